"""The footprint of every part, from KiCad's own libraries, and the check that it fits the part.

A footprint follows from what the part number says (hardware/part_numbers.py): kind and package. Where KiCad has pads for
soldering by hand, they are used. The check compares KiCad's files with the pins of the symbols and with BODIES, dimensions
of the packages that were not taken from KiCad.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from hardware.netlist import children, s_expression
from hardware.part_numbers import Rating, decode
from hardware.sheet import Part

FOOTPRINTS = {
    ("R", "0805"): "Resistor_SMD:R_0805_2012Metric_Pad1.20x1.40mm_HandSolder",
    ("R", "1206"): "Resistor_SMD:R_1206_3216Metric_Pad1.30x1.75mm_HandSolder",
    ("R", "axial RS02B"): "Resistor_THT:R_Axial_DIN0516_L15.5mm_D5.0mm_P20.32mm_Horizontal",
    ("C", "0805"): "Capacitor_SMD:C_0805_2012Metric_Pad1.18x1.45mm_HandSolder",
    ("C", "1206"): "Capacitor_SMD:C_1206_3216Metric_Pad1.33x1.80mm_HandSolder",
    ("C", "1210"): "Capacitor_SMD:C_1210_3225Metric_Pad1.33x2.70mm_HandSolder",
    ("FUSE", "1812"): "Fuse:Fuse_1812_4532Metric_Pad1.30x3.40mm_HandSolder",
    ("FUSE", "2920"): "Fuse:Fuse_2920_7451Metric_Pad2.10x5.45mm_HandSolder",
    ("BEAD", "0805"): "Inductor_SMD:L_0805_2012Metric_Pad1.05x1.20mm_HandSolder",
    ("DIODE", "SMA"): "Diode_SMD:D_SMA_Handsoldering",
    ("DIODE", "SMC"): "Diode_SMD:D_SMC_Handsoldering",
    ("TVS", "SMA"): "Diode_SMD:D_SMA_Handsoldering",
    ("TVS_BOTH", "SMA"): "Diode_SMD:D_SMA_Handsoldering",
    ("CHIP", "SOT-23"): "Package_TO_SOT_SMD:SOT-23_Handsoldering",
    ("CHIP", "SOT-23-5"): "Package_TO_SOT_SMD:SOT-23-5_HandSoldering",
    ("CHIP", "SOT-223"): "Package_TO_SOT_SMD:SOT-223",
    # JEITA's land pattern leaves 3.8 mm under a coupler, KiCad's other one 3.0 mm
    ("CHIP", "SOIC-8"): "Package_SO:JEITA_SOIC-8_3.9x4.9mm_P1.27mm",
    ("CHIP", "VSSOP-10"): "Package_SO:VSSOP-10_3x3mm_P0.5mm",
    ("CHIP", "TSSOP-20"): "Package_SO:TSSOP-20_4.4x6.5mm_P0.65mm",
    ("CHIP", "DIP-4"): "Package_DIP:DIP-4_W7.62mm",
    ("CHIP", "module"): "Module:RaspberryPi_Pico_Common_THT",
    **{
        (f"TERMINAL {ways}", "5.08 mm"): f"TerminalBlock_Phoenix:TerminalBlock_Phoenix_MKDS-1,5-{ways}-5.08_1x{ways:02}_P5.08mm_Horizontal"
        for ways in (2, 3, 5, 6, 7)
    },
}  # fmt: skip

# two terminals: length of the body or, with leads, from the end of one to the end of the other; mm. The pads must lie under
# the ends: no gap as wide as the part, no pad that it does not reach. From the sizes' names and the data sheets of SMA and SMC.
LENGTHS = {"0805": 2.0, "1206": 3.2, "1210": 3.2, "1812": 4.5, "2920": 7.4, "SMA": 5.1, "SMC": 7.9}
# length of an axial body, from memory of Vishay's 30204 (14.2 mm, 15.8 mm at most): its wires need 2 mm at each end to bend
AXIAL = {"axial RS02B": 15.8}
# everything else: smallest distance of two pads' centres, mm (JEDEC's pitches; 2.54 mm of headers and DIP; 5.08 mm of terminals)
PITCHES = {
    "SOT-23": 1.9,
    "SOT-23-5": 0.95,
    "SOT-223": 2.3,
    "SOIC-8": 1.27,
    "VSSOP-10": 0.5,
    "TSSOP-20": 0.65,
    "DIP-4": 2.54,
    "module": 2.54,
    "5.08 mm": 5.08,
}


@dataclass(frozen=True)
class Pad:
    """A pad: its number, centre and size in mm."""

    number: str
    x: float
    y: float
    width: float
    height: float


def footprint_of(part_number: str) -> str:
    """Return "library:name". Raises KeyError for a part number or a package that is not known."""
    rating = decode(part_number)
    if rating is None:
        raise KeyError(part_number)
    return FOOTPRINTS[_kind(rating), rating.package]


def _kind(rating: Rating) -> str:
    return f"TERMINAL {rating.value:.0f}" if rating.kind == "TERMINAL" else rating.kind


def read_pads(libraries: Path, footprint: str) -> list[Pad]:
    """Return the numbered pads of a footprint of KiCad's. Raises FileNotFoundError if there is none of this name."""
    library, _, name = footprint.partition(":")
    root = s_expression((libraries / f"{library}.pretty" / f"{name}.kicad_mod").read_text(encoding="utf-8"))
    found = []
    for pad in children(root, "pad"):
        at, size = next(children(pad, "at")), next(children(pad, "size"))
        if pad[1]:
            found.append(Pad(pad[1], float(at[1]), float(at[2]), float(size[1]), float(size[2])))
    return found


