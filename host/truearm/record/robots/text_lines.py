"""Joint readings as text, for robots that can print their joints.

These are tables (CSV), and lines of CSV or JSON over TCP or UDP.

::

    lines+tcp://192.168.0.2:7008                                       the robot listens, we connect
    lines+udp://0.0.0.0:7008                                           we listen, the robot sends datagrams
    lines+tcp://192.168.0.2:7008?unit=deg&t=stamp&q=positions          JSON with names and units of its own
    lines+udp://0.0.0.0:7008?columns=t_ms,q1_deg,q2_deg                CSV without a header

Column titles in a header end in the unit: ``t_s`` (or _ms, _us, _ns) is the controller's time, ``q1_rad`` (_deg, _m,
_mm) … are the measured joints. Optional columns are ``q1_cmd_rad`` … commanded joints, ``qd1_rad_s`` … velocities,
``seq`` a count of the readings, and ``inputs`` digital inputs as a number. ``note`` and ``x_…`` are skipped.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import TextIOWrapper
from itertools import chain, cycle
from pathlib import Path
from types import NoneType
from typing import IO, Annotated, Any, Literal

import msgspec

from truearm.disk import open_input, reading
from truearm.errors import Argument, InputError, LinkError, ProtocolError, TableError
from truearm.kinds.csv_cells import MAX_COLUMNS, NUMBER, Column, Row, read_header, rows_of
from truearm.record.intake import MAX_LINE, SILENCE_S
from truearm.record.links import Arrivals, Clock, Datagram, Link, LinkOnTop, Runs, TcpLink, UdpLink, parse_address
from truearm.record.robots.sources import AddedReading, FileOptions
from truearm.schema import quoted
from truearm.session.joint_format import MAX_JOINTS, are_joints, format_reading, parse_line
from truearm.units import SUFFIXES

# to divide by: 1e-9 is not exact in binary
PER_SECOND = {unit: round(SUFFIXES[unit].factor) for unit in ("s", "ms", "us", "ns")}
EXAMPLE = "t_s,seq,q1_rad,q2_rad,... (units: rad, deg, m, mm; commanded joints are q1_cmd_rad, ...)"
UNITS_OF_JOINTS = ("rad", "deg", "m", "mm")
# the quantity and the unit of each column that is read; quantities of joints are numbered
TITLES = {
    **{f"t_{unit}": ("t", unit) for unit in PER_SECOND},
    **{name: (name, "") for name in ("seq", "inputs")},
    **{
        title.format(number, unit): (f"{quantity}{number}", unit)
        for quantity, title in (("q", "q{}_{}"), ("q_cmd", "q{}_cmd_{}"), ("qd", "qd{}_{}_s"))
        for number in range(1, MAX_JOINTS + 1)
        for unit in UNITS_OF_JOINTS
    },
}
_NUMBER = re.compile(rf"([+-]?\d{{1,18}})|(?:{NUMBER.pattern})", re.ASCII)

QUANTITIES = ("t", "seq", "q", "q_cmd", "qd", "current", "effort", "inputs")
CONVERTED = ("q", "q_cmd", "qd")  # of joints, with units
MAX_CELL = 40  # characters of a number
MAX_TIME = 2**63  # in any unit: nanoseconds since 1970 are 2⁶¹

Name = str | tuple[str, ...]


@dataclass(frozen=True)
class Names:
    """The names and units in a robot's rows.

    ``keys``: the key of a quantity, or the keys of its joints. ``scale``: factors of a quantity to SI, one for all
    joints or one each. Time is divided by ``t_per_second``.
    """

    keys: Mapping[str, Name] = field(default_factory=dict)
    scale: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    t_per_second: int = 1

    def line(self, row: Mapping[str, Any], **entries: object) -> bytes | None:
        """Return a row as a line of a session, with ``entries`` added; None if it is not a reading."""
        values = {quantity: self._value(row, quantity) for quantity in QUANTITIES}
        t, seq, q = (values.pop(name) for name in ("t", "seq", "q"))
        if type(t) not in (int, float) or not abs(t) < MAX_TIME or type(seq) not in (int, NoneType) or q is None:
            return None
        return format_reading(t / self.t_per_second, seq, q, **values, **entries)

    def _value(self, row: Mapping[str, Any], quantity: str) -> Any:
        """Return a value of a row, joints in SI.

        None if it is invalid, or the number of joints is not that of the units.
        """
        key = self.keys.get(quantity, quantity)
        value = row.get(key) if isinstance(key, str) else [row.get(name) for name in key]
        if value is None or quantity in ("t", "seq"):
            return value
        if quantity == "inputs":
            return value if type(value) is int else None
        scale = self.scale.get(quantity, (1.0,))
        if not are_joints(value) or len(scale) not in (1, len(value)):
            return None
        return [factor * number for factor, number in zip(cycle(scale), value, strict=False)]


@dataclass(frozen=True)
class Columns:
    """The columns of a table with ``width`` cells per row that are read, by their titles; ``names`` refers to these."""

    width: int
    read: Sequence[Column]
    names: Names

    def line(self, cells: Sequence[str], **entries: object) -> bytes | None:
        """Return a row as a line of a session, with ``entries`` added; None if it is not a reading."""
        if len(cells) != self.width:
            return None
        row = {column.title: _number(cells[column.position]) for column in self.read}
        if None in row.values() or any(type(row[column.title]) is float for column in self.read if not column.unit):
            return None
        return self.names.line(row, **entries)


def _number(cell: str) -> int | float | None:
    """Return a decimal number, whole if it is written so; None for any other text.

    float() would accept "1_000", "nan" and digits of other scripts.
    """
    match = _NUMBER.fullmatch(cell)
    if match is None or len(cell) > MAX_CELL:
        return None
    return int(cell) if match[1] else float(cell)


NUMBERED = "{}"  # stands for the number of a joint
SEPARATORS = ",;\t"


def separator_of(header: str) -> str:
    """Return the delimiter of a table with this header: the commonest of comma, semicolon and tab, else a space."""
    separator = max(SEPARATORS, key=header.count)
    return separator if separator in header or " " not in header.strip() else " "


def with_point(cell: str) -> str:
    """Replace the decimal comma of a number with a point and leave other cells unchanged.

    For tables that are not separated by commas.
    """
    return cell.replace(",", ".") if cell.count(",") == 1 and "." not in cell else cell


def parse_renames(text: str) -> tuple[tuple[str, str], ...]:
    """Parse OURS=THEIRS,… into pairs (ours, theirs); {} in both stands for a joint's number. Raises InputError."""
    entries = text.split(",")
    pairs = tuple((ours.strip(), theirs.strip()) for ours, _, theirs in (entry.partition("=") for entry in entries))
    for entry, (ours, theirs) in zip(entries, pairs, strict=True):
        if not theirs or not ours or (NUMBERED in ours) != (NUMBERED in theirs) or theirs.count(NUMBERED) > 1:
            raise InputError(
                f"{quoted(entry)}: write OURS=THEIRS, such as t_s=timestamp or q{NUMBERED}_rad=actual_q_{NUMBERED}, "
                f"with {NUMBERED} for a joint's number on both sides or none"
            )
    return pairs


