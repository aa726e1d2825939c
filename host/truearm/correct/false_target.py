"""False targets: the controller keeps its nominal model, and is told another target (Renders 1991, IV-B).

The controller brings the arm to q = f_n⁻¹(x_m), the end to f_i(q). Told the desired x_d, the end stands at
x_n = f_i(f_n⁻¹(x_d)), and the mirror image of that error is told instead:

    x_m = x_d + (x_d − x_n)                                   (32)

One step leaves an error of second order. Iterated, x_m ← x_m + (x_d − f_i(f_n⁻¹(x_m))), it vanishes, unless a
singularity is near. Differences of orientations are rotation vectors in base axes, and turns are composed, not added.
"""

from __future__ import annotations

import numpy as np

from truearm.correct.inverse import inverse
from truearm.correct.pair import Pair, reached
from truearm.model.poses import apart, moved
from truearm.types import Floats


def false_target(pair: Pair, targets: Floats, q_nominal: Floats, oriented: bool = True, steps: int = 1) -> Floats:
    """Joint readings (n, j) to which the controller takes the false targets after ``steps`` steps of (32).

    targets : (n, 4, 4) x_d; q_nominal : (n, j) f_n⁻¹(x_d), of the configuration that the controller will take.
    A target whose iteration grows is left at its best step; NaN where the nominal robot does not reach the false target.
    """
    q, told_target = q_nominal.copy(), targets.copy()
    if not oriented:  # the controller keeps what orientation it has; only the origin is told another place
        told_target[:, :3, :3] = np.eye(3)
    best = np.full(len(q), np.inf)
    kept = q.copy()
    for step in range(steps + 1):
        error = apart(targets, reached(pair, q))
        size = np.linalg.norm(error if oriented else error[:, :3], axis=-1)
        better = size < best
        best, kept = np.where(better, size, best), np.where(better[:, None] | (step == 1), q, kept)
        if step == steps:
            break
        told_target = moved(told_target, error if oriented else error * ([1.0] * 3 + [0.0] * 3))
        found = inverse(pair.chain, pair.nominal, told_target, q, oriented)
        q = np.where(found.reached[:, None], found.q, np.nan)
        q = np.where(np.isnan(q), kept, q) if step else q
        if np.isnan(q).any():
            q = np.where(np.isnan(q), q_nominal, q)
    return kept
