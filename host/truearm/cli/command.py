"""Declare a command: its signature has the types, bounds and defaults of its options, its docstring describes them.

Parameters before ``*`` are arguments, those after it options: ``dwell_s`` is ``--dwell-s``. Their descriptions stand at
the end of the docstring, below the headings of the help page::

    def pause(axis: str, *, dwell_s: Annotated[float, DWELL] = 2.0, force: bool = False) -> None:
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

A record, such as those of ``workflows/requests.py``, stands for its fields that are described. A field is in SI: the
name of its option has the unit.

What the command does not describe, such as ``force``, is described in ``cli/options.py``; a name without a text only
moves below another heading. A command that returns an ``Answer`` gets ``--json``, and ``--details`` if it describes it.
"""

from __future__ import annotations

import builtins
import inspect
import math
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar, cast, get_args, get_origin, get_type_hints

import typer

from truearm import units
from truearm.bounds import OneOf, Within
from truearm.cli import options
from truearm.cli.output import print_json, print_lines
from truearm.errors import TruearmError
from truearm.exit_codes import ExitCode
from truearm.findings import Finding, findings_of
from truearm.model.builtin import builtin_names

if TYPE_CHECKING:
    from truearm.report.tables import Table

R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])
ARGUMENTS, EXPERT = "Arguments", "Expert options"
HEADING = re.compile(rf"^({ARGUMENTS}|Options|{EXPERT})\n-+\n", re.MULTILINE)
ENTRY = re.compile(r"^(\w[\w, ]*)(?: : (.+))?\n((?: {4}.*\n)*)", re.MULTILINE)
EXAMPLE = re.compile(r"^(?=Examples?:\n)", re.MULTILINE)  # whose lines the help page must not join
OPTIONS = {
    "robot": "model",
    "bars": "bar",
    "tools": "tool",
    "works": "work",
    "as_json": "json",
    "joints": "vary",
}  # of fields and of arguments in errors
FIELDS = {option: field for field, option in OPTIONS.items()}
SCALES = {scale.suffix: scale for scale in vars(units).values() if isinstance(scale, units.Scale) and scale.suffix}


class Entry(NamedTuple):
    """What a docstring says of an argument or an option."""

    heading: str = ""
    metavar: str = ""
    text: str = ""


def described(docstring: str | None, texts: Mapping[str, str]) -> tuple[str, dict[tuple[bool, str], Entry]]:
    """Return the text of a docstring above its first heading, and its entries by whether they are options and by name."""
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

    These are ``lines``, or findings, the document's by default, with the ``tables`` of ``--details`` and the files that were ``written``.
    ``more`` says how to get the rest. ``end`` is the exit code, or the error that is raised after printing.
    """

    document: Any
    lines: Iterable[str] | None = None
    findings: Sequence[Finding] | None = None
    tables: Iterable[Table | str] = ()
    written: Iterable[Path | None] = ()
    more: str | None = None
    end: ExitCode | TruearmError = ExitCode.DONE

    def show(self, as_json: bool, details: bool | None) -> None:
        """Print it; ``details`` is None for a command that has none."""
        from truearm.cli.findings_text import show

        if as_json:
            print_json(self.document)
        elif self.lines is not None:
            print_lines(self.lines)
        else:
            usual = "" if details is None else "All notes and tables: --details"
            more = usual if self.more is None else self.more
            findings = findings_of(self.document) if self.findings is None else self.findings
            show(findings, self.tables if details else None, self.written, more)
        if isinstance(self.end, TruearmError):
            raise self.end
        if self.end is not ExitCode.DONE:
            raise typer.Exit(self.end)


def command(**texts: str) -> Callable[[F], F]:
    """Return a decorator that declares a function's options for typer; ``{name}`` in a description stands for a text.

    A parameter whose type is a record stands for those of its fields that have a description. The function gets the record.
    """

    def declare(function: F) -> F:
        page, entries = described(function.__doc__, {**options.TEXTS, **texts})
        described_names = {**SHARED, **entries}
        hints = get_type_hints(function, include_extras=True)
        answers = hints.pop("return", None) is Answer
        keyword, declared = inspect.Parameter.KEYWORD_ONLY, dict(inspect.signature(function).parameters)
        switches = [name for name in ("details", "json") if answers and (name == "json" or (True, name) in entries)]
        for name in switches:
            declared.setdefault(name, inspect.Parameter(name, keyword, default=False))
        parameters: list[inspect.Parameter] = []
        for name, parameter in declared.items():
            is_option, kind = parameter.kind is keyword, hints.get(name, bool)
            field = [(name, kind, parameter.default, is_option)]
            fields = _fields(kind, described_names, parameter.default) if is_record(kind) else field
            for option, hint, default, is_option in fields:
                shared, command_entry = (table.pop((is_option, option), Entry()) for table in (dict(SHARED), entries))
                entry = Entry(*(field or theirs for field, theirs in zip(command_entry, shared, strict=True)))
                hint = hint if hint is typer.Context else _declared(option, hint, is_option, entry)
                parameters.append(parameter.replace(name=option, annotation=hint, default=default))
        if entries:
            raise TypeError(f"{function.__name__}() has no parameter {[name for _, name in entries]}")

        def run(**arguments: Any) -> Any:
            records = {name: fill(hint, arguments) for name, hint in hints.items() if is_record(hint)}
            answer = function(**{name: value for name, value in arguments.items() if name in hints}, **records)
            if answers:
                answer.show(arguments["json"], arguments.get("details"))
            return answer

        run.__name__, run.__doc__ = function.__name__, EXAMPLE.sub("\b\n", page)
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        run.__signature__ = inspect.Signature([parameter.replace(kind=keyword) for parameter in parameters])  # type: ignore[attr-defined]
        return cast(F, run)

    return declare


def is_record(hint: Any) -> bool:
    """Return whether a type is a dataclass or a named tuple."""
    return is_dataclass(hint) or hasattr(hint, "_fields")


def _fields(record: Any, documented: Collection[tuple[bool, str]], usual: Any) -> Iterator[tuple[str, Any, Any, bool]]:
    """Yield name, type, default and whether it is an option of each described field, in the unit of the option.

    ``usual`` has the defaults. Without it, the record's are used, and a named tuple needs its first field.
    """
    has_defaults = usual is not inspect.Parameter.empty
    names = {stem_of(name): name for _, name in documented} | {name: name for _, name in documented}
    hints = hints_of(record)
    for position, (field, parameter) in enumerate(inspect.signature(record).parameters.items()):
        hint, default = hints[field], getattr(usual, field) if has_defaults else parameter.default
        if is_record(hint):
            yield from _fields(hint, documented, default)
        elif (name := names.get(OPTIONS.get(field, field))) is not None:
            is_needed = default is parameter.empty or not (has_defaults or position or is_dataclass(record))
            is_option = (True, name) in documented and not ((False, name) in documented and is_needed)
            if field in options.READERS:
                hint = list[str] | None if field in options.REPEATED else str | None
            elif get_origin(hint) is tuple:
                hint, default = list[get_args(hint)[0]] | None, default or None  # type: ignore[misc]
            scale = units.ONE if name in (field, OPTIONS.get(field)) else SCALES[name.removeprefix(f"{field}_")]
            scale = units.ONE if scale.factor == 1.0 else scale
            hint = hint if scale is units.ONE else Annotated[hint, scale]
            if field in options.READERS:
                default = None
            elif scale is not units.ONE and default is not None:
                default = scale.of(default)
            yield name, hint, parameter.empty if is_needed else default, is_option


def hints_of(record: Any) -> dict[str, Any]:
    """Return the types of a record's fields; one that is known to type checkers alone is given as a text."""

    class Names(dict[str, Any]):
        def __missing__(self, name: str) -> Any:
            return vars(sys.modules[record.__module__]).get(name, getattr(builtins, name, str))

    return get_type_hints(record, localns=Names(), include_extras=True)


