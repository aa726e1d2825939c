"""A line device: a target that the robot drives along a straight line, measured in the device's axes.

y is the longitudinal coordinate (magnetostrictive, about 1 m), x and z are the two transverse ones (magnetic, some
millimetres). Each placement of the device is a line with six unknowns of its own (Renders, Rossignol, Becquet, Hanus
1991, II-H); the geometry and its derivatives are those of a tracker with a very long, thin field (``position.py``).

Points exactly on a line (transverse readings 0) do not see the device's roll about it: one direction less a line.

The line stands in the room by hand, so it is first placed by its own readings through the nominal robot
(``LinePlacement``): by least squares of all its points, or, as Renders III-G 5 a, by its first two points alone. Least
squares starts nearer: two neighbours lie some centimetres apart, and by as many millimetres as the nominal robot errs
between them the far end is off by a multiple. Both fits end at the same place. The paper then leaves the two points out
of the identification; here they stay in, for a placement is a start and what is known of the device's pose is said by
its sigma. Whoever gives the placed pose a prior as tight as the two points themselves has to take them out of the table.

A placement turns the device so that its points' line falls on the line where the nominal robot has them. About that
line it turns as little as can be from the declared orientation, if one is known (``turn_sigma``): the points of a line
hardly show the roll, what they seem to say of it through a nominal robot that errs by more than they leave the line is
chance, and a prior about chance is false. A fit would have to creep away from it against that prior.

The time offset needs the line driven there and back: at constant speed in one direction τ cannot be told from the
device's longitudinal place.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import assert_never

import numpy as np

from truearm.errors import ProblemError
from truearm.kinds import position
from truearm.kinds.kind import Kind
from truearm.kinds.linearised import Indices
from truearm.kinds.position import nearest_rotation, points_of
from truearm.kinds.proposals import NEW, TRIAL_SIGMA, Proposal, about_one_point, trial_rows
from truearm.kinds.quantities import POINT, SPREAD
from truearm.kinds.rig_entries import DEVICE, TARGET, by_name
from truearm.kinds.rig_use import ORIGIN, RigUse, Scope
from truearm.model.chain import Chain, point_forward
from truearm.model.rotation import rotation
from truearm.schema import Entries
from truearm.types import Device, Floats, LinePlacement, ObservationTable, Rig


def place(
    xyz: Floats, p_base: Floats, declared: Floats, rule: LinePlacement, roll_known: bool
) -> tuple[Floats, Floats]:
    """Position (3,) and rotation (3, 3) of a line device.

    ``xyz`` (n, 3) are its readings in the order in which they were taken, ``p_base`` (n, 3) where the nominal robot has
    them, ``declared`` (3, 3) the orientation that the rig declares. Unless ``roll_known`` the roll about the line is
    that of the best fit of all points.
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
    rot = nearest_rotation((p_base - middle_base).T @ (xyz - middle_device), about, most=1)
    return middle_base - rot @ middle_device, rot


def use_rig(scope: Scope, rows: Indices) -> RigUse:
    """Targets and line devices that the rows use; a rig that lists no lines takes any that a row names."""
    rig = scope.rig
    if rig.line_placement not in tuple(LinePlacement):
        raise ProblemError(f"line_placement {rig.line_placement!r} is not known; use {' or '.join(LinePlacement)}")
    cov = tuple(tuple(sigma**2 * (i == k) for k in range(3)) for i, sigma in enumerate(rig.line_sigma))
    known = rig.lines or {name: Device(name, cov) for name in scope.table.line[rows].tolist()}

    def placed(xyz: Floats, p_base: Floats, device: Device) -> tuple[Floats, Floats]:
        declared = rotation(np.array(device.rotation))
        return place(xyz, p_base, declared, rig.line_placement, device.turn_sigma is not None)

    used, make = points_of(scope, rows, "line", known, placed)
    return RigUse(used, lambda layout: [make(layout)])


def proposals(here: Chain, rig: Rig, table: ObservationTable, rng: np.random.Generator) -> Iterator[Proposal]:
    """One more line."""
    ball = next(iter(rig.targets.values()), ORIGIN[""])
    q = about_one_point(here, table.q[len(table) // 2], np.array(ball.xyz), rng, reach=0.1)
    if len(q):
        p_base = point_forward(here, here.params_nominal, q, np.array(ball.xyz))
        cov = tuple(tuple(TRIAL_SIGMA**2 * (i == k) for k in range(3)) for i in range(3))
        more = replace(rig, lines={**rig.lines, NEW: Device(NEW, cov)} if rig.lines else rig.lines)
        rows = trial_rows(q, "line", xyz=p_base, line=NEW, target=ball.name)
        yield Proposal("line", "measure a new line with the line device", more, rows)


def facts(rows: ObservationTable) -> tuple[tuple[str, str], ...]:
    """What was measured in motion."""
    moving = np.isfinite(rows.q_rate).all(axis=1)
    if not moving.any():
        return ()
    ways = {(name, group) for name, group in zip(rows.line[moving], rows.shell[moving], strict=True)}
    names = sorted({str(name) for name, _ in ways})
    both = sum(sum(name == one for name, _ in ways) > 1 for one in names)
    return (
        ("lines driven", f"{', '.join(names[:20])}; {both} of {len(names)} there and back"),
        ("points on lines", f"{int(moving.sum())} in motion, {int((~moving).sum())} at rest"),
    )


LINE = Entries("line", DEVICE, "lines", by_name)
KIND = Kind(
    group=position.PositionRows,
    use_rig=use_rig,
    needs=("line", POINT),
    may=("target", SPREAD),
    entries=(TARGET, LINE),
    free_names=("line",),
    point="target",
    grouped_by=("line",),
    regions=("line",),
    drawn_from=("line",),
    name="line",
    residual={"m": "distance of the measured from the predicted point, along and across the line"},
    groups="line",
    proposals=proposals,
    facts=facts,
)
