"""Corrected programs in the frames of ROS and of controllers, by an arm computed here alone, and with tools given by name."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.host import correct_bench
from tests.host.controllers import pose_from
from tests.host.puma_bench import CHAIN, DESIGN, TRUTH
from tests.host.test_program_corrections import DATA, OBJECTS, POSES, TOOLS, Q, matrix, mm, module, robtarget, six

from truearm.cli import main as cli
from truearm.correct.correction import MARGIN, ModelPair
from truearm.correct.methods import JointMoves
from truearm.correct.programs.languages import base_of, flange_of, language_of
from truearm.model.chain import forward
from truearm.model.inverse import inverse
from truearm.model.robot_file import RobotChoice, builtin_robot, load_robot
from truearm.workflows import correct_program as workflow
from truearm.workflows.correct import tool0_in_flange
from truearm.workflows.correct_program import CalibrationFrames, HowCorrected
from truearm.workflows.requests import ProgramOptions

# base_link and base


def correct_program(path, how, names, options):
    return workflow.correct_program({path.name: path.read_bytes()}, language_of([path.name]), how, names, options)


def text_of(done):
    (data,) = done.contents.values()
    return data.decode("latin-1")


def numbers(script):
    """Return the numbers of p[…]."""
    return [float(number) for pose in re.findall(r"p\[(.*)\]", script) for number in pose.split(",")]


def test_a_calibration_in_base_link_corrects_a_script_as_one_in_base_does(tmp_path):
    """The same arm in either frame, half a turn about z apart: p[…] is always in the controller's base."""
    chain = builtin_robot("ur5e").chain
    at = [chain.parameter_names.index(name) for name in ("base.alpha", "joint2.a", "joint3.offset", "joint5.offset")]
    nominal = chain.params_nominal
    truth = nominal.copy()
    truth[at[1:]] += 0.001, 0.003, -0.002
    half_a_turn = np.zeros_like(nominal)
    half_a_turn[at[0]] = np.pi
    q = np.array([[0.3, -1.4, 1.5, -1.6, -1.5, 0.4], [0.5, -1.2, 1.4, -1.5, -1.4, 0.1]])
    given = tmp_path / "p.script"
    given.write_text("\n".join(["def p():", *(f" movej({six(pose)})" for pose in forward(chain, nominal, q)), "end"]))
    texts, notes = [], []
    for turned, names in (
        (0.0, CalibrationFrames("base", "flange", brought=True, own_frames=False)),
        (half_a_turn, CalibrationFrames("base_link", "tool0", brought=False, own_frames=False)),
        (half_a_turn, CalibrationFrames("base_link", "tool0", brought=False, own_frames=True)),
        (0.0, CalibrationFrames("base_link_inertia", "tool0", brought=False, own_frames=False)),
    ):
        how = HowCorrected(ModelPair(chain, nominal + turned, truth + turned), "newton", 1, q[0], MARGIN)
        done = correct_program(given, how, names, ProgramOptions(tools={"": (0.0,) * 6}))
        texts.append(numbers(text_of(done)))
        notes.append(done.notes[0].values["base"])
    np.testing.assert_allclose(texts[1:], [texts[0]] * 3, atol=2e-9)
    assert "from base_link" in notes[1]
    shift = np.linalg.norm(np.subtract(texts[0], numbers(given.read_text()))[:3])
    assert shift > 1e-3


# an IRB 120 of its own


ORIGINS = np.array([[0, 0, 0], [0, 0, 0.290], [0, 0, 0.270], [0, 0, 0.070], [0.302, 0, 0], [0.072, 0, 0]])  # m
AXES = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]])
LIMITS = np.deg2rad([[-165, 165], [-110, 110], [-110, 70], [-160, 160], [-120, 120], [-400, 400]])
TOOL0 = Rotation.from_euler("y", np.pi / 2)  # of link_6
LENGTHS = {"joint2.a": (2, 2, 0.8e-3), "joint3.a": (3, 2, -0.5e-3), "joint4.d": (4, 0, 0.7e-3)}  # link, axis, error
OFFSETS = np.array([0.0, 0.002, -0.003, 0.004, -0.0025, 0.0])  # rad


def irb120(q, origins=ORIGINS, offsets=0.0):
    """Return the pose (4, 4) of tool0 in base_link."""
    turn, place = Rotation.identity(), np.zeros(3)
    for origin, axis, angle in zip(origins, AXES, q + offsets, strict=True):
        place = place + turn.apply(origin)
        turn = turn * Rotation.from_rotvec(angle * axis)
    return pose_from(place, turn * TOOL0)