def findings(libraries: Path, parts: Iterable[tuple[Part, str]]) -> list[str]:
    """Return, in words, what does not fit: footprints that do not exist, other pads than pins, other dimensions.

    ``parts`` are the parts with their part numbers.
    """
    found = []
    for part, number in parts:
        footprint = footprint_of(number)
        try:
            pads = read_pads(libraries, footprint)
        except FileNotFoundError:
            found.append(f"{part.ref}: KiCad has no footprint {footprint}")
            continue
        pins = {pin.number for pin in part.kind.pins}
        if {pad.number for pad in pads} != pins:
            found.append(
                f"{part.ref}: {footprint} has the pads {sorted(pad.number for pad in pads)}, not {sorted(pins)}"
            )
        rating = decode(number)
        assert rating is not None
        found += [f"{part.ref}: {footprint} {text}" for text in misfits(rating.package, pads)]
    return found


def misfits(package: str, pads: list[Pad]) -> list[str]:
    """Return, in words, the dimensions that are not the package's."""
    if package in PITCHES:
        pitch = min(math.dist((a.x, a.y), (b.x, b.y)) for a, b in combinations(pads, 2))
        return (
            [] if abs(pitch - PITCHES[package]) < 0.011 else [f"has a pitch of {pitch:.2f} mm, not {PITCHES[package]}"]
        )
    a, b = pads
    between = abs(a.x - b.x)
    if package in AXIAL:
        least = AXIAL[package] + 4
        return [] if between >= least else [f"has {between:.2f} mm between its holes; {least:.1f} mm are needed"]
    length, gap, span = LENGTHS[package], between - a.width, between + a.width
    return (
        []
        if gap < 0.8 * length < length < span
        else [f"has pads from {gap:.2f} to {span:.2f} mm, the part {length} mm"]
    )


def gap_across(pads: Iterable[Pad], side: set[str]) -> float:
    """Return the least distance [mm] of the pads in ``side`` from the others: bare board under an isolator."""
    pads = list(pads)
    return min(
        math.hypot(
            max(0.0, abs(a.x - b.x) - (a.width + b.width) / 2), max(0.0, abs(a.y - b.y) - (a.height + b.height) / 2)
        )
        for a in pads
        for b in pads
        if a.number in side and b.number not in side
    )