def renamed(titles: Sequence[str], renames: Sequence[tuple[str, str]], name: str = "the header") -> list[str]:
    """Return a table's titles with our names. Joints count from the lowest number present.

    Columns without a rename keep the titles that we know, unless a renamed column takes their place; others are
    skipped. ``name`` is that of the file. Raises TableError for a column that is not there.
    """
    out: dict[int, str] = {}
    for ours, theirs in renames:
        pattern = re.compile(r"(\d{1,2})".join(map(re.escape, theirs.split(NUMBERED))))
        places = [(k, match) for k, title in enumerate(titles) if (match := pattern.fullmatch(title))]
        if not places:
            listed = ", ".join(map(quoted, titles[:8]))
            raise TableError(f"{name}: no column {quoted(theirs)}; the table begins with {listed}")
        first = min(int(match[1]) for _, match in places) if NUMBERED in theirs else 0
        for k, match in places:
            number = int(match[1]) - first + 1 if NUMBERED in theirs else ""
            out[k] = ours.replace(NUMBERED, str(number))
    taken = {_quantity(title) for title in out.values()} | {""}
    return [out.get(k, f"x_{k}" if _quantity(title) in taken else title) for k, title in enumerate(titles)]


def _quantity(title: str) -> str:
    return TITLES.get(title, ("", ""))[0]


