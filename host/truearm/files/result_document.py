"""The content of result.json of an estimate: see ``result_file`` and docs/reference/result-format.md.

Fields have the names of the estimate's attributes. Where a name ends in a unit, the value is converted to this unit.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from truearm import __version__
from truearm.estimate.gain import gain_of
from truearm.files.result_covariance import Covariance
from truearm.files.result_file import Parameter, Result, RobotFrames
from truearm.files.strict_json import without_nan
from truearm.kinds import registry
from truearm.kinds.table import ObservationTable
from truearm.results import (
    Diagnosis,
    Estimate,
    Figures,
    HeldOut,
    JointLaws,
    PredictedError,
    ResidualParts,
    Rival,
    ToolClaim,
)
from truearm.types import Residuals
from truearm.units import MM, MRAD, SUFFIXES, UNITS, key, shown


def result_of(
    estimate: Estimate,
    table: ObservationTable,
    robot: RobotFrames,
    predicted: PredictedError | None = None,
    **fields: Any,
) -> Result:
    """Return the content of result.json for an estimate from ``table``.

    ``predicted`` is the predicted error of the tool. ``fields`` are those that do not follow from an estimate, such as ``inputs`` and ``prior``.
    """
    names, free, units = np.array(estimate.parameter_names), estimate.free, residual_units(estimate)
    q, other_fit = table.q[estimate.fitted], ("n", "rms_after", "chi2_reduced", "value")
    pose, bad = estimate.pose_error, estimate.without_bad_rows
    parts = {si: estimate.parts.get(si, ResidualParts(math.nan, math.nan)) for si in units}
    content = {
        **_entry(estimate, "status", "message", "solver", "loss", "iterations", "n_observations", "rank", "rank_gap"),
        **_entry(estimate, "null_space", "hardly_seen", "additions", "alternatives_tried"),
        **_entry(estimate, "chi2_reduced", "chi2_band", "chi2_freedom"),
        **_entry(estimate, "rms_before", "rms_raw", "rms_after", units=units),
        **{key("rms_history", si): [shown(rms, si) for rms in estimate.rms_history.get(si, ())] for si in units},
        **_by_unit(parts, "rms_", "declared", "unexplained"),
        "faults": fault_entries(estimate.faults, table),
        "claim": _claim(estimate.claim, predicted is not None),
        "applied": estimate.applied,
        "truearm_version": __version__,
        "simulated": table.simulated,
        "robot": robot,
        "joint_range": {"lower": q.min(axis=0), "upper": q.max(axis=0)},
        "observations": _counts(estimate, table, units),
        # The prior of the evidence constrains the coefficients of joint laws: they count neither as free nor in the rank.
        "n_free": int(free[: estimate.n_robot_parameters].sum()) - len(estimate.law_parameters),
        "free": names[free],
        "suggested_free": names[np.flatnonzero(estimate.suggested_free)],
        "usable": not estimate.unusable,
        "unusable_because": estimate.unusable,
        "explanations": [
            _entry(explanation, "code", "n", "rms_given", "rms", "chance", units=list(explanation.rms_given))
            | {"values": dict(explanation.values)}
            for explanation in estimate.explanations
        ],
        "residual_units": [UNITS[si].scale.suffix for si in units],
        "observability": _entry(estimate.observability, "o1", "o2", "o3", "o4"),
        "scale": _entry(estimate.scale, "factor", "sigma", "n", "chance"),
        "pose_error": pose and _entry(pose, "sigma_mm", "n", row_variance=pose.row),
        "suspect": _suspects(estimate, table),
        "unexplained": _unexplained(estimate),
        "mean_change": _mean_change(estimate),
        "with_outliers": _entry(estimate.with_outliers, *other_fit, units=units, names=names),
        "without_bad_rows": bad and _entry(bad, *other_fit, units=units, names=names, tool_moves_mm=MM.of(bad.moves)),
        "held_out": _held_out(estimate.held_out, units),
        "held_out_before": _held_out(estimate.held_out_before, units),
        "predicted_error": predicted and _predicted(predicted),
        "joint_laws": _joint_laws(estimate.joint_laws, units),
        "parameters": _parameters(estimate),
        "covariance": Covariance.of(
            names[free], np.array(estimate.units)[free], estimate.covariance[np.ix_(free, free)]
        ),
    }
    return msgspec.convert(_json({**content, **fields}), Result)


def _entry(source: object, *names: str, units: Sequence[str] = (), **fields: Any) -> Any:
    """Return attributes by name, in the unit that the name ends in, and further ``fields``; None of None.

    A value by SI unit gives an entry for each of ``units``, in its display unit.
    """
    if source is None:
        return None
    entry: dict[str, Any] = {}
    for name in names:
        attribute, _, suffix = name.rpartition("_")
        value = getattr(source, name, None)
        if isinstance(value, Mapping):
            entry |= {key(name, si): shown(value.get(si, math.nan), si) for si in units}
        elif hasattr(source, name):
            entry[name] = value
        else:
            value = getattr(source, attribute)
            entry[name] = SUFFIXES[suffix].of(value if isinstance(value, float) else np.array(value))
    return entry | fields


def _by_unit(records: Mapping[str, Any], prefix: str, *names: str) -> dict[str, Any]:
    """Return attributes of a record for each SI unit, in its display unit, which ends their names, and its count."""
    counts = {key("n", si): record.n for si, record in records.items() if hasattr(record, "n")}
    return {
        key(prefix + name, si): shown(getattr(record, name), si) for si, record in records.items() for name in names
    } | counts


def _json(value: Any) -> Any:
    """Return a value as JSON has it: null for a number that does not exist."""
    return without_nan(msgspec.to_builtins(value, enc_hook=lambda array: array.tolist()))


def fault_entries(faults: Sequence[Diagnosis], table: ObservationTable) -> list[dict[str, Any]]:
    """Return the field ``faults`` for faults in the table's rows, with rows counted from 1, the last one included."""
    entries = [
        _entry(fault, "aliases", "freedom", "log_evidence", "deciding", chi2_drop=fault.drop)
        | {
            "sizes": [_entry(size, "unit", "value", "sigma") for size in fault.sizes],
            "rivals": [_rival(rival, table) for rival in fault.rivals],
            "mean": _rival(fault.mean, table),
        }
        for fault in faults
    ]
    return list(_json(entries))


