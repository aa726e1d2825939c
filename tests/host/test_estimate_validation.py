"""Errors that are stated: of held-out poses, by the covariance, declared and unexplained; and the named priors."""

from dataclasses import replace

import numpy as np
import pytest
from tests.host import plan_bench as bench
from tests.host.findings_bench import stated
from tests.host.puma_bench import CHAIN, DESIGN, FREE, RIG, ROBOT, SIGMA, TRUTH, lengths, random_poses, random_table

import truearm
from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.uncertainty import tolerance_error, weak_prior, wide_prior
from truearm.estimate.validation import expected, judge, mean_errors
from truearm.kinds.table_file import concatenate
from truearm.model.chain import point_forward
from truearm.model.transforms import rotation
from truearm.plan.ball_bar_plan import all_pairings
from truearm.plan.bar_paths import Pace
from truearm.plan.forecast import bar_table
from truearm.plan.line_plan import line_rows, plan_lines
from truearm.plan.options import LineOptions
from truearm.plan.shells import candidates
from truearm.types import Plan, Point
from truearm.workflows.identify import write_page

NAME = "irb120"
DRAWS = 100
POINT = (0.03, -0.02, 0.12)


@pytest.fixture(scope="module")
def rows():
    """Return chain, rig and error-free rows: 30 lengths with a chuck known to 0.2 mm, and two lines with devices at unknown poses."""
    known = bench.known(NAME)
    chucks = known.rig.chucks | {"c1": replace(known.rig.chucks["c1"], sigma=2e-4)}
    rig = replace(known.rig, chucks=chucks, targets={"ball": Point("ball", POINT)}, time_offset_sigma=0.0)
    known = replace(known, rig=rig)
    wanted = LineOptions(lines=2, length=0.3, points=8, speed=0.08, candidates=4)
    planned = plan_lines(bench.site(NAME), known, wanted, Pace(), target="ball")
    lines, _ = line_rows(known, planned.lines, ["plan1", "plan2"], "ball")
    bars = bar_table(known, candidates(bench.site(NAME), all_pairings(rig), 27))
    return known, planned.rig, bars, lines


def drawn(rows, sigma, rng):
    """Return the readings of a robot whose parameters deviate by sigma (p,), with noise and a displaced chuck."""
    known, rig, bars, lines = rows
    params = known.params + sigma * rng.normal(size=sigma.size)
    chuck = replace(rig.chucks["c1"], xyz=tuple(rig.chucks["c1"].xyz + 2e-4 * rng.normal(size=3)))
    true = replace(known, params=params, rig=replace(rig, chucks=rig.chucks | {"c1": chuck}))
    plan = Plan(bars.q, bars.shell, bars.bar, bars.chuck, bars.sphere)
    value = bar_table(true, plan).value + bench.SIGMA * rng.normal(size=len(bars))
    ends = [point_forward(known.chain, p, lines.q, np.array(POINT)) for p in (known.params, params)]
    xyz = lines.xyz + np.array(rig.line_sigma) * rng.normal(size=lines.xyz.shape)
    for name, device in rig.lines.items():
        mine = lines.line == name
        xyz[mine] += (ends[1] - ends[0])[mine] @ rotation(np.array(device.rotation))
    return concatenate([replace(bars, value=value), replace(lines, xyz=xyz)])


def test_errors_are_as_large_as_expected(rows):
    known, rig, bars, lines = rows
    sigma = np.array([{"m": 1e-4, "rad": 2e-4, "1": 1e-5}[p.unit] for p in known.chain.parameters]) * known.free
    exact, p = concatenate([bars, lines]), sigma.size
    due = expected(judge(known.chain, rig, exact, known.params), np.diag(sigma**2), np.zeros((p, 0)))["m"]
    assert (due.by_parameters > 0.0).all()
    assert not due.unseen.any()
    rng = np.random.default_rng(5)
    tables = [drawn(rows, sigma, rng) for _ in range(DRAWS)]
    square = np.mean([judge(known.chain, rig, t, known.params).error["m"] ** 2 for t in tables], axis=0)
    ratio = np.sqrt(square / (due.by_noise + due.by_parameters))
    # A mean of DRAWS squares of one normal residual scatters by 7 % in its root.
    assert np.abs(ratio - 1.0).max() < 0.28
    bar = exact.kind == "ball_bar"
    for mine in (bar, ~bar, bar & (exact.chuck == "c1"), exact.line == "plan1"):
        assert np.mean(ratio[mine]) == pytest.approx(1.0, abs=0.05)