def read_columns(titles: Sequence[str], name: str = "the header") -> Columns:
    """Return the columns named by a header; ``name`` is that of its file. Raises TableError."""
    if len(titles) > MAX_COLUMNS:
        raise TableError(f"{name}: {len(titles)} columns; the maximum is {MAX_COLUMNS}")
    columns = read_header(list(titles) or [""], TITLES, name, f"expected a header such as {EXAMPLE}", ignored="x_.*")
    keys: dict[str, Name] = {key: columns[key].title for key in ("t", "seq", "inputs") if key in columns}
    scale: dict[str, tuple[float, ...]] = {}
    n = sum(key.startswith("q") and key[1:].isdigit() for key in columns)
    for quantity in CONVERTED:
        joints = [key for key in columns if key.rstrip("0123456789") == quantity]
        numbered = [f"{quantity}{number}" for number in range(1, n + 1)]
        if n == 0 or (joints and {*joints} != {*numbered}):
            raise TableError(
                f"{name}: columns of {quantity} are needed for joints 1, 2, ... without a gap; expected {EXAMPLE}"
            )
        if joints:
            keys[quantity] = tuple(columns[key].title for key in numbered)
            scale[quantity] = tuple(SUFFIXES[columns[key].unit].scale for key in numbered)
    return Columns(len(titles), tuple(columns.values()), Names(keys, scale, PER_SECOND[columns["t"].unit]))


NO_ARRIVAL = {"arrival": False}  # in every such line: its arrival was not observed


def readings(path: Path, options: FileOptions) -> Iterator[AddedReading]:
    """Yield the readings of a table that a robot or its logger wrote, in order of time.

    It is read row by row: a day at 500 Hz is 43 million rows. Raises TableError with file and row, InputError if joints
    are named.
    """
    if options.joints:
        arguments = Argument("joints"), " and ", Argument("model")
        raise InputError(*arguments, " order the joints of a bag; a table's columns are already in order")
    try:
        with open_input(path) as file, reading(path):
            yield from _rows(path, TextIOWrapper(file, encoding="utf-8-sig", newline=""), options.columns)
    except UnicodeDecodeError as exc:
        raise TableError("not-text", place=path) from exc


def _rows(path: Path, file: IO[str], renames: Sequence[tuple[str, str]]) -> Iterator[AddedReading]:
    lines = _lines(path, file)
    header = next(lines, "")
    separator = separator_of(header)
    rows_of_text = chain([header], lines)
    rows = rows_of(map(_one_space, rows_of_text) if separator == " " else rows_of_text, str(path), separator=separator)
    titles = next(rows, Row(1, [])).cells
    columns = read_columns(renamed(titles, renames, str(path)) if renames else titles, str(path))
    last = -1.0
    for number, cells in rows:
        line = columns.line(cells if separator == "," else [with_point(cell) for cell in cells], **NO_ARRIVAL)
        reading = None if line is None else parse_line(line)
        if line is None or reading is None:
            raise TableError(
                f"{path} row {number}: is not a reading: it needs {len(titles)} numbers, with t not negative"
            )
        if reading.t < last:
            raise TableError(
                f"{path} row {number}: time goes back from {last:g} s to {reading.t:g} s; sort the rows, or "
                "make two tables if the controller was restarted"
            )
        last = reading.t
        yield AddedReading(reading.t, line)


def _one_space(line: str) -> str:
    """Return a line of columns that are aligned with spaces, with one space between them.

    A "#" before a header is left out.
    """
    return " ".join(line.removeprefix("#").split()) + "\n"


def _lines(path: Path, file: IO[str]) -> Iterator[str]:
    while line := file.readline(MAX_LINE + 1):
        if len(line) > MAX_LINE:
            raise TableError(
                f"{path}: has a line of more than {MAX_LINE} characters; is this a table of joint readings?"
            )
        yield line


