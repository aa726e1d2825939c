"""What Goswami, Quaid, Peshkin 1993 claim, of the estimators; docs/notebooks/goswami_1993.ipynb has all numbers.

Rank tests run at the design and at the optimised values; fits start from the design values, truth is the optimised.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
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
from truearm.estimate.identify import identify
from truearm.estimate.information import fold, observe
from truearm.estimate.problem import build_problem
from truearm.model.chain import Chain, forward, point_jacobians
from truearm.types import Rig

ALL = np.ones(54, dtype=bool)


def rotation(axis, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array({"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
                     "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis])  # fmt: skip


def table_two(q_degrees):
    """Position of the end by Table II's design column as printed: (3), Trans·Rz·Ry·Rx, cm and degrees."""
    links = [(0, 0, 66.04, 0, 0, 0), (-18, 0, 0, 90, 0, -90), (43.18, 0, -3.091, 0, 0, 0), (43.307, -2.032, 0, 90, 0, 90),
             (0, 0, 0, 0, 0, -90), (0, 0, 0, 0, 0, 90), (0, 0, 5.625, 0, 0, 0)]  # fmt: skip
    offsets = (-90, 0, -90, 0, 0, 0)
    p, rot = np.zeros(3), np.eye(3)
    for i, (x, y, z, alpha, beta, gamma) in enumerate(links):
        p = p + rot @ np.array([x, y, z]) / 100.0
        rot = rot @ rotation("z", alpha) @ rotation("y", beta) @ rotation("x", gamma)
        if i < 6:
            rot = rot @ rotation("z", offsets[i] + q_degrees[i])
    return p, rot


@pytest.mark.parametrize(
    ("q_degrees", "printed"),
    [((0, 0, 0, 0, 0, 0), (0.41148, 0.14909, 1.14972)), ((0, -90, 90, 0, 0, 0), (-0.02032, 0.14909, 1.58152))],
)
def test_zero_and_ready_pose_of_table_two(q_degrees, printed):
    p, rot = table_two(q_degrees)
    pose = forward(CHAIN, DESIGN, np.radians(q_degrees))
    np.testing.assert_allclose(pose[:3, 3], p, atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3], rot, atol=1e-12)
    np.testing.assert_allclose(p, printed, atol=1e-12)


@pytest.mark.parametrize("params", [DESIGN, TRUTH], ids=["design", "optimised"])
def test_jacobian_of_the_puma_is_the_central_difference(params):
    q, p_end = random_poses(20, np.random.default_rng(0)), np.array(SPHERES["s0"].xyz)
    _, jac, _ = point_jacobians(CHAIN, params, q, p_end)
    h = 1e-5  # truncation h²/6 · 2 m = 3e-11, rounding eps · 2 m / h = 4e-11
    for i, unit in enumerate(np.eye(54)):
        up, down = (point_jacobians(CHAIN, params + s * h * unit, q, p_end)[0] for s in (1, -1))
        np.testing.assert_allclose(jac[..., i], (up - down) / (2 * h), atol=1e-8)


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


def sub_table(n_chucks, n_spheres):
    return itertools.product(list(CHUCKS)[:n_chucks], list(SPHERES)[:n_spheres])


@pytest.mark.parametrize("params", [DESIGN, TRUTH], ids=["design", "optimised"])
def test_table_one(params):
    rng = np.random.default_rng(1)
    triangles = roots(params, lambda _: random_poses(80, rng))
    found = [[rank(triangles, sub_table(c, s)) for s in (1, 2, 3)] for c in (1, 2, 3)]
    assert found == [[30, 32, 33], [32, 34, 35], [33, 35, 36]]


def test_three_collinear_chucks_count_as_two():
    rig = Rig(points("c", [(0.4, 0.0, 0.2), (0.5, 0.05, 0.25), (0.6, 0.1, 0.3)]), SPHERES, BARS)
    rng = np.random.default_rng(3)
    assert rank(roots(TRUTH, lambda _: random_poses(80, rng), rig), PAIRS) == 35


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


