"""Straight lines as a controller drives them: by its own model, at constant speed with smooth ends.

In the controller's model, the target moves straight from the previous row to this row, while the tool turns at a
constant rate about one axis. The joints for this are computed once, at knots KNOT apart; the error of a cubic spline
between them is less than 30 nm. The speed rises and falls as 3u² − 2u³, so the acceleration has no step and does not
make the joints ring.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from truearm.errors import PlanError
from truearm.model.chain import Chain, forward
from truearm.model.inverse import inverse
from truearm.model.transforms import rotation, rotation_vector
from truearm.types import Floats, Plan, Rig
from truearm.units import MM, MM_S

KNOT = 0.005  # m
SHORTEST = 0.01  # m
ACCELERATION = 1.0  # m/s², at its peak
FASTEST_JOINT = 4.0  # rad/s; a line that requires more passes a singularity
SAME = 1e-6  # rad, between the row's joints and those computed for its position


@dataclass(frozen=True)
class Path:
    """The joints along one line, and the motion of the target along it in time."""

    joints: CubicSpline  # by distance along the line [m]
    length: float  # m
    speed: float  # m/s, between the ends
    ramp: float  # s

    @property
    def seconds(self) -> float:
        """Return the seconds from rest to rest."""
        return self.length / self.speed + self.ramp

    def along(self, since: Floats) -> Floats:
        """Return the distance covered by the target (k,) [m] at times since the start (k,) [s]."""
        t = np.clip(since, 0.0, self.seconds)
        rise, fall = np.minimum(t / self.ramp, 1.0), np.minimum((self.seconds - t) / self.ramp, 1.0)
        cruise = np.clip(t - self.ramp, 0.0, self.seconds - 2.0 * self.ramp)
        return np.asarray(self.speed * (self.ramp * (_risen(rise) + 0.5 - _risen(fall)) + cruise))


def _risen(u: Floats) -> Floats:
    """Return ∫ 3u² − 2u³: distance in units of speed · ramp."""
    return u**3 * (1.0 - 0.5 * u)


def line_paths(plan: Plan, chain: Chain, params: Floats, rig: Rig) -> dict[int, Path]:
    """Return the path to each line of the plan, for a controller that uses the chain with ``params`` (p,).

    Raises PlanError for a line that the arm cannot drive.
    """
    return {
        int(row): _path(plan, int(row), chain, params, target_of(plan, int(row), rig))
        for row in np.flatnonzero(plan.lines)
    }


def target_of(plan: Plan, row: int, rig: Rig) -> Floats:
    """Return the target (3,) [m, end frame] of a line: the one it names, otherwise the rig's only one or the end."""
    names: Mapping[str, object] = rig.targets
    name = str(plan.target[row]) or (next(iter(names)) if len(names) == 1 else "")
    return np.array(rig.targets[name].xyz) if name else np.zeros(3)


def _path(plan: Plan, row: int, chain: Chain, params: Floats, p_end: Floats) -> Path:
    start, end = forward(chain, params, plan.q[row - 1 : row + 1])
    p_start, p_stop = (T[:3, :3] @ p_end + T[:3, 3] for T in (start, end))
    length = float(np.linalg.norm(p_stop - p_start))
    if length < SHORTEST:
        raise PlanError(f"plan pose {row}: its line is {MM.text(length, '.1f')} long; {MM.text(SHORTEST)} is the least")
    share = np.linspace(0.0, 1.0, 2 + int(length / KNOT))
    turns = rotation(share[:, None] * rotation_vector(end[:3, :3] @ start[:3, :3].T)) @ start[:3, :3]
    poses = np.tile(np.eye(4), (len(share), 1, 1))
    poses[:, :3, :3] = turns
    poses[:, :3, 3] = p_start + share[:, None] * (p_stop - p_start) - turns @ p_end
    guess = plan.q[row - 1] + share[:, None] * (plan.q[row] - plan.q[row - 1])
    q = inverse(chain, params, poses, guess)
    if np.isnan(q).any() or np.abs(q[[0, -1]] - plan.q[row - 1 : row + 1]).max() > SAME:
        raise PlanError(f"plan pose {row}: the arm cannot be driven straight there in one posture")
    q[[0, -1]] = plan.q[row - 1 : row + 1]
    speed = min(float(plan.speed[row]), np.sqrt(length * ACCELERATION / 1.5))
    joints = CubicSpline(length * share, q)
    if speed * np.abs(joints(length * share, 1)).max() > FASTEST_JOINT:
        raise PlanError(f"plan pose {row}: its line passes too near a singularity to be driven at {MM_S.text(speed)}")
    return Path(joints, length, speed, 1.5 * speed / ACCELERATION)