# ------------------------------------------------------------------------------------------------- lines over a network

OVERLONG = b"of a line that is too long: "  # before its pieces, so that none is taken for a reading


class Declaration(msgspec.Struct):
    """The keys of a robot's quantities, and the units of its joints, one for all or one for each, and of its time."""

    names: dict[
        Annotated[str, msgspec.Meta(pattern=rf"^({'|'.join(QUANTITIES)})\Z")],
        str | Annotated[tuple[str, ...], msgspec.Meta(min_length=1, max_length=MAX_JOINTS)],
    ] = {}
    unit: Annotated[str, msgspec.Meta(pattern=r"^(rad|deg|mm?)(,(rad|deg|mm?)){0,31}\Z")] | None = None
    t_unit: Literal["s", "ms", "us", "ns"] | None = None


def read_names(declaration: Mapping[str, Any], names: Names) -> Names:
    """Return ``names`` extended by the fields of a ``Declaration``. Raises InputError."""
    try:
        declared = msgspec.convert(declaration, Declaration)
    except msgspec.ValidationError as exc:
        form = '{"names": {"t": "stamp", "q": ["j1", "j2"]}, "unit": "deg,mm", "t_unit": "ms"}'
        raise InputError(f"names and units of the readings: {exc}; write them as in {form}") from None
    if declared.unit is not None:
        scale = tuple(SUFFIXES[unit].scale for unit in declared.unit.split(","))
        names = replace(names, scale=dict.fromkeys(CONVERTED, scale))
    if declared.t_unit is not None:
        names = replace(names, t_per_second=PER_SECOND[declared.t_unit])
    return replace(names, keys={**names.keys, **declared.names})


class LineDialect:
    """Converts a robot's lines to a session's lines. ``specified``: by the address.

    A line that begins with ``{`` is JSON, others CSV. **CSV** begins with a header (``columns``), unless the address
    gives one. **JSON** follows docs/reference/session-format.md, or the names and units in the address or in a line
    before the readings, such as ``{"names": {"t": "stamp", "q": ["j1", "j2"]}, "unit": "deg", "t_unit": "ms"}``. ``q``
    is the name of a list, or a list of the joints' names. ``unit`` is one for all joints or one for each
    (``deg,deg,mm``).

    A line in the session format is stored as received. Any other reading is stored with its numbers in SI and, under
    ``line``, in its original form.
    """

    def __init__(self, specified: dict[str, str]) -> None:
        """Raises InputError."""
        names = dict(specified)
        columns = names.pop("columns", None)
        declaration: dict[str, Any] = {name: names.pop(name) for name in ("unit", "t_unit") if name in names}
        declaration["names"] = {name: key.split(",") if "," in key else key for name, key in names.items()}
        self._names = read_names(declaration, Names())
        self._columns = None if columns is None else read_columns(columns.split(","))

    def line(self, line: bytes) -> bytes:
        """Return a session's line for a robot's; the line itself if it needs no conversion or is not a reading.

        Raises InputError for a header or a declaration that is not understood.
        """
        try:
            values = self._line(line.decode().strip(), line)
        except UnicodeDecodeError:
            return line
        return values if len(values) <= MAX_LINE else line  # the embedded original may have grown

    def _line(self, text: str, line: bytes) -> bytes:
        """Return a session's line as ``line`` does, or learn the columns from a header; ``text``: the line, decoded."""
        if text.startswith("{"):
            return self._json(text, line)
        cells = [cell.strip() for cell in text.split(",")]
        if "t" in (cell.partition("_")[0] for cell in cells) and len(cells) > 1:
            self._columns = read_columns(cells)
            return line
        return line if self._columns is None else self._columns.line(cells, line=text) or line

    def _json(self, text: str, line: bytes) -> bytes:
        """Return a session's line for a JSON object, or learn the names from a declaration."""
        if self._names == Names() and parse_line(line) is not None:
            return line
        try:
            row = json.loads(text)
        except (ValueError, RecursionError):
            return line
        if row and row.keys() <= {"names", "unit", "t_unit"}:
            self._names = read_names(row, self._names)
            return line
        return line if self._names == Names() else self._names.line(row, line=text) or line


