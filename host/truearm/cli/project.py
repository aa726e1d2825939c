"""Commands and groups of commands, whose options have defaults from the truearm.toml of the current project.

An earlier name of a command or option is refused with the new one, a wrong word with the command that it means.
"""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import click
from click.core import ParameterSource

from truearm.disk import KINDS, kind_of
from truearm.errors import InputError
from truearm.workflows.project_file import Project, project_of

ALIKE = 0.75  # of two names, by difflib: less is another word

# Earlier names are refused with a message that gives the new one. An option after a command is of that command.
EARLIER = {
    "recover": "session recover",
    "relabel": "session relabel",
    "add-joints": "session add-joints",
    "export-session": "session export",
    "--device": "--box",
    "--rig-file": "--rig",
    "--robot": "--model",
    "record --robot": "--address",
    "simulate --robot": "--protocol",
    "--allow-truncated": "--allow-damaged",
    "--allow": "--apply",
    "--save-table": "--table-out",
    "--seconds": "--sample-s",
    "--long-s": "--long-dwell-s",
    "--known-mm": "--measured-with",
}
# What people call the work of a command. Names of subcommands ("gauge") need no entry: the tree has them.
MEANINGS = {
    "identify": "calibrate calibration fit solve estimate optimize optimise",
    "correct": "compensate apply fix",
    "validate": "verify check judge evaluate",
    "record": "measure acquire capture log",
    "simulate": "rehearse sim",
    "init": "new create setup",
    "inspect": "show view",
    "seats": "sockets rests",
    "report": "certificate page",
    "demo": "try example",
    "box": "pico firmware sensor",
    "session recover": "repair mend",
    "session relabel": "label",
    "session add-joints": "joints import merge",
    "session export": "convert csv parquet tables",
}
EXPERT = "Expert options"
SUMMARY = 1000  # characters: a first sentence in the list of commands is wrapped, never cut
RESULT_TAKEN = "truearm.result"  # in a context: the project's result, set before the files that were typed
# kinds of file that a parameter takes (``disk.KINDS``)
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


def command_for(root: Any, word: str) -> str | None:
    """Return why there is no command ``word`` and which one is meant, None if nothing is known about it."""
    if word in EARLIER:
        return f"truearm {word} is now truearm {EARLIER[word]}"
    subcommands = [path for path, _ in _commands(root) if path.endswith(f" {word}")]
    meant = subcommands or [name for name, words in MEANINGS.items() if word.lower() in words.split()]
    commands = " or ".join(f"truearm {path}" for path in meant)
    return f"truearm has no command {word!r}; use {commands}" if meant else None


def option_for(command: Any, path: str, word: str) -> str:
    """Return why the command at ``path`` has no option ``word``, and which one like it is used instead."""
    options = [name for option in command.params for name in option.opts]
    if (new_name := EARLIER.get(f"{path} {word}", EARLIER.get(word))) in options:
        return f"{word} is now {new_name}"
    if word in ("--install-completion", "--show-completion"):
        return f"{word} is now: source <(_TRUEARM_COMPLETE=bash_source truearm)"
    if alike := get_close_matches(word, options, cutoff=ALIKE):
        return f"No such option: {word}; did you mean {' or '.join(alike)}?"
    return f"No such option: {word}"


