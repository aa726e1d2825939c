"""Mimic joints on the path: the readings of other joints move them, and a table has no columns for them."""

import re

import numpy as np
import pytest
from tests.host.test_model_urdf import joint, robot, rodrigues
from tests.refusals import ended, refused

import truearm
from truearm.cli.main import main
from truearm.model.chain import end_and_jacobian, forward, joint_jacobian, point_jacobians
from truearm.model.inverse import inverse, singular_value
from truearm.model.joint_law import flat
from truearm.model.transforms import rotation_vector
from truearm.model.urdf import chain_from_urdf

URDF = robot(
    joint("j1", "revolute", "a", "b", "0 0 1", "0 0 0.4"),
    joint("j2", "revolute", "b", "c", "0 1 0", "0.1 0 0.1"),
    joint("motor", "revolute", "c", "d", "0 0 1", more="<limit lower='-1' upper='1'/>"),
    joint("lift", "prismatic", "d", "e", "0 0 1", "0 0 0.3", more="<limit lower='0' upper='0.5'/>"),
    joint("j3", "revolute", "e", "f", "0 1 0", "0 0 0.3", more="<mimic joint='j2' multiplier='-1.0' offset='0.2'/>"),
    joint("wrist", "revolute", "f", "g", "0 1 0", "0.6 0 0", more="<mimic joint='j3' multiplier='0.5' offset='-0.1'/>"),
    joint("slide", "prismatic", "g", "h", "1 0 0", "0.1 0 0", more="<mimic joint='lift' multiplier='0.25'/>"),
    joint("j6", "continuous", "h", "i", "0 0 1", "0.05 0 -0.1", more=""),
    joint("tool", "fixed", "i", "ball", xyz="0.02 0.03 -0.1", more=""),
    links=[*"abcdefghi", "ball"],
)  # fmt: skip
MOVING = [0, 1, 2, 3, 7]
CHAIN = chain_from_urdf(URDF)


def by_hand(q):
    """The ball in the base frame at readings (5,) of the motors, by Rodrigues' formula."""
    q1, q2, motor, lift, q6 = q
    z, y, x = [0, 0, 1], [0, 1, 0], [1, 0, 0]
    steps = [(z, q1, [0, 0, 0.4]), (y, q2, [0.1, 0, 0.1]), (z, motor, [0, 0, 0]), (None, [0, 0, lift], [0, 0, 0.3])]
    third = 0.2 - q2
    steps += [
        (y, third, [0, 0, 0.3]),
        (y, 0.5 * third - 0.1, [0.6, 0, 0]),
        (None, np.multiply(x, 0.25 * lift), [0.1, 0, 0]),
    ]
    steps += [(z, q6, [0.05, 0, -0.1])]
    point = np.array([0.02, 0.03, -0.1])
    for axis, amount, origin in reversed(steps):
        point = origin + (point + amount if axis is None else rodrigues(axis, amount) @ point)
    return point


def readings(n, seed=0):
    lower, upper = np.array([[-2, -1, -1, 0.0, -2], [2, 1.0, 1, 0.5, 2]])
    return np.random.default_rng(seed).uniform(lower, upper, (n, 5))


def spread(q):
    """Readings of all eight joints; those of the mimic joints are arbitrary, because they are not used."""
    every = np.full((len(q), 8), 7.0)
    every[:, MOVING] = q
    return every


def test_the_chain_moves_as_the_parallelograms_do():
    q = readings(20)
    poses = forward(CHAIN, CHAIN.params_nominal, spread(q))
    np.testing.assert_allclose(poses[:, :3, 3], [by_hand(row) for row in q], atol=1e-14)


