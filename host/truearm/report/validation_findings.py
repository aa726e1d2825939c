"""The findings of a validation, from its document: the verdict first; and its errors as rows of a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from truearm.findings import Finding, ordered
from truearm.report.result_findings import FAR_OFF, audit, copies, fault_findings, rig_unknowns, sizes
from truearm.report.tables import ErrorRow, Table, error_table
from truearm.results import chi2_text
from truearm.text import one_line
from truearm.units import SUFFIXES, UNITS, from_shown

Document = Mapping[str, Any]

FEW_ROWS = 10  # fewer say nothing about other poses
BY_PLACE = "radius "  # begins the name of a region of the space


def validation_findings(document: Document, about: Sequence[Finding] = ()) -> list[Finding]:
    """Return the verdict, what limits it, and notes; ``about``: findings about calibration, rows and their payloads."""
    units = document["residual_units"]
    figures = (sizes(document, name, units) for name in ("rms_before", "rms_drawing", "rms_after"))
    return ordered(
        [
            _verdict(document),
            *audit(*figures),
            *_limits(document),
            *fault_findings(document, True),
            *about,
            *_notes(document),
        ],
        document["simulated"],
    )


def _verdict(document: Document) -> Finding:
    """Return whether the errors are as expected, or smaller than without the calibration, or neither.

    Rows that were fitted cannot tell.
    """
    helped, units = any(document["better"].values()), document["residual_units"]
    expected = document["expected"] or {}
    due, noise, parameters = (sizes(expected, name, units) for name in ("rms", "by_noise", "by_parameters"))
    values = {
        "after": sizes(document, "rms_after", units),
        "before": sizes(document, "rms_before", units),
        "n": document["rows"],
        "expected": due,
    }
    if document["identified_from"]:
        return Finding("validation-own-rows", {**values, "files": document["identified_from"]})
    if document["consistent"] and due:
        unsure = {suffix: size for suffix, size in parameters.items() if size > noise[suffix]}
        return Finding("validation-uncertain" if unsure else "validation-holds", {**values, "parameters": unsure})
    if not helped:
        implausible = any(
            from_shown(size, SUFFIXES[suffix].si) > FAR_OFF * UNITS[SUFFIXES[suffix].si].wide_sigma
            for suffix, size in values["after"].items()
        )
        return Finding("validation-no-help", {**values, "implausible": implausible})
    if document["consistent"] is None or not due:
        return Finding("validation-unjudged", values)
    unexplained = sizes(document, "unexplained", list(due))
    shown = unexplained if any(unexplained.values()) else None
    return Finding("validation-changed", {**values, "unexplained": shown, "region": document["worst_region"]})


def _limits(document: Document) -> Iterator[Finding]:
    """Return what the verdict does not hold for, and why it may prove little."""
    if document["without_rig"]:
        yield Finding("rig-missing", {"rig": document["without_rig"]})
    if document["unseen"]:
        yield Finding("rows-unseen", {"n": document["unseen"]})
    helped = [suffix for suffix, better in document["better"].items() if better]
    worse = [region["region"] for region in document["regions"] if any(_is_worse(region, unit) for unit in helped)]
    if worse:
        yield Finding("regions-worse", {"regions": worse})
    if document["consistent"] and document["rows"] < FEW_ROWS:
        yield Finding("few-rows", {"n": document["rows"], "enough": FEW_ROWS})
    yield from copies(document)


def _is_worse(region: Document, unit: str) -> bool:
    error_before, error_after = region[f"rms_before_{unit}"], region[f"rms_after_{unit}"]
    return error_before is not None and bool(error_after >= error_before)


def _notes(document: Document) -> Iterator[Finding]:
    """Return what the tables mean, and what was estimated from the rows themselves."""
    by_place = any(region["region"].startswith(BY_PLACE) for region in document["regions"])
    chi2 = document["chi2_reduced"]
    limits = {"chi2": chi2 and chi2_text(chi2), "limit": document["chi2_limit"]}
    yield Finding("validation-terms", {"by_place": by_place, **limits})
    raw = sizes(document, "rms_raw", document["residual_units"])
    placed = document["placed"]
    yield Finding("before", {"fitted": ["base and tool"] * placed, "raw": raw, "placed": placed})
    yield from rig_unknowns(document["settled"], document["left_out"])
    if document["kept"]:
        yield Finding("rig-unknowns", {"n": document["kept"], "how": "held as identified"})


def error_tables(document: Document) -> list[Table]:
    """Return a table of errors for each unit: all rows, then the regions."""
    return [_error_table(document, suffix) for suffix in document["residual_units"]]


def _error_table(document: Document, suffix: str) -> Table:
    def row(words: str, errors: Document, figure: str, predicted: float | None) -> ErrorRow:
        sizes = [errors[f"{figure}_{name}_{suffix}"] for name in ("before", "after")]
        return words, (*sizes, predicted), errors[f"n_{suffix}"]

    due = document["expected"] if not document["unseen"] else None
    rows = [row("all, RMS", document, "rms", due and due[f"rms_{suffix}"])]
    rows += [row(f"all, {words}", document, figure, None) for words, figure in (("mean", "mean"), ("largest", "max"))]
    rows += [
        row(one_line(region["region"]), region, "rms", region[f"rms_expected_{suffix}"])
        for region in document["regions"]
        if region[f"n_{suffix}"]
    ]
    return error_table(suffix, ("before", "after", "expected"), rows)
