"""The work of ``truearm validate``: errors of the robot as described and as identified, by region, and a verdict.

The verdict holds the error against what is to be expected: the noise that rig and table declare, and what the identification did
not know better. The error that the calibration had on its own data is no measure of rows of another kind, or of another place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import InputError
from truearm.estimate.problem import Rigs
from truearm.estimate.validation import Expected, expected, judge
from truearm.files.result_file import Input
from truearm.files.robot_file import RobotChoice
from truearm.kinds.registry import regions as regions_of_kinds
from truearm.model.chain import forward
from truearm.report.page_text import counted
from truearm.text import one_line
from truearm.types import Floats, ObservationTable
from truearm.workflows.calibration import Calibration, read_calibration
from truearm.workflows.inputs import Sources, check_files, hashed_inputs, observed
from truearm.workflows.session_parts import with_parts

LEAST_ROWS = 5  # of a region: fewer say little
AS_GOOD = 1.5  # times the error to be expected
HELPS = 0.9  # of the error without it


@dataclass(frozen=True)
class Validation:
    """How a calibration does on other observations; ``document`` is what ``truearm validate --json`` prints.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("friday.csv", robot), truearm.read_rig("rig.toml")
    >>> found = truearm.validate(truearm.read_result("result.json"), table, rig)
    >>> found.document["rows"]
    45
    """

    document: Mapping[str, Any]

    def __str__(self) -> str:
        return "\n".join(validation_lines(self.document))

    @property
    def verdict(self) -> str:
        """What the numbers mean, in words."""
        return str(self.document["verdict"])


def validate_files(result: Path, robot: RobotChoice, sources: Sources) -> dict[str, Any]:
    """Read a result and the observations that judge it; numbers and verdict. Raises InputError in one line."""
    calibration = read_calibration(result, robot)
    sources = replace(sources, inputs=tuple(with_parts(list(sources.inputs))))
    check_files(sources, robot)
    rig, table = observed(sources, calibration.joint_units)
    return validated(calibration, rig, table, hashed_inputs(sources, robot))


def validated(
    calibration: Calibration, rig: Rigs, table: ObservationTable, inputs: Sequence[Input] = ()
) -> dict[str, Any]:
    """Numbers and verdict; ``inputs`` are the files that the rows were read from. Raises InputError where no row can judge."""
    before, after = (judge(calibration.chain, rig, table, p) for p in (calibration.nominal, calibration.identified))
    judging = before.judging & after.judging
    if not judging.any():
        raise InputError("no row can judge: each fits unknowns of the rig whatever it says; measure more there")
    errors = before.error["m"], after.error["m"]
    due = _scaled(expected(after, calibration.covariance, calibration.unseen)["m"], calibration.stored.document)
    inputs_then = calibration.stored.document.get("inputs")
    seen = {
        str(entry.get("sha256"))
        for entry in (inputs_then if isinstance(inputs_then, list) else [])
        if isinstance(entry, dict)
    }
    hashes = [entry for entry in inputs if entry.role == "observations"]
    document: dict[str, Any] = {
        "rows": int(judging.sum()),
        "left_out": int((~judging).sum()),
        "settled": after.n_settled,
        "identified_from": [entry.name for entry in hashes if entry.sha256 in seen],
        "reference_mm": _reference(calibration.stored.document),
        **_errors(errors, judging),
        "unseen": int((judging & due.unseen).sum()),
        "expected": _expected(due, after.error["m"], judging & ~due.unseen),
        "regions": _regions(calibration, table, errors, due, judging),
    }
    return document | {"verdict": verdict(document)}


def _errors(errors: tuple[Floats, Floats], rows: NDArray[np.bool_]) -> dict[str, float]:
    out: dict[str, float] = {}
    for name, error in zip(("before", "after"), errors, strict=True):
        mine = 1e3 * error[rows]
        out |= {
            f"rms_{name}_mm": float(np.sqrt(np.mean(mine**2))),
            f"mean_{name}_mm": float(mine.mean()),
            f"max_{name}_mm": float(mine.max()),
        }
    return out


def _scaled(due: Expected, document: Mapping[str, Any]) -> Expected:
    """With more noise where the identification's own residuals had more than was declared, beyond chance."""
    chi2, band = document.get("chi2_reduced"), document.get("chi2_band")
    if not (isinstance(chi2, int | float) and isinstance(band, list) and len(band) == 2):
        return due
    beyond = isinstance(band[1], int | float) and chi2 > band[1]
    scale = float(chi2) if beyond else 1.0
    return Expected(scale * due.by_noise, scale * due.by_parameters, due.unseen)


def _expected(due: Expected, error: Floats, rows: NDArray[np.bool_]) -> dict[str, float] | None:
    """What the rows should say if the robot is as identified, and what they say; None where there are none."""
    if not rows.any():
        return None
    squares = {
        "rms_mm": due.by_noise + due.by_parameters,
        "by_noise_mm": due.by_noise,
        "by_parameters_mm": due.by_parameters,
        "rms_after_mm": error**2,
    }
    return {name: 1e3 * float(np.sqrt(np.mean(square[rows]))) for name, square in squares.items()}


