"""Two results for one robot, compared in a common gauge.

Parameters of two results must not be subtracted as they stand. Of a PUMA's 54 only 36 can be seen, so two results that
predict the same poses may differ by any amount along the other 18, depending on what each froze and where it started.
What can be compared is what they predict, T_a(q) and T_b(q); and parameters, once b is moved into a's gauge: of all
parameter vectors that predict what b predicts, the one nearest to a (metres and radians counting alike), by

    x ← a + J⁺·[(prediction of b − prediction at x) + J·(x − a)] ,  from x = a , J at x .

J⁺ has no part along directions that move nothing, so x − a holds what truly differs and none of the gauge.

Where the fixtures were mounted anew between the two (another rig, another day), links 1 and n + 1 have absorbed that.
``fixtures_moved`` then looks for T_a(q) = B·T_b(q)·E with B and E free, and leaves to the parameters only what no
mounting explains.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg

from truearm.errors import ProblemError
from truearm.estimate.identifiability import project_out
from truearm.model.chain import Chain, forward, point_jacobians
from truearm.types import Floats

LEVER = 0.1  # m: the end's orientation counts as much as the position of points this far out
MARKS = LEVER * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
SINGULAR = 1e-9  # of the largest singular value: below it a direction moves nothing
STEP_END = 1e-11  # m, rad; rounding of 1e-16 times what J⁺ may enlarge it
MAX_STEPS = 50


class Comparison(NamedTuple):
    """b against a over n poses."""

    position: Floats  # (n,) m, between the ends' origins
    orientation: Floats  # (n,) rad, angle between the ends' frames
    delta_params: Floats  # (p,) b − a in the gauge of a
    T_base_fixture: Floats  # (4, 4) B; the identity unless ``fixtures_moved``
    T_end_fixture: Floats  # (4, 4) E
    aligned: bool  # False if the alignment did not come to rest; delta_params is then not to be trusted


def compare(chain: Chain, a: Floats, b: Floats, q: Floats, *, fixtures_moved: bool = False) -> Comparison:
    """Compare two robots' parameters a, b (p,) over poses q (n, j), which should fill the workspace of interest.

    Position and orientation are those of T_a(q) against B·T_b(q)·E. Raises ProblemError for parameters that are not
    this robot's, and for no poses.
    """
    a, b, q = (np.asarray(v, dtype=float) for v in (a, b, q))
    p = len(chain.parameters)
    if a.shape != (p,) or b.shape != (p,):
        raise ProblemError(f"robot {chain.name} has {p} parameters, got {a.shape} and {b.shape}; compare one robot")
    if q.ndim != 2 or q.shape[1] != len(chain.joints) or len(q) == 0:
        raise ProblemError(f"poses to compare at must be (n, {len(chain.joints)}), are {q.shape}")
    T_b = forward(chain, b, q)
    left, right, x = np.eye(4), np.eye(4), a
    aligned = False
    for _ in range(MAX_STEPS):
        goal = left @ T_b @ right
        there, jac = _marks(chain, x, q)
        wanted = (goal @ _homogeneous(MARKS).T)[:, :3].swapaxes(1, 2)
        error = (wanted - there).ravel()
        frames = _fixture_columns(wanted, goal) if fixtures_moved else np.zeros((error.size, 0))
        part = jac @ (x - a)
        before, x = x, a + _least_norm(project_out(jac, frames), error + part)
        delta = x - before
        twist = _least_norm(frames, error - jac @ delta)
        if fixtures_moved:
            left, right = _exp(-twist[:6]) @ left, right @ _exp(-twist[6:])
        if max(np.abs(delta).max(initial=0.0), np.abs(twist).max(initial=0.0)) < STEP_END:
            aligned = True
            break
    position, orientation = _apart(forward(chain, a, q), left @ T_b @ right)
    return Comparison(position, orientation, x - a, left, right, aligned)


def _marks(chain: Chain, x: Floats, q: Floats) -> tuple[Floats, Floats]:
    """Marks on the end in the base frame (n, 4, 3), and their derivatives (n·4·3, p)."""
    traced = [point_jacobians(chain, x, q, mark) for mark in MARKS]
    jac = np.stack([t[1] for t in traced], axis=1)
    return np.stack([t[0] for t in traced], axis=1), jac.reshape(-1, jac.shape[-1])


def _fixture_columns(wanted: Floats, goal: Floats) -> Floats:
    """−∂wanted/∂(twist of B in the base frame, twist of E in the end frame), (n·4·3, 12); twists are (v; w)."""
    rot = goal[:, None, :3, :3]
    base = _point_by_twist(wanted)
    end = rot @ _point_by_twist(MARKS)
    return np.asarray(np.concatenate([base, np.broadcast_to(end, base.shape)], axis=-1).reshape(-1, 12))


def _point_by_twist(point: Floats) -> Floats:
    """(…, 3, 6): v + w × p for each unit twist."""
    turned = np.cross(np.eye(3), point[..., None, :]).swapaxes(-1, -2)
    return np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=-1)


def _least_norm(matrix: Floats, error: Floats) -> Floats:
    if matrix.shape[1] == 0:
        return np.zeros(0)
    return np.asarray(np.linalg.lstsq(matrix, error, rcond=SINGULAR)[0])


def _exp(twist: Floats) -> Floats:
    """The motion (4, 4) of a twist (v; w)."""
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = np.cross(np.eye(3), twist[3:])
    matrix[:3, 3] = twist[:3]
    return np.asarray(scipy.linalg.expm(matrix))


def _homogeneous(points: Floats) -> Floats:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def _apart(T_a: Floats, T_b: Floats) -> tuple[Floats, Floats]:
    """Distance [m] and angle [rad] between poses (n, 4, 4); the angle by its sine and cosine, exact near 0."""
    relative = T_a[:, :3, :3].swapaxes(1, 2) @ T_b[:, :3, :3]
    skew = relative - relative.swapaxes(1, 2)
    sine = 0.5 * np.sqrt(skew[:, 0, 1] ** 2 + skew[:, 0, 2] ** 2 + skew[:, 1, 2] ** 2)
    cosine = 0.5 * (np.trace(relative, axis1=1, axis2=2) - 1.0)
    return np.linalg.norm(T_a[:, :3, 3] - T_b[:, :3, 3], axis=1), np.arctan2(sine, cosine)
