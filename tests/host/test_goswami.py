"""Ranks and null directions of the PUMA of Goswami, Quaid, Peshkin 1993; docs/notebooks/goswami_1993.ipynb has their numbers."""

import numpy as np
import pytest
from puma_bench import (
    CHAIN,
    CHUCKS,
    DESIGN,
    PAIRS,
    RIG,
    SPHERES,
    constant_orientation_poses,
    lengths,
    random_poses,
    random_table,
    table,
    vertical_tool_poses,
)

from truearm.estimate.identifiability import identifiability
from truearm.estimate.identify import identify
from truearm.estimate.information import fold, observe
from truearm.estimate.problem import build_problem
from truearm.model.chain import point_jacobians

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
