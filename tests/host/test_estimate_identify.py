"""Complete identifications of synthetic tables: unknown rigs, priors, seats, held-out rows, special cases."""

from dataclasses import replace

import numpy as np
import pytest
from puma_bench import (
    BARS,
    CHAIN,
    CHUCKS,
    DESIGN,
    FREE,
    RIG,
    SIGMA,
    SPHERES,
    TRUTH,
    lengths,
    random_poses,
    random_table,
)
from puma_bench import table as ball_bar_table

from truearm.estimate import fit as fit_module
from truearm.estimate import problem as problem_module
from truearm.estimate.frame_choice import mounting
from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.uncertainty import weak_prior
from truearm.kinds.table import ObservationTable
from truearm.model.chain import forward, point_jacobians
from truearm.model.urdf import free_without_gains
from truearm.types import BallBar, Point, Rig, SocketDistance, rms

AT = {name: i for i, name in enumerate(CHAIN.parameter_names)}


def parameter(e, name):
    return e.value[e.parameter_names.index(name)]


def test_chucks_of_which_nothing_is_known():
    rng = np.random.default_rng(0)
    truth = {**CHUCKS, "new": Point("new", (0.2, 0.3, 0.1))}
    q = random_poses(600, rng)
    pairs = [(("c0", "c1", "c2", "new")[i % 4], f"s{i % 3}") for i in range(600)]
    t = ball_bar_table(q, lengths(TRUTH, q, pairs, truth), pairs)
    rig = Rig({**CHUCKS, "new": Point("new", (0.25, 0.26, 0.08), None)}, SPHERES, BARS)
    e = identify(CHAIN, rig, t, free=FREE)
    assert (e.status, e.rank, e.null_space) == ("converged", 36, ())
    np.testing.assert_allclose(e.value[:54], TRUTH, atol=1e-10)
    np.testing.assert_allclose(e.value[54:], [0.2, 0.3, 0.1], atol=1e-10)
    assert (e.sigma[54:] > 0).all()
    rig = Rig({k: Point(k, p.xyz, None) for k, p in CHUCKS.items()}, SPHERES, BARS)
    e = identify(CHAIN, rig, random_table(600, np.random.default_rng(1)), free=FREE)
    assert e.rank == 30  # 36 − the pose of the base
    assert e.rms_after["m"] < 1e-10
    base = [AT[f"link1.{k}"] for k in ("x", "y", "z", "alpha", "beta", "gamma")]
    assert not e.identifiable[base].any()
    assert np.isnan(e.sigma[base]).all()
    assert len(e.null_space) == 6
    assert e.identifiable[AT["link3.x"]]
    assert e.value[AT["link3.x"]] == pytest.approx(TRUTH[AT["link3.x"]], abs=1e-10)


def test_zero_and_gain_of_a_bar_from_many_lengths():
    rng = np.random.default_rng(2)
    exact = random_table(600, rng)
    # The bar's true law is 0.4602 + 1.003·e; the table was made with the declared 0.46 + 1.0·e.
    t = replace(exact, value=0.46 + (exact.value - 0.4602) / 1.003)
    bar = BallBar("short", 0.46, 1.0, 0.075, SIGMA, zero_sigma=1.0, gain_sigma=1.0)
    e = identify(CHAIN, Rig(CHUCKS, SPHERES, {"short": bar}), t, free=FREE)
    # Priors of 1 m and 1 pull by (σ/prior)² of the offset: far below 1e-9 here.
    assert parameter(e, "bar.short.zero") == pytest.approx(0.4602, abs=1e-9)
    assert parameter(e, "bar.short.gain") == pytest.approx(1.003, abs=1e-9)
    assert e.rank == 36


