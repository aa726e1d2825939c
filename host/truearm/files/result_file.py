"""result.json: the result of an identification, for people, scripts and later commands
(docs/reference/result-format.md).

The file is strict JSON (RFC 8259): a number that does not exist is ``null``, never NaN. Lengths in the summary are in
mm, angles in deg, parameters in the unit they name. The file is written atomically. A checksum over its content detects
damage: a digit of a parameter altered by a disk fault or by hand would otherwise lead to a wrong correction.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, assert_never

import numpy as np
from numpy.typing import NDArray

from truearm import __version__
from truearm.errors import InputError
from truearm.files.disk import read_text, sha256, write_atomic
from truearm.files.law_document import LAWS, law_document
from truearm.files.strict_json import number_or_null, numbers_or_null, shown_or_null
from truearm.kinds import registry
from truearm.schema import Choice, Flag, Key, List, ReadOnly, SchemaError, Table, Text, Value, quoted, raising
from truearm.types import (
    Defaults,
    DriftWith,
    Estimate,
    Explanation,
    Figures,
    Floats,
    HeldOut,
    Law,
    NullDirection,
    Observability,
    ObservationTable,
    Payload,
    PoseError,
    PredictedError,
    Relabelling,
    Residuals,
    StillJoint,
    SystematicError,
    SystematicErrors,
)
from truearm.units import UNITS, key

FORMAT = "truearm-result"
FORMAT_VERSION = 3
SINCE_CHECKSUM = 3  # version
CHECKSUM = "checksum"
ROUNDING = 1e-6  # relative, of numbers that are computed in two ways
MAX_BYTES = 64 * 2**20
MAX_PARAMETERS = 20_000
MAX_TEXT = 500  # characters; a parameter's name has at most 150
NO_DEFAULTS = Defaults()


class Input(NamedTuple):
    """An input file of an identification: its role, its name without folders, its SHA-256."""

    role: str  # "observations" | "rig" | "noise" | "robot"
    name: str
    sha256: str


def input_of(role: str, path: Path) -> Input:
    """Return the name and hash of an input file.

    Folders are omitted: they reveal where someone works, not what was read.
    """
    return Input(role, path.name.encode(errors="backslashreplace").decode(), sha256(path))


@dataclass(frozen=True)
class RobotFrames:
    """The identified chain: its name, frames, and joint units ("rad" or "m")."""

    name: str
    base_frame: str
    end_frame: str
    joint_units: tuple[str, ...]


class JointRange(NamedTuple):
    """The lowest and highest reading [rad or m] of each joint among the fitted observations."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]


@dataclass(frozen=True)
class StoredResult:
    """The parts of a result.json that later commands need; arrays run over all parameters, NaN where the file has null.

    ``covariance`` (f, f) runs over ``covariance_names``, the free parameters.
    """

    status: str
    robot: RobotFrames
    parameter_names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: Floats
    value: Floats
    sigma: Floats
    free: NDArray[np.bool_]
    of_robot: NDArray[np.bool_]
    covariance_names: tuple[str, ...]
    covariance: Floats
    null_space: tuple[NullDirection, ...]
    frames: tuple[NullDirection, ...]  # along which parameters were fixed as a choice of frame
    still: tuple[StillJoint, ...]
    lost: tuple[str, ...]  # parameters fixed because their joints did not move
    laws: tuple[Law, ...]  # joint laws; their parameters follow the robot's own
    document: Mapping[str, Any]  # the whole file as parsed
    joint_range: JointRange | None = None  # None: written by an earlier version
    payloads: tuple[Payload, ...] = ()  # the different ones of the fitted rows, empty if joint laws were not tried


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
        **systematic_entries(estimate.systematic, table),
        "unexplained": _unexplained(estimate),
        "with_outliers": _with_outliers(estimate, units),
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


