"""Tables and rigs that do not define a problem are refused with one line that names the row."""

from dataclasses import replace

import numpy as np
import pytest
from device_bench import join, rows
from puma_bench import BARS, CHAIN, CHUCKS, RIG, SPHERES, random_table
from tests.refusals import refused

from truearm.errors import ProblemError
from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.problem import build_problem
from truearm.kinds.table import ObservationTable
from truearm.types import BallBar, Device, Plane, Point, Rig, SocketDistance

TABLE = random_table(18, np.random.default_rng(0))


def with_cell(column, row, value):
    cells = getattr(TABLE, column).astype(object)
    cells[row] = value
    kind = float if column in ("value", "sigma") else str
    return replace(TABLE, **{column: cells.astype(kind)})


@pytest.mark.parametrize(
    ("column", "value", "says"),
    [
        ("chuck", "c9", "row 5: chuck 'c9'"),
        ("sphere", "x", "row 5: sphere 'x'"),
        ("bar", "medium", "row 5: bar 'medium'"),
        ("bar", "", "row 5: bar ''"),
        ("kind", "lidar", "row 5: kind 'lidar'"),
        ("value", np.nan, "row 5: a ball_bar row needs a length"),
        ("sigma", 0.0, "row 5: sigma must be positive"),
        ("sigma", -1e-4, "row 5: sigma must be positive"),
        ("sigma", np.inf, "row 5: sigma must be positive"),
    ],
)
def test_a_bad_cell(column, value, says):
    with pytest.raises(ProblemError, match=says) as caught:
        build_problem(CHAIN, RIG, with_cell(column, 4, value))
    assert "\n" not in str(caught.value)


def test_bad_joint_readings():
    with refused("other-robot", joints=5, expected=6):
        build_problem(CHAIN, RIG, replace(TABLE, q=TABLE.q[:, :5], q_rate=TABLE.q_rate[:, :5], side=TABLE.side[:, :5]))
    q = TABLE.q.copy()
    q[7, 2] = np.nan
    with pytest.raises(ProblemError, match="row 8:"):
        build_problem(CHAIN, RIG, replace(TABLE, q=q))


def test_only_names_and_their_own_sigmas_count():
    one = Rig(CHUCKS, SPHERES, {"b": BARS["short"]})
    problem = build_problem(CHAIN, one, replace(TABLE, bar=np.full(18, "")))
    np.testing.assert_allclose(problem.groups[0].sensor_cov, BARS["short"].sigma ** 2, rtol=1e-15)
    problem = build_problem(CHAIN, RIG, with_cell("sigma", 3, 2e-3))
    assert problem.groups[0].sensor_cov[3, 0] == 2e-3**2
    assert problem.groups[0].sensor_cov[4, 0] == BARS["short"].sigma ** 2


def test_what_is_used_and_not_known_becomes_a_parameter_with_its_prior():
    rig = Rig(
        {**CHUCKS, "c1": Point("c1", CHUCKS["c1"].xyz, None), "spare": Point("spare", (1.0, 1.0, 1.0), None)},
        {**SPHERES, "s2": Point("s2", SPHERES["s2"].xyz, 1e-4)},
        {**BARS, "short": BallBar("short", 0.46, 1.0, 0.075, 84e-6, zero_sigma=1e-3)},
    )
    problem = build_problem(CHAIN, rig, TABLE)
    rest = [f"{p}.{k}" for p in ("chuck.c1", "sphere.s2") for k in "xyz"]
    assert list(problem.names[54:]) == [*rest, "bar.short.zero"]
    np.testing.assert_array_equal(problem.prior_sigma[54:], [np.inf] * 3 + [1e-4] * 3 + [1e-3])
    assert np.isinf(problem.prior_sigma[:54]).all()
    assert problem.units[54:] == ("m",) * 7


def test_an_empty_table():
    with pytest.raises(ProblemError, match="no observations"):
        identify(CHAIN, RIG, TABLE.select(np.zeros(18, bool)))


