"""Words for the results of an identification: kinds of observation, parameters, observability indices."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from truearm.kinds.registry import kinds
from truearm.report.tables import Table
from truearm.results import Estimate, largest_terms
from truearm.text import one_line, with_article
from truearm.units import MS, UNITS, tolerances

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


def parameter_table(entries: Iterable[Mapping[str, Any]]) -> Table:
    """Return parameters, entries as in result.json or with NaN for null, in their display units; "-" for what is unknown.

    The marks are "held" and "unseen".
    """
    rows, marks = [], []
    for entry in entries:
        unit, is_free = UNITS[entry["unit"]], entry["free"]
        numbers = (entry[name] for name in ("nominal", "value", "sigma"))
        nominal, value, sigma = (math.nan if number is None else unit.factor * number for number in numbers)
        is_unseen = math.isnan(sigma)
        if not is_free or (unit.si == "s" and is_unseen):  # an unidentifiable time offset may have any value
            value = math.nan
        form = f".{unit.decimals}f"
        forms = ((nominal, form), (value, form), (value - nominal, f"+{form}"))
        texts = ("-" if math.isnan(number) else f"{number:{spec}}" for number, spec in forms)
        accuracy = f"{sigma:.2g}" if not is_unseen else "unidentifiable" if is_free else "held fixed"
        rows.append((one_line(entry["name"]), *texts, accuracy, unit.symbol))
        marks.append("unseen" * is_unseen if is_free else "held")
    titles = ("parameter", "nominal", "value", "change", "sigma", "unit ")
    return Table(titles, rows, "parameters", marks=marks)
