"""The content of result.json: an estimate for people, scripts and later commands (docs/reference/result-format.md).

Lengths in the summary are in mm, angles in deg, parameters in the unit they name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm import __version__
from truearm.estimate.gain import gain_of
from truearm.files.law_document import law_document
from truearm.files.result_file import FORMAT, FORMAT_VERSION, Input, RobotFrames, with_checksum
from truearm.files.strict_json import number_or_null, numbers_or_null, shown_or_null
from truearm.files.systematic_document import source_name, systematic_entries
from truearm.kinds import registry
from truearm.results import (
    Defaults,
    Estimate,
    Explanation,
    Figures,
    HeldOut,
    Observability,
    OtherFit,
    PoseError,
    PredictedError,
    Relabelling,
)
from truearm.types import Floats, ObservationTable, Residuals
from truearm.units import UNITS, key

NO_DEFAULTS = Defaults()


def document_of(
    estimate: Estimate,
    table: ObservationTable,
    robot: RobotFrames,
    inputs: Sequence[Input],
    held_out_by: Sequence[str] = (),
    prior: str = "none",
    predicted: PredictedError | None = None,
    defaults: Defaults = NO_DEFAULTS,
) -> dict[str, Any]:
    """Return the content of result.json for an estimate from ``table``.

    ``held_out_by`` and ``prior`` are what the user asked to hold out, and the name of the robot's prior. ``predicted``
    is the predicted error of the tool. ``defaults`` are the fixed parameters and the assumptions that the user did not
    ask for.
    """
    names = np.array(estimate.parameter_names)
    units = residual_units(estimate)
    document = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "truearm_version": __version__,
        "inputs": [entry._asdict() for entry in inputs],
        "simulated": table.simulated,
        "robot": {
            "name": robot.name,
            "base_frame": robot.base_frame,
            "end_frame": robot.end_frame,
            "joint_units": list(robot.joint_units),
        },
        "status": estimate.status,
        "message": estimate.message,
        "solver": estimate.solver,
        "loss": estimate.loss,
        "prior": prior,
        "iterations": estimate.iterations,
        "n_observations": estimate.n_observations,
        "joint_range": _joint_range(table.q[estimate.fitted]),
        "observations": _counts(estimate, table, units),
        "n_free": int(estimate.free[: estimate.n_robot_parameters].sum()) - _coefficients(estimate),
        "rank": estimate.rank,
        "rank_gap": number_or_null(estimate.rank_gap),
        "free": names[estimate.free].tolist(),
        "defaults": _defaults(defaults),
        "suggested_free": names[np.flatnonzero(estimate.suggested_free)].tolist(),
        "null_space": [{"names": list(d.names), "weights": numbers_or_null(d.weights)} for d in estimate.null_space],
        "hardly_seen": [{"names": list(d.names), "weights": numbers_or_null(d.weights)} for d in estimate.hardly_seen],
        "observability": _observability(estimate.observability),
        "additions": [_lists(addition._asdict()) for addition in estimate.additions],
        "relabellings": [_relabelling(r, table) for r in estimate.relabellings],
        "relabelling_search": estimate.relabelling_search,
        "usable": not estimate.unusable,
        "unusable_because": None if estimate.unusable is None else estimate.unusable.value,
        "explanations": [_explanation(one) for one in estimate.explanations],
        "residual_units": [UNITS[unit].scale.suffix for unit in units],
        **_by_unit("rms_before", estimate.rms_before, units),
        **_by_unit("rms_raw", estimate.rms_raw, units),
        **_by_unit("rms_after", estimate.rms_after, units),
        **_by_unit("rms_declared", {si: of.declared for si, of in estimate.parts.items()}, units),
        **_by_unit("rms_unexplained", {si: of.unexplained for si, of in estimate.parts.items()}, units),
        "pose_error": _pose_error(estimate.pose_error),
        **{
            key("rms_history", si): [shown_or_null(rms, si) for rms in estimate.rms_history.get(si, ())] for si in units
        },
        "chi2_reduced": number_or_null(estimate.chi2_reduced),
        "chi2_band": numbers_or_null(estimate.chi2_band),
        "chi2_freedom": number_or_null(estimate.chi2_freedom),
        "suspect": _suspects(estimate, table),
        "scale": None if estimate.scale is None else estimate.scale._asdict(),
        **systematic_entries(estimate.systematic, table),
        "unexplained": _unexplained(estimate),
        "mean_change": _mean_change(estimate),
        "with_outliers": _other_fit(estimate, estimate.with_outliers, units),
        "without_bad_rows": _without_bad_rows(estimate, units),
        "held_out_by": list(held_out_by),
        "held_out": _held_out(estimate.held_out, units),
        "held_out_before": _held_out(estimate.held_out_before, units),
        "predicted_error": _predicted(predicted),
        "joint_laws": law_document(estimate.joint_laws, _held_out, units),
        "parameters": _parameters(estimate),
        "covariance": {
            "names": names[estimate.free].tolist(),
            "units": np.array(estimate.units)[estimate.free].tolist(),
            "matrix": _matrix(estimate.covariance[np.ix_(estimate.free, estimate.free)]),
        },
    }
    return with_checksum(document)


def copies_of(copied: NDArray[np.intp], table: ObservationTable) -> list[dict[str, str]]:
    """Return the rows that are copies, each with the row that it copies; ``copied`` (n,) is that row, or -1."""
    rows = np.flatnonzero(copied >= 0).tolist()
    return [{"source": source_name(table, row), "of": source_name(table, int(copied[row]))} for row in rows]


def _coefficients(estimate: Estimate) -> int:
    """Return the number of joint-law parameters.

    The prior of the evidence constrains them, so they count neither as free nor in the rank.
    """
    return sum(law.size for law in estimate.joint_laws.kept) if estimate.joint_laws else 0


def _matrix(covariance: Floats) -> list[list[float | None]]:
    rows: list[list[float | None]] = covariance.tolist()
    return rows if np.isfinite(covariance).all() else [numbers_or_null(row) for row in rows]


def _joint_range(q: Floats) -> dict[str, list[float]]:
    return {"lower": q.min(axis=0).tolist(), "upper": q.max(axis=0).tolist()}


def _defaults(defaults: Defaults) -> dict[str, Any]:
    names = {name: list(getattr(defaults, name)) for name in ("base", "tool", "lost", "believed")}
    frames = [{"names": list(d.names), "weights": numbers_or_null(d.weights)} for d in defaults.frames]
    return {**names, "frames": frames, "still": [joint._asdict() for joint in defaults.still]}


def residual_units(estimate: Estimate) -> list[str]:
    """Return the SI units of the residuals, fitted or held out."""
    held_out = estimate.held_out.figures if estimate.held_out else {}
    return [si for si in UNITS if si in estimate.rms_before or si in held_out]


def _by_unit(name: str, values: Mapping[str, float], units: Sequence[str]) -> dict[str, float | None]:
    """Return a number for each unit, in the display unit, which ends its key; None if there is no number."""
    return {key(name, si): shown_or_null(values.get(si, math.nan), si) for si in units}


def _counts(estimate: Estimate, table: ObservationTable, units: Sequence[str]) -> list[dict[str, Any]]:
    entries = []
    for rig, kind in sorted(set(zip(table.rig.tolist(), table.kind.tolist(), strict=True))):
        mine = (table.rig == rig) & (table.kind == kind)
        fitted, held_out = mine & estimate.used, mine & ~estimate.fitted
        if estimate.left_out.size:
            held_out &= ~estimate.left_out
        entry = {"rig": rig, "kind": kind, "fitted": int(fitted.sum()), "held_out": int(held_out.sum())}
        entry |= {
            f"{what}s": _distinct(table, what, fitted)
            for what in registry.identifiers()
            if what not in registry.ORIGINS
        }
        entry |= _by_unit("rms_before", _rms(estimate.residual_before, fitted), units)
        entry |= _by_unit("rms_after", _rms(estimate.residual, fitted), units)
        entry |= _by_unit("rms_held_out", _rms(estimate.residual, held_out), units)
        entries.append(entry)
    return entries


def _rms(residual: Residuals, rows: NDArray[np.bool_]) -> dict[str, float]:
    return {si: figures.rms for si, figures in Figures.by_unit(residual, rows).items()}


def _distinct(table: ObservationTable, what: str, rows: NDArray[np.bool_]) -> int:
    return sum(name != "" for name in np.unique(table.column(what)[rows]))


def _parameters(estimate: Estimate) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "unit": estimate.units[i],
            "nominal": number_or_null(estimate.nominal[i]),
            "value": number_or_null(estimate.value[i]),
            "sigma": number_or_null(estimate.sigma[i]) if estimate.free[i] and estimate.identifiable[i] else None,
            "free": bool(estimate.free[i]),
            "seen": bool(estimate.free[i] and estimate.identifiable[i]),
            **({"law": True} if i in estimate.law_parameters else {}),
            "of": "robot" if i < estimate.n_robot_parameters else "rig",
        }
        for i, name in enumerate(estimate.parameter_names)
    ]


def _observability(indices: Observability | None) -> dict[str, float | None] | None:
    return None if indices is None else {name: number_or_null(value) for name, value in indices._asdict().items()}


def _lists(record: Mapping[str, Any]) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in record.items()}


def _relabelling(relabelling: Relabelling, table: ObservationTable) -> dict[str, Any]:
    return {
        "rows": [source_name(table, row) for row in relabelling.rows],
        "columns": list(relabelling.columns),
        "was": list(relabelling.was),
        "fits": list(relabelling.fits),
        "rms_before_mm": shown_or_null(relabelling.rms_before, "m"),
        "rms_after_mm": shown_or_null(relabelling.rms_after, "m"),
    }


def _explanation(one: Explanation) -> dict[str, Any]:
    return {
        "what": one.what.value,
        "text": one.text,
        "apply": {"leave_out": one.apply} if one.apply else {"allow": one.allow} if one.allow else None,
        "n": one.n,
        **{key("rms_given", si): shown_or_null(rms, si) for si, rms in one.rms_given.items()},
        **{key("rms", si): shown_or_null(rms, si) for si, rms in one.rms.items()},
        "chance": number_or_null(one.chance),
    }


def _unexplained(estimate: Estimate) -> dict[str, Any] | None:
    """Return the mean error where nothing was fitted, by unit; None if the declared noise explains the residuals."""
    if not estimate.unexplained:
        return None
    out: dict[str, Any] = {"by": "cross-validation"}
    for si, error in estimate.unexplained.items():
        out |= {key(name, si): shown_or_null(getattr(error, name), si) for name in ("mean", "low", "high")}
        out |= {key("n", si): error.n}
        if error.held_out:
            out["by"] = "held out"
    return out


def _mean_change(estimate: Estimate) -> dict[str, Any] | None:
    """Return the mean errors where nothing was fitted, before and after, by unit; None if they are not compared."""
    gain = gain_of(estimate.mean_change)
    if gain is None:
        return None
    out: dict[str, Any] = {"gain": gain.value, "by": "cross-validation" if estimate.held_out is None else "held out"}
    for si, change in estimate.mean_change.items():
        out |= {key(f"mean_{name}", si): shown_or_null(getattr(change, name), si) for name in ("before", "after")}
        out |= {key("n", si): change.n}
    return out


def _pose_error(error: PoseError | None) -> dict[str, Any] | None:
    """Return the error shared by the rows of one pose, beyond chance."""
    if error is None:
        return None
    return {"sigma_mm": shown_or_null(error.sigma, "m"), "row_variance": number_or_null(error.row), "n": error.n}


def _other_fit(estimate: Estimate, other: OtherFit | None, units: Sequence[str]) -> dict[str, Any] | None:
    """Return the fit with outliers that were left out, or without bad rows that were not."""
    if other is None:
        return None
    return {
        "n": other.n,
        **_by_unit("rms_after", other.rms_after, units),
        "chi2_reduced": number_or_null(other.chi2_reduced),
        "names": list(estimate.parameter_names),
        "value": numbers_or_null(other.value),
    }


def _without_bad_rows(estimate: Estimate, units: Sequence[str]) -> dict[str, Any] | None:
    """Return the fit without bad rows that were not left out, and how far the tool is from the estimate's with it."""
    other = estimate.without_bad_rows
    fit = _other_fit(estimate, other, units)
    return None if other is None or fit is None else {**fit, "tool_moves_mm": shown_or_null(other.moves, "m")}