def _coefficients(estimate: Estimate) -> int:
    """Return the number of joint-law parameters.

    The prior of the evidence constrains them, so they count neither as free nor in the rank.
    """
    return sum(law.size for law in estimate.joint_laws.kept) if estimate.joint_laws else 0


def _matrix(covariance: Floats) -> list[list[float | None]]:
    rows: list[list[float | None]] = covariance.tolist()
    return rows if np.isfinite(covariance).all() else [numbers_or_null(row) for row in rows]


def with_checksum(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a result with its checksum as the last entry."""
    content = {name: value for name, value in document.items() if name != CHECKSUM}
    return {**content, CHECKSUM: checksum(content)}


def checksum(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a result's content, independent of its layout. Raises ValueError for non-finite numbers."""
    content = {name: value for name, value in document.items() if name != CHECKSUM}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


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
        entry |= {f"{what}s": _distinct(table, what, fitted) for what in registry.identifiers() if what != "rig"}
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
        "rows": [_source(table, row) for row in relabelling.rows],
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
        "apply": {"leave_out": one.apply} if one.apply else None,
        "n": one.n,
        **{key("rms_given", si): shown_or_null(rms, si) for si, rms in one.rms_given.items()},
        **{key("rms", si): shown_or_null(rms, si) for si, rms in one.rms.items()},
        "chance": number_or_null(one.chance),
    }


def _source(table: ObservationTable, row: int) -> str:
    """Return the source of a row, without the folder, as in ``input_of``."""
    return Path(str(table.source[row])).name


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


def _pose_error(error: PoseError | None) -> dict[str, Any] | None:
    """Return the error shared by the rows of one pose, beyond chance."""
    if error is None:
        return None
    return {"sigma_mm": shown_or_null(error.sigma, "m"), "row_variance": number_or_null(error.row), "n": error.n}


def _with_outliers(estimate: Estimate, units: Sequence[str]) -> dict[str, Any] | None:
    """Return the fit of all rows, if outliers were left out."""
    every = estimate.with_outliers
    if every is None:
        return None
    return {
        "n": every.n,
        **_by_unit("rms_after", every.rms_after, units),
        "chi2_reduced": number_or_null(every.chi2_reduced),
        "names": list(estimate.parameter_names),
        "value": numbers_or_null(every.value),
    }


def _suspects(estimate: Estimate, table: ObservationTable) -> list[dict[str, Any]]:
    """Return the rows beyond the gate, the farthest first."""
    rows = np.flatnonzero(estimate.suspect)
    return [
        {
            "source": _source(table, int(row)),
            "distance": number_or_null(estimate.distance[row]),
            "weight": number_or_null(estimate.weight[row]),
        }
        for row in rows[np.argsort(-estimate.distance[rows], kind="stable")]
    ]


def systematic_entries(found: SystematicErrors | None, table: ObservationTable) -> dict[str, Any]:
    """Return the fields ``systematic`` and ``without_systematic`` for systematic errors found in the table's rows."""
    if found is None:
        return {"systematic": [], "without_systematic": None}
    would_be = {
        "chi2_reduced": number_or_null(found.chi2_reduced),
        "tool_moves_mm": shown_or_null(found.moves, "m"),
        "held_out_ratio": number_or_null(found.held_out_ratio),
    }
    return {"systematic": [_systematic(one, table) for one in found.found], "without_systematic": would_be}


def _systematic(found: SystematicError, table: ObservationTable) -> dict[str, Any]:
    """Return one systematic error; rows count from 1, the last one included."""
    (first, last), effect = found.rows, found.effect
    return {
        "what": None if effect is None else effect.what,
        "form": found.form.value,
        "rows": [first + 1, last],
        "first_within": [row + 1 for row in found.within[0]],
        "last_within": list(found.within[1]),
        "from": _source(table, first),
        "to": _source(table, last - 1),
        "unit": found.unit or None,
        "size": number_or_null(found.size),
        "sigma": number_or_null(found.sigma),
        **_over(found, table),
        "off_by": [
            {**of._asdict(), "value": number_or_null(of.value), "sigma": number_or_null(of.sigma)}
            for of in found.off_by
        ],
        "chi2_drop": number_or_null(found.drop),
        "freedom": found.freedom,
        "chance": number_or_null(found.chance),
        "rivals": list(found.rivals),
        "apply": {"leave_out": f"{first + 1}:{last}"} if effect is None else {"allow": str(effect)},
    }