def test_derivatives_are_those_of_the_motors():
    q, params, h = spread(readings(4)), CHAIN.params_nominal + 1e-2, 1e-30
    _, jac_params, jac_joints = point_jacobians(CHAIN, params, q, np.zeros(3))
    for k in range(8):
        step = np.zeros(8, complex)
        step[k] = 1j * h
        expected = forward(CHAIN, params, q + step)[:, :3, 3].imag / h
        np.testing.assert_allclose(jac_joints[..., k], expected, atol=1e-12)
        np.testing.assert_allclose(joint_jacobian(CHAIN, params, q)[:, :3, k], expected, atol=1e-12)
        np.testing.assert_allclose(end_and_jacobian(CHAIN, params, q)[1][:, :3, k], expected, atol=1e-12)
    for k in range(len(params)):
        step = np.zeros(len(params), complex)
        step[k] = 1j * h
        expected = forward(CHAIN, params + step, q)[:, :3, 3].imag / h
        np.testing.assert_allclose(jac_params[..., k], expected, atol=1e-12)
    assert CHAIN.law.angles(params, q).shape == flat(q).T.shape


def test_the_inverse_moves_the_motors_alone():
    q = spread(readings(50))
    targets = forward(CHAIN, CHAIN.params_nominal, q)
    solution = inverse(CHAIN, CHAIN.params_nominal, targets, q + 0.03, oriented=False)
    np.testing.assert_allclose(solution[:, 4], 0.2 - solution[:, 1], atol=1e-15)
    np.testing.assert_allclose([by_hand(row) for row in solution[:, MOVING]], targets[:, :3, 3], atol=1e-11)
    assert (singular_value(CHAIN, CHAIN.params_nominal, solution, oriented=False) > 0.05).all()


@pytest.mark.parametrize(
    ("mimic", "says"),
    [
        ("<mimic joint='elsewhere'/>", "mimic joint='elsewhere'"),
        ("<mimic joint='j2'/>", "mimic: "),
        ("<mimic joint='j1' multiplier='two'/>", "mimic: multiplier='two'"),
        ("<mimic/>", "mimic joint=None"),
    ],
)
def test_a_mimic_without_a_motor_is_refused(mimic, says):
    with refused("unsuited-robot", reason=f"URDF joint j2: {says}"):
        chain_from_urdf(
            robot(joint("j1", "revolute", "a", "b"), joint("j2", "revolute", "b", "c", more=mimic), links="abc")
        )


LIMITS = "<limit lower='{}' upper='{}'/>".format
PALLETIZER = robot(
    joint("j1", "revolute", "base", "turret", "0 0 1", "0 0 0.3", more=LIMITS(-2.5, 2.5)),
    joint("j2", "revolute", "turret", "lower_arm", "0 1 0", "0.1 0 0.1", more=LIMITS(-0.8, 1.3)),
    joint("j2b", "revolute", "lower_arm", "plate", "0 1 0", "0 0 0.5", more="<mimic joint='j2' multiplier='-1'/>"),
    joint("j3", "revolute", "plate", "upper_arm", "0 1 0", "0.05 0 0", more=LIMITS(-0.6, 1.4)),
    joint("j3b", "revolute", "upper_arm", "wrist", "0 1 0", "0.6 0 0", more="<mimic joint='j3' multiplier='-1'/>"),
    joint("j4", "revolute", "wrist", "flange", "0 0 -1", "0.08 0 -0.05", more=LIMITS(-3, 3)),
    joint("tool", "fixed", "flange", "ball", xyz="0.06 0.02 -0.15", rpy="3.14159265358979 0 0", more=""),
    links=["base", "turret", "lower_arm", "plate", "upper_arm", "wrist", "flange", "ball"],
)
BARS = """
[[chuck]]
name = "c"
xyz_mm = [600, 0, 0]

[[sphere]]
name = "s"
xyz_mm = [0, 0, 0]

[[bar]]
name = "b"
zero_mm = 300
travel_mm = 20
sigma_mm = 0.05
"""
RIG = """
[[tracker]]
name = "t"
xyz_mm = [0, 0, 0]
rotation_deg = [0, 0, 0]
sigma_mm = [0.02, 0.02, 0.02]

[[target]]
name = "ball"
xyz_mm = [0, 0, 0]
"""


