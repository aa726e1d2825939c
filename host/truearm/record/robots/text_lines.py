"""Lines of CSV or JSON over TCP or UDP, for robots that can print their joints.

::

    lines+tcp://192.168.0.2:7008                                       the robot listens, we connect
    lines+udp://0.0.0.0:7008                                           we listen, the robot sends datagrams
    lines+tcp://192.168.0.2:7008?unit=deg&t=stamp&q=positions          JSON with names and units of its own
    lines+udp://0.0.0.0:7008?columns=t_ms,q1_deg,q2_deg                CSV without a header

A line that begins with ``{`` is JSON, others CSV. **CSV** begins with a header (``columns``), unless the address
gives one. **JSON** follows docs/reference/session-format.md, or the names and units in the address or in a line before
the readings, such as ``{"names": {"t": "stamp", "q": ["j1", "j2"]}, "unit": "deg", "t_unit": "ms"}``. ``q`` is the name
of a list, or a list of the joints' names. ``unit`` is one for all joints or one for each (``deg,deg,mm``).

A line in the session format is stored as received. Any other reading is stored with its numbers in SI and, under
``line``, in its original form.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import msgspec

from truearm.errors import InputError, LinkError, ProtocolError
from truearm.record.intake import MAX_LINE, SILENCE_S
from truearm.record.links import Arrivals, Clock, Datagram, Link, LinkOnTop, Runs, TcpLink, UdpLink, parse_address
from truearm.record.robots.joint_table import CONVERTED, PER_SECOND, QUANTITIES, Names, read_columns
from truearm.session.joint_format import MAX_JOINTS, parse_line
from truearm.units import SUFFIXES

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
    """Converts a robot's lines to a session's lines. ``specified``: by the address."""

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
        if text.startswith("{"):
            return self._json(text, line)
        cells = [cell.strip() for cell in text.split(",")]
        if "t" in (cell.partition("_")[0] for cell in cells) and len(cells) > 1:
            self._columns = read_columns(cells)
            return line
        return line if self._columns is None else self._columns.line(cells, line=text) or line

    def _json(self, text: str, line: bytes) -> bytes:
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
        return [self._line(*run) + b"\n" for run in self.runs.push(data)]

    def _line(self, is_whole: bool, line: bytes) -> bytes:
        joined, self._joined = self._joined, False
        if not is_whole:
            return OVERLONG + line
        try:
            converted = self.dialect.line(line)
            return line if joined and not line.lstrip().startswith(b"{") else converted
        except InputError as exc:
            self._end = ProtocolError(f"{self.name}: {exc}")
            return line


class DatagramLines(LinesLink):
    """The lines of a robot's datagrams.

    The robot is the address that sent the first reading, from any port: a restarted program gets another one. What other
    addresses send is counted and dropped. After ``SILENCE_S`` without a reading, another address that sends one takes
    over: LinkError is raised, and a link opened after it begins anew. While there is no robot, whatever is no reading
    is passed on, a header that is not understood too: anybody can send one.
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
