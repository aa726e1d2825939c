"""The command line: one typer app; errors become one line on stderr and an exit code.

The exit codes stand in ``truearm.exit_codes``. To add a command, write ``cli/NAME.py``
with a function NAME, or a typer app for a group of commands, and add it to its task in ``TASKS``.
"""

from __future__ import annotations

import functools
import io
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from truearm.cli.command import OPTIONS, stem_of
from truearm.cli.names import option_for
from truearm.cli.output import print_json
from truearm.cli.project import CommandGroup, ProjectCommand, defaults, missing_file
from truearm.errors import TruearmError
from truearm.exit_codes import ExitCode, table
from truearm.findings import Finding, option
from truearm.text import one_line
from truearm.version import VERSION

# What ``truearm --help`` lists for each task: commands, each a module here, and the first sentences of their help pages.
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
COMMANDS = {name: task for task, summaries in TASKS.items() for name in summaries}

# Options and arguments that typer rejects raise a UsageError. That class lives in click or, in later versions, inside
# typer, which exports only its subclass BadParameter.
_UsageError = cast(type[typer.BadParameter], typer.BadParameter.__mro__[1])

# The parser's words for a wrong command line, and plainer ones.
_PLAINER = (
    (r"Got unexpected extra argument(?:\(s\)|s)? \((.*)\)", r"Too many arguments: \1"),
    (r"is not a valid int(?:eger)?(?: range)?", "is not a whole number"),
    (r"is not a valid float(?: range)?", "is not a number"),
    (r"requires an argument", "needs a value"),
    (r"\.$", ""),
)
_COMPLETE = "_TRUEARM_COMPLETE"  # set by the shell function that --install-completion writes


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"truearm {VERSION}")
        raise typer.Exit


def _root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@functools.cache
def command_tree(only: str | None = None) -> Any:
    """Return the commands as typer builds them, or with ``only`` one of them: all take as long as to import typer."""
    app = _app()
    for name in COMMANDS if only is None else (only,):
        module, shown = import_module(f"truearm.cli.{name}"), {"rich_help_panel": COMMANDS[name]}
        group: typer.Typer | None = getattr(module, "app", None)
        if group is not None:
            app.add_typer(group, name=name, **cast(Any, shown))
        else:
            command = getattr(module, name, None) or getattr(module, f"{name}_")
            own_class = getattr(module, f"{name.capitalize()}Command", ProjectCommand)
            app.command(name, cls=own_class, **cast(Any, shown))(command)
    return _in_order(app)


def _app() -> typer.Typer:
    app = typer.Typer(
        name="truearm",
        cls=CommandGroup,
        help="Measure a robot arm, identify its kinematic parameters with their uncertainty, and correct its targets.",
        epilog=f"In a project folder, you can leave out options and files, even those marked as required: truearm.toml provides them. See truearm init --help.\n\nExit codes: {table()}\n\nExample: truearm demo",
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        add_completion=True,
    )
    app.callback(invoke_without_command=True)(_root)
    return app


def _in_order(app: typer.Typer) -> Any:
    """Return the tree of an app in the order of COMMANDS: typer lists groups last."""
    tree: Any = typer.main.get_command(app)
    tree.commands = {name: tree.commands[name] for name in COMMANDS if name in tree.commands}
    return tree


def listing() -> Any:
    """Return the commands without their options, as ``truearm --help`` lists them: none of their modules is imported."""
    app = _app()
    for task, summaries in TASKS.items():
        for name, summary in summaries.items():
            app.command(name, cls=ProjectCommand, help=summary, rich_help_panel=task)(lambda: None)
    return _in_order(app)