def test_rows_that_hang_on_what_was_not_seen_are_told(rows):
    """A device that stands anywhere does not feel how the base stands; a bar from a chuck of known place does."""
    known, rig, bars, lines = rows
    p = len(known.chain.parameters)
    base = np.array([[float(name == "base.z")] for name in known.chain.parameter_names])
    due = expected(judge(known.chain, rig, concatenate([bars, lines]), known.params), np.zeros((p, p)), base)["m"]
    assert np.array_equal(due.unseen, np.arange(len(due.unseen)) < len(bars))
    assert np.all(due.by_parameters == 0.0)


@pytest.fixture(scope="module")
def exact():
    """Return 200 lengths without noise and lm's estimate from them."""
    t = random_table(200, np.random.default_rng(0))
    return t, identify(CHAIN, RIG, t, free=FREE)


def found(exact, **how):
    """Return a fit of the exact lengths, and the largest deviation of its parameters in σ of lm's."""
    t, lm = exact
    e = identify(CHAIN, RIG, t, free=FREE, **how)
    return e, np.abs((e.value - lm.value)[: FREE.size][FREE] / lm.sigma[: FREE.size][FREE]).max()


def test_sigmas_by_unit():
    unit = np.array([p.unit for p in CHAIN.parameters])
    for prior, sigmas in ((weak_prior, (1e-3, 5e-3, 1e-3)), (wide_prior, (1e-2, 0.052, 1e-2))):
        for u, sigma in zip(("m", "rad", "1"), sigmas, strict=True):
            assert (prior(CHAIN)[unit == u] == sigma).all()


def test_map_without_a_prior_with_a_wide_and_with_a_weak_one(exact):
    e, off = found(exact, options=SolverOptions(solver="map"))
    assert e.status == "converged"
    assert off < 1e-6  # the end of the search, 1e-6 of what is left
    assert e.chi2_reduced < 1e-15
    # An error e by a prior M moves a fit of covariance P by PMe, in P's norm at most √(eᵀMe) √λ, λ the largest of PM.
    error, sigma = (TRUTH - DESIGN)[FREE], wide_prior(CHAIN)[FREE]
    assert ((error / sigma) ** 2).sum() < 36  # 4: what robots such as the prior believes in have
    covariance = exact[1].covariance[: FREE.size, : FREE.size][np.ix_(FREE, FREE)]
    largest = np.linalg.eigvalsh(covariance / np.multiply.outer(sigma, sigma))[-1]
    bound = np.linalg.norm(error / sigma) * np.sqrt(largest)
    e, off = found(exact, options=SolverOptions(solver="map"), prior_sigma=wide_prior(CHAIN))
    assert e.status == "converged"
    assert off < bound < 0.2
    assert e.chi2_reduced < bound**2 / (200 - 36)
    assert off < 0.02  # as the module says
    # 410 for 36: the prior is false, and the parameters are off by a σ of the data, without any noise.
    assert (((TRUTH - DESIGN) / weak_prior(CHAIN))[FREE] ** 2).sum() > 400
    _, off = found(exact, options=SolverOptions(solver="map"), prior_sigma=weak_prior(CHAIN))
    assert off > 0.5


N, RANK = 400, 36


@pytest.mark.parametrize("times", [1.0, 3.0])
def test_the_two_parts_are_what_was_declared_and_what_was_not(times):
    parts = identify(CHAIN, RIG, random_table(N, np.random.default_rng(0), times * SIGMA), free=FREE).parts["m"]
    left = np.sqrt(1.0 - RANK / N)  # of the residuals, as the parameters follow the others
    assert parts.declared == pytest.approx(SIGMA * left, rel=1e-9)
    # Mean squares of 364 degrees of freedom have a standard error of 7.4 %.
    assert parts.unexplained**2 == pytest.approx(
        (times**2 - 1.0) * (SIGMA * left) ** 2, abs=3.0 * 0.074 * (times * SIGMA) ** 2
    )


