"""Check every part number against its value and against what the circuit needs (hardware/part_needs.txt).

Independent of the generator: hardware/part_numbers.py decodes the number by its manufacturer's ordering code.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from hardware.netlist import Component, Netlist, quantity
from hardware.part_numbers import Rating, decode

NEEDS = Path(__file__).resolve().parent / "part_needs.txt"
VALUED = ("R", "C", "FUSE", "BEAD")


@dataclass(frozen=True)
class Need:
    """What the circuit needs of a part: package, highest tolerance, lowest ratings [W, V, A], dielectric."""

    package: str
    tolerance: float | None = None
    watts: float = 0.0
    volts: float = 0.0
    amperes: float = 0.0
    dielectric: str = ""


@cache
def read_needs() -> dict[tuple[str, str], Need]:
    """Return kind and value → need. Raises ValueError for a line that is not one."""
    found = {}
    for line in NEEDS.read_text(encoding="utf-8").splitlines():
        if not line or line.startswith("#"):
            continue
        fields = [field.strip() for field in line.split("|")]
        if len(fields) != 4:
            raise ValueError(f"{NEEDS.name}: {line!r} has {len(fields)} fields, not 4")
        kind, value, package, words = fields
        need: dict[str, float | str] = {}
        for word in words.split():
            match = re.fullmatch(r"([0-9.]+)([%WVA])", word)
            if match:
                name = {"%": "tolerance", "W": "watts", "V": "volts", "A": "amperes"}[match[2]]
                need[name] = float(match[1]) / (100 if match[2] == "%" else 1)
            else:
                need["dielectric"] = word
        found[kind, value] = Need(package, **need)  # type: ignore[arg-type]
    return found


def findings(netlist: Netlist) -> list[str]:
    """Return, in words, every part number that is unknown or is not what its value and the circuit need."""
    return [text for part in netlist.components.values() for text in part_findings(part)]


def part_findings(part: Component) -> list[str]:
    """Return the findings of one part."""
    rating = decode(part.mpn)
    what = f"{part.ref} ({part.value}): {part.mpn}"
    if rating is None:
        return [f"{what} is in no ordering code or table of hardware/part_numbers.py"]
    need = read_needs().get((rating.kind, part.value))
    if need is None:
        return [f"{what} is a {rating.kind}; hardware/part_needs.txt has none with this value"]
    return [f"{what} {text}" for text in (*_value(part, rating), *_needs(need, rating))]


def _value(part: Component, rating: Rating) -> list[str]:
    if rating.kind in VALUED:
        wanted = quantity(part.value)
        return [] if abs(rating.value / wanted - 1) < 1e-6 else [f"is {rating.value:g}, not {wanted:g}"]
    # the number of a TVS or a diode is its value; only the ratings of a bead have no other name
    name = part.mpn if rating.kind.startswith("TVS") else rating.part
    return [] if name == part.value else [f"is {name}"]


def _needs(need: Need, rating: Rating) -> list[str]:
    found = []
    if rating.package != need.package:
        found.append(f"has package {rating.package}, not {need.package}")
    if need.tolerance is not None and rating.tolerance > need.tolerance + 1e-9:
        found.append(f"has a tolerance of {rating.tolerance:.2%}, {need.tolerance:.2%} is needed")
    if need.dielectric and rating.dielectric != need.dielectric:
        found.append(f"is {rating.dielectric}, not {need.dielectric}")
    for name, unit in (("watts", "W"), ("volts", "V"), ("amperes", "A")):
        have, least = getattr(rating, name), getattr(need, name)
        if have < least - 1e-9:
            found.append(f"has {have:g} {unit}, {least:g} {unit} are needed")
    return found