def tree_for(arguments: Sequence[str]) -> Any:
    """Return the commands that a command line may use: the one that it names, their list, or all."""
    first = arguments[0] if arguments else "--help"
    if first in ("--help", "--version"):
        return listing()
    return command_tree(first if first in COMMANDS else None)


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
    except TruearmError as exc:
        _complain(exc.text(_option_of(arguments)), exc.finding, arguments)
        return exc.exit_code
    except _UsageError as exc:
        message = _unknown_option(exc) or _missing(exc, arguments) or _plain(exc.format_message())
        command = exc.ctx.command_path if exc.ctx else _command_of(arguments)
        finding = Finding("usage", {"reason": message, "command": command})
        _complain(finding.text("--{}".format), finding, arguments)
        return ExitCode.INPUT
    except (KeyboardInterrupt, typer.Abort):
        _complain("interrupted")
        return ExitCode.INTERRUPTED
    except BrokenPipeError:  # the reader of the output closed it, as `| head` does
        _discard_stdout()
        return ExitCode.FAILED
    except OSError as exc:  # files and links raise TruearmError; this is standard output, for example on a full disk
        _discard_stdout()
        _complain(f"cannot write: {exc.strerror or exc}")
        return ExitCode.FAILED
    except Exception as exc:
        if not isinstance(exc.__cause__, KeyboardInterrupt):
            raise
        _complain("interrupted")  # during the import of a compiled module, which turns it into an ImportError
        return ExitCode.INTERRUPTED


def _discard_stdout() -> None:
    """Redirect standard output to nowhere: flushing its buffer at exit would raise again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _option_of(arguments: Sequence[str]) -> Callable[[str], str]:
    """Return a function from an argument's name to the option that this command line's command declares for it."""
    command = tree_for(arguments)
    for word in arguments:
        if word not in getattr(command, "commands", {}):
            break
        command = command.commands[word]
    options = {
        key: parameter.opts[0]
        for parameter in command.params
        if parameter.opts[0].startswith("-")
        for key in (stem_of(parameter.name), parameter.name)
    }
    return lambda name: options.get(OPTIONS.get(name, name), option(name))


def _plain(message: str) -> str:
    """Return the parser's message on a wrong command line in plainer words."""
    for theirs, ours in _PLAINER:
        message = re.sub(theirs, ours, message)
    return message


def _command_of(arguments: Sequence[str]) -> str:
    """Return the command of a line that its parser could not read at all, such as "truearm identify"."""
    return " ".join(["truearm", *(word for word in arguments[:1] if word in COMMANDS)])


def _unknown_option(exc: typer.BadParameter) -> str | None:
    """Return the message for an option that the command does not have, None for any other error."""
    option = getattr(exc, "option_name", None)  # only of unknown options
    if option is None or exc.ctx is None:
        return None
    return option_for(exc.ctx.command, exc.ctx.info_name or "", option)


def _missing(exc: typer.BadParameter, arguments: Sequence[str]) -> str | None:
    """Return the message for a file that is missing on a project's command line, None for any other error."""
    parameter = getattr(exc, "param", None)
    is_missing = type(exc).__name__ == "MissingParameter" and parameter is not None
    return missing_file(parameter.name or "", arguments[0], Path.cwd()) if is_missing and parameter else None


def _shown_progress() -> AbstractContextManager[None]:
    if not sys.stderr.isatty():
        return nullcontext()
    from truearm.cli.progress_line import shown_progress  # slow to import

    return shown_progress()


def _run(arguments: list[str]) -> int:
    if _COMPLETE in os.environ:  # the shell asks for completions on standard output
        return int(command_tree().main(prog_name="truearm", standalone_mode=False) or ExitCode.DONE)
    command = tree_for(arguments)
    try:
        # Not command.main(): it prints errors in a box of several lines and swallows KeyboardInterrupt.
        answers = defaults(Path.cwd())
        context = command.make_context("truearm", list(arguments), obj=arguments, default_map=answers)
        with context, _shown_progress():
            command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as exc:
        return int(exc.exit_code)
    return ExitCode.DONE


def _complain(message: str, finding: Finding | None = None, arguments: Sequence[str] = ()) -> None:
    """Print an error on standard error; with --json also as JSON on standard output."""
    print("truearm: " + one_line(message), file=sys.stderr)
    if finding and "--json" in arguments:
        print_json({"error": {"code": finding.code, "text": one_line(message), "values": finding.values}})
