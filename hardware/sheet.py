"""A sheet of the schematic: parts placed on a grid of 2.54 mm, and the parts of their nets that are drawn as wires.

Wires follow from the placement: two points of a net in one row or column are joined if nothing of another net lies
between them. Other points get labels. `via` adds a corner to route a wire around something.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

from hardware.netlist import Component, Netlist
from hardware.parts import CATALOGUE, Kind

Point = tuple[int, int]
TWO_TERMINAL_LENGTH = 3
SUPPLIES = ("GND", "+3V3", "AVDD", "VBUS", "+24V")


@dataclass(frozen=True)
class Part:
    """A part on a sheet. ``nets``: pin number → net, None for an open pin."""

    ref: str
    kind: Kind
    value: str
    at: Point
    nets: Mapping[str, str | None]
    vertical: bool
    flip: bool
    fitted: bool
    note: str

    def far(self, number: str) -> bool:
        """Return whether a pin of a two-terminal part is its right or lower end."""
        return (number == "2") != self.flip

    def pin_at(self, number: str) -> Point:
        """Return the position of a pin's end."""
        x, y = self.at
        pin = next(pin for pin in self.kind.pins if pin.number == number)
        if self.kind.glyph:
            along = TWO_TERMINAL_LENGTH * self.far(number)
            return (x, y + along) if self.vertical else (x + along, y)
        return (x - 1, y + 1 + pin.row) if pin.side == "L" else (x + self.kind.width + 1, y + 1 + pin.row)

    def direction(self, number: str) -> int:
        """Return the direction of a label at the pin, in degrees: 0 right, 90 up, 180 left, 270 down."""
        if self.kind.glyph:
            return (90, 270)[self.far(number)] if self.vertical else (180, 0)[self.far(number)]
        return 180 if next(pin for pin in self.kind.pins if pin.number == number).side == "L" else 0

    def box(self) -> tuple[int, int, int, int]:
        """Return the rectangle x0, y0, x1, y1 whose inner grid points no wire may cross."""
        x, y = self.at
        if self.kind.glyph:
            return (x, y, x, y + 3) if self.vertical else (x, y, x + 3, y)
        return (x, y, x + self.kind.width, y + self.kind.rows + 1)


@dataclass
class Sheet:
    """One sheet. ``notes`` are (position, text) printed on it."""

    name: str
    title: str
    parts: list[Part] = field(default_factory=list)
    vias: list[tuple[str, Point]] = field(default_factory=list)
    notes: list[tuple[Point, str]] = field(default_factory=list)

    def add(
        self,
        ref: str,
        kind: Kind,
        value: str,
        at: Point,
        nets: tuple | dict,
        *,
        down: bool = False,
        flip: bool = False,
        note: str = "",
    ) -> None:
        """Place a part. ``nets`` of two terminals is (net of pin 1, net of pin 2), from left to right or, ``down``,
        downwards.

        ``flip`` draws pin 2 of a diode, its anode, first.

        A value that ends in " not fitted" is a position on the board that stays empty. Raises KeyError for a part
        without part number, ValueError for nets that do not name every pin.
        """
        if isinstance(nets, tuple):
            nets = {str(i + 1): net for i, net in enumerate(nets)}
        if set(nets) != {pin.number for pin in kind.pins}:
            raise ValueError(f"{ref}: nets for pins {sorted(nets)}, but it has {sorted(p.number for p in kind.pins)}")
        fitted = not value.endswith(" not fitted")
        value = value.removesuffix(" not fitted")
        CATALOGUE[kind.name, value]
        self.parts.append(Part(ref, kind, value, at, dict(nets), down, flip, fitted, note))

    def via(self, net: str, *points: Point) -> None:
        """Add corners to a net's wire."""
        self.vias += [(net, point) for point in points]

    def note(self, at: Point, text: str) -> None:
        self.notes.append((at, text))


