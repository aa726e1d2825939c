"""The content of result.json of an estimate: see ``result_file`` and docs/reference/result-format.md.

Fields have the names of the estimate's attributes, and its records those of their own fields, in the unit that
``results`` declares, which ends the name. ``Result`` leaves out what it does not declare.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from pathlib import PurePath
from typing import Annotated, Any, get_origin, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from truearm import results
from truearm.estimate.law_fit import is_of_arm
from truearm.estimate.result_file import Covariance, ParameterEstimate, Result, RobotFrames
from truearm.estimate.validation import gain_of
from truearm.kinds.columns import ORIGINS, identifiers
from truearm.kinds.table import ObservationTable
from truearm.units import MM, MRAD, UNITS, key, named, shown
from truearm.version import VERSION


def result_of(
    estimate: results.Estimate,
    table: ObservationTable,
    robot: RobotFrames,
    predicted: results.PredictedError | None = None,
    **fields: Any,
) -> Result:
    """Return the content of result.json for an estimate from ``table``: attributes that are fields, and what follows.

    ``predicted`` is the predicted error of the tool. ``fields`` are those that do not follow from an estimate, such as
    ``inputs`` and ``prior``.
    """
    names, free, units = np.array(estimate.parameter_names), estimate.free, residual_units(estimate)
    q = table.q[estimate.fitted]
    suspects = sorted(np.flatnonzero(estimate.suspect).tolist(), key=lambda row: -estimate.distance[row])
    is_held_out = any(error.held_out for error in estimate.unexplained.values())
    change = _unfitted(estimate.mean_change, estimate.held_out is not None, "mean_", "before", "after")
    attributes = [name for name in Result.__struct_fields__ if hasattr(estimate, name)]
    content = {
        **{name: _entry(getattr(estimate, name), units, table) for name in attributes},
        **_entries(units, rms_before=estimate.rms_before, rms_raw=estimate.rms_raw, rms_after=estimate.rms_after),
        **{key("rms_history", si): [shown(rms, si) for rms in estimate.rms_history.get(si, ())] for si in units},
        **_by_unit(estimate.parts, units, "rms_", "declared", "unexplained"),
        "claim": _claim(estimate.claim, predicted is not None),
        "truearm_version": VERSION,
        "simulated": table.simulated,
        "robot": robot,
        "joint_range": {"lower": q.min(axis=0), "upper": q.max(axis=0)},
        "observations": _counts(estimate, table, units),
        # The evidence's prior constrains the coefficients of joint laws: they count neither as free nor in the rank.
        "n_free": int(free[: estimate.n_robot_parameters].sum()) - len(estimate.law_parameters),
        "free": names[free],
        "suggested_free": names[np.flatnonzero(estimate.suggested_free)],
        "usable": not estimate.unusable,
        "unusable_because": estimate.unusable,
        "explanations": [_entry(explanation, list(explanation.rms_given)) for explanation in estimate.explanations],
        "residual_units": [UNITS[si].scale.suffix for si in units],
        "suspect": [
            {"source": source_name(table, row), "distance": estimate.distance[row], "weight": estimate.weight[row]}
            for row in suspects
        ],
        "unexplained": _unfitted(estimate.unexplained, is_held_out, "", "mean", "low", "high"),
        "mean_change": change and {"gain": gain_of(estimate.mean_change), **change},
        "predicted_error": predicted and {**_entry(predicted), "at": PurePath(predicted.at).name},
        "joint_laws": _joint_laws(estimate.joint_laws, estimate.scatter, units),
        "pose_error": _pose_error(estimate.scatter),
        "parameters": _parameters(estimate),
        "covariance": Covariance.of(
            names[free], np.array(estimate.units)[free], estimate.covariance[np.ix_(free, free)]
        ),
    }
    for fit in filter(None, (content["with_outliers"], content["without_bad_rows"])):
        fit["names"] = names
    return msgspec.json.decode(_json({**content, **fields}), type=Result)


@cache
def _hints(record: type) -> dict[str, Any]:
    return get_type_hints(record, include_extras=True)


def _entry(record: Any, units: Sequence[str] = (), table: ObservationTable | None = None) -> Any:
    """Return a record of ``results`` by the annotations of its fields, and anything else as it is.

    A number with a unit, or one for each of ``units``, has a key that ends in the unit of the file. Rows are those of
    ``table``, counted from 1, the last one included.
    """
    kind: Any = type(record)
    if isinstance(record, tuple) and not hasattr(kind, "_fields"):
        return [_entry(item, units, table) for item in record]
    if not isinstance(record, tuple) and not is_dataclass(kind):
        return record
    entry: dict[str, Any] = {}
    for name, hint in _hints(kind).items():
        value = getattr(record, name)
        if get_origin(hint) is Annotated:
            (scale,) = hint.__metadata__
            entry[named(name, scale.suffix)] = scale.of(np.array(value))
        elif hint == Mapping[str, float]:
            entry |= _entries(units, **{name: value})
        elif hint == Mapping[str, results.Figures]:
            entry |= _by_unit(value, units, "", "rms", "mean", "max", "n")
        elif name == "rows" and table is not None:
            first, last = value or (0, 0)
            places = (first + 1, last, source_name(table, first), source_name(table, last - 1))
            entry |= dict(zip(("first", "last", "from", "to"), places if value else (None,) * 4, strict=True))
        else:
            entry[name] = _entry(value, units, table)
    return entry


def _entries(units: Sequence[str], **values: Mapping[str, float]) -> dict[str, Any]:
    """Return a number for each of ``units``, in its display unit, by a key that ends in it; NaN if there is none."""
    return {key(name, si): shown(value.get(si, math.nan), si) for name, value in values.items() for si in units}


def _by_unit(records: Mapping[str, Any], units: Sequence[str], prefix: str, *names: str) -> dict[str, Any]:
    """Return attributes of the record for each SI unit, in its display unit, which ends their names; "n" is a count."""
    return {
        key(prefix + name, si): getattr(records.get(si), name, 0)
        if name == "n"
        else shown(getattr(records.get(si), name, math.nan), si)
        for si in units
        for name in names
    }


def _json(value: Any) -> bytes:
    """Return a value as JSON, with null for a number that does not exist."""
    return msgspec.json.encode(value, enc_hook=lambda array: array.tolist())


def fault_entries(faults: Sequence[results.Diagnosis], table: ObservationTable) -> list[dict[str, Any]]:
    """Return the field ``faults`` for faults in the table's rows, with rows counted from 1, the last one included."""
    return list(msgspec.json.decode(_json(_entry(tuple(faults), (), table))))


