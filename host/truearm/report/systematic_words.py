"""The systematic errors of a fit in sentences, for the terminal and the page, from the content of result.json."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import Any, assert_never

from truearm.results import DriftWith, ErrorForm
from truearm.text import counted, one_line
from truearm.units import DEGC, MM, UNITS


def systematic_sentences(document: Mapping[str, Any], argument: Callable[[str], str] | None = None) -> list[str]:
    """Return what is wrong, from which row, by how much, and what to do; empty if nothing was found.

    ``argument`` is the format of the arguments of an identification; None if they do not apply, as in a validation.
    """
    found, would_be = document["systematic"], document["without_systematic"]
    lines = [_sentence(entry) for entry in found]
    if would_be is None:
        return lines
    chi2, moves = would_be["chi2_reduced"], would_be["tool_moves_mm"]
    them = "it" if len(found) == 1 else "all of them"
    if argument is None:
        would = "" if chi2 is None else f" Without {them}, χ² per degree of freedom would be {chi2:.3g}."
        return [*lines, f"Correct the error at its source, or judge the result by rows without it.{would}"]
    after = "" if chi2 is None else f" χ² per degree of freedom is then {chi2:.3g}"
    moved = "" if moves is None else f", and the tool moves by {MM.text(MM.to_si(moves), '.3f')} RMS"
    held = (
        ""
        if would_be["held_out_ratio"] is None
        else f" The cross-validation error is then {would_be['held_out_ratio']:.3g} times as large."
    )
    given = [item for entry in found for item in entry["apply"].items()]
    apply = " ".join(f"{argument(name)} {shlex.quote(one_line(value))}" for name, value in given)
    return [*lines, f"To apply {them}: {apply}.{after}{moved}.{held}"]


def _sentence(entry: Mapping[str, Any]) -> str:
    first, last = entry["rows"]
    places = one_line(entry["from"]) if first == last else f"{one_line(entry['from'])} to {one_line(entry['to'])}"
    rows = (
        f"rows {_about(first, entry['first_within'])} to {_about(last, entry['last_within'])} (in the files: {places})"
    )
    freedom = counted(entry["freedom"], "degree of freedom", "degrees of freedom")
    gain = f"χ² falls by {entry['chi2_drop']:.4g} with {freedom}"
    match ErrorForm(entry["form"]):
        case ErrorForm.ROWS:
            line = f"Systematic error: {rows} do not fit the others; without them {gain}."
        case ErrorForm.DRIFT:
            line = f"Systematic error: {_what(entry)} drifts {_along(entry)} by {_size(entry)} over {rows}. Estimating this drift: {gain}."
        case ErrorForm.OFFSET:
            line = (
                f"Systematic error: {_what(entry)} is off by {_size(entry)} in {rows}. Estimating this error: {gain}."
            )
        case form:
            assert_never(form)
    if entry["rivals"]:
        line += f" Other possible explanations: {', '.join(map(one_line, entry['rivals']))}."
    return line


def _about(row: int, within: Sequence[int]) -> str:
    """Return a row's number, and how far off it may be."""
    off = max(row - within[0], within[1] - row)
    return f"{row}±{off}" if off else str(row)


def _along(entry: Mapping[str, Any]) -> str:
    """Return the quantity in which a drift is linear: the box's temperature, time, or the row order without times."""
    match DriftWith(entry["drifts_with"]):
        case DriftWith.TEMPERATURE:
            return f"with the box's temperature (which varies by {DEGC.text(entry['over_degc'], '.1f')})"
        case DriftWith.TIME:
            seconds = entry["over_s"]
            return "linearly" if seconds is None else f"linearly in {round(seconds / 60.0)} min"
        case drift:
            assert_never(drift)


def _what(entry: Mapping[str, Any]) -> str:
    return one_line(str(entry["what"]))


def _size(entry: Mapping[str, Any]) -> str:
    unit = UNITS[entry["unit"]]
    if entry["size"] is None or entry["sigma"] is None:
        return "an amount that cannot be determined"
    return f"{unit.scale.text(entry['size'], '.3g')} (σ {unit.scale.text(entry['sigma'], '.1g')})"
