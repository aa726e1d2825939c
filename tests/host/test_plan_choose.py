"""Optimal choice, compared with brute force where possible; distances, paths and branches of a plan; no part is mounted for its own sake."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.host import plan_bench as bench

from truearm.errors import PlanError
from truearm.model.chain import point_forward
from truearm.model.robot import Branch
from truearm.model.robot_file import builtin_robot, names_with_branch
from truearm.plan.ball_bar_plan import all_pairings
from truearm.plan.bar_paths import onto_shell, samples, way_without_bar, ways_with_bar
from truearm.plan.branches import branch_of
from truearm.plan.choose import TIE, Gains, Setup, as_blocks, choose, condensed, value
from truearm.plan.first_rig import first_rig
from truearm.plan.forecast import Aim, bar_table, candidate_rows, region_root
from truearm.plan.measurement_limits import (
    Pairing,
    allowed,
    around,
    bar_vectors,
    make_shapes,
    poses_in,
    segment_distance,
)
from truearm.plan.options import Budget, Criterion
from truearm.plan.shells import candidates
from truearm.workflows.plan import BallBarOptions, knowledge_of, planned_ball_bar
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


coordinate = st.floats(-1.0, 1.0).map(lambda v: round(v, 3))
ends = st.tuples(*(st.tuples(coordinate, coordinate, coordinate) for _ in range(4)))


@settings(max_examples=150, deadline=None)
@given(ends)
def test_segment_distance_is_that_of_the_nearest_points(points):
    a0, a1, b0, b1 = map(np.array, points)
    share = np.linspace(0.0, 1.0, 101)[:, None]
    a, b = a0 + share * (a1 - a0), b0 + share * (b1 - b0)
    apart = np.linalg.norm(a[:, None] - b[None], axis=2).min()
    exact = segment_distance(a0, a1, b0, b1)
    # points a hundredth of a segment apart miss the nearest by at most half of that on either
    half_step = 0.005 * (np.linalg.norm(a1 - a0) + np.linalg.norm(b1 - b0))
    assert exact <= apart + 1e-9
    assert exact >= apart - half_step - 1e-9


def test_ways_are_found_or_none_is():
    site, pairing = bench.site("puma560"), Pairing("bar46", "c1", "s1")
    q = candidates(site, [pairing], 12).q
    middle = onto_shell(site, 0.5 * (q[:1] + q[-1:]), pairing)
    bar, mounted = pairing.of(site.rig)
    assert abs(np.linalg.norm(bar_vectors(site, middle, mounted)[0]) - bar.zero) < 1e-9
    assert ways_with_bar(site, q[:1], q[:1], pairing)[0].shape == (0, 6)
    # A pose on the other side of the wrist's singularity cannot be gone to with the bar on.
    site, pairing = bench.site("puma560"), Pairing("bar46", "c1", "s1")
    q = candidates(site, [pairing], 12).q[0]
    flipped = q + np.array([0, 0, 0, -np.pi, -2.0 * q[4], np.pi])
    assert ways_with_bar(site, q[None], flipped[None], pairing) == [None]
    site = bench.site("irb120")
    q = candidates(site, all_pairings(site.rig, ["bar25"]), 27).q
    low = [q[i] for i in np.argsort(q[:, 0])[[0, -1]]]
    stops = [low[0], *way_without_bar(site, *low, "it"), low[1]]
    assert allowed(site, samples(np.array(stops[:-1]), np.array(stops[1:]))[0], None).all()


@pytest.mark.parametrize("name", names_with_branch())
def test_branches_lie_inside_the_joints_limits(name):
    robot = builtin_robot(name)
    chain, branch = robot.chain, branch_of(robot)
    assert (branch.lower >= [j.lower for j in chain.joints]).all()
    assert (branch.upper <= [j.upper for j in chain.joints]).all()


def test_a_branch_that_does_not_fit_the_robot_is_refused():
    robot = builtin_robot("puma560")
    for size, bound in ((5, 0.1), (7, 0.1), (6, 99.0)):
        with pytest.raises(PlanError, match=r"^branch: "):
            branch_of(robot, Branch(np.full(size, -bound), np.full(size, bound)))
    bare = replace(robot, branch=None)
    with pytest.raises(PlanError, match=r"robot puma560 .*\[branch\].* 6 joints"):
        branch_of(bare)
    given = Branch(np.full(6, -0.1), np.full(6, 0.1))
    assert branch_of(bare, given) is given


def test_every_limit_is_looked_at():
    """A good pose is refused as soon as any one limit is drawn past it."""
    site, pairing = bench.site("puma560"), Pairing("bar46", "c1", "s1")
    q = candidates(site, [pairing], 12).q[:1]
    assert allowed(site, q, pairing).all()
    for change in (
        {"joint_margin": 1.5},
        {"singular_value": 0.9},
        {"reserve": 0.0376},
        {"chuck_angle": 0.01},
        {"sphere_angle": 0.01},
    ):
        assert not allowed(site, q, pairing, replace(site.limits, **change)).any()
    for change in ({"table": 2.0}, {"link": 0.5}, {"post": 0.6}):
        sizes = replace(site.shapes.sizes, **change)
        shapes = make_shapes(site.arm.chain, site.arm.params, site.rig, sizes)
        assert not allowed(replace(site, shapes=shapes), q, pairing).any()


def test_a_chuck_that_nobody_measured_has_more_poses_than_coordinates_or_none():
    """40 poses of 300 candidates; chosen one by one they took two poses each of two more chucks, whose places that leaves unknown."""
    robot = builtin_robot("ur5e")
    rig = first_rig(robot)
    unknown = {
        name: {point: replace(at, sigma=None) for point, at in getattr(rig, name).items()}
        for name in ("chucks", "spheres")
    }
    known = knowledge_of(robot, replace(rig, **unknown))
    planned = planned_ball_bar(known, Budget(40), BallBarOptions(candidates=300), False)
    assert len(planned.route.plan) == 40
    for column in ("chuck", "sphere"):
        _, poses = np.unique(getattr(planned.route.plan, column), return_counts=True)
        assert poses.min() > 3
    sigma = dict(zip(planned.forecast.names, planned.forecast.sigma, strict=True))
    assert all(np.isfinite(sigma[f"chuck.{name}.x"]) for name in set(planned.route.plan.chuck.tolist()))