def _claim(claim: results.ToolClaim | None, predicted: bool) -> Any:
    """Return the parts of the tool's error, if it is ``predicted`` at all, and what was assumed."""
    return claim and {name: value for name, value in _entry(claim).items() if predicted or not name.endswith(MM.suffix)}


def copies_of(copied: NDArray[np.intp], table: ObservationTable) -> list[dict[str, str]]:
    """Return the rows that are copies, each with the row that it copies; ``copied`` (n,) is that row, or -1."""
    rows = np.flatnonzero(copied >= 0).tolist()
    return [{"source": source_name(table, row), "of": source_name(table, int(copied[row]))} for row in rows]


def source_name(table: ObservationTable, row: int) -> str:
    """Return the source of a row, without the folder, as in ``input_of``."""
    return PurePath(str(table.source[row])).name


def residual_units(estimate: results.Estimate) -> list[str]:
    """Return the SI units of the residuals, fitted or held out."""
    held_out = estimate.held_out.figures if estimate.held_out else {}
    return [si for si in UNITS if si in estimate.rms_before or si in held_out]


def _counts(estimate: results.Estimate, table: ObservationTable, units: Sequence[str]) -> list[dict[str, Any]]:
    """Return how many rows of each rig and kind were fitted and held out, with their errors.

    Rows left out are in none.
    """
    unfitted = ~(estimate.fitted | estimate.left_out) if estimate.left_out.size else ~estimate.fitted
    columns = [column for column in identifiers() if column not in ORIGINS]
    entries = []
    for rig, kind in sorted(set(zip(table.rig.tolist(), table.kind.tolist(), strict=True))):
        rows = (table.rig == rig) & (table.kind == kind)
        fitted, held_out = rows & estimate.used, rows & unfitted
        entry = {"rig": rig, "kind": kind, "fitted": int(fitted.sum()), "held_out": int(held_out.sum())}
        entry |= {f"{column}s": len(set(table[column][fitted].tolist()) - {""}) for column in columns}
        for name, residual, chosen in (
            ("before", estimate.residual_before, fitted),
            ("after", estimate.residual, fitted),
            ("held_out", estimate.residual, held_out),
        ):
            figures = results.Figures.by_unit(residual, chosen)
            entry |= _entries(units, **{f"rms_{name}": {si: figure.rms for si, figure in figures.items()}})
        entries.append(entry)
    return entries


def _parameters(estimate: results.Estimate) -> list[dict[str, Any]]:
    determined, names = estimate.free & estimate.identifiable, estimate.parameter_names
    owner = np.where(np.arange(len(names)) < estimate.n_robot_parameters, "robot", "rig")
    sigma = np.where(determined, estimate.sigma, np.nan)
    columns = (names, estimate.units, estimate.nominal, estimate.value, sigma, estimate.free, determined, owner)
    entries = [dict(zip(ParameterEstimate.__struct_fields__, row)) for row in zip(*columns, strict=True)]
    for i in estimate.law_parameters:
        entries[i]["law"] = True
    return entries


def _unfitted(records: Mapping[str, Any], held_out: bool, prefix: str, *names: str) -> dict[str, Any] | None:
    """Return mean errors where nothing was fitted, by unit, with the number of poses; None if there are none."""
    by, units = "held out" if held_out else "cross-validation", list(records)
    return (
        {"by": by, **_by_unit(records, units, prefix, *names), **_by_unit(records, units, "", "n")} if units else None
    )


def _joint_laws(laws: results.JointLaws | None, scatter: results.Scatter | None, units: Sequence[str]) -> Any:
    return laws and {
        **_entry(laws, units),
        "laws": laws.kept,
        "noise": _noise(scatter) if laws.kept and scatter else {},
    }


def _noise(scatter: results.Scatter) -> dict[str, float]:
    sizes = {"shared_mm": float(MM.of(scatter.shared)), "turned_mrad": float(MRAD.of(scatter.turned))}
    for joint, sigma in scatter.joint.items():
        scale = MM if joint in scatter.linear else MRAD
        sizes[named(joint, scale.suffix)] = float(scale.of(sigma))
    sizes |= {named(joint, MM.suffix): float(MM.of(motion)) for joint, motion in scatter.at_tool.items()}
    return {"factor": scatter.factor, **sizes, "nats": scatter.nats}


def _pose_error(scatter: results.Scatter | None) -> dict[str, float] | None:
    """Return the arm's scatter where rows that share poses show it."""
    return {**_noise(scatter), "n": scatter.n} if scatter and scatter.n and is_of_arm(scatter) else None
