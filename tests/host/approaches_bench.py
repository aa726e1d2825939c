"""The run planned by ``truearm plan characterize`` for the simulator's PUMA 560, planned once."""

import functools

from truearm.model.robot_file import builtin_robot
from truearm.plan.approaches import plan_approaches
from truearm.plan.ball_bar_plan import make_site
from truearm.plan.bar_paths import Pace
from truearm.plan.forecast import Knowledge
from truearm.plan.measurement_limits import Limits, Pairing, Site, Sizes
from truearm.plan.options import ApproachOptions
from truearm.plan.route import Route
from truearm_sim.world import standard_rig

PAIRING = Pairing("bar46", "c1", "s1")
WANTED = ApproachOptions(poses=4, rounds=3, long_dwell=10.0, candidates=200)


@functools.cache
def planned() -> tuple[Site, Route]:
    """Return the arm with its rig as designed, and the route."""
    robot, rig = builtin_robot("puma560"), standard_rig()
    site = make_site(Knowledge.design(robot, rig), Limits(), Sizes())
    return site, plan_approaches(site, PAIRING, WANTED, Pace())
