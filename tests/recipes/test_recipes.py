"""The recipes of docs/how-to/extending.md, all in one copy of the package: what each changes, and that it does what it says."""

import csv
import json
import math
import re
import tomllib
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.host import session_stream
from tests.host.plan_bench import RIGS
from tests.host.tcp_peer import Peer
from tests.recipes.recipes import ROOT, Copy, findings
from truearm.kinds.rig_file import write_rig
from truearm.model.chain import forward, joint_frames
from truearm.model.robot_file import builtin_robot
from truearm.session.joint_format import parse_line
from truearm.types import BallBar

HOST = "host/truearm/"
CHANGES = {
    "A kind of observation": {"kinds/inclinometer.py": "new file", "kinds/__init__.py": "+1 -0"},
    "A term of the joint law": {"model/joint_law.py": "+1 -0", "model/joint_terms/spring.py": "new file"},
    "A format to export": {"export/formats.py": "+1 -0", "export/screws.py": "new file"},
    "A joint source": {"record/robots/semicolons.py": "new file", "record/robots/sources.py": "+1 -0"},
    "A robot": {"model/robots/ur3lab.toml": "new file"},
    "A unit": {"units.py": "+2 -0"},
    "A fault to test for": {"kinds/plane.py": "+2 -2"},
}
SIGMA_RAD, SIGMA_M = 1e-4, 2e-5
JOINTS = ",".join(f"q{i}_rad" for i in range(1, 7))
TRACKER = """
[[tracker]]
name = "t"
sigma_mm = [0.02, 0.02, 0.02]
xyz_mm = [0, 0, 0]
position_sigma_mm = 0
turn_sigma_deg = 0
"""
TARGETS = {"a": (0.0, 0.0, 0.1), "b": (0.1, 0.0, 0.0), "c": (0.0, 0.1, 0.05)}  # m, in the end frame
TARGET = '\n[[target]]\nname = "{}"\nxyz_mm = [{}, {}, {}]\nsigma_mm = 0\n'
WITH_TARGETS = TRACKER + "".join(TARGET.format(name, *(1e3 * v for v in xyz)) for name, xyz in TARGETS.items())

# --- a kind: three inclinometers, one of them on the second link, beside a tracker, on a PUMA 560

ZERO = {"i1": 0.01, "i2": -0.005, "i3": 0.003}
AXES = {"i1": (1.0, 0.0, 0.0), "i2": (-1.0, 0.0, 0.0), "i3": (0.6, 0.8, 0.0)}
INCLINOMETERS = f"""
[[inclinometer]]
name = "i1"
sigma_rad = 1e-4
zero_sigma_deg = "unknown"

[[inclinometer]]
name = "i2"
sigma_rad = 1e-4
axis = [-1, 0, 0]
zero_sigma_deg = "unknown"

[[inclinometer]]
name = "i3"
sigma_rad = 1e-4
joint = "joint2"
axis = [0.6, 0.8, 0]
zero_sigma_deg = "unknown"
{TRACKER}"""
WRONG = {  # rows and rigs, and what is said of them
    "no reading": ("i1,", INCLINOMETERS, "malformed-file", ["row 2", "inclination_deg", "inclination_rad"]),
    "unknown": ("i7,3", INCLINOMETERS, "not-in-rig", ["row 2", "inclinometer", "i7", "i1", "i2"]),
    "too large": ("i1,91", INCLINOMETERS, "malformed-file", ["row 2", "inclination_deg", "91"]),
    "misspelt key": (
        *("i1,3", INCLINOMETERS.replace("axis", "axes"), "malformed-file"),
        ["[[inclinometer]] 2", "'axes'", "axis?"],
    ),
}


