"""What data see and do not see: rows to distrust, ranks, null directions, what to measure next; bad input."""

from dataclasses import replace

import numpy as np
import pytest
import ulb_bench
from puma_bench import (
    BARS,
    CHAIN,
    CHUCKS,
    DESIGN,
    FREE,
    PAIRS,
    RIG,
    SIGMA,
    SPHERES,
    TRUTH,
    all_pairs,
    constant_orientation_poses,
    lengths,
    points,
    random_poses,
    random_table,
    shell_table,
    table,
    vertical_tool_poses,
)

from truearm.estimate.identifiability import identifiability
from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.information import fold, observe
from truearm.estimate.problem import build_problem
from truearm.estimate.solvers import SOLVERS
from truearm.model.chain import point_jacobians
from truearm.types import Rig


@pytest.fixture(scope="module")
def shells():
    return shell_table(400, 0.46, np.random.default_rng(0), SIGMA)


def test_distances_are_chi_and_bands_hold(shells):
    e = identify(CHAIN, RIG, shells, free=FREE)
    assert e.chi2_band[0] < e.chi2_reduced < e.chi2_band[1]
    # Deleted residuals have unit variance; the mean of 400 squares has a standard error of sqrt(2/400).
    assert abs(np.mean(e.distance**2) - 1.0) < 4 * np.sqrt(2 / 400)
    assert (e.weight == 1.0).all()
    held = np.arange(400) % 4 == 0
    part = identify(CHAIN, RIG, shells, free=FREE, hold_out=held)
    assert np.isnan(part.distance[held]).all()
    assert not part.suspect[held].any()


def test_least_squares_reads_the_noise_from_the_residuals(shells):
    """Its σ are those of lm times s/σ, whatever σ the rig declares."""
    lied = {k: replace(b, sigma=10 * SIGMA) for k, b in BARS.items()}
    e = identify(CHAIN, Rig(CHUCKS, SPHERES, lied), shells, free=FREE, options=SolverOptions(solver="ls"))
    lm = identify(CHAIN, RIG, shells, free=FREE)
    np.testing.assert_allclose(e.sigma[FREE], lm.sigma[FREE] * np.sqrt(lm.chi2_reduced), rtol=1e-3)
    assert e.chi2_reduced == pytest.approx(lm.chi2_reduced / 100, rel=1e-3)


# --- what to measure next -------------------------------------------------------------------------------------------


def by_kind(e):
    out = {}
    for addition in e.additions:
        out.setdefault(addition.kind, []).append(addition)
    return out


def test_one_chuck_and_two_spheres_want_more(shells):
    """Table I: 32 as it stands, a second chuck makes 34, a third sphere 33, both 35."""
    few = shells.select((shells.chuck == "c0") & (shells.sphere != "s2"))
    e = identify(CHAIN, RIG, few, free=FREE)
    assert e.rank == 32
    assert e.suggested_free.sum() == 32
    found = by_kind(e)
    assert {a.rank for a in found["chuck"]} == {34}
    assert {a.rank for a in found["sphere"]} == {33}
    assert {a.names: a.rank for a in found["pairing"]} == {
        ("c1", "s0"): 34, ("c1", "s1"): 34, ("c2", "s0"): 34, ("c2", "s1"): 34, ("c0", "s2"): 33, ("c1", "s2"): 35, ("c2", "s2"): 35,
    }  # fmt: skip
    for a in e.additions:
        assert len(a.parameters) == a.rank - 32
        assert not e.suggested_free[[CHAIN.parameter_names.index(n) for n in a.parameters]].any()
    assert [a.rank for a in e.additions] == sorted((a.rank for a in e.additions), reverse=True)


def test_an_advice_taken_brings_what_it_promised(shells):
    few = shells.select((shells.chuck == "c0") & (shells.sphere != "s2"))
    e = identify(CHAIN, RIG, few, free=FREE)
    chuck, sphere = e.additions[0].names
    more = shells.select(
        ((shells.chuck == "c0") & (shells.sphere != "s2")) | ((shells.chuck == chuck) & (shells.sphere == sphere))
    )
    assert identify(CHAIN, RIG, more, free=FREE).rank == e.additions[0].rank


