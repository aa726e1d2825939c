"""The predicted error of the tool by the covariance, and of measured orientations."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from device_bench import TARGETS, join, joints_at, rows, touches, tracked
from puma_bench import CHAIN, CHUCKS, FREE, RIG, SIGMA, SPHERES, TRUTH, random_table, shell_table

from truearm.estimate import prediction
from truearm.estimate.defaults import choose_defaults
from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.prediction import MOST_POSES, ParametersKnown, end_sigmas, point_covariance, predicted_point_error
from truearm.estimate.uncertainty import weak_prior
from truearm.kinds.table import ObservationTable
from truearm.model.chain import joint_frames, point_forward, point_jacobians
from truearm.model.robot_file import load_robot
from truearm.model.transforms import rotation, rotation_vector
from truearm.results import weights_of
from truearm.types import BallBar, Device, Plane, Point, Rig, rms
from truearm.workflows.identify import IdentifyOptions, identified
from truearm.workflows.inputs import Observed

MUKCA = Path(__file__).parents[1] / "data" / "mukca"
SENSOR = ((1e-8, 0.0, 0.0), (0.0, 1e-8, 0.0), (0.0, 0.0, 1e-8))  # m²: 0.1 mm each axis
TURN = 2e-4  # rad
UNKNOWN = Device("t", SENSOR, rotation_sigma=TURN)


@pytest.fixture(scope="module")
def bars():
    table = random_table(300, np.random.default_rng(0), SIGMA)
    return table, identify(CHAIN, RIG, table, free=FREE)


def test_ball_bars_see_the_tool_in_the_base_frame_beyond_the_rank_too(bars):
    table, estimate = bars
    found = predicted_point_error(CHAIN, RIG, table, estimate)
    spheres = np.array([SPHERES[name].xyz for name in table.sphere])
    _, jac, _ = point_jacobians(CHAIN, estimate.value, table.q, spheres)
    every = np.sqrt(np.einsum("nip,pq,niq->n", jac, estimate.covariance, jac))
    assert (found.n, found.relative) == (300, False)
    assert found.rms == pytest.approx(np.sqrt(np.mean(every**2)), rel=1e-7)
    assert found.max == pytest.approx(every.max(), rel=1e-7)
    assert found.at in set(table.source)
    table, estimate = bars
    every = identify(CHAIN, RIG, table)
    assert len(every.null_space) == 18
    few, many = (predicted_point_error(CHAIN, RIG, table, e) for e in (estimate, every))
    assert many.rms == pytest.approx(few.rms, rel=1e-6)  # two fits, each converged to 1e-8 or so of a σ
    assert not many.relative


@pytest.mark.parametrize("seed", [8, 16])
def test_six_constants_a_joint_do_not_move_the_tool(seed):
    """A URDF's redundant parameters leave every length as it is. As printed, without parts below 1e-6, they do not quite."""
    robot = load_robot(str(MUKCA / "panda.urdf"), None, "ball_link")
    rng = np.random.default_rng(seed)
    chain, n = robot.chain, 120
    truth = chain.params_nominal + np.where(robot.free, weak_prior(chain) * rng.standard_normal(robot.free.size), 0.0)
    lower, upper = np.clip(chain.limits, -2.5, 2.5)
    q = rng.uniform(lower, upper, (n, len(chain.joints)))
    spheres = {"s1": (0.0, 0.03, 0.02), "s2": (0.02, -0.03, 0.05), "s3": (-0.03, 0.0, 0.08)}
    chucks = {"c1": (0.5, 0.0, 0.0), "c2": (0.3, 0.5, 0.0), "c3": (0.6, -0.4, 0.1)}
    sphere, chuck = rng.choice(list(spheres), n), rng.choice(list(chucks), n)
    ends = point_forward(chain, truth, q, np.array([spheres[name] for name in sphere]))
    length = np.linalg.norm(ends - [chucks[name] for name in chuck], axis=1) + 3e-5 * rng.standard_normal(n)
    rig = Rig(
        spheres={name: Point(name, at, 0.0) for name, at in spheres.items()},
        chucks={name: Point(name, at, 0.0) for name, at in chucks.items()},
        bars={"b": BallBar("b", 1.0, 1.0, 3.0, 3e-5)},
    )
    table = ObservationTable(q=q, kind="ball_bar", value=length, bar="b", chuck=chuck, sphere=sphere)
    estimate = identify(chain, rig, table, free=robot.free)
    few = identify(chain, rig, table, free=estimate.suggested_free[: truth.size])
    predicted = [predicted_point_error(chain, rig, table, each) for each in (estimate, few)]
    assert not predicted[0].relative
    assert predicted[0].rms == pytest.approx(predicted[1].rms, rel=1e-3)
    stored = weights_of(estimate.null_space, chain.parameter_names)
    known = ParametersKnown(
        chain, estimate.value[: truth.size], estimate.covariance[: truth.size, : truth.size], stored
    )
    sigmas = end_sigmas(known, q, np.tile(spheres["s1"], (n, 1)))
    assert sigmas is not None
    assert not sigmas.relative


