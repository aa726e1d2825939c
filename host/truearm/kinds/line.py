"""A line device: a target that the robot drives along a straight line, measured in the device's axes.

y is the longitudinal coordinate (magnetostrictive, about 1 m); x and z are transverse (magnetic, a few millimetres).
Each placement has six unknowns of its own (Renders, Rossignol, Becquet, Hanus 1991, II-H), with the geometry of a
tracker (``position.py``). Points exactly on a line do not determine the roll about it.

The device is first placed from its readings with the nominal robot (``LinePlacement``): by least squares of all points,
or from the first two as in Renders III-G 5 a. It is an initial value, so these points are kept. It turns as little as
possible about the line from the declared orientation (``turn_sigma``): an apparent roll is random.

Lines are driven in both directions: otherwise τ is a shift along the line.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import assert_never

import numpy as np

from truearm.kinds import position
from truearm.kinds.columns import POINT, SPREAD
from truearm.kinds.kind import ORIGIN, Kind, RigUse, Scope
from truearm.kinds.position import nearest_rotation, points_of
from truearm.kinds.proposals import NEW, TRIAL_SIGMA, Proposal, about_one_point, trial_rows
from truearm.kinds.rig_entries import DEVICE, TARGET, by_name
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, point_forward
from truearm.model.transforms import rotation
from truearm.schema import Entries
from truearm.types import Device, Floats, Indices, LinePlacement, Rig


def place(
    xyz: Floats, p_base: Floats, declared: Floats, rule: LinePlacement, roll_known: bool
) -> tuple[Floats, Floats]:
    """Return position (3,) and rotation (3, 3) of a line device.

    ``xyz`` (n, 3) are its readings in the order in which they were taken, ``p_base`` (n, 3) the corresponding positions
    according to the nominal robot, and ``declared`` (3, 3) the orientation declared in the rig. Unless ``roll_known``,
    the roll about the line is that of the best fit of all points.
    """
    about = declared if roll_known else position.place(xyz, p_base, declared)[1]
    match rule:
        case LinePlacement.LEAST_SQUARES:
            pass
        case LinePlacement.TWO_POINT:
            xyz, p_base = xyz[:2], p_base[:2]
        case _:
            assert_never(rule)
    middle_device, middle_base = xyz.mean(axis=0), p_base.mean(axis=0)
    rot = nearest_rotation((p_base - middle_base).T @ (xyz - middle_device), about, largest_rank=1)
    return middle_base - rot @ middle_device, rot


def use_rig(scope: Scope, rows: Indices) -> RigUse:
    """Return what the rows use of the rig: targets and line devices.

    A rig without lines accepts any line that a row names.
    """
    rig = scope.rig
    cov = tuple(tuple(sigma**2 * (i == k) for k in range(3)) for i, sigma in enumerate(rig.line_sigma))
    lines = rig.lines or {name: Device(name, cov) for name in dict.fromkeys(scope.table.line[rows].tolist())}

    def placed(xyz: Floats, p_base: Floats, device: Device) -> tuple[Floats, Floats]:
        declared = rotation(np.array(device.rotation))
        return place(xyz, p_base, declared, rig.line_placement, device.turn_sigma is not None)

    return RigUse.of(position.PositionRows, scope, rows, **points_of(scope, rows, "line", lines, placed))


def proposals(chain: Chain, rig: Rig, table: ObservationTable, rng: np.random.Generator) -> Iterator[Proposal]:
    """Propose one more line."""
    ball = next(iter(rig.targets.values()), ORIGIN[""])
    q = about_one_point(chain, table.q[len(table) // 2], np.array(ball.xyz), rng, reach=0.1)
    if len(q):
        p_base = point_forward(chain, chain.params_nominal, q, np.array(ball.xyz))
        cov = tuple(tuple(TRIAL_SIGMA**2 * (i == k) for k in range(3)) for i in range(3))
        rig_with_line = replace(rig, lines={**rig.lines, NEW: Device(NEW, cov)} if rig.lines else rig.lines)
        rows = trial_rows(q, "line", xyz=p_base, line=NEW, target=ball.name)
        yield Proposal("line", "measure a new line with the line device", rig_with_line, rows)


def facts(rows: ObservationTable) -> tuple[tuple[str, str], ...]:
    """Return facts about the rows measured in motion."""
    moving = np.isfinite(rows.q_rate).all(axis=1)
    if not moving.any():
        return ()
    directions = {*zip(rows.line[moving].tolist(), rows.shell[moving].tolist(), strict=True)}
    passes = Counter(line for line, _ in directions)
    both_ways = sum(count > 1 for count in passes.values())
    return (
        ("lines driven", f"{', '.join(sorted(passes)[:20])}; {both_ways} of {len(passes)} there and back"),
        ("points on lines", f"{int(moving.sum())} in motion, {int((~moving).sum())} at rest"),
    )


LINE = Entries("line", DEVICE, "lines", by_name)
KIND = Kind(
    group=position.PositionRows,
    use_rig=use_rig,
    needs=("line", POINT),
    may=("target", SPREAD),
    entries=(TARGET, LINE),
    channels=(("magnetostrictive",), ("transverse_a", "transverse_b")),  # along the device, and across it
    free_names=("line",),
    point="target",
    grouped_by=("line",),
    regions=("line",),
    drawn_from=("line",),
    name="line",
    residual={"m": "distance of the measured from the predicted point, along and across the line"},
    proposals=proposals,
    facts=facts,
)
