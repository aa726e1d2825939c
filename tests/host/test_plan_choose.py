"""Optimal choice, compared with brute force where possible, and the demo's rig compared with its grid of 800 poses."""

from itertools import product

import numpy as np
import pytest
from tests.host import plan_bench as bench

from truearm.model.chain import point_forward
from truearm.plan.choose import TIE, Gains, Setup, as_blocks, choose, condensed, value
from truearm.plan.forecast import Aim, bar_table, candidate_rows, region_root
from truearm.plan.measurement_limits import Pairing
from truearm.plan.options import Criterion
from truearm.plan.region import around, poses_in
from truearm.plan.shells import candidates
from truearm_sim.shells import plan_shells


def problem(n=12, width=1, k=3, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, width, k)) * [3.0, 1.0, 0.5], rng.normal(size=(2, k))


def information(rows, chosen):
    return np.eye(rows.shape[2]) + sum(rows[i].T @ rows[i] for i in chosen)


@pytest.mark.parametrize("criterion", ["D", "A", "I"])
@pytest.mark.parametrize("width", [1, 2])
def test_the_first_choice_is_the_best_single_one(criterion, width):
    rows, region = problem(width=width)
    (first,) = choose(rows, np.eye(3), 1, criterion, region, passes=0)
    values = [value(information(rows, [i]), criterion, region) for i in range(len(rows))]
    assert first == np.argmin(values)


def test_e_looks_at_the_worst_direction_alone():
    rows = np.diag([1.0, 50.0, 50.0])[:, None]
    assert choose(rows, np.diag([0.1, 1.0, 2.0]), 1, "E", passes=0).tolist() == [0]
    assert choose(rows, np.diag([9.0, 1.0, 2.0]), 1, "E", passes=0).tolist() == [1]


@pytest.mark.parametrize("criterion", ["D", "A", "I"])
def test_after_the_exchange_no_single_swap_helps(criterion):
    for seed in range(5):
        rows, region = problem(seed=seed)
        chosen = choose(rows, np.eye(3), 4, criterion, region, passes=20).tolist()
        best = value(information(rows, chosen), criterion, region)
        for old, new in product(chosen, set(range(len(rows))) - set(chosen)):
            swapped = [new if i == old else i for i in chosen]
            assert value(information(rows, swapped), criterion, region) >= best - 1e-8 * abs(best)


@pytest.mark.parametrize("criterion", Criterion)
def test_exchange_never_makes_it_worse_and_nothing_is_taken_twice(criterion):
    rows, region = problem(n=60)
    greedy = choose(rows, np.eye(3), 20, criterion, region, passes=0)
    better = choose(rows, np.eye(3), 20, criterion, region, passes=3)
    assert len(set(better.tolist())) == 20
    assert value(information(rows, better), criterion, region) <= value(information(rows, greedy), criterion, region)


@pytest.mark.parametrize("tie", [TIE, 0.1])
@pytest.mark.parametrize("criterion", Criterion)
def test_no_choice_rests_on_rounding(criterion, tie):
    """Three unknowns are as vague as an unknown sphere's coordinates: the first readings of them are worth all the same."""
    rng = np.random.default_rng(3)
    rows, region = rng.normal(size=(300, 1, 12)), 0.01 * rng.normal(size=(40, 12))
    rows[:, :, :3] *= 1e4 / np.linalg.norm(rows[:, :, :3], axis=2, keepdims=True)
    region[:, :3] = np.tile(np.eye(3), (14, 1))[:40]
    noisy = rows * (1.0 + 1e-15 * rng.normal(size=rows.shape))
    chosen, again = (choose(each, np.eye(12), 30, criterion, region, tie=tie) for each in (rows, noisy))
    assert set(chosen.tolist()) == set(again.tolist())


def test_what_is_excluded_is_not_chosen_where_nothing_gains(monkeypatch):
    gains = Gains(*problem(n=3)[:1], np.eye(3), Criterion.D, None, TIE)
    monkeypatch.setattr(Gains, "_gain", lambda _: np.array([5.0, -2.0, -1.0]))
    assert gains.best(np.array([0.0, 1.0, 1.0])) == 2


def test_a_setup_is_paid_where_it_brings_enough_and_not_again():
    """Two groups of like candidates; the second alone shows the third unknown."""
    rng = np.random.default_rng(4)
    rows = rng.normal(size=(40, 1, 3)) * [1.0, 1.0, 0.0]
    group = np.arange(40) % 2
    cheap = choose(rows, np.eye(3), 10, "D", passes=0, setup=Setup(group, 50.0))
    assert len(set(group[cheap].tolist())) == 1
    assert (
        choose(rows, np.eye(3), 10, "D", passes=2, setup=Setup(group, 0.0)).tolist()
        == choose(rows, np.eye(3), 10, "D", passes=2).tolist()
    )
    rows[group == 1] += [0.0, 0.0, 30.0]
    began = group[choose(rows, np.eye(3), 10, "D", passes=3, setup=Setup(group, 50.0))]
    assert began[0] == 1


def test_what_is_known_or_unknown_of_rows_counts():
    rows = np.array([[[10.0, 0.0]], [[0.0, 1.0]]])
    assert choose(rows, np.eye(2), 1)[0] == 0
    assert choose(rows, np.diag([1e6, 1.0]), 1)[0] == 1
    # The information on k with u unknowns fitted away is the Schur complement.
    rng = np.random.default_rng(1)
    jac, own = rng.normal(size=(20, 4)), rng.normal(size=(20, 3))
    left = condensed(jac, own)
    assert left.shape == (4, 4)
    schur = jac.T @ jac - jac.T @ own @ np.linalg.inv(own.T @ own) @ own.T @ jac
    np.testing.assert_allclose(left.T @ left, schur, atol=1e-12)
    blocks = as_blocks([left, left[:2]])
    np.testing.assert_allclose(blocks[1].T @ blocks[1], left[:2].T @ left[:2])


@pytest.fixture(scope="module")
def demo():
    """5000 candidates on the demo's shells of 46 cm, its grid of 800 there, and its region: where the grid's spheres are."""
    site, known = bench.site("puma560"), bench.known("puma560")
    rig = known.rig
    pairings = [Pairing("bar46", c, s) for c in rig.chucks for s in rig.spheres]
    found = candidates(site, pairings, 5000, seed=1)
    grid = plan_shells(known, "bar46", 800)
    spheres = np.array([rig.spheres[name].xyz for name in grid.sphere])
    region = around(point_forward(known.chain, known.params, grid.q, spheres))
    middle = np.array([0.0, 0.0, 0.04])  # of the three spheres
    aim = Aim(poses_in(site, region, middle), tuple(rig.spheres))
    rows, nothing = candidate_rows(known, bar_table(known, found))
    old, _ = candidate_rows(known, bar_table(known, grid))
    grid_information = nothing + sum(row.T @ row for row in old)
    return as_blocks(rows), nothing, grid_information, region_root(known, bar_table(known, found), aim)


@pytest.mark.parametrize(("criterion", "share"), [("D", 0.60), ("I", 0.40)])
def test_greedy_choice_does_with_fewer_poses_than_the_grid(demo, criterion, share):
    rows, nothing, grid, region = demo
    assert len(rows) >= 5000
    chosen = choose(rows, nothing, round(share * 800), criterion, region, passes=0)
    after = nothing + np.einsum("nwk,nwl->kl", rows[chosen], rows[chosen])
    assert value(after, criterion, region) <= value(grid, criterion, region)