def test_a_prior_ends_where_the_gradient_vanishes():
    """Jᵀ r/σ² + (nominal − x)/prior² = 0 for every unknown, with J by central differences of plain distances."""
    rng = np.random.default_rng(3)
    t = random_table(90, rng, SIGMA)
    bar = BallBar("short", 0.46, 1.0, 0.075, SIGMA, zero_sigma=2e-4)
    prior = np.where(FREE, weak_prior(CHAIN), np.inf)
    e = identify(CHAIN, Rig(CHUCKS, SPHERES, {"short": bar}), t, free=FREE, prior_sigma=prior)
    pairs = list(zip(t.chuck, t.sphere, strict=True))
    unknown = [*np.flatnonzero(FREE), 54]
    sigma = np.append(prior, 2e-4)

    def residual(x):  # predicted = 0.46 + (d − zero)
        return t.value - (0.46 + lengths(x[:54], t.q, pairs) - x[54])

    for i in unknown:
        unit = np.eye(55)[i] * 1e-6
        jac = -(residual(e.value + unit) - residual(e.value - unit)) / 2e-6
        pull = jac @ residual(e.value) / SIGMA**2
        back = (e.nominal[i] - e.value[i]) / sigma[i] ** 2
        # The end is within 1e-6 of ‖f‖ = sqrt(χ²) ~ 10 of flat, in units of the column's norm.
        assert abs(pull + back) < 1e-4 * np.hypot(np.linalg.norm(jac) / SIGMA, 1 / sigma[i])


def test_covariance_is_the_inverse_of_the_information():
    t = random_table(200, np.random.default_rng(5), SIGMA)
    e = identify(CHAIN, RIG, t, free=FREE)
    rows = []
    for q, chuck, sphere in zip(t.q, t.chuck, t.sphere, strict=True):
        p, jac, _ = point_jacobians(CHAIN, e.value, q, np.array(SPHERES[sphere].xyz))
        bar = p - np.array(CHUCKS[chuck].xyz)
        rows.append(bar / np.linalg.norm(bar) @ jac)
    information = np.array(rows)[:, FREE]
    expected = np.linalg.inv(information.T @ information / SIGMA**2)
    # The condition of the normal matrix, 1e8 or so in SI units, costs its half of the digits.
    np.testing.assert_allclose(e.covariance[np.ix_(FREE, FREE)], expected, rtol=1e-5, atol=1e-6 * expected.max())
    assert not e.covariance[~FREE].any()
    np.testing.assert_allclose(e.sigma[FREE], np.sqrt(np.diag(expected)), rtol=1e-5)
    assert np.isnan(e.sigma[~FREE]).all()


def test_block_size_does_not_matter(monkeypatch):
    t = random_table(300, np.random.default_rng(6), SIGMA)
    whole = identify(CHAIN, RIG, t, free=FREE)
    monkeypatch.setattr(problem_module, "BLOCK", 7)
    parts = identify(CHAIN, RIG, t, free=FREE)
    # Other order of rounding, eps times a condition of 1e4.
    np.testing.assert_allclose(parts.value, whole.value, atol=1e-11)
    np.testing.assert_allclose(parts.residual["m"], whole.residual["m"], atol=1e-12)


def test_the_result_is_complete():
    t = random_table(200, np.random.default_rng(7), SIGMA)
    held = np.arange(200) % 4 == 0
    heard = []
    e = identify(
        CHAIN,
        RIG,
        t,
        free=FREE,
        hold_out=held,
        options=SolverOptions(progress=lambda i, rms: heard.append((i, rms["m"]))),
    )
    assert (e.n_robot_parameters, e.n_observations, e.solver) == (54, 150, "lm")
    assert e.parameter_names == CHAIN.parameter_names
    np.testing.assert_array_equal(e.nominal, DESIGN)
    np.testing.assert_array_equal(e.fitted, ~held)
    np.testing.assert_array_equal(e.value[~FREE], DESIGN[~FREE])
    assert e.rms_after["m"] == pytest.approx(np.sqrt(np.mean(e.residual["m"][~held] ** 2)))
    assert e.held_out.figures["m"].rms == pytest.approx(np.sqrt(np.mean(e.residual["m"][held] ** 2)))
    assert e.held_out.figures["m"].mean == pytest.approx(np.abs(e.residual["m"][held]).mean())
    assert e.held_out.figures["m"].max == np.abs(e.residual["m"][held]).max()
    assert e.held_out_before.figures["m"].rms == pytest.approx(np.sqrt(np.mean(e.residual_before["m"][held] ** 2)))
    assert e.held_out_before.figures["m"].rms > 10 * e.held_out.figures["m"].rms
    assert heard == list(zip(range(1, e.iterations + 1), e.rms_history["m"][1:], strict=True))
    assert e.rms_history["m"][0] == e.rms_raw["m"] >= e.rms_before["m"]
    assert e.rms_history["m"][-1] == e.rms_after["m"]


