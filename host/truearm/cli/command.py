"""Declare a command: its signature has the types, bounds and defaults of its options, its docstring describes them.

The descriptions of arguments and options stand at the end of the docstring, below the headings of the help page. A
function takes SI: if the name of an option ends in a unit, such as ``--dwell-s``, the argument's name does not::

    @command()
    def pause(axis: str, *, dwell: Annotated[float, DWELL] = 2.0, force: bool = False) -> None:
        \"""Wait at rest.

        Arguments
        ---------
        axis : AXIS
            Axis that rests.

        Options
        -------
        dwell_s : S
            Duration of the rest.
        force
        \"""

A record, such as those of ``workflows/requests.py``, stands for its fields that are described, by the command or in the
record's own docstring.

What the command does not describe, such as ``force``, is described in ``cli/options.py``; a name without a text only
moves below another heading. A command that returns an ``Answer`` gets ``--json``, and ``--details`` if it describes it.
"""

from __future__ import annotations

import builtins
import inspect
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import click

from truearm import units
from truearm.bounds import OneOf, Within
from truearm.cli import options
from truearm.cli.output import DETAILS, print_json, print_lines, show
from truearm.cli.project import EXPERT, CommandGroup, Parameter, ProjectCommand
from truearm.errors import ExitCode, TruearmError
from truearm.findings import Finding, findings_of
from truearm.model.robot_file import builtin_names

if TYPE_CHECKING:
    from truearm.report.tables import Table

R = TypeVar("R")
ARGUMENTS, EMPTY = "Arguments", inspect.Parameter.empty
HEADING = re.compile(rf"^({ARGUMENTS}|Options|{EXPERT})\n-+\n", re.MULTILINE)
ENTRY = re.compile(r"^(\w[\w, ]*)(?: : (.+))?\n((?: {4}.*\n)*)", re.MULTILINE)
EXAMPLE = re.compile(r"^(?=Examples?:\n)", re.MULTILINE)  # whose lines the help page must not join
# options of arguments with other names
OPTIONS = {"robot": "model", "bars": "bar", "tools": "tool", "works": "work", "joints": "vary", "lengths": "bars_mm"}
SCALES = {scale.suffix: scale for scale in vars(units).values() if isinstance(scale, units.Scale) and scale.suffix}


class Entry(NamedTuple):
    """What a docstring says of an argument or an option."""

    heading: str = ""
    metavar: str = ""
    text: str = ""

    def completed(self, shared: Entry) -> Entry:
        """Return it with what it lacks from the shared one."""
        return Entry(*(field or default for field, default in zip(self, shared, strict=True)))


def described(docstring: str | None, texts: Mapping[str, str]) -> tuple[str, dict[tuple[bool, str], Entry]]:
    """Return the text of a docstring above its first heading, and its entries by whether they are options, and name."""
    page, *sections = HEADING.split(f"{inspect.cleandoc(docstring or '')}\n")
    entries = {
        (heading != ARGUMENTS, name): Entry(heading, metavar, re.sub(r"\{(\w+)\}", lambda word: texts[word[1]], text))
        for heading, section in zip(sections[::2], sections[1::2], strict=True)
        for names, metavar, lines in ENTRY.findall(section)
        for text in (" ".join(lines.split()),)
        for name in names.split(", ")
    }
    return page, entries


SHARED = described(options.__doc__, options.TEXTS)[1]


