"""The committed files generated from the sources: KiCad project, netlist, parts list, drawings, and tables for
hardware.md.

The tables are in docs/how-to/hardware.md.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from hardware import drawing, schematic, tables
from hardware.box import sheets
from hardware.datasheets import DATA_SHEETS
from hardware.footprints import footprint_of
from hardware.netlist import children, s_expression, text_of, to_csv
from hardware.parts import CATALOGUE
from hardware.sheet import Sheet, netlist

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "hardware" / "out"
DOCUMENT = ROOT / "docs" / "how-to" / "hardware.md"
DRAWINGS = ROOT / "docs" / "images" / "hardware"
# nets supplied from outside or through a part that KiCad does not recognise as a supply: net → a pin of it
FLAGS = {"+24V": "C3.1", "LDO_IN": "C4.1", "TI0_N": "D22.2", "TI1_N": "D23.2"}

PARTS_COLUMNS = ("quantity", "references", "value", "manufacturer", "part number", "package", "footprint", "source and date", "price")  # fmt: skip


def committed() -> dict[Path, str]:
    """Return every committed file with its text."""
    made = sheets()
    found = {OUT / name: text for name, text in schematic.files(made, FLAGS).items()}
    found[OUT / "netlist.csv"] = to_csv(netlist(made))
    found[OUT / "parts.csv"] = parts_list(made)
    found |= {DRAWINGS / f"{sheet.name}.svg": drawing.svg(sheet, _shared(made)) for sheet in made}
    found[DOCUMENT] = with_tables(DOCUMENT.read_text(encoding="utf-8"), tables.blocks(made))
    return found


def stale() -> list[Path]:
    """Return files that differ from what the sources generate."""
    return [path for path, text in committed().items() if not path.exists() or path.read_text(encoding="utf-8") != text]


def write_project(folder: Path) -> None:
    """Write the KiCad project to a folder."""
    for name, text in schematic.files(sheets(), FLAGS).items():
        (folder / name).write_text(text, encoding="utf-8")


def _shared(made: list[Sheet]) -> frozenset[str]:
    where = Counter(net for sheet in made for net in {net for part in sheet.parts for net in part.nets.values()} if net)
    return frozenset(net for net, times in where.items() if times > 1)


def parts_list(made: list[Sheet]) -> str:
    """Return one row per part number: quantity, references, value, manufacturer, part number, footprint, source, price."""
    rows: dict[tuple[str, str, bool], list[str]] = {}
    for part in (part for sheet in made for part in sheet.parts):
        rows.setdefault((part.kind.name, part.value, part.fitted), []).append(part.ref)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(PARTS_COLUMNS)
    for refs in rows.values():
        refs.sort(key=lambda ref: (ref[0], int(ref[1:])))
    for (kind, value, fitted), refs in sorted(rows.items(), key=lambda item: item[1][0]):
        maker, number = CATALOGUE[kind, value]
        quantity = str(len(refs)) if fitted else f"0 ({len(refs)} for 4-20 mA)"
        package, source = tables.package_of(number), tables.source_of(number)
        footprint = footprint_of(number)
        writer.writerow([quantity, " ".join(refs), value, maker, number, package, footprint, source, "unpriced"])
    return out.getvalue()


def with_tables(text: str, blocks: Mapping[str, str]) -> str:
    """Return a document with the blocks between its marks ``<!-- generated: NAME -->`` and ``<!-- end -->`` updated.

    Raises:
        ValueError: a mark names no block, or a block has no mark.
    """
    seen = set()

    def block(match: re.Match[str]) -> str:
        seen.add(match[1])
        return f"<!-- generated: {match[1]} -->\n\n{blocks[match[1]].strip()}\n\n<!-- end -->"

    names = set(re.findall(r"<!-- generated: (\S+) -->", text))
    if names != set(blocks):
        raise ValueError(f"marks and blocks differ: {sorted(names ^ set(blocks))}")
    return re.sub(r"<!-- generated: (\S+) -->.*?<!-- end -->", block, text, flags=re.S)


def differing_pins(libraries: Path) -> list[str]:
    """Return pins in the data sheets' tables that KiCad's own symbols number differently."""
    found = []
    for number, sheet in DATA_SHEETS.items():
        if not sheet.symbol:
            continue
        library, _, name = sheet.symbol.partition(":")
        path = libraries / f"{library}.kicad_sym"
        if not path.exists():
            found.append(f"KiCad's library {library} is missing")
            continue
        theirs = _symbol_pins(path, name)
        ours = {pin: _plain(function) for pin, function in sheet.pins.items()}
        for pin in sorted(set(ours) | set(theirs)):
            other = _plain(theirs.get(pin, "missing"))
            if other not in ("", ours.get(pin)) and {other, ours.get(pin)} not in SAME_PINS:
                found.append(f"{number} pin {pin}: {ours.get(pin)} here, {other} in KiCad's {sheet.symbol}")
    return found


# names with the same meaning
SAME_PINS = [
    {"+A", "+"}, {"-A", "-"}, {"+B", "+"}, {"-B", "-"}, {"GP26", "GPIO26ADC0"}, {"GP27", "GPIO27ADC1"}, {"GP28", "GPIO28ADC2"},
    {"V+", "VCC"}, {"K2", "K"}, {"A1", "A"}, {"MID", "COM"}, {"OUTA", ""}, {"OUTB", ""},
    *({f"GP{n}", f"GPIO{n}"} for n in range(29)),
]  # fmt: skip


def _plain(name: str) -> str:
    return re.sub(r"[~{}_]", "", name)


def _symbol_pins(path: Path, name: str) -> dict[str, str]:
    root = s_expression(path.read_text(encoding="utf-8"))
    symbols = {symbol[1]: symbol for symbol in children(root, "symbol")}
    symbol = symbols[name]
    base = text_of(symbol, "extends")
    found = {}
    for unit in children(symbols[base] if base else symbol, "symbol"):
        for pin in children(unit, "pin"):
            found[text_of(pin, "number")] = text_of(pin, "name")
    return found
