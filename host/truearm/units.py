"""Units: the names of numbers in files, their display, and their plausible size.

All values inside truearm are in SI units. A ``Unit`` is an SI unit, a ``Scale`` is a unit for people and files (``mm``
for metres). Every displayed number gets its factor, its symbol and its digits from here: ``number(length, "m")`` and
``title("error", "m")`` for the usual unit, ``UM.text(noise, ".1f")`` for a specific one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Scale:
    """A unit for people and files: ``value_si = scale · value``, and ``factor`` its inverse: 1000.0 for millimetres.

    Both are given, since 1/1e-9 is not 1e9 in floating point.

    ``suffix`` is at the end of a name in a file (``length_mm``, ``qd1_deg_s``), ``symbol`` follows a displayed number.
    """

    suffix: str
    symbol: str
    si: str
    scale: float
    factor: float

    def of(self, value_si: Any) -> Any:
        """Return an SI value, or an array of them, in this unit."""
        return self.factor * value_si

    def to_si(self, value: Any) -> Any:
        """Return a value in this unit, or an array of them, in SI."""
        return self.scale * value

    def text(self, value_si: float, spec: str = "g") -> str:
        """Return an SI value as text in this unit, with the symbol: ``UM.text(2e-6, ".1f")`` is "2.0 µm"."""
        return f"{self.of(value_si):{spec}} {self.symbol}".rstrip()


DEGREE = math.pi / 180.0
SMALLEST = 1e-9  # [SI] a smaller length, angle or standard deviation is an error: no instrument resolves a nanometre or nanoradian

M = Scale("m", "m", "m", 1.0, 1.0)
CM = Scale("cm", "cm", "m", 1e-2, 1e2)
MM = Scale("mm", "mm", "m", 1e-3, 1e3)
UM = Scale("um", "µm", "m", 1e-6, 1e6)
INCH = Scale("in", "in", "m", 25.4e-3, 1.0 / 25.4e-3)
RAD = Scale("rad", "rad", "rad", 1.0, 1.0)
DEG = Scale("deg", "deg", "rad", DEGREE, 1.0 / DEGREE)
MRAD = Scale("mrad", "mrad", "rad", 1e-3, 1e3)
URAD = Scale("urad", "µrad", "rad", 1e-6, 1e6)
ONE = Scale("", "", "1", 1.0, 1.0)
PPM = Scale("ppm", "ppm", "1", 1e-6, 1e6)
S = Scale("s", "s", "s", 1.0, 1.0)
MS = Scale("ms", "ms", "s", 1e-3, 1e3)
US = Scale("us", "µs", "s", 1e-6, 1e6)
NS = Scale("ns", "ns", "s", 1e-9, 1e9)
M_S = Scale("m_s", "m/s", "m/s", 1.0, 1.0)
MM_S = Scale("mm_s", "mm/s", "m/s", 1e-3, 1e3)
M_S2 = Scale("m_s2", "m/s²", "m/s2", 1.0, 1.0)
RAD_S = Scale("rad_s", "rad/s", "rad/s", 1.0, 1.0)
DEG_S = Scale("deg_s", "deg/s", "rad/s", DEGREE, 1.0 / DEGREE)
DEGC = Scale("degc", "°C", "degc", 1.0, 1.0)  # temperatures stay in °C: only their differences enter computations
MDEGC = Scale("mdegc", "m°C", "degc", 1e-3, 1e3)
KG = Scale("kg", "kg", "kg", 1.0, 1.0)
PER_K = Scale("per_k", "1/K", "1/K", 1.0, 1.0)
PPM_PER_K = Scale("ppm_per_k", "ppm/K", "1/K", 1e-6, 1e6)


def micro(si: str) -> Scale:
    """Return the millionth of a unit that is not in SUFFIXES, such as a volt."""
    return Scale(f"u{si}", f"µ{si}", si, 1e-6, 1e6)


@dataclass(frozen=True)
class Unit:
    """An SI unit and its display.

    ``own``: the SI unit as a scale. ``scale``: its display unit. Keys and columns of files may be written in either.
    ``decimals``: of a value with its standard deviation. ``largest``: a larger number [SI] was written in another unit.
    ``weak_sigma`` and ``wide_sigma``: σ [SI] of a drawing, and of manual mounting (``estimate.uncertainty``); a
    parameter known less well than ``weak_sigma`` is hardly identifiable. ``vague_sigma``: σ [SI] that represents no
    knowledge where a plan needs a finite one. ``others``: further scales that only some files or displays have.
    """

    own: Scale
    scale: Scale
    decimals: int
    largest: float
    weak_sigma: float = math.nan
    wide_sigma: float = math.nan
    vague_sigma: float = 1.0
    others: tuple[Scale, ...] = ()

    @property
    def si(self) -> str:
        return self.own.si

    @property
    def symbol(self) -> str:
        return self.scale.symbol

    @property
    def factor(self) -> float:
        return self.scale.factor


UNITS: Mapping[str, Unit] = {
    unit.si: unit
    for unit in (
        Unit(M, MM, 4, 100.0, 1e-3, 1e-2, others=(CM, UM, INCH)),
        Unit(RAD, DEG, 5, 20.0 * math.pi, 5e-3, 0.052, others=(MRAD, URAD)),
        Unit(ONE, ONE, 6, 100.0, 1e-3, 1e-2, 1e-2, others=(PPM,)),
        Unit(S, MS, 4, 100.0, 1e-3, others=(US, NS)),
        Unit(M_S, MM_S, 3, 100.0),
        Unit(RAD_S, DEG_S, 4, 20.0 * math.pi),
        Unit(M_S2, M_S2, 3, 100.0),
        Unit(DEGC, DEGC, 1, 200.0, others=(MDEGC,)),
        Unit(KG, KG, 3, 1e4),
        Unit(PER_K, PPM_PER_K, 2, 1e-2, 1e-5, 1e-4, 1e-4),
    )
}

SUFFIXES: Mapping[str, Scale] = {
    scale.suffix: scale for unit in UNITS.values() for scale in (unit.own, unit.scale, *unit.others)
}


def suffixes(si: str, of: Iterable[str] | None = None) -> dict[str, float]:
    """Return the suffixes that a quantity in an SI unit may have, each with the factor to SI; SI's own first.

    Default: SI's own and that of the display unit, otherwise those of ``of`` that belong to this unit.
    """
    if of is None:
        return {scale.suffix: scale.scale for scale in (UNITS[si].own, UNITS[si].scale)}
    return {name: SUFFIXES[name].scale for name in of if SUFFIXES[name].si == si}


def named(name: str, suffix: str) -> str:
    """Return the name of a number in a file with the suffix of its unit; that of a ratio is empty."""
    return f"{name}_{suffix}".rstrip("_")


def length(name: str, si: tuple[str, ...] = ("m",)) -> Scale | None:
    """Return the unit of length (or another ``si``) with this suffix or symbol ("um" and "µm" are equal), or None."""
    return next((s for s in SUFFIXES.values() if s.si in si and name in (s.suffix, s.symbol)), None)


def shown(value: Any, si: str) -> Any:
    """Return a value, or an array of them, in its display unit: metres become millimetres."""
    return UNITS[si].scale.of(value)


def from_shown(value: Any, si: str) -> Any:
    """Return the inverse of ``shown``."""
    return UNITS[si].scale.to_si(value)


def symbol(si: str) -> str:
    """Return the symbol of the display unit: "mm" for "m"."""
    return UNITS[si].symbol


def key(name: str, si: str) -> str:
    """Return the name of a number in a file, in its display unit: "rms_after_mm" for "rms_after" in "m"."""
    return named(name, UNITS[si].scale.suffix)


def number(value: float, si: str, decimals: int | None = None) -> str:
    """Return a value as text without its unit, for a column whose title has it; "-" if it is not finite."""
    if not math.isfinite(value):
        return "-"
    return f"{shown(value, si):.{UNITS[si].decimals if decimals is None else decimals}f}"


def size(value: float | None, unit: Scale, fewer: int = 0) -> str:
    """Return a value in ``unit`` as text with its symbol, with ``fewer`` decimals than its SI unit has.

    "-" for None.
    """
    return "-" if value is None else f"{value:.{UNITS[unit.si].decimals - fewer}f} {unit.symbol}"


def title(text: str, si: str) -> str:
    """Return a column's title with its unit: "error [mm]"."""
    return f"{text} [{symbol(si)}]" if symbol(si) else text


def tolerances(prior: str) -> tuple[str, str, str]:
    """Return the standard deviations of a length, an angle and a gain for the prior "weak" or "wide"."""
    length, angle, gain = (getattr(UNITS[si], f"{prior}_sigma") for si in ("m", "rad", "1"))
    return MM.text(length), MRAD.text(angle), f"{ONE.text(gain)} of a gain"
