"""KiCad 9 schematic files of the sheets, with their own symbols. Only the standard library; reproducible output."""

from __future__ import annotations

import json
import uuid
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from hardware.footprints import FOOTPRINTS, footprint_of
from hardware.parts import CATALOGUE, Kind
from hardware.sheet import SUPPLIES, Part, Point, Sheet, wires

GRID = 2.54
LIBRARY = "truearm"
NAME = "truearm-box"
FORMAT = 20250114  # of KiCad 9.0
IDS = uuid.UUID("5f0c1d1e-7a0b-4c3e-9d6b-3d0f6c0a8b10")  # arbitrary: identifiers are derived from it and the names
LENGTH = 3 * GRID

# The drawing of a two-terminal part along its axis t from pin 1 and across it, s; mm. Pins end where the drawing
# begins.
GLYPHS: dict[str, tuple[float, list[list[tuple[float, float]]]]] = {
    "R": (1.905, [[(1.905, -0.9), (5.715, -0.9), (5.715, 0.9), (1.905, 0.9), (1.905, -0.9)]]),
    "C": (3.43, [[(3.43, -1.7), (3.43, 1.7)], [(4.19, -1.7), (4.19, 1.7)]]),
    "FUSE": (
        1.905,
        [[(1.905, -0.9), (5.715, -0.9), (5.715, 0.9), (1.905, 0.9), (1.905, -0.9)], [(1.905, 0), (5.715, 0)]],
    ),
    "BEAD": (
        1.905,
        [[(1.905, -0.9), (5.715, -0.9), (5.715, 0.9), (1.905, 0.9), (1.905, -0.9)], [(2.4, -0.9), (5.2, 0.9)]],
    ),
    "DIODE": (2.54, [[(2.54, -1.27), (2.54, 1.27)], [(5.08, -1.27), (5.08, 1.27), (2.54, 0), (5.08, -1.27)]]),
    "TVS": (
        2.54,
        [
            [(2.1, -1.6), (2.54, -1.27), (2.54, 1.27), (2.98, 1.6)],
            [(5.08, -1.27), (5.08, 1.27), (2.54, 0), (5.08, -1.27)],
        ],
    ),
    "TVS_BOTH": (
        1.78,
        [
            [(3.37, -1.6), (3.81, -1.27), (3.81, 1.27), (4.25, 1.6)],
            [(1.78, -1.27), (1.78, 1.27), (5.84, -1.27), (5.84, 1.27), (1.78, -1.27)],
        ],
    ),
}


def quote(text: object) -> str:
    return json.dumps(str(text), ensure_ascii=False)


def number(value: float) -> str:
    return f"{value:.4f}".rstrip("0").rstrip(".").replace("-0", "0", value == 0)


def identifier(*names: object) -> str:
    return str(uuid.uuid5(IDS, "/".join(map(str, names))))


def place(point: Point | tuple[float, float]) -> str:
    return f"{number(point[0] * GRID)} {number(point[1] * GRID)}"


# ---- symbols


def variant(part: Part) -> str:
    """Return the name of the symbol that draws the part."""
    if not part.kind.glyph:
        return part.kind.name
    return part.kind.name + ("_V" if part.vertical else "_H") + ("F" if part.flip else "")


def symbol(part: Part) -> str:
    kind = part.kind
    name = variant(part)
    hidden = "(pin_numbers (hide yes)) (pin_names (offset 0) (hide yes))" if kind.glyph else "(pin_names (offset 0.8))"
    body = _two_terminals(part) if kind.glyph else _rectangle(kind)
    return _symbol(name, kind.name, hidden, body)