@dataclass(frozen=True)
class Answer:
    """What a command answers: the ``document`` of ``--json``, and what is printed without it.

    These are ``lines`` (with ``--details``: the ``tables``), or findings with the ``tables`` of ``--details`` and the
    files that were ``written``; findings and files are the document's by default. ``details_hint`` says how to get the
    rest; without it, no finding is cut. ``end`` is the exit code, or the error that is raised after printing.
    """

    document: Any
    lines: Iterable[str] | None = None
    findings: Sequence[Finding] | None = None
    tables: Iterable[Table | str] = ()
    written: Iterable[Path | str | None] | None = None
    details_hint: str | None = None
    end: ExitCode | TruearmError = ExitCode.DONE

    def show(self, as_json: bool, details: bool | None) -> None:
        """Print it; ``details`` is None for a command that has none."""
        if as_json:
            print_json(self.document)
        elif self.lines is not None:
            print_lines(map(str, self.tables) if details else self.lines)
        else:
            usual = "" if details is None else DETAILS
            hint = usual if self.details_hint is None else self.details_hint
            findings = findings_of(self.document) if self.findings is None else self.findings
            written = self.document.get("written", ()) if self.written is None else self.written
            show(findings, self.tables, written, hint, bool(details))
        if isinstance(self.end, TruearmError):
            raise self.end
        if self.end is not ExitCode.DONE:
            raise click.exceptions.Exit(self.end)


def command(
    group: CommandGroup | None = None,
    title: str | None = None,
    cls: type[ProjectCommand] = ProjectCommand,
    **texts: str,
) -> Callable[[Callable[..., Any]], ProjectCommand]:
    """Return a decorator that makes a command of a function, in a group.

    ``{name}`` in a description stands for a text.
    """

    def declare(function: Callable[..., Any]) -> ProjectCommand:
        hints = hints_of(function)
        page, entries = described(function.__doc__, {**options.TEXTS, **texts})
        for record in filter(is_record, hints.values()):
            entries = described(record.__doc__, {**options.TEXTS, **texts})[1] | entries
        answers = hints.pop("return", None) is Answer
        documented = SHARED | {key: entry.completed(SHARED.get(key, Entry())) for key, entry in entries.items()}
        parameters = list(_parameters(function, hints, documented))
        switches = [name for name in ("details", "json") if answers and (name == "json" or (True, name) in entries)]
        for name in switches:
            if name not in hints:
                parameters.append(_parameter(name, name, bool, False, True, documented[True, name]))
        declared = {parameter.declared.name: parameter for parameter in parameters}
        if unused := {name for _, name in entries} - declared.keys():
            raise TypeError(f"{function.__name__}() has no parameter {unused}")

        def run(**typed: Any) -> None:
            parsed = {name: value for name, value in typed.items() if value is not None and value != ()}
            values = {declared[name].argument: declared[name].read(value) for name, value in parsed.items()}
            values["context"] = click.get_current_context()
            records = {name: fill(hint, values) for name, hint in hints.items() if is_record(hint)}
            answer = function(
                **{name: values[name] for name in hints.keys() & values.keys() - records.keys()}, **records
            )
            if answers:
                answer.show(typed["json"], typed.get("details"))

        new_command = cls(title or function.__name__, run, EXAMPLE.sub("\b\n", page), parameters)
        if group is not None:
            group.add_command(new_command)
        return new_command

    return declare


def is_record(hint: Any) -> bool:
    """Return whether a type is a dataclass or a named tuple."""
    return is_dataclass(hint) or hasattr(hint, "_fields")


def _parameters(
    function: Callable[..., Any],
    hints: Mapping[str, Any],
    documented: Mapping[tuple[bool, str], Entry],
    usual: Any = EMPTY,
) -> Iterator[Parameter]:
    """Yield the described arguments of a function, or fields of a record, whose defaults are those of ``usual``.

    Without ``usual``, the record's are used, and a named tuple needs its first field. An argument is described under
    its name, that of ``OPTIONS``, or either with a unit. One that is described both as option and as argument of the
    command is the latter if it has no default.
    """
    has_defaults = usual is not EMPTY
    names = {stem_of(name): name for _, name in documented} | {name: name for _, name in documented}
    for position, (argument, parameter) in enumerate(inspect.signature(function).parameters.items()):
        hint, default = hints[argument], getattr(usual, argument) if has_defaults else parameter.default
        if is_record(hint):
            yield from _parameters(hint, hints_of(hint), documented, default)
        elif name := names.get(OPTIONS.get(argument, ""), names.get(argument, "")):
            default = EMPTY if hasattr(function, "_fields") and not (has_defaults or position) else default
            is_option = (True, name) in documented and not ((False, name) in documented and default is EMPTY)
            yield _parameter(argument, name, hint, default, is_option, documented[is_option, name])


