"""Sockets from an empty folder: init plans the seats, the joints are written into a table, identify and status read it."""

import csv
import json
import tomllib
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from command_line import told
from ros_bags import joint_state, write_bag
from scipy.spatial.transform import Rotation
from tests.host.findings_bench import listed
from tests.refusals import ended, refused, shown

import truearm
from truearm.cli.main import main
from truearm.estimate.uncertainty import weak_prior
from truearm.kinds.rig_file import parse_rig, write_rig
from truearm.kinds.seat import other_lengths
from truearm.kinds.table import ObservationTable
from truearm.model.chain import joint_and_end_frames, point_forward, point_jacobians
from truearm.model.robot_file import load_robot
from truearm.plan.forecast import planned_table
from truearm.plan.socket_places import SocketBlock, plans_of_sites
from truearm.report.result_findings import result_findings
from truearm.types import rms
from truearm.workflows.socket_project import RIG, stl

PANDA = Path(__file__).parents[1] / "data" / "mukca" / "panda.urdf"
FIVE = (  # name, axis, origin, limit: a desktop arm with five axes
    *(("pan", "0 0 1", "0 0 0.06", 1.9), ("lift", "0 1 0", "0.03 0 0.055", 1.75)),
    *(("elbow", "0 1 0", "0.028 0 0.113", 1.7), ("flex", "0 1 0", "0.135 0 0.005", 1.66)),
    ("roll", "1 0 0", "0.06 0 0", 2.8),
)
SEAT_NOISE = 5e-5  # m


