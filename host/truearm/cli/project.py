"""Defaults of options that the commands take from the truearm.toml of the current project."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperCommand, TyperGroup

from truearm.cli.command import ARGUMENTS, EXPERT
from truearm.cli.names import command_for
from truearm.errors import InputError
from truearm.files.file_kind import KINDS, kind_of
from truearm.files.project_folder import project_of

if TYPE_CHECKING:
    from truearm.files.project_file import Project

SUMMARY = 1000  # characters: a first sentence in the list of commands is wrapped, never cut
RESULT_TAKEN = "truearm.result"  # in a context: the project's result, set before the files that were typed
BOX_COMMANDS = ("test", "monitor", "gauge", "info", "flash", "reset")
# kinds of file that a parameter takes (``files.file_kind``)
TAKES = {
    "session": ("session",),
    "inputs": ("session", "table"),
    "measured": ("session", "table"),
    "result": ("result",),
    "rig": ("rig",),
    "noise": ("noise", "rig"),  # one that is written by hand has keys of a rig
    "plan": ("plan",),
    "model": ("robot", "exported"),
    "targets": ("targets", "program"),
}
Answer = Callable[[], Any]  # the value of an option; None: no default


class ProjectCommand(TyperCommand):
    """A command that prints on standard error what it took from truearm.toml and refuses numbers that are not finite."""

    def get_short_help_str(self, limit: int = SUMMARY) -> str:
        """Return the whole first sentence of the help page; ``limit`` would cut it."""
        return super().get_short_help_str(max(limit, SUMMARY))

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the usage line's parts; typer sets braces about a required argument."""
        return [piece.strip("{}") for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """List arguments and options below their headings."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            if row := parameter.get_help_record(ctx):
                usual = "Options" if parameter.opts[0].startswith("-") else ARGUMENTS
                panels.setdefault(getattr(parameter, "rich_help_panel", None) or usual, []).append(row)
        for heading in (ARGUMENTS, "Options", EXPERT):
            if heading in panels:
                with formatter.section(heading):
                    formatter.write_dl(panels[heading])

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line. Of a command that takes a result and further files, the project's result may be left out."""
        files = [parameter.name or "" for parameter in self.params if not parameter.opts[0].startswith("-")]
        if files[:1] == ["result"] and len(files) == 2:
            words, *_ = self.make_parser(ctx).parse_args(list(args))
            first, further = (words.get(name) for name in files)
            further = [further] if isinstance(further, str) else further if isinstance(further, list | tuple) else []
            takes_more = not further or isinstance(words[files[1]], list | tuple)
            kind = kind_of(Path(first)) if isinstance(first, str) else "result"
            if kind != "result" and any(kind_of(Path(file)) == "result" for file in further):
                raise InputError(f"{first}: stands where the result belongs; give the result first")
            if kind != "result" and (kind or not further) and takes_more and (result := ctx.lookup_default("result")):
                ctx.meta[RESULT_TAKEN] = [result]
                args = [result, *args]
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command. Raises InputError for nan, inf and "-", which typer accepts, and for a file of another kind."""
        for parameter in self.params:
            argument = ctx.params[parameter.name or ""]
            for value in argument if isinstance(argument, list | tuple) else (argument,):
                if isinstance(value, float) and not math.isfinite(value):
                    raise InputError(f"{parameter.opts[0]} must be a finite number, is {value}")
                if value in ("-", Path("-")) and parameter.type.name == "path":
                    option = parameter.opts[0] if parameter.opts[0].startswith("-") else ""
                    raise InputError(f"{option} - is not a file; give its path".lstrip())
                if parameter.name in TAKES and isinstance(value, str | Path):
                    _check_kind(parameter.name, value, self.params)
        project_words = [
            word
            for parameter in self.params
            if _source(ctx, parameter.name or "") == "DEFAULT_MAP" and ctx.params[parameter.name or ""] is not None
            for word in _words(parameter, ctx.params[parameter.name or ""])
        ]
        project_result = ctx.meta.get(RESULT_TAKEN, [])
        if project_result or project_words:
            typer.echo(f"from truearm.toml: {shlex.join([*project_result, *project_words])}", err=True)
            if ctx.obj is not None:  # the command line, as results and reports quote it
                ctx.obj.extend(project_words)
        return super().invoke(ctx)


def _check_kind(name: str, value: str | Path, parameters: Sequence[Any]) -> None:
    """Raise InputError if a file is recognised as another kind than the parameter ``name`` takes."""
    paths = (Path(value), Path(str(value).rpartition("=")[2]))  # of NAME=FILE
    path, kind = next(((path, kind) for path in paths if (kind := kind_of(path))), (paths[0], None))
    if kind is None or kind in TAKES[name]:
        return
    expected = " or ".join(KINDS[kind_name].description for kind_name in TAKES[name])
    instead = f"; give it as --{kind}" if any(f"--{kind}" in p.opts for p in parameters) and kind != name else ""
    raise InputError(f"{path}: is {KINDS[kind].description.partition(' (')[0]}, where {expected} is expected{instead}")


class CommandGroup(TyperGroup):
    """A group of commands that are listed by task, each with its whole first sentence, and suggested by meaning."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List the commands below the headings of their tasks."""
        shown: list[tuple[str, Any]] = [
            (name, command) for name, command in self.commands.items() if not command.hidden
        ]
        width = max(len(name) for name, _ in shown)
        for task in dict.fromkeys(command.rich_help_panel for _, command in shown):
            with formatter.section(task if isinstance(task, str) else "Commands"):
                formatter.write_dl(
                    (f"{name:<{width}}", command.get_short_help_str())
                    for name, command in shown
                    if command.rich_help_panel == task
                )

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command of ``args``. Raises a UsageError if another one is meant."""
        if args[0] not in self.commands and (meant := command_for(ctx.find_root().command, args[0])):
            ctx.fail(meant)
        return super().resolve_command(ctx, args)

    def get_short_help_str(self, limit: int = SUMMARY) -> str:
        """Return the whole first sentence of the help page; ``limit`` would cut it."""
        return super().get_short_help_str(max(limit, SUMMARY))


def command_group(name: str, text: str, epilog: str) -> typer.Typer:
    """Return an app without commands that prints its help if it is called without one."""
    app = typer.Typer(
        name=name, cls=CommandGroup, help=text, epilog=epilog, rich_markup_mode=None, add_completion=False
    )

    @app.callback(invoke_without_command=True)
    def print_help(context: typer.Context) -> None:
        if context.invoked_subcommand is None:
            typer.echo(context.get_help())

    return app


def typed(context: typer.Context, name: str) -> Any:
    """Return an option's value if it was typed, None if it is a default or from truearm.toml."""
    return context.params[name] if _source(context, name) == "COMMANDLINE" else None


def _source(context: typer.Context, name: str) -> str:
    source = context.get_parameter_source(name)
    return "" if source is None else source.name


def _words(option: Any, value: Any) -> Sequence[str]:
    """Return an option as words of a command line."""
    flag = [option.opts[0]] if option.opts[0].startswith("-") else []
    values = value if isinstance(value, list | tuple) else [value]
    return [word for item in values for word in (*flag, str(item))]


def defaults(folder: Path) -> dict[str, Any]:
    """Return the defaults from the project that contains ``folder``, by command and parameter; empty without a project.

    Raises InputError for an invalid truearm.toml.
    """
    project = project_of(folder)
    return {} if project is None else _answers(*project, folder)


def project_model(folder: Path) -> str:
    """Return the robot, or the path of its file, of the project that contains ``folder``; "" without a project."""
    project, home = project_of(folder) or (None, folder)
    model = project.model if project else ""
    return str(home / model) if model and (home / model).is_file() else model


def _answers(project: Project, home: Path, folder: Path) -> dict[str, Any]:
    def shown(path: Path) -> str:
        return os.path.relpath(path, folder)

    def there(name: str) -> Answer:
        return lambda: shown(home / name) if (home / name).exists() else None

    def text(value: str) -> Answer:
        return lambda: value or None

    def project_file(function: str, *arguments: Any) -> Answer:
        """Return what a function of ``workflows.project``, which is slow to import, finds or names: files or a file."""

        def answer() -> Any:
            from truearm.workflows import project as project_files

            files = getattr(project_files, function)(*arguments)
            return [shown(path) for path in files] or None if isinstance(files, list) else files and shown(files)

        return answer

    recordings, results = home / project.sessions, home / project.results
    sessions = project_file("sessions_of", recordings)
    newest_session: Answer = lambda: (sessions() or [None])[-1]  # noqa: E731
    newest_result, plan = project_file("result_in_use", results), project_file("new_plan", home / project.plan)
    inputs = (lambda: [shown(home / project.table)]) if project.table else sessions
    table_rig = (lambda: [shown(home / project.rig)]) if project.table else text("")  # a session has its own

    def model() -> str:
        return shown(home / project.model) if (home / project.model).is_file() else project.model

    robot: Mapping[str, Answer] = {"model": model, "base": text(project.base), "tip": text(project.tip)}
    rig = {"rig": there(project.rig)}

    branch = {"branch": text(project.branch)}
    planned = {"plan": there(project.plan), **rig}
    planning: Mapping[str, Answer] = {**robot, **branch, **rig, "out": plan}
    box: Mapping[str, Answer] = {"box": text(project.box)}
    gauging = {"gauge": {"operator": text(project.operator)}}
    result: Mapping[str, Answer] = {"result": newest_result, **robot}
    return {
        "demo": robot,
        "simulate": {**robot, **branch, **planned},
        "robot": {"read": {"address": text(project.address), "model": model}},
        "record": {
            **box,
            "address": text(project.address),
            "plan": there(project.plan),
            **rig,
            "out": project_file("new_file", recordings, ".mcap"),
        },
        "identify": {"inputs": inputs, "rig": table_rig, **robot, "out": project_file("new_file", results, ".json")},
        "report": {**result, "out": project_file("new_file", results, ".html")},
        "validate": result,
        "correct": result,
        "map": result,
        "export": result,
        "inspect": {"session": newest_session},
        "characterize": {"session": newest_session, **robot},
        "seats": {**robot, "table": there(project.table)},
        "session": {name: {"session": newest_session, **robot} for name in ("relabel", "export")},
        "plan": {"ballbar": planning, "line": planning, "characterize": planning},
        "box": {
            **{name: {**box, **gauging.get(name, {})} for name in BOX_COMMANDS},
            "config": {"get": box, "set": box},
        },
    }


def missing_file(parameter: str, command: str, folder: Path) -> str | None:
    """Return the message for a command without its argument ``parameter``, a result or sessions; None outside a project."""
    has_default = parameter in ("result", "inputs", "session") and (parameter, command) != (
        "inputs",
        "validate",
    )
    project_and_home = project_of(folder) if has_default else None
    if project_and_home is None:
        return None
    project, home = project_and_home
    is_result = parameter == "result"
    place = os.path.relpath(home / (project.results if is_result else project.sessions), folder)
    noun, source = ("result", "truearm identify") if is_result else ("session", "truearm record")
    return f"the folder {place} (truearm.toml) holds no {noun} yet; make one with {source}, or name the file of another"
