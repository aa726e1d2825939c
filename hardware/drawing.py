"""The sheets as SVG, drawn from the same positions as the KiCad schematic. Uses only the standard library."""

from __future__ import annotations

from collections import Counter
from html import escape

from hardware.schematic import GLYPHS
from hardware.sheet import SUPPLIES, Part, Point, Sheet, wires

UNIT = 10  # pixels per grid unit
PER_MM = UNIT / 2.54
NOTE_LETTER = 0.62  # grid units: the width of a letter of a note at most, on average over a sentence
STYLE = (
    "text{font:8px sans-serif;fill:#222}.n{font-size:11px;fill:#245}.p{fill:#777;font-size:6.5px}.l{fill:#830;font-size:7.5px}"
    ".w{stroke:#063;fill:none}.s{stroke:#222;fill:none}.b{stroke:#222;fill:#fffbe8}.d{fill:#063}.e{opacity:.45}"
)


def svg(sheet: Sheet, shared: frozenset[str]) -> str:
    """Return one sheet. Nets in ``shared`` are also on other sheets and always show their name."""
    drawn = wires(sheet)
    out = []
    for a, b in drawn.segments:
        out.append(f'<path class="w" d="M{_xy(a)}L{_xy(b)}"/>')
    out += [f'<circle class="d" cx="{x * UNIT}" cy="{y * UNIT}" r="2"/>' for x, y in drawn.dots]
    for part in sheet.parts:
        out += _part(part)
    directions = {part.pin_at(pin): part.direction(pin) for part in sheet.parts for pin in part.nets}
    count = Counter(net for net, _ in drawn.clusters)
    for net, points in drawn.clusters:
        if len(points) > 1 and count[net] == 1 and net not in shared:
            continue
        ends = [point for point in points if point in directions]
        point = min(ends, key=lambda p: (p[0], p[1])) if len(points) > 1 else ends[0]
        out += _name(net, point, directions[point], on_wire=len(points) > 1)
    for point, text in sheet.notes:
        out.append(f'<text class="n" x="{point[0] * UNIT}" y="{point[1] * UNIT}">{escape(text)}</text>')
    xs = [p[0] for part in sheet.parts for p in (part.pin_at(pin) for pin in part.nets)]
    ys = [p[1] for part in sheet.parts for p in (part.pin_at(pin) for pin in part.nets)] + [
        p[1] for p, _ in sheet.notes
    ]
    x0, y0 = (min(xs) - 9) * UNIT, (min(ys) - 5) * UNIT
    right = max(max(xs) + 11, *(round(p[0] + NOTE_LETTER * len(text)) + 1 for p, text in sheet.notes))
    width, height = right * UNIT - x0, (max(ys) + 5) * UNIT - y0
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{x0} {y0} {width} {height}" role="img">\n'
        f"<title>{escape(sheet.title)}</title>\n<style>{STYLE}</style>\n"
        f'<rect x="{x0}" y="{y0}" width="{width}" height="{height}" fill="#fff"/>\n' + "\n".join(out) + "\n</svg>\n"
    )


def _xy(point: Point | tuple[float, float]) -> str:
    return f"{point[0] * UNIT:g} {point[1] * UNIT:g}"


def _part(part: Part) -> list[str]:
    x, y = part.at
    faint = "" if part.fitted else " e"
    if not part.kind.glyph:
        width, height = part.kind.width * UNIT, (part.kind.rows + 1) * UNIT
        found = [f'<rect class="b" x="{x * UNIT}" y="{y * UNIT}" width="{width}" height="{height}"/>']
        found.append(f'<text x="{x * UNIT}" y="{y * UNIT - 3}">{part.ref} {escape(part.value)}</text>')
        for pin in part.kind.pins:
            px, py = part.pin_at(pin.number)
            left = pin.side == "L"
            inner = px + 1 if left else px - 1
            found.append(f'<path class="s" d="M{_xy((px, py))}L{_xy((inner, py))}"/>')
            anchor, shift = ("start", 2) if left else ("end", -2)
            if pin.name != pin.number:
                found.append(
                    f'<text class="p" x="{inner * UNIT + shift}" y="{py * UNIT + 2.5}" text-anchor="{anchor}">{escape(pin.name)}</text>'
                )
            found.append(
                f'<text class="p" x="{(px + inner) / 2 * UNIT:g}" y="{py * UNIT - 1.5}" text-anchor="middle">{pin.number}</text>'
            )
        return found
    lead, lines = GLYPHS[part.kind.glyph]
    lines = [*lines, [(0.0, 0.0), (lead, 0.0)], [(7.62 - lead, 0.0), (7.62, 0.0)]]
    found = []
    for line in lines:
        points = []
        for t, s in line:
            t = 7.62 - t if part.flip else t
            dx, dy = (s, t) if part.vertical else (t, s)
            points.append(f"{x * UNIT + dx * PER_MM:.1f} {y * UNIT + dy * PER_MM:.1f}")
        found.append(f'<path class="s{faint}" d="M{"L".join(points)}"/>')
    value = part.value if part.fitted else f"{part.value} (empty)"
    if part.vertical:
        found.append(f'<text x="{x * UNIT + 8}" y="{y * UNIT + 13}">{part.ref}</text>')
        found.append(f'<text x="{x * UNIT + 8}" y="{y * UNIT + 22}">{escape(value)}</text>')
    else:
        found.append(f'<text x="{x * UNIT + 15}" y="{y * UNIT - 6}" text-anchor="middle">{part.ref}</text>')
        found.append(f'<text x="{x * UNIT + 15}" y="{y * UNIT + 13}" text-anchor="middle">{escape(value)}</text>')
    return found


def _name(net: str, point: Point, direction: int, on_wire: bool) -> list[str]:
    x, y = point[0] * UNIT, point[1] * UNIT
    if net == "GND" and direction == 270:
        return [f'<path class="s" d="M{x} {y}v3m-5 0h10m-8 3h6m-4 3h2"/>']
    if net in SUPPLIES and direction == 90:
        return [
            f'<path class="s" d="M{x} {y}v-4m-5 0h10"/>',
            f'<text class="l" x="{x}" y="{y - 6}" text-anchor="middle">{escape(net)}</text>',
        ]
    if on_wire and direction != 180:
        return [f'<text class="l" x="{x + 2}" y="{y - 2}">{escape(net)}</text>']
    anchor, dx, dy = {0: ("start", 2, 3), 180: ("end", -2, 3), 90: ("middle", 0, -3), 270: ("middle", 0, 9)}[direction]
    return [f'<text class="l" x="{x + dx}" y="{y + dy}" text-anchor="{anchor}">{escape(net)}</text>']
