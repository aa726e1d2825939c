"""The command line: click's; errors become one line on stderr and an exit code.

The exit codes stand in ``truearm.errors``. To add a command, write it in the module of its task, or as a group of
commands ``app`` in a module of its own, and add it to ``TASKS``.
"""

from __future__ import annotations

import functools
import io
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from truearm.additions import BROKEN, plug_in_error
from truearm.cli.output import print_json
from truearm.cli.project import CommandGroup, defaults, missing_file, option_for
from truearm.errors import ExitCode, PlugInError, TruearmError, exit_code_table
from truearm.findings import Finding, option
from truearm.text import one_line
from truearm.version import VERSION

# What ``truearm --help`` lists for each task: commands, and the first sentences of their help pages.
TASKS = {
    "Try": {
        "demo": "Calibrate a simulated robot (default: the PUMA 560) with a ball-bar or a line device, from the firmware to the report.",
        "simulate": "Simulate a sensor box and a robot, to rehearse a session on your own arm.",
    },
    "Measure": {
        "init": "Create a project: truearm.toml, rig.toml and a first plan.",
        "robot": "Read the model that a robot's controller computes with.",
        "status": "Show the files of this folder's project, and the command that comes next.",
        "plan": "Plan what to measure, and predict what the measurements will determine.",
        "record": "Record a sensor box and a robot into a session file.",
        "seats": "Fill the joints of seats in sockets into their table, from a log of the arm.",
        "inspect": "Show whether a session is usable, what is in it, and what was lost.",
        "characterize": "Measure how well a robot repeats: spread, backlash, settling time, noise of joints and sensor, each with its 95 % interval.",
        "session": "Repair session files, and convert them for other programs.",
    },
    "Identify": {
        "identify": "Identify a robot's parameters from observations.",
        "report": "Write the report on a result, with a certificate as its first page.",
        "validate": "Judge a calibration by other measurements: errors with and without it, in parts of the workspace, and a verdict.",
        "map": "Map the error of the uncalibrated robot over a section of its workspace, with the uncertainty of the map.",
        "fleet": "Identify the robots of all projects in some folders, several at a time.",
    },
    "Use": {
        "correct": "Correct targets so that the real robot reaches them.",
        "export": "Write a calibrated robot for other programs.",
    },
    "Box": {"box": "Find, flash, test, configure, calibrate and monitor a sensor box."},
}
TASK_MODULES = {"Try": "simulate", "Measure": "measure", "Identify": "identify", "Use": "use", "Box": "box"}
MODULES = {name: TASK_MODULES[task] for task, summaries in TASKS.items() for name in summaries}  # of commands
MODULES |= {name: name for name in ("init", "status", "session")}
COMMANDS = tuple(MODULES)

# The parser's words for a wrong command line, and plainer ones.
_PLAINER = (
    (r"Got unexpected extra argument(?:\(s\)|s)? \((.*)\)", r"Too many arguments: \1"),
    (r"is not a valid int(?:eger)?(?: range)?", "is not a whole number"),
    (r"is not a valid float(?: range)?", "is not a number"),
    (r"is not in the range x>=(\S+)", r"is less than \1"),
    (r"is not in the range (\S+)<=x<=(\S+)", r"is not from \1 to \2"),
    (r"requires an argument", "needs a value"),
    (r"\.$", ""),
)
_COMPLETE = "_TRUEARM_COMPLETE"  # set by the function with which a shell completes


class Tasks(CommandGroup):
    """All commands, listed by task; for this, none of their modules is imported."""

    def summaries(self) -> Mapping[str, Mapping[str, str]]:
        """Return the commands below headings, with their first sentences."""
        return TASKS


@functools.cache
def command_tree(names: tuple[str, ...] = COMMANDS) -> Tasks:
    """Return the commands, or only some of them: to import all takes as long as to import click."""
    tree = Tasks(
        "truearm",
        help="Measure a robot arm, identify its kinematic parameters with their uncertainty, and correct its targets.",
        epilog=f"In a project folder, you can leave out options and files, even those marked as required: truearm.toml provides them. See truearm init --help.\n\nTo complete commands in bash: source <({_COMPLETE}=bash_source truearm); zsh and fish work alike.\n\nExit codes: {exit_code_table()}\n\nExample: truearm demo",
    )
    for name in names:
        module = vars(import_module(f"truearm.cli.{MODULES[name]}"))
        tree.add_command(module.get(name) or module.get(f"{name}_") or module["app"])
    click.version_option(VERSION, message="truearm %(version)s", help="Print the version and exit.")(tree)
    return tree


