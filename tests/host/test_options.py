"""Options: docs/reference/options.md says what each means, every command and its --help follow it, and earlier names are refused."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import click
import pytest
from tests.refusals import ended

from truearm.bounds import CELL
from truearm.cli import command as declaration
from truearm.cli.main import TASKS, command_tree, main
from truearm.cli.project import EARLIER, MEANINGS
from truearm.errors import RobotError
from truearm.model.robot_file import load_robot
from truearm.plan.options import PoseOptions
from truearm.types import Payload
from truearm_sim.simbox import FAULTS

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "options.md").read_text()
ROWS = {
    word: tuple(value.split(" or "))
    for words, value in re.findall(r"^\| (`--.*?) \| (.*?) ?\|", PAGE, re.MULTILINE)
    for word in re.findall(r"`(--[\w-]+)`", words)
}


def commands(tree=None, name="truearm", groups=False):
    """Every command by what is typed, with or without the groups."""
    tree = tree or command_tree()
    below = getattr(tree, "commands", {})
    found = {name: tree} if groups or not below else {}
    for word, sub in below.items():
        found |= commands(sub, f"{name} {word}", groups)
    return found


def options():
    """Each option of each command."""
    return [(name, one.opts[0], one) for name, command in commands().items() for one in command.params]


def test_the_page_names_options_with_their_values():
    for name, word, one in options():
        if word in ROWS:
            given = "" if one.is_flag else (one.metavar or "").removeprefix("[NAME=]")
            assert given in ROWS[word], f"{name} {word} {given}"
    # Where the page does not name it: what it takes is the same anyway.
    takes = {}
    for name, word, one in options():
        if word.startswith("--") and word not in ROWS and not one.is_flag and not name.startswith("truearm box"):
            takes.setdefault(word, {}).setdefault(str(one.metavar), []).append(name)
    assert {word for word, kinds in takes.items() if len(kinds) > 1} == {"--format", "--method"}  # each has its own
    assert set(ROWS) <= {word for _, word, _ in options()}


@pytest.mark.parametrize(
    ("typed", "now"),
    [
        ("identify t.csv --robot puma560", "--model"),
        ("record --robot tcp://127.0.0.1:7008", "--address"),
        ("record --device /dev/ttyACM0", "--box"),
        ("box info --device /dev/ttyACM0", "--box"),
        ("simulate --robot rtde", "--protocol"),
        ("simulate --rig-file rig.toml", "--rig"),
        ("identify t.csv --save-table x.csv", "--table-out"),
        ("identify t.csv --allow joint1", "--apply"),
        ("inspect s.mcap --allow-truncated", "--allow-damaged"),
        ("demo --device x", "--device"),  # it has no box
        ("record --duration 3", "--duration-s"),
        ("recover session.mcap", "truearm session recover"),
        ("export-session session.mcap --out x", "truearm session export"),
    ],
)
def test_an_earlier_word_is_refused_and_the_new_one_named(typed, now, capsys):
    assert main(typed.split()) == 2
    ended(capsys.readouterr().err, "usage", reason=now)


def test_an_unknown_option_is_not_answered_by_another_word(capsys):
    assert main(["map", "--tolerance", "3"]) == 2
    assert "--force" not in capsys.readouterr().err


@pytest.mark.parametrize("typed", ["correct targets.csv r.json --out c.csv", "validate poses.csv r.json"])
def test_files_in_the_wrong_order_are_named_as_such(typed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("targets.csv").write_text("x_mm,y_mm,z_mm\n1,2,3\n")
    Path("poses.csv").write_text("kind,bar\n")
    Path("r.json").write_text('{"format": "truearm-result"}')
    assert main(typed.split()) == 2
    ended(capsys.readouterr().err, "invalid-input", place=typed.split()[1])


@pytest.mark.parametrize(
    ("typed", "meant"), [("UR5E", "ur5e"), ("kuka_lbr", "iiwa14"), ("ABB", "irb120"), ("franka", "panda or fr3")]
)
def test_a_wrong_robot_is_answered_by_what_it_means(typed, meant):
    with pytest.raises(RobotError, match=f"did you mean {meant}"):
        load_robot(typed)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("calibrate poses.csv", "truearm identify"),
        ("gauge lvdt", "truearm box gauge"),
        ("flash", "truearm box flash"),
        ("get", "truearm box config get"),
        ("box calibrate", "truearm identify"),
        ("Verify result.json", "truearm validate"),
        ("identfy", "'identify'"),
    ],
)
def test_a_wrong_command_is_answered_by_what_it_means(typed, meant, capsys):
    assert main(typed.split()) == 2
    assert meant in capsys.readouterr().err


def test_commands_exist_in_five_tasks():
    paths = {name.removeprefix("truearm ") for name in commands()} | {"box"}
    assert {*MEANINGS, *(new for old, new in EARLIER.items() if "--" not in old)} <= paths
    assert [*TASKS] == ["Try", "Measure", "Identify", "Use", "Box"]
    assert [*command_tree().commands] == [name for names in TASKS.values() for name in names]
    assert len(command_tree().commands) <= 20


@pytest.mark.parametrize("name", commands(groups=True))
def test_help_has_an_example_of_that_very_command_with_options_that_exist(run, name):
    """Of a command's own example, wherever it stands in its help."""
    outcome, command = run(*name.split()[1:], "--help"), commands(groups=True)[name]
    words = " ".join(outcome.out.split())
    assert (outcome.code, name in words.partition("Example")[2]) == (0, True)
    assert "range>" not in words, "say what the number is, not of which type"
    example = re.split(r"arguments:|Options:|Commands:", re.split(r"Examples?:", words)[-1])[0]
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    assert hasattr(command, "commands") or set(re.findall(r"(?<=\s)--[a-z][a-z-]*", example)) <= known