@pytest.mark.parametrize("rows", [[7, 9, 11], [0, 2, 4, *range(7, 27, 2)]], ids=["none thinned", "three thinned"])
def test_a_sphere_of_few_rows_is_placed_by_all_of_them(monkeypatch, rows):
    """Three lengths determine it, but are not the best place for the others, where the many rows are more precise."""
    rare, rng = np.isin(np.arange(120), rows), np.random.default_rng(31)
    q, pairs = random_poses(120, rng), [(f"c{i % 3}", "s1" if rare[i] else "s2") for i in range(120)]
    noise = np.where(rare, SIGMA, 0.01 * SIGMA)
    t = ball_bar_table(q, lengths(TRUTH, q, pairs) + noise * rng.normal(size=120), pairs)
    t = replace(t, sigma=noise)
    s1 = replace(SPHERES["s1"], xyz=tuple(np.array(SPHERES["s1"].xyz) + 3e-3), sigma=None)
    rig = Rig(CHUCKS, {**SPHERES, "s1": s1}, BARS)
    before = []
    for many in (1000, 60):
        monkeypatch.setattr(fit_module, "THINNED_TO", many)
        before.append(identify(CHAIN, rig, t, free=FREE).residual_before["m"])
    np.testing.assert_allclose(*map(rms, (before[0][rare], before[1][rare])), rtol=1e-3, atol=1e-7)


def test_before_is_the_robot_as_described_with_the_rig_fitted_to_it():
    """A sphere that nobody measured is not an error of the robot, wherever it was guessed to be."""
    t = random_table(120, np.random.default_rng(30), SIGMA)
    held = np.arange(120) % 4 == 0
    found = []
    for guess in (0.0, 0.02):
        s1 = replace(SPHERES["s1"], xyz=tuple(np.array(SPHERES["s1"].xyz) + guess), sigma=None)
        rig = Rig(CHUCKS, {**SPHERES, "s1": s1}, BARS)
        found.append(identify(CHAIN, rig, t, free=FREE, hold_out=held))
    near, far = found
    # A fit ends where no more than 1e-6 of the residuals' norm is to be gained.
    assert far.rms_before["m"] == pytest.approx(near.rms_before["m"], rel=1e-6)
    assert far.rms_history["m"][0] == far.rms_raw["m"] > far.rms_before["m"]
    assert np.linalg.norm((far.residual_before["m"] - near.residual_before["m"])[~held]) < 2e-6 * np.linalg.norm(
        near.residual_before["m"][~held]
    )
    assert far.held_out_before.figures["m"].rms == pytest.approx(near.held_out_before.figures["m"].rms, rel=1e-5)
    # The same as an identification of nothing but the rig, and of how base and tool are mounted.
    nothing = identify(CHAIN, rig, t, free=np.zeros(54, bool), hold_out=held)
    assert nothing.rms_before["m"] == nothing.rms_raw["m"] == far.rms_raw["m"]
    assert nothing.rms_after["m"] == pytest.approx(nothing.rms_before["m"], rel=0.5e-8)  # 1e-8 of χ² may be left there
    placed = identify(CHAIN, rig, t, free=FREE & mounting(CHAIN, DESIGN).either, hold_out=held)
    assert placed.rms_after["m"] == pytest.approx(far.rms_before["m"], rel=1e-6)
    assert placed.held_out.figures["m"].rms == pytest.approx(far.held_out_before.figures["m"].rms, rel=1e-4)


# --- seats ---------------------------------------------------------------------------------------------------------


def seat_table(rng, n_each, places, noise):
    """A ball on sphere s0 in two sockets 80 mm apart at each place, seated by inverse kinematics of the true robot."""
    q_all, place_all, socket_all = [], [], []
    for place in places:
        centre = rng.uniform([0.3, -0.3, 0.2], [0.6, 0.3, 0.6])
        across = rng.normal(size=3)
        across *= 0.04 / np.linalg.norm(across)
        for socket, point in (("a", centre - across), ("b", centre + across)):
            q = seated(point, n_each, rng, noise)
            q_all.append(q)
            place_all += [place] * len(q)
            socket_all += [socket] * len(q)
    q = np.concatenate(q_all)
    source = [f"row {i + 1}" for i in range(len(q))]
    return ObservationTable(q=q, kind="seat", sphere="s0", socket=socket_all, place=place_all, source=source)


