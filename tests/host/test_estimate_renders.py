"""What Renders, Rossignol, Becquet, Hanus 1991 claim, and what follows from their model.

Their lines and unmodelled errors are not in the paper, so its millimetres cannot come out again; what can is their kind:
how fast a fit arrives, what their recipe does to the covariance, what is to be frozen, when weights help (ulb_bench.py).
"""

from dataclasses import replace

import numpy as np
import puma_bench
import pytest
from ulb_bench import CHAIN, NOMINAL, OFFSETS, S_Q, free, lines, rig, rows, straights

from truearm.estimate.identifiability import identifiability, suggested_free
from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.information import observe
from truearm.estimate.problem import build_problem
from truearm.model.chain import Chain, Element, Joint, Parameter, point_forward
from truearm.types import Rig

PRIOR = {CHAIN.parameter_names[i]: 0.052 for i in OFFSETS}


def wrong_offsets(rng):
    truth = NOMINAL.copy()
    truth[OFFSETS] += 0.052 * rng.normal(size=5)
    return truth


def nees(e, truth):
    error = (e.value[: len(truth)] - truth)[OFFSETS]
    return error @ np.linalg.solve(e.covariance[np.ix_(OFFSETS, OFFSETS)], error)


@pytest.fixture(scope="module")
def third_runs():
    """III-E a dozen times: four lines of 12 points, a fifth to validate, three runs of each recipe."""
    out = {"map": [], "renders-1991": []}
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth = wrong_offsets(rng)
        t = lines(5, 12, truth, rng)
        for solver, found in out.items():
            e = identify(
                CHAIN, rig(t), t, free=free(*OFFSETS), hold_out=t.line == "l4", prior_sigma=PRIOR, options=SolverOptions(solver=solver, max_iterations=3)
            )  # fmt: skip
            found.append((e, nees(e, truth)))
    return out


def test_map_arrives_in_three_runs(third_runs):
    """From millimetres to the noise: S_x and S_q make some 0.15 mm, of which the fit takes a part."""
    for e, _ in third_runs["map"]:
        assert e.rms_before["m"] > 1e-3
        assert np.mean(e.residual["m"][e.fitted]) <= 0.2e-3
        assert e.held_out.figures["m"].mean <= 0.3e-3
    # By then all but the last tenths of a σ are gone: the median fits as its noise allows.
    assert abs(np.median([e.chi2_reduced for e, _ in third_runs["map"]]) - 1.0) < 2 * np.sqrt(2 / (3 * 48))


def test_the_covariance_of_map_holds(third_runs):
    """NEES of five offsets over a dozen robots: 5 ± 3 standard errors of a mean of χ²(5)."""
    assert abs(np.mean([n for _, n in third_runs["map"]]) - 5.0) < 3 * np.sqrt(2 * 5 / 12)


def test_the_papers_recipe_is_worse_and_does_not_know_it(third_runs):
    found = third_runs["renders-1991"]
    of_map = np.array([np.mean(e.residual["m"][e.fitted]) for e, _ in third_runs["map"]])
    of_paper = np.array([np.mean(e.residual["m"][e.fitted]) for e, _ in found])
    assert np.median(of_paper / of_map) > 1.5
    assert np.median([n for _, n in found]) > 10 * 5
    for (e, _), (good, _) in zip(found, third_runs["map"], strict=True):
        # Three runs on the same data claim what three times the data would: σ smaller by about sqrt(3).
        seen = e.identifiable[: len(NOMINAL)] & e.free[: len(NOMINAL)]
        assert np.median(good.sigma[: len(NOMINAL)][seen] / e.sigma[: len(NOMINAL)][seen]) > 1.4
        assert "3 runs" in e.message
        assert "too small" in e.message
        assert "map" in e.message


def test_more_runs_of_the_recipe_help_slowly():
    rng = np.random.default_rng(1)
    truth = wrong_offsets(rng)
    t = lines(4, 12, truth, rng)
    how = {"free": free(*OFFSETS), "prior_sigma": PRIOR}
    few, many = (
        identify(CHAIN, rig(t), t, options=SolverOptions("renders-1991", max_iterations=m), **how) for m in (3, 30)
    )
    assert many.rms_after["m"] < few.rms_after["m"]
    assert many.sigma[OFFSETS[0]] < few.sigma[OFFSETS[0]] / 1.5


@pytest.mark.parametrize(("truth", "runs"), [(puma_bench.TRUTH, range(5, 30)), (puma_bench.DESIGN, range(1, 2))])
def test_the_recipe_ends_on_data_without_noise(truth, runs):
    """Its error fades as that of the first run over k, so what run k gains as 1/k²: below 0.01 σ after ten or twenty."""
    t = puma_bench.random_table(200, np.random.default_rng(0), truth=truth)
    e = identify(
        puma_bench.CHAIN, puma_bench.RIG, t, free=puma_bench.FREE, options=SolverOptions(solver="renders-1991")
    )
    assert (e.status, e.iterations in runs) == ("converged", True)
    assert e.rms_after["m"] < 0.2 * puma_bench.SIGMA  # (runs − 1)⁻¹ of 1.6 σ after the first


