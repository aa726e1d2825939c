"""Plans of lines: inside the workspace and the device's reach, where the error is large, and foretold as identified."""

from dataclasses import replace

import numpy as np
import pytest
from tests.host import plan_bench as bench

from truearm.errors import PlanError
from truearm.estimate.identify import identify
from truearm.model.chain import point_forward
from truearm.plan.lines import LinesWanted, a_priori, candidate_lines, driven_lines, line_rows, lines_csv, plan_lines
from truearm.plan.region import Region
from truearm.plan.way import Pace
from truearm.types import NullDirection, Point

POINT = np.array([0.03, -0.02, 0.12])
WANTED = LinesWanted(n_lines=4, n_points=9, length=0.35, n_candidates=24)
NAME = "irb120"


@pytest.fixture(scope="module")
def known():
    rig = replace(bench.RIGS[NAME], targets={"ball": Point("ball", tuple(POINT.tolist()))})
    return replace(bench.known(NAME), rig=rig)


@pytest.fixture(scope="module")
def planned(known):
    return plan_lines(bench.site(NAME), known, WANTED, Pace(), target="ball")


def test_points_lie_evenly_on_straight_lines_of_the_length_asked_for(planned):
    assert planned.q.shape == (4, 9, 6)
    for q in planned.q:
        p = point_forward(bench.known(NAME).chain, bench.known(NAME).params, q, POINT)
        steps = np.diff(p, axis=0)
        # each point is within 1e-8 m of its place
        np.testing.assert_allclose(steps, np.broadcast_to((p[-1] - p[0]) / 8, (8, 3)), atol=3e-8)
        assert np.linalg.norm(p[-1] - p[0]) == pytest.approx(0.35, abs=3e-8)


def test_the_whole_way_along_a_line_keeps_to_limits_and_sensors(planned):
    lower, upper = np.array([(j.lower, j.upper) for j in bench.known(NAME).chain.joints]).T
    for line in planned.q:
        q = np.concatenate([a + np.linspace(0, 1, 20)[:, None] * (b - a) for a, b in zip(line[:-1], line[1:])])  # noqa: RUF007
        assert (q > lower + bench.LIMITS.joint_margin).all()
        assert (q < upper - bench.LIMITS.joint_margin).all()
        assert bench.condition(NAME, q).min() > bench.LIMITS.singular_value
        arm = bench.arm_points(NAME, q)
        assert arm[..., 2].min() > bench.SIZES.link
        p = point_forward(bench.known(NAME).chain, bench.known(NAME).params, q, POINT)
        u = (p[-1] - p[0]) / np.linalg.norm(p[-1] - p[0])
        off = (p - p[0]) - ((p - p[0]) @ u)[:, None] * u
        assert np.linalg.norm(off, axis=1).max() < 0.0075


def test_the_true_robot_stays_within_the_transverse_sensors(planned):
    """Tolerances of a drawing, 1 mm and 5 mrad a parameter, 200 robots: 2σ each way is exceeded by few."""
    chain = bench.known(NAME).chain
    rng = np.random.default_rng(5)
    sigma = np.array([{"m": 1e-3, "rad": 5e-3, "1": 1e-3}[p.unit] for p in chain.parameters])
    out = 0
    for _ in range(200):
        params = chain.params_nominal + sigma * rng.standard_normal(sigma.size)
        p = point_forward(chain, params, planned.q[0], POINT)
        middle = p - p.mean(axis=0)
        u = np.linalg.svd(middle)[2][0]
        off = np.linalg.norm(middle - (middle @ u)[:, None] * u, axis=1).max()
        out += off > 0.0075
    assert out < 0.05 * 200


def test_lines_lie_where_the_error_is_large(planned, known):
    site = bench.site(NAME)
    every = a_priori(site, candidate_lines(site, WANTED, POINT, None), POINT)
    assert planned.error.min() >= np.median(every) - 1e-12


def test_foretold_is_what_identification_reports(known):
    wanted = WANTED._replace(n_lines=8, n_points=12)
    planned = plan_lines(bench.site(NAME), known, wanted, Pace(), target="ball")
    rng = np.random.default_rng(2)
    sigma = np.array([{"m": 1e-3, "rad": 4e-3, "1": 0.0}[p.unit] for p in known.chain.parameters]) * known.free
    truth = replace(known, params=known.params + sigma * rng.standard_normal(sigma.size))
    table, _ = line_rows(truth, planned.q, "ball", POINT)
    cov = np.array(planned.devices["plan1"].sensor_cov)
    table = replace(table, xyz=table.xyz + rng.standard_normal(table.xyz.shape) * np.sqrt(np.diag(cov)))
    found = identify(known.chain, replace(known.rig, lines=planned.devices), table, free=known.free)
    told = planned.forecast
    assert found.rank == told.rank
    # parameters with small weights in a direction come and go with the values that they have
    assert [d.names[0] for d in found.null_space] == [d.names[0] for d in told.null_space]
    assert told.null_space[:3] == tuple(NullDirection((f"base.{k}",), (1.0,)) for k in "xyz")
    seen = found.free & np.isfinite(found.sigma)
    seen[found.n_robot_parameters :] = False
    ratio = told.sigma[seen] / found.sigma[seen]
    assert ratio.min() > 0.9
    assert ratio.max() < 1.1
    assert told.relative


def test_points_out_of_reach_are_not_a_number():
    site = bench.site(NAME)
    q = np.array([[0.1, 0.2, 0.1, 0.3, 0.8, 0.1]])
    p = point_forward(site.arm.chain, site.arm.params, q, POINT)
    far = driven_lines(site, q, p, np.array([[1.0, 0.0, 0.0]]), np.array([-2.0, 0.0, 2.0]), POINT)
    assert np.isnan(far).all()


def test_the_csv_has_every_point(planned):
    rows = [line.split(",") for line in lines_csv(planned).splitlines()]
    assert rows[0] == ["pose", "line", "x_mm", "y_mm", "z_mm", *(f"q{i}_rad" for i in range(1, 7))]
    np.testing.assert_array_equal([[float(v) for v in row[5:]] for row in rows[1:]], planned.q.reshape(-1, 6))
    assert [row[1] for row in rows[1::9]] == ["plan1", "plan2", "plan3", "plan4"]


def test_a_workspace_too_small_is_said(known):
    nowhere = Region(np.array([0.3, 0.0, 0.3]), np.array([0.3001, 0.0001, 0.3001]))
    with pytest.raises(PlanError, match="lines of 350 mm fit"):
        candidate_lines(bench.site(NAME), WANTED, POINT, nowhere)
