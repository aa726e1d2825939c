"""Words for the results of an identification: kinds of observation, parameters, observability indices."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from truearm.kinds.registry import kinds
from truearm.report.tables import Table
from truearm.results import Estimate, largest_terms
from truearm.text import one_line, with_article
from truearm.units import MS, UNITS, Unit, tolerances

SMALLEST_WEIGHT = 0.005  # of a parameter in a combination; below this, "0.00" would be shown
MAX_TERMS = 4  # of a combination that are shown
PARTS = {"m": "position", "rad": "rotation"}  # for a kind that has residuals in both units


def direction_text(weights: Iterable[float], names: Iterable[str], limit: int = MAX_TERMS) -> str:
    """Format a combination of parameters as "1.00 link1.z - 0.50 link2.z", its largest terms first."""
    terms = largest_terms(weights, names)
    shown = [(weight, name) for weight, name in terms[:limit] if abs(weight) >= SMALLEST_WEIGHT]
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
    entry = kinds()[kind]
    definitions = [
        f"{PARTS.get(si, si)}: {text}" if len(entry.residual) > 1 else text for si, text in entry.residual.items()
    ]
    return f"Residual of {with_article(entry.name)} observation: {'; '.join(definitions)}."


@dataclass(frozen=True)
class ParameterRow:
    """A parameter as a row of a table, in its display unit: NaN for what was not identified or is unknown."""

    name: str
    unit: Unit
    free: bool
    nominal: float
    value: float
    sigma: float  # NaN if it is not identifiable

    @classmethod
    def of(cls, name: str, si: str, free: bool, *numbers: float | None) -> ParameterRow:
        """Return the row of a parameter with its nominal value, value and sigma in SI."""
        nominal, value, sigma = (math.nan if number is None else UNITS[si].factor * number for number in numbers)
        if not free or (si == "s" and math.isnan(sigma)):  # an unidentifiable time offset may have any value
            value = math.nan
        return cls(name, UNITS[si], free, nominal, value, sigma)

    @classmethod
    def of_document(cls, entry: Mapping[str, Any]) -> ParameterRow:
        """Return the row of an entry of result.json."""
        return cls.of(*(entry[name] for name in ("name", "unit", "free", "nominal", "value", "sigma")))

    @property
    def change(self) -> float:
        return self.value - self.nominal

    @property
    def texts(self) -> tuple[str, ...]:
        """Return name, nominal, value, change, sigma and unit as text."""
        form = f".{self.unit.decimals}f"
        forms = ((self.nominal, form), (self.value, form), (self.change, f"+{form}"))
        numbers = ("-" if math.isnan(number) else f"{number:{form}}" for number, form in forms)
        sigma = f"{self.sigma:.2g}" if not math.isnan(self.sigma) else "unidentifiable" if self.free else "held fixed"
        return one_line(self.name), *numbers, sigma, self.unit.symbol


def parameter_table(rows: Iterable[ParameterRow]) -> Table:
    """Return parameters as a table; the marks are "held" and "unseen"."""
    listed = list(rows)
    marks = ["unseen" * math.isnan(row.sigma) if row.free else "held" for row in listed]
    titles = ("parameter", "nominal", "value", "change", "sigma", "unit ")
    return Table(titles, [row.texts for row in listed], "parameters", marks=marks)
