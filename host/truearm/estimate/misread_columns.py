"""Other interpretations of single columns or of the geometry: rotations, mirrored axes, shifted rows, one joint's unit or sign.

- A pose's rotation as roll, pitch and yaw in place of a rotation vector, or the reverse; or of the device in the tool's
  axes.
- Left-handed axes: the readings of a device, or the rig's points of one type, with one coordinate's sign reversed. Any
  other one of the device's differs from it by a rotation of the device.
- Joint readings that belong to the row before or after, as where one side lost its first line.
- One joint's readings in another unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from truearm.errors import ProblemError
from truearm.estimate.other_readings import (
    FEW_ROWS,
    MOST_FITTED,
    Interpretation,
    in_each_rig,
    in_other_unit,
    worst_fitted,
)
from truearm.estimate.ties import largest_first
from truearm.estimate.trial_fit import placed
from truearm.kinds.quantities import POINT, TURN
from truearm.kinds.registry import kinds, points
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.model.rotation import rotation, rotation_vector
from truearm.types import Floats, Indices, Mask, Rig, Rigs, thinned

AXES = "xyz"


def other_rotations(chain: Chain, rig: Rigs, table: ObservationTable, free: Mask) -> Iterator[Interpretation]:
    """Return the measured rotations in other conventions; none if no row has a rotation."""
    if not _measured(table, TURN.field):
        return
    turn, some = table.rotation, np.isfinite(table.rotation).all(axis=1)
    v, r = turn[some], rotation(turn[some])
    readings = {
        "the rotations are roll, pitch and yaw (about fixed axes x, y, z), not rotation vectors": _by_angles(v),
        "the rotations are angles about the moving axes x, y, z, not rotation vectors": _by_angles(v, moving=True),
        "the rotations were rotation vectors, and were converted as roll, pitch and yaw": _angles(r),
        "the rotations are of the device in the tool's axes, not of the tool in the device's": -v,
    }
    for text, of in readings.items():
        changed = turn.copy()
        changed[some] = of
        yield Interpretation(text, chain, rig, table.replace(rotation=changed), free)


def _by_angles(angles: Floats, moving: bool = False) -> Floats:
    """Return the rotation vectors (n, 3) of angles (n, 3) about x, y, z: fixed axes, or each about the axes moved before."""
    x, y, z = (rotation(angles[:, [k]] * np.eye(3)[k]) for k in range(3))
    return rotation_vector(x @ y @ z if moving else z @ y @ x)


def _angles(r: Floats) -> Floats:
    """Return roll, pitch and yaw (n, 3) of rotations (n, 3, 3)."""
    return np.stack(
        [
            np.arctan2(r[:, 2, 1], r[:, 2, 2]),
            np.arcsin(np.clip(-r[:, 2, 0], -1.0, 1.0)),
            np.arctan2(r[:, 1, 0], r[:, 0, 0]),
        ],
        axis=1,
    )


def mirrored(chain: Chain, rig: Rigs, table: ObservationTable, free: Mask) -> Iterator[Interpretation]:
    """Return the measured points and the rig's points of each type with the sign of a coordinate reversed."""
    if _measured(table, POINT.field):
        text = "the axes of the readings of x, y and z are left-handed: two are exchanged, or one has the wrong sign"
        turned = _measured(table, TURN.field)
        for k in range(3) if turned else (2,):
            flip = np.where(np.arange(3) == k, -1.0, 1.0)
            yield Interpretation(text, chain, rig, table.replace(xyz=table.xyz * flip), free)
        if turned:
            both = table.replace(xyz=table.xyz * flip, rotation=table.rotation * -flip)
            yield Interpretation(f"{text}, also in the rotations", chain, rig, both, free)
    for column, entry in points().items():
        for k, axis in enumerate(AXES):
            other = _flipped(rig, entry, k)
            if other is not None:
                text = f"the {axis} of each {column} in the rig has the wrong sign (left-handed axes)"
                yield Interpretation(text, chain, other, table, free)
    if isinstance(rig, Rig):
        single = [
            Interpretation(f"the {axis} of {column} {name} in the rig has the wrong sign", chain, other, table, free)
            for column, entry in points().items()
            for name in rig.named(entry)
            for k, axis in enumerate(AXES)
            if (other := _flipped(rig, entry, k, name)) is not None
        ]
        yield from likeliest(single)


def likeliest(readings: Sequence[Interpretation]) -> list[Interpretation]:
    """Return the MOST_FITTED interpretations with the smallest residuals before the robot is fitted, in a few rows."""
    scored: list[tuple[float, int]] = []
    for i, one in enumerate(readings):
        few = one.table.select(thinned(len(one.table), FEW_ROWS))
        try:
            with np.errstate(all="ignore"):
                least = placed(one.chain, one.rig, few, worst_fitted(scored)).reduced
        except (ProblemError, np.linalg.LinAlgError):
            continue
        if np.isfinite(least):
            scored.append((least, i))
    return [readings[scored[k][1]] for k in largest_first([-least for least, _ in scored])[:MOST_FITTED]]


def _flipped(rig: Rigs, entry: str, axis: int, only: str = "") -> Rigs | None:
    """Return the rig, or rigs, with the sign of one coordinate of some points, or of one, reversed; None if all are 0."""
    if not isinstance(rig, Rig):
        return in_each_rig(rig, lambda one: _flipped(one, entry, axis))
    known = rig.named(entry)
    changed = {name: point for name, point in known.items() if only in ("", name)}
    if not any(point.xyz[axis] for point in changed.values()):
        return None
    sign = [-1.0 if k == axis else 1.0 for k in range(3)]
    moved: dict[str, Any] = {
        entry: {
            **known,
            **{n: replace(p, xyz=tuple(s * v for s, v in zip(sign, p.xyz, strict=True))) for n, p in changed.items()},
        }
    }
    return replace(rig, **moved)


def shifted_rows(
    chain: Chain, rig: Rigs, table: ObservationTable, rows: Indices, free: Mask
) -> Iterator[Interpretation]:
    """Return some ``rows`` of a table with the joint readings of the row before each, or after it."""
    for by, belong_to in ((1, "after"), (-1, "before")):
        other = rows - by
        inside = (other >= 0) & (other < len(table))
        some, of = rows[inside], other[inside]
        if some.size:
            changed = table.select(some).replace(q=table.q[of], q_rate=table.q_rate[of])
            text = f"the joint readings in each row belong to the row {belong_to} it"
            yield Interpretation(text, chain, rig, changed, free)


def joint_in_other_unit(chain: Chain, rig: Rigs, table: ObservationTable, free: Mask) -> Iterator[Interpretation]:
    """Return the table with the readings of one joint in another unit."""
    for j, (joint, unit) in enumerate(zip(chain.joints, chain.joint_units, strict=True)):
        for factor, are, called in in_other_unit(unit):
            text = f"the readings of {joint.name} are in {are}, not in {called}"
            by = np.where(np.arange(len(chain.joints)) == j, factor, 1.0)
            yield Interpretation(text, chain, rig, table.replace(q=table.q * by, q_rate=table.q_rate * by), free)


def _measured(table: ObservationTable, field: str) -> bool:
    """Return whether the rows measure a quantity."""
    used = (kinds()[str(kind)] for kind in np.unique(table.kind))
    return any(quantity.field == field for kind in used for quantity in kind.quantities) and bool(
        np.isfinite(table[field]).any()
    )