def write_inputs(folder):
    """Write poses.csv and rig.toml: points of a tracker and readings of the inclinometers on a PUMA 560."""
    robot, rng = builtin_robot("puma560"), np.random.default_rng(4)
    q = rng.uniform(-2.0, 2.0, (600, 6))
    pose = forward(robot.chain, robot.parameter_sets["optimised"], q)
    second = joint_frames(robot.chain, robot.parameter_sets["optimised"], q)[:, 1]
    name = np.array(list(AXES))[np.arange(len(q)) % 3]
    up = np.where(name[:, None] == "i3", second[:, 2, :3], pose[:, 2, :3])
    angle = np.arcsin(np.einsum("nk,nk->n", up, np.array([AXES[n] for n in name])))
    angle += np.array([ZERO[n] for n in name]) + SIGMA_RAD * rng.normal(size=len(q))
    point = pose[:, :3, 3] + SIGMA_M * rng.normal(size=(len(q), 3))
    lines = [f"kind,inclinometer,tracker,inclination_deg,x_m,y_m,z_m,sigma_deg,{JOINTS}"]
    for i, joints in enumerate(q.tolist()):
        if i < 300:
            cells = ["position", "", "t", "", *map(repr, point[i].tolist()), ""]
        elif abs(angle[i]) < 1.3:
            cells = ["inclinometer", name[i], "", repr(math.degrees(angle[i])), "", "", "", "0.006" if i % 3 else ""]
        else:
            continue
        lines.append(",".join([*cells, *map(repr, joints)]))
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    (folder / "rig.toml").write_text(INCLINOMETERS)
    return lines


def write_more_of_the_kind(folder, lines):
    """Write points with one reading of an inclinometer, wrong tables, and a session with an inclinometer in place of an LVDT."""
    inclined = next(line for line in lines[1:] if line[:9] != "position,")  # the user has one
    points = [line for line in lines if line[:9] == "position,"]
    (folder / "points.csv").write_text("\n".join([lines[0], *points, inclined]) + "\n")
    for i, (row, rig, *_) in enumerate(WRONG.values()):
        (folder / f"wrong{i}.csv").write_text(
            f"kind,inclinometer,inclination_deg,{JOINTS}\ninclinometer,{row},{','.join('0' * 6)}\n"
        )
        (folder / f"wrong{i}.toml").write_text(rig)
    document = session_stream.ident_document()
    (stream,) = document["streams"]
    for channel, name in zip(stream["channels"], ("inclinometer", "inclinometer_b"), strict=False):
        channel |= {"name": name, "calibration": {"unit": "rad", "poly": session_stream.POLY}}
    with patch.object(session_stream, "ident_document", lambda *_: document):
        messages, truth = session_stream.session(np.random.default_rng(6), dwells=4, plan=False)
    session_stream.write_session(folder / "s.mcap", messages)
    (folder / "seventh.toml").write_text(INCLINOMETERS.replace("joint2", "joint7"))
    device = "[[inclinometer]]\nname = '{}'\nsigma_rad = 1e-4\naxis = [{}]\njoint = 'joint2'\n"
    (folder / "device.toml").write_text(device.format("i1", "1, 0, 0") + device.format("i2", "0, 1, 0"))
    return truth


# --- a term: a torsional spring in joint 2. The true arm follows from the robot file's numbers, with nothing of truearm's.

SPRING = math.radians(0.12)
PUMA = (ROOT / "host/truearm/model/robots/puma560.toml").read_text(encoding="utf-8")
SPRUNG = PUMA.replace("[joint2]\n", "[joint2]\nspring_deg = { design = 0.0, optimised = 0.0 }\n")
N_TRACKED = 400


def numbers(values):
    """Links (7, 6) as x, y, z [m], α, β, γ [rad], offsets (6,) [rad] and gains (6,) of the file's ``values``."""
    data = tomllib.loads(PUMA)
    links = [data[f"link{i}"] for i in range(1, 8)]
    lengths = np.array([[link[f"{key}_cm"][values] / 100.0 for key in "xyz"] for link in links])
    turns = np.radians([[link[f"{key}_deg"][values] for key in ("alpha", "beta", "gamma")] for link in links])
    joints = [data[f"joint{i}"] for i in range(1, 7)]
    offsets = np.radians([joint["offset_deg"][values] for joint in joints])
    return np.hstack([lengths, turns]), offsets, np.array([joint["gain"][values] for joint in joints])