def palletizer_ball(q, errors):
    """The ball (3,) at readings (4,); errors: of offsets (6,) [rad] and of the lengths of the two arms [m]."""
    q1, q2, q3, q4 = q
    angles = np.array([q1, q2, -q2, q3, -q3, -q4]) + errors[:6] * [1, 1, 1, 1, 1, -1]
    origins = np.array(
        [[0, 0, 0.3], [0.1, 0, 0.1], [0, 0, 0.5 + errors[6]], [0.05, 0, 0], [0.6 + errors[7], 0, 0], [0.08, 0, -0.05]]
    )
    point = np.array([0.06, 0.02, -0.15])
    for axis, angle, origin in reversed(list(zip([2, 1, 1, 1, 1, 2], angles, origins, strict=True))):
        point = origin + rodrigues(np.eye(3)[axis], angle) @ point
    return point


@pytest.fixture(scope="module")
def palletizer(tmp_path_factory):
    """A folder with the arm, its rig, and 200 measured points with the columns of its four motors alone."""
    folder = tmp_path_factory.mktemp("palletizer")
    (folder / "arm.urdf").write_text(PALLETIZER)
    (folder / "rig.toml").write_text(RIG)
    rng = np.random.default_rng(3)
    errors = np.append(rng.normal(0.0, 2e-3, 6), [0.8e-3, -0.6e-3])
    errors[0] = 0.0  # would be a rotation of the base
    q = rng.uniform([-2.5, -0.8, -0.6, -3], [2.5, 1.3, 1.4, 3], (200, 4))
    points = 1e3 * np.array([palletizer_ball(row, errors) for row in q]) + rng.normal(0.0, 0.02, (200, 3))
    lines = [f"position,t,{','.join(map(repr, (*a, *b)))}" for a, b in zip(q.tolist(), points.tolist(), strict=True)]
    header = "kind,tracker,q1_rad,q2_rad,q3_rad,q4_rad,x_mm,y_mm,z_mm"
    (folder / "points.csv").write_text("\n".join([header, *lines, ""]))
    return folder, errors


def test_a_palletizer_is_identified_from_the_readings_of_its_motors(palletizer, tmp_path):
    folder, errors = palletizer
    arguments = [str(folder / "points.csv"), "--model", str(folder / "arm.urdf"), "--rig", str(folder / "rig.toml")]
    result, urdf = tmp_path / "result.json", tmp_path / "calibrated.urdf"
    assert main(["identify", *arguments, "--joint-laws", "none", "--out", str(result)]) == 0
    held = readings(100, 9)[:, :4] * [1, 0.7, 0.6, 0]
    every = np.insert(held, [2, 3], 9.0, axis=1)
    truth = np.array([palletizer_ball(row, errors) for row in held])
    arm = truearm.load_robot(folder / "arm.urdf")
    calibration = truearm.read_result(result, robot=folder / "arm.urdf")
    assert np.linalg.norm(calibration.forward(every)[:, :3, 3] - truth, axis=1).max() < 0.05e-3
    assert np.linalg.norm(arm.forward(every)[:, :3, 3] - truth, axis=1).max() > 1e-3
    # The URDF in its place has the same mimic joints, and predicts the same.
    assert (
        main(["export", str(result), "--format", "urdf", "--model", str(folder / "arm.urdf"), "--out", str(urdf)]) == 0
    )
    poses = truearm.load_robot(urdf).forward(every)
    np.testing.assert_allclose(poses, calibration.forward(every), atol=1e-12)


def test_a_table_with_the_columns_of_all_joints_is_read_too(palletizer, tmp_path):
    folder, _ = palletizer
    arm = truearm.load_robot(folder / "arm.urdf")
    table = truearm.read_table(folder / "points.csv", arm)
    np.testing.assert_array_equal(table.q[:, [2, 4]], -table.q[:, [1, 3]])
    truearm.write_table(tmp_path / "all.csv", table, arm)
    np.testing.assert_array_equal(truearm.read_table(tmp_path / "all.csv", arm).q, table.q)


def test_formats_without_mimic_joints_name_one_that_has_them(palletizer):
    folder, _ = palletizer
    arm = truearm.load_robot(folder / "arm.urdf")
    result = truearm.identify(arm, truearm.read_table(folder / "points.csv", arm), folder / "rig.toml")
    for form in ("mjcf", "dh", "ur", "evaluator-c"):
        with refused("unsuited-robot", "mimic joint j2b", "urdf", place=form):
            truearm.export_robot(result, form)