def _declared(name: str, hint: Any, is_option: bool, entry: Entry) -> Any:
    """Return the annotation of a parameter as typer reads it."""
    kind, rules = (hint.__origin__, hint.__metadata__) if hasattr(hint, "__metadata__") else (hint, ())
    info: Any = typer.Option(f"--{name.replace('_', '-')}") if is_option else typer.Argument()
    info.metavar, info.help = entry.metavar or None, entry.text or None
    info.rich_help_panel = entry.heading if entry.heading == EXPERT else None
    if name == "model":
        info.autocompletion = completed(builtin_names())
    scale = next((rule for rule in rules if isinstance(rule, units.Scale)), units.ONE)
    for rule in rules:
        if isinstance(rule, Within):
            info.min, info.max = (_bound(end, scale) for end in (rule.least, rule.most))
        elif isinstance(rule, OneOf):
            info.metavar = f"<{'|'.join(rule.names)}>"
            choice = StrEnum("Choice", {name: name for name in rule.names})  # type: ignore[misc]
            kind = choice | None if type(None) in get_args(kind) else choice
    return Annotated[kind, info]


def _bound(end: float, scale: units.Scale) -> float | None:
    """Return an end of a range in the unit of the option, None if it is infinite; whole numbers remain whole."""
    return None if math.isinf(end) else end if scale is units.ONE else scale.of(end)


def completed(names: Collection[str]) -> Callable[[str], list[str]]:
    """Return a function that completes a partly typed option value from ``names``."""
    return lambda incomplete: [name for name in names if name.startswith(incomplete)]  # typer requires this name


def fill(kind: Callable[..., R], arguments: Mapping[str, Any], **values: Any) -> R:
    """Return a record of options in SI, from ``values`` and a command's parameters by the names of its fields.

    A parameter's name may end in its unit: ``dwell_s`` gives ``dwell``. None leaves the field's default. A field that is
    a record is filled in the same way.
    """
    fields, hints = inspect.signature(kind).parameters, hints_of(kind)
    for name, value in arguments.items():
        field = next((field_name for field_name in (name, FIELDS.get(name), stem_of(name)) if field_name in fields), "")
        if value is not None and field and field not in values and (field == name or not is_record(hints[field])):
            if isinstance(value, str | list) and field in options.READERS:
                value = options.READERS[field](value)
            elif isinstance(value, list):
                value = tuple(value)
            elif field not in (name, FIELDS.get(name)):
                value = SCALES[name.removeprefix(f"{field}_")].to_si(value)
            values[field] = value
    for name in fields:
        if name not in values and is_record(hints[name]):
            values[name] = fill(hints[name], arguments)
    return kind(**values)


def stem_of(name: str) -> str:
    """Return the name of a parameter without its unit: "dwell" of "dwell_s"."""
    return next(
        (name.removesuffix(f"_{unit}") for unit in sorted(SCALES, key=len, reverse=True) if name.endswith(f"_{unit}")),
        name,
    )