def hints_of(record: Any) -> dict[str, Any]:
    """Return the types of arguments or of a record's fields; one that is known to type checkers alone is an object."""

    class Names(dict[str, Any]):
        def __missing__(self, name: str) -> Any:
            return vars(sys.modules[record.__module__]).get(name, getattr(builtins, name, object))

    return get_type_hints(record, localns=Names(), include_extras=True)


def _parameter(argument: str, name: str, hint: Any, default: Any, is_option: bool, entry: Entry) -> Parameter:
    """Return a parameter ``name``; ``default``, in SI, is EMPTY if it is required."""
    kind, rules = (hint.__origin__, hint.__metadata__) if hasattr(hint, "__metadata__") else (hint, ())
    kind = get_args(kind)[0] if type(None) in get_args(kind) else kind
    has_several, of_text = get_origin(kind) is tuple, None if kind is str else options.READERS.get(argument)
    scale = SCALES.get(name.removeprefix(f"{argument}_"), units.ONE)
    reader: Callable[[Any], Any] | None = None
    if of_text is not None:
        reader = partial(of_text.read, f"--{name.replace('_', '-')}")
        kind, has_several, scale = str, of_text.named, units.ONE
        default = default if isinstance(default, str) else None
    elif has_several:
        kind = get_args(kind)[0]
    if scale.factor != 1.0:
        reader = scale.to_si
        default = scale.of(default) if isinstance(default, float) else default
    value_type, metavar = _type(kind, rules, scale), entry.metavar
    if isinstance(value_type, click.Choice):
        metavar = metavar or f"<{'|'.join(value_type.choices)}>"
        reader = None if kind is str else kind
    words = {"type": value_type, "required": default is EMPTY, "help": entry.text}
    if default is not EMPTY:
        words["default"] = str(default) if isinstance(default, StrEnum) else default
    if is_option:
        flags = {"is_flag": kind is bool or None, "multiple": has_several, "show_default": default != ""}
        complete = _completed if name == "model" else None
        declared: click.Parameter = click.Option(
            [name, f"--{name.replace('_', '-')}"], metavar=metavar, shell_complete=complete, **flags, **words
        )
    else:
        metavar = metavar if default is EMPTY else f"[{metavar}]"
        declared = click.Argument([name], nargs=-1 if has_several else 1, metavar=metavar, **words)
    return Parameter(argument, declared, entry.heading == EXPERT, reader or (lambda value: value))


def _type(kind: Any, rules: Sequence[Any], scale: units.Scale) -> Any:
    """Return the type of the values of an option or argument in a unit, as click checks and converts them."""
    for rule in rules:
        if isinstance(rule, Within):
            ends: Iterator[Any] = (end if scale.factor == 1.0 else scale.of(end) for end in (rule.least, rule.most))
            low, high = (None if math.isinf(end) else end for end in ends)
            return click.IntRange(low, high) if kind is int else click.FloatRange(low, high)
        if isinstance(rule, OneOf):
            return click.Choice([str(name) for name in rule.names])
    if issubclass(kind, StrEnum):
        return click.Choice([str(name) for name in kind])
    return click.Path(path_type=Path) if kind is Path else kind


def _completed(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[Any]:
    """Return the built-in robots whose names begin as a partly typed option value."""
    return [name for name in builtin_names() if name.startswith(incomplete)]


def fill(kind: Callable[..., R], values: Mapping[str, Any]) -> R:
    """Return a record of the values of its fields, and of those of records in it."""
    hints = hints_of(kind)
    records = {name: fill(hint, values) for name, hint in hints.items() if is_record(hint)}
    return kind(**{name: values[name] for name in hints.keys() & values.keys()} | records)


def stem_of(name: str) -> str:
    """Return the name of a parameter without its unit: "dwell" of "dwell_s"."""
    units_of_name = (unit for unit in sorted(SCALES, key=len, reverse=True) if name.endswith(f"_{unit}"))
    return name.removesuffix(f"_{next(units_of_name, '')}")
