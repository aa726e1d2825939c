"""One table of exit codes, with which code, documentation, --help and every command agree."""

import ast
import re
from pathlib import Path

import pytest

from truearm import errors
from truearm.cli import main as cli
from truearm.errors import ExitCode

ROOT = Path(__file__).parents[2]
HOST = ROOT / "host" / "truearm"


def commands(command, words=()):
    """Return every executable command, by its words."""
    below = getattr(command, "commands", {})
    if not below:
        yield words, command
    for name, sub in below.items():
        yield from commands(sub, (*words, name))


# of the trees that a command line gets: one for each word
COMMANDS = dict(one for name in cli.command_tree().commands for one in commands(cli.command_tree((name,))))


def test_the_codes_that_scripts_rely_on_are_in_documentation_and_help(run):
    assert {code.name: code.value for code in ExitCode} == {
        "DONE": 0,
        "FAILED": 1,
        "INPUT": 2,
        "UNUSABLE": 3,
        "INCOMPLETE": 4,
        "INTERRUPTED": 130,
    }
    page = (ROOT / "docs" / "reference" / "exit-codes.md").read_text()
    rows = re.findall(r"^\| (\d+) \| (\w+) \| (.+) \|$", page, re.MULTILINE)
    assert rows == [(str(code.value), code.name, code.meaning) for code in ExitCode]
    told = " ".join(run("--help").out.split())
    assert all(f"{code.value} {code.meaning}" in told for code in ExitCode)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_an_unknown_option_is_wrong_input(run, words):
    outcome = run(*words, "--no-such-option")
    assert (outcome.code, outcome.out, outcome.err.count("\n")) == (ExitCode.INPUT, "", 1)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_file_that_is_not_there_is_wrong_input_and_a_box_a_failure(run, words, tmp_path):
    """Of every command that needs one or the other."""
    needed = [one for one in COMMANDS[words].params if one.required]
    files = [one for one in needed if one.name in ("rig", "plan", "file") or one.param_type_name == "argument"]
    talks = words[0] == "box" and words[-1] not in ("list", "flash")
    box = [one for one in COMMANDS[words].params if one.name == "box" and talks]
    if not files and not box:
        return
    arguments = []
    for one in needed + box:
        value = {"model": "puma560", "box": "socket://127.0.0.1:1"}.get(one.name, tmp_path / "none" / "absent")
        arguments += [value] if one.param_type_name == "argument" else [one.opts[0], value]
    outcome = run(*words, *arguments)
    allowed = [ExitCode.INPUT] * bool(files) + [ExitCode.FAILED] * bool(box)  # whichever is looked for first
    assert outcome.code in allowed, outcome
    assert (outcome.out, outcome.err.count("\n")) == ("", 1)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (errors.InputError("x"), ExitCode.INPUT),
        (errors.ProblemError("x"), ExitCode.INPUT),
        (errors.SessionError("x"), ExitCode.INPUT),
        (errors.LinkError("x"), ExitCode.FAILED),
        (errors.WriteError("x"), ExitCode.FAILED),
        (OSError(28, "No space left on device"), ExitCode.FAILED),
        (errors.IncompleteError("x"), ExitCode.INCOMPLETE),
        (KeyboardInterrupt(), ExitCode.INTERRUPTED),
    ],
)
@pytest.mark.parametrize("words", [("identify",), ("box", "test")], ids=" ".join)
def test_whatever_happens_in_a_command_has_its_code(capfd, monkeypatch, words, error, code):
    """The command's own work is replaced by what happens in it."""

    def fails(*_, **__):
        raise error

    monkeypatch.setattr(COMMANDS[words], "callback", fails)
    monkeypatch.setattr(COMMANDS[words], "params", [])
    monkeypatch.setattr(cli, "_discard_stdout", lambda: None)
    assert cli.main(list(words)) == code
    assert capfd.readouterr().err.count("\n") == 1


def test_every_error_has_a_code_of_the_table():
    every = [one for one in vars(errors).values() if isinstance(one, type) and issubclass(one, errors.TruearmError)]
    assert {type(one.exit_code) for one in every} == {ExitCode}


def test_no_command_ends_by_a_number_of_its_own():
    """click.exceptions.Exit, sys.exit and os._exit have no number but one of the table; __main__ may import nothing. An Answer's end is declared as one."""
    for path in sorted(HOST.rglob("*.py")):
        text = path.read_text()
        nodes = ast.walk(ast.parse(text)) if re.search(r"Exit\(|exit\(", text) else ()
        for node in nodes:
            if not (
                isinstance(node, ast.Call)
                and ast.unparse(node.func) in ("click.exceptions.Exit", "sys.exit", "os._exit")
            ):
                continue
            given = [ast.unparse(one) for one in node.args]
            allowed = path.name == "__main__.py" or (
                given and (given[0].startswith("ExitCode.") or given[0] == "self.end")
            )
            assert allowed, f"{path.name}: {ast.unparse(node)}"
