"""Declare a command: its signature has the types, bounds and defaults of its options, its docstring describes them.

Parameters before ``*`` are arguments, those after it are options: ``dwell_s`` is ``--dwell-s``. Their descriptions stand
at the end of the docstring, in the form of NumPy's, below the headings of the help page::

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

What the command does not describe, such as ``force``, is described in ``cli/options.py``; a name without a text only
moves it below another heading.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Collection, Mapping
from typing import Annotated, Any, NamedTuple, TypeVar, get_type_hints

import typer

from truearm import units
from truearm.bounds import OneOf, Within
from truearm.cli import options
from truearm.model.builtin import builtin_names

R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])
ARGUMENTS, EXPERT = "Arguments", "Expert options"
HEADING = re.compile(rf"^({ARGUMENTS}|Options|{EXPERT})\n-+\n", re.MULTILINE)
ENTRY = re.compile(r"^(\w[\w, ]*)(?: : (.+))?\n((?: {4}.*\n)*)", re.MULTILINE)
EXAMPLE = re.compile(r"^(?=Examples?:\n)", re.MULTILINE)  # whose lines the help page must not join
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


def command(**texts: str) -> Callable[[F], F]:
    """Return a decorator that declares a function's options for typer; ``{name}`` in a description stands for a text."""

    def declare(function: F) -> F:
        page, entries = described(function.__doc__, {**options.TEXTS, **texts})
        hints = get_type_hints(function, include_extras=True)
        for name, parameter in inspect.signature(function).parameters.items():
            if hints[name] is not typer.Context:
                is_option = parameter.kind is inspect.Parameter.KEYWORD_ONLY
                shared = SHARED.get((is_option, name), Entry())
                own = entries.pop((is_option, name), Entry())
                entry = Entry(*(mine or theirs for mine, theirs in zip(own, shared, strict=True)))
                function.__annotations__[name] = _declared(name, hints[name], is_option, entry)
        if entries:
            raise TypeError(f"{function.__name__}() has no parameter {[name for _, name in entries]}")
        function.__doc__ = EXAMPLE.sub("\b\n", page)
        return function

    return declare


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
            info.callback, info.autocompletion = one_of(rule.names), completed(rule.names)
    return Annotated[kind, info]


def _bound(end: float, scale: units.Scale) -> float | None:
    """Return an end of a range in the unit of the option, None if it is infinite; whole numbers remain whole."""
    return None if math.isinf(end) else end if scale is units.ONE else scale.of(end)


def completed(names: Collection[str]) -> Callable[[str], list[str]]:
    """Return a function that completes a partly typed option value from ``names``."""
    return lambda incomplete: [
        name for name in names if name.startswith(incomplete)
    ]  # typer requires this argument name


def one_of(names: Collection[str]) -> Callable[[str | None], str | None]:
    """Return a function that checks an option against ``names``. It raises typer.BadParameter for another name."""

    def checked(text: str | None) -> str | None:
        if text is not None and text not in names:
            raise typer.BadParameter(f"{text!r} is not one of {', '.join(names)}")
        return text

    return checked


def fill(kind: Callable[..., R], given: Mapping[str, Any], **values: Any) -> R:
    """Return a record of options in SI, from ``values`` and a command's parameters by the names of its fields.

    A parameter's name may end in its unit: ``dwell_s`` gives ``dwell``. None leaves the field's default.
    """
    fields = inspect.signature(kind).parameters
    for name, value in given.items():
        field = name if name in fields else stem_of(name)
        if value is not None and field in fields and field not in values:
            scale = units.ONE if field == name else SCALES[name.removeprefix(f"{field}_")]
            values[field] = (
                tuple(value) if isinstance(value, list) else scale.to_si(value) if scale is not units.ONE else value
            )
    return kind(
        **{name: values.get(name) for name, field in fields.items() if name in values or field.default is field.empty}
    )


def stem_of(name: str) -> str:
    """Return the name of a parameter without its unit: "dwell" of "dwell_s"."""
    return next(
        (name.removesuffix(f"_{unit}") for unit in sorted(SCALES, key=len, reverse=True) if name.endswith(f"_{unit}")),
        name,
    )