def urdf(path, joints):
    """Write an arm whose tool points along the z axis of its last link."""
    links = "".join(f'<link name="l{i}"/>' for i in range(len(joints) + 2))
    turning = "".join(
        f'<joint name="{name}" type="revolute"><origin xyz="{xyz}"/><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<axis xyz="{axis}"/><limit lower="{-limit}" upper="{limit}" effort="1" velocity="1"/></joint>'
        for i, (name, axis, xyz, limit) in enumerate(joints)
    )
    end = len(joints)
    tool = (
        f'<joint name="tool" type="fixed"><origin xyz="0.05 0 0" rpy="0 {np.pi / 2} 0"/>'
        f'<parent link="l{end}"/><child link="l{end + 1}"/></joint>'
    )
    path.write_text(f'<robot name="arm">{links}{turning}{tool}</robot>')
    return path


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def measured(home, robot, ball, seed=1):
    """Fill in the table of seats as a true arm would, whose blocks stand 5 mm from where the plan has them."""
    rng, chain = np.random.default_rng(seed), robot.chain
    sigma = np.array([np.radians(0.3) if p.unit == "rad" else 4e-4 if p.unit == "m" else 0.0 for p in chain.parameters])
    truth = chain.params_nominal + robot.free * sigma * rng.normal(size=len(chain.parameters))
    plan, table = rows(home / "places.csv"), rows(home / "seats.csv")
    joints = [name for name in table[0] if name.startswith("q")]
    q = np.radians([[float(row[name]) for name in joints] for row in plan])
    moved = {place: 5e-3 * rng.normal(size=3) for place in dict.fromkeys(row["place"] for row in plan)}
    socket = np.array([[1e-3 * float(row[f"ball_{axis}_mm"]) for axis in "xyz"] + moved[row["place"]] for row in plan])
    socket += SEAT_NOISE * rng.normal(size=socket.shape)
    for _ in range(6):
        p, _, jacobian = point_jacobians(chain, truth, q, np.array(ball))
        q = q + (np.linalg.pinv(jacobian) @ (socket - p)[..., None])[..., 0]
    np.testing.assert_allclose(point_forward(chain, truth, q, np.array(ball)), socket, atol=1e-9)
    for row, readings in zip(table, np.degrees(q), strict=True):
        row.update(zip(joints, readings.round(4), strict=True))
    with (home / "seats.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, table[0])
        writer.writeheader()
        writer.writerows(table)
    return truth


@pytest.mark.parametrize("arm", ["five axes", "panda.urdf", "ur3e"])
def test_from_an_empty_folder_to_the_floor(tmp_path, run, monkeypatch, arm):
    monkeypatch.chdir(tmp_path)
    model = {"five axes": urdf(tmp_path / "five.urdf", FIVE), "panda.urdf": PANDA}.get(arm, arm)
    links = ["--tip", "ball_link"] if model == PANDA else []
    ball = (0.0, 0.0, 0.0) if model == PANDA else (0.0, 0.0, 0.05) if arm == "five axes" else (0.0, 0.0, 0.1)
    at = ",".join(f"{1e3 * x:g}" for x in ball)
    planned = run("init", "bench", "--method", "sockets", "--model", model, *links, f"--ball-xyz-mm={at}", "--json")
    assert planned.code == 0
    forecast = json.loads(planned.out)["plan"]
    assert forecast["cartesian_relative"]
    monkeypatch.chdir("bench")
    project = tomllib.loads(Path("truearm.toml").read_text())
    assert all(Path(project[name]).exists() for name in ("rig", "table", "plan") if name in project)
    status = json.loads(run("status", "--json").out)
    assert (status["seats"]["rows"], status["seats"]["noted"], status["seats"]["last_place"]) == (72, 0, "p6")
    assert "seats.csv" in status["next"]

    robot = load_robot(str(model), None, "ball_link" if links else None)
    plan = rows(Path("places.csv"))
    q = np.radians([[float(row[f"q{i}_deg"]) for i in range(1, len(robot.chain.joints) + 1)] for row in plan])
    goal = np.array([[1e-3 * float(row[f"ball_{axis}_mm"]) for axis in "xyz"] for row in plan])
    lower, upper = robot.chain.limits
    assert np.all((q > lower) & (q < upper))
    np.testing.assert_allclose(robot.forward(q)[:, :3, :3] @ ball + robot.forward(q)[:, :3, 3], goal, atol=1e-3)
    assert len({(row["place"], row["socket"]) for row in plan}) == 12
    for place in {row["place"] for row in plan}:
        of_place = q[[row["place"] == place for row in plan]]
        assert np.ptp(of_place, axis=0).max() > 1.0  # several orientations

    measured(Path(), robot, ball)
    assert json.loads(run("status", "--json").out)["next"] == "truearm identify --hold-out place=p6"
    code, out, err = run("identify", "--hold-out", "place=p6", "--joint-laws", "none", "--json")
    assert code == 0, out + err
    document = json.loads(out)
    assert document["predicted_error"]["rms_mm"] == pytest.approx(forecast["cartesian_rms_mm"], rel=0.25)
    held_out = document["held_out"]
    assert held_out["n_mm"] == 12
    assert held_out["rms_mm"] < 1.3e3 * np.sqrt(3.0) * SEAT_NOISE  # of three coordinates: the floor
    assert json.loads(run("status", "--json").out)["next"].startswith("truearm correct results")


def logged(q, rng, pause_s, rate_hz=25.0):
    """Return time (n,) and joints (n, j) of an arm that moves from row to row of q, and rests ``pause_s`` in each."""
    moves = [np.linspace(a, b, 40)[1:-1] for a, b in pairwise(np.radians(q))]
    still = [np.tile(row, (int(pause_s * rate_hz), 1)) for row in np.radians(q)]
    track = np.concatenate([piece for pair in zip(still, [*moves, still[0][:0]], strict=True) for piece in pair])
    return 100.0 + np.arange(len(track)) / rate_hz, track + 1e-4 * rng.uniform(-1.0, 1.0, track.shape)


@pytest.mark.parametrize("kind", ["csv", "bag"])
def test_the_joints_come_from_the_log_of_the_arm(tmp_path, run, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    names = [name for name, *_ in FIVE]
    arm = urdf(tmp_path / "five.urdf", FIVE)
    few = run("init", ".", "--method", "sockets", "--model", arm, "--seats", 4, "--places", 2)
    told(few, "no-plan", seats=8, places=2)
    assert run("init", ".", "--method", "sockets", "--model", arm, "--seats", 4, "--places", 3).code == 0
    joints = [f"q{i}_deg" for i in range(1, 6)]
    q = np.array([[float(row[name]) for name in joints] for row in rows(Path("places.csv"))])
    t, track = logged(q, np.random.default_rng(1), 3.0)
    if kind == "csv":
        log = Path("log.csv")
        cells = [",".join(map(repr, (a, *b))) for a, b in zip(t.tolist(), track.tolist(), strict=True)]
        log.write_text("\n".join(["t_s,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad", *cells]))
    else:
        order = [2, 0, 1, 4, 3]
        states = [
            (int(1e9 * a), joint_state(int(1e9 * a), [names[k] for k in order], b[order]))
            for a, b in zip(t, track, strict=True)
        ]
        log = write_bag(tmp_path / "bag", "mcap", states)
    before = Path("seats.csv").read_bytes()
    ended(run("seats", log, "--rest-s", 4).err, "invalid-input", place=log, rests=[], rows=12)
    assert Path("seats.csv").read_bytes() == before
    assert run("seats", log).code == 0
    assert (shown["seats-filled"]["place"], shown["seats-filled"]["n"]) == ("seats.csv", 12)
    filled = np.array([[float(row[name]) for name in joints] for row in rows(Path("seats.csv"))])
    np.testing.assert_allclose(filled, q, atol=np.degrees(1e-4))
    assert json.loads(run("status", "--json").out)["seats"]["noted"] == 12
    ended((again := run("seats", log)).err, "invalid-input", place=log, rows=0)
    rests = again.finding.values["rests"]
    assert (len(rests), rests[0]) == (12, "100.0 to 103.0 s")


def facets(data):
    return np.frombuffer(data[84:], [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def test_the_block_for_a_ball_of_20_mm_is_kept_as_a_file():
    kept = (Path(__file__).parents[2] / "hardware" / "socket_20mm.stl").read_bytes()
    np.testing.assert_allclose(facets(kept)["corners"], facets(stl(SocketBlock(10e-3)))["corners"], atol=1e-4)


@pytest.mark.parametrize("ball_mm", [6.0, 20.0, 40.0])
def test_the_block_is_closed_and_holds_the_ball(ball_mm):
    block = SocketBlock(0.5e-3 * ball_mm)
    file = facets(stl(block))
    assert int.from_bytes(stl(block)[80:84], "little") == len(file)
    corners = [[tuple(corner) for corner in facet] for facet in file["corners"].tolist()]
    edges = Counter((facet[i], facet[(i + 1) % 3]) for facet in corners for i in range(3))
    assert all(count == 1 and edges[end, start] == 1 for (start, end), count in edges.items())
    points = file["corners"].astype(float)
    volume = np.einsum("ni,ni->", points[:, 0], np.cross(points[:, 1], points[:, 2])) / 6.0
    cones = 2.0 * np.pi / 3.0 * (0.85**3 - 0.3**3) * (0.5 * ball_mm) ** 3  # of 45°, from the apex
    assert volume == pytest.approx(np.prod(block.size) * 1e9 - cones, rel=1e-3)
    centre = 1e3 * np.array([0.5 * block.distance, 0.0, block.centre_height])
    dense = points[:, None] * np.array([[0.6, 0.2, 0.2], [0.1, 0.8, 0.1], [0.5, 0.5, 0.0]])[:, :, None]
    gap = np.linalg.norm(np.concatenate([points.reshape(-1, 3), dense.sum(axis=2).reshape(-1, 3)]) - centre, axis=1)
    assert gap.min() > 0.5 * ball_mm * (1.0 - 2e-3)  # nothing within the ball, up to the facets of the cone


def test_an_arm_with_four_axes_is_planned_and_one_with_three_is_not(tmp_path, run):
    four, three = (urdf(tmp_path / f"{n}.urdf", FIVE[:n]) for n in (4, 3))
    assert run("init", tmp_path / "a", "--method", "sockets", "--model", four, "--seats", 6, "--places", 3).code == 0
    assert len(rows(tmp_path / "a" / "places.csv")) == 18
    told(run("init", tmp_path / "b", "--method", "sockets", "--model", three), "no-plan", joints=3)
    assert not (tmp_path / "b").exists()


def test_no_link_touches_a_table_that_is_higher_than_the_base(tmp_path, run):
    """The table begins at 0.3 of the arm's length of 336 mm from the base's axis, and the shoulder is below it."""
    arm = urdf(tmp_path / "five.urdf", FIVE)
    options = ["--method", "sockets", "--model", arm, "--table-mm", 120, "--places", 3, "--seats", 8]
    assert run("init", tmp_path / "a", *options).code == 0
    plan, chain = rows(tmp_path / "a" / "places.csv"), load_robot(str(arm)).chain
    q = np.radians([[float(row[f"q{i}_deg"]) for i in range(1, 6)] for row in plan])
    joints, end = joint_and_end_frames(chain, chain.params_nominal, q)
    points = np.concatenate([joints, end[:, None]], axis=1)[:, :, :3, 3]
    over = points[np.hypot(points[..., 0], points[..., 1]) > 0.3 * 0.336]
    assert (points[:, 1, 2] < 0.12).all()
    assert len(over) > len(q)
    assert over[:, 2].min() > 0.12
    ball = np.array([[1e-3 * float(row[f"ball_{axis}_mm"]) for axis in "xyz"] for row in plan])
    assert np.hypot(*ball.T[:2]).min() > 0.3 * 0.336


@pytest.mark.parametrize(
    ("options", "code", "values"),
    [
        (["--table-mm", 900], "no-plan", {"reached": 0, "places": 6}),
        (["--bars-mm", "300"], "no-effect", {"place": "bars_mm"}),
        (["--chucks", 3], "no-effect", {"place": "chucks"}),  # also at its default
        (["--minutes", 10], "no-effect", {"place": "minutes"}),
        (["--ball-xyz-mm", "1,2"], "wrong-value", {"place": "--ball-xyz-mm", "value": "1,2"}),
    ],
)
def test_what_cannot_be_planned_writes_nothing(tmp_path, run, options, code, values):
    arm = urdf(tmp_path / "five.urdf", FIVE)
    told(run("init", tmp_path / "bench", "--method", "sockets", "--model", arm, *options), code, **values)
    assert not (tmp_path / "bench").exists()


def test_a_rig_that_exists_is_kept(tmp_path, run):
    (tmp_path / "rig.toml").write_text("# mine\n")
    told(run("init", tmp_path, "--method", "sockets", "--model", urdf(tmp_path / "five.urdf", FIVE)), "already exists")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["five.urdf", "rig.toml"]
    assert (tmp_path / "rig.toml").read_text() == "# mine\n"


def test_radians_called_degrees_are_named_although_a_ball_in_metres_would_be_too_far_away(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("init", ".", "--method", "sockets", "--model", "ur5e").code == 0
    table = rows(PANDA.parents[1] / "sockets" / "seats.csv")
    with Path("seats.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, table[0])
        writer.writeheader()
        for row in table:
            writer.writerow({k: np.radians(float(v)) if k.startswith("q") else v for k, v in row.items()})
    answer = run("identify", "--hold-out", "place=p6")
    assert answer.code == 3, answer
    assert (shown["wrong-unit"]["are"], shown["wrong-unit"]["called"]) == ("radians", "degrees")


# one measured distance of two sockets has one error, at however many places the block was used

BALL = (0.0, 0.0, 0.1)
BLOCK = SocketBlock(0.01)
ROBOT = truearm.load_robot("ur5e")
RIG_OF_BLOCK = parse_rig(RIG.format(name="ur5e", ball="0, 0, 100", distance=1e3 * BLOCK.distance), "rig.toml")
SIGMA = RIG_OF_BLOCK.socket_distances[0].sigma
SEEDS = 24


@pytest.fixture(scope="module", params=[3, 6])
def seats(request):
    """Seats of a plan as rows, and the balls' centres (n, 3) from the middle of their places (n, 3)."""
    sites = next(plans_of_sites(ROBOT, BALL, BLOCK, 0.0, request.param, 12))
    rows, arms, middles = [], [], []
    for place, site in enumerate(sites):
        for socket, (q, side) in enumerate(zip(site.q, (-0.5, 0.5), strict=True)):
            rows.append(planned_table(q, "seat", place=f"p{place}", socket=str(socket)))
            arms.append(np.tile(side * BLOCK.distance * site.direction, (len(q), 1)))
            middles.append(np.tile(site.place + BLOCK.centre_height * np.eye(3)[2], (len(q), 1)))
    return ObservationTable.joined(rows), np.concatenate(arms), np.concatenate(middles)


def read_by_arm(seats, seed):
    """Return the parameters of a true arm, the true distance [m], and the seats that the arm reads."""
    table, arms, middles = seats
    rng, chain = np.random.default_rng(seed), ROBOT.chain
    truth = chain.params_nominal + ROBOT.free * weak_prior(chain) * rng.normal(size=len(chain.parameters))
    distance = BLOCK.distance + SIGMA * rng.normal()  # of the only block
    socket = middles + arms * distance / BLOCK.distance + RIG_OF_BLOCK.seat_sigma * rng.normal(size=arms.shape)
    q = table.q
    for _ in range(6):
        p, _, jacobian = point_jacobians(chain, truth, q, np.array(BALL))
        q = q + (np.linalg.pinv(jacobian) @ (socket - p)[..., None])[..., 0]
    return truth, distance, table.replace(q=q)


def test_the_stated_error_holds_for_one_distance_at_all_places(seats):
    stated, true, off = [], [], []
    for seed in range(SEEDS):
        truth, distance, table = read_by_arm(seats, seed)
        options = truearm.IdentifyOptions(joint_laws="none")
        result = truearm.identify(ROBOT, table, RIG_OF_BLOCK, options=options)
        estimate = result.estimate
        values = dict(zip(estimate.parameter_names, estimate.value.tolist(), strict=True))
        index = estimate.parameter_names.index("socket_distance.0.1")
        off.append((estimate.value[index] - distance) / np.sqrt(estimate.covariance[index, index]))
        ball = np.array([values[f"sphere.ball.{axis}"] for axis in "xyz"])
        identified = point_forward(ROBOT.chain, estimate.value[: len(ROBOT.chain.parameters)], table.q, ball)
        actual = point_forward(ROBOT.chain, truth, table.q, np.array(BALL))
        _, distances = Rotation.align_vectors(actual - actual.mean(axis=0), identified - identified.mean(axis=0))
        true.append(distances / np.sqrt(len(actual)))
        stated.append(1e-3 * result.document["predicted_error"]["rms_mm"])
    ratio = np.array(true) / stated
    assert (ratio < 2.0).sum() >= SEEDS - 2
    assert rms(np.array(true)) == pytest.approx(rms(np.array(stated)), rel=0.3)
    assert 0.6 < rms(np.array(off)) < 1.4  # 99.8 % of 24 normal deviates


def test_the_distance_is_known_as_well_as_it_was_measured(seats):
    """Places do not average the error of one measurement; only the drawing of the arm adds to it."""
    table, *_ = seats
    estimate = truearm.identify(ROBOT, table, RIG_OF_BLOCK, options=truearm.IdentifyOptions(joint_laws="none")).estimate
    index = estimate.parameter_names.index("socket_distance.0.1")
    assert 0.5 * SIGMA < np.sqrt(estimate.covariance[index, index]) < SIGMA


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_a_distance_in_another_unit_is_named(seats, tmp_path, capsys, factor):
    table, *_ = seats
    (distance,) = RIG_OF_BLOCK.socket_distances
    wrong = replace(distance, distance=factor * distance.distance)
    write_rig(tmp_path / "rig.toml", replace(RIG_OF_BLOCK, socket_distances=(wrong,)))
    truearm.write_table(tmp_path / "seats.csv", table, ROBOT)
    arguments = ["--model", ROBOT.chain.name, "--rig", str(tmp_path / "rig.toml"), "--joint-laws", "none"]
    assert main(["identify", str(tmp_path / "seats.csv"), *arguments]) in (2, 3)
    (finding,) = other_lengths(table, replace(RIG_OF_BLOCK, socket_distances=(wrong,)), ROBOT.chain)
    lengths = {"declared": {"mm": pytest.approx(50 * factor)}, "nominal": {"mm": pytest.approx(50, abs=0.5)}}
    assert (finding.code, finding.values) == ("other-distance", {"sockets": ["0", "1"], **lengths})
    assert " ".join(finding.text().split()) in " ".join("".join(capsys.readouterr()).split())


def test_a_block_in_two_rigs_is_said_to_count_twice(seats, tmp_path, capsys):
    table, *_ = seats
    write_rig(tmp_path / "rig.toml", RIG_OF_BLOCK)
    days = np.where(np.arange(len(table)) % 2, "monday", "tuesday")
    truearm.write_table(tmp_path / "seats.csv", table.replace(rig=days), ROBOT)
    rigs = [f"--rig={day}={tmp_path / 'rig.toml'}" for day in ("monday", "tuesday")]
    assert main(["identify", str(tmp_path / "seats.csv"), "--model", ROBOT.chain.name, "--json", *rigs]) in (0, 3)
    result = json.loads(capsys.readouterr().out)
    assert listed(result)["repeated-distance"] == {"rigs": ["monday", "tuesday"], "sockets": ["0", "1"]}
    assert "repeated-distance" in [finding.code for finding in result_findings(result)]


@pytest.mark.parametrize("order", [1, -1])
def test_a_distance_that_is_declared_twice_is_refused(seats, order):
    (distance,) = RIG_OF_BLOCK.socket_distances
    again = replace(distance, sockets=distance.sockets[::order], distance=0.051)
    with refused("given-twice", place="rig", what="sockets 0.1"):
        truearm.identify(ROBOT, seats[0], replace(RIG_OF_BLOCK, socket_distances=(distance, again)))