def test_about_one_chuck_the_arm_may_turn_as_one_body(bars):
    """Rank 33: three directions are not seen, all of them turns of the whole arm about the chuck."""
    table = bars[0].select(bars[0].chuck == "c0")
    rig = replace(RIG, chucks={"c0": CHUCKS["c0"]})
    estimate = identify(CHAIN, rig, table, free=FREE)
    assert estimate.rank == 33
    assert predicted_point_error(CHAIN, rig, table, estimate).relative


def test_two_sockets_do_not_say_how_far_they_are_apart():
    """Each place's seats agree with each other alone; the places may move against each other, and no figure is honest."""
    rng = np.random.default_rng(4)
    at = {"a": (0.4, 0.2, 0.5), "b": (0.4, -0.3, 0.6)}
    seats = [rows("seat", joints_at(np.tile(xyz, (15, 1)), rng), socket="0", place=place) for place, xyz in at.items()]
    table = join(*seats)
    table = table.select(np.isfinite(table.q).all(axis=1))
    rig = Rig(spheres={"ball": TARGETS["ball"]})
    estimate = identify(CHAIN, rig, table, free=FREE)
    assert set(table.place) == {"a", "b"}
    assert predicted_point_error(CHAIN, rig, table, estimate) is None


def test_flats_alone_do_not_determine_the_tool(monkeypatch):
    """What moves the tool is seen, if only just: to first order it would be off by some 100 m, which means nothing."""
    normals = {"top": (0.0, 0.05, 1.0), "front": (1.0, 0.1, 0.2), "side": (0.1, 1.0, 0.3)}
    flats = {name: Plane(name, (0.45, 0.0, 0.3), normal, 2e-5) for name, normal in normals.items()}
    rng = np.random.default_rng(5)
    table = join(*(touches(flat, 40, rng) for flat in flats.values()))
    table = replace(table, value=table.value + 2e-5 * rng.normal(size=len(table)))
    rig = Rig(targets={"ball": TARGETS["ball"]}, planes=flats)
    estimate = identify(CHAIN, rig, table, free=FREE, options=SolverOptions(max_iterations=5))
    assert predicted_point_error(CHAIN, rig, table, estimate) is None
    monkeypatch.setattr(prediction, "FIRST_ORDER", np.inf)
    assert predicted_point_error(CHAIN, rig, table, estimate).rms > 10.0


def test_a_tracker_anywhere_sees_the_tool_but_not_the_base():
    """Robots drawn from the covariance, each moved onto the estimate as one body, spread as was predicted."""
    rng = np.random.default_rng(1)
    table = tracked("position", 120, np.array([1.5, 0.2, 0.5, 0.1, 0.2, 0.3]), rng)
    table = replace(table, xyz=table.xyz + 1e-4 * rng.normal(size=table.xyz.shape))
    rig = Rig(targets=TARGETS, trackers={"t": UNKNOWN})
    estimate = identify(CHAIN, rig, table, free=FREE)
    found = predicted_point_error(CHAIN, rig, table, estimate)
    assert found.relative
    p_end = np.array(TARGETS["ball"].xyz)
    at = point_forward(CHAIN, estimate.value[:54], table.q, p_end)
    spread = []
    for delta in rng.multivariate_normal(np.zeros(54), estimate.covariance[:54, :54], 200, method="svd"):
        moved = point_forward(CHAIN, estimate.value[:54] + delta, table.q, p_end)
        spread.append(np.mean(np.sum((aligned(moved, at) - at) ** 2, axis=1)))
    # 200 draws of a mean square over about 27 directions: well below 2/sqrt(2·200) = 10 % of it, 5 % of its root
    assert np.sqrt(np.mean(spread)) == pytest.approx(found.rms, rel=0.05)
    assert 0.0 < found.rms < 1e-4  # better than one reading