def test_first_run_of_the_recipe_is_the_first_of_map():
    rng = np.random.default_rng(2)
    t = lines(4, 12, wrong_offsets(rng), rng)
    how = {"free": free(*OFFSETS), "prior_sigma": PRIOR}
    one, other = (
        identify(CHAIN, rig(t), t, options=SolverOptions(s, max_iterations=1), **how) for s in ("map", "renders-1991")
    )
    np.testing.assert_allclose(other.value, one.value, atol=1e-10)


def test_weights_matter_least_squares_claims_less_than_it_knows():
    """Without S_q the residuals pass for sensor noise: χ² says so."""
    rng = np.random.default_rng(3)
    t = lines(4, 60, wrong_offsets(rng), rng)
    blind = replace(rig(t), joint_cov=())
    e = identify(CHAIN, blind, t, free=free(*OFFSETS), prior_sigma=PRIOR, options=SolverOptions(solver="map"))
    assert e.chi2_reduced > e.chi2_band[1]
    told = identify(CHAIN, rig(t), t, free=free(*OFFSETS), prior_sigma=PRIOR, options=SolverOptions(solver="map"))
    assert told.chi2_band[0] < told.chi2_reduced < told.chi2_band[1]
    assert S_Q[5, 5] > S_Q[0, 0]


# --- what to freeze -------------------------------------------------------------------------------------------------


def by_hand(a6):
    """The ULB robot with all of Table I's parameters, d2 and β2 both: θ, d, a, α of each row, then β after α2."""
    table = [(-0.5, 0, 0), (0, 0.35, 0), (0.5, 0, 0), (-0.5, 0, 0.35), (0.5, 0, 0), (0, a6, 0.1)]
    elements, parameters = [], []

    def add(motion, name, unit, value):
        elements.append(Element(motion, parameter=len(parameters)))
        parameters.append(Parameter(name, unit, value))

    for i, (alpha, a, d) in enumerate(table, start=1):
        elements.append(Element("rz", joint=i - 1))
        parameters.append(Parameter(f"theta{i}", "rad", 0.0, "offset", i - 1))
        add("tz", f"d{i}", "m", float(d))
        add("tx", f"a{i}", "m", float(a))
        add("rx", f"alpha{i}", "rad", alpha * np.pi)
        if i == 2:
            add("ry", "beta2", "rad", 0.0)
    joints = tuple(Joint(f"joint{i}", "revolute", -np.pi, np.pi) for i in range(1, 7))
    return Chain("ulb by hand", tuple(elements), tuple(parameters), joints)


FROZEN = ("theta1", "alpha6", "d1", "d2")  # III-D


def root_of(chain, bow=2e-3, n_lines=10):
    """The triangle of ten lines, all parameters free; the tool turns on its way and leaves the line by ``bow`` [m].

    With one orientation a line more is lost, since a device that stands anywhere takes the tool's step for its own.
    """
    rng = np.random.default_rng(4)
    tables = []
    for i, q in enumerate(straights(n_lines, 12, rng)):
        q = q + 0.2 * rng.normal(size=q.shape)
        p = point_forward(chain, chain.params_nominal, q, np.zeros(3))
        tables.append(rows(f"l{i}", q, p + bow * rng.normal(size=p.shape)))
    t = type(tables[0]).joined(tables)
    problem = build_problem(chain, Rig(), t)
    return observe(problem, problem.start, np.ones(len(problem.names), bool)).root, problem


@pytest.mark.parametrize(("a6", "all_free", "frozen"), [(0.0, 7, 3), (0.05, 4, 0)])
def test_what_the_paper_freezes_is_what_cannot_be_seen(a6, all_free, frozen):
    chain = by_hand(a6)
    root, problem = root_of(chain)
    names = chain.parameter_names
    found = identifiability(root, 25, problem.names)
    assert len(names) - found.rank == all_free
    assert found.gap > 1e4
    rest = [i for i, name in enumerate(problem.names) if name not in FROZEN]
    of_robot = len(names) - len(FROZEN)
    left = identifiability(np.linalg.qr(root[:, rest], mode="r"), of_robot, [problem.names[i] for i in rest])
    assert of_robot - left.rank == frozen
    prefer = np.array([name not in FROZEN for name in names])
    free_set = suggested_free(root, 25, prefer)
    assert free_set.sum() == 25 - all_free
    assert not free_set[~prefer].any()  # of equals, those of the paper are frozen
    if a6 == 0.0:
        held = {name for name, is_free in zip(names, free_set, strict=True) if not is_free} - set(FROZEN)
        assert "theta6" in held
        assert len(held & {"theta5", "a5"}) == 1
        assert len(held & {"alpha5", "d5"}) == 1
