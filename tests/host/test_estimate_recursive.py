"""The recursive estimator: it agrees with the batch estimate, and its outlier gate does not depend on the order of the rows."""

import re

import numpy as np
import pytest
from puma_bench import CHAIN, FREE, RIG, SIGMA, random_table, shell_table
from scipy import stats
from ulb_bench import CHAIN as ULB
from ulb_bench import NOMINAL as ULB_NOMINAL
from ulb_bench import OFFSETS, free, lines, rig

from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.information import observe, with_prior
from truearm.estimate.problem import build_problem
from truearm.estimate.recursive import rows_of, run, start
from truearm.estimate.whitened_rows import distance_without, gate, leverages

PRIOR = np.where(np.isin(np.arange(len(ULB.parameters)), OFFSETS), 0.052, np.inf)


@pytest.fixture(scope="module")
def ulb():
    """Return four lines of 12 points, as in III-E, with offsets wrong by some degrees."""
    rng = np.random.default_rng(1)
    truth = ULB_NOMINAL.copy()
    truth[OFFSETS] += 0.052 * rng.normal(size=5)
    return lines(4, 12, truth, rng)


def test_a_pass_is_the_batch_solution(ulb):
    """(12) against (18), (20): the same to 1e-7 of a σ, P to 1e-10."""
    problem = build_problem(ULB, rig(ulb), ulb, PRIOR)
    columns = np.concatenate([free(*OFFSETS), np.ones(24, dtype=bool)])
    x, sigma = problem.start, problem.prior_sigma[columns]
    rows = rows_of(problem, x, columns)
    passed = run(start(np.zeros(29), sigma), rows, np.ones(48, dtype=bool))[0]
    data = with_prior(observe(problem, x, columns), np.zeros(29), sigma)
    P = np.linalg.inv(data.root.T @ data.root)
    batch = np.linalg.solve(data.root, data.rhs)
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(passed.delta / scale, batch / scale, rtol=1e-7, atol=1e-7)
    got = passed.root @ passed.root.T
    np.testing.assert_allclose(got / scale / scale[:, None], P / scale / scale[:, None], atol=1e-10)
    mixed = [rows[i] for i in np.random.default_rng(2).permutation(48)]
    again = run(start(np.zeros(29), sigma), mixed, np.ones(48, dtype=bool))[0]
    np.testing.assert_allclose(again.delta / scale, passed.delta / scale, rtol=1e-7, atol=1e-7)


def test_relinearised_it_ends_where_map_ends(ulb):
    """The data count once: estimate and σ are those of the batch with one fixed prior."""
    map_, recursive = (
        identify(ULB, rig(ulb), ulb, free=free(*OFFSETS), prior_sigma=PRIOR, options=SolverOptions(solver=s))
        for s in ("map", "recursive")
    )
    assert (map_.status, recursive.status) == ("converged", "converged")
    seen = map_.identifiable & map_.free
    # Both end within 1e-6 of flat in whitened units.
    np.testing.assert_allclose(recursive.value[seen], map_.value[seen], atol=1e-4 * map_.sigma[seen].min())
    np.testing.assert_allclose(recursive.sigma[seen], map_.sigma[seen], rtol=1e-5)
    assert recursive.rms_after["m"] == pytest.approx(map_.rms_after["m"], rel=1e-6)
    assert recursive.rms_before["m"] > 10 * recursive.rms_after["m"]


def test_deleted_distances_and_the_gate():
    rng = np.random.default_rng(4)
    jac, residual = rng.normal(size=(12, 2, 5)), rng.normal(size=(12, 2))
    flat, values = jac.reshape(-1, 5), residual.ravel()
    P = np.linalg.inv(flat.T @ flat)
    left = residual - jac @ (P @ flat.T @ values)
    found = distance_without(leverages(jac @ np.linalg.cholesky(P)), left, np.ones(12))
    for i in range(12):
        keep = np.repeat(np.arange(12) != i, 2)
        rest = np.linalg.inv(flat[keep].T @ flat[keep])
        nu = residual[i] - jac[i] @ rest @ flat[keep].T @ values[keep]
        expected = nu @ np.linalg.solve(np.eye(2) + jac[i] @ rest @ jac[i].T, nu)
        assert found[i] == pytest.approx(expected, rel=1e-9)
        out = distance_without(leverages(jac[i : i + 1] @ np.linalg.cholesky(rest)), nu[None], np.zeros(1))
        assert out[0] == pytest.approx(expected, rel=1e-9)
    jac = np.array([[[1.0, 0.0]], [[1.0, 0.0]], [[0.0, 1e-3]]])
    P = np.diag([0.5, 1e6])
    assert distance_without(leverages(jac @ np.sqrt(P)), np.array([[0.5], [-0.5], [1e-9]]), np.ones(3))[2] == 0.0
    assert gate(1) == pytest.approx(stats.chi2.isf(1e-6, 1))
    np.testing.assert_allclose(gate(np.array([1, 3])), stats.chi2.isf(1e-6, [1, 3]))


