"""Which parameters only define the pose of frames: of the base in the rig, and of the tool on the flange.

A parameter of the first constants moves the entire robot by one twist of the base, whatever the pose. One of the last
constants moves the end by one twist in its own axes. Generic readings distinguish these from all others, and from a
twist that only looks constant over one table.

Such a motion is a choice of frame if unknowns of the rig (a tracker's pose, a target's position, sockets) can
compensate for it. So is one on which no observation depends (the base about the only chuck). No measurement of this
kind can determine it. Directions of the data's null space over these parameters and the rig are such choices. As many
parameters are fixed as there are directions.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.identifiability import null_basis, project_out, rank_columns
from truearm.estimate.information import RANK_TOLERANCE
from truearm.estimate.ties import pivots
from truearm.model.chain import Chain, about, along, forward, trace_point
from truearm.types import Floats

N_POSES = 12
RANGE = np.pi  # rad, m: for joints with wider limits
CONSTANT = 1e-9  # relative to the largest twist: rounding leaves 1e-15


class Mounting(NamedTuple):
    """Masks (p,) of the parameters that move only the base, and of those that move only the tool; twists (6, p)."""

    base: NDArray[np.bool_]
    tool: NDArray[np.bool_]
    base_twist: Floats  # in the base frame, (turn; velocity of the origin), of those of the base
    tool_twist: Floats  # in the end's own axes

    @property
    def either(self) -> NDArray[np.bool_]:
        return self.base | self.tool


def mounting(chain: Chain, params: Floats) -> Mounting:
    """Return the parameters whose motion is one twist of the base, or one of the end, in every pose.

    The last few are cached: dozens of trial fits ask for those of the nominal robot.
    """
    return _mounting(chain, params.tobytes())


@lru_cache(maxsize=4)
def _mounting(chain: Chain, numbers: bytes) -> Mounting:
    params = np.frombuffer(numbers)
    rng = np.random.default_rng(0)
    lower, upper = chain.limits
    q = rng.uniform(np.maximum(lower, -RANGE), np.minimum(upper, RANGE), (N_POSES, len(chain.joints)))
    pose = forward(chain, params, q)
    trace = trace_point(chain, params, q, np.zeros(3))
    axes = np.eye(3)[:, None]
    turn, velocity = about(trace, axes).jac_params, along(trace, axes).jac_params  # (3, n, p) of the end, base axes
    at_base = velocity - np.cross(turn, trace.p_base.T[..., None], axis=0)
    at_end = [np.einsum("nki,knp->inp", pose[:, :3, :3], motion) for motion in (turn, velocity)]
    twists = [np.concatenate(motions) for motions in ((turn, at_base), at_end)]  # (6, n, p)
    base, tool = (np.ptp(twist, axis=1).max(axis=0) <= CONSTANT * np.abs(twist).max(initial=1.0) for twist in twists)
    varies = np.isin(
        np.arange(params.size), chain.law.of_column
    )  # a curve's coefficient may have no effect in any of these poses
    masks = Mounting(base & ~varies, tool & ~varies, twists[0][:, 0], twists[1][:, 0])
    for array in masks:
        array.setflags(write=False)
    return masks


def held_as_frames(
    root: Floats, mounted: Mounting, free: NDArray[np.bool_], named: NDArray[np.bool_], unit: Floats
) -> NDArray[np.bool_]:
    """Return which of the ``free`` (p,) parameters to fix so that none of the others is a choice of frame.

    None of the ``named`` parameters is fixed. ``root`` (k, k) has the robot's free columns first and then the rig's;
    ``unit`` (p,) makes metres and radians comparable.
    """
    scaled, scale = rank_columns(root)
    n_robot = int(free.sum())
    column = np.cumsum(free) - 1
    out = np.zeros(free.size, dtype=bool)
    for moves_frame, twist in ((mounted.base, mounted.base_twist), (mounted.tool & ~mounted.base, mounted.tool_twist)):
        members = np.flatnonzero(moves_frame & free)
        _, unseen = null_basis(project_out(scaled[:, column[members]], scaled[:, n_robot:]))
        # Two parameters of one motion are not a choice of frame: the frame does not move.
        if unseen.shape[1] <= members.size - np.linalg.matrix_rank(twist[:, members], tol=CONSTANT):
            continue
        basis, _ = np.linalg.qr(unseen / (scale[column[members]] * unit[members])[:, None])
        may = ~named[members]
        out[members[may][pivots(basis[may].T, RANK_TOLERANCE)]] = True
    return out
