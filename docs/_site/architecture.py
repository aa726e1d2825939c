"""The picture of docs/explanation/code_flow.md, made from the imports: ``python docs/_site/architecture.py`` writes it.

A box is a room: a folder of host/truearm (or a single module that is one), the wire, the simulator, the firmware. An arrow is an import. Imports that
follow from others (a → c beside a → b → c) are left out, as are the modules that every room may use.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
HOST = ROOT / "host" / "truearm"
OUTSIDE = {
    "truearm_wire": "protocol/truearm_wire",
    "truearm_sim": "hil_sim/truearm_sim",
    "firmware": "firmware/truearm_box",
}
WIDTH, ROW, BOX, HEIGHT = 760, 64, 104, 30


def rooms() -> dict[str, list[Path]]:
    """The files of each room."""
    found = {
        path.name: sorted(path.rglob("*.py")) for path in sorted(HOST.iterdir()) if (path / "__init__.py").exists()
    }
    found["api"] = [HOST / "api.py"]
    return found | {name: sorted((ROOT / folder).rglob("*.py")) for name, folder in OUTSIDE.items()}


def imported(path: Path, names: set[str]) -> set[str]:
    """The rooms that a file imports by their full names, as all files here do."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        modules = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for parts in (module.split(".") for module in modules):
            found |= {parts[1]} & names if parts[0] == "truearm" and len(parts) > 1 else {parts[0]} & names
    return found


@cache
def imports() -> dict[str, set[str]]:
    """Which rooms each room imports."""
    files = rooms()
    return {
        room: set().union(*(imported(path, set(files)) for path in paths)) - {room} for room, paths in files.items()
    }


def reached(graph: dict[str, set[str]], room: str) -> set[str]:
    """All rooms that a room imports, itself or through others."""
    return set().union(*({below} | reached(graph, below) for below in graph[room]))


def direct(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """The imports that do not follow from others."""
    return {
        room: {b for b in below if not any(b in reached(graph, other) for other in below - {b})}
        for room, below in graph.items()
    }


def levels(graph: dict[str, set[str]]) -> dict[str, int]:
    """How many rooms lie below each, one on the other."""

    def level(room: str) -> int:
        return max((1 + level(below) for below in graph[room]), default=0)

    return {room: level(room) for room in graph}


def picture() -> str:
    """The SVG."""
    graph = imports()
    level = levels(graph)
    top = max(level.values())
    rows = [sorted(room for room in graph if level[room] == number) for number in range(top, -1, -1)]
    place = {
        room: (WIDTH * (column + 0.5) / len(row), 24 + ROW * number)
        for number, row in enumerate(rows)
        for column, room in enumerate(row)
    }
    height = 24 + ROW * top + HEIGHT + 24
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" font-family="sans-serif" font-size="13">',
        "<title>Which part of the code imports which</title>",
        '<defs><marker id="a" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0 8 4 0 8z" fill="#888"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>',
    ]
    for room, below in sorted(direct(graph).items()):
        for other in sorted(below):
            (x1, y1), (x2, y2) = place[room], place[other]
            bend = y1 + HEIGHT + 0.5 * (y2 - y1 - HEIGHT)
            curve = f"M{x1:.0f} {y1 + HEIGHT} C{x1:.0f} {bend:.0f} {x2:.0f} {bend:.0f} {x2:.0f} {y2}"
            lines.append(f'<path d="{curve}" fill="none" stroke="#888" marker-end="url(#a)"/>')
    for room, (x, y) in sorted(place.items()):
        colour = "#fff3e0" if room in OUTSIDE else "#e0f2f1"
        lines.append(
            f'<rect x="{x - BOX / 2:.0f}" y="{y}" width="{BOX}" height="{HEIGHT}" rx="4" fill="{colour}" stroke="#00695c"/>'
        )
        lines.append(f'<text x="{x:.0f}" y="{y + 20}" text-anchor="middle">{room}</text>')
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