def turned(axis, angle):
    """(n, 4, 4) turns by angles (n,) about x, y or z; complex ones too."""
    out = np.zeros((len(angle), 4, 4), angle.dtype)
    out[:, range(4), range(4)] = 1.0
    i, k = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    out[:, i, i] = out[:, k, k] = np.cos(angle)
    out[:, k, i] = np.sin(angle)
    out[:, i, k] = -np.sin(angle)
    return out


def end(links, angles):
    """(n, 4, 4) the end at true joint angles (n, 6)."""
    pose = np.broadcast_to(np.eye(4), (len(angles), 4, 4))
    for i, (x, y, z, alpha, beta, gamma) in enumerate(links):
        link = np.eye(4)
        link[:3, 3] = x, y, z
        for axis, angle in (("z", alpha), ("y", beta), ("x", gamma)):
            link = link @ turned(axis, np.array([angle]))[0]
        pose = pose @ link
        if i < 6:
            pose = pose @ turned("z", angles[:, i])
    return pose


def true_end(q):
    """The arm with a spring in joint 2: the optimised values, and the torque of a weight by the design's height of the end."""
    links, offsets, gains = numbers("design")
    raised = (offsets + gains * q).astype(complex)
    raised[:, 1] += 1e-30j
    torque = -end(links, raised)[:, 2, 3].imag / 1e-30
    links, offsets, gains = numbers("optimised")
    angles = offsets + gains * q
    angles[:, 1] += SPRING * torque
    return end(links, angles)


def some_targets():
    """20 poses in one configuration of the arm, away from singularities and limits."""
    low, high = np.radians([(-120, 120), (-120, -20), (120, 170), (-60, 120), (30, 80), (-150, 150)]).T
    links, offsets, gains = numbers("design")
    q = np.random.default_rng(7).uniform(low, high, (20, 6))
    return q, end(links, offsets + gains * q)


def tracked(q, ends, noise):
    """Return the text of a table: poses of each target in turn. ends (n, 4, 4); noise (n, 3) in the tracker's sigmas."""
    lines = [f"kind,tracker,target,x_m,y_m,z_m,{JOINTS}"]
    for i, (joints, pose) in enumerate(zip(q, ends, strict=True)):
        name = list(TARGETS)[i % len(TARGETS)]
        point = pose[:3, :3] @ TARGETS[name] + pose[:3, 3] + SIGMA_M * noise[i]
        lines.append(",".join(["position", "t", name, *(repr(float(v)) for v in (*point, *joints))]))
    return "\n".join([*lines, ""])


def write_sprung(folder):
    rng = np.random.default_rng(3)
    q = rng.uniform(-2.0, 2.0, (N_TRACKED, 6))
    ends = true_end(q)
    (folder / "exact.csv").write_text(tracked(q, ends, np.zeros((N_TRACKED, 3))))
    (folder / "noisy.csv").write_text(tracked(q, ends, rng.normal(size=(N_TRACKED, 3))))
    (folder / "targets.toml").write_text(WITH_TARGETS)
    (folder / "sprung.toml").write_text(SPRUNG)
    q, ends = some_targets()
    rows = np.hstack([ends[:, :3, 3], Rotation.from_matrix(ends[:, :3, :3]).as_rotvec(), q]).tolist()
    header = f"x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,{JOINTS}"
    (folder / "targets.csv").write_text("\n".join([header, *(",".join(map(repr, row)) for row in rows)]))


# --- a format: the joints' axes of a UR5e

Q = np.random.default_rng(6).uniform(-2.0, 2.0, (300, 6))


def disturbed():
    """Return a robot that differs from its description."""
    robot, rng = builtin_robot("ur5e"), np.random.default_rng(5)
    return robot.chain, robot.chain.params_nominal + robot.free * rng.normal(size=len(robot.free)) * 1e-3


