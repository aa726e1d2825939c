"""The command line: one typer app; errors become one line on stderr and an exit code.

The exit codes stand in ``truearm.exit_codes``. To add a command, write ``cli/NAME.py`` and add it to the group of its task in ``TASKS``.
"""

from __future__ import annotations

import functools
import io
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from truearm.cli.box import app as box
from truearm.cli.characterize import characterize
from truearm.cli.command import OPTIONS, stem_of
from truearm.cli.correct import correct
from truearm.cli.demo import demo
from truearm.cli.export import export
from truearm.cli.fleet import fleet
from truearm.cli.identify import identify
from truearm.cli.init import init
from truearm.cli.inspect import inspect
from truearm.cli.map import map_
from truearm.cli.names import option_for
from truearm.cli.output import print_json
from truearm.cli.plan import app as plan
from truearm.cli.progress_line import shown_progress
from truearm.cli.project import CommandGroup, ProjectCommand, defaults, missing_file
from truearm.cli.record import RecordCommand, record
from truearm.cli.report import report
from truearm.cli.robot import app as robot
from truearm.cli.seats import seats
from truearm.cli.session import app as session
from truearm.cli.simulate import SimulateCommand, simulate
from truearm.cli.status import status
from truearm.cli.validate import validate
from truearm.errors import TruearmError
from truearm.exit_codes import ExitCode, table
from truearm.findings import Finding, option
from truearm.text import one_line
from truearm.version import VERSION

# What ``truearm --help`` lists for each task; a typer app is a group of commands.
TASKS: dict[str, tuple[Any, ...]] = {
    "Try": (demo, simulate),
    "Measure": (init, robot, status, plan, record, seats, inspect, characterize, session),
    "Identify": (identify, report, validate, map_, fleet),
    "Use": (correct, export),
    "Box": (box,),
}
COMMANDS = {
    getattr(command, "__name__", None) or command.info.name: (command, task)
    for task, commands in TASKS.items()
    for command in commands
}

# Options and arguments that typer rejects raise a UsageError. That class lives in click or, in later versions, inside
# typer, which exports only its subclass BadParameter.
_UsageError = cast(type[typer.BadParameter], typer.BadParameter.__mro__[1])

# The parser's words for a wrong command line, and plainer ones. Versions of typer differ: some have others.
_PLAINER = (
    (r"Value error, ", ""),
    (r"Input should be greater than or equal to (\S+)", r"must be \1 or more"),
    (r"Input should be less than or equal to (\S+)", r"must be \1 or less"),
    (r"Input should be a valid integer.*", "is not a whole number"),
    (r"Input should be a valid number.*", "is not a number"),
    (r"Got unexpected extra argument(?:\(s\)|s)? \((.*)\)", r"Too many arguments: \1"),
    (r"is not a valid int(?:eger)?(?: range)?", "is not a whole number"),
    (r"is not a valid float(?: range)?", "is not a number"),
    (r"requires an argument", "needs a value"),
    (r"\.$", ""),
)
_COMPLETE = "_TRUEARM_COMPLETE"  # set by the shell function that --install-completion writes

CLASS_OF = {"simulate": SimulateCommand, "record": RecordCommand}


def _print_version(wanted: bool) -> None:
    if wanted:
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
    """Return the commands as typer builds them, or with ``only`` one of them: to build all takes as long as to import typer."""
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
    for name, (command, task) in COMMANDS.items():
        if only not in (None, name):
            continue
        shown: dict[str, Any] = {"rich_help_panel": task}
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, **shown)
        else:
            app.command(name, cls=CLASS_OF.get(name, ProjectCommand), **shown)(command)
    tree: Any = typer.main.get_command(app)  # in which typer lists groups last
    tree.commands = {name: tree.commands[name] for name in COMMANDS if name in tree.commands}
    return tree


def tree_for(arguments: Sequence[str]) -> Any:
    """Return the commands that a command line may use: the one that it names, or all."""
    first = arguments[0] if arguments else None
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
        key: one.opts[0]
        for one in command.params
        if one.opts[0].startswith("-")
        for key in (stem_of(one.name), one.name)
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
    return option_for(command_tree(), exc.ctx.command, exc.ctx.info_name or "", option)


def _missing(exc: typer.BadParameter, arguments: Sequence[str]) -> str | None:
    """Return the message for a file that is missing on a project's command line, None for any other error."""
    parameter = getattr(exc, "param", None)
    wanted = type(exc).__name__ == "MissingParameter" and parameter is not None
    return missing_file(parameter.name or "", arguments, Path.cwd()) if wanted and parameter else None


def _run(arguments: list[str]) -> int:
    if _COMPLETE in os.environ:  # the shell asks for completions on standard output
        return int(command_tree().main(prog_name="truearm", standalone_mode=False) or ExitCode.DONE)
    command = tree_for(arguments)
    try:
        # Not command.main(): it prints errors in a box of several lines and swallows KeyboardInterrupt.
        answers = defaults(Path.cwd())
        context = command.make_context("truearm", list(arguments), obj=arguments, default_map=answers)
        with context, shown_progress():
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