def _symbol(name: str, value: str, options: str, body: str, power: str = "") -> str:
    reference = "#" if power else "U"
    return (
        f"(symbol {quote(name)} {power} {options} (exclude_from_sim no) (in_bom yes) (on_board yes)\n"
        f'  (property "Reference" {quote(reference)} (at 0 2 0) (effects (font (size 1.27 1.27))))\n'
        f'  (property "Value" {quote(value)} (at 0 -2 0) (effects (font (size 1.27 1.27))))\n'
        '  (property "Footprint" "" (at 0 0 0) (effects (font (size 1.27 1.27)) (hide yes)))\n'
        '  (property "Datasheet" "" (at 0 0 0) (effects (font (size 1.27 1.27)) (hide yes)))\n'
        '  (property "Description" "" (at 0 0 0) (effects (font (size 1.27 1.27)) (hide yes)))\n'
        f"  (symbol {quote(name.split(':')[-1] + '_1_1')}\n{body}\n  )\n)"
    )


def _line(points: Iterable[tuple[float, float]], fill: str = "none") -> str:
    ends = " ".join(f"(xy {number(x)} {number(y)})" for x, y in points)
    return f"    (polyline (pts {ends}) (stroke (width 0.2) (type default)) (fill (type {fill})))"


def _pin(kind: str, name: str, pin: str, x: float, y: float, angle: int, length: float) -> str:
    font = "(effects (font (size 1.1 1.1)))"
    return (
        f"    (pin {kind} line (at {number(x)} {number(y)} {angle}) (length {number(length)}) "
        f"(name {quote(name)} {font}) (number {quote(pin)} {font}))"
    )


def _two_terminals(part: Part) -> str:
    lead, lines = GLYPHS[part.kind.glyph]

    def turn(t: float, s: float) -> tuple[float, float]:
        t = LENGTH - t if part.flip else t
        return (s, -t) if part.vertical else (t, s)

    found = [_line(turn(*point) for point in line) for line in lines]
    for pin in part.kind.pins:
        far = part.far(pin.number)
        x, y = (0.0, -LENGTH * far) if part.vertical else (LENGTH * far, 0.0)
        angle = (90 if far else 270) if part.vertical else (180 if far else 0)
        found.append(_pin(pin.type, pin.name, pin.number, x, y, angle, lead))
    return "\n".join(found)


def _rectangle(kind: Kind) -> str:
    width, height = kind.width * GRID, (kind.rows + 1) * GRID
    found = [
        f"    (rectangle (start 0 0) (end {number(width)} {number(-height)}) "
        "(stroke (width 0.25) (type default)) (fill (type background)))"
    ]
    for pin in kind.pins:
        y = -(pin.row + 1) * GRID
        left = pin.side == "L"
        found.append(_pin(pin.type, pin.name, pin.number, -GRID if left else width + GRID, y, 0 if left else 180, GRID))
    return "\n".join(found)


def _supply(net: str) -> str:
    """Return a supply's symbol; its net is its value."""
    hidden = "(pin_numbers (hide yes)) (pin_names (offset 0) (hide yes))"
    lines = [[(-1.27, -1), (1.27, -1), (0, -2.2), (-1.27, -1)], [(0, 0), (0, -1)]]
    if net != "GND":
        lines = [[(0, 0), (0, 1.2)], [(-1.1, 1.2), (1.1, 1.2)]]
    body = "\n".join([*map(_line, lines), _pin("power_in", net, "1", 0, 0, 270 if net == "GND" else 90, 0)])
    return _symbol(f"{LIBRARY}:{net}", net, hidden, body, "(power)")


def _flag() -> str:
    hidden = "(pin_numbers (hide yes)) (pin_names (offset 0) (hide yes))"
    body = "\n".join(
        [
            _line([(0, 0), (0, 1), (-0.8, 1.6), (0, 2.2), (0.8, 1.6), (0, 1)]),
            _pin("power_out", "flag", "1", 0, 0, 90, 0),
        ]
    )
    return _symbol(f"{LIBRARY}:FLAG", "FLAG", hidden, body, "(power)")