def _rival(rival: Rival, table: ObservationTable) -> dict[str, Any]:
    first, last = rival.rows or (0, 0)
    rows = {
        "first": first + 1,
        "last": last,
        "from": source_name(table, first),
        "to": source_name(table, last - 1),
    }
    entry = _entry(rival, "name", "apply", "weight", "moves_mm", "error_mm", "gain", "gain_t")
    return {**entry, **(rows if rival.rows else dict.fromkeys(rows))}


def _claim(claim: ToolClaim | None, predicted: bool) -> Any:
    """Return the parts of the tool's error, if it is ``predicted`` at all, and what was assumed."""
    sizes = ("parameters_mm", "unnamed_mm", "rivals_mm", "shift_mm") if predicted else ()
    return claim and dict(
        _entry(claim, *sizes, "noise", "chi2_reduced", "unseen", "refused", noise_factor=claim.noise_scale)
    )


def copies_of(copied: NDArray[np.intp], table: ObservationTable) -> list[dict[str, str]]:
    """Return the rows that are copies, each with the row that it copies; ``copied`` (n,) is that row, or -1."""
    rows = np.flatnonzero(copied >= 0).tolist()
    return [{"source": source_name(table, row), "of": source_name(table, int(copied[row]))} for row in rows]


def source_name(table: ObservationTable, row: int) -> str:
    """Return the source of a row, without the folder, as in ``input_of``."""
    return os.path.basename(str(table.source[row]))


def residual_units(estimate: Estimate) -> list[str]:
    """Return the SI units of the residuals, fitted or held out."""
    held_out = estimate.held_out.figures if estimate.held_out else {}
    return [si for si in UNITS if si in estimate.rms_before or si in held_out]


def _counts(estimate: Estimate, table: ObservationTable, units: Sequence[str]) -> list[dict[str, Any]]:
    entries = []
    columns = [column for column in registry.identifiers() if column not in registry.ORIGINS]
    for rig, kind in sorted(set(zip(table.rig.tolist(), table.kind.tolist(), strict=True))):
        rows = (table.rig == rig) & (table.kind == kind)
        fitted, held_out = rows & estimate.used, rows & ~estimate.fitted
        if estimate.left_out.size:
            held_out &= ~estimate.left_out
        entry = {"rig": rig, "kind": kind, "fitted": int(fitted.sum()), "held_out": int(held_out.sum())}
        entry |= {f"{column}s": len(set(table[column][fitted].tolist()) - {""}) for column in columns}
        entry |= _rms("rms_before", estimate.residual_before, fitted, units)
        entry |= _rms("rms_after", estimate.residual, fitted, units)
        entry |= _rms("rms_held_out", estimate.residual, held_out, units)
        entries.append(entry)
    return entries