def test_a_constant_tool_and_collinear_chucks_want_others():
    # The design robot itself: any other's orientation is not quite constant, which hides the loss behind a poor o2.
    q, pairs = constant_orientation_poses(200, np.random.default_rng(1)), all_pairs(200)
    e = identify(CHAIN, RIG, table(q, lengths(DESIGN, q, pairs), pairs), free=FREE)
    nearly = identify(CHAIN, RIG, table(q, lengths(TRUTH, q, pairs), pairs), free=FREE)
    varied = identify(CHAIN, RIG, random_table(200, np.random.default_rng(1)), free=FREE)
    assert nearly.rank == 36
    assert nearly.observability.o2 < 0.1 * varied.observability.o2
    assert e.rank == 33
    assert by_kind(e)["poses"][0].rank == 36
    assert "pairing" not in by_kind(e)  # all nine are there already
    rig = Rig(points("c", [(0.4, 0.0, 0.2), (0.5, 0.05, 0.25), (0.6, 0.1, 0.3)]), SPHERES, BARS)
    q, pairs = random_poses(300, np.random.default_rng(2)), all_pairs(300)
    e = identify(CHAIN, rig, table(q, lengths(TRUTH, q, pairs, rig.chucks), pairs), free=FREE)
    assert e.rank == 35
    assert [a.rank for a in by_kind(e)["chuck"]] == [36]
    assert "sphere" not in by_kind(e)


@pytest.mark.parametrize("solver", sorted(SOLVERS))
@pytest.mark.parametrize("case", ["alike", "few", "one"])
def test_poor_data_still_give_an_answer(solver, case):
    """All poses alike, fewer rows than parameters, a single row: no solver raises, all say what they do not see."""
    rng = np.random.default_rng(3)
    n = {"alike": 80, "few": 12, "one": 1}[case]
    q = np.tile(random_poses(1, rng), (n, 1)) if case == "alike" else random_poses(n, rng)
    pairs = all_pairs(n)
    e = identify(
        CHAIN,
        RIG,
        table(q, lengths(TRUTH, q, pairs), pairs),
        free=FREE,
        options=SolverOptions(solver=solver, max_iterations=20),
    )
    assert e.status in ("converged", "max_iterations", "stalled")
    assert np.isfinite(e.value).all()
    assert e.rank == {"alike": 6, "few": 12, "one": 1}[case]  # one pose, nine pairings: six numbers place the end
    assert len(e.null_space) == 36 - e.rank
    assert ("poses" in by_kind(e)) or (e.additions and case != "alike")
    assert np.isnan(e.sigma[FREE]).any()


def test_a_chuck_known_with_sigma_helps_as_one_known_exactly(shells):
    """Of several rigs, too: its numbers are named after the rig."""
    loose = replace(RIG, chucks={k: replace(p, sigma=1e-4) for k, p in CHUCKS.items()})
    few = shells.select(shells.chuck == "c0")
    e = identify(CHAIN, {"day": loose}, replace(few, rig=np.full(len(few), "day")), free=FREE)
    assert e.rank == 33
    assert {a.names: a.rank for a in by_kind(e)["pairing"]} == {(c, s): 35 for c in ("c1", "c2") for s in SPHERES}


def test_each_rig_is_extended_according_to_its_own_rows(shells):
    """The rows of one rig name chucks that the other lacks."""
    here, there = shells.select(shells.chuck == "c0"), shells.select(shells.chuck == "c1")
    rigs = {name: replace(RIG, chucks={chuck: CHUCKS[chuck]}) for name, chuck in (("here", "c0"), ("there", "c1"))}
    both = [replace(rows, rig=np.full(len(rows), name)) for rows, name in ((here, "here"), (there, "there"))]
    e = identify(CHAIN, rigs, type(shells).joined(both), free=FREE)
    assert {addition.text.rpartition(" ")[2] for addition in e.additions} == set(rigs)


@pytest.mark.parametrize("sigma", [None, 0.1])
def test_lines_alone_want_no_equipment_that_the_user_does_not_have(sigma):
    """A point on the tool tells nothing of its orientation; devices that stand anywhere cannot place the base."""
    t = ulb_bench.lines(6, 12, ulb_bench.NOMINAL, np.random.default_rng(7))
    t = replace(t, q=t.q + 0.1 * np.random.default_rng(8).normal(size=t.q.shape))  # the tool turns on its way
    free = np.array([p.unit != "1" for p in ulb_bench.CHAIN.parameters])
    # Not the nominal robot itself: its parallel axes make further parameters alike.
    truth = ulb_bench.NOMINAL + 2e-3 * free * np.random.default_rng(9).normal(size=free.size)
    t = replace(t, xyz=ulb_bench.point_forward(ulb_bench.CHAIN, truth, t.q, np.zeros(3)))
    rig = ulb_bench.rig(t, sigma=sigma, turn_sigma=sigma)
    e = identify(
        ulb_bench.CHAIN, rig, t, free=free, options=SolverOptions(solver="lm"), prior_sigma=np.full(free.size, 0.01)
    )
    assert e.status == "converged"
    assert e.iterations <= 6  # from the guessed rig, with all at once, it crept for more than 100
    assert e.null_space
    assert set(by_kind(e)) <= {"line"}