def exponentials(document, q):
    """Return T(q) of the file, computed independently."""
    out = np.eye(4)
    for joint, angle in zip(document["joints"], q, strict=True):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(angle * np.array(joint["axis"])).as_matrix()
        turn[:3, 3] = joint["point"] - turn[:3, :3] @ joint["point"]
        out = out @ turn
    return out @ np.array(document["home"])


# --- a fault: a flat that sinks

SUNK = 0.3e-3  # m, from the first row to the last
FLAT = f"""
[[plane]]
name = "p"
xyz_mm = [0, 0, 0]
normal = [0, 0, 1]
sigma_mm = 0.02
offset_sigma_mm = 0
tilt_sigma_deg = 0
{TRACKER}"""


def write_sinking(folder):
    robot, rng, n = builtin_robot("puma560"), np.random.default_rng(0), 300
    q = rng.uniform(-2.0, 2.0, (n, 6))
    point = forward(robot.chain, robot.parameter_sets["optimised"], q)[:, :3, 3] + SIGMA_M * rng.normal(size=(n, 3))
    sunk = np.linspace(0.0, SUNK, n)
    lines = [f"kind,plane,tracker,length_m,x_m,y_m,z_m,{JOINTS}"]
    for i, joints in enumerate(q.tolist()):
        of_plane = ["plane", "p", "", repr(float(point[i, 2] + sunk[i])), "", "", ""]
        cells = of_plane if i % 3 == 0 else ["position", "", "t", "", *map(repr, point[i].tolist())]
        lines.append(",".join([*cells, *map(repr, joints)]))
    (folder / "sinking.csv").write_text("\n".join(lines) + "\n")
    (folder / "flat.toml").write_text(FLAT)


# --- the copy, and the commands that run in it