def library(sheets: Sequence[Sheet]) -> str:
    """Return the symbol library with the schematic's symbols."""
    symbols = {variant(part): symbol(part) for sheet in sheets for part in sheet.parts}
    supplies = [_supply(net).replace(f'"{LIBRARY}:', '"', 1) for net in SUPPLIES]
    text = "\n".join([*(symbols[name] for name in sorted(symbols)), *supplies, _flag().replace(f'"{LIBRARY}:', '"', 1)])
    return f'(kicad_symbol_lib (version 20241209) (generator "truearm") (generator_version "9.0")\n{text}\n)\n'


# ---- sheets


@dataclass(frozen=True)
class Page:
    """How a sheet's symbols are addressed: its path of identifiers and its page number."""

    path: str
    page: int


def _property(name: str, value: str, at: tuple[float, float], hide: bool = False, justify: str = "") -> str:
    effects = (
        f"(effects (font (size 1.2 1.2)){f' (justify {justify})' if justify else ''}{' (hide yes)' if hide else ''})"
    )
    return f"  (property {quote(name)} {quote(value)} (at {place(at)} 0) {effects})"


def _instance(part: Part, page: Page, sheet: str) -> str:
    x, y = part.at
    if not part.kind.glyph:
        names = [(x, y - 0.5), (x + part.kind.width, y - 0.5)]
        justify = ["left", "right"]
        if part.kind.width < 5:
            names, justify = [(x, y - 1.2), (x, y - 0.5)], ["left", "left"]
    elif part.vertical:
        names, justify = [(x + 0.9, y + 1.0), (x + 0.9, y + 1.8)], ["left", "left"]
    else:
        names, justify = [(x + 1.5, y - 0.8), (x + 1.5, y + 1.0)], ["", ""]
    value = part.value if part.fitted else f"{part.value} (not fitted)"
    part_number = CATALOGUE[part.kind.name, part.value][1]
    lines = [
        f"(symbol (lib_id {quote(f'{LIBRARY}:{variant(part)}')}) (at {place(part.at)} 0) (unit 1) (exclude_from_sim no) "
        f"(in_bom yes) (on_board yes) (dnp {'no' if part.fitted else 'yes'}) (uuid {quote(identifier(sheet, part.ref))})",
        _property("Reference", part.ref, names[0], justify=justify[0]),
        _property("Value", value.removesuffix(" (not fitted)"), names[1], justify=justify[1]),
        _property("Footprint", footprint_of(part_number), part.at, hide=True),
        _property("Datasheet", "", part.at, hide=True),
        _property("Description", part.note, part.at, hide=True),
        _property("MPN", part_number, part.at, hide=True),
        _reference(part.ref, page),
    ]
    return "\n".join(lines) + ")"


def _reference(ref: str, page: Page) -> str:
    return f"  (instances (project {quote(NAME)} (path {quote(page.path)} (reference {quote(ref)}) (unit 1))))"


def _mark(name: str, net: str, ref: str, point: Point, page: Page) -> str:
    """Return a supply's symbol or a power flag."""
    up = 1.6 if name == "GND" else -1.1
    lines = [
        f"(symbol (lib_id {quote(f'{LIBRARY}:{name}')}) (at {place(point)} 0) (unit 1) (exclude_from_sim no) (in_bom no) "
        f"(on_board no) (dnp no) (uuid {quote(identifier(page.path, ref))})",
        _property("Reference", ref, point, hide=True),
        _property("Value", net, (point[0], point[1] + up), hide=name == "FLAG"),
        _property("Footprint", "", point, hide=True),
        _property("Datasheet", "", point, hide=True),
        _property("Description", "", point, hide=True),
        _reference(ref, page),
    ]
    return "\n".join(lines) + ")"


def _label(kind: str, net: str, point: tuple[float, float], angle: int, *names: object) -> str:
    justify = {0: "left", 90: "left", 180: "right", 270: "right"}[angle]
    shape = "(shape passive) " if kind == "global_label" else ""
    bottom = " bottom" if kind == "label" else ""
    return (
        f"({kind} {quote(net)} {shape}(at {place(point)} {angle}) "
        f"(effects (font (size 1.1 1.1)) (justify {justify}{bottom})) (uuid {quote(identifier('label', *names))}))"
    )


