"""What truearm states about data: a short code with values. Screen, page, JSON and Python are readers of these.

``truearm.finding_texts`` has the severity, the sentence and the remedy of every code. To add a finding, add an entry
there, and return ``Finding(code, values)`` where its cause is seen.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from string import Formatter
from typing import Any

from truearm.finding_texts import REASONS, STATEMENTS, Severity, Statement
from truearm.text import counted, listed, one_line
from truearm.units import SUFFIXES, UNITS

_OPTIONAL = re.compile(r"\[([^\[\]]*)\]")
_NAME = re.compile(r"\{(\w+)")
MOST = 12  # texts of a list, unless a template says otherwise
_ABSENT: tuple[Any, ...] = (None, "", (), [], {}, False)


class Argument(str):
    """The name of an argument in an error: Python shows it, the command line shows the option instead."""

    __slots__ = ()


def option(argument: str) -> str:
    """Return the name that the command line has for an argument: on screen and pages."""
    return f"--{argument.replace('_', '-')}"


@dataclass(frozen=True)
class Finding:
    """A statement by its code, such as "shared-use", with the values that its text needs.

    Values are numbers, texts, lists of texts, and quantities: {"mm": 0.42}, with one number for each unit.

    Examples
    --------
    >>> import truearm
    >>> verdict = truearm.read_result("result.json").findings[0]
    >>> verdict.code, verdict.severity.value, verdict.text()[:7]
    ('usable', 'result', 'Usable:')
    """

    code: str
    values: Mapping[str, Any] = field(default_factory=dict)

    @property
    def statement(self) -> Statement:
        """The entry of the code."""
        return STATEMENTS[self.code]

    @property
    def severity(self) -> Severity:
        return self.statement.severity

    def text(self, argument: Callable[[str], str] = str) -> str:
        """Return the sentence and the remedy; ``argument`` is the format of arguments of truearm."""
        _, *templates = self.statement
        sentence, remedy = (worded(template, self.values, argument) for template in templates)
        return f"{sentence}{' ' if sentence.endswith('.') else '; '}{remedy}" if remedy else sentence

    def entry(self) -> dict[str, Any]:
        """Return the finding as JSON."""
        return {"code": self.code, "severity": self.severity.value, "text": self.text(), "values": dict(self.values)}


def stated(code: str, *sources: Mapping[str, Any], **values: Any) -> Finding:
    """Return a finding with the ``values``, and those of ``sources`` (the first has precedence) that its text names.

    Numbers with a unit become a quantity: "rms_mm" and "rms_deg" are {"mm": …, "deg": …} under the name "rms".
    """
    names = [name for name in dict.fromkeys(_NAME.findall(" ".join(STATEMENTS[code][1:]))) if name not in values]
    for source in reversed(sources):
        values |= {name: source[name] for name in names if name in source}
        for key, value in source.items():
            name, _, suffix = key.rpartition("_")
            if name in names and name not in source and suffix in SUFFIXES and isinstance(value, float | int | None):
                values[name] = values.get(name) if value is None else {**(values.get(name) or {}), suffix: value}
    return Finding(code, values)


@dataclass(frozen=True)
class Reason:
    """Why a move of a program is not corrected, such as "shared-use": a value of the findings about programs."""

    name: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def text(self, argument: Callable[[str], str] = str) -> str:
        """Return the clause of the reason, about the move's tool or the like if the values have a subject."""
        return worded(f"[its {{subject}}: ]{REASONS[self.name]}", self.values, argument)


def ordered(findings: Sequence[Finding], simulated: bool = False) -> list[Finding]:
    """Return the verdict, the first finding, and the others by severity; before it that data are simulated."""
    severities = list(Severity)
    following = sorted(findings[1:], key=lambda finding: severities.index(finding.severity))
    return [*([Finding("simulated")] if simulated else []), *findings[:1], *following]


def entries(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    """Return findings as JSON."""
    return [finding.entry() for finding in findings]


def findings_of(document: Mapping[str, Any]) -> list[Finding]:
    """Return the findings of a JSON document."""
    return [Finding(entry["code"], entry["values"]) for entry in document["findings"]]


def worded(template: str, values: Mapping[str, Any], argument: Callable[[str], str] = str) -> str:
    """Return a template with its values.

    ``{name}``: a text, a list of texts, or a quantity. ``{names:4}``: at most four of a list. ``{n:#row}``: "1 row", "2
    rows"; ``{n:#entry|entries}``. ``{n:?is|are}``: the first for one. ``{texts:;}``: all of a list, which may have
    commas. ``{@loss}``: the argument of this name; ``{rows:@leave_out}``: it, before each text of a list. ``@@`` in a
    command: the option in Python too. ``[…]`` is left out if one of its values is absent or false, or replaced by ``B``
    in ``[A||B]``; ``{name:!}`` prints nothing, so that only its presence matters.
    """
    words = _Words(argument)

    def present(optional: re.Match[str]) -> str:
        text, _, otherwise = optional[1].partition("||")
        names = [name for _, name, _, _ in words.parse(text) if name and not name.startswith("@")]
        return otherwise if any(values.get(name) in _ABSENT for name in names) else text

    return words.vformat(_OPTIONAL.sub(present, template), (), values)


class _Words(Formatter):
    """The formatter of ``worded``."""

    def __init__(self, argument: Callable[[str], str]) -> None:
        self._argument = argument

    def get_value(self, key: int | str, args: Any, kwargs: Mapping[str, Any]) -> Any:
        name = str(key)
        return self._named(name) if name.startswith("@") else kwargs[name]

    def _named(self, reference: str) -> str:
        name = reference.lstrip("@")
        return option(name) if reference.startswith("@@") else self._argument(name)

    def format_field(self, value: Any, format_spec: str) -> str:
        """Format a value by the mark that ``worded`` describes; a mark precedes the type of the value."""
        mark, choice = format_spec[:1], format_spec[1:].partition("|")
        count = len(value) if isinstance(value, list | tuple) else value
        if mark == "!":
            return ""
        if isinstance(value, Argument):
            return self._argument(value)
        if mark == "#":
            return counted(count, choice[0], choice[2])
        if mark == "?":
            return choice[0] if count == 1 else choice[2]
        if isinstance(value, Mapping):
            return " and ".join(_quantity(number, suffix, format_spec) for suffix, number in value.items())
        if mark == "@":
            return " ".join(f"{self._named(format_spec)} {shlex.quote(one_line(text))}" for text in value)
        if isinstance(value, list | tuple):
            texts = [one_line(str(text)) for text in value]
            return "; ".join(texts) if mark == ";" else listed(texts, int(format_spec or MOST))
        if value is None:
            return "-"
        return one_line(value) if isinstance(value, str) else format(value, format_spec)


def _quantity(number: float | None, suffix: str, spec: str) -> str:
    """Return a number in the unit of a suffix, by default with one decimal less than a parameter."""
    unit = SUFFIXES[suffix]
    if number is None:
        return "-"
    return f"{number:{spec or f'.{UNITS[unit.si].decimals - 1}f'}} {unit.symbol}".rstrip()
