"""Bars and seats: signs, and derivatives with respect to every unknown compared with central differences."""

from dataclasses import replace

import numpy as np
import pytest
from puma_bench import BARS, CHAIN, CHUCKS, SPHERES, TRUTH, all_pairs, lengths, random_poses, table

from truearm.estimate.problem import blocks, build_problem
from truearm.kinds.ball_bar import beyond_stroke
from truearm.kinds.table import ObservationTable
from truearm.model.chain import forward, point_forward
from truearm.types import BallBar, Point, Rig, SocketDistance

STEEL = BallBar(
    "short", 0.46, 1.01, 0.075, 84e-6, expansion=11.5e-6, expansion_sigma=1e-6, gain_drift=1e-4, gain_drift_sigma=2e-5
)
UNKNOWN_RIG = Rig(
    chucks={k: Point(k, p.xyz, None) for k, p in CHUCKS.items()},
    spheres={k: Point(k, p.xyz, 1e-3) for k, p in SPHERES.items()},
    bars={"short": replace(STEEL, zero_sigma=1e-4, gain_sigma=1e-3)},
    socket_distances=(SocketDistance(("left", "right"), 0.05, 1e-5),),
    seat_sigma=5e-5,
)


def warmed(t, bar, sensor):
    return t.replace(bar_temperature=bar, sensor_temperature=sensor)