def netlist(sheets: Iterable[Sheet]) -> Netlist:
    """Return the content of the sheets without their drawing. Raises ValueError for a duplicate reference."""
    components: dict[str, Component] = {}
    pins = {}
    for part in (part for sheet in sheets for part in sheet.parts):
        if part.ref in components:
            raise ValueError(f"{part.ref} is there twice")
        mpn = CATALOGUE[part.kind.name, part.value][1]
        components[part.ref] = Component(part.ref, part.value, mpn, part.fitted)
        pins |= {(part.ref, number): net for number, net in part.nets.items() if net is not None}
    return Netlist(components, pins)


# ---- wires


@dataclass(frozen=True)
class Wires:
    """``segments``: the wires; ``clusters``: net and points joined by them, one entry per cluster; ``dots``: junctions."""

    segments: tuple[tuple[Point, Point], ...]
    clusters: tuple[tuple[str, frozenset[Point]], ...]
    dots: tuple[Point, ...]


def wires(sheet: Sheet) -> Wires:
    """Draw straight wires between neighbours where possible. Supplies remain symbols and labels."""
    points: dict[Point, str] = {}
    for part in sheet.parts:
        for number, net in part.nets.items():
            if points.setdefault(part.pin_at(number), net or "") != (net or ""):
                raise ValueError(f"{sheet.name}: {part.ref} pin {number} lies on another net's point")
    points |= {point: net for net, point in sheet.vias}
    parent = {point: point for point in points}

    def root(point: Point) -> Point:
        while parent[point] != point:
            point = parent[point]
        return point

    segments: list[tuple[Point, Point]] = []
    for a, b in sorted(_neighbours(points), key=lambda pair: (_length(*pair), pair)):
        free = all(not _inside(part, a, b) for part in sheet.parts)
        if root(a) != root(b) and free and not any(_overlap(a, b, *other) for other in segments):
            parent[root(a)] = root(b)
            segments.append((a, b))
    clusters: dict[Point, set[Point]] = {}
    for point, net in points.items():
        if net:
            clusters.setdefault(root(point), set()).add(point)
    ends = [end for segment in segments for end in segment]
    pin_points = [part.pin_at(number) for part in sheet.parts for number in part.nets]
    dots = sorted({end for end in ends if ends.count(end) + pin_points.count(end) >= 3})
    return Wires(
        tuple(segments), tuple((points[where], frozenset(group)) for where, group in clusters.items()), tuple(dots)
    )


def _neighbours(points: Mapping[Point, str]) -> list[tuple[Point, Point]]:
    """Return pairs of points of one net in a row or column with no other point between them, except on supplies."""
    found = []
    for axis in (0, 1):
        lines: dict[int, list[Point]] = {}
        for point in points:
            lines.setdefault(point[1 - axis], []).append(point)
        for line in lines.values():
            line.sort()
            found += [
                (a, b)
                for a, b in pairwise(line)
                if points[a] and points[a] == points[b] and points[a] not in SUPPLIES and _length(a, b) <= 40
            ]
    return found


def _length(a: Point, b: Point) -> int:
    return abs(a[0] - b[0]) + abs(a[1] - b[1])


def _inside(part: Part, a: Point, b: Point) -> bool:
    """Return whether the wire crosses the part's drawing."""
    x0, y0, x1, y1 = part.box()
    low, high = (min(a[0], b[0]), min(a[1], b[1])), (max(a[0], b[0]), max(a[1], b[1]))
    if part.kind.glyph:  # a line between its two pins
        if a[1] == b[1] == y0 == y1:
            return low[0] < x1 and high[0] > x0
        if a[0] == b[0] == x0 == x1:
            return low[1] < y1 and high[1] > y0
        if a[1] == b[1] and x0 == x1:
            return low[0] < x0 < high[0] and y0 < a[1] < y1
        return a[0] == b[0] and y0 == y1 and low[1] < y0 < high[1] and x0 < a[0] < x1
    return low[0] < x1 and high[0] > x0 and low[1] < y1 and high[1] > y0


def _overlap(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Return whether two wires overlap, or one ends within the other."""

    def within(p: Point, q: Point, r: Point) -> bool:
        return (p[0] == q[0] == r[0] and q[1] < p[1] < r[1]) or (p[1] == q[1] == r[1] and q[0] < p[0] < r[0])

    first, second = sorted((a, b)), sorted((c, d))
    return first == second or any([within(p, *second) for p in first] + [within(p, *first) for p in second])