def tree_for(arguments: Sequence[str]) -> Tasks:
    """Return the commands that a command line may use: the one that it names, none for their list, or all."""
    first = arguments[0] if arguments else "--help"
    return command_tree((first,) if first in COMMANDS else () if first in ("--help", "--version") else COMMANDS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``truearm`` with ``arguments`` (``sys.argv`` without the first if None); returns the exit code."""
    if sys.stdout is None or sys.stderr is None:  # closed by the caller: output is discarded
        sys.stdout = sys.stdout or open(os.devnull, "w")
        sys.stderr = sys.stderr or open(os.devnull, "w")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a Latin-1 terminal must not end a run at its first "σ"
            stream.reconfigure(errors="backslashreplace")
    if "OMP_NUM_THREADS" not in os.environ:  # matrices are small: one thread per core would mostly wait
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        return _run(arguments)
    except PlugInError as exc:  # the command itself may be what cannot be loaded
        _complain(str(exc), exc.finding, arguments)
        return exc.exit_code
    except TruearmError as exc:
        for finding in exc.noticed:
            print(f"{finding.severity}: {finding.text(option)}", file=sys.stderr)
        _complain(exc.text(_option_of(arguments)), exc.finding, arguments)
        return exc.exit_code
    except click.UsageError as exc:
        message = _reason(exc, arguments)
        named = [word for word in arguments[:1] if word in COMMANDS]  # of a line that could not be read at all
        command = exc.ctx.command_path if exc.ctx else " ".join(["truearm", *named])
        finding = Finding("usage", {"reason": message, "command": command})
        _complain(finding.text("--{}".format), finding, arguments)
        return ExitCode.INPUT
    except (KeyboardInterrupt, click.Abort):
        _complain("interrupted")
        return ExitCode.INTERRUPTED
    except BrokenPipeError:  # the reader of the output closed it, as `| head` does
        _discard_stdout()
        return ExitCode.FAILED
    except OSError as exc:  # files and links raise TruearmError; this is standard output, for example on a full disk
        if error := plug_in_error(exc):
            _complain(str(error), error.finding, arguments)
            return error.exit_code
        _discard_stdout()
        _complain(f"cannot write: {exc.strerror or exc}")
        return ExitCode.FAILED
    except Exception as exc:
        if not isinstance(exc.__cause__, KeyboardInterrupt):
            error = plug_in_error(exc)
            if error is None:
                raise
            _complain(str(error), error.finding, arguments)
            return error.exit_code
        _complain("interrupted")  # during the import of a compiled module, which turns it into an ImportError
        return ExitCode.INTERRUPTED


def _discard_stdout() -> None:
    """Redirect standard output to nowhere: flushing its buffer at exit would raise again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _option_of(arguments: Sequence[str]) -> Callable[[str], str]:
    """Return a function from an argument's name to the option that this command line's command declares for it."""
    command: Any = tree_for(arguments)
    for word in arguments:
        if word not in getattr(command, "commands", {}):
            break
        command = command.commands[word]
    flags = {parameter.name: parameter.opts[0] for parameter in command.params} | getattr(command, "flags", {})
    return lambda name: flags[name] if flags.get(name, "").startswith("-") else option(name)


def _reason(exc: click.UsageError, arguments: Sequence[str]) -> str:
    """Return why the parser refuses a command line.

    An unknown option, a file that a project does not have, or the parser's own message.
    """
    if isinstance(exc, click.NoSuchOption) and exc.ctx is not None:
        return option_for(exc.ctx.command, exc.ctx.info_name or "", exc.option_name)
    parameter = exc.param if isinstance(exc, click.MissingParameter) else None
    if parameter is not None and (missing := missing_file(parameter.name, arguments[0], Path.cwd())):
        return missing
    message = exc.format_message()
    for theirs, ours in _PLAINER:
        message = re.sub(theirs, ours, message)
    return message


def _shown_progress() -> AbstractContextManager[None]:
    if not sys.stderr.isatty():
        return nullcontext()
    from truearm.cli.progress_line import shown_progress  # slow to import

    return shown_progress()


def _run(arguments: list[str]) -> int:
    if _COMPLETE in os.environ:  # the shell asks for completions on standard output
        return int(command_tree().main(prog_name="truearm", standalone_mode=False) or ExitCode.DONE)
    try:
        command = tree_for(arguments)
        # Not command.main(): it prints errors in a box of several lines and swallows KeyboardInterrupt.
        answers = defaults(Path.cwd())
        context = command.make_context("truearm", list(arguments), obj=arguments, default_map=answers)
        with context, _shown_progress():
            command.invoke(context)
        sys.stdout.flush()
    except click.exceptions.Exit as exc:
        return int(exc.exit_code)
    finally:
        for error in BROKEN.values():
            if str(error) != str(sys.exc_info()[1]):
                print("warning: " + one_line(str(error)), file=sys.stderr)
    return ExitCode.DONE


def _complain(message: str, finding: Finding | None = None, arguments: Sequence[str] = ()) -> None:
    """Print an error on standard error; with --json also as JSON on standard output."""
    print("truearm: " + one_line(message), file=sys.stderr)
    if finding and "--json" in arguments:
        print_json({"error": {"code": finding.code, "text": one_line(message), "values": finding.values}})