def seat_rows(*labels):
    n = len(labels)
    place, socket = (np.array(names) for names in zip(*labels, strict=True))
    q = np.random.default_rng(1).uniform(-1, 1, (n, 6))
    source = [f"row {i + 1}" for i in range(n)]
    return ObservationTable(q=q, kind="seat", socket=socket, place=place, source=source)


def test_sockets_and_points_go_by_their_keys():
    rig = Rig(socket_distances=(SocketDistance(("x.0", "1"), 0.05, 1e-4),))
    table = seat_rows(("p.q", "x.0"), ("p.q", "1"), ("r", "x.0"), ("", "x.0"), ("", "1"))
    distances = build_problem(CHAIN, rig, table).groups[1]
    assert len(distances.distance) == 2  # at p.q and at the place without a name
    with pytest.raises(ProblemError, match=r"two sockets would both be called socket\.a\.b\.c"):
        build_problem(CHAIN, Rig(), seat_rows(("a.b", "c"), ("a", "b.c")))
    # Two entries may carry the same name inside; the key is what a table writes.
    same = {k: Point("same", p.xyz, None) for k, p in CHUCKS.items()}
    assert len(build_problem(CHAIN, Rig(same, SPHERES, BARS), TABLE).names) == 54 + 9


def unchecked(part, **fields):
    """Return a part of a rig with numbers that its constructor would refuse, since a kind's own entries may have no checks."""
    for name, value in fields.items():
        object.__setattr__(part, name, value)
    return part


@pytest.mark.parametrize(
    ("xyz", "sigma"), [((np.nan, 0.0, 0.0), 0.0), ((0.0, 0.0, 0.0), -1.0), ((0.0, 0.0, 0.0), np.nan)]
)
def test_numbers_of_the_rig_that_are_none(xyz, sigma):
    point = unchecked(Point("c1", (0.0, 0.0, 0.0)), xyz=xyz, sigma=sigma)
    with pytest.raises(ProblemError, match=r"chuck\.c1\.x .*finite"):
        build_problem(CHAIN, Rig({**CHUCKS, "c1": point}, SPHERES, BARS), TABLE)


def test_a_wild_prior_mean_of_the_bars_gain_does_no_harm():
    """Gains near zero divide by nearly nothing; the step is refused, not an exception."""
    rig = Rig(CHUCKS, SPHERES, {"short": BallBar("short", 0.46, 1e-6, 0.075, 84e-6, gain_sigma=10.0)})
    assert identify(CHAIN, rig, TABLE, options=SolverOptions(max_iterations=5)).status in (
        "converged",
        "max_iterations",
        "stalled",
    )


COV = ((1e-8, 0.0, 0.0), (0.0, 1e-8, 0.0), (0.0, 0.0, 1e-8))
AT = (1.0, 0.0, 0.0)
POINT = {"xyz": np.array([[0.0, 0.1, 0.0], [0.0, 0.2, 0.0]])}
FLAT = Plane("p", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1e-5)
Q = np.random.default_rng(2).uniform(-1.0, 1.0, (2, 6))


def tracker(**fields):
    return Rig(trackers={"t": unchecked(Device("t", COV, rotation_sigma=1e-4), **fields)})