def _commands(group: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every command below a group by its name, such as "box config get"."""
    for name, command in getattr(group, "commands", {}).items():
        yield f"{path} {name}".strip(), command
        yield from _commands(command, f"{path} {name}".strip())


class Parameter(NamedTuple):
    """An option or argument of the command line for ``argument`` of a function, or a field of one of its records.

    ``read`` makes the argument's value in SI of that of the command line.
    """

    argument: str
    declared: click.Parameter
    is_expert: bool
    read: Callable[[Any], Any]


class ProjectCommand(click.Command):
    """A command that prints on standard error what it took from truearm.toml and refuses numbers that are not finite.

    ``expert``: names of the options that its help page lists below a heading of their own. ``flags``: of arguments.
    """

    def __init__(self, name: str, callback: Callable[..., None], page: str, parameters: Sequence[Parameter]) -> None:
        declared = [parameter.declared for parameter in parameters]
        super().__init__(name, callback=callback, params=declared, help=page)
        self.expert = {parameter.declared.name for parameter in parameters if parameter.is_expert}
        self.flags = {parameter.argument: parameter.declared.opts[0] for parameter in parameters}

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List options below their headings."""
        for heading, is_expert in (("Options", False), (EXPERT, True)):
            listed = [option for option in self.get_params(ctx) if (option.name in self.expert) is is_expert]
            rows = [option.get_help_record(ctx) for option in listed if isinstance(option, click.Option)]
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(list(filter(None, rows)))

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line.

        Of a command that takes a result and further files, the project's result may be left out.
        """
        files = [parameter.name for parameter in self.params if not parameter.opts[0].startswith("-")]
        if files[:1] == ["result"] and len(files) == 2:
            words, *_ = self.make_parser(ctx).parse_args(list(args))
            first = words.get(files[0])
            further = [file for file in _values(words.get(files[1])) if isinstance(file, str)]  # else none was typed
            takes_more = not further or isinstance(words[files[1]], list | tuple)
            kind = kind_of(Path(first)) if isinstance(first, str) else "result"
            if kind != "result" and any(kind_of(Path(file)) == "result" for file in further):
                raise InputError(f"{first}: stands where the result belongs; give the result first")
            if kind != "result" and (kind or not further) and takes_more and (result := ctx.lookup_default("result")):
                ctx.meta[RESULT_TAKEN] = [result]
                args = [result, *args]
        further_words = super().parse_args(ctx, args)
        for parameter in self.params:  # a project may have no such file
            if parameter.required and ctx.params[parameter.name] in (None, ()) and not ctx.resilient_parsing:
                raise click.MissingParameter(ctx=ctx, param=parameter)
        return further_words

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command.

        Raises InputError for nan, inf and "-", which click accepts, and for a file of another kind.
        """
        for parameter in self.params:
            for value in _values(ctx.params[parameter.name]):
                if isinstance(value, float) and not math.isfinite(value):
                    raise InputError(f"{parameter.opts[0]} must be a finite number, is {value}")
                if value in ("-", Path("-")) and parameter.type.name == "path":
                    option = parameter.opts[0] if parameter.opts[0].startswith("-") else ""
                    raise InputError("unreadable-file", place=f"{option} -".lstrip())
                if parameter.name in TAKES and isinstance(value, str | Path):
                    _check_kind(parameter.name, value, self.params)
        project_words = [
            word
            for parameter in self.params
            if ctx.get_parameter_source(parameter.name) is ParameterSource.DEFAULT_MAP
            for value in _values(ctx.params[parameter.name])
            for word in (*(flag for flag in parameter.opts[:1] if flag.startswith("-")), str(value))
        ]
        project_result = ctx.meta.get(RESULT_TAKEN, [])
        if project_result or project_words:
            click.echo(f"from truearm.toml: {shlex.join([*project_result, *project_words])}", err=True)
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


class CommandGroup(click.Group):
    """Commands, each listed with its whole first sentence and suggested by meaning; alone, it prints its help."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in their order."""
        return list(self.commands)

    def summaries(self) -> Mapping[str, Mapping[str, str]]:
        """Return the commands below headings, with their first sentences."""
        return {"Commands": {name: command.get_short_help_str(SUMMARY) for name, command in self.commands.items()}}

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands below headings."""
        headings = self.summaries()
        width = max(len(name) for summaries in headings.values() for name in summaries)
        for heading, summaries in headings.items():
            with formatter.section(heading):
                formatter.write_dl([(f"{name:<{width}}", text) for name, text in summaries.items()])

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line."""
        return super().parse_args(ctx, args or ["--help"])

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """Return the command of ``args``. Raises a UsageError if another one is meant."""
        if args[0] not in self.commands and (meant := command_for(ctx.find_root().command, args[0])):
            ctx.fail(meant)
        return super().resolve_command(ctx, args)


def typed(context: click.Context, name: str) -> Any:
    """Return an option's value if it was typed, None if it is a default or from truearm.toml."""
    return context.params[name] if context.get_parameter_source(name) is ParameterSource.COMMANDLINE else None


def _values(value: Any) -> Sequence[Any]:
    """Return the values of a parameter: several, one, or none."""
    return value if isinstance(value, list | tuple) else () if value is None else (value,)


ROBOT = "model base tip"
# parameters that a command takes from truearm.toml
DEFAULTS = {
    "demo": ROBOT,
    "simulate": f"{ROBOT} branch plan rig",
    "robot read": "address model",
    "record": "box address plan rig out",
    "identify": f"inputs rig {ROBOT} out",
    "report": f"result {ROBOT} out",
    **dict.fromkeys(("validate", "correct", "map", "export"), f"result {ROBOT}"),
    "inspect": "session",
    **dict.fromkeys(("characterize", "session relabel", "session export"), f"session {ROBOT}"),
    "seats": f"{ROBOT} table",
    **dict.fromkeys(("plan ballbar", "plan line", "plan characterize"), f"{ROBOT} branch rig out"),
    **dict.fromkeys((f"box {name}" for name in ("test", "monitor", "info", "flash", "reset")), "box"),
    "box gauge": "box operator",
    **dict.fromkeys(("box config get", "box config set"), "box"),
}


def defaults(folder: Path) -> dict[str, Any]:
    """Return the defaults from the project that contains ``folder``, by command and parameter; empty without a project.

    Raises InputError for an invalid truearm.toml.
    """
    tree: dict[str, Any] = {}
    project, home = project_of(folder) or (None, folder)
    if project is None:
        return tree
    answers = _answers(project, home, folder)
    for command, names in DEFAULTS.items():
        branch = tree
        for word in command.split():
            branch = branch.setdefault(word, {})
        branch |= {name: answers.get(f"{command.split()[0]} {name}") or answers[name] for name in names.split()}
    return tree


def project_model(folder: Path) -> str:
    """Return the robot, or the path of its file, of the project that contains ``folder``; "" without a project."""
    project, home = project_of(folder) or (None, folder)
    model = project.model if project else ""
    return str(home / model) if model and (home / model).is_file() else model


def _answers(project: Project, home: Path, folder: Path) -> dict[str, Answer]:
    """Return the values of parameters by name, or by command and name."""

    from truearm.workflows import project as project_files

    def shown(path: Path | None) -> str | None:
        return None if path is None else os.path.relpath(path, folder)

    def existing(name: str) -> Answer:
        return lambda: shown(home / name) if (home / name).exists() else None

    def text(value: str) -> Answer:
        return lambda: value or None

    def sessions() -> list[str | None]:
        return [shown(path) for path in project_files.sessions_of(recordings)]

    recordings, results = home / project.sessions, home / project.results
    model = home / project.model
    return {
        "model": text(os.path.relpath(model, folder) if model.is_file() else project.model),
        **{name: text(getattr(project, name)) for name in ("base", "tip", "branch", "address", "box", "operator")},
        **{name: existing(getattr(project, name)) for name in ("plan", "rig", "table")},
        "session": lambda: (sessions() or [None])[-1],
        "inputs": (lambda: [shown(home / project.table)]) if project.table else lambda: sessions() or None,
        "identify rig": lambda: [shown(home / project.rig)] if project.table else None,  # a session has its own
        "result": lambda: shown(project_files.result_in_use(results)),
        "record out": lambda: shown(project_files.new_file(recordings, ".mcap")),
        "identify out": lambda: shown(project_files.new_file(results, ".json")),
        "report out": lambda: shown(project_files.new_file(results, ".html")),
        "plan out": lambda: shown(project_files.unused(home / project.plan)),
    }


def missing_file(parameter: str, command: str, folder: Path) -> str | None:
    """Return the message for a command without its argument ``parameter``, a result or sessions.

    None outside a project.
    """
    has_default = parameter in ("result", "inputs", "session") and (parameter, command) != ("inputs", "validate")
    project, home = (project_of(folder) if has_default else None) or (None, folder)
    if project is None:
        return None
    is_result = parameter == "result"
    noun, source = ("result", "truearm identify") if is_result else ("session", "truearm record")
    place = os.path.relpath(home / (project.results if is_result else project.sessions), folder)
    return f"the folder {place} (truearm.toml) holds no {noun} yet; make one with {source}, or name the file of another"