def test_the_help_names_every_fault_and_every_command(run):
    words = run("simulate", "--help").out.split()
    assert all(fault in " ".join(words) for fault in FAULTS)
    # It is written without importing them.
    listed = {name: text for summaries in TASKS.values() for name, text in summaries.items()}
    assert listed == {name: one.get_short_help_str(1000) for name, one in command_tree().commands.items()}


def test_what_writes_a_file_has_force():
    """An existing file is refused without it. Folders are judged by their content."""
    for name, command in commands().items():
        words = {one.opts[0]: one for one in command.params}
        writes = [one for word, one in words.items() if word in ("--out", "--report") or word.endswith("-out")]
        # fleet's rerun replaces its own table
        if any(one.metavar == "FILE" for one in writes) and name != "truearm fleet":
            assert "--force" in words, name


def test_a_help_page_shows_ten_options_and_describes_all():
    for name, _, one in options():
        assert one.help, (name, one.name)
    for name, command in commands().items():
        shown = [one.opts[0] for one in command.params if one.opts[0][0] == "-" and one.name not in command.expert]
        assert len(shown) <= 10, name


def test_a_function_gets_si():
    """Of an option in another unit, as a record or an argument; texts become what they name."""
    taken = []

    @declaration.command()
    def probe(chosen: PoseOptions, *, cell: Annotated[float, CELL] = 0.5, payload: object = None) -> None:
        """Take some options.

        Options
        -------
        cell_mm : MM
            Size.
        spread_mm : MM
            Spread.
        bar : NAME
            Bars.
        """
        taken.append((chosen, cell, payload))

    probe.main(["--spread-mm", "2", "--bar", "b1", "--dwell-s", "3", "--payload", "2,0,0,8"], standalone_mode=False)
    probe.main(["--cell-mm", "25"], standalone_mode=False)
    payload = Payload(2.0, (0.0, 0.0, 0.008))
    assert taken == [(PoseOptions(dwell=3.0, spread=2e-3, bars=("b1",)), 0.5, payload), (PoseOptions(), 0.025, None)]
    with pytest.raises(click.UsageError, match=r"0\.5 is not in the range"):
        probe.main(["--cell-mm", "0.5"], standalone_mode=False)


WITHOUT_JSON = {
    "simulate": "it prints the ports for the recorder, and writes a session",
    "box reset": "the result is the exit code",
    "box gauge": "it asks its operator; box config get --json prints the calibration",
    "box monitor": "a display without an end",
}


def test_what_prints_results_prints_them_as_json_too():
    without = {name.removeprefix("truearm ") for name, command in commands().items() if not _has(command, "--json")}
    assert without == set(WITHOUT_JSON)
    (paragraph,) = re.findall(r"^Every command that prints results has `--json`.*?\n\n", PAGE, re.MULTILINE | re.DOTALL)
    assert all(name.removeprefix("box ") in paragraph for name in without)


def _has(command, word):
    return any(word in one.opts for one in command.params)


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("truearm ide", "identify"),
        ("truearm identify --mode", "--model"),
        ("truearm identify --model pu", "puma560"),
        ("truearm box config ''", "get set"),
    ],
)
def test_a_shell_completes(typed, offered):
    """In a real bash, as truearm --help says."""
    program = Path(sys.executable).parent / "truearm"
    script = f"""
        export PATH={program.parent}:$PATH
        source <(_TRUEARM_COMPLETE=bash_source truearm)
        COMP_WORDS=({typed}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
        _truearm_completion truearm
        echo "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == offered.split()