def seats(n, rng, sphere="s1", places=("here", "there")):
    socket = [("left", "right")[i % 2] for i in range(n)]
    place = [places[(i // 2) % len(places)] for i in range(n)]
    return ObservationTable(q=random_poses(n, rng), kind="seat", sphere=sphere, socket=socket, place=place)


def both_kinds(rng):
    q, pairs = random_poses(12, rng), all_pairs(12)
    bar = warmed(table(q, lengths(TRUTH, q, pairs), pairs), *rng.uniform(10.0, 30.0, (2, 12)))
    return ObservationTable.joined([bar, seats(9, rng)])


def test_derivatives_of_every_kind_by_every_unknown():
    rng = np.random.default_rng(0)
    problem = build_problem(CHAIN, UNKNOWN_RIG, both_kinds(rng))
    # 54 + three chucks, three spheres, the bar's zero, gain, expansion and drift, two sockets at each of two places, their distance
    assert len(problem.names) == 54 + 9 + 9 + 4 + 12 + 1
    # somewhere away from the start, where residuals are not small and gain and zero not as declared
    x = problem.start + 0.01 * rng.normal(size=problem.start.size)
    h = 1e-5  # truncation h²/6 · 10 m = 2e-10 (curvature 1/d of a short bar), rounding eps · 3 m/h = 7e-11
    kinds = list(blocks(problem))
    assert [type(b).__name__ for b in kinds] == ["BallBarRows", "SeatRows", "SocketDistanceRows"]
    for block in kinds:
        jac = block.evaluate(problem.chain, x).jac_params
        for i, unit in enumerate(np.eye(x.size)):
            up, down = (block.evaluate(problem.chain, x + s * h * unit).residual for s in (1, -1))
            np.testing.assert_allclose(jac[:, i], -(up - down) / (2 * h), atol=1e-8, err_msg=problem.names[i])


def test_derivatives_by_the_joint_readings():
    rng = np.random.default_rng(1)
    t = both_kinds(rng)
    x = build_problem(CHAIN, UNKNOWN_RIG, t).start
    h = 1e-5
    for i, unit in enumerate(np.eye(6)):
        sides = []
        for s in (1, -1):
            moved = replace(t, q=t.q + s * h * unit)
            problem = build_problem(CHAIN, UNKNOWN_RIG, moved)
            sides.append(np.concatenate([b.evaluate(problem.chain, x).residual for b in blocks(problem)]))
        problem = build_problem(CHAIN, UNKNOWN_RIG, t)
        jac = np.concatenate([b.evaluate(problem.chain, x).jac_joints[:, i] for b in blocks(problem)])
        np.testing.assert_allclose(jac, -(sides[0] - sides[1]) / (2 * h), atol=1e-8)


def test_a_sphere_in_the_chucks_centre_has_no_direction():
    q = random_poses(1, np.random.default_rng(4))
    centre = point_forward(CHAIN, CHAIN.params_nominal, q, np.array(SPHERES["s0"].xyz))[0]
    rig = Rig({"c": Point("c", tuple(centre))}, SPHERES, BARS)
    problem = build_problem(CHAIN, rig, table(q, np.array([0.1]), [("c", "s0")]))
    (block,) = blocks(problem)
    found = block.evaluate(problem.chain, problem.start)
    np.testing.assert_array_equal(found.jac_params, 0.0)
    np.testing.assert_allclose(found.residual, 0.1)


def test_sockets_start_at_the_mean_of_the_predicted_ball():
    t = seats(40, np.random.default_rng(5))
    problem = build_problem(CHAIN, UNKNOWN_RIG, t)
    rows = (t.place == "there") & (t.socket == "right")
    pose = forward(CHAIN, CHAIN.params_nominal, t.q[rows])
    ball = (pose @ np.array([*SPHERES["s1"].xyz, 1.0]))[:, :3]
    at = problem.names.index("socket.there.right.x")
    np.testing.assert_allclose(problem.start[at : at + 3], ball.mean(axis=0), atol=1e-14)


def test_a_warm_bar_reads_short_and_a_warm_sensor_in_its_proportion():
    """Truth: d = z (1 + α ΔT) + k (1 + κ ΔT') e. Declared: z + k e of the same reading e. With the temperatures nothing is left."""
    q, pairs = random_poses(9, np.random.default_rng(4)), all_pairs(9)
    d = lengths(TRUTH, q, pairs)
    bar, sensor = np.linspace(18.0, 23.0, 9), np.linspace(30.0, 20.0, 9)
    longer, larger = 1.0 + 11.5e-6 * (bar - 20.0), 1.0 + 1e-4 * (sensor - 20.0)
    reading = (d - 0.46 * longer) / (1.01 * larger)
    rig = Rig(CHUCKS, SPHERES, {"short": STEEL})
    t = table(q, 0.46 + 1.01 * reading, pairs)
    for known, left in (
        (warmed(t, bar, sensor), np.zeros(9)),
        (t, t.value - d),  # nobody read them
        (warmed(t, np.full(9, np.nan), sensor), t.value - (0.46 + (d - 0.46) / larger)),
    ):
        problem = build_problem(CHAIN, rig, known)
        (block,) = blocks(problem)
        x = np.concatenate([TRUTH, problem.start[TRUTH.size :]])
        # some roundings of metres
        np.testing.assert_allclose(block.evaluate(problem.chain, x).residual, left, atol=1e-14)
    assert problem.names[-2:] == ("bar.short.expansion", "bar.short.gain_drift")


def test_a_bar_whose_rig_says_nothing_of_temperature_has_the_unknowns_that_it_had():
    q, pairs = random_poses(9, np.random.default_rng(6)), all_pairs(9)
    t = table(q, lengths(TRUTH, q, pairs), pairs)
    plain = build_problem(CHAIN, Rig(CHUCKS, SPHERES, BARS), t)
    warm = build_problem(CHAIN, Rig(CHUCKS, SPHERES, BARS), warmed(t, np.full(9, 31.0), np.full(9, 11.0)))
    assert plain.names == warm.names
    for problem in (plain, warm):
        (block,) = blocks(problem)
        np.testing.assert_array_equal(
            block.evaluate(problem.chain, TRUTH).residual,
            next(iter(blocks(plain))).evaluate(plain.chain, TRUTH).residual,
        )


def test_lengths_that_a_bar_cannot_have_are_named():
    """The stroke of the short bar ends 37.9 mm from its zero (75 mm · 1.01 / 2); 5 σ are 0.66 mm."""
    ends = 0.46 + np.array([0.0379 + 0.0006, -0.0379 - 0.0006, 0.0379 + 0.0008, 0.15])
    rows = replace(table(random_poses(4, np.random.default_rng(1)), ends, all_pairs(4)), bar=np.full(4, "short"))
    (warning,) = beyond_stroke(rows, UNKNOWN_RIG, CHAIN)
    expected = {"bar": "short", "n": 2, "rows": 4, "first": rows.source[2]}
    assert (warning.code, expected.items() <= warning.values.items()) == ("beyond-stroke", True)
    lengths = [warning.values[name]["mm"] for name in ("low", "high", "length")]
    assert lengths == pytest.approx([422.1, 497.9, 498.7], abs=0.05)
    assert beyond_stroke(rows.select(np.arange(4) < 2), UNKNOWN_RIG, CHAIN) == []