@pytest.mark.parametrize("turn", [0.0, 2.0 * np.pi], ids=["as it is", "a turn beyond, where only a motor has limits"])
def test_a_plan_of_sockets_has_columns_of_the_motors(turn, tmp_path):
    (tmp_path / "arm.urdf").write_text(PALLETIZER.replace("multiplier='-1'", f"multiplier='-1' offset='{turn}'"))
    arguments = [
        "--method",
        "sockets",
        "--model",
        str(tmp_path / "arm.urdf"),
        "--ball-xyz-mm",
        "0,0,0",
        "--table-mm=-200",
    ]
    assert main(["init", str(tmp_path / "cell"), *arguments]) == 0
    header, *rows = (tmp_path / "cell" / "places.csv").read_text().splitlines()
    assert header.endswith("q1_deg,q2_deg,q3_deg,q4_deg")
    for cells in (row.split(",") for row in rows):
        ball = palletizer_ball(np.radians([float(cell) for cell in cells[6:]]), np.zeros(8))
        np.testing.assert_allclose(1e3 * ball, [float(cell) for cell in cells[3:6]], atol=0.3)


def test_a_plan_of_bars_needs_joints_that_move_by_themselves(palletizer, tmp_path, capsys):
    folder, _ = palletizer
    (tmp_path / "bars.toml").write_text(BARS)
    arguments = ["--model", str(folder / "arm.urdf"), "--rig", str(tmp_path / "bars.toml"), "--poses", "20", "--branch"]
    assert main(["plan", "ballbar", *arguments, ",".join(["-60:60"] * 6), "--out", str(tmp_path / "plan.csv")]) == 2
    ended(capsys.readouterr().err, "no-plan", "joint j2b", "robot r ")


def test_readings_of_the_motors_are_completed_wherever_joints_are_read(palletizer, tmp_path, capsys):
    folder, _ = palletizer
    model, result = ["--model", str(folder / "arm.urdf")], tmp_path / "result.json"
    rig = ["--rig", str(folder / "rig.toml"), "--joint-laws", "none"]
    assert main(["identify", str(folder / "points.csv"), *model, *rig, "--out", str(result)]) == 0
    x, y, z = 1e3 * palletizer_ball(np.radians([20, 10, 25, 30]), np.zeros(8))
    home = {4: "20,10,25,30", 6: "20,10,-10,25,-25,30"}
    corrected = []
    for count, joints in home.items():
        headers = {
            "targets": "x_mm,y_mm,z_mm," + ",".join(f"q{i}_deg" for i in range(1, count + 1)),
            "poses": "x_mm,y_mm,z_mm",
        }
        for name, header in headers.items():
            table, out = tmp_path / f"{name}{count}.csv", tmp_path / f"{name}{count}_out.csv"
            table.write_text(f"{header}\n{x},{y},{z}{',' + joints if name == 'targets' else ''}\n")
            option = ["--home", joints] if name == "poses" else []
            assert (
                main(["correct", str(result), str(table), *model, *option, "--margin", "0.001", "--out", str(out)]) == 0
            )
            corrected.append(out.read_text().splitlines())
    assert corrected[0] == corrected[2]
    assert corrected[1] == corrected[3]
    assert "q4_deg,before_mm" in corrected[0][0]
    pages = []
    for count, joints in home.items():
        pages.append(tmp_path / f"map{count}.csv")
        section = ["--at", joints, "--vary", "2,4", "--cell-mm", "100", "--out", str(pages[-1])]
        assert main(["map", str(result), *model, *section]) == 0, capsys.readouterr().err
    maps = [page.read_bytes() for page in pages]
    assert maps[0] == maps[1]
    plan = tmp_path / "plan.csv"
    plan.write_text(
        "pose,shell,bar,chuck,sphere,q1_rad,q2_rad,q3_rad,q4_rad\n0,s,b,c,s,0.1,0.2,0.3,0.4\n1,s,b,c,s,0.4,0.5,0.6,0.7\n"
    )
    urdf = ["--format", "urdf", "--over", str(plan), "--out", str(tmp_path / "calibrated.urdf")]
    assert main(["export", str(result), *model, *urdf]) == 0


