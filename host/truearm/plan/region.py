"""Where accuracy is wanted: a box in the base frame, and poses of the arm with its point of interest inside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.errors import Argument, PlanError
from truearm.model.chain import point_forward
from truearm.plan.measurement_limits import Site, allowed
from truearm.types import Floats

N_POSES = 300


class Region(NamedTuple):
    """A box of the base frame [m]."""

    lower: Floats  # (3,)
    upper: Floats  # (3,)


def around(points: Floats) -> Region:
    """The smallest box around points (n, 3)."""
    return Region(points.min(axis=0), points.max(axis=0))


def poses_in(site: Site, region: Region, p_end_point: Floats, n: int = N_POSES, seed: int = 0) -> Floats:
    """(n, j) poses of the arm's branch, drawn by chance, with a point (3,) of the end inside the region.

    Raises PlanError where not one of 200,000 drawn is.
    """
    rng, arm = np.random.default_rng([seed, 0x4E610]), site.arm
    kept = np.zeros((0, len(arm.chain.joints)))
    for _ in range(10):
        q = rng.uniform(arm.branch.lower, arm.branch.upper, (20_000, len(arm.branch.lower)))
        at = point_forward(arm.chain, arm.params, q, p_end_point)
        q = q[((at >= region.lower) & (at <= region.upper)).all(axis=1)]
        kept = np.concatenate([kept, q[allowed(site, q, None)]])
        if len(kept) >= n:
            return kept[:n]
    if not len(kept):
        raise PlanError("the arm reaches no place of the region; give another ", Argument("region"))
    return kept
