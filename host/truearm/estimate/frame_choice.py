"""Which parameters only say where frames stand: of the base in the rig, of the tool on the flange.

A parameter of the first constants moves the whole robot by one twist of the base, whatever the pose; one of the last
constants moves the end by one twist in the end's own axes. With generic joint readings these are told from all others, and
from a twist that only the poses of one table make look constant.

Where what the rig leaves unknown (a tracker's pose, a target's place, sockets) can take up such a motion, or no observation
sees it (the base about the only chuck, the tool about the only sphere), it is a choice of frame and not a parameter of
the robot: no measurement of this kind can ever find it, and no use of the robot needs it. Directions of the data's null
space over these parameters and the rig are such choices; as many parameters are held as there are directions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from truearm.estimate.identifiability import null_basis, project_out
from truearm.estimate.information import RANK_TOLERANCE, scaled_columns
from truearm.model.chain import Chain, about, along, forward, trace_point
from truearm.types import Floats

N_POSES = 12
RANGE = np.pi  # rad, m: of joints whose limits are wider
CONSTANT = 1e-9  # of the largest twist: rounding leaves 1e-15


class Mounting(NamedTuple):
    """Masks (p,) of the parameters that only move the base, and of those that only move the tool; their twists (6, p)."""

    base: NDArray[np.bool_]
    tool: NDArray[np.bool_]
    base_twist: Floats  # in the base frame, (turn; velocity of the origin), of those of the base
    tool_twist: Floats  # in the end's own axes

    @property
    def either(self) -> NDArray[np.bool_]:
        return self.base | self.tool


def mounting(chain: Chain, params: Floats) -> Mounting:
    """The parameters whose motion is one twist of the base, or one of the end, in every pose."""
    rng = np.random.default_rng(0)
    lower, upper = (np.array([getattr(joint, side) for joint in chain.joints]) for side in ("lower", "upper"))
    q = rng.uniform(np.maximum(lower, -RANGE), np.minimum(upper, RANGE), (N_POSES, len(chain.joints)))
    pose = forward(chain, params, q)
    trace = trace_point(chain, params, q, np.zeros(3))
    axes = np.eye(3)[:, None]
    turn, velocity = about(trace, axes).jac_params, along(trace, axes).jac_params  # (3, n, p) of the end, base axes
    at_base = velocity - np.cross(turn, trace.p_base.T[..., None], axis=0)
    at_end = [np.einsum("nki,knp->inp", pose[:, :3, :3], part) for part in (turn, velocity)]
    twists = [np.concatenate(parts) for parts in ((turn, at_base), at_end)]  # (6, n, p)
    base, tool = (np.ptp(of, axis=1).max(axis=0) <= CONSTANT * np.abs(of).max(initial=1.0) for of in twists)
    varies = np.isin(
        np.arange(params.size), chain.law.of_column
    )  # a curve's coefficient may do nothing in any of these poses
    return Mounting(base & ~varies, tool & ~varies, twists[0][:, 0], twists[1][:, 0])


def held_as_frames(
    root: Floats, mounted: Mounting, free: NDArray[np.bool_], named: NDArray[np.bool_], unit: Floats
) -> NDArray[np.bool_]:
    """(p,) which of the ``free`` (p,) parameters to hold, none of the ``named``, so that none of the others is a choice of frame.

    ``root`` (k, k) has the robot's free columns first and then the rig's; ``unit`` (p,) makes metres and radians comparable.
    """
    scaled, scale = scaled_columns(root)
    n_robot = int(free.sum())
    at = np.cumsum(free) - 1
    out = np.zeros(free.size, dtype=bool)
    for of, twist in ((mounted.base, mounted.base_twist), (mounted.tool & ~mounted.base, mounted.tool_twist)):
        which = np.flatnonzero(of & free)
        _, unseen = null_basis(project_out(scaled[:, at[which]], scaled[:, n_robot:]))
        # Two parameters of one motion are no choice of frame: the frame stays where it is.
        if unseen.shape[1] <= which.size - np.linalg.matrix_rank(twist[:, which], tol=CONSTANT):
            continue
        basis, _ = np.linalg.qr(unseen / (scale[at[which]] * unit[which])[:, None])
        may = ~named[which]
        triangle, order = scipy.linalg.qr(basis[may].T, mode="r", pivoting=True)
        out[which[may][order[: int((np.abs(np.diag(triangle)) > RANK_TOLERANCE).sum())]]] = True
    return out