PUMA_ARM, SPRUNG_ARM = ("--model", "puma560", "--rig", "rig.toml"), ("--model", "sprung.toml", "--rig", "targets.toml")
KIND = ("--hold-out", "inclinometer=i2", "--details", "--out", "kind.json", "--report", "page.html")
COMMANDS = {
    "session": ("session", "export", "s.mcap", "--rig", "device.toml", "--out", "exported"),
    "kind": ("identify", "poses.csv", *PUMA_ARM, *KIND),
    "proposed": ("identify", "points.csv", *PUMA_ARM, "--also-free", "joint6.offset"),
    "noisy": ("identify", "noisy.csv", *SPRUNG_ARM, "--details", "--out", "noisy.json"),
    "exact": ("identify", "exact.csv", *SPRUNG_ARM, "--out", "exact.json"),
    "correct": (
        *("correct", "exact.json", "targets.csv", "--model", "sprung.toml", "--out", "corrected.csv"),
        *("--margin", "0.01"),
    ),
    "ur5e": ("identify", "ur5e.csv", "--model", "ur5e", "--rig", "targets.toml", "--out", "ur5e.json"),
    "export": (*("export", "ur5e.json", "--format", "screws", "--out", "screws.json", "--over", "ur5e.csv", "--json"),),
    "help of identify": ("identify", "--help"),
    "help of record": ("record", "--help"),
    "help of plan": ("plan", "ballbar", "--help"),
    "plan": (
        *("plan", "ballbar", "--model", "ur3lab", "--rig", "small.toml", "--poses", "36", "--candidates", "60"),
        *("--out", "plan.csv", "--program-out", "plan.script"),
    ),
    "sinking": (*("identify", "sinking.csv", "--model", "puma560", "--rig", "flat.toml", "--out", "sinking.json"),),
}
REFUSED = {
    "another joint": ("identify", "poses.csv", "--model", "puma560", "--rig", "seventh.toml"),
    "another robot": ("identify", "none.csv", "--model", "ur3la", "--rig", "rig.toml"),
    **{
        name: ("identify", f"wrong{i}.csv", "--model", "puma560", "--rig", f"wrong{i}.toml", "--json")
        for i, name in enumerate(WRONG)
    },
}


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The package with all recipes, and inputs."""
    copy = Copy(tmp_path_factory.mktemp("recipes"))
    for recipe, files in CHANGES.items():
        before = copy.changes()
        copy.apply(recipe)
        assert copy.changes() == before | {HOST + path: change for path, change in files.items()}
    copy.session_truth = write_more_of_the_kind(copy.folder, write_inputs(copy.folder))
    write_sprung(copy.folder)
    (copy.folder / "ur5e.csv").write_text(tracked(Q, forward(*disturbed(), Q), np.zeros((len(Q), 3))))
    small = replace(RIGS["irb120"], bars={"bar25": BallBar("bar25", 0.25, 1.0, 0.075, 84e-6)})
    write_rig(copy.folder / "small.toml", small)
    write_sinking(copy.folder)
    return copy


@pytest.fixture(scope="module")
def said(copy):
    """Return what each command prints."""
    said = dict(zip([*COMMANDS, *REFUSED], copy.run_each(*COMMANDS.values(), *REFUSED.values()), strict=True))
    assert {name: each.err for name, each in said.items() if each.code != (2 if name in REFUSED else 0)} == {}
    return said


def document(copy, name):
    return json.loads((copy.folder / name).read_text())


def rows(copy, name):
    with (copy.folder / name).open() as file:
        return list(csv.DictReader(file))


def test_a_session_has_a_row_of_the_kind_for_each_dwell_and_axis(copy, said):
    """The box reads both axes of an inclinometer in place of an LVDT; the channels are calibrated in rad, and no bar is mounted."""
    exported = rows(copy, "exported/observations.csv")
    assert [(row["kind"], row["inclinometer"]) for row in exported] == [("inclinometer", "i1")] * 4 + [
        ("inclinometer", "i2")
    ] * 4
    angles = [float(row["inclination_rad"]) for row in exported]
    assert angles[:4] == pytest.approx(copy.session_truth.length - 0.46, abs=1e-6)
    assert angles[4:] == pytest.approx(session_stream.metres_of(np.zeros(4)), abs=1e-9)


def test_the_kind_is_identified_judged_and_reported(copy, said):
    assert "error [mm]" in said["kind"].out
    assert "inclinometer" in said["kind"].out.partition("error [deg]")[2]
    result = document(copy, "kind.json")
    inclined, points = sorted(result["observations"], key=lambda entry: entry["kind"])
    assert (inclined["kind"], points["kind"]) == ("inclinometer", "position")
    # Some 90 readings: the RMS is known to 1/sqrt(180) = 7.5 %; 4 of these
    assert inclined["rms_after_deg"] == pytest.approx(math.degrees(SIGMA_RAD), rel=0.3)
    assert inclined["rms_held_out_deg"] == pytest.approx(math.degrees(SIGMA_RAD), rel=0.3)
    assert (inclined["rms_after_mm"], points["rms_after_deg"]) == (None, None)
    assert result["rms_after_deg"] == inclined["rms_after_deg"]
    assert result["held_out"]["rms_deg"] == inclined["rms_held_out_deg"]
    assert result["held_out"]["rms_mm"] is None
    for name in ("i1", "i3"):
        (zero,) = (p for p in result["parameters"] if p["name"] == f"inclinometer.{name}.zero")
        assert zero["unit"] == "rad"
        assert abs(zero["value"] - ZERO[name]) < 5 * zero["sigma"] < 1e-3
    page = (copy.folder / "page.html").read_text()
    assert "measured minus predicted inclination." in page
    assert "<dt>inclinometers</dt><dd>i1, i2, i3</dd>" in page


DERIVATIVES = """
import numpy as np
import truearm
from truearm.estimate.problem import build_problem

