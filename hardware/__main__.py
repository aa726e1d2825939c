"""python -m hardware make | check | get: generate the committed files, check the circuit, download KiCad and ngspice."""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from pathlib import Path

from hardware import footprints, kicad, outputs, part_check, spice_check
from hardware.box import sheets
from hardware.netlist import Netlist, from_kicad
from hardware.netlist_check import findings
from hardware.parts import CATALOGUE
from hardware.schematic import NAME
from hardware.sheet import netlist

# ERC findings that are allowed: (type, words in it, reason). None is needed.
WAIVERS: tuple[tuple[str, str, str], ...] = ()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m hardware", description=__doc__)
    parser.add_argument("command", choices=("make", "check", "get"))
    command = parser.parse_args().command
    if command == "make":
        return make()
    if command == "check":
        return check()
    try:
        kicad.get()
    except kicad.NoTools as error:
        print(f"hardware: no KiCad and ngspice: {error}", file=sys.stderr)
        return 3
    return 0


def make() -> int:
    """Write hardware/out and the generated parts of docs/how-to/hardware.md."""
    for path, text in outputs.committed().items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(f"wrote {path.relative_to(outputs.ROOT)}")
    return 0


def check() -> int:
    """Run all checks. Returns 0 if all pass, 1 if one fails, 3 if those that need KiCad or ngspice could not be run."""
    made = netlist(sheets())
    failed = [f"netlist: {text}" for text in findings(made)]
    failed += [f"part number: {text}" for text in part_check.findings(made)]
    failed += [
        f"{path.relative_to(outputs.ROOT)} is not what python -m hardware make writes" for path in outputs.stale()
    ]
    print(f"netlist: {len(made.components)} parts, {len(made.nets())} nets; {len(failed)} findings")
    try:
        tools = kicad.get()
    except kicad.NoTools as error:
        print("\n".join(failed))
        print(f"hardware: ERC and SPICE were not run: {error}", file=sys.stderr)
        return 1 if failed else 3
    failed += [*erc(tools), *same_netlist(tools, made), *same_pins(tools), *fitting_footprints(tools)]
    rows = spice_check.check(tools, made)
    for row in rows:
        print(f"{'ok  ' if row.passed else 'FAIL'} {row.what}: {row.measured} (wanted: {row.wanted})")
    failed += [f"SPICE: {row.what}: {row.measured}, wanted {row.wanted}" for row in rows if not row.passed]
    print("\n".join(failed) if failed else f"hardware: all checks passed, {len(rows)} of them simulated")
    return 1 if failed else 0


def erc(tools: kicad.Tools) -> list[str]:
    """Return the findings of KiCad's electrical rules check that no waiver covers, including warnings."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        outputs.write_project(folder)
        done = tools.run_kicad(
            "sch", "erc", "--severity-all", "--format", "report", "-o", "erc.txt", f"{NAME}.kicad_sch", folder=folder
        )
        if not (folder / "erc.txt").exists():
            return [f"ERC did not run: {(done.stdout + done.stderr).strip()[-300:]}"]
        text = (folder / "erc.txt").read_text(encoding="utf-8")
    found = re.findall(r"^\[(\w+)\]: (.*?)(?=^\[|^\*\*\*|^ \*\* |\Z)", text, re.M | re.S)
    kept = [
        f"ERC: {kind}: {' '.join(words.split())}"
        for kind, words in found
        if not any(kind == waived and part in words for waived, part, _ in WAIVERS)
    ]
    print(f"ERC: {len(found)} findings, {len(found) - len(kept)} waived")
    return kept


def same_netlist(tools: kicad.Tools, made: Netlist) -> list[str]:
    """Check that KiCad reads the same netlist from the schematic as the other checks used."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        outputs.write_project(folder)
        tools.run_kicad(
            "sch", "export", "netlist", "--format", "kicadsexpr", "-o", "box.net", f"{NAME}.kicad_sch", folder=folder
        )
        read = from_kicad((folder / "box.net").read_text(encoding="utf-8"))
    found = []
    if read.groups() != made.groups():
        found.append(f"KiCad joins other pins: {sorted(map(sorted, read.groups() ^ made.groups()))[:4]}")
    if read.components != made.components:
        found.append("KiCad lists other parts")
    return found


def same_pins(tools: kicad.Tools) -> list[str]:
    """Compare the pins of hardware/datasheets.py with the symbols of KiCad's own libraries, which others wrote."""
    return outputs.differing_pins(tools.symbols)


def fitting_footprints(tools: kicad.Tools) -> list[str]:
    """Compare every part's footprint with its pins and its package's dimensions."""
    parts = [(part, CATALOGUE[part.kind.name, part.value][1]) for sheet in sheets() for part in sheet.parts]
    return footprints.findings(tools.footprints, parts)


if __name__ == "__main__":
    sys.exit(main())