def _suspects(estimate: Estimate, table: ObservationTable) -> list[dict[str, Any]]:
    """Return the rows beyond the gate, the farthest first."""
    rows = np.flatnonzero(estimate.suspect)
    return [
        {
            "source": source_name(table, int(row)),
            "distance": number_or_null(estimate.distance[row]),
            "weight": number_or_null(estimate.weight[row]),
        }
        for row in rows[np.argsort(-estimate.distance[rows], kind="stable")]
    ]


def _held_out(held_out: HeldOut | None, units: Sequence[str]) -> dict[str, Any] | None:
    if held_out is None:
        return None
    figures = {si: held_out.figures.get(si, Figures.of(np.zeros(0))) for si in units}
    return {
        **_by_unit("rms", {si: of.rms for si, of in figures.items()}, units),
        **_by_unit("mean", {si: of.mean for si, of in figures.items()}, units),
        **_by_unit("max", {si: of.max for si, of in figures.items()}, units),
        **{key("n", si): of.n for si, of in figures.items()},
        "n": held_out.n,
        "n_settled": held_out.n_settled,
        "n_left_out": held_out.n_left_out,
    }


def _predicted(predicted: PredictedError | None) -> dict[str, Any] | None:
    if predicted is None:
        return None
    return {
        "rms_mm": shown_or_null(predicted.rms, "m"),
        "max_mm": shown_or_null(predicted.largest, "m"),
        "at": Path(predicted.source).name,
        "n": predicted.n,
        "relative": predicted.relative,
    }
