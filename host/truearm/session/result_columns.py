"""What sync found in a session as columns, for other programs (``truearm export-session``): plan, dwells, passes.

Titles end in the unit; a number that is not known is NaN, a whole one UNKNOWN.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.session.dwells import Dwell
from truearm.session.line_passes import Pass
from truearm.session.pipeline import Survey
from truearm.session.session_columns import UNKNOWN, Columns
from truearm.types import BAR_MOUNTED, LINE_MOUNTED


def plan_columns(found: Survey, joint_units: Sequence[str] = ()) -> Columns | None:
    """The plan's rows as they were recorded, via points and lines too; None without any. ``pose`` is what dwells and passes name."""
    rows = found.marks.rows
    if not rows:
        return None
    q = np.array([row.q for row in rows])
    units = tuple(joint_units) if len(joint_units) == q.shape[1] else ("rad",) * q.shape[1]
    return {
        "pose": np.arange(len(rows)),
        "move": np.array([row.move for row in rows], dtype=np.str_),
        **_joints(q, units),
        **_mounted([row.mounted for row in rows], ("shell", *BAR_MOUNTED, *LINE_MOUNTED)),
    }


def dwell_columns(found: Survey, dwells: Sequence[Dwell], joint_units: Sequence[str] = ()) -> Columns:
    """A row a dwell, those that gave no observation too, with the reason."""
    units = tuple(joint_units) or ("rad",) * len(found.joints.step)
    return {
        "dwell": np.arange(1, len(dwells) + 1),
        "reason": _of(dwells, "reason", np.str_),
        "host_start_ns": _of(dwells, "start_host_ns", int),
        "host_end_ns": _of(dwells, "end_host_ns", int),
        "segment": _of(dwells, "segment", int),
        "controller_start_s": _of(dwells, "start_s"),
        "controller_end_s": _of(dwells, "end_s"),
        "pose": _poses(dwells),
        **_mounted([dwell.mounted for dwell in dwells], ("shell", *BAR_MOUNTED)),
        "readings": _of(dwells, "n_readings", int),
        "samples": _of(dwells, "n_samples", int),
        "value_m": _of(dwells, "value"),
        "sigma_m": _of(dwells, "sigma"),
        "noise_m": _of(dwells, "noise"),
        "drift_m": _of(dwells, "drift"),
        "samples_effective": _of(dwells, "n_eff"),
        "clock_bound_ns": _of(dwells, "clock_bound_ns"),
        **_joints(np.array([dwell.q for dwell in dwells]).reshape(len(dwells), len(units)), units),
    }


def pass_columns(passes: Sequence[Pass]) -> Columns:
    """A row a motion along a line, those that gave no rows too, with the reason; ``noise``: of single samples about the motion."""
    legs = [one.leg for one in passes]
    noise = np.array([one.noise for one in passes]).reshape(len(passes), 3)
    return {
        "pass": np.arange(1, len(passes) + 1),
        "reason": _of(passes, "reason", np.str_),
        "host_start_ns": _of(legs, "start_host_ns", int),
        "host_end_ns": _of(legs, "end_host_ns", int),
        "segment": _of(legs, "segment", int),
        "controller_start_s": _of(legs, "start_s"),
        "controller_end_s": _of(legs, "end_s"),
        "pose": _poses(passes),
        **_mounted([one.mounted for one in passes], LINE_MOUNTED),
        "direction": _of(passes, "direction", int),
        "speed_m_s": _of(passes, "speed"),
        "points": np.array([len(one.xyz) for one in passes], dtype=np.int64),
        "points_dropped": np.array([sum(one.dropped.values()) for one in passes], dtype=np.int64),
        "samples": _of(passes, "n_samples", int),
        **{f"noise_{axis}_m": noise[:, k] for k, axis in enumerate("xyz")},
        "correlation_s": _of(passes, "correlation_s"),
        "time_sigma_s": _of(passes, "time_sigma_s"),
        "clock_bound_ns": _of(passes, "clock_bound_ns"),
    }


def _of(items: Sequence[object], name: str, kind: type = float) -> NDArray[Any]:
    return np.array([getattr(item, name) for item in items], dtype=kind)


def _poses(items: Sequence[Dwell] | Sequence[Pass]) -> NDArray[np.int64]:
    return np.array([UNKNOWN if item.pose is None else item.pose for item in items], dtype=np.int64)


def _mounted(said: Sequence[dict[str, str]], keys: Sequence[str]) -> Columns:
    return {key: np.array([mounted.get(key, "") for mounted in said], dtype=np.str_) for key in keys}


def _joints(q: NDArray[np.float64], units: Sequence[str]) -> Columns:
    return {f"q{j}_{unit}": q[:, j - 1] for j, unit in enumerate(units, start=1)}