robot = truearm.load_robot("puma560")
table = truearm.read_table("poses.csv", robot)
problem = build_problem(robot.chain, truearm.read_rig("rig.toml"), table.select(table.kind == "inclinometer"))
(group,) = problem.groups
lin = group.evaluate(problem.chain, problem.start)
steps = 1e-6 * np.eye(problem.start.size)
by_x = [group.evaluate(problem.chain, problem.start + s).residual - group.evaluate(problem.chain, problem.start - s).residual for s in steps]
print(np.abs(lin.jac_params + np.array(by_x).T / 2e-6).max())
"""


def test_derivatives_of_the_kind_are_differences(copy):
    assert float(copy.python("-c", DERIVATIVES).out) < 1e-7


def test_the_kind_is_proposed_where_it_would_show_more(said):
    """A target on the axis of joint 6 does not show how far that joint turns; an inclinometer's axis turns with it."""
    assert "end to identify 1 more parameter: joint6.offset." in " ".join(said["proposed"].out.split())


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_input_of_the_kind_is_one_line(said, wrong):
    *_, code, words = WRONG[wrong]
    (values,) = (values for name, values in findings(said[wrong].out).items() if name == code)
    assert [word for word in words if word not in str(values)] == []
    assert said[wrong].err.count("\n") == 1


def test_a_joint_that_the_robot_lacks_is_one_line(said):
    assert "joint7" in said["another joint"].err
    assert said["another joint"].err.count("\n") == 1


def test_the_term_is_identified_with_its_standard_deviation(copy, said):
    (line,) = (line for line in said["noisy"].out.splitlines() if "joint2.spring" in line)
    assert re.search(r"0\.1[12]\d*", line), line
    result = document(copy, "noisy.json")
    (spring,) = (p for p in result["parameters"] if p["name"] == "joint2.spring")
    assert spring["unit"] == "rad"
    assert abs(spring["value"] - SPRING) < 5 * spring["sigma"] < 0.05 * SPRING
    assert result["chi2_reduced"] == pytest.approx(1.0, abs=5 * math.sqrt(2 / (3 * N_TRACKED - 60)))


