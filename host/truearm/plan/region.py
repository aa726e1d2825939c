"""Where accuracy is wanted: a box in the base frame, and poses of the arm whose point of interest is inside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from truearm.arguments import floats
from truearm.errors import Argument, InputError, PlanError
from truearm.model.chain import point_forward
from truearm.plan.measurement_limits import Site, allowed
from truearm.types import Floats

N_POSES = 300


@dataclass(frozen=True, init=False)
class Region:
    """A cuboid in the base frame, with edges along its axes.

    Parameters
    ----------
    lower, upper : array (3,)
        Its corners [m], none of ``lower`` above ``upper``.

    Raises
    ------
    TypeError, InputError
        If one is not three finite numbers, or they are in the wrong order.

    Examples
    --------
    >>> import truearm
    >>> region = truearm.Region([0.3, -0.2, 0.1], [0.6, 0.2, 0.4])
    >>> truearm.BallBarOptions(region=region).criterion
    'I'
    """

    lower: Floats
    upper: Floats

    def __init__(self, lower: ArrayLike, upper: ArrayLike) -> None:
        object.__setattr__(self, "lower", floats("lower", lower, 3))
        object.__setattr__(self, "upper", floats("upper", upper, 3))
        if (self.lower > self.upper).any():
            raise InputError(Argument("lower"), " of a region must not lie above ", Argument("upper"))


def around(points: Floats) -> Region:
    """Return the smallest box around points (n, 3)."""
    return Region(points.min(axis=0), points.max(axis=0))


def poses_in(site: Site, region: Region, p_end_point: Floats, seed: int = 0) -> Floats:
    """Return N_POSES random poses (n, j), or fewer if they are rare, of the arm's branch with a point (3,) of the end inside the region.

    Raises PlanError if none of 200,000 random poses is.
    """
    rng, arm = np.random.default_rng([seed, 0x4E610]), site.arm
    poses = np.zeros((0, len(arm.chain.joints)))
    for _ in range(10):
        q = rng.uniform(arm.branch.lower, arm.branch.upper, (20_000, len(arm.branch.lower)))
        points = point_forward(arm.chain, arm.params, q, p_end_point)
        q = q[((points >= region.lower) & (points <= region.upper)).all(axis=1)]
        poses = np.concatenate([poses, q[allowed(site, q, None)]])
        if len(poses) >= N_POSES:
            return poses[:N_POSES]
    if not len(poses):
        raise PlanError("the arm cannot reach the region; ask for another ", Argument("region"))
    return poses