def true_irb120(q):
    origins = ORIGINS.copy()
    for link, axis, error in LENGTHS.values():
        origins[link, axis] += error
    return irb120(q, origins, OFFSETS)


def solved(pose, q):
    """Return the joints near q of the arm as designed, by Newton's method with differences."""
    for _ in range(20):
        here = irb120(q)
        error = off(here, pose)
        if np.abs(error).max() < 1e-11:
            return q
        columns = [off(here, irb120(q + 1e-6 * unit)) / 1e-6 for unit in np.eye(6)]
        q = q + np.linalg.solve(np.array(columns).T, error)
    raise AssertionError("the arm as designed does not reach a corrected target")


def off(pose, goal):
    turn = Rotation.from_matrix(goal[:3, :3] @ pose[:3, :3].T).as_rotvec()
    return np.array([*(goal - pose)[:3, 3], *turn])


def target_at(pose, q):
    """Return a robtarget with a pose and the configuration of joints q."""
    cf1, cf4, cf6 = np.floor(q[[0, 3, 5]] / (0.5 * np.pi)).astype(int)
    return f"[{mm(pose)},[{cf1},{cf4},{cf6},0],[9E9,9E9,9E9,9E9,9E9,9E9]]"


def robtargets(text):
    """Return the poses (n, 4, 4) of a module's robtargets."""
    found = []
    for place, turn in re.findall(r"\[\[([-\d.,]+)\],\[([-\d.,]+)\],\[[-\d,]+\],\[9E9", text):
        turn = Rotation.from_quat(np.roll(np.fromstring(turn, sep=","), -1))
        found.append(pose_from(np.fromstring(place, sep=",") * 1e-3, turn))
    return np.array(found)


def test_an_irb_120_computed_here_goes_where_it_should(tmp_path):
    """A module of moves from place to place, corrected for the true arm."""
    chain = builtin_robot("irb120").chain
    truth = chain.params_nominal.copy()
    for name, (_, _, error) in LENGTHS.items():
        truth[chain.parameter_names.index(name)] += error
    for k, error in enumerate(OFFSETS, start=1):
        truth[chain.parameter_names.index(f"joint{k}.offset")] += error
    rng = np.random.default_rng(5)
    q = np.array([0.2, 0.2, 0.1, 0.3, 0.9, -0.4]) + np.cumsum(rng.uniform(-0.15, 0.15, (8, 6)), axis=0)
    q[0] += 0.4  # a long way between the first two
    assert ((LIMITS[:, 0] < q) & (q < LIMITS[:, 1])).all()
    np.testing.assert_allclose(irb120(np.zeros(6))[:3, 3], [0.374, 0.0, 0.630], atol=1e-12)
    targets = np.array([irb120(one) for one in q])
    data = [f"CONST robtarget p{k}:={target_at(*pair)};" for k, pair in enumerate(zip(targets, q, strict=True))]
    moves = [f"Move{'L' if k else 'J'} p{k},v100,fine,tool0;" for k in range(len(q))]
    path = tmp_path / "p.mod"
    path.write_text("\n".join(["MODULE m", *data, "PROC main()", *moves, "ENDPROC", "ENDMODULE"]))
    how = HowCorrected(ModelPair(chain, chain.params_nominal, truth), "newton", 1, None, MARGIN)
    names = CalibrationFrames("base_link", "tool0", brought=False, own_frames=False)
    told = robtargets(text_of(correct_program(path, how, names, ProgramOptions())))
    before = [np.abs(off(true_irb120(one), goal)).max() for one, goal in zip(q, targets, strict=True)]
    reached = np.array([true_irb120(solved(pose, near)) for pose, near in zip(told, q, strict=True)])
    after = [np.abs(off(pose, goal)).max() for pose, goal in zip(reached, targets, strict=True)]
    assert min(before) > 1e-3
    assert max(after) < 1e-6


# KUKA and Fanuc

TOOL_1 = (0.0, 0.005, 0.02, 0.0, 0.0, 0.0)