def test_suggestions_among_all_54_are_the_papers_36():
    e = identify(CHAIN, RIG, random_table(300, np.random.default_rng(4), SIGMA), prefer=FREE)
    np.testing.assert_array_equal(e.suggested_free, FREE)
    assert e.observability is not None
    assert e.observability.o3 > 0.0
    few = identify(CHAIN, RIG, random_table(300, np.random.default_rng(4), SIGMA), free=FREE)
    assert few.observability == pytest.approx(e.observability, rel=1e-3)


ALL = np.ones(54, dtype=bool)


def roots(params, q_of_pair, rig=RIG):
    """For each pairing the triangle (54, 54) of its poses, all 54 parameters free."""
    out = {}
    for pair in PAIRS:
        q = q_of_pair(pair)
        pairs = [pair] * len(q)
        problem = build_problem(CHAIN, rig, table(q, lengths(params, q, pairs, rig.chucks, rig.spheres), pairs))
        out[pair] = observe(problem, params, ALL).root
    return out


def rank(triangles, pairs):
    whole = np.zeros((54, 54))
    for pair in pairs:
        whole = fold(whole, triangles[pair])
    seen = identifiability(whole, 54, CHAIN.parameter_names)
    assert len(seen.null_space) == 54 - seen.rank
    assert seen.gap > 1e6  # the count does not hang on the tolerance
    return seen.rank


def test_constant_tool_orientation_silently_loses_parameters():
    """With one orientation each sphere is the same constant step from the others: three spheres see no more than one.

    A vertical tool with the wrist in the arm's plane, the lazy way to keep an orientation, aligns joint axes and loses
    six more. docs/decisions/0007 has the table.
    """
    rng = np.random.default_rng(5)

    def vertical(*, turns=1, flips=1):
        q = vertical_tool_poses(80, rng)
        turned_over = np.arange(80) % flips == 1
        q[turned_over] = q[turned_over] * (1, 1, 1, 1, -1, 1) + np.pi * np.array([0, 0, 0, 1, 0, -1])
        q[:, 5] += np.arange(80) % turns
        return q

    def still():
        return random_poses(80, rng) * (1, 1, 1, 0, 0, 0) + np.radians([0, 0, 0, 20, 60, 30])

    def on_shell(pair):
        return constant_orientation_poses(80, rng, shell=(CHUCKS[pair[0]], SPHERES[pair[1]]))

    def tilted(of):
        tilt = {name: 0.3 * rng.normal(size=3) for name in (*CHUCKS, *SPHERES)}
        return lambda pair: constant_orientation_poses(80, rng, tilt[pair[of]])

    assert rank(roots(DESIGN, lambda _: constant_orientation_poses(80, rng)), PAIRS) == 33
    assert rank(roots(DESIGN, on_shell), PAIRS) == 33
    assert [rank(roots(DESIGN, tilted(of)), PAIRS) for of in (0, 1)] == [36, 36]
    assert rank(roots(DESIGN, lambda _: vertical(flips=2)), PAIRS) == 33
    assert rank(roots(DESIGN, lambda _: vertical(turns=2)), PAIRS) == 29
    assert rank(roots(DESIGN, lambda _: vertical(turns=3)), PAIRS) == 29
    assert rank(roots(DESIGN, lambda _: vertical()), PAIRS) == 27
    assert rank(roots(DESIGN, lambda _: still()), PAIRS) == 21


def test_null_directions_move_nothing():
    e = identify(CHAIN, RIG, random_table(900, np.random.default_rng(6)), free=ALL)
    at = {name: i for i, name in enumerate(e.parameter_names)}
    q = random_poses(50, np.random.default_rng(8))
    _, jac, _ = point_jacobians(CHAIN, e.value, q, np.array(SPHERES["s1"].xyz))
    for direction in e.null_space:
        assert max(np.abs(direction.weights)) == pytest.approx(1.0)
        moved = jac[..., [at[n] for n in direction.names]] @ np.array(direction.weights)
        assert (
            np.abs(moved).max() < 1e-5
        )  # m a unit; weights below 1e-6 are left out of the direction, lengths are ~1 m
        assert not e.identifiable[[at[n] for n in direction.names]].any()
    assert np.isnan(e.sigma[~e.identifiable]).all()