def aligned(a, b):
    """Return points a (n, 3) moved as one body onto b (Kabsch)."""
    u, _, vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    turn = (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
    return (a - a.mean(0)) @ turn.T + b.mean(0)


def test_large_tables_orientations_and_rows_without(bars):
    table = shell_table(27, 0.46, np.random.default_rng(2), SIGMA)
    many = table.select(np.arange(2000) % 27)
    estimate = identify(CHAIN, RIG, many, free=np.array([name == "link2.x" for name in CHAIN.parameter_names]))
    assert predicted_point_error(CHAIN, RIG, many, estimate).n == MOST_POSES
    # Noise of σ about each of three axes: an angle of σ√3 in the root mean square, less what the fit takes up.
    rng = np.random.default_rng(3)
    n = 150
    true = tracked("pose", n, np.array([1.5, 0.2, 0.5, 0.1, 0.2, 0.3]), rng)
    turned = rotation_vector(rotation(TURN * rng.normal(size=(n, 3))) @ rotation(true.rotation))
    noisy = replace(true, rotation=turned, xyz=true.xyz + 1e-4 * rng.normal(size=(n, 3)))
    rig = Rig(targets=TARGETS, trackers={"t": UNKNOWN})
    estimate = identify(CHAIN, rig, noisy, free=FREE)
    angle = estimate.residual["rad"]
    assert estimate.rms_after.keys() == estimate.rms_before.keys() == estimate.rms_history.keys() == {"m", "rad"}
    assert estimate.rms_after["rad"] == pytest.approx(np.sqrt(np.mean(angle**2)), rel=1e-12)
    freedom = 1.0 - (36 + 6) / (6 * n)
    # χ² of 3n angles: standard deviation of the root 1/sqrt(6n) = 3.3 %; four of these, and what the split leaves open
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(TURN * np.sqrt(3 * freedom), rel=0.15)
    _, estimate = bars
    assert estimate.residual.keys() == estimate.rms_after.keys() == {"m"}


def coverage(worlds, kind):
    """Return the share of coordinates within two predicted standard deviations of the truth, over noisy worlds."""
    inside, unknown = [], {name: replace(p, sigma=None) for name, p in TARGETS.items()}
    for seed in range(worlds):
        rng = np.random.default_rng(seed)
        if kind == "spheres":
            table = random_table(180, rng, SIGMA)
            rig = replace(RIG, spheres={name: replace(p, sigma=None) for name, p in SPHERES.items()})
            p_end = np.array([SPHERES[str(name)].xyz for name in table.sphere])
        else:
            table = tracked("position", 150, np.array([1.5, 0.2, 0.5, 0.1, 0.2, 0.3]), rng)
            table = replace(table, xyz=table.xyz + 1e-4 * rng.normal(size=table.xyz.shape))
            rig, p_end = Rig(targets=unknown, trackers={"t": UNKNOWN}), np.array(TARGETS["ball"].xyz)
        free, _, chosen = choose_defaults(CHAIN, rig, table, FREE, np.zeros(54, bool), prior=False)
        estimate = identify(CHAIN, rig, table, free=free)
        found = point_covariance(CHAIN, rig, table, estimate, any_base=bool(chosen.base))
        truth = point_forward(CHAIN, TRUTH, table.q, p_end)
        error = (aligned(found.points, truth) if found.relative else found.points) - truth
        sigma = np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2))
        inside.append(np.mean(np.abs(error) <= 2.0 * sigma))
    return float(np.mean(inside)), float(np.std(inside) / np.sqrt(worlds))


@pytest.mark.parametrize("kind", ["spheres", "tracker"])
def test_points_are_as_uncertain_as_robot_and_rig_say(kind):
    """0.954 of a normal error lies within two standard deviations; within four standard errors of eight worlds."""
    share, error = coverage(8, kind)
    assert abs(share - 0.954) < 4.0 * max(error, 0.01)


