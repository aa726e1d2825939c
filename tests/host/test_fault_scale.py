"""Lengths of two instruments that contradict each other: a laser tracker with a wrong scale beside a ball-bar."""

import fault_worlds as worlds
import numpy as np
import pytest
from puma_bench import CHAIN, DESIGN, FREE, SIGMA, TRUTH, random_poses

from truearm.checks.examination import examined
from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.problem import build_problem
from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward
from truearm.results import Effect
from truearm.types import Device, Point, Rig

TRACKER_SIGMA = 5e-5  # m
PLACE = (1.5, 0.2, 0.5)
COV = tuple(tuple(TRACKER_SIGMA**2 * (i == k) for k in range(3)) for i in range(3))
REFLECTOR = Point("a", (0.1, 0.0, 0.05))
RIG = Rig(
    worlds.RIG.chucks,
    worlds.RIG.spheres,
    worlds.RIG.bars,
    trackers={"t": Device("t", COV, PLACE)},
    targets={"a": REFLECTOR},
)


def both(seed, scale=1.0, zero=0.0, bars=150, points=100):
    """Return lengths of the bar, then points of the tracker, with errors of the tracker's scale and of the bar's zero."""
    rng, plan = np.random.default_rng(seed), worlds.plan()
    some = np.sort(rng.choice(len(plan), bars, replace=False))
    q = random_poses(points, rng)
    at = point_forward(CHAIN, TRUTH, q, np.array(REFLECTOR.xyz)) - PLACE

    def first(values):
        return np.concatenate([values[some], np.full(points, "")])

    return ObservationTable(
        q=np.concatenate([plan.q[some], q]),
        kind=np.array(["ball_bar"] * bars + ["position"] * points),
        value=np.append(worlds.lengths(plan)[some] + zero + SIGMA * rng.normal(size=bars), np.full(points, np.nan)),
        bar=first(plan.bar),
        chuck=first(plan.chuck),
        sphere=first(plan.sphere),
        xyz=np.concatenate([np.full((bars, 3), np.nan), scale * at + TRACKER_SIGMA * rng.normal(size=at.shape)]),
        tracker=np.array([""] * bars + ["t"] * points),
        target=np.array([""] * bars + ["a"] * points),
        source=np.array([f"poses.csv row {i + 2}" for i in range(bars + points)]),
    )


def examination(table, *effects, rig=RIG):
    estimate = identify(CHAIN, rig, table, free=FREE, prefer=FREE, options=SolverOptions(effects=effects))
    return estimate, examined(CHAIN, rig, table, estimate, effects).faults


@pytest.mark.parametrize("ppm", [500.0, -500.0])
def test_the_scale_of_a_tracker_is_named_and_not_the_bar(ppm):
    """Air that is 0.5 ‰ wrong (seed 940000)."""
    rows = both(940000, scale=1.0 + 1e-6 * ppm)
    before, (fault,) = examination(rows)
    assert fault.rivals[0].apply == "tracker.t.scale"
    assert fault.sizes[0].value == pytest.approx(5e-4, abs=4.0 * fault.sizes[0].sigma)
    after, left = examination(rows, Effect("tracker.t.scale"))
    assert not left
    assert after.chi2_reduced < after.chi2_band[1]
    assert worlds.tool_error(after, worlds.plan()) < worlds.tool_error(before, worlds.plan())


def test_the_bar_is_named_or_both_or_neither():
    _, (fault,) = examination(both(940001, zero=0.3e-3))
    names = [rival.name for rival in fault.rivals]
    assert "bar.bar46.zero.offset" in names
    assert "tracker.t.scale.offset" not in names
    # One mount: the bar's lengths all change by the same amount, as by its zero. Seed 940102, air that is 1 ‰ wrong.
    rows = both(940102, scale=1.001)
    rows = rows.select((rows.kind == "position") | ((rows.chuck == rows.chuck[0]) & (rows.sphere == rows.sphere[0])))
    _, (fault,) = examination(rows)
    assert {rival.name for rival in fault.rivals} >= {"bar.bar46.zero.offset", "tracker.t.scale.offset"}
    assert not examination(both(940002))[1]
    # The robot's lengths follow it: to first order nothing is left that only a scale explains.
    rows = both(940003, scale=1.0005, bars=0)
    rig = Rig(trackers=RIG.trackers, targets={"a": Point("a", REFLECTOR.xyz, None)})
    assert not examination(rows, rig=rig)[1]


def test_points_of_a_wrong_scale_and_their_derivatives_are_exact():
    rows = both(940004, bars=0, points=4)
    problem = build_problem(CHAIN, RIG, rows, None, [Effect("tracker.t.scale")])
    (group,) = problem.groups
    at = point_forward(CHAIN, DESIGN, rows.q, np.array(REFLECTOR.xyz)) - PLACE
    x = problem.start.copy()
    x[-1] = 0.01
    lin = group.evaluate(CHAIN, x)
    assert rows.xyz.ravel() - lin.residual == pytest.approx(1.01 * at.ravel(), abs=1e-12)
    steps = 1e-6 * np.eye(x.size)
    away = [group.evaluate(CHAIN, x + step).residual - group.evaluate(CHAIN, x - step).residual for step in steps]
    assert lin.jac_params == pytest.approx(-np.array(away).T / 2e-6, abs=1e-8)
