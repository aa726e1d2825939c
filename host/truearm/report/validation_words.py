"""The verdict of a validation in words, and its errors as lines of a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from truearm.findings import Finding
from truearm.report.result_findings import FAR_OFF, copies, systematic_findings
from truearm.results import chi2_text
from truearm.text import counted, one_line
from truearm.units import SUFFIXES, UNITS, Scale, from_shown, size, title

FEW_ROWS = 10  # fewer say nothing about other poses
BY_PLACE = "radius "  # begins the name of a region of the space


def verdict(document: Mapping[str, Any]) -> str:
    """Explain the numbers in words."""
    units = [SUFFIXES[suffix] for suffix in document["residual_units"]]
    helped = [suffix for suffix, better in document["better"].items() if better]
    told = [_Told.of(document["expected"], unit) for unit in units if _Told.known(document["expected"], unit)]
    remedy = "identify from more varied poses" if document["identified_from"] else "identify from these rows too"
    if document["without_rig"]:
        remedy = "give the rig first"
    if document["consistent"] and told:
        explained = " and ".join(of.text(of.rms) for of in told)
        words = f"The calibration holds: the errors are consistent with declared noise and the calibration's uncertainty ({explained})."
        if unsure := [of for of in told if of.by_parameters > of.by_noise]:
            words = (
                "The calibration holds, but its uncertainty here is "
                f"{unsure[0].text(unsure[0].by_parameters)}. To reduce it, {remedy}."
            )
    elif not helped and (implausible := [unit for unit in units if _beyond_any_arm(document, unit)]):
        unit = implausible[0]
        words = (
            f"Errors of {size(document[f'rms_after_{unit.suffix}'], unit, 1)} RMS remain, more than those of any "
            "plausible arm: check that these measurements are of this robot, with this rig, and in these units."
        )
    elif not helped:
        words = (
            "The calibration does not help here: check that these measurements are of the robot of the result, or identify again, from "
            "measurements of this place and tool."
        )
    elif document["consistent"] is None or not told:
        words = "The calibration helps, but these rows cannot show how accurate it is."
    else:
        explained = " and ".join(of.text(of.rms) for of in told)
        left = " and ".join(of.text(document[f"unexplained_{of.unit.suffix}"]) for of in told)
        where = f", most of it in {document['worst_region']}" if document["worst_region"] else ""
        words = (
            f"The errors are smaller than without the calibration, but {left} RMS is unexplained{where}: declared noise and the "
            f"calibration's uncertainty explain {explained}. The arm, its tool or its load has changed, the rig is not as described, here or in the "
            "identification, or the arm has errors that the parameters do not model."
        )
    if document["unseen"]:
        words += (
            f" {counted(document['unseen'], 'row depends', 'rows depend')} on combinations of parameters that the identification could not "
            f"determine, such as the pose of base or tool, or a joint that did not move: {remedy}."
        )
    worse = [region["region"] for region in document["regions"] if any(_is_worse(region, unit) for unit in helped)]
    if worse:
        words += f" Worse than without it: {'; '.join(worse)}."
    if document["consistent"] and document["rows"] < FEW_ROWS:
        words += f" But {counted(document['rows'], 'row')} cannot show how accurate it is at other poses: validate with {FEW_ROWS} or more."
    if document["identified_from"]:
        words += " But the identification used these rows too, so this verdict proves little: validate with other measurements."
    return words


def _beyond_any_arm(document: Mapping[str, Any], unit: Scale) -> bool:
    after = document[f"rms_after_{unit.suffix}"]
    return after is not None and from_shown(after, unit.si) > FAR_OFF * UNITS[unit.si].wide_sigma


class _Told(NamedTuple):
    """What is expected of the rows in one unit, for display."""

    unit: Scale
    rms: float
    by_noise: float
    by_parameters: float

    @classmethod
    def of(cls, due: Mapping[str, Any], unit: Scale) -> _Told:
        return cls(unit, *(due[f"{name}_{unit.suffix}"] for name in ("rms", "by_noise", "by_parameters")))

    @staticmethod
    def known(due: Mapping[str, Any] | None, unit: Scale) -> bool:
        return due is not None and due[f"rms_{unit.suffix}"] is not None

    def text(self, value: float) -> str:
        return size(value, self.unit, 1)


def _is_worse(region: Mapping[str, Any], unit: str) -> bool:
    before, after = region[f"rms_before_{unit}"], region[f"rms_after_{unit}"]
    return before is not None and bool(after >= before)


def validation_lines(document: Mapping[str, Any]) -> list[str]:
    """Format the document for people: a table per unit, and its meaning."""
    first = [Finding("simulated").text()] if document["simulated"] else []
    tables = [line for rows in error_tables(document) for line in _aligned(rows)]
    before, after = validation_remarks(document)
    return [*first, *before, *tables, *after, one_line(document["verdict"])]


def validation_remarks(document: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Return the sentences before and after the tables of errors."""
    first, lines = [], []
    if document["without_rig"]:
        first.append(
            f"No rig was given, but the identification used one ({one_line(document['without_rig'])}). What it says of the fixtures and of the points on "
            "the end is not used here; give the rig of these measurements."
        )
    if any(region["region"].startswith(BY_PLACE) for region in document["regions"]):
        lines.append(
            '"Radius" is the distance of the end from the z axis of the base frame, "z" its height in this frame; each is split at its median.'
        )
    lines.append('"Expected" is the error that declared noise and the calibration\'s uncertainty explain.')
    if document["placed"]:
        units = [SUFFIXES[suffix] for suffix in document["residual_units"]]
        raw = " and ".join(size(document[f"rms_raw_{unit.suffix}"], unit) for unit in units)
        lines.append(
            f'"Without" is the nominal robot with base and tool fitted to these rows; with base and tool as described: {raw} RMS.'
        )
    else:
        lines.append('"Without" is the nominal robot, with base and tool as described.')
    if document["chi2_reduced"] is not None:
        lines.append(
            f"χ² per degree of freedom {chi2_text(document['chi2_reduced'])}; declared noise alone leaves it below {document['chi2_limit']:.3g} (99 %)."
        )
    lines += [finding.text() for finding in systematic_findings(document, judging=True)]
    if document["settled"]:
        lines.append(
            f"{counted(document['settled'], 'unknown of the rig was', 'unknowns of the rig were')} estimated from these rows, without and with the calibration alike."
        )
    if document["kept"]:
        lines.append(f"{counted(document['kept'], 'unknown')} of the rig held as identified.")
    if document["left_out"]:
        lines.append(
            f"{counted(document['left_out'], 'row is', 'rows are')} not judged: unknowns of the rig fit such rows exactly."
        )
    return first, [*lines, *(finding.text() for finding in copies(document)), *document["payload"]]