@pytest.fixture(scope="module")
def clean():
    """900 lengths without noise, every fourth row held out (every third would be one sphere)."""
    t = random_table(900, np.random.default_rng(6))
    return t, np.arange(900) % 4 == 0


def test_recovery_without_noise(clean):
    t, held = clean
    e = identify(CHAIN, RIG, t, free=FREE, hold_out=held)
    assert e.status == "converged"
    assert e.iterations <= 8
    assert e.rms_raw["m"] > 5e-3  # the error was there
    assert e.rms_after["m"] < 1e-10
    assert e.held_out.figures["m"].max < 1e-10
    np.testing.assert_allclose(e.value, TRUTH, atol=1e-10)
    assert (e.rank, e.null_space) == (36, ())


def test_54_free_and_36_free_predict_alike(clean):
    t, held = clean
    rng = np.random.default_rng(7)
    noisy = table(t.q, t.value + SIGMA * rng.normal(size=900), all_pairs(900))
    few, many = (identify(CHAIN, RIG, noisy, free=free, hold_out=held) for free in (FREE, ALL))
    assert (few.rank, many.rank) == (36, 36)
    assert len(many.null_space) == 18
    # Both end within 1e-6 of the residual's norm of the same minimum, quadratically: predictions agree far below that.
    np.testing.assert_allclose(many.residual["m"], few.residual["m"], atol=1e-10)
    assert np.abs(many.value - few.value).max() > 1e-3  # though the parameters differ


def test_null_directions_move_nothing(clean):
    t, _ = clean
    e = identify(CHAIN, RIG, t, free=ALL)
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


@pytest.fixture(scope="module")
def shells():
    """The paper's experiment: 800 poses on the 46 cm shells to fit, 800 on the 61 cm shells to judge."""
    rng = np.random.default_rng(9)
    return shell_table(800, 0.46, rng, SIGMA), shell_table(800, 0.61, rng, SIGMA, "long")


def joined(a, b):
    return type(a).joined([a, b])


def test_800_poses_on_shells(shells):
    near, far = shells
    held = np.arange(1600) >= 800
    e = identify(CHAIN, RIG, joined(near, far), free=FREE, hold_out=held)
    assert e.status == "converged"
    assert e.iterations <= 10
    assert (e.rank, e.n_observations) == (36, 800)
    assert e.rms_before["m"] > 2e-3
    freedom = 800 - 36
    # The RMS of 764 free Gaussian residuals has a relative standard error of 1/sqrt(2 · 764).
    expected = SIGMA * np.sqrt(freedom / 800)
    assert expected == pytest.approx(0.0821e-3, abs=5e-8)
    assert abs(e.rms_after["m"] - expected) < 3 * expected / np.sqrt(2 * freedom)
    assert abs(e.chi2_reduced - 1.0) < 3 * np.sqrt(2 / freedom)
    # On new shells: noise and the prediction's own variance, trace(J C Jᵀ)/n (theory in PAPERS: 0.0877 mm).
    problem = build_problem(CHAIN, RIG, far)
    root = observe(problem, e.value, FREE).root * SIGMA
    own = np.trace(root @ e.covariance[np.ix_(FREE, FREE)] @ root.T) / 800
    predicted = np.sqrt(SIGMA**2 + own)
    assert SIGMA < predicted < 0.097e-3
    assert abs(e.held_out.figures["m"].rms - predicted) < 3 * predicted / np.sqrt(2 * 800)


@pytest.mark.parametrize("seed", range(2))
def test_converges_from_ten_centimetres_ten_degrees_five_percent(seed, clean):
    t, held = clean
    rng = np.random.default_rng(seed)
    size = {"m": 0.10, "rad": np.radians(10.0), "1": 0.05}
    start = [
        replace(p, nominal=p.nominal + (rng.uniform(-1, 1) * size[p.unit] if is_free else 0.0))
        for p, is_free in zip(CHAIN.parameters, FREE, strict=True)
    ]
    far_off = Chain(CHAIN.name, CHAIN.elements, tuple(start), CHAIN.joints)
    e = identify(far_off, RIG, t, free=FREE, hold_out=held)
    assert e.status == "converged"
    np.testing.assert_allclose(e.value, TRUTH, atol=1e-10)