def sheet_file(sheet: Sheet, page: Page, shared: frozenset[str], flags: Mapping[str, str]) -> str:
    """Return one sheet. ``shared`` are nets that other sheets have too; ``flags``: net → "ref.pin" for a power flag."""
    drawn = wires(sheet)
    out = [_instance(part, page, sheet.name) for part in sheet.parts]
    used: dict[str, str] = {variant(part): symbol(part) for part in sheet.parts}
    symbols = [
        text.replace("(symbol " + quote(name), "(symbol " + quote(f"{LIBRARY}:{name}"), 1)
        for name, text in used.items()
    ]
    for a, b in drawn.segments:
        out.append(
            f"(wire (pts (xy {place(a)}) (xy {place(b)})) (stroke (width 0) (type default)) "
            f"(uuid {quote(identifier(sheet.name, 'wire', a, b))}))"
        )
    for dot in drawn.dots:
        out.append(
            f"(junction (at {place(dot)}) (diameter 0) (color 0 0 0 0) (uuid {quote(identifier(sheet.name, 'dot', dot))}))"
        )
    directions = {part.pin_at(pin): part.direction(pin) for part in sheet.parts for pin in part.nets}
    count = Counter(net for net, _ in drawn.clusters)
    supplies: set[str] = set()
    marks = 0
    for net, points in drawn.clusters:
        point, angle = _label_place(drawn.segments, points, directions)
        if net in SUPPLIES and len(points) == 1 and angle == (270 if net == "GND" else 90):
            marks += 1
            supplies.add(net)
            out.append(_mark(net, net, f"#S{page.page}{marks:02d}", next(iter(points)), page))
        else:
            across = net in shared or net in SUPPLIES
            alone = not across and count[net] == 1
            if alone:
                angle = 0 if angle in (0, 180) or len(points) > 1 else angle
            elif len(points) > 1 and point not in directions:
                angle = 90 if _is_level(drawn.segments, points, point) else 0
            kind = "label" if alone and len(points) > 1 else "global_label"
            out.append(_label(kind, net, point, angle, sheet.name, net, point))
    for part in sheet.parts:
        for pin, net in part.nets.items():
            shape = next(shape for shape in part.kind.pins if shape.number == pin)
            if net is None and shape.type != "no_connect":
                where = place(part.pin_at(pin))
                out.append(f"(no_connect (at {where}) (uuid {quote(identifier(sheet.name, 'nc', part.ref, pin))}))")
    for k, (_net, pin) in enumerate(sorted(flags.items())):
        ref, _, pin_number = pin.partition(".")
        found = next((part for part in sheet.parts if part.ref == ref), None)
        if found:
            symbols.append(_flag()) if not any('"truearm:FLAG"' in text for text in symbols) else None
            out.append(_mark("FLAG", "FLAG", f"#F{page.page}{k:02d}", found.pin_at(pin_number), page))
    for point, text in sheet.notes:
        out.append(
            f"(text {quote(text)} (exclude_from_sim no) (at {place(point)} 0) (effects (font (size 1.6 1.6)) (justify left)) "
            f"(uuid {quote(identifier(sheet.name, 'note', point))}))"
        )
    symbols += [_supply(net) for net in sorted(supplies)]
    return _file(identifier("file", sheet.name), sheet.title, symbols, out, "")


def _is_level(segments: Sequence[tuple[Point, Point]], points: frozenset[Point], point: tuple[float, float]) -> bool:
    return any(
        a[1] == b[1] == point[1] for a, b in segments if a in points and min(a[0], b[0]) <= point[0] <= max(a[0], b[0])
    )


def _short(segment: tuple[Point, Point]) -> bool:
    (x0, y0), (x1, y1) = segment
    return abs(x0 - x1) + abs(y0 - y1) <= 1