def _reference(document: Mapping[str, Any]) -> float | None:
    """RMS that the calibration had on rows that it was not fitted to, or else on those that it was [mm]."""
    held_out = document.get("held_out")
    value = held_out.get("rms_mm") if isinstance(held_out, dict) else document.get("rms_after_mm")
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _regions(
    calibration: Calibration,
    table: ObservationTable,
    errors: tuple[Floats, Floats],
    due: Expected,
    judging: NDArray[np.bool_],
) -> list[dict[str, Any]]:
    """Groups that the rows name, and four parts of the space where the end was."""
    square = np.where(due.unseen, np.nan, due.by_noise + due.by_parameters)
    regions = []
    for column in regions_of_kinds():
        names = [str(name) for name in np.unique(table.column(column)) if name]
        if len(names) > 1:
            regions += [(f"{column}={name}", table.column(column) == name) for name in names]
    regions += _parts(calibration, table)
    found = []
    for name, mine in regions:
        rows = mine & judging
        if rows.sum() >= LEAST_ROWS:
            rms = 1e3 * float(np.sqrt(np.mean(square[rows])))
            told = None if math.isnan(rms) else rms
            found.append({"region": name, "rows": int(rows.sum()), **_errors(errors, rows), "rms_expected_mm": told})
    return found


def _parts(calibration: Calibration, table: ObservationTable) -> list[tuple[str, NDArray[np.bool_]]]:
    """Near and far, low and high: halves by the distance of the end from the base frame's z axis, and by its height."""
    p = forward(calibration.chain, calibration.identified, table.q)[:, :3, 3]
    reach = np.hypot(p[:, 0], p[:, 1])
    far, high = reach > np.median(reach), p[:, 2] > np.median(p[:, 2])
    split = f"{1e3 * np.median(reach):.0f} mm out", f"{1e3 * np.median(p[:, 2]):.0f} mm up"
    return [
        (
            f"{'beyond' if is_far else 'within'} {split[0]}, {'above' if is_high else 'below'} {split[1]}",
            (far == is_far) & (high == is_high),
        )
        for is_far in (False, True)
        for is_high in (False, True)
    ]


def verdict(document: Mapping[str, Any]) -> str:
    """What the numbers mean, in words."""
    before, after, due = (document[key] for key in ("rms_before_mm", "rms_after_mm", "expected"))
    if after >= HELPS * before:
        words = "The calibration does not help here: identify again, from measurements of this place and tool."
    elif due is None:
        words = "The calibration helps, but how far it holds cannot be told here."
    elif due["rms_after_mm"] > AS_GOOD * due["rms_mm"]:
        words = (
            f"The calibration helps, but leaves {due['rms_after_mm'] / due['rms_mm']:.1f} times the error that noise and its own "
            f"uncertainty explain ({due['rms_mm']:.3f} mm): the arm, its tool or its load has changed, or it errs in ways that "
            "the parameters do not hold."
        )
    elif due["by_parameters_mm"] > due["by_noise_mm"]:
        words = (
            "The calibration holds, as far as it says anything here: its own uncertainty leaves "
            f"{due['by_parameters_mm']:.3f} mm. To know this place better, identify from it too."
        )
    else:
        words = f"The calibration holds: noise and its own uncertainty explain such an error ({due['rms_mm']:.3f} mm)."
    if document["unseen"]:
        words += (
            f" {counted(document['unseen'], 'row hangs', 'rows hang')} on combinations of parameters that it did not see when it "
            "was identified, as how base or tool stand: identify from these rows too."
        )
    worse = [region["region"] for region in document["regions"] if region["rms_after_mm"] >= region["rms_before_mm"]]
    if worse and after < HELPS * before:
        words += f" Worse than without it: {'; '.join(worse)}."
    if document["identified_from"]:
        words += " But these rows are among those that it was identified from, so they prove little."
    return words


def validation_lines(document: Mapping[str, Any]) -> list[str]:
    """The document as a person reads it."""
    due = document["expected"] if not document["unseen"] else None
    width = max([len(region["region"]) for region in document["regions"]] + [len("all, largest")])
    lines = [f"{'error [mm]':<{width}}{'without':>12}{'with':>12}{'expected':>12}{'rows':>8}"]
    for key, title in (("rms", "all, RMS"), ("mean", "all, mean"), ("max", "all, largest")):
        told = due["rms_mm"] if due and key == "rms" else None
        lines.append(_line(title, width, document, key, told))
    for region in document["regions"]:
        lines.append(_line(one_line(region["region"]), width, region, "rms", region["rms_expected_mm"]))
    lines.append("Expected is, with the calibration, what declared noise and its own uncertainty explain.")
    if document["settled"]:
        lines.append(f"{document['settled']} unknowns of the rig were settled on these rows, without and with alike.")
    if document["left_out"]:
        lines.append(f"{document['left_out']} rows are not judged: they fit such unknowns whatever they say.")
    return [*lines, one_line(document["verdict"])]


def _line(title: str, width: int, numbers: Mapping[str, Any], key: str, told: float | None) -> str:
    before, after = numbers[f"{key}_before_mm"], numbers[f"{key}_after_mm"]
    last = "-" if told is None else f"{told:.4f}"
    return f"{title:<{width}}{before:>12.4f}{after:>12.4f}{last:>12}{numbers['rows']:>8}"
