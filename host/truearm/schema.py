"""Schemas: the keys of a file are declared once, and the file is both read and written by this declaration.

A ``Value`` converts a TOML or JSON value to a checked value in SI units, and back to TOML text that is read back bit
for bit. A ``Key`` gives a value its name in the file; the name ends in the unit (``length_mm``). A ``Table`` is a set
of keys and the object made from them. ``Entries`` are the ``[[name]]`` tables of a document. Errors raise SchemaError,
whose text names the key and the entry; ``read`` adds the file and raises the caller's error.

Nothing here accesses a file, and importing this module is cheap: a declaration can be next to the class that it
declares.
"""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields
from types import UnionType
from typing import Annotated, Any, Generic, TypeVar, Union, get_args, get_origin, get_type_hints

from truearm.errors import InputError
from truearm.units import SMALLEST, SUFFIXES, UNITS, named, suffixes

Matrix = tuple[tuple[float, ...], ...]  # rows of a small constant matrix; unlike an array it supports ==

MOST_LISTED = 150  # characters of a list of names in a message
MAX_SHOWN = 40  # characters of an external text in a message
MAX_SIZE = 64  # of a list or a matrix, by the number of joints
MAX_ENTRIES = 10_000
HUGE = 1e12  # no number in any unit is larger; a larger integer may have no float
UNKNOWN = "unknown"
NO_UNIT = ("",)
NAME = re.compile(r"[\w-](?:[\w.-]{0,62}[\w-])?")  # no dot at an end: parameter names such as chuck.<name>.x have these
MAX_KEY_PARTS = 32  # tomllib's time grows with the square of the number
_KEY_PART = r"""(?:(?<![\w-])[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+"""
_DEEP_KEY = re.compile(f"(?:{_KEY_PART}){{{MAX_KEY_PARTS}}}")
LARGEST_RATIO = 1e6  # of standard deviations in a covariance; the smallest would be lost in the rounding of its square

T = TypeVar("T")


class SchemaError(ValueError):
    """An error in a value; every enclosing table puts its key or entry in front."""


@contextmanager
def at(place: str) -> Iterator[None]:
    """Put ``place`` in front of the text of a SchemaError."""
    try:
        yield
    except SchemaError as exc:
        raise SchemaError(f"{place}: {exc}") from None


def load_toml(text: str, parse_float: Callable[[str], Any] = float) -> dict[str, Any]:
    """Return TOML text as a dictionary, in a time proportional to its length.

    Raises ValueError for a dotted key of MAX_KEY_PARTS or more dots, and otherwise what tomllib raises.
    """
    if deep := _DEEP_KEY.search(text):
        line = text.count("\n", 0, deep.start()) + 1
        raise ValueError(f"a key of more than {MAX_KEY_PARTS} parts in line {line}")
    return tomllib.loads(text, parse_float=parse_float)


def toml_text(document: Mapping[str, Any]) -> str:
    """Return a document as TOML: its own entries, then its tables. Tables and lists in these are on one line."""
    lines = [f"{key} = {_toml_value(entry)}" for key, entry in document.items() if not isinstance(entry, dict)]
    for name, table in document.items():
        if isinstance(table, dict):
            lines += [
                "",
                f"[{_toml_key(name)}]",
                *(f"{_toml_key(key)} = {_toml_value(entry)}" for key, entry in table.items()),
            ]
    return "\n".join([*lines, ""])


def _toml_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _toml_value(key)