def _label_place(
    segments: Sequence[tuple[Point, Point]], points: frozenset[Point], directions: Mapping[Point, int]
) -> tuple[tuple[float, float], int]:
    """Return the position of a cluster's label: at its only pin, or midway on its longest wire, preferably a level one."""
    mine = [segment for segment in segments if segment[0] in points]
    if not mine:
        (only,) = points
        return only, directions[only]
    if len(mine) == 1 and (only := [point for point in points if point in directions]) and _short(mine[0]):
        return only[0], directions[only[0]]
    a, b = max(mine, key=lambda s: (s[0][1] == s[1][1], abs(s[0][0] - s[1][0]) + abs(s[0][1] - s[1][1]), s))
    return ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2), 0


def _file(name: str, title: str, symbols: Sequence[str], body: Sequence[str], pages: str) -> str:
    return (
        f'(kicad_sch (version {FORMAT}) (generator "truearm") (generator_version "9.0") (uuid {quote(name)}) (paper "A3")\n'
        f'(title_block (title {quote(title)}) (company "truearm: the sensor box"))\n'
        "(lib_symbols\n" + "\n".join(symbols) + "\n)\n" + "\n".join(body) + f"\n{pages})\n"
    )


def files(sheets: Sequence[Sheet], flags: Mapping[str, str]) -> dict[str, str]:
    """Return all files of the KiCad project by name: root, sheets, library, library tables, project."""
    root = identifier("root")
    where = Counter(
        net for sheet in sheets for net in {net for part in sheet.parts for net in part.nets.values()} if net
    )
    shared = frozenset(net for net, sheets_with_it in where.items() if sheets_with_it > 1)
    found = {}
    boxes = []
    for page, sheet in enumerate(sheets, start=2):
        own = identifier("sheet", sheet.name)
        found[f"{sheet.name}.kicad_sch"] = sheet_file(sheet, Page(f"/{root}/{own}", page), shared, flags)
        at = (14 + 45 * ((page - 2) % 3), 24 + 30 * ((page - 2) // 3))
        boxes.append(
            f"(sheet (at {place(at)}) (size {number(36 * GRID)} {number(18 * GRID)}) (exclude_from_sim no) (in_bom yes) (on_board yes) "
            f"(dnp no) (stroke (width 0.15) (type solid)) (fill (color 0 0 0 0)) (uuid {quote(own)})\n"
            f"{_property('Sheetname', sheet.name, (at[0], at[1] - 0.5), justify='left')}\n"
            f"{_property('Sheetfile', f'{sheet.name}.kicad_sch', (at[0], at[1] + 19), justify='left')}\n"
            f"  (instances (project {quote(NAME)} (path {quote('/' + root)} (page {quote(page)})))))"
        )
        boxes.append(
            f"(text {quote(sheet.title)} (exclude_from_sim no) (at {place((at[0] + 1, at[1] + 3))} 0) "
            f"(effects (font (size 1.4 1.4)) (justify left)) (uuid {quote(identifier('title', sheet.name))}))"
        )
    found[f"{NAME}.kicad_sch"] = _file(root, "Sheets", [], boxes, '(sheet_instances (path "/" (page "1")))\n')
    found[f"{LIBRARY}.kicad_sym"] = library(sheets)
    found["sym-lib-table"] = (
        "(sym_lib_table\n  (version 7)\n"
        f'  (lib (name "{LIBRARY}")(type "KiCad")(uri "${{KIPRJMOD}}/{LIBRARY}.kicad_sym")(options "")(descr ""))\n)\n'
    )
    libraries = sorted({footprint.partition(":")[0] for footprint in FOOTPRINTS.values()})
    lines = [
        f'  (lib (name "{name}")(type "KiCad")(uri "${{KICAD9_FOOTPRINT_DIR}}/{name}.pretty")(options "")(descr ""))\n'
        for name in libraries
    ]
    found["fp-lib-table"] = f"(fp_lib_table\n  (version 7)\n{''.join(lines)})\n"
    found[f"{NAME}.kicad_pro"] = json.dumps({"meta": {"filename": f"{NAME}.kicad_pro", "version": 3}}, indent=2) + "\n"
    return found
