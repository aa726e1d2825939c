"""Words for the results of an identification: kinds of observation, parameters, observability indices."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from truearm.kinds.registry import kinds
from truearm.results import Estimate, largest_terms
from truearm.text import one_line, with_article
from truearm.units import MS, UNITS, number, tolerances

SMALLEST_WEIGHT = 0.005  # of a parameter in a combination; below this, "0.00" would be shown
MAX_TERMS = 4  # of a combination that are shown
PARTS = {"m": "position", "rad": "rotation"}  # for a kind that has residuals in both units

# In steps of ``tolerances("weak")``; estimate.identifiability defines the four.
OBSERVABILITY = {
    "o1": ("the average parameter: change of one residual in σ, caused by one step (geometric mean)", "σ"),
    "o2": ("ratio of the weakest to the strongest combination of parameters; 1: all are determined equally well", "1"),
    "o3": ("the weakest combination: change of all residuals together in σ, caused by one step", "σ"),
    "o4": ("O2 times O3: small if either is", "σ"),
}


def direction_text(weights: Iterable[float], names: Iterable[str], most: int = MAX_TERMS) -> str:
    """Format a combination of parameters as "1.00 link1.z - 0.50 link2.z", its largest terms first."""
    terms = largest_terms(weights, names)
    shown = [(weight, name) for weight, name in terms[:most] if abs(weight) >= SMALLEST_WEIGHT]
    words = [f"{'-' if weight < 0.0 else '+'} {abs(weight):.2f} {one_line(name)}" for weight, name in shown]
    return " ".join(words).removeprefix("+ ") + f" and {len(terms) - len(shown)} smaller" * (len(terms) > len(shown))


def before_words(e: Estimate, lead: str = " ") -> str:
    """Return what was fitted to the nominal robot for its errors: base and tool, or "" if they were left as described."""
    return "" if e.rms_before == e.rms_raw else f"{lead}with base and tool fitted"


def drawing(timed: bool) -> str:
    """Return the tolerances of a manufacturer's drawing: the steps that define hardly identifiable parameters.

    ``timed``: also that of a delay of the joint readings, which no drawing has.
    """
    delay = f"; a delay of the joint readings: {MS.text(UNITS['s'].weak_sigma)}" * timed
    return ", ".join(tolerances("weak")) + delay


def kind_name(kind: str) -> str:
    """Return the name of a kind; a kind of a later version is its own name."""
    return kinds()[kind].name if kind in kinds() else kind


def residual_words(kind: str) -> str:
    """Return a sentence that defines the residual of a kind for each unit."""
    of = kinds()[kind]
    parts = [f"{PARTS.get(si, si)}: {text}" if len(of.residual) > 1 else text for si, text in of.residual.items()]
    return f"Residual of {with_article(of.name)} observation: {'; '.join(parts)}."


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