def _toml_value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_toml_key(key)} = {_toml_value(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def quoted(value: object) -> str:
    """Return an external text in a form suitable for a one-line message."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return repr(value[:MAX_SHOWN])
    if value is None:
        return "null"
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "a table"
    if isinstance(value, int | float) and not abs(value) > HUGE:
        return f"{value:g}"
    return f"a value of type {type(value).__name__}"


class Value:
    """One value of a file."""

    @property
    def suffixes(self) -> Sequence[str]:
        """Those of ``units.SUFFIXES`` that its key may end in, the SI unit first."""
        return NO_UNIT

    def parse(self, raw: Any, suffix: str) -> Any:
        """Return the checked SI value of an entry whose key has this suffix. Raises SchemaError."""
        raise NotImplementedError

    def format(self, value: Any) -> str:
        """Return the TOML text of a value, under a key with the first of the suffixes."""
        return _toml_value(value)


def values_of(record: type) -> Mapping[str, Value]:
    """Return the value types in the annotations of a dataclass, by field: ``sigma: Annotated[float, Number("m")]``."""
    hints = get_type_hints(record, include_extras=True)
    return {field.name: value for field in fields(record) for value in _annotated(hints[field.name])}


def _annotated(hint: Any) -> Iterator[Value]:
    if get_origin(hint) is Annotated:
        yield hint.__metadata__[0]
    elif get_origin(hint) in (Union, UnionType):
        for alternative in get_args(hint):
            yield from _annotated(alternative)


@dataclass(frozen=True)
class Number(Value):
    """A finite number in an SI unit of ``UNITS``, between ``least`` and ``most`` [SI].

    Those default to ± the unit's largest.

    ``positive``: 0 is too small. A number that may not be negative must not be so small that it is probably an error
    (``units.SMALLEST``). ``unknown``: the word "unknown" is accepted and read as None. ``spelled``: the suffixes that
    its key may have, the SI unit first; by default those of ``units.suffixes``.
    """

    si: str = "1"
    least: float | None = None
    most: float | None = None
    positive: bool = False
    unknown: bool = False
    spelled: tuple[str, ...] = ()

    @property
    def suffixes(self) -> Sequence[str]:
        return self.spelled or tuple(suffixes(self.si))

    def parse(self, raw: Any, suffix: str = "") -> float | None:
        if self.unknown and raw == UNKNOWN:
            return None
        if isinstance(raw, bool) or not isinstance(raw, int | float):
            remedy = "write a number without quotes" if isinstance(raw, str) else "write one number"
            raise SchemaError(f"{quoted(raw)} is not a number" + f' (or "{UNKNOWN}")' * self.unknown + f"; {remedy}")
        if not abs(raw) <= HUGE:  # also rejects NaN; an integer of a thousand digits has no float and no text
            raise SchemaError("not a finite number of reasonable size")
        unit = SUFFIXES[suffix]
        value = float(raw) * unit.scale
        highest = UNITS[self.si].largest if self.most is None else self.most
        lowest = 0.0 if self.positive else -highest if self.least is None else self.least
        if self.positive and value <= 0.0:
            raise SchemaError(f"{raw:g} {unit.symbol}".rstrip() + " is not greater than 0")
        if lowest == 0.0 and 0.0 < value < SMALLEST:
            zero = "" if self.positive else ", or 0"
            raise SchemaError(
                f"{raw:g} {unit.symbol}".rstrip() + f" is too small; give {unit.text(SMALLEST)} or more{zero}"
            )
        if not lowest <= value <= highest:
            raise SchemaError(
                f"{unit.text(value)} is not between {lowest / unit.scale:g} and {unit.text(highest)}; is the unit right?"
            )
        return value

    def format(self, value: float | None) -> str:
        return _toml_value(UNKNOWN if value is None else float(value))


@dataclass(frozen=True)
class Whole(Value):
    """A whole number between ``least`` and ``most``."""

    least: int
    most: int

    def parse(self, raw: Any, suffix: str = "") -> int:
        if type(raw) is not int or not self.least <= raw <= self.most:
            raise SchemaError(f"{quoted(raw)} is not a whole number from {self.least} to {self.most}")
        return raw


def sigma(si: str = "1", *, unknown: bool = False) -> Number:
    """Return the value type of a standard deviation, 0 or more."""
    return Number(si, least=0.0, unknown=unknown)


@dataclass(frozen=True)
class List(Value):
    """A list of ``size`` values of one type (None: ``least`` to ``most``), read as a tuple."""

    item: Value
    size: int | None = None
    least: int = 1
    most: int = MAX_SIZE

    @property
    def suffixes(self) -> Sequence[str]:
        return self.item.suffixes

    def parse(self, raw: Any, suffix: str = "") -> tuple[Any, ...]:
        fewest, greatest = (self.least, self.most) if self.size is None else (self.size, self.size)
        if not isinstance(raw, list | tuple) or not fewest <= len(raw) <= greatest:
            count = str(greatest) if fewest == greatest else f"{fewest} to {greatest}"
            has = str(len(raw)) if isinstance(raw, list | tuple) else quoted(raw)
            raise SchemaError(f"needs a list of {count} value{'s' * (count != '1')}, has {has}")
        values = []
        for number, value in enumerate(raw, start=1):
            with at(f"item {number}"):
                values.append(self.item.parse(value, suffix))
        return tuple(values)

    def format(self, value: Sequence[Any]) -> str:
        return f"[{', '.join(map(self.item.format, value))}]"


@dataclass(frozen=True)
class Direction(List):
    """A vector of any length but 0."""

    item: Value = Number(most=HUGE)
    size: int | None = 3

    def parse(self, raw: Any, suffix: str = "") -> tuple[Any, ...]:
        values = super().parse(raw, suffix)
        if not any(values):
            raise SchemaError("must not be zero; [0, 0, 1] points along z")
        return values


@dataclass(frozen=True)
class Covariance(Value):
    """A covariance matrix, ``size``×``size`` or, if None, any size up to MAX_SIZE. ``singular``: it may be singular."""

    size: int | None = None
    singular: bool = False

    def parse(self, raw: Any, suffix: str = "") -> Matrix:
        import numpy as np

        matrix: Matrix = List(List(Number(most=1e4), self.size), self.size).parse(raw)
        if any(len(row) != len(matrix) for row in matrix):
            raise SchemaError(f"is not square: {len(matrix)} rows need {len(matrix)} values each")
        array = np.array(matrix)
        if not np.allclose(array, array.T, rtol=1e-9, atol=0.0):
            raise SchemaError("must be symmetric")
        least, most = np.linalg.eigvalsh(array)[[0, -1]]
        rounding = abs(most) / LARGEST_RATIO**2
        if least < -rounding or (least <= rounding and not self.singular):
            raise SchemaError(
                f"is not a covariance: it has an eigenvalue of {least:g}; check the signs and the entries off the diagonal"
            )
        if least < SMALLEST**2 and not self.singular:
            raise SchemaError(f"has an eigenvalue of {least:g}, too small; give {SMALLEST**2:g} or more")
        return matrix

    def format(self, value: Matrix) -> str:
        return List(List(Number())).format(value)


@dataclass(frozen=True)
class Sigmas(Value):
    """A list of standard deviations, read as a diagonal covariance matrix."""

    number: Number
    size: int | None = None

    @property
    def suffixes(self) -> Sequence[str]:
        return self.number.suffixes

    def parse(self, raw: Any, suffix: str) -> Matrix:
        values = List(self.number, self.size).parse(raw, suffix)
        if self.number.positive and max(values) >= LARGEST_RATIO * min(values):
            raise SchemaError(f"the largest must be less than {LARGEST_RATIO:,.0f} times the smallest")
        return tuple(tuple(s * s if i == k else 0.0 for k in range(len(values))) for i, s in enumerate(values))

    def format(self, value: Matrix) -> str:
        return List(self.number).format([row[i] ** 0.5 for i, row in enumerate(value)])


@dataclass(frozen=True)
class Text(Value):
    """Text of at most ``longest`` characters; ``one_line``: not empty, and all of it printable.

    If ``pattern`` is given, all of the text must match; ``wanted`` describes such a text.
    """

    longest: int = 200
    pattern: re.Pattern[str] | None = None
    wanted: str = ""
    one_line: bool = False

    def parse(self, raw: Any, suffix: str = "") -> str:
        if not isinstance(raw, str) or not self.matches(raw):
            lines = f"text of at most {self.longest} characters" + ", on one line" * self.one_line
            raise SchemaError(f"{quoted(raw)} is not {self.wanted or lines}")
        return raw

    def matches(self, text: str) -> bool:
        return (
            len(text) <= self.longest
            and (self.pattern is None or self.pattern.fullmatch(text) is not None)
            and (not self.one_line or (text != "" and text.isprintable()))
        )


IDENTIFIER = Text(pattern=NAME, wanted="a name of up to 64 letters, digits, '-', '_' and '.'")


@dataclass(frozen=True)
class Choice(Value):
    """One of some texts, members of a StrEnum, whole numbers, or truth values."""

    options: tuple[Any, ...]

    def parse(self, raw: Any, suffix: str = "") -> Any:
        for option in self.options:
            if option == raw and isinstance(option, type(raw)) and isinstance(option, bool) is isinstance(raw, bool):
                return option
        raise SchemaError(f"{quoted(raw)} is not one of {', '.join(map(quoted, self.options))}")


@dataclass(frozen=True)
class Key:
    """A value and its name in a file, without the unit.

    ``field``: its name in ``Table.make``, if different. Two keys with the same field are alternatives: a table may have
    only one of them, and the first is the one that is written.
    """

    name: str
    value: Value
    optional: bool = False
    field: str = ""

    @property
    def called(self) -> str:
        return self.field or self.name

    @property
    def spellings(self) -> Mapping[str, str]:
        """Return the names that it may have in a file, each with its suffix."""
        return {named(self.name, suffix): suffix for suffix in self.value.suffixes}

    def parse(self, raw: Any, spelled: str) -> Any:
        with at(spelled):
            return self.value.parse(raw, self.spellings[spelled])

    def line(self, value: Any) -> str:
        return f"{next(iter(self.spellings))} = {self.value.format(value)}"


def keys_of(record: type, *optional: str) -> tuple[Key, ...]:
    """Return a key for each field of a dataclass with a value type in its annotation.

    A key is optional if its field has a default or is among ``optional``.
    """
    values = values_of(record)
    return tuple(
        Key(field.name, values[field.name], field.default is not MISSING or field.name in optional)
        for field in fields(record)
        if field.name in values
    )


@dataclass(frozen=True)
class Entries(Generic[T]):
    """The ``[[name]]`` tables of a document, read as a dictionary by ``index``, or as a tuple if that is None."""

    name: str
    table: Table[T]
    field: str
    index: Callable[[T], Hashable] | None = None

    def parse(self, raw: Any) -> Mapping[Any, T] | tuple[T, ...]:
        if not isinstance(raw, list) or not all(isinstance(item, dict) for item in raw):
            raise SchemaError(f"{self.name} must be written as [[{self.name}]] entries")
        if len(raw) > MAX_ENTRIES:
            raise SchemaError(f"has {len(raw)} [[{self.name}]] entries; the maximum is {MAX_ENTRIES}")
        items: dict[Hashable, T] = {}
        for i, table in enumerate(raw, start=1):
            with at(f"[[{self.name}]] {i}"):
                item = self.table.parse(table)
                index = i if self.index is None else self.index(item)
                if index in items:
                    raise SchemaError(f"{_words(index)!r} is already defined; give each entry its own name")
                items[index] = item
        return items if self.index else tuple(items.values())

    def blocks(self, value: Mapping[Any, T] | tuple[T, ...]) -> list[str]:
        items = value.values() if isinstance(value, Mapping) else value
        return ["\n".join([f"[[{self.name}]]", *self.table.lines(item)]) for item in items]


def _words(index: Hashable) -> str:
    return "/".join(filter(None, index)) if isinstance(index, tuple) else str(index)


@dataclass(frozen=True)
class Table(Value, Generic[T]):
    """A table of a file, and the object made from it.

    ``make`` is called with the values of the existing keys, by field, and may raise SchemaError if they are
    inconsistent; the default of a key is that of ``make``'s parameter. ``take`` is its inverse: an object's values by
    field. A value that is missing, None (unless it may be unknown) or empty is not written. ``unknown_keys``:
    undeclared keys, from a later version, are skipped.
    """

    keys: tuple[Key, ...]
    make: Callable[..., T]
    take: Callable[[T], Mapping[str, Any]] = vars
    entries: tuple[Entries[Any], ...] = ()
    unknown_keys: bool = False

    def parse(self, raw: Any, suffix: str = "") -> T:
        return self.make(**self.values(raw))

    def values(self, raw: Any) -> dict[str, Any]:
        """Return the values of a table's keys, by field; optional keys only if they exist. Raises SchemaError."""
        table = as_table(raw)
        spellings = {spelled: key for key in self.keys for spelled in key.spellings}
        if not self.unknown_keys:
            check_known(table, [*spellings, *(entries.name for entries in self.entries)])
        spelling_of: dict[str, str] = {}
        for spelled in (spelled for spelled in spellings if spelled in table):
            first_spelling = spelling_of.setdefault(spellings[spelled].called, spelled)
            if first_spelling != spelled:
                raise SchemaError(f"has both {first_spelling} and {spelled}; keep one")
        values = {field: spellings[spelled].parse(table[spelled], spelled) for field, spelled in spelling_of.items()}
        for key in self.keys:
            if not key.optional and key.called not in spelling_of:
                alternatives = [s for s, alternative in spellings.items() if alternative.called == key.called]
                first, *further = sorted(alternatives, key=len)  # a plain sigma before a covariance
                raise SchemaError(f"needs {first}" + (f" (or {', '.join(further)})" if further else ""))
        return values | {e.field: e.parse(table[e.name]) for e in self.entries if e.name in table}

    def lines(self, item: T) -> list[str]:
        """Return ``key = value`` of an object, one line each, without its entries."""
        values = self.take(item)
        first = {key.called: key for key in reversed(self.keys)}
        return [
            key.line(values[key.called])
            for key in self.keys
            if first[key.called] is key and _is_written(values.get(key.called), key.value)
        ]

    def format(self, item: T) -> str:
        """Return the TOML document of an object."""
        values = self.take(item)
        blocks = [block for entries in self.entries for block in entries.blocks(values.get(entries.field, ()))]
        return "\n\n".join(["\n".join(self.lines(item)), *blocks]) + "\n"


def _is_written(value: Any, value_type: Value) -> bool:
    return (
        value != () and value != "" and (value is not None or (isinstance(value_type, Number) and value_type.unknown))
    )


def as_table(raw: Any) -> Mapping[str, Any]:
    """Return ``raw``, if it is a table. Raises SchemaError."""
    if not isinstance(raw, dict):
        raise SchemaError(f"must be a table, is {quoted(raw)}")
    return raw


def check_known(table: Mapping[str, Any], names: Sequence[str]) -> None:
    """Raise SchemaError for an unknown key: a misspelt one would silently take its default."""
    for key in table:
        if key not in names:
            raise SchemaError(f"unknown key {key[:MAX_SHOWN]!r}; {hint(key, names)}")


def hint(name: str, names: Sequence[str]) -> str:
    """Return which of the known names was probably meant, otherwise a list of them."""
    close = difflib.get_close_matches(name[:MAX_SHOWN], names, n=1)
    if close:
        stem, _, suffix = close[0].rpartition("_")
        both = [
            candidate
            for candidate in names
            if suffix in SUFFIXES and candidate in {f"{stem}_{unit}" for unit in SUFFIXES}
        ]
        return f"did you mean {' or '.join(both or close)}?"
    listed = ", ".join(names)
    return f"known are {listed if len(listed) <= MOST_LISTED else listed[:MOST_LISTED].rpartition(',')[0] + ', …'}"


@contextmanager
def raising(error: type[InputError], name: str = "") -> Iterator[None]:
    """Turn a SchemaError into ``error``, with the name of the file in front if there is one."""
    try:
        yield
    except SchemaError as exc:
        raise error(f"{name}: {exc}" if name else str(exc)) from None


def read(table: Table[T], document: Mapping[str, Any], name: str, error: type[InputError]) -> T:
    """Return the object made from a document; ``name`` stands for the file in messages.

    Raises ``error`` with file, entry and key.
    """
    with raising(error, name):
        return table.parse(document)