def seated(point, n, rng, noise):
    """(n, 6) readings with the true robot's ball within ``noise`` of a point."""
    kept = np.zeros((0, 6))
    goal = point + noise * rng.normal(size=(6 * n, 3))
    while len(kept) < n:
        q = random_poses(6 * n, rng)
        for _ in range(60):
            p, _, jac = point_jacobians(CHAIN, TRUTH, q, np.array(SPHERES["s0"].xyz))
            square = jac @ jac.swapaxes(1, 2) + 1e-6 * np.eye(3)
            step = (jac.swapaxes(1, 2) @ np.linalg.solve(square, (goal - p)[..., None]))[..., 0]
            q = q + np.clip(step, -0.3, 0.3)
        p = (forward(CHAIN, TRUTH, q) @ np.array([*SPHERES["s0"].xyz, 1.0]))[:, :3]
        kept = np.concatenate([kept, q[np.linalg.norm(p - goal, axis=1) < 1e-13]])
    return kept[:n]


DISTANCE = SocketDistance(("a", "b"), 0.08, 1e-5)
SEAT_RIG = Rig(spheres=SPHERES, socket_distances=(DISTANCE,), seat_sigma=1e-4)


@pytest.fixture(scope="module")
def seated_clean():
    return seat_table(np.random.default_rng(10), 25, ("p1", "p2", "p3", "p4", "p5"), 0.0)


def test_seats_without_noise(seated_clean):
    """36 − the base's pose (6) − the tool's orientation (3) = 27, residuals to nothing, new places to nothing."""
    held = seated_clean.place == "p5"
    e = identify(CHAIN, SEAT_RIG, seated_clean, free=FREE, hold_out=held)
    assert e.rank == 27
    assert e.rank_gap > 1e6
    assert e.rms_before["m"] > 1e-3
    assert e.rms_after["m"] < 1e-9
    assert e.held_out_before.figures["m"].mean > 1e-3
    assert e.held_out.figures["m"].max < 1e-9
    assert not any(name.startswith("socket.p5") for name in e.parameter_names)
    assert len([n for n in e.parameter_names if n.startswith("socket.")]) == 4 * 2 * 3
    at = [e.parameter_names.index(f"socket.p1.{s}.{k}") for s in "ab" for k in "xyz"]
    assert np.linalg.norm(e.value[at[:3]] - e.value[at[3:]]) == pytest.approx(0.08, abs=1e-9)


def test_a_socket_is_the_weighted_mean_by_which_held_out_places_are_judged(seated_clean):
    held = seated_clean.place == "p1"
    e = identify(CHAIN, SEAT_RIG, seated_clean, free=np.zeros(54, bool), hold_out=held)
    expected = []
    for socket in "ab":
        rows = held & (seated_clean.socket == socket)
        ball = (forward(CHAIN, DESIGN, seated_clean.q[rows]) @ np.array([*SPHERES["s0"].xyz, 1.0]))[:, :3]
        expected.append(np.linalg.norm(ball - ball.mean(axis=0), axis=1))
    assert e.held_out.figures["m"].mean == pytest.approx(np.concatenate(expected).mean(), rel=1e-9)
    assert e.held_out_before == e.held_out
    assert e.held_out.n == held.sum()
    sigma = np.random.default_rng(12).uniform(1e-4, 1e-3, len(seated_clean))
    t = replace(seated_clean, sigma=sigma)
    e = identify(CHAIN, Rig(spheres=SPHERES), t, free=np.zeros(54, bool))
    rows = (t.place == "p3") & (t.socket == "a")
    ball = (forward(CHAIN, DESIGN, t.q[rows]) @ np.array([*SPHERES["s0"].xyz, 1.0]))[:, :3]
    weight = sigma[rows] ** -2.0
    at = e.parameter_names.index("socket.p3.a.x")
    np.testing.assert_allclose(e.value[at : at + 3], weight @ ball / weight.sum(), atol=1e-9)
    np.testing.assert_allclose(e.sigma[at : at + 3], weight.sum() ** -0.5, rtol=1e-9)