class LinesLink(LinkOnTop):
    """The lines of ``link`` in a session's form, converted by a dialect that learns the format from them.

    ``joined``: the first line may be incomplete, and a number without its first digits is still a number, so a row is
    skipped there.
    """

    def __init__(self, link: Link, clock: Clock, dialect: LineDialect, joined: bool = False) -> None:
        super().__init__(link, clock)
        self.dialect = dialect
        self._joined = joined
        self.runs = Runs(b"\n", MAX_LINE)
        self._end: LinkError | None = None

    def read(self, timeout_s: float) -> Arrivals:
        lines: Arrivals = []
        try:
            for t_host_ns, data in self._link.read(timeout_s) if self._end is None else ():
                lines += [(t_host_ns, line) for line in self._lines(t_host_ns, data)]
        except LinkError as exc:
            self._end = exc
            lines += [(self._clock.now_ns(), remainder)] if (remainder := self.runs.flush()) else []
        if self._end is not None and not lines:
            raise self._end
        return lines

    def _lines(self, t_host_ns: int, data: bytes) -> list[bytes]:
        """Return the lines that ``data``, which arrived at ``t_host_ns``, completes."""
        return [self._line(*run) + b"\n" for run in self._runs(data)]

    def _runs(self, data: bytes) -> list[tuple[bool, bytes]]:
        return self.runs.push(data)

    def _line(self, is_whole: bool, line: bytes) -> bytes:
        """Return a session's line for a run of bytes, or the run itself if it is not a reading or may be incomplete."""
        is_first_joined, self._joined = self._joined, False
        if not is_whole:
            return OVERLONG + line
        try:
            converted = self.dialect.line(line)
            return line if is_first_joined and not line.lstrip().startswith(b"{") else converted
        except InputError as exc:
            self._end = ProtocolError(f"{self.name}: {exc}")
            return line


class DatagramLines(LinesLink):
    """The lines of a robot's datagrams.

    The robot is the address that sent the first reading, from any port: a restarted program gets another one. What
    other addresses send is counted and dropped. After ``SILENCE_S`` without a reading, another address that sends one
    takes over: LinkError is raised, and a link opened after it begins anew. While there is no robot, whatever is no
    reading is passed on, a header that is not understood too: anybody can send one.
    """

    _robot: str | None = None
    _reading_ns = 0  # arrival of its last reading

    def _lines(self, t_host_ns: int, data: bytes) -> list[bytes]:
        assert isinstance(data, Datagram)
        is_foreign = self._robot not in (None, data.sender)
        if is_foreign and t_host_ns - self._reading_ns < SILENCE_S * 1e9:
            self._foreign += 1
            return []
        end = self._end
        lines = super()._lines(t_host_ns, data)
        if self._robot != data.sender:
            self._end = end
        if any(map(parse_line, lines)):
            if is_foreign:
                raise LinkError(
                    f"{self.name}: {self._robot} sent no reading for {SILENCE_S:g} s, and {data.sender} sends instead"
                )
            self._robot, self._reading_ns = data.sender, t_host_ns
        return lines


class DatagramMessages(DatagramLines):
    """The same of a robot that sends bytes: its dialect is given each datagram whole."""

    def _runs(self, data: bytes) -> list[tuple[bool, bytes]]:
        return [(True, data.removesuffix(b"\n"))]  # the link's


def connect(url: str, clock: Clock, last: Link | None) -> Link:
    """Return a link that still uses the header of the ``last`` one. Raises InputError, LinkError.

    Lines from ``tcp://HOST:PORT`` are in the session format already, and stored as received.
    """
    if url.startswith("tcp:"):
        return TcpLink(url, clock)
    address, options = url.partition("?")[0], parse_address(url, url.partition(":")[0], with_options=True)[2]
    dialect = last.dialect if isinstance(last, LinesLink) else LineDialect(options)
    plain = address.removeprefix("lines+")
    if plain.startswith("udp"):
        return DatagramLines(UdpLink(plain, clock, name=url), clock, dialect)
    return LinesLink(TcpLink(plain, clock, name=url), clock, dialect, joined=True)
