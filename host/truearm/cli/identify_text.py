"""The tables of ``truearm identify --details``.

All of it comes from the content of result.json, so that what is printed and what is stored cannot differ.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rich.table import Table

from truearm.cli.findings_text import table_of
from truearm.report.law_findings import law_steps
from truearm.report.parameter_cells import parameter_cells
from truearm.report.result_findings import has_little_freedom
from truearm.report.result_words import direction_text, kind_name
from truearm.text import counted, one_line
from truearm.units import SUFFIXES, UNITS, title

Document = Mapping[str, Any]

MAX_DIRECTIONS = 6


def tables(document: Document) -> Iterator[Table | str]:
    """Return the parameters, the combinations that are unidentifiable, the errors and the joint laws."""
    yield _parameter_table(document)
    for field, words in (("null_space", "unidentifiable"), ("hardly_seen", "weakly identifiable")):
        directions = document[field]
        if directions:
            what = counted(len(directions), "combination")
            yield f"{what} of parameters {'is' if len(directions) == 1 else 'are'} {words}; weights in m, rad and 1:"
            yield from _directions(directions, field)
    for suffix in document["residual_units"]:
        yield _error_table(document, suffix)
        if steps := law_steps(document, suffix):
            yield table_of((f"joint laws [{SUFFIXES[suffix].symbol}]", "fitted, RMS", "held out, mean"), steps)


def _parameter_table(document: Document) -> Table:
    free = (parameter for parameter in document["parameters"] if parameter["free"] and not parameter.get("law", False))
    return table_of(("parameter", "nominal", "value", "change", "sigma", "unit "), map(parameter_cells, free))


def _directions(directions: list[Mapping[str, Any]], field: str) -> list[str]:
    lines = [
        f"  {direction_text(direction['weights'], direction['names'])}" for direction in directions[:MAX_DIRECTIONS]
    ]
    if len(directions) > MAX_DIRECTIONS:
        lines.append(f"  and {len(directions) - MAX_DIRECTIONS} more ({field} in the JSON result)")
    return lines


def _error_table(document: Document, suffix: str) -> Table:
    """Return the errors in the unit of ``suffix``: of the fitted rows, of each kind, of the held-out rows."""
    scale = SUFFIXES[suffix]
    before, after = f"rms_before_{suffix}", f"rms_after_{suffix}"
    decimals = UNITS[scale.si].decimals
    table = table_of((title("error", scale.si), "before", "after", "rows"), ())
    entries = [entry for entry in document["observations"] if entry[after] is not None]
    says_nothing = has_little_freedom(document)
    if entries:
        rows = str(sum(entry["fitted"] for entry in entries))
        fitted = _cell(None if says_nothing else document[after], decimals)
        table.add_row("fitted, RMS", _cell(document[before], decimals), fitted, rows)
    for entry in entries if len(document["observations"]) > 1 else ():
        fitted = _cell(None if says_nothing else entry[after], decimals)
        cells = (_cell(entry[before], decimals), fitted, str(entry["fitted"]))
        table.add_row(f"  {_of(entry)}", *cells)
    held_out, held_out_before = (document[name] or {} for name in ("held_out", "held_out_before"))
    if held_out.get(f"n_{suffix}"):
        for figure, words in (("rms", "RMS"), ("mean", "mean"), ("max", "largest")):
            numbers = (_cell(errors.get(f"{figure}_{suffix}"), decimals) for errors in (held_out_before, held_out))
            table.add_row(f"held out, {words}", *numbers, str(held_out[f"n_{suffix}"]))
    return table


def _of(entry: Mapping[str, Any]) -> str:
    """Return a kind of observation, and its rig if there are several."""
    return one_line(f"{entry['rig']}: {kind_name(entry['kind'])}" if entry["rig"] else kind_name(entry["kind"]))


def _cell(value: float | None, decimals: int = UNITS["m"].decimals) -> str:
    """Format a number that is already in the unit of its column."""
    return "-" if value is None else f"{value:.{decimals}f}"
