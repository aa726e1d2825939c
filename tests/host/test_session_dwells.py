"""Dwells from joint readings, the mean of correlated samples, matching with the plan."""

import json
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from session_stream import columns_of

from truearm.session.dwells import Dwell, find_dwells, mean_of
from truearm.session.joint_readings import JointReader
from truearm.session.plan_matching import BACK, REPEAT, Marks, PlannedPoses, distances, match_plan, with_mountings
from truearm.types import MOUNTING, Message

HZ = 125.0


def dwells_of(path, noise=0.0, step=0.0, drop=(), seed=0):
    """Return the dwells of a robot whose first joint follows (t, q) corners; readings between ``drop`` times are missing."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, path[-1][0], 1.0 / HZ)
    q = np.stack([np.interp(t, *np.array(path).T), 0.3 + 0.0 * t], axis=1) + noise * rng.standard_normal((t.size, 2))
    q = step * np.rint(q / step) if step else q
    reader, messages = JointReader(), []
    for k, (at, row) in enumerate(zip(t.tolist(), q.tolist(), strict=True)):
        if not any(a < at < b for a, b in drop):
            line = json.dumps({"t": at, "seq": k, "q": row}).encode()
            messages.append(Message("/robot/joints", round(1e9 * at), line))
    reader.take(columns_of(messages))
    return find_dwells(reader.finish())


TWO_STOPS = [(0, 0.0), (2, 0.0), (3, 1.0), (5, 1.0), (6, 0.5), (6.6, 0.5), (8, 1.5), (10, 1.5)]


@pytest.mark.parametrize(("noise", "step"), [(0.0, 0.0), (0.0, 1e-4), (2e-5, 0.0), (2e-5, 1e-5), (3e-4, 0.0)])
def test_stops_are_found_at_any_noise_and_quantisation(noise, step):
    dwells = dwells_of(TWO_STOPS, noise, step)
    assert [dwell.reason for dwell in dwells] == ["", "", "too short", ""]
    assert float(dwells[2].detail.split()[0]) == pytest.approx(0.3, abs=0.11)
    good = [dwell for dwell in dwells if not dwell.reason]
    assert np.allclose([dwell.q[0] for dwell in good], [0.0, 1.0, 1.5], atol=5 * noise / 10 + step + 1e-12)
    for dwell, (start, end) in zip(good, [(0, 2), (3, 5), (8, 10)], strict=True):
        # 0.2 s at the beginning and 0.1 s at the end are left out; bins of 50 ms and windows of four decide to within 0.2 s
        assert start + 0.2 <= dwell.start_s + 1e-9
        assert dwell.start_s < start + 0.4
        assert end - 0.35 < dwell.end_s <= end - 0.1 + 1e-9


def test_nothing_of_the_settling_enters_the_mean():
    """The arm reaches its pose with a tail of 5e-4 rad that is gone after 0.4 s: within the settling time."""
    path = [(0, 0.0), (1, 0.0), (2, 1.0), (2.4, 1.0005), (5, 1.0005)]
    last = dwells_of(path, noise=1e-6)[-1]
    assert last.reason == ""
    assert last.q[0] == pytest.approx(1.0005, abs=1e-6)


def test_what_moves_or_is_missing_is_no_dwell():
    # 1e-5 rad in each window of 0.2 s passes the window's threshold of 7e-5, 1.4e-4 rad over the dwell does not.
    creep = [(0, 0.0), (3, 0.0), (4, 1.0), (10, 1.0003)]
    assert [dwell.reason for dwell in dwells_of(creep, noise=5e-6)] == ["", "still moving"]
    dwells = dwells_of([(0, 0.0), (6, 0.0)], drop=[(2.5, 3.1)])
    assert [dwell.reason for dwell in dwells] == ["", ""]
    assert dwells[0].end_s <= 2.5
    assert dwells[1].start_s >= 3.1 + 0.2
    assert len(dwells_of([(0, 0.0), (6, 0.0)], drop=[(2.5, 2.6)])) == 1
    assert [dwell.reason for dwell in dwells_of([(0, 0.0), (20, 3.0)], noise=1e-6) if not dwell.reason] == []


def test_a_long_stop_and_quantised_readings():
    (dwell,) = dwells_of([(0, 0.0), (90, 0.0)])
    assert 59.0 < dwell.end_s - dwell.start_s < 60.0
    dwell = dwells_of(TWO_STOPS, step=1e-4)[0]
    assert dwell.q_var[0] == pytest.approx(1e-8 / 12, rel=1e-6)


# ------------------------------------------------------------------------------------------------------- statistics


def ar1(rng, n, phi, sigma=1.0):
    """Return stationary AR(1) noise with standard deviation sigma."""
    kicks = rng.standard_normal(n + 500) * sigma * np.sqrt(1.0 - phi**2)
    return lfilter([1.0], [1.0, -phi], kicks)[500:]


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9, -0.4])
def test_variance_of_the_mean_is_what_the_means_do(phi):
    """z² = mean²/variance over 600 dwells. If the variances were exact Σz² would be χ² with 600 degrees: mean 1 ± 3·0.058.
    An estimate v of relative spread s raises E[1/v] by s²; s² = 2(2W + 1)/n with W ≈ 5τ + 1, at least 8
    (Wolff eq. 42)."""
    rng = np.random.default_rng(17)
    n, runs = 1400, 600
    results = [mean_of(5.0 + ar1(rng, n, phi)) for _ in range(runs)]
    z2 = np.mean([(r.value - 5.0) ** 2 / r.value_var for r in results])
    tau = 0.5 * (1.0 + phi) / (1.0 - phi)
    expected = 1.0 + 2.0 * (2.0 * max(8.0, 5.0 * tau + 1.0) + 1.0) / n
    assert abs(z2 - expected) < 3.0 * np.sqrt(2.0 / runs) * expected
    # Three standard errors of the mean of the estimates, and the e^-5 of C that the window leaves out.
    tolerance = 3.0 * np.sqrt((expected - 1.0) / runs) + np.exp(-5.0)
    assert np.mean([r.value_var for r in results]) == pytest.approx(2.0 * tau / n, rel=tolerance)
    assert all(r.n_eff == pytest.approx(r.noise**2 / r.value_var) for r in results)
    assert np.mean([r.noise for r in results]) == pytest.approx(1.0, rel=0.02)


def test_drift_is_seen_against_its_own_noise():
    rng = np.random.default_rng(3)
    line = np.linspace(-0.5, 0.5, 1400)
    results = [mean_of(ar1(rng, 1400, 0.6)) for _ in range(400)]
    z2 = np.mean([(r.drift / r.drift_sigma) ** 2 for r in results])
    assert abs(z2 - 1.0) < 3.0 * np.sqrt(2.0 / 400) + 0.03  # and the s² of the test above
    drifting = mean_of(ar1(rng, 1400, 0.6) + 3.0 * line)
    assert drifting.drift == pytest.approx(3.0, abs=5 * drifting.drift_sigma)
    assert drifting.noise == pytest.approx(1.0, rel=0.15)  # the drift is not taken for noise
    r = mean_of(np.full(100, 0.46))
    assert r.value == pytest.approx(0.46, abs=1e-15)
    assert r.value_var < 1e-30
    assert abs(r.drift) < 1e-14


# ------------------------------------------------------------------------------------------------------- pairing


def plan_of(q):
    fittings = {"bar": "b", "chuck": "c", "sphere": "s"}
    return PlannedPoses(np.asarray(q, dtype=float).reshape(len(q), -1), tuple(dict(fittings) for _ in q))


def matched(q, plan, said=None):
    q = np.asarray(q, dtype=float).reshape(len(q), -1)
    return match_plan(q, plan, said or [{}] * len(q))[0]


def test_missing_and_extra_dwells():
    plan = plan_of([0.0, 1.0, 2.0, 3.0, 4.0])
    assert matched([0.001, 1.5, 2.001, 4.0], plan) == [0, None, 2, 4]


@pytest.mark.parametrize(
    ("dwells", "poses"),
    [
        ([0, 1, 2, 0, 1, 2, 3, 4], [0, 1, 2, 0, 1, 2, 3, 4]),  # the program was begun again
        ([0, 1, 2, 3, 2, 3, 4], [0, 1, 2, 3, 2, 3, 4]),  # and here two poses back
        ([0, 1, 2, 3, 1, 4], [0, 1, 2, 3, None, 4]),  # one stop near an earlier pose is not a restart
        ([3, 4, 0, 1, 2], [3, 4, 0, 1, 2]),  # begun in the middle, then from the beginning
    ],
)
def test_a_plan_begun_again(dwells, poses):
    assert matched(np.array(dwells) + 0.001, plan_of([0.0, 1.0, 2.0, 3.0, 4.0])) == poses


def test_how_far_a_dwell_is_from_the_plan():
    plan = plan_of([[0.0, 0.0], [1.0, 0.0]])
    assert distances(np.array([0.9, 0.2]), plan) == pytest.approx([0.9, 0.2])
    assert np.isinf(distances(np.array([0.9]), plan)).all()
    assert matched([0.005], plan_of([0.0, 0.006, 0.001])) == [1]
    assert matched([0.004, 0.0041], plan_of([0.0, 0.004])) == [0, 1]
    plan = plan_of([[0.0, 0.0]])
    assert matched([[0.016, -0.016]], plan) == [0]
    assert matched([[0.0, 0.018]], plan) == [None]
    assert matched([[0.0, 0.0, 0.0]], plan) == [None]  # another number of joints


def test_what_was_said_to_be_mounted_decides():
    plan = PlannedPoses(np.zeros((2, 1)), ({"bar": "b46", "chuck": "c1"}, {"bar": "b46", "chuck": "c2"}))
    assert matched([0.0], plan, said=[{"chuck": "c2"}]) == [1]
    assert matched([0.0], plan, said=[{"chuck": "c3"}]) == [None]
    plan = PlannedPoses(np.zeros((2, 1)), tuple({"bar": bar, "chuck": "c", "sphere": "s"} for bar in ("b46", "b61")))
    assert set(match_plan(np.zeros((1, 1)), plan, [{}])[1]) == {0}
    assert match_plan(np.zeros((1, 1)), plan, [{"bar": "b61"}]) == ([1], {})


def all_ways(dwells, poses):
    """Return every assignment of dwells to poses of the plan or none, with its score; the poses of those with the highest score."""
    choices = [[None, *(p for p, at in enumerate(poses) if at == d)] for d in dwells]
    ways = {}
    for way in product(*choices):
        taken = [p for p in way if p is not None]
        steps = [0.0 if b > a else REPEAT if a == b else BACK for a, b in pairwise(taken)]
        ways.setdefault(len(taken) - sum(steps), []).append(way)
    return max(ways), ways[max(ways)]


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.integers(0, 2), min_size=1, max_size=5),
    st.lists(st.tuples(st.integers(0, 2), st.sampled_from("ab")), min_size=1, max_size=7),
)
def test_the_best_way_and_what_is_ambiguous(dwells, poses):
    """Against all ways, one by one. The best ways may differ in bars, and then only."""
    fittings = tuple({"bar": b, "chuck": "c", "sphere": "s"} for _, b in poses)
    plan = PlannedPoses(np.array([[float(p)] for p, _ in poses]), fittings)
    poses_found, ambiguous = match_plan(np.array(dwells, dtype=float)[:, None], plan, [{}] * len(dwells))
    _, ways = all_ways(dwells, [p for p, _ in poses])
    assert tuple(poses_found) in ways
    bars = [{poses[way[d]][1] for way in ways if way[d] is not None} for d in range(len(dwells))]
    assert set(ambiguous) == {d for d, of in enumerate(bars) if len(of) > 1}


def test_marks_of_a_stranger():
    marks = Marks()
    for data in (b"", b"[]", b'{"q":"x"}', b'{"q":[]}', b'{"q":[1e9]}', b'{"q":[NaN]}', b'{"q":[true]}', b"[" * 2000):
        marks.feed("/plan", 0, data)
    assert marks.rows == []
    for data in (b'{"q":[1,2],"bar":"b","chuck":null,"pose":0,"later":{}}', b'{"q":[1,2],"bar":7}', b'{"q":[1,2,3]}'):
        marks.feed("/plan", 0, data)
    marks.feed("/plan", 0, b'{"q":[1,2],"m\xedve":"via"}')
    marks.feed("/events", 1, b'{"bar":"b"}')
    assert marks.malformed == 12
    assert marks.plan().mounted == ({"bar": "b"},)
    marks.feed("/events", 5, b'{"kind":"mounted","bar":"b1"}')
    marks.feed("/events", 9, b'{"kind":"mounted","bar":"b2"}')
    assert [marks.mounted_at(t) for t in (4, 5, 8, 9)] == [{}, {"bar": "b1"}, {"bar": "b1"}, {"bar": "b2"}]
    assert marks.kinds == {"mounted": 2}


def test_only_dwells_of_a_plan_are_poses_to_be_matched():
    marks = Marks()
    for row in (
        b'{"q":[0,0],"move":"via"}',
        b'{"q":[1,0],"bar":"b","chuck":"c","sphere":"s"}',
        b'{"q":[2,0],"move":"line","line":"left","target":"ball","speed_m_s":0.1}',
        b'{"q":[3,0],"move":"dwell","bar":"b"}',
        b'{"q":[4,0],"move":"jump"}',
    ):
        marks.feed("/plan", 0, row)
    assert len(marks.rows) == 4
    assert marks.dwells == (1, 3)
    marks.feed("/plan", 0, b'{"q":[5,0]}')
    assert marks.dwells == (1, 3, 5)  # a row that cannot be used keeps its number
    assert marks.plan().q.tolist() == [[1.0, 0.0], [3.0, 0.0], [5.0, 0.0]]
    assert marks.rows[2].mounted == {"line": "left", "target": "ball"}


def test_a_stop_to_mount_another_pairing_is_no_lost_dwell():
    """Off the plan before its first pose, where the pairing changes, or where a mount was confirmed; elsewhere it is a stop that nobody asked for."""

    def row(q, chuck):
        fittings = {"bar": "b", "chuck": chuck, "sphere": "s"}
        return Message("/plan", 0, json.dumps({"q": [q], "move": "dwell", **fittings}).encode())

    marks = Marks()
    for message in [row(q, "c1") for q in (0.0, 1.0, 2.0)] + [row(q, "c2") for q in (3.0, 4.0)]:
        marks.feed(*message)
    marks.feed("/events", 75, b'{"kind": "mounted", "bar": "b", "chuck": "c1", "sphere": "s"}')
    stood = [(0.5, None), (0.0, 0), (0.5, None), (1.0, 1), (1.5, None), (2.0, 2), (2.5, None), (3.0, 3), (4.5, None)]
    dwells = [
        Dwell(
            0, float(i), i + 0.5, np.array([q]), np.eye(1), 9, float(i), (0, 9),
            reason="" if pose is not None else "no plan match", start_host_ns=20 * i, end_host_ns=20 * i + 10,
            pose=pose, mounted={} if pose is None else dict(marks.rows[pose].mounted),
        )
        for i, (q, pose) in enumerate(stood)
    ]  # fmt: skip
    found = [dwell.reason for dwell in with_mountings(dwells, marks)]
    assert found == [MOUNTING, "", "no plan match", "", MOUNTING, "", MOUNTING, "", "no plan match"]