def angles(pose):
    """Return X, Y, Z [mm] and A, B, C [deg] about z, the new y and the new x; W, P, R are C, B, A."""
    return [*(1e3 * pose[:3, 3]), *Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX", degrees=True)]


def krl_program(poses):
    data = [f"DECL E6POS XP{k}={{X {x:.6f},Y {y:.6f},Z {z:.6f},A {a:.8f},B {b:.8f},C {c:.8f},E1 0.0}}" for k, (x, y, z, a, b, c) in enumerate(map(angles, poses))]  # fmt: skip
    moves = [f"LIN XP{k} C_DIS ;{k}" for k in range(len(poses))]
    home = ",".join(f"A{k} {value:.8f}" for k, value in enumerate(np.rad2deg(Q[1]), start=1))
    code = ["DEF p()", "BAS(#TOOL,1)", "$BASE=$NULLFRAME", f"PTP {{{home}}}", *moves, "END", ""]
    frames = "TOOL_DATA[1]={X 0,Y 5,Z 20,A 0,B 0,C 0}\r\n"
    return {"p.src": "\r\n".join(code), "p.dat": "\r\n".join(["DEFDAT p", *data, "ENDDAT", ""]), "$config.dat": frames}


def ls_program(poses):
    data = [f"P[{k}]{{\n   GP1:\n\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',\n\tX = {x:.6f}  mm,\tY = {y:.6f}  mm,\tZ = {z:.6f}  mm,\n\tW = {c:.8f} deg,\tP = {b:.8f} deg,\tR = {a:.8f} deg\n}};" for k, (x, y, z, a, b, c) in enumerate(map(angles, poses))]  # fmt: skip
    home = ",\t".join(f"J{k}= {value:.8f} deg" for k, value in enumerate(np.rad2deg(Q[1]), start=1))
    data.append(f"P[90]{{\n   GP1:\n\tUF : 0, UT : 1,\n\t{home}\n}};")
    lines = ["J P[90] 100% FINE", *(f"L P[{k}] 100mm/sec FINE" for k in range(len(poses)))]
    code = [f"   {k}:{line} ;" for k, line in enumerate(lines, start=1)]
    return {"p.ls": "\n".join(["/PROG P", "/MN", *code, "/POS", *data, "/END", ""])}


@pytest.mark.parametrize("language", ["krl", "ls"])
def test_programs_of_kuka_and_fanuc_arms_go_where_they_should(language):
    """The poses that are written bring the true arm's tool to the targets."""
    tool = matrix(TOOL_1)
    asked = POSES[1:5] @ tool
    files = {"krl": krl_program, "ls": ls_program}[language](asked)
    how = HowCorrected(ModelPair(CHAIN, DESIGN, TRUTH), "newton", 1, None, MARGIN)
    names = CalibrationFrames("base", "tool0", brought=True, own_frames=False)
    options = ProgramOptions(joint_moves=JointMoves.KEEP, tools={} if language == "krl" else {"ut1": TOOL_1})
    contents = {name: text.encode() for name, text in files.items()}
    done = workflow.correct_program(contents, language, how, names, options)
    text = done.contents["p.dat" if language == "krl" else "p.ls"].decode()
    order = "XYZABC" if language == "krl" else "XYZRPW"
    pattern = r"\b%s (-?[\d.]+)" if language == "krl" else r"\b%s = (-?[\d.]+)"
    columns = [re.findall(pattern % name, text) for name in order]
    told = np.array(columns, dtype=float).T
    turns = Rotation.from_euler("ZYX", told[:, 3:], degrees=True)
    pose = np.array([pose_from(place, turn) for place, turn in zip(1e-3 * told[:, :3], turns, strict=True)])
    q = inverse(CHAIN, DESIGN, pose @ np.linalg.inv(tool), Q[1:5])
    assert np.abs(forward(CHAIN, TRUTH, q) @ tool - asked).max() < 1e-6
    assert np.abs(forward(CHAIN, TRUTH, Q[1:5]) @ tool - asked).max() > 1e-3
    kept = [name for name in contents if name not in ("p.dat", "p.ls")]
    assert all(done.contents[name] == contents[name] for name in kept)


# tools and work objects by name


def test_tools_and_work_objects_by_name_at_the_command_line(tmp_path, capsys):
    """Two of each, beside those of the module: the same numbers as where the module declares all of them."""
    lines = [f"MoveJ {robtarget(1 + 3 * t + w, t, w)},v100,fine,t{t}\\WObj:=w{w};" for t in range(3) for w in range(3)]
    whole = module([], lines)
    part = "\n".join(line for line in whole.split("\r\n") if not re.match(r" *PERS \w+ [tw][12]:=", line))
    assert len(DATA) - 4 == part.count("PERS")

    def six_text(pose):
        numbers = [*(1e3 * pose[:3, 3]), *np.rad2deg(Rotation.from_matrix(pose[:3, :3]).as_rotvec())]
        return ",".join(f"{number:.12g}" for number in numbers)

    named = []
    for k in (1, 2):
        frame = matrix(OBJECTS[k][0]) @ matrix(OBJECTS[k][1])
        named += ["--tool", f"T{k}={six_text(matrix(TOOLS[k]))}", "--work", f"w{k}={six_text(frame)}"]
    correct_bench.write(tmp_path / "result.json", correct_bench.identified())
    home = ",".join(map(repr, np.rad2deg(Q[0]).tolist()))
    same = "0,0,0,0,0,0"
    found = []
    for name, text, options in (("whole", whole, []), ("part", part, named)):
        (tmp_path / f"{name}.mod").write_text(text)
        out = tmp_path / f"{name}-out.mod"
        given = ["correct", str(tmp_path / "result.json"), str(tmp_path / f"{name}.mod"), "--out", str(out)]
        code = cli.main([*given, "--work", same, "--flange", same, "--home", home, *options])
        assert code == 0, capsys.readouterr().err
        found.append(robtargets(out.read_text()))
    assert found[0].shape == (9, 4, 4)
    np.testing.assert_allclose(found[1], found[0], atol=2e-8)
    assert np.abs(found[0][0] - POSES[1]).max() > 1e-3
    assert cli.main([*given, "--work", same, "--flange", same, *named[:-2], "--out", str(tmp_path / "o.mod")]) == 2
    assert re.search(r"w2.*--work NAME=", capsys.readouterr().err, re.DOTALL)


# a controller's base and flange, by the frame names of ROS's descriptions and of truearm's robots

X, Y, Z = np.eye(3)


def test_universal_robots_base_is_half_a_turn_from_base_link():
    """A point in front of base_link is behind the controller's base, at the same height."""
    base = base_of("urscript", "base_link")
    np.testing.assert_allclose(base.pose[:3, :3] @ X, -X, atol=1e-15)
    np.testing.assert_allclose(base.pose[:3, :3] @ Z, Z, atol=1e-15)
    np.testing.assert_array_equal(base.pose[:3, 3], 0.0)
    assert "base_link" in base.words


@pytest.mark.parametrize(("language", "x"), [("urscript", Y), ("rapid", -Z)])
def test_ros_flange_points_with_x_where_tool0_points_with_z(language, x):
    """REP 199; the two differ by a rotation alone. UR's description turns by rpy (90°, 0, 90°): tool0's x is the flange's y."""
    flange = flange_of(language, "flange", brought=False)
    np.testing.assert_allclose(flange.pose[:3, :3] @ np.array([X, Z]).T, np.array([x, X]).T, atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(flange.pose[:3, :3]), 1.0)
    np.testing.assert_array_equal(flange.pose[:3, 3], 0.0)


@pytest.mark.parametrize("language", ["urscript", "rapid"])
def test_frames_that_are_the_controllers_own(language):
    """A robot that is not a URDF is described in the controller's own frames, whose flange has z out of it."""
    for frame in (base_of(language, "base"), flange_of(language, "flange", True), flange_of(language, "tool0", False)):
        np.testing.assert_array_equal(frame.pose, np.eye(4))


@pytest.mark.parametrize("language", ["urscript", "rapid"])
@pytest.mark.parametrize("name", ["world", "ee_link", "chuck_fixture", "link_6", ""])
def test_a_name_that_says_nothing_is_not_guessed_at(language, name):
    for brought in (False, True):
        assert base_of(language, name) is None
        assert flange_of(language, name, brought) is None


@pytest.mark.parametrize("has_tool0", [True, False])
@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.0, np.pi / 2, 0.0), (0.7, 0.0, 0.0)])
def test_the_geometry_of_a_urdf_decides_what_its_flange_is(tmp_path, rpy, has_tool0):
    """tool0 in the file is the controller's; otherwise x must point out of a flange, or its pose is asked for."""
    fixed = [("flange", rpy), *([("tool0", (0.0, np.pi / 2, 0.0))] if has_tool0 else [])]
    links = "".join(f'<link name="{name}"/>' for name in ("base", "link", *(name for name, _ in fixed)))
    joint = '<joint name="j" type="revolute"><parent link="base"/><child link="link"/><axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    for name, angles in fixed:
        origin = f'<origin rpy="{" ".join(map(str, angles))}"/>'
        joint += f'<joint name="to_{name}" type="fixed"><parent link="link"/><child link="{name}"/>{origin}</joint>'
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="r">{links}{joint}</robot>')
    pose = tool0_in_flange(RobotChoice(str(path), "base", "flange"), load_robot(str(path), "base", "flange").chain)
    turn = Rotation.from_euler("xyz", rpy)
    assert (pose is not None) == has_tool0
    if pose is not None:
        np.testing.assert_allclose(turn.as_matrix() @ pose[:3, :3] @ Z, X, atol=1e-12)
    assert (flange_of("rapid", "flange", False, turn.inv().apply(X)) is None) == bool(rpy[1])
