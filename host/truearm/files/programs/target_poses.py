"""The poses of targets and of the literals that make them up, and joint readings near them, as arrays of numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.files.programs.syntax import NO_NUMBERS, Form, Taught
from truearm.files.programs.values import Fixed, Goal, Pose, literals_in, plain_literal
from truearm.types import Floats
from truearm.units import DEG, MM

QUARTERS = (0, 3, 5)  # joints whose quarter turns a robtarget's configuration gives: axes 1, 4 and 6
_IDENTITY = np.eye(4)
_IDENTITY.flags.writeable = False


class PoseTarget(NamedTuple):
    """A pose that is a goal of moves. ``literal`` receives the correction; None if written into the move (``split``)."""

    goal: Goal
    literal: Taught | None
    at: int  # of the first move that goes to it


def values_of(literals: Sequence[Taught]) -> Floats:
    """Return the numbers (n, k) of literals of one form."""
    joined_text = ",".join([one.text for one in literals]).translate(NO_NUMBERS)
    return np.fromstring(joined_text, sep=",").reshape(len(literals), -1)


def matrices_of(literals: Sequence[Taught]) -> Floats:
    """Return the poses (n, 4, 4) [m] of literals of form POSE and ROBTARGET."""
    out = np.tile(np.eye(4), (len(literals), 1, 1))
    for form in (Form.POSE, Form.ROBTARGET):
        rows = [i for i, one in enumerate(literals) if one.form is form]
        if rows:
            numbers = values_of([literals[i] for i in rows])
            if form is Form.POSE:
                place, turn = numbers[:, :3], Rotation.from_rotvec(numbers[:, 3:])
            else:
                place, turn = MM.to_si(numbers[:, :3]), Rotation.from_quat(numbers[:, [4, 5, 6, 3]])
            out[rows, :3, 3], out[rows, :3, :3] = place, turn.as_matrix()
    return out


@dataclass(frozen=True)
class LiteralPoses:
    """Poses (m, 4, 4) of literals; ``rows`` are their rows by the places of the literals."""

    rows: Mapping[int, int]
    matrices: Floats

    def of(self, literal: Taught) -> Floats:
        """Return the pose (4, 4) of one of them."""
        return np.asarray(self.matrices[self.rows[literal.start]])


def matrix_of(pose: Pose, literals: LiteralPoses) -> Floats:
    """Return the product (4, 4)."""
    out = _IDENTITY
    for factor in pose.factors:
        of = factor.pose
        here = np.array(of.rows).reshape(4, 4) if isinstance(of, Fixed) else literals.of(of)
        out = out @ (np.linalg.inv(here) if factor.inverse else here)
    return out


def readings_of(taught: Taught) -> tuple[float, ...]:
    """Return the joint readings [rad] of a literal of form JOINTS or JOINTTARGET."""
    values = taught.values[:6]
    return values if taught.form is not Form.JOINTTARGET else tuple(float(DEG.to_si(value)) for value in values)


def poses_of(targets: Sequence[PoseTarget], known: LiteralPoses | None = None) -> tuple[Floats, Floats, Floats]:
    """Return targets (n, 4, 4) in their frames, the frames in the controller's base, and the tools, in m.

    ``known`` are their ``literal_poses``.
    """
    literals = known or literal_poses(targets)
    goals = [one.goal for one in targets]
    target, frame, tool = (
        _products([pose for pose in poses if isinstance(pose, Pose)], literals)
        for poses in ([g.target for g in goals], [g.frame for g in goals], [g.tool for g in goals])
    )
    return target, frame, tool


def _products(poses: Sequence[Pose], literals: LiteralPoses) -> Floats:
    """Return the matrices (n, 4, 4) of poses, many of which are one literal or the same object."""
    if poses and all(pose is poses[0] for pose in poses):  # as tools and frames usually are
        return np.broadcast_to(matrix_of(poses[0], literals), (len(poses), 4, 4))
    plain = [plain_literal(pose) for pose in poses]
    at = [0 if literal is None else literals.rows[literal.start] for literal in plain]
    out = literals.matrices[at] if literals.rows else np.empty((len(poses), 4, 4))
    known: dict[int, Floats] = {}
    for i, pose in enumerate(poses) if None in plain else ():
        if plain[i] is None:
            matrix = known.get(id(pose))
            if matrix is None:
                matrix = known[id(pose)] = matrix_of(pose, literals)
            out[i] = matrix
    return out


def literal_poses(targets: Sequence[PoseTarget]) -> LiteralPoses:
    """Return the poses of all literals that make up targets, tools and frames."""
    found = literals_of(targets)
    return LiteralPoses(dict(zip(found, range(len(found)), strict=True)), matrices_of(list(found.values())))


def literals_of(targets: Sequence[PoseTarget]) -> dict[int, Taught]:
    """Return the literals of targets, tools and frames by their places."""
    found: dict[int, Taught] = {}
    seen: set[int] = set()  # tools and frames are usually the same objects
    for one in targets:
        for pose in one.goal[:3]:
            if not isinstance(pose, Pose) or not pose.factors or id(pose) in seen:
                continue
            if one.literal is not None and len(pose.factors) == 1 and pose is one.goal.target:
                found[one.literal.start] = one.literal
                continue
            seen.add(id(pose))
            for literal in literals_in(pose):
                found[literal.start] = literal
    return found


def nears_of(goals: Sequence[Goal], n_joints: int) -> Floats:
    """Return joint readings (n, j) [rad] near those of each goal, NaN if the program gives none."""
    out = np.full((len(goals), n_joints), np.nan)
    taught = [(i, one.near) for i, one in enumerate(goals) if isinstance(one.near, Taught)]
    if taught and n_joints == 6:
        out[[i for i, _ in taught]] = values_of([near for _, near in taught])
    for i, one in enumerate(goals):
        near = one.near
        if near is not None and not isinstance(near, Taught) and len(near) == n_joints:
            out[i] = near
    return out


def quarters_of(goals: Sequence[Goal], n_joints: int) -> Floats:
    """Return the quarter turns (n, j) of axes 1, 4 and 6 by the configurations of robtargets, NaN elsewhere."""
    out = np.full((len(goals), n_joints), np.nan)
    poses = [(i, one.target) for i, one in enumerate(goals)]
    known = [(i, pose.like) for i, pose in poses if isinstance(pose, Pose) and not pose.free and pose.like is not None]
    if known and n_joints == 6:
        rows = np.array([i for i, _ in known])
        out[rows[:, None], QUARTERS] = values_of([like for _, like in known])[:, 7:10]
    return out