@pytest.mark.soak
@pytest.mark.parametrize("kind", ["spheres", "tracker"])
def test_points_are_as_uncertain_as_robot_and_rig_say_in_60_worlds(kind):
    assert 0.93 <= coverage(60, kind)[0] <= 0.97


def sagging(n: int, sensor: float, declared: float, joint: float = 0.0, shared: float = 0.0, rows: int = 1):
    """Return what identifies an arm that sags in joint 2, and its scatter (m).

    ``sensor`` and ``declared`` are noise of the ``rows`` a pose (m, an axis), ``joint`` (rad) and ``shared`` (m, an axis) of n poses.
    """
    robot = load_robot(str(MUKCA / "panda.urdf"), None, "ball_link")
    rng = np.random.default_rng(3)
    chain, tracker = robot.chain, np.array([1.5, 0.2, 0.5])
    truth = chain.params_nominal + np.where(robot.free, weak_prior(chain) * rng.standard_normal(robot.free.size), 0.0)
    lower, upper = np.clip(chain.limits, -2.0, 2.0)
    q = rng.uniform(lower, upper, (n, len(chain.joints)))
    frames = joint_frames(chain, truth, q)
    lever = point_forward(chain, truth, q, np.zeros(3)) - frames[:, 1, :3, 3]
    true = q.copy()
    true[:, 1] -= 5e-3 * np.cross(frames[:, 1, :3, 2], lever)[:, 2]
    still = point_forward(chain, truth, true, np.zeros(3))
    noise = rng.standard_normal((n * rows, 3))
    points = point_forward(chain, truth, true + joint * rng.standard_normal(q.shape), np.zeros(3))
    points = points + shared * rng.standard_normal((n, 3))
    xyz = np.repeat(points, rows, axis=0) - tracker + sensor * noise
    table = ObservationTable(q=np.repeat(q, rows, axis=0), kind="position", xyz=xyz, tracker="t")
    rig = Rig(
        trackers={"t": Device("t", (declared**2 * np.eye(3)).tolist())},
        targets={"ball": Point("ball", (0.0,) * 3, 0.0)},
    )
    result = identified(robot, Observed(rig, table), (), IdentifyOptions(joint_laws="sag"))
    assert result.estimate.joint_laws.kept
    return result, rms(np.linalg.norm(points - still, axis=1))


def test_scatter_and_sag_count_in_the_error_of_the_tool():
    # With sag the parameters move by milliradians. The geometry's own null space, taken before, then moves the tool by
    # 0.2 mm.
    result, _ = sagging(40, sensor=5e-5, declared=5e-5)
    assert result.estimate.null_space
    assert result.predicted.rms == pytest.approx(3e-5, rel=0.4)
    # A tracker declared at what its readings scatter by, arm included: the rows tell the two apart, χ² does not.
    result, scatter = sagging(300, sensor=2e-5, declared=6e-5, joint=6e-5)
    assert result.estimate.covariance_explains
    assert result.predicted.scatter == pytest.approx(scatter, rel=0.25)
    # The ball is near the axis of joint 7: whatever angle is learned, it moves the ball by less than a reading scatters.
    noise = result.document["joint_laws"]["noise"]
    at_tool = [noise[f"panda_joint{number}_mm"] for number in range(1, 8)]
    total = np.hypot.reduce([*at_tool, np.sqrt(3.0) * noise["shared_mm"]])
    assert total == pytest.approx(1e3 * result.predicted.scatter)
    assert at_tool[6] < 1e3 * 2e-5
    result, scatter = sagging(80, sensor=2e-5, declared=6.5e-5, shared=6e-5, rows=4)
    assert result.estimate.covariance_explains
    assert result.predicted.scatter == pytest.approx(scatter, rel=0.25)


@pytest.mark.parametrize(("n", "rows"), [(300, 1), (80, 4)])
def test_noise_of_the_tracker_is_not_scatter_of_the_arm(n, rows):
    result, _ = sagging(n, sensor=5e-5, declared=5e-5, rows=rows)
    assert result.predicted.scatter == 0.0