def test_targets_corrected_for_the_term_are_where_the_true_arm_goes(copy, said):
    q, wanted = some_targets()
    told = np.radians([[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows(copy, "corrected.csv")])
    before, after = (np.abs(true_end(joints) - wanted).max() for joints in (q, told))
    assert before > 5e-3
    assert after < 1e-9


def test_the_format_holds_a_robot_without_gains(copy, said):
    assert findings(said["export"].out)["exported"] == {"exact": True}
    screws = document(copy, "screws.json")
    for q, pose in zip(Q, forward(*disturbed(), Q), strict=True):
        assert np.linalg.norm(exponentials(screws, q)[:3, 3] - pose[:3, 3]) < 1e-9


SENT = b"0;89.0\n1500;90.0;-45.5\nhello\n\xff\n1502;nan;0\n1502\n;;\n1504;90.0;-45.0\n1506;9"
OPEN = """
import sys
from truearm.errors import LinkClosed
from truearm.record.links import HostClock
from truearm.record.robots.sources import open_source

link, got = open_source(sys.argv[1], HostClock()), b""
try:
    while True:
        got += b"".join(data for _, data in link.read(0.1))
except LinkClosed:
    link.close()
print(got.hex())
"""


def test_readings_of_the_source_come_out(copy):
    got = bytes.fromhex(copy.python("-c", OPEN, f"semicolons://{Peer(SENT).address}").out)
    first, reading, *others, last, rest = got.split(b"\n")
    assert (first, rest) == (
        b"0;89.0",
        b"1506;9",
    )  # the first of a connection may have lost its head, the last its tail
    assert others == [b"hello", b"\xff", b"1502;nan;0", b"1502", b";;"]
    readings = [parse_line(line) for line in (reading, last)]
    assert [each.t for each in readings] == pytest.approx([1.5, 1.504], rel=1e-15)
    assert readings[0].q == pytest.approx([math.pi / 2, math.radians(-45.5)], rel=1e-15)
    assert json.loads(reading)["line"] == "1500;90.0;-45.5"
    assert not any(map(parse_line, others))


def test_help_and_errors_name_the_source(copy, said):
    address = "semicolons://192.168.0.2:5000 (milliseconds and degrees between semicolons)"
    assert address in " ".join(said["help of record"].out.split())
    for url, why in {
        "colons://127.0.0.1:1": "tcp://, rtde://, lines+tcp://, lines+udp://, semicolons://",
        "semicolons://127.0.0.1:1/x": "needs tcp://host:port",
    }.items():
        assert why in copy.python("-c", OPEN, url, code=1).err


def test_help_and_errors_name_the_robot(copy, said):
    for text in (said["help of identify"].out, said["help of plan"].out, said["another robot"].err):
        assert "ur3lab" in text
    (branch,) = (part for part in " ".join(said["help of plan"].out.split()).split(" --") if part.startswith("branch"))
    assert "ur3lab" in branch
    assert "ur3lab" in copy.python("-c", "import truearm; print(truearm.builtin_robots())").out


def test_the_robot_is_planned_for(copy, said):
    stops = rows(copy, "plan.csv")
    assert sum(stop["move"] == "dwell" for stop in stops) == 36
    low, high = (-150, -170, -150, -200, -165, -180), (150, -10, -15, 60, -15, 180)
    for stop in stops:
        q = [math.degrees(float(stop[f"q{i}_rad"])) for i in range(1, 7)]
        assert all(a - 1e-6 <= joint <= b + 1e-6 for a, joint, b in zip(low, q, high, strict=True))
    assert "movej" in (copy.folder / "plan.script").read_text()


def test_the_fault_is_named(copy, said):
    (fault,) = document(copy, "sinking.json")["faults"]
    (size,) = fault["sizes"]
    assert fault["rivals"][0]["name"] == fault["rivals"][0]["apply"] == "plane.p.offset.drift"
    assert abs(size["value"] - SUNK) < 4.0 * size["sigma"]


UNIT = """
import json, re
from truearm.kinds import columns
columns.CIRCUMSTANCES += (columns.Quantity("force", ("force",), "N"),)
from truearm.errors import TableError
from truearm.kinds.table_file import format_table, parse_table
from truearm.schema import Key, Number, SchemaError
from truearm.units import number, title

def refused(call):
    try:
        call()
    except TableError as exc:
        return exc.finding.code, exc.finding.values["place"]
    except SchemaError as exc:
        return re.findall("[-0-9]+ N", str(exc))

def table(column, value):
    return parse_table(f"kind,q1_rad,place,socket,{column}\\nseat,0,a,0,{value}\\n", "t.csv")

key = Key("force", Number("N"))
print(json.dumps({
    "read": table("force_n", 12.5)["force"].tolist(),
    "written": format_table(table("force_n", 12.5), ("rad",)).splitlines()[0],
    "no unit": refused(lambda: table("force", 1)),
    "other unit": refused(lambda: table("force_kg", 1)),
    "too large": refused(lambda: table("force_n", 1e6)),
    "key": [key.parse(12.5, "force_n"), list(key.spellings)],
    "key too large": refused(lambda: key.parse(1e6, "force_n")),
    "shown": f"{title('force', 'N')} {number(12.5, 'N')}",
}))
"""


def test_the_unit_is_in_tables_keys_and_titles(copy):
    assert json.loads(copy.python("-c", UNIT).out) == {
        "read": [12.5],
        "written": "kind,q1_rad,force_n,place,socket",
        "no unit": ["wrong-value", "t.csv column 5 ('force')"],
        "other unit": ["wrong-value", "t.csv column 5 ('force_kg')"],
        "too large": ["malformed-file", "t.csv row 2 column force_n"],
        "key": [12.5, ["force_n"]],
        "key too large": ["06 N", "100000 N"],
        "shown": "force [N] 12.50",
    }
