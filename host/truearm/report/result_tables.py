"""The tables of a result, from the content of result.json: parameters, combinations of them, errors, outliers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from truearm.kinds.registry import kinds
from truearm.report.tables import ErrorRow, Table, error_table
from truearm.results import largest_terms
from truearm.text import counted, one_line, with_article
from truearm.units import MS, SUFFIXES, UNITS, tolerances

Document = Mapping[str, Any]

SMALLEST_WEIGHT = 0.005  # of a parameter in a combination; below this, "0.00" would be shown
MAX_TERMS = 4  # of a combination that are shown
MAX_ROWS = 40  # outliers that are listed
COMPONENTS = {"m": "position", "rad": "rotation"}  # of a kind that has residuals in both units
STEPS = {"geometry": "geometry", "sag": "with sag", "curves": "with curves", "laws": "with joint laws"}
COMBINATIONS = {  # the field of a result, what its combinations are, and what that means
    "null_space": (
        "unidentifiable",
        "Changes along them do not change any prediction, so the values are one choice of many.",
    ),
    "hardly_seen": (
        "weakly identifiable",
        f"The observations alone determine them less accurately than a manufacturer's drawing ({', '.join(tolerances('weak'))}; where a delay of the joint readings is free, {MS.text(UNITS['s'].weak_sigma)}).",
    ),
}


def kind_name(kind: str) -> str:
    """Return the name of a kind; a kind of a later version is its own name."""
    return kinds()[kind].name if kind in kinds() else kind


def residual_words(kind: str) -> str:
    """Return a sentence that defines the residual of a kind for each unit."""
    entry = kinds()[kind]
    definitions = [
        f"{COMPONENTS.get(si, si)}: {text}" if len(entry.residual) > 1 else text for si, text in entry.residual.items()
    ]
    return f"Residual of {with_article(entry.name)} observation: {'; '.join(definitions)}."


def direction_text(weights: Iterable[float], names: Iterable[str], limit: int = MAX_TERMS) -> str:
    """Format a combination of parameters as "1.00 link1.z - 0.50 link2.z", its largest terms first."""
    terms = largest_terms(weights, names)
    shown = [(weight, name) for weight, name in terms[:limit] if abs(weight) >= SMALLEST_WEIGHT]
    words = [f"{'-' if weight < 0.0 else '+'} {abs(weight):.2f} {one_line(name)}" for weight, name in shown]
    return " ".join(words).removeprefix("+ ") + f" and {len(terms) - len(shown)} smaller" * (len(terms) > len(shown))


def combinations(document: Document, limit: int, terms: int = MAX_TERMS) -> Iterator[tuple[str, str, list[str]]]:
    """Return a heading, a remark and at most ``limit`` lines for each sort of combination that the result has."""
    for field, (words, remark) in COMBINATIONS.items():
        if directions := document[field]:
            texts = [direction_text(entry["weights"], entry["names"], terms) for entry in directions[:limit]]
            if len(directions) > limit:
                texts.append(f"and {len(directions) - limit} more ({field} in the JSON result)")
            are = "is" if len(directions) == 1 else "are"
            count = counted(len(directions), "combination")
            yield f"{count} of parameters {are} {words}; weights in m, rad and 1:", remark, texts


def parameter_table(entries: Iterable[Document]) -> Table:
    """Return parameters, entries as in result.json, in their display units; "-" for what is unknown.

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


def result_tables(document: Document) -> Iterator[Table | str]:
    """Return what a terminal shows: parameters, combinations, errors and joint laws."""
    yield parameter_table(row for row in document["parameters"] if row["free"] and not row.get("law"))
    for heading, _, texts in combinations(document, limit=6):
        yield from (heading, *(f"  {text}" for text in texts))
    for suffix in document["residual_units"]:
        yield errors_of_fit(document, suffix)
        yield from law_steps(document, suffix)


def errors_of_fit(document: Document, suffix: str) -> Table:
    """Return the errors in the unit of ``suffix``: of the fitted rows, of each kind, of the held-out rows."""
    key_before, key_after, key_held_out = (f"rms_{state}_{suffix}" for state in ("before", "after", "held_out"))
    entries = [entry for entry in document["observations"] if entry[key_after] is not None]
    says_nothing = has_little_freedom(document)
    everything = {**document, "fitted": sum(entry["fitted"] for entry in entries)}  # has the keys of a kind's entry
    fitted = [("fitted, RMS", everything)] if entries else []
    kinds_shown = document["observations"] if len(document["observations"]) > 1 else []
    fitted += [(f"  {_kind_of(entry)}", entry) for entry in kinds_shown if entry in entries]
    rows: list[ErrorRow] = [
        (words, (entry[key_before], None if says_nothing else entry[key_after]), entry["fitted"])
        for words, entry in fitted
    ]
    held_out, held_out_before = (document[name] or {} for name in ("held_out", "held_out_before"))
    if n := held_out.get(f"n_{suffix}"):
        for figure, words in (("rms", "RMS"), ("mean", "mean"), ("max", "largest")):
            errors = [state.get(f"{figure}_{suffix}") for state in (held_out_before, held_out)]
            rows.append((f"held out, {words}", errors, n))
        judged = [entry for entry in kinds_shown if entry.get(key_held_out) is not None]
        rows += [(f"  {_kind_of(entry)}, RMS", (None, entry[key_held_out]), entry["held_out"]) for entry in judged]
    return error_table(suffix, ("before", "after"), rows)


def has_little_freedom(document: Document) -> bool:
    """Return whether there are fewer degrees of freedom than fitted parameters: residuals then show no accuracy."""
    freedom = document["chi2_freedom"]
    return freedom is not None and bool(freedom < document["rank"])


def _kind_of(entry: Document) -> str:
    """Return a kind of observation, and its rig if there are several."""
    return one_line(f"{entry['rig']}: {kind_name(entry['kind'])}" if entry["rig"] else kind_name(entry["kind"]))


def law_steps(document: Document, suffix: str) -> list[Table]:
    """Return the fits with joint laws by their errors in a suffix's unit; empty if only geometry was fitted."""
    laws = document["joint_laws"]
    rows = []
    for step in laws["steps"] if laws else ():
        errors = step.get(f"rms_after_{suffix}"), (step["held_out"] or {}).get(f"mean_{suffix}")
        rows.append((STEPS[step["name"]], *("-" if error is None else f"{error:.4f}" for error in errors)))
    titles = f"joint laws [{SUFFIXES[suffix].symbol}]", "fitted, RMS", "held out, mean"
    return [Table(titles, rows, "fits")] if len(rows) > 1 else []


def outlier_table(rows: list[Document]) -> Table:
    """Return the rows that are farther from the others than chance allows, the farthest first."""
    titles = ("row", "distance from the others [σ]", "weight in the fit [1]")
    cells = ((row["source"], f"{row['distance']:.1f}", f"{row['weight']:.2g}") for row in rows[:MAX_ROWS])
    return Table(titles, cells, "rows far from the others", total=len(rows))
