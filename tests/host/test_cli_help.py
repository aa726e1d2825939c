"""--help of every command has an example and describes every value."""

import re

import pytest

from truearm.cli import main as cli
from truearm_sim.simbox import FAULTS


def commands(command, name=""):
    """Names of all commands and groups, as they are typed after ``truearm``, with the command."""
    yield name, command
    for each, sub in getattr(command, "commands", {}).items():
        yield from commands(sub, f"{name} {each}".strip())


COMMANDS = dict(commands(cli.command_tree()))


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example_of_that_very_command(run, name):
    outcome = run(*name.split(), "--help")
    assert outcome.code == 0
    words = " ".join(outcome.out.split())
    assert f"truearm {name}".strip() in words.partition("Example")[2]
    assert "range>" not in words, "say what the number is, not of which type"


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_name_options_that_exist(run, name):
    """Of a command's own example, wherever it stands in its help."""
    words = run(*name.split(), "--help").out
    example = re.split(r"arguments:|Options:|Commands:", re.split(r"Examples?:", " ".join(words.split()))[-1])[0]
    known = {option for parameter in COMMANDS[name].params for option in (*parameter.opts, *parameter.secondary_opts)}
    if not hasattr(COMMANDS[name], "commands"):
        assert set(re.findall(r"(?<=\s)--[a-z][a-z-]*", example)) <= known


def test_the_help_names_every_fault_and_every_command(run):
    words = " ".join(run("simulate", "--help").out.split())
    for fault in FAULTS:
        assert fault in words
    # It is written without importing them.
    listed = {name: text for summaries in cli.TASKS.values() for name, text in summaries.items()}
    assert listed == {name: one.get_short_help_str(1000) for name, one in cli.command_tree().commands.items()}
