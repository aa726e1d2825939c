"""A plan mounts no part that would determine only its own position."""

from dataclasses import replace

import numpy as np

from truearm.model.robot import builtin_robot
from truearm.plan.first_rig import first_rig
from truearm.plan.options import Budget
from truearm.workflows.plan import BallBarOptions, knowledge_of, planned_ball_bar


def test_a_chuck_that_nobody_measured_has_more_poses_than_coordinates_or_none():
    """40 poses of 300 candidates; chosen one by one they took two poses each of two more chucks, whose places that leaves unknown."""
    robot = builtin_robot("ur5e")
    rig = first_rig(robot)
    unknown = {
        name: {point: replace(at, sigma=None) for point, at in getattr(rig, name).items()}
        for name in ("chucks", "spheres")
    }
    known = knowledge_of(robot, replace(rig, **unknown))
    planned = planned_ball_bar(known, Budget(40), BallBarOptions(candidates=300), False)
    assert len(planned.route.plan) == 40
    for column in ("chuck", "sphere"):
        _, poses = np.unique(getattr(planned.route.plan, column), return_counts=True)
        assert poses.min() > 3
    sigma = dict(zip(planned.forecast.names, planned.forecast.sigma, strict=True))
    assert all(np.isfinite(sigma[f"chuck.{name}.x"]) for name in set(planned.route.plan.chuck.tolist()))
