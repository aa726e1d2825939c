"""Units: what a number is called in files, how a person sees it, and how large it can sensibly be.

SI inside, always. A *unit* here is an SI unit, the key of ``UNITS``; a *suffix* is what stands at the end of a name in a
file (``length_mm``, ``q1_deg``, ``qd1_deg_s``), the key of ``SUFFIXES``. Every number that a person sees gets its
factor, its symbol and its digits from here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Unit:
    """An SI unit and how it meets people.

    ``shown = factor · SI``. ``decimals``: of a value with its standard deviation. ``largest``: beyond this [SI] a number was
    written in another unit. ``weak_sigma`` and ``wide_sigma``: σ [SI] of what a drawing says, and of what a hand leaves
    (``estimate.prior``); a parameter that is known less well than ``weak_sigma`` is hardly seen.
    """

    si: str
    symbol: str
    factor: float
    decimals: int
    largest: float
    weak_sigma: float = math.nan
    wide_sigma: float = math.nan


@dataclass(frozen=True)
class Suffix:
    """The end of a name in a file; ``value_si = scale · value``."""

    si: str
    scale: float


DEGREE = math.pi / 180.0

UNITS: Mapping[str, Unit] = {
    unit.si: unit
    for unit in (
        Unit("m", "mm", 1e3, 4, 100.0, 1e-3, 1e-2),
        Unit("rad", "deg", 1.0 / DEGREE, 5, 20.0 * math.pi, 5e-3, 0.052),
        Unit("1", "", 1.0, 6, 100.0, 1e-3, 1e-2),
        Unit("s", "ms", 1e3, 4, 100.0, 1e-3),
        Unit("m/s", "mm/s", 1e3, 3, 100.0),
        Unit("rad/s", "deg/s", 1.0 / DEGREE, 4, 20.0 * math.pi),
    )
}
SUFFIXES: Mapping[str, Suffix] = {
    "m": Suffix("m", 1.0),
    "cm": Suffix("m", 1e-2),
    "mm": Suffix("m", 1e-3),
    "um": Suffix("m", 1e-6),
    "in": Suffix("m", 25.4e-3),
    "rad": Suffix("rad", 1.0),
    "deg": Suffix("rad", DEGREE),
    "s": Suffix("s", 1.0),
    "ms": Suffix("s", 1e-3),
    "m_s": Suffix("m/s", 1.0),
    "mm_s": Suffix("m/s", 1e-3),
    "rad_s": Suffix("rad/s", 1.0),
    "deg_s": Suffix("rad/s", DEGREE),
}


def suffixes(
    si: str, of: Iterable[str] = ("m", "mm", "rad", "deg", "s", "ms", "m_s", "mm_s", "rad_s", "deg_s")
) -> dict[str, float]:
    """The suffixes ``of`` that a quantity in an SI unit may have, each with the factor that makes it SI; SI's own first."""
    return {name: SUFFIXES[name].scale for name in of if SUFFIXES[name].si == si}


def shown(value: Any, si: str) -> Any:
    """A value, or an array of them, in the unit that a person sees: metres become millimetres."""
    return UNITS[si].factor * value


def from_shown(value: Any, si: str) -> Any:
    """The inverse of ``shown``."""
    return value / UNITS[si].factor


def symbol(si: str) -> str:
    """The symbol of the unit that a person sees: "mm" for "m"."""
    return UNITS[si].symbol


def number(value: float, si: str, decimals: int | None = None) -> str:
    """A value as text without its unit, for a column whose title has it; "-" where it is not finite."""
    if not math.isfinite(value):
        return "-"
    return f"{shown(value, si):.{UNITS[si].decimals if decimals is None else decimals}f}"


def quantity(value: float, si: str, decimals: int | None = None) -> str:
    """A value as text with its unit: "0.0855 mm"."""
    return f"{number(value, si, decimals)} {symbol(si)}".rstrip()


def title(text: str, si: str) -> str:
    """A column's title with its unit: "error [mm]"."""
    return f"{text} [{symbol(si)}]" if symbol(si) else text