def error_tables(document: Mapping[str, Any]) -> list[list[tuple[str, ...]]]:
    """Return a table of errors for each unit, its titles first: all rows, then the regions."""
    return [_error_rows(document, SUFFIXES[suffix]) for suffix in document["residual_units"]]


def _error_rows(document: Mapping[str, Any], unit: Scale) -> list[tuple[str, ...]]:
    due = document["expected"] if not document["unseen"] else None
    rows: list[tuple[str, ...]] = [(title("error", unit.si), "without", "with", "expected", "rows")]
    for figure, words in (("rms", "all, RMS"), ("mean", "all, mean"), ("max", "all, largest")):
        predicted = due[f"rms_{unit.suffix}"] if due and figure == "rms" else None
        rows.append(_error_row(words, document, figure, unit, predicted))
    for region in document["regions"]:
        if region[f"n_{unit.suffix}"]:
            predicted = region[f"rms_expected_{unit.suffix}"]
            rows.append(_error_row(one_line(region["region"]), region, "rms", unit, predicted))
    return rows


def _error_row(
    words: str, numbers: Mapping[str, Any], figure: str, unit: Scale, predicted: float | None
) -> tuple[str, ...]:
    decimals = UNITS[unit.si].decimals
    before, after = (f"{numbers[f'{figure}_{name}_{unit.suffix}']:.{decimals}f}" for name in ("before", "after"))
    expected = "-" if predicted is None else f"{predicted:.{decimals}f}"
    return words, before, after, expected, str(numbers[f"n_{unit.suffix}"])


def _aligned(rows: list[tuple[str, ...]]) -> list[str]:
    width = max(len(words) for words, *_ in rows)
    return [f"{words:<{width}}{a:>12}{b:>12}{c:>12}{n:>8}" for words, a, b, c, n in rows]
