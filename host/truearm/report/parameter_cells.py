"""A parameter of a result as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from truearm.text import one_line
from truearm.units import UNITS, number


def parameter_cells(parameter: Mapping[str, Any]) -> tuple[str, ...]:
    """Return name, nominal, value, change, sigma and unit of a parameter as text, in mm, deg or 1."""
    unit = UNITS[parameter["unit"]]
    nominal, value, sigma = (parameter[key] for key in ("nominal", "value", "sigma"))
    if parameter["unit"] == "s" and sigma is None:
        value = None  # an unidentifiable time offset may have any value
    change = value - nominal if None not in (nominal, value) else None
    numbers = ["-" if v is None else number(v, unit.si) for v in (nominal, value)]
    numbers.append("-" if change is None else f"{unit.scale.of(change):+.{unit.decimals}f}")
    numbers.append("unidentifiable" if sigma is None else f"{unit.scale.of(sigma):.2g}")
    return (one_line(parameter["name"]), *numbers, unit.symbol)