@pytest.mark.parametrize(
    ("rig", "kind", "columns", "says"),
    [
        (Rig(), "line", {"line": "l"}, "line 1: a line row needs x, y and z"),
        (Rig(), "position", {"tracker": "t", **POINT}, "position 1: tracker 't'"),
        (Rig(lines={"l": Device("l", COV)}), "line", {"line": "k", **POINT}, "line 'k'"),
        (tracker(sigma=0.0), "position", {"tracker": "t", **POINT}, r"tracker\.t .*sigma 0 .*xyz_mm"),
        (tracker(xyz=AT, sigma=-1.0), "position", {"tracker": "t", **POINT}, r"tracker\.t\.x .* 1 ± -1"),
        (tracker(xyz=(np.nan, 0.0, 0.0)), "position", {"tracker": "t", **POINT}, r"tracker\.t\.x .*nan"),
        (tracker(), "pose", {"tracker": "t", **POINT}, "pose 1: a pose row needs rx, ry and rz"),
        (tracker(rotation_sigma=None), "pose", {"tracker": "t", "rotation": np.zeros((2, 3)), **POINT}, "pose 1:"),
        (tracker(), "position", {"tracker": "t", "sigma": np.array([1e-5, 0.0]), **POINT}, "position 2: sigma must be"),
        (
            Rig(time_offset_sigma=None),
            "line",
            {"line": "l", "q_rate": np.array([[1.0] * 6, [1.0] * 5 + [np.nan]]), **POINT},
            "line 2:",
        ),
        (unchecked(Rig(), time_offset=np.nan), "line", {"line": "l", **POINT}, "time_offset .*nan"),
        (Rig(), "plane", {"plane": "p"}, "plane 1: plane 'p'"),
        (Rig(planes={"p": FLAT}), "plane", {"plane": "p", "value": np.array([0.0, np.inf])}, "plane 2: its distance"),
        (Rig(joint_cov=((1.0,),)), "line", {"line": "l", **POINT}, "1 joint"),
    ],
)
def test_devices_and_rows_that_make_no_problem(rig, kind, columns, says):
    with pytest.raises(ProblemError, match=says) as caught:
        build_problem(CHAIN, rig, rows(kind, Q, **columns))
    assert "\n" not in str(caught.value)


def test_devices_go_by_the_rigs_key_and_rows_by_their_own_sigma():
    rig = Rig(trackers={"left": Device("same", COV), "right": Device("same", COV)})
    t = rows("position", Q, tracker="left", **POINT)
    both = build_problem(CHAIN, rig, replace(t, tracker=np.array(["left", "right"])))
    assert both.names[54::6] == ("tracker.left.x", "tracker.right.x")
    alone = build_problem(CHAIN, Rig(trackers={"left": Device("same", COV)}), replace(t, tracker=np.array(["", ""])))
    assert alone.names[54] == "tracker.left.x"
    assert build_problem(CHAIN, Rig(), rows("line", Q, **POINT)).names[54] == "line.x"
    rig = tracker(sensor_cov=((1e-8, 1e-9, 0.0), (1e-9, 1e-8, 0.0), (0.0, 0.0, 1e-8)))
    t = rows("position", Q, tracker="t", sigma=np.array([np.nan, 1e-3]), **POINT)
    (group,) = build_problem(CHAIN, rig, t).groups
    np.testing.assert_array_equal(group.sensor_cov[0], rig.trackers["t"].sensor_cov)
    np.testing.assert_array_equal(group.sensor_cov[1], 1e-3**2 * np.eye(3))


def test_unknowns_of_devices_have_units_and_priors():
    rig = replace(tracker(xyz=AT, sigma=0.1, turn_sigma=0.05), planes={"p": replace(FLAT, offset_sigma=0.0)})
    t = rows("position", Q, tracker="t", **POINT)
    touch = rows("plane", Q, plane="p")
    problem = build_problem(CHAIN, rig, join(t, touch))
    assert problem.units[54:] == ("m", "m", "m", "rad", "rad", "rad", "rad", "rad")
    np.testing.assert_array_equal(problem.prior_sigma[54:], [0.1] * 3 + [0.05] * 3 + [np.inf] * 2)
    assert problem.names[60:] == ("plane.p.tilt1", "plane.p.tilt2")
    np.testing.assert_array_equal(problem.start[54:], [1.0] + [0.0] * 7)


def test_a_robot_and_a_rig_with_one_name_are_refused():
    """A joint of a URDF may be called anything."""
    first, *others = CHAIN.parameters
    chain = replace(CHAIN, parameters=(replace(first, name="tracker.t.x"), *others))
    t = rows("position", Q, tracker="t", **POINT)
    with pytest.raises(ProblemError, match=r"parameter tracker\.t\.x"):
        build_problem(chain, Rig(trackers={"t": Device("t", COV)}), t)