@pytest.fixture(scope="module")
def shells():
    """Return 800 noise-free lengths on the 46 cm shells."""
    return shell_table(800, 0.46, np.random.default_rng(5))


def noisy(t, seed, fault=None, size=10.0):
    noise = np.random.default_rng(seed).normal(size=len(t))
    if fault is not None:
        noise[fault] = size
    return type(t)(**{**vars(t), "value": t.value + SIGMA * noise})


@pytest.mark.parametrize("solver", ["recursive", "cauchy", "huber"])
@pytest.mark.parametrize("at", [0, 35, 400, 799])
def test_one_fault_is_named_wherever_it_stands(shells, solver, at):
    """A fault of 10 σ among 800 rows: first, among the first that determine anything, in the middle, last."""
    how = SolverOptions("recursive") if solver == "recursive" else SolverOptions("lm", loss=solver)
    e = identify(CHAIN, RIG, noisy(shells, at, at), free=FREE, options=how)
    assert np.flatnonzero(e.suspect).tolist() == [at]
    assert e.distance[at] > 8.0
    if solver == "recursive":
        assert np.flatnonzero(e.weight == 0.0).tolist() == [at]
        clean = identify(CHAIN, RIG, noisy(shells, at, at).select(np.arange(800) != at), free=FREE)
        np.testing.assert_allclose(e.value[FREE], clean.value[FREE], atol=1e-3 * clean.sigma[FREE].min())
    else:
        assert np.argmin(e.weight) == at


def test_live_the_first_rows_look_faulty_and_in_the_end_none_is(shells):
    """What the re-evaluation is for: poor at first, the linearisation makes clean rows look faulty."""
    t = noisy(shells, 0)
    sigma = np.where([p.unit == "m" for p in CHAIN.parameters], 1e-2, 2e-2)
    problem = build_problem(CHAIN, RIG, t, sigma)
    rows = rows_of(problem, problem.start, FREE)
    _, live = run(start(np.zeros(FREE.sum()), sigma[FREE]), rows, np.ones(len(t), dtype=bool))
    assert (live > gate(1)).sum() > 3
    end = identify(CHAIN, RIG, t, free=FREE, prior_sigma=sigma, options=SolverOptions(solver="recursive"))
    assert end.status == "converged"
    assert (end.weight == 1.0).all()


@pytest.mark.parametrize("seeds", [4, pytest.param(20, marks=pytest.mark.soak)])
def test_no_clean_row_is_left_out(shells, seeds):
    """20 seeds of 800 rows: 0.016 rows beyond 1e-6 are to be expected in all of them together."""
    for seed in range(seeds):
        e = identify(
            CHAIN,
            RIG,
            noisy(shells, 100 + seed),
            free=FREE,
            options=SolverOptions(solver="recursive", max_iterations=20),
        )
        assert e.status == "converged"
        assert not e.suspect.any()
        assert (e.weight == 1.0).all()


def test_gross_faults_do_not_take_their_neighbours_along(shells):
    t = noisy(shells, 1)
    at = [3, 250, 251, 600]
    t.value[at] += [1.0, -0.05, 0.03, 0.002]
    e = identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(solver="recursive"))
    assert e.status == "converged"
    assert np.flatnonzero(e.weight == 0.0).tolist() == at
    assert re.findall(r"\d+", e.message) == ["4", "800"]


def test_fits_that_do_not_converge_or_have_nothing_free(ulb):
    e = identify(
        ULB,
        rig(ulb),
        ulb,
        free=free(*OFFSETS),
        prior_sigma=PRIOR,
        options=SolverOptions(solver="recursive", max_iterations=1),
    )
    assert (e.status, e.iterations) == ("max_iterations", 1)
    t = random_table(60, np.random.default_rng(6), SIGMA)
    t.value[3] = 1e300
    for solver in ("lm", "map", "recursive", "ls", "renders-1991"):
        with np.errstate(over="ignore"):
            e = identify(CHAIN, RIG, t, free=FREE, options=SolverOptions(solver=solver, max_iterations=3))
        assert e.status in ("stalled", "max_iterations"), solver
    t = random_table(20, np.random.default_rng(7), SIGMA)
    e = identify(CHAIN, RIG, t, free=np.zeros(54, bool), options=SolverOptions(solver="recursive"))
    assert e.rms_after["m"] == e.rms_before["m"]
