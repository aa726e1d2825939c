"""What ``truearm identify`` prints: the findings, the verdict first; with ``--details`` also the tables.

All of it comes from the content of result.json, so that what is printed and what is stored cannot differ.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from truearm.finding_texts import Severity
from truearm.findings import Finding
from truearm.report.law_words import law_steps
from truearm.report.parameter_cells import parameter_cells
from truearm.report.result_findings import MAX_TERMS, has_little_freedom, result_findings
from truearm.report.result_words import SMALLEST_WEIGHT, kind_name
from truearm.results import largest_terms
from truearm.text import counted, one_line
from truearm.units import SUFFIXES, UNITS, title

Document = Mapping[str, Any]

MAX_LINES = 15  # of the short form
MAX_DIRECTIONS = 6
SHORT_NOTES = ("better", "held-out", "unjudged", "identified")  # notes of the short form, and those of the tool's error


def show_result(document: Document, inputs: Sequence[Path], written: Sequence[Path], details: bool = False) -> None:
    """Print the findings of a result.json made from ``inputs`` and the files that were ``written``; with ``details`` all
    of them, and the tables.
    """
    # No markup, because names come from files. Into a pipe, rich would wrap at 80 columns.
    width = None if sys.stdout.isatty() else 120
    console = Console(markup=False, highlight=False, emoji=False, width=width)
    findings = result_findings(document, {path.name: str(path) for path in inputs})
    texts = [(finding, finding.text(_option)) for finding in findings]
    files = [f"Written: {one_line(str(path))}" for path in written]
    if details:
        advice = [text for finding, text in texts if finding.severity is Severity.ADVICE]
        for text in (text for finding, text in texts if finding.severity is not Severity.ADVICE):
            console.print(text)
        for table in _tables(document):
            console.print(table)
        lines = [*advice, *files]
    else:
        lines = _short(texts, console, MAX_LINES - len(files)) + files
    for line in lines:
        console.print(line)


def _option(argument: str) -> str:
    return f"--{argument.replace('_', '-')}"


def _short(texts: Sequence[tuple[Finding, str]], console: Console, room: int) -> list[str]:
    """Return the verdict, the error of the tool, refusals and warnings, and advice, in at most ``room`` lines."""
    chosen = [text for finding, text in texts if _is_short(finding)]
    hint = "Parameters, residuals and {}: --details, or --report report.html"
    shown: list[str] = []
    used = 1
    for text in chosen:
        used += len(console.render_lines(text, pad=False))
        if used > room:
            break
        shown.append(text)
    more = len(chosen) - len(shown)
    return [*shown, hint.format(counted(more, "more finding") if more else "all notes")]


def _is_short(finding: Finding) -> bool:
    of_note = finding.code in SHORT_NOTES or finding.code.startswith("tool-error")
    return of_note or finding.severity is not Severity.NOTE


def _tables(document: Document) -> Iterator[Table | str]:
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
            yield _law_table(steps, SUFFIXES[suffix].symbol)


def _parameter_table(document: Document) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("parameter", overflow="fold")
    for column in ("nominal", "value", "change", "sigma"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("unit")
    for parameter in document["parameters"]:
        if parameter["free"] and not parameter.get("law", False):
            table.add_row(*parameter_cells(parameter))
    return table


def _law_table(steps: list[tuple[str, str, str]], unit: str) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column(f"joint laws [{unit}]")
    for column in ("fitted, RMS", "held out, mean"):
        table.add_column(column, justify="right", no_wrap=True)
    for step in steps:
        table.add_row(*step)
    return table


def _directions(directions: list[Mapping[str, Any]], field: str) -> list[str]:
    lines = [f"  {direction_text(direction)}" for direction in directions[:MAX_DIRECTIONS]]
    if len(directions) > MAX_DIRECTIONS:
        lines.append(f"  and {len(directions) - MAX_DIRECTIONS} more ({field} in the JSON result)")
    return lines


def direction_text(direction: Mapping[str, Any]) -> str:
    """Format a null direction as "1.00 link1.z - 0.50 link2.z", its largest terms first."""
    terms = largest_terms(direction["weights"], direction["names"])
    shown = [(weight, name) for weight, name in terms[:MAX_TERMS] if abs(weight) >= SMALLEST_WEIGHT]
    words = [f"{'-' if weight < 0.0 else '+'} {abs(weight):.2f} {one_line(name)}" for weight, name in shown]
    return " ".join(words).removeprefix("+ ") + f" and {len(terms) - len(shown)} smaller" * (len(terms) > len(shown))


def _error_table(document: Document, suffix: str) -> Table:
    """Return the errors in the unit of ``suffix``: of the fitted rows, of each kind, of the held-out rows."""
    scale = SUFFIXES[suffix]
    before, after = f"rms_before_{suffix}", f"rms_after_{suffix}"
    decimals = UNITS[scale.si].decimals
    table = Table(box=None, pad_edge=False)
    table.add_column(title("error", scale.si))
    for column in ("before", "after", "rows"):
        table.add_column(column, justify="right")
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