def _over(found: SystematicError, table: ObservationTable) -> dict[str, Any]:
    """Return the quantity in which a drift is linear and its change over the rows: ``over_s`` or ``over_degc``."""
    drift, rows = None if found.effect is None else found.effect.drifts_with, slice(*found.rows)
    match drift:
        case None:
            seconds, degrees = math.nan, math.nan
        case DriftWith.TIME:
            seconds, degrees = float(np.ptp(table.time[rows])), math.nan
        case DriftWith.TEMPERATURE:
            seconds, degrees = math.nan, float(np.ptp(table.temperature[rows]))
        case never:
            assert_never(never)
    return {
        "drifts_with": drift and drift.value,
        "over_s": number_or_null(seconds),
        "over_degc": number_or_null(degrees),
    }


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


def format_document(value: Any, indent: int = 0) -> str:
    """Return JSON with one line for each innermost list or object, so that a covariance has one line per row."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if not any(isinstance(item, dict | list) for item in inner):
        return json.dumps(value, allow_nan=False)
    pad = " " * (indent + 2)
    if isinstance(value, dict):
        lines = [f"{pad}{json.dumps(key)}: {format_document(item, indent + 2)}" for key, item in value.items()]
    else:
        lines = [pad + format_document(item, indent + 2) for item in value]
    start, end = "{}" if isinstance(value, dict) else "[]"
    return start + "\n" + ",\n".join(lines) + "\n" + " " * indent + end


def looks_like_result(head: bytes) -> bool:
    """Return whether a file with this beginning is a result, or empty."""
    return not head.strip() or (head.lstrip().startswith(b"{") and b'"truearm' in head)


def write_result(path: Path, document: Mapping[str, Any]) -> None:
    """Write result.json atomically. Raises InputError if it cannot be written there."""
    write_atomic(path, format_document(dict(document)) + "\n")


def read_result(path: Path) -> StoredResult:
    """Read a result.json of this format version or an older one. Raises InputError that names file and field."""
    return parse_result(read_text(path, MAX_BYTES, InputError), str(path))


def parse_result(text: str, name: str) -> StoredResult:
    """Parse the text of a result.json; see ``read_result``. Unknown fields, from later versions, are skipped."""
    document = _json_object(text, name)
    if document.get("format") != FORMAT:
        raise InputError(f"{name}: is not a result of truearm identify (its format is not {FORMAT!r})")
    version = document.get("format_version")
    if version is None:
        raise InputError(f"{name}: has no format_version, so it is incomplete; identify again")
    if not isinstance(version, int) or isinstance(version, bool) or not 1 <= version <= FORMAT_VERSION:
        raise InputError(f"{name}: has format version {str(version)[:20]}, this truearm reads up to {FORMAT_VERSION}")
    with raising(InputError, name):
        stored = stored_result(document)
        if version >= SINCE_CHECKSUM or CHECKSUM in document:
            _check_whole(document)
        else:
            _check_redundant(stored)
        return stored


def _check_whole(document: Mapping[str, Any]) -> None:
    """Raise SchemaError if the content is not what was written."""
    try:
        whole = document.get(CHECKSUM) == checksum(document)
    except (ValueError, RecursionError):
        whole = False
    if not whole:
        raise SchemaError("was changed or damaged: its checksum does not match; copy it again or identify again")


def _check_redundant(stored: StoredResult) -> None:
    """Raise SchemaError if numbers that a result without a checksum holds twice differ, or no covariance can have them.

    The values themselves stand there once, so damage to them is not found.
    """
    covariance = np.nan_to_num(stored.covariance)
    bound = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.outer(bound, bound)
    if (np.abs(covariance - covariance.T) > ROUNDING * scale).any():
        raise SchemaError("covariance: is not symmetric, so the file is damaged; copy it again or identify again")
    if (np.diag(covariance) < 0.0).any() or (np.abs(covariance) > (1.0 + ROUNDING) * scale).any():
        raise SchemaError("covariance: exceeds its variances, so the file is damaged; copy it again or identify again")
    sigma = dict(zip(stored.parameter_names, stored.sigma, strict=True))
    for name, expected in zip(stored.covariance_names, bound, strict=True):
        if abs(sigma[name] - expected) > ROUNDING * expected:  # False for a NaN, of a parameter that is unidentifiable
            raise SchemaError(
                f"parameter {name}: its sigma is not that of the covariance, so the file is damaged; copy it again or identify again"
            )


def _json_object(text: str, name: str) -> dict[str, Any]:
    try:
        document = json.loads(text, parse_constant=_refuse_constant)
    except RecursionError as exc:
        raise InputError(f"{name}: is nested too deeply; give a result of truearm identify") from exc
    except ValueError as exc:  # JSONDecodeError, constants such as NaN, integers that are too large
        raise InputError(f"{name}: is not strict JSON: {exc}; give a result of truearm identify") from exc
    if not isinstance(document, dict):
        raise InputError(f"{name}: is not a JSON object; give a result of truearm identify")
    return document


def _refuse_constant(constant: str) -> float:
    raise ValueError(f"{constant} is not JSON")


@dataclass(frozen=True)
class _JsonNumber(ReadOnly):
    """A finite number, or NaN for ``null`` where that is allowed."""

    null: bool = True

    def parse(self, raw: Any, suffix: str = "") -> float:
        if raw is None and self.null:
            return math.nan
        if isinstance(raw, bool) or not isinstance(raw, int | float):
            raise SchemaError(f"{quoted(raw)} is not a number")
        if not abs(raw) <= sys.float_info.max:  # JSON's 1e999, or an integer too large for a float
            raise SchemaError("not a finite number")
        return float(raw)


class _NumberRow(ReadOnly):
    """A list of numbers or ``null``. Rows of finite floats, nearly all of a large covariance, are checked at once."""

    def parse(self, raw: Any, suffix: str = "") -> tuple[float, ...]:
        if isinstance(raw, list) and all(type(item) is float for item in raw) and np.isfinite(raw).all():
            return tuple(raw)  # as many as there are names
        return tuple(_many(_NUMBER).parse(raw, suffix))


@dataclass(frozen=True)
class Nullable(ReadOnly):
    """A value, or ``null``."""

    value: Value

    def parse(self, raw: Any, suffix: str = "") -> Any:
        return None if raw is None else self.value.parse(raw, suffix)


class _StoredParameter(NamedTuple):
    name: str
    unit: str
    nominal: float
    value: float
    sigma: float
    free: bool
    of: str


class _StoredCovariance(NamedTuple):
    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


def _later(keys: tuple[Key, ...], make: Callable[..., Any]) -> Table[Any]:
    """Return a table to which a later version may have added keys."""
    return Table(keys, make, unknown_keys=True)


def _many(item: Value) -> List:
    return List(item, least=0, most=MAX_PARAMETERS)


def _text(name: str) -> Key:
    return Key(name, Text(MAX_TEXT))


_NUMBER, _KNOWN = _JsonNumber(), _JsonNumber(null=False)
_NAMES = Key("names", _many(Text(MAX_TEXT)))
_UNITS = Key("joint_units", List(Choice(("rad", "m"))))
_FRAMES = _later((_text("name"), _text("base_frame"), _text("end_frame"), _UNITS), RobotFrames)
_NUMBERS = (Key("nominal", _KNOWN), Key("value", _NUMBER), Key("sigma", _NUMBER))
_OF = Key("of", Choice(("robot", "rig")))
_PARAMETER = _later((_text("name"), _text("unit"), *_NUMBERS, Key("free", Flag()), _OF), _StoredParameter)
_COVARIANCE = _later((_NAMES, Key("matrix", _many(_NumberRow()))), _StoredCovariance)
_DIRECTION = _later((_NAMES, Key("weights", _many(_KNOWN))), NullDirection)
_STILL = _later(
    (_text("joint"), Key("unit", Choice(("rad", "m"))), Key("spread", _KNOWN), Key("at", _KNOWN)), StillJoint
)
_DEFAULTS = _later(
    (
        Key("frames", _many(_DIRECTION), optional=True),
        Key("still", _many(_STILL), optional=True),
        Key("lost", _many(Text(MAX_TEXT)), optional=True),
    ),
    dict,
)
_JOINT_RANGE = _later((Key("lower", _many(_KNOWN)), Key("upper", _many(_KNOWN))), JointRange)
_RESULT = _later(
    (
        _text("status"),
        Key("robot", _FRAMES),
        Key("parameters", _many(_PARAMETER)),
        Key("covariance", _COVARIANCE),
        Key("null_space", _many(_DIRECTION)),
        Key("joint_laws", Nullable(LAWS), optional=True),
        Key("defaults", _DEFAULTS, optional=True),  # results of earlier versions have nothing here
        Key("joint_range", _JOINT_RANGE, optional=True),
    ),
    dict,
)


def stored_result(document: Mapping[str, Any]) -> StoredResult:
    """Return the parts of a result.json that later commands need. Raises SchemaError for a wrong field."""
    fields = _RESULT.parse(document)
    parameters: tuple[_StoredParameter, ...] = fields["parameters"]
    covariance: _StoredCovariance = fields["covariance"]
    names, size = tuple(p.name for p in parameters), len(covariance.names)
    if len(set(names)) != len(names):
        raise SchemaError("parameters: their names are not unique; identify again")
    if not set(covariance.names) <= set(names):
        raise SchemaError("covariance: names parameters that the result does not have; identify again")
    if len(covariance.matrix) != size or any(len(row) != size for row in covariance.matrix):
        raise SchemaError(f"covariance: matrix: needs {size} rows of {size} numbers, one per name")
    defaults = fields.get("defaults", {})
    frames: tuple[NullDirection, ...] = defaults.get("frames", ())
    for where, directions in (("null_space", fields["null_space"]), ("defaults: frames", frames)):
        for i, direction in enumerate(directions, start=1):
            if len(direction.names) != len(direction.weights):
                raise SchemaError(f"{where}: item {i}: needs a weight for each of its names")
    joint_range: JointRange | None = fields.get("joint_range")
    n_joints = len(fields["robot"].joint_units)
    if joint_range is not None and (len(joint_range.lower), len(joint_range.upper)) != (n_joints, n_joints):
        raise SchemaError(f"joint_range: needs {n_joints} numbers each, one per joint")
    laws = fields.get("joint_laws") or {}
    return StoredResult(
        status=fields["status"],
        robot=fields["robot"],
        parameter_names=names,
        units=tuple(p.unit for p in parameters),
        nominal=np.array([p.nominal for p in parameters]),
        value=np.array([p.value for p in parameters]),
        sigma=np.array([p.sigma for p in parameters]),
        free=np.array([p.free for p in parameters], dtype=bool),
        of_robot=np.array([p.of == "robot" for p in parameters], dtype=bool),
        covariance_names=covariance.names,
        covariance=np.array(covariance.matrix).reshape(size, size),
        null_space=fields["null_space"],
        frames=frames,
        still=defaults.get("still", ()),
        lost=defaults.get("lost", ()),
        laws=laws.get("laws", ()),
        document=document,
        joint_range=joint_range,
        payloads=laws.get("payloads", ()),
    )