@pytest.mark.parametrize("sigma", [0.0, 1e-4, None])
def test_sockets_whose_place_is_known(seated_clean, sigma):
    """Knowledge, they place the base as three chucks do; known to a σ, that well; of nothing known but a guess, not at all."""
    places = zip(seated_clean.place.tolist(), seated_clean.socket.tolist(), strict=True)
    ball = np.array([*SPHERES["s0"].xyz, 1.0])
    at = {key: (forward(CHAIN, TRUTH, q) @ ball)[:3] for key, q in zip(places, seated_clean.q, strict=True)}
    sockets = {key: Point(key[1], tuple(map(float, xyz)), sigma) for key, xyz in at.items()}
    e = identify(CHAIN, Rig(spheres=SPHERES, seat_sigma=1e-4, sockets=sockets), seated_clean, free=FREE)
    unknown = [name for name in e.parameter_names if name.startswith("socket")]
    assert len(unknown) == (0 if sigma == 0.0 else 30)
    assert e.rank == 36 - 3 - (
        7 if sigma is None else 0
    )  # one sphere: the tool's orientation; the base's pose and the scale
    assert e.rms_after["m"] < 1e-9
    if sigma is not None:
        # Of the same point all 25 seats and the declaration speak; the robot's own errors come on top.
        seen = dict(zip(e.parameter_names, e.sigma, strict=True))
        assert all(seen[name] < sigma for name in unknown)
    guessed = {key: replace(point, xyz=tuple(np.array(point.xyz) + 5e-3)) for key, point in sockets.items()}
    moved = identify(CHAIN, Rig(spheres=SPHERES, seat_sigma=1e-4, sockets=guessed), seated_clean, free=FREE)
    shift = (moved.value - e.value)[:6]
    assert (np.abs(shift[:3] - 5e-3) < 1e-8).all() == (sigma is not None)


def test_the_distance_between_sockets_brings_the_scale(seated_clean):
    """Without it the lengths follow their prior; the true arm is shorter or longer by the declared distance."""
    longer = replace(SEAT_RIG, socket_distances=(SocketDistance(("a", "b"), 0.08 * 1.002, 1e-7),))
    prior = np.where([p.unit == "m" for p in CHAIN.parameters], 0.01, 0.05)
    upper = AT["link3.x"]
    found = {
        rig: identify(CHAIN, rig_, seated_clean, free=FREE & free_without_gains(CHAIN), prior_sigma=prior).value[upper]
        for rig, rig_ in (("true", SEAT_RIG), ("longer", longer))
    }
    assert found["longer"] / found["true"] == pytest.approx(1.002, abs=5e-4)


def test_the_only_seat_of_a_socket_judges_nothing():
    """A socket that only one held-out row touches is settled on that row: it fits whatever it says, and must not count."""
    t = seat_table(np.random.default_rng(10), 25, ("p1", "p2", "p3"), 1e-4)
    held = np.flatnonzero(t.place == "p3")
    a, b = (held[t.socket[held] == name] for name in "ab")
    errors = {}
    for few in (1, 2, 25):
        keep = np.concatenate([np.flatnonzero(t.place != "p3"), a[:few], b])
        some = t.select(keep)
        e = identify(
            CHAIN,
            SEAT_RIG,
            some,
            free=FREE & free_without_gains(CHAIN),
            hold_out=some.place == "p3",
            prior_sigma=weak_prior(CHAIN),
        )
        assert (e.held_out.n_settled, e.held_out.n_left_out) == (6, 1 if few == 1 else 0)
        assert e.held_out.n == 25 + (0 if few == 1 else few)
        errors[few] = e.held_out.figures["m"].rms
    # 25 rows of the other socket judge in each case; one seat more or less changes little
    assert errors[1] == pytest.approx(errors[2], rel=0.2)
    alone = t.select(np.concatenate([np.flatnonzero(t.place != "p3"), a[:1], b[:1]]))
    e = identify(CHAIN, SEAT_RIG, alone, hold_out=alone.place == "p3", prior_sigma=weak_prior(CHAIN))
    assert e.held_out is None