def test_they_stand_in_result_terminal_and_report(tmp_path):
    found = truearm.identify(ROBOT, random_table(N, np.random.default_rng(1), 3.0 * SIGMA), RIG)
    declared, unexplained = (found.document[f"rms_{name}_mm"] for name in ("declared", "unexplained"))
    assert declared**2 + unexplained**2 == pytest.approx(found.document["rms_after_mm"] ** 2)
    share = stated(found.document)["noise-share"]
    assert (share.values["declared"], share.values["unexplained"]) == ({"mm": declared}, {"mm": unexplained})
    assert share.values["rest"] == "is unexplained"
    write_page(tmp_path / "page.html", found)
    assert share.text() in (tmp_path / "page.html").read_text()
    found = truearm.identify(ROBOT, random_table(N, np.random.default_rng(0), 1.05 * SIGMA), RIG)
    assert found.document["chi2_reduced"] <= found.document["chi2_band"][1]
    assert found.document["rms_unexplained_mm"] > 0.0
    assert stated(found.document)["noise-share"].values["rest"] == "may be chance"


def test_intervals_hold_the_mean_and_count_poses():
    # In 95 % of 2000 draws of 30 poses; the counting's own standard deviation is 0.5 %, the skewness of |normal| costs 1
    # %.
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(2000):
        of = mean_errors({"m": rng.normal(size=30)}, np.arange(30), held_out=True)["m"]
        inside += of.low <= np.sqrt(2.0 / np.pi) <= of.high
    assert inside / 2000 == pytest.approx(0.95, abs=0.03)
    # Ten rows of each of 20 poses, alike within a pose, say no more than 20 rows.
    rng = np.random.default_rng(0)
    error = np.abs(rng.normal(size=20))
    of_poses = mean_errors({"m": error}, np.arange(20), held_out=True)["m"]
    of_rows = mean_errors({"m": np.repeat(error, 10)}, np.repeat(np.arange(20), 10), held_out=True)["m"]
    assert of_rows == pytest.approx(of_poses)
    assert of_poses.n == 20


def test_each_pose_is_left_out_in_turn():
    """Noise of three times the declared σ: the error of a pose as a fit without it has it."""
    t = random_table(120, np.random.default_rng(2), 3.0 * SIGMA)
    t = replace(t, q=np.repeat(t.q[::3], 3, axis=0))  # three rows a pose
    truth = lengths(TRUTH, t.q, list(zip(t.chuck, t.sphere, strict=True)))
    t = replace(t, value=truth + 3.0 * SIGMA * np.random.default_rng(3).normal(size=120))
    e = identify(CHAIN, RIG, t, free=FREE)
    assert e.chi2_reduced > e.chi2_band[1]
    found = e.unexplained["m"]
    assert (found.n, found.held_out) == (40, False)
    errors = []
    for pose in range(40):
        held = np.arange(120) // 3 == pose
        errors.append(np.abs(identify(CHAIN, RIG, t, free=FREE, hold_out=held).residual["m"][held]).mean())
    assert found.mean == pytest.approx(np.mean(errors), rel=0.02)  # what the linearisation leaves
    judged = identify(CHAIN, RIG, t, free=FREE, hold_out=np.arange(120) < 15)
    assert judged.unexplained["m"].held_out
    assert judged.unexplained["m"].n == 5


def test_explained_residuals_need_no_other_figure():
    assert identify(CHAIN, RIG, random_table(200, np.random.default_rng(4), SIGMA), free=FREE).unexplained == {}


def test_prediction_is_the_spread_of_sampled_robots():
    rng = np.random.default_rng(0)
    sigma = np.where([p.unit == "m" for p in CHAIN.parameters], 1e-5, 2e-5)
    q, tool = random_poses(40, rng), np.array([0.01, 0.02, 0.1])
    error = tolerance_error(CHAIN, sigma, q, tool)
    runs = 1000
    ends = np.array([point_forward(CHAIN, DESIGN + sigma * rng.normal(size=54), q, tool) for _ in range(runs)])
    moved = ends - point_forward(CHAIN, DESIGN, q, tool)
    # The mean square of a norm with up to three unequal components has a relative standard error ≤ sqrt(2/runs).
    ratio = (moved**2).sum(axis=2).mean(axis=0) / error**2
    np.testing.assert_allclose(ratio, 1.0, atol=4.5 * np.sqrt(2 / runs))