def test_programs_have_the_joints_of_six_motors(tmp_path):
    more = LIMITS(-2, 2)
    wrist = joint("j5", "revolute", "flange", "hand", "0 1 0", "0 0 0.1", more=more)
    wrist += joint("j6", "revolute", "hand", "plate6", "1 0 0", "0.02 0 0.1", more=more)
    links = "".join(f"<link name='{name}'/>" for name in ("hand", "plate6"))
    arm = PALLETIZER.replace('<parent link="flange"/>', '<parent link="plate6"/>')
    (tmp_path / "arm.urdf").write_text(arm.replace("<joint", links + wrist + "<joint", 1))
    robot_of_six = truearm.load_robot(tmp_path / "arm.urdf")
    chain, rng = robot_of_six.chain, np.random.default_rng(4)
    tolerance = np.array([0.0 if p.term == "gain" else 1e-3 for p in chain.parameters])
    q = rng.uniform([-2, -0.6, -0.4, -2, 0.3, -1.5], [2, 1.2, 1.2, 2, 1.5, 1.5], (120, 6))
    true = chain.params_nominal + tolerance * rng.normal(size=tolerance.size)
    ends = forward(chain, true, chain.completed(q))
    cells = np.concatenate([q, 1e3 * ends[:, :3, 3], rotation_vector(ends[:, :3, :3])], axis=1)
    header = (
        "kind,tracker,target," + ",".join(f"q{i}_rad" for i in range(1, 7)) + ",x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad"
    )
    lines = ["pose,t,ball," + ",".join(map(repr, row)) for row in cells.tolist()]
    (tmp_path / "poses.csv").write_text("\n".join([header, *lines, ""]))
    (tmp_path / "rig.toml").write_text(RIG.replace("\n\n[[target", "\nrotation_sigma_deg = 0.01\n\n[[target"))
    old = np.array([0.1, 0.3, 0.9, 0.2, 0.7, 0.3])
    end = robot_of_six.forward(chain.completed(old))
    six = ",".join(map(repr, [*end[:3, 3].tolist(), *rotation_vector(end[:3, :3]).tolist()]))
    program = "def p():\n  set_tcp(p[0,0,0,0,0,0])\n  movej([{}], a=1, v=1)\n  movej(p[{}], a=1, v=1)\nend\n"
    (tmp_path / "p.script").write_text(program.format(",".join(map(repr, old.tolist())), six))
    files = {
        name: str(tmp_path / name) for name in ("poses.csv", "arm.urdf", "rig.toml", "r.json", "p.script", "o.script")
    }
    model = ["--model", files["arm.urdf"]]
    options = ["--rig", files["rig.toml"], "--joint-laws", "none", "--out", files["r.json"]]
    assert main(["identify", files["poses.csv"], *model, *options]) == 0
    options = ["--joint-moves", "correct", "--flange", "0,0,0,0,0,0", "--margin", "0.001", "--out", files["o.script"]]
    assert main(["correct", files["r.json"], files["p.script"], *model, *options]) == 0
    joints, pose = (
        np.array([float(number) for number in numbers.split(",")])
        for numbers in re.findall(r"movej\(p?\[(.*)\]", (tmp_path / "o.script").read_text())
    )
    # The arm goes by its new joints where the nominal one goes by the old, and the new pose means the same joints.
    calibration = truearm.read_result(files["r.json"], robot=files["arm.urdf"])
    new = chain.completed(joints)
    assert 1e-4 < np.abs(joints - old).max() < 0.1
    np.testing.assert_allclose(calibration.forward(new), robot_of_six.forward(chain.completed(old)), atol=1e-7)
    moved = robot_of_six.forward(new)
    np.testing.assert_allclose(pose, [*moved[:3, 3], *rotation_vector(moved[:3, :3])], atol=1e-7)