def _rms(name: str, residual: Residuals, rows: NDArray[np.bool_], units: Sequence[str]) -> dict[str, Any]:
    figures = Figures.by_unit(residual, rows)
    return {key(name, si): shown(figures[si].rms, si) if si in figures else None for si in units}


def _parameters(estimate: Estimate) -> list[dict[str, Any]]:
    seen, names = estimate.free & estimate.identifiable, estimate.parameter_names
    of = np.where(np.arange(len(names)) < estimate.n_robot_parameters, "robot", "rig")
    sigma = np.where(seen, estimate.sigma, np.nan)
    columns = (names, estimate.units, estimate.nominal, estimate.value, sigma, estimate.free, seen, of)
    entries = [dict(zip(Parameter.__struct_fields__, row)) for row in zip(*columns, strict=True)]
    for i in estimate.law_parameters:
        entries[i]["law"] = True
    return entries


def _unexplained(estimate: Estimate) -> dict[str, Any] | None:
    """Return the mean error where nothing was fitted, by unit; None if the declared noise explains the residuals."""
    errors = estimate.unexplained
    by = "held out" if any(error.held_out for error in errors.values()) else "cross-validation"
    return {"by": by, **_by_unit(errors, "", "mean", "low", "high")} if errors else None


def _mean_change(estimate: Estimate) -> dict[str, Any] | None:
    """Return the mean errors where nothing was fitted, before and after, by unit; None if they are not compared."""
    changes, gain = estimate.mean_change, gain_of(estimate.mean_change)
    by = "cross-validation" if estimate.held_out is None else "held out"
    return {"gain": gain, "by": by, **_by_unit(changes, "mean_", "before", "after")} if gain else None


def _suspects(estimate: Estimate, table: ObservationTable) -> list[dict[str, Any]]:
    """Return the rows beyond the gate, the farthest first."""
    rows = np.flatnonzero(estimate.suspect)
    rows = rows[np.argsort(-estimate.distance[rows], kind="stable")].tolist()
    return [
        {"source": source_name(table, row), "distance": estimate.distance[row], "weight": estimate.weight[row]}
        for row in rows
    ]


def _held_out(held_out: HeldOut | None, units: Sequence[str]) -> dict[str, Any] | None:
    if held_out is None:
        return None
    figures = {si: held_out.figures.get(si, Figures.of(np.zeros(0))) for si in units}
    counts = _entry(held_out, "n", "n_settled", "n_left_out")
    return {**_by_unit(figures, "", "rms", "mean", "max"), **counts}


def _predicted(predicted: PredictedError) -> Any:
    row, largest = os.path.basename(predicted.source), MM.of(predicted.largest)
    return _entry(predicted, "rms_mm", "n", "relative", max_mm=largest, at=row)


def _joint_laws(laws: JointLaws | None, units: Sequence[str]) -> dict[str, Any] | None:
    if laws is None:
        return None
    tried = ("joint", "term", "nats", "kept", "rms_mrad", "range_share", "covered_deg")
    noise = {
        "factor": laws.noise_factor,
        "shared_mm": MM.of(laws.noise_shared),
        "turned_mrad": MRAD.of(laws.noise_turned),
    }
    noise |= {f"{joint}_mrad": MRAD.of(sigma) for joint, sigma in laws.noise_joint.items()}
    return {
        **_entry(laws, "mode", "reasons", "gravity", "gravity_known"),
        "payloads": [_entry(payload, "mass_kg", "centre_mm") for payload in laws.payloads],
        "laws": laws.kept,
        "tried": [
            _entry(law, *tried, resolution_cycles=law.resolution)
            | {"periods": [_entry(period, "cycles", "amplitude_mrad") for period in law.periods]}
            for law in laws.tried
        ],
        "steps": [
            _entry(step, "name", "rms_after", units=units, held_out=_held_out(step.held_out, units))
            for step in laws.steps
        ],
        "noise": noise,
    }
