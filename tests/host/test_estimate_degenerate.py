"""Data that cannot determine the robot: every solver reports the rank, the unidentifiable combinations and useful additions."""

from dataclasses import replace

import numpy as np
import pytest
from puma_bench import CHAIN, FREE, RIG, SIGMA, random_table

from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.solvers import SOLVERS
from truearm.types import Point, Rig


@pytest.fixture(scope="module")
def rows():
    return random_table(300, np.random.default_rng(0), SIGMA)


def fit(rig, rows, **more):
    return identify(CHAIN, rig, rows, free=FREE, prefer=FREE, **more)


def chucks_at(*places):
    return Rig({n: Point(n, p) for n, p in zip(RIG.chucks, places, strict=True)}, RIG.spheres, RIG.bars)


def test_collinear_chucks_lose_one_and_say_which_would_add_it(rows):
    e = fit(chucks_at((0.0, 0.2, 0.0), (0.1, 0.2, 0.0), (0.2, 0.2, 0.0)), rows)
    assert e.rank == 35
    assert len(e.null_space) == 1
    assert "chuck" in {a.kind for a in e.additions}


def test_a_contradictory_rig_is_seen_in_chi2(rows):
    """All chucks at one point: the lengths contradict it. Rank as with one chuck, and residuals far beyond the noise."""
    e = fit(chucks_at((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), rows)
    assert e.rank == 33
    assert e.chi2_reduced > 1e4
    assert "chuck" in {a.kind for a in e.additions}


@pytest.mark.parametrize("solver", sorted(SOLVERS))
@pytest.mark.parametrize("n", [1, 5])
def test_too_few_rows_have_their_number_as_rank(rows, n, solver):
    e = fit(RIG, rows.select(np.arange(n)), options=SolverOptions(solver=solver))
    assert e.rank == n
    assert len(e.null_space) == 36 - n
    assert "poses" in {a.kind for a in e.additions}
    assert np.isfinite(e.value).all()


@pytest.mark.parametrize("solver", sorted(SOLVERS))
def test_poses_all_alike(rows, solver):
    """One pose, nine pairings: six numbers place the end, and no more is seen."""
    e = fit(RIG, replace(rows, q=np.repeat(rows.q[:1], len(rows), axis=0)), options=SolverOptions(solver=solver))
    assert e.rank == 6
    assert "poses" in {a.kind for a in e.additions}
    assert np.isfinite(e.value).all()
