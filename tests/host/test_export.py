"""Exported robots predict the same poses as the identified robot, read by truearm and by an independent library."""

import io
import json
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import correct_bench
import numpy as np
import pytest
from puma_bench import CHAIN, DESIGN, TRUTH
from scipy.spatial.transform import Rotation
from term_bench import register
from tests.host.findings_bench import listed
from tests.refusals import refused

from truearm.errors import RobotError
from truearm.estimate.identify import identify
from truearm.estimate.result_file import read_result
from truearm.export.formats import FORMATS
from truearm.export.toml_tables import dh_hayati_table, dh_table, modified_dh_table, sheth_uicker_table
from truearm.export.ur import KEYS, SEGMENTS, ur_segments, ur_yaml
from truearm.export.urdf import edited, joint_origins, new_urdf, write_mjcf
from truearm.export.writing import RobotToWrite, fit_to, link_frames, writer, written
from truearm.kinds.rig_file import read_rig
from truearm.kinds.table_file import read_table
from truearm.model import joint_law
from truearm.model.chain import forward
from truearm.model.chain_structure import Parameter
from truearm.model.robot import parse_robot
from truearm.model.robot_file import builtin_names, builtin_robot, load_robot
from truearm.model.transforms import elementary, inverted
from truearm.model.urdf import chain_from_urdf

MUKCA = Path(__file__).parents[1] / "data" / "mukca"
ROUNDING = 1e-13  # of an arm of a metre and some twenty products


def disturbed(chain, sigma=0.003, gains=0.0, seed=0):
    """Return nominal and calibrated parameters, with errors of millimetres and milliradians, also of the mountings."""
    rng = np.random.default_rng(seed)
    scale = np.where([p.term == "gain" for p in chain.parameters], gains, sigma)
    return chain.params_nominal, chain.params_nominal + scale * rng.normal(size=scale.size)


def some_poses(chain, n=40):
    return np.random.default_rng(1).uniform(-1.2, 1.2, (n, len(chain.joints)))


def source(robot, described, comment="a\nb"):
    """Return what a writer needs of a RobotToWrite."""
    return SimpleNamespace(robot=robot, described=described, comment=comment)


def tables(robot, described):
    writers = {
        "sheth-uicker": sheth_uicker_table,
        "dh": dh_table,
        "dh-hayati": dh_hayati_table,
        "mdh": modified_dh_table,
    }
    return {name: partial(write, source(robot, described)) for name, write in writers.items()}


READABLE = ("urdf", "dh-hayati", "sheth-uicker")  # files of any robot that truearm reads itself


@pytest.mark.parametrize("name", builtin_names())
@pytest.mark.parametrize("form", ["sheth-uicker", "dh", "dh-hayati", "mdh"])
def test_tables_are_robot_files_that_predict_the_same(name, form):
    chain = builtin_robot(name).chain
    nominal, calibrated = disturbed(chain, gains=1e-3)
    robot, described = link_frames(chain, nominal, calibrated), link_frames(chain, nominal, nominal)
    again = parse_robot(tables(robot, described)[form]()).chain
    q = some_poses(chain)
    np.testing.assert_allclose(forward(again, again.params_nominal, q), forward(chain, calibrated, q), atol=ROUNDING)
    assert (again.base_frame, again.end_frame) == (chain.base_frame, chain.end_frame)
    np.testing.assert_allclose(
        [(j.lower, j.upper) for j in again.joints], [(j.lower, j.upper) for j in chain.joints], atol=1e-12
    )


@pytest.mark.parametrize("tilt", [1e-10, 1e-8, 1.1e-8, 1e-6, 1e-4, 1e-2])
def test_rows_of_nearly_parallel_axes_predict_the_same_however_large_d(tilt):
    """A tilt of 0.1 mrad toward each other puts the common normal of two axes 0.4 m apart 4 km away."""
    chain = builtin_robot("ur5e").chain
    calibrated = disturbed(chain)[1]
    for name in ("joint2.alpha", "joint3.alpha"):
        calibrated[chain.parameter_names.index(name)] = 0.01 * tilt
    for name, sign in (("joint2.beta", 1.0), ("joint3.beta", -1.0)):
        calibrated[chain.parameter_names.index(name)] = sign * tilt
    robot, described = (link_frames(chain, chain.params_nominal, p) for p in (calibrated, chain.params_nominal))
    q = np.random.default_rng(2).uniform(-3.0, 3.0, (100, 6))
    for table in (dh_table, modified_dh_table):
        again = parse_robot(table(source(robot, described))).chain
        largest = max(abs(v) for n, v in zip(again.parameter_names, again.params_nominal) if n.endswith(".d"))
        assert largest < 10.0 / tilt
        assert largest > 0.1 / tilt or tilt <= 1e-8
        apart = forward(again, again.params_nominal, q) - forward(chain, calibrated, q)
        assert np.abs(apart).max() <= max(1e-12, 3e-16 * largest, 2.0 * tilt if tilt <= 1e-8 else 0.0)


def test_rows_are_the_makers():
    """Of design values the rows come out as Universal Robots publishes them, and a PUMA's as in any textbook."""
    rows = rows_of("ur5e")
    np.testing.assert_allclose(rows["a_m"], [0, -0.425, -0.3922, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rows["d_m"], [0.1625, 0, 0, 0.1333, 0.0997, 0.0996], atol=1e-12)
    np.testing.assert_allclose(np.degrees(rows["alpha_rad"]), [90, 0, 0, 90, -90, 0], atol=1e-9)
    np.testing.assert_allclose(rows["offset_rad"], 0.0, atol=1e-12)
    puma = rows_of("puma560")
    np.testing.assert_allclose(np.abs(puma["a_m"]), [0, 0.4318, 0.02032, 0, 0, 0], atol=1e-5)
    np.testing.assert_allclose(np.abs(np.degrees(puma["alpha_rad"])), [90, 0, 90, 90, 90, 0], atol=1e-9)


def rows_of(name):
    chain = builtin_robot(name).chain
    described = link_frames(chain, chain.params_nominal, chain.params_nominal)
    again = parse_robot(dh_table(source(described, described))).chain
    found = dict(zip(again.parameter_names, again.params_nominal.tolist(), strict=True))
    short = {"a_m": "a", "d_m": "d", "alpha_rad": "alpha", "offset_rad": "offset"}
    return {key: [found[f"joint{i}.{name}"] for i in range(1, 7)] for key, name in short.items()}


def library_forward(text, chain, q, base, tip):
    """Return yourdfpy's forward kinematics."""
    import yourdfpy  # and trimesh with it: every worker collects this file, and one runs it

    robot = yourdfpy.URDF.load(io.BytesIO(text.encode()), load_meshes=False, build_scene_graph=True)
    out = []
    for row in q:
        robot.update_cfg({joint.name: value for joint, value in zip(chain.joints, row, strict=True)})
        out.append(robot.get_transform(tip, base))
    return np.stack(out)


@pytest.mark.parametrize("name", builtin_names())
def test_new_urdfs_agree_with_an_independent_library(name):
    chain = builtin_robot(name).chain
    nominal, calibrated = disturbed(chain)
    text = new_urdf(link_frames(chain, nominal, calibrated), "-- a comment --")
    q = some_poses(chain, 10)
    expected = forward(chain, calibrated, q)
    again = chain_from_urdf(text)
    np.testing.assert_allclose(forward(again, again.params_nominal, q), expected, atol=ROUNDING)
    there = library_forward(text, chain, q, chain.base_frame, chain.end_frame)
    np.testing.assert_allclose(there, expected, atol=1e-9)


@pytest.mark.parametrize(("file", "tip"), [("panda.urdf", "ball_link"), ("iiwa14.urdf", None)])
def test_a_urdf_changed_in_place_agrees_with_an_independent_library(file, tip):
    text = (MUKCA / file).read_text()
    try:
        chain = chain_from_urdf(text, tip=tip)
    except RobotError as error:
        tip = re.search(r"among ([\w]+)", str(error))[1]
        chain = chain_from_urdf(text, tip=tip)
    nominal, calibrated = disturbed(chain)
    written = edited(text, joint_origins(chain, nominal, nominal), joint_origins(chain, nominal, calibrated))
    q = some_poses(chain, 10)
    expected = forward(chain, calibrated, q)
    again = chain_from_urdf(written, chain.base_frame, chain.end_frame)
    np.testing.assert_allclose(forward(again, again.params_nominal, q), expected, atol=ROUNDING)
    there = library_forward(written, chain, q, chain.base_frame, chain.end_frame)
    np.testing.assert_allclose(there, expected, atol=1e-9)


def numbers_cut_out(text):
    """Return a URDF without the numbers of its origins."""
    return re.sub(r'\b(xyz|rpy)="[^"]*"', r"\1=", text)


def test_only_numbers_of_origins_on_the_path_change():
    text = (MUKCA / "panda.urdf").read_text()
    chain = chain_from_urdf(text, tip="ball_link")
    nominal, calibrated = disturbed(chain)
    written = edited(text, joint_origins(chain, nominal, nominal), joint_origins(chain, nominal, calibrated))
    assert written != text
    assert numbers_cut_out(written) == numbers_cut_out(text)
    names = {name.rpartition(".")[0] for name in chain.parameter_names}
    for before, after in zip(*(ElementTree.fromstring(t).findall("joint") for t in (text, written)), strict=True):
        if before.get("name") not in names:
            assert ElementTree.tostring(before) == ElementTree.tostring(after)
    assert edited(text, *(2 * [joint_origins(chain, nominal, nominal)])) == text


def test_own_frames_leave_both_ends_as_they_were():
    text = (MUKCA / "panda.urdf").read_text()
    chain = chain_from_urdf(text, tip="ball_link")
    nominal, calibrated = disturbed(chain)
    kept, left_out = (joint_origins(chain, nominal, calibrated, with_mountings) for with_mountings in (True, False))
    described = joint_origins(chain, nominal, nominal)
    names = list(described)
    for end in (names[0], names[-1]):
        np.testing.assert_allclose(left_out[end], described[end], atol=ROUNDING)
    for name in names[1:-1]:
        np.testing.assert_array_equal(left_out[name], kept[name])
    chains = [chain_from_urdf(edited(text, described, o), chain.base_frame, chain.end_frame) for o in (kept, left_out)]
    poses = [forward(c, c.params_nominal, some_poses(chain)) for c in chains]
    base = kept[names[0]] @ inverted(described[names[0]])
    tool = inverted(described[names[-1]]) @ kept[names[-1]]
    np.testing.assert_allclose(poses[0], base @ poses[1] @ tool, atol=ROUNDING)


JOINT = '<joint name="{}" type="{}">{}<parent link="{}"/><child link="{}"/>{}</joint>'
AXIS = '<axis xyz="1 2 -2"/><limit lower="-2" upper="2"/>'


@pytest.mark.parametrize(
    "origins",
    [
        ("", "", ""),
        ("<origin note=\" xyz='1 2 3'\" xyz='&#49; 0 0'/>", "<origin rpy='0 0 1' />", "<origin\txyz='1 2 3' rpy='1 2 3'/>"),
        ("<origin/>", "<origin  xyz = '0 0 .1'\n/>", '<origin rpy="0.1 0 0"></origin>'),
        ('<!-- <origin xyz="9 9 9"/> -->', '<origin rpy="0 1.5707963267948966 0" xyz="1 0 0"/>', "<note a='>'><origin/></note>"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("ends", ["moving", "fixed"])
def test_origins_of_any_writing(origins, ends):
    """Missing origins, single quotes, spaces, comments, origins of something else, gimbal lock, odd axes."""
    kinds = ("revolute", "prismatic", "revolute") if ends == "moving" else ("fixed", "revolute", "fixed")
    body = "".join(f'<link name="{link}"/>' for link in "abcd") + "".join(
        JOINT.format(f"j{i}", kind, origin, "abcd"[i], "abcd"[i + 1], AXIS if kind != "fixed" else "")
        for i, (kind, origin) in enumerate(zip(kinds, origins, strict=True))
    )
    text = f"<?xml version='1.0'?>\n<robot name='r'>{body}</robot>"
    chain = chain_from_urdf(text)
    nominal, calibrated = disturbed(chain, 0.02)
    written = edited(text, joint_origins(chain, nominal, nominal), joint_origins(chain, nominal, calibrated))
    again = chain_from_urdf(written)
    q = some_poses(chain)
    # at a pitch of 90° rpy has 1e-9 of six_of
    np.testing.assert_allclose(forward(again, again.params_nominal, q), forward(chain, calibrated, q), atol=5e-9)


def test_gains_are_refused_where_there_is_no_place_for_them():
    robot = link_frames(CHAIN, DESIGN, TRUTH)
    with pytest.raises(RobotError, match=r"gain 0\.999217, but"):
        new_urdf(robot)


def test_refitting_makes_up_for_most_of_the_gains():
    """PAPERS: dropping identified gains leaves 0.44 mm RMS, refitting the rest 0.34; over what region decides the figure."""
    gains = np.array([p.term == "gain" for p in CHAIN.parameters])
    q = np.random.default_rng(0).uniform([-1, -1.5, 1.5, -1.5, 0.3, -1.5], [1, 0.2, 3.3, 1.5, 1.5, 1.5], (300, 6))
    found = fit_to("urdf", CHAIN, DESIGN, TRUTH, np.ones(gains.size, dtype=bool), q)
    assert found.refitted
    assert not found.exact
    assert found.missing == tuple(f"joint{i}.gain" for i in range(1, 7))
    rms = [np.sqrt(np.mean(error**2)) for error in (found.dropped, found.left)]
    assert rms[1] < 0.6 * rms[0]
    np.testing.assert_array_equal(found.params[gains], 1.0)
    apart = (forward(CHAIN, found.params, q) - forward(CHAIN, TRUTH, q))[:, :3, 3]
    np.testing.assert_allclose(found.left, np.linalg.norm(apart, axis=1), atol=ROUNDING)
    # no step in any parameter makes it better: the gradient over the marks is zero to first order
    rng = np.random.default_rng(1)
    for _ in range(5):
        step = 1e-4 * rng.normal(size=gains.size) * ~gains
        assert cost(found.params + step, q) > cost(found.params, q)


def cost(params, q):
    marks = 0.1 * np.array([[0, 0, 0, 10], [1, 0, 0, 10], [0, 1, 0, 10], [0, 0, 1, 10.0]]).T
    return float(np.sum(((forward(CHAIN, params, q) - forward(CHAIN, TRUTH, q)) @ marks) ** 2))


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_says_what_it_holds(name):
    """Its writer is there, its terms are terms, and what it holds of a robot it holds exactly."""
    assert callable(writer(name))
    form = FORMATS[name]
    assert set(form.holds) <= {term.name for term in joint_law.terms()}
    chain = builtin_robot("ur5e").chain
    nominal, calibrated = disturbed(chain, gains=1e-3)
    found = fit_to(name, chain, nominal, calibrated, np.ones(nominal.size, dtype=bool), some_poses(chain))
    assert found.exact == ("gain" in form.holds)
    assert bool(found.missing) == ("gain" not in form.holds)


def test_the_docs_list_every_format_and_without_poses_nothing_is_said():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "robot-format.md").read_text()
    for name, form in FORMATS.items():
        mountings = "yes" if form.mountings else "no"
        assert f"| `{name}` | `{form.suffix}` | {', '.join(form.holds)} | {mountings} |" in page
    with pytest.raises(RobotError, match="no poses"):
        fit_to("urdf", CHAIN, DESIGN, TRUTH, np.ones(DESIGN.size, dtype=bool), np.zeros((0, 6)))


@pytest.fixture
def waving(monkeypatch):
    """Return a robot with a joint term that no format knows in joint 2: the chain, nominal and identified parameters."""
    register(monkeypatch)
    plain = builtin_robot("ur5e").chain
    chain = replace(
        plain, name="wavy", parameters=(*plain.parameters, Parameter("joint2.ripple", "rad", 0.0, "ripple", 1))
    )
    nominal, calibrated = disturbed(chain)
    calibrated[-1] = 2e-3
    return chain, nominal, calibrated


@pytest.mark.parametrize("name", FORMATS)
def test_a_term_that_no_format_has_is_costed_by_each(name, waving):
    chain, nominal, calibrated = waving
    q = some_poses(chain, 200)
    found = fit_to(name, chain, nominal, calibrated, np.ones(nominal.size, dtype=bool), q)
    assert (found.refitted, found.exact) == (True, False)
    assert "joint2.ripple" in found.missing
    assert found.params[-1] == 0.0
    assert 1e-5 < np.sqrt(np.mean(found.left**2)) < np.sqrt(np.mean(found.dropped**2))
    text = written(name if name in READABLE else "sheth-uicker", RobotToWrite(chain, nominal, found.params))
    again = parse_robot(text).chain if text.startswith("name") else chain_from_urdf(text)
    apart = (forward(again, again.params_nominal, q) - forward(chain, calibrated, q))[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(apart, axis=1), found.left, atol=1e-12)  # the cost is that of the file


def test_an_error_that_only_turns_the_end_has_a_cost():
    """The end of a UR5e lies on the axis of joint 6: without that joint's gain the end turns, but stays where it is."""
    chain = builtin_robot("ur5e").chain
    nominal = chain.params_nominal
    calibrated, only = nominal.copy(), np.zeros(nominal.size, dtype=bool)
    at = chain.parameter_names.index("joint6.gain")
    calibrated[at], only[at] = 1.01, True
    q = some_poses(chain, 200)
    found = fit_to("urdf", chain, nominal, calibrated, only, q)
    assert found.missing == ("joint6.gain",)
    assert found.left.max() < 1e-12
    np.testing.assert_allclose(found.left_turn, 0.01 * np.abs(q[:, 5]), atol=1e-9)
    np.testing.assert_array_equal(found.dropped_turn, found.left_turn)


@pytest.mark.parametrize("name", ["dh-hayati", "sheth-uicker"])
def test_a_format_may_declare_a_further_term_and_then_writes_it(name, waving, monkeypatch):
    chain, nominal, calibrated = waving
    monkeypatch.setitem(FORMATS, name, FORMATS[name]._replace(holds=("offset", "gain", "ripple")))
    q = some_poses(chain)
    found = fit_to(name, chain, nominal, calibrated, np.ones(nominal.size, dtype=bool), q)
    assert (found.refitted, found.missing, found.exact) == (False, (), True)
    again = parse_robot(written(name, RobotToWrite(chain, nominal, found.params))).chain
    assert "ripple" in {p.term for p in again.parameters}
    np.testing.assert_allclose(forward(again, again.params_nominal, q), forward(chain, calibrated, q), atol=1e-12)


@pytest.mark.parametrize("name", ["urdf", "ur"])
def test_a_format_that_declares_what_it_does_not_write_is_refused(name, waving, monkeypatch):
    chain, nominal, calibrated = waving
    monkeypatch.setitem(FORMATS, name, FORMATS[name]._replace(holds=("offset", "ripple")))
    found = fit_to(name, chain, nominal, calibrated, np.ones(nominal.size, dtype=bool), some_poses(chain))
    with pytest.raises(RobotError, match=f"{name} declares .* ripple "):
        written(name, RobotToWrite(chain, nominal, found.params))


@pytest.mark.parametrize(("model", "key", "part"), [("ur5e", "joint6.a", "flange"), ("kr6", "joint6.a", "axes")])
def test_a_kinematics_file_says_what_it_cannot_express(model, key, part):
    chain = builtin_robot(model).chain
    nominal = chain.params_nominal.copy()
    nominal[chain.parameter_names.index(key)] += 1e-3
    with refused("unsuited-robot", place=f"robot {model}", reason=part):
        written("ur", RobotToWrite(chain, nominal, nominal))


def test_where_nothing_sensible_can_be_written_nothing_is():
    """Two joints that turn against their readings: without their gains of −1 no links help."""
    chain = builtin_robot("irb120").chain
    nominal = chain.params_nominal.copy()
    against = [i for i, p in enumerate(chain.parameters) if p.name in ("joint1.gain", "joint5.gain")]
    nominal[against] = -1.0
    _, calibrated = disturbed(chain)
    calibrated[against] = -1.0
    every = np.ones(nominal.size, dtype=bool)
    with pytest.raises(RobotError, match=r"urdf .* joint1\.gain, joint5\.gain.*dh or .* or sheth-uicker"):
        fit_to("urdf", chain, nominal, calibrated, every, some_poses(chain))
    assert fit_to("sheth-uicker", chain, nominal, calibrated, every, some_poses(chain)).exact


PUBLISHED = {  # Universal_Robots_ROS2_Description, config/ur5e/default_kinematics.yaml
    "shoulder": (0.0, 0.0, 0.1625, 0.0, 0.0, 0.0),
    "upper_arm": (0.0, 0.0, 0.0, np.pi / 2, 0.0, 0.0),
    "forearm": (-0.425, 0.0, 0.0, 0.0, 0.0, 0.0),
    "wrist_1": (-0.3922, 0.0, 0.1333, 0.0, 0.0, 0.0),
    "wrist_2": (0.0, -0.0997, 0.0, np.pi / 2, 0.0, 0.0),
    "wrist_3": (0.0, 0.0996, 0.0, np.pi / 2, np.pi, np.pi),
}


def read_kinematics(text):
    """Return {segment: pose} of a kinematics file."""
    out = {}
    for name in SEGMENTS:
        block = re.search(rf"^  {name}:\n((?:    \w+: \S+\n){{6}})", text, re.MULTILINE)[1]
        values = dict(line.strip().split(": ") for line in block.splitlines())
        x, y, z, roll, pitch, yaw = (float(values[key]) for key in KEYS)
        out[name] = six_pose(x, y, z, roll, pitch, yaw)
    return out


def six_pose(x, y, z, roll, pitch, yaw):
    pose = elementary("rz", yaw) @ elementary("ry", pitch) @ elementary("rx", roll)
    pose[:3, 3] = x, y, z
    return pose


def test_kinematics_files_are_the_published_ones_and_predict_the_robot():
    chain = builtin_robot("ur5e").chain
    described = link_frames(chain, chain.params_nominal, chain.params_nominal)
    found = read_kinematics(ur_yaml(source(described, described)))
    for name, six in PUBLISHED.items():
        np.testing.assert_allclose(found[name], six_pose(*six), atol=1e-12)
    chain = builtin_robot("ur5e").chain
    nominal, calibrated = disturbed(chain)
    robot, described = link_frames(chain, nominal, calibrated), link_frames(chain, nominal, nominal)
    found = read_kinematics(ur_yaml(source(robot, described)))
    _, rest = ur_segments(robot)
    for q in some_poses(chain, 10):
        here = np.eye(4)
        for name, angle in zip(SEGMENTS, q, strict=True):
            here = here @ found[name] @ elementary("rz", angle)
        expected = inverted(robot.base) @ forward(chain, calibrated, q) @ inverted(robot.tool)
        np.testing.assert_allclose(here @ rest, expected, atol=ROUNDING)
    chain = builtin_robot("irb120").chain
    described = link_frames(chain, chain.params_nominal, chain.params_nominal)
    with pytest.raises(RobotError, match="irb120: its axes"):
        ur_yaml(source(described, described))
    panda = builtin_robot("panda").chain
    described = link_frames(panda, panda.params_nominal, panda.params_nominal)
    with pytest.raises(RobotError, match="six revolute joints"):
        ur_yaml(source(described, described))


def test_names_that_would_be_taken_twice():
    """Joints called as the fixed ones of a new URDF, frames called as its links."""
    chain = builtin_robot("ulb").chain
    names = ("flange", "base_mounting", "tool_mounting", "a", "b", "c")
    joints = tuple(replace(joint, name=name) for joint, name in zip(chain.joints, names, strict=True))
    odd = replace(chain, joints=joints, base_frame="link1", end_frame="link1", name='<&"\u00e9\U0001f600')
    robot = link_frames(odd, odd.params_nominal, odd.params_nominal)
    again = chain_from_urdf(new_urdf(robot))
    q = some_poses(chain)
    np.testing.assert_allclose(
        forward(again, again.params_nominal, q), forward(chain, chain.params_nominal, q), atol=ROUNDING
    )
    assert parse_robot(sheth_uicker_table(source(robot, robot))).chain.name == odd.name


@pytest.mark.parametrize("name", builtin_names())
def test_an_mjcf_predicts_the_same(name):
    """Its bodies are multiplied by hand; by MuJoCo 4.0.0, the poses of three arms agree to 2e-15 m."""
    chain = builtin_robot(name).chain
    nominal, calibrated = disturbed(chain)
    text = write_mjcf(RobotToWrite(chain, nominal, calibrated, comment="a--b"))
    body, q = ElementTree.fromstring(text).find("worldbody/body"), some_poses(chain, 1)[0]
    end, readings = np.eye(4), iter(q)
    while body is not None:
        here = np.eye(4)
        w, x, y, z = map(float, body.get("quat").split())
        here[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        here[:3, 3] = [float(word) for word in body.get("pos").split()]
        end = end @ here
        if (joint := body.find("joint")) is not None:
            end = end @ elementary({"hinge": "rz", "slide": "tz"}[joint.get("type")], next(readings))
        last, body = body.get("name"), body.find("body")
    assert last == chain.end_frame
    assert next(readings, None) is None
    np.testing.assert_allclose(end, forward(chain, calibrated, q[None])[0], atol=ROUNDING)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return correct_bench.write(tmp_path_factory.mktemp("export") / "result.json", correct_bench.identified())


def test_only_what_the_user_may_adjust_changes(result, tmp_path, printed):
    """Renders' III-F: a controller that takes offsets and lengths alone."""
    out = tmp_path / "adjusted.toml"
    patterns = ("--adjust", "joint*.offset", "--adjust", "*.x,*.y,*.z")
    said = printed("export", result, "--format", "sheth-uicker", "--out", out, *patterns, "--json")
    assert listed(json.loads(said))["exported"]["dropped"]["mm"] > 1.0
    chain = load_robot(str(out)).chain
    gains = [value for name, value in zip(chain.parameter_names, chain.params_nominal, strict=True) if "gain" in name]
    np.testing.assert_array_equal(gains, 1.0)
    q = correct_bench.good_poses(100)
    stored = read_result(result)
    identified = forward(CHAIN, stored.column("value")[stored.column("of") == "robot"], q)
    error = (forward(chain, chain.params_nominal, q) - identified)[:, :3, 3]
    before = (forward(CHAIN, DESIGN, q) - identified)[:, :3, 3]
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(before**2))


def test_panda_exported_and_reloaded_has_the_same_held_out_error(tmp_path, printed):
    """The arm of tests/data/mukca: three places identify it; the exported URDF, as it stands, predicts the other three as well."""
    held = [a for place in ("frontcenter", "frontleft", "frontright") for a in ("--hold-out", f"place={place}")]
    urdf, table, rig = MUKCA / "panda.urdf", MUKCA / "panda_3.csv", MUKCA / "rig.toml"
    result, out = tmp_path / "r.json", tmp_path / "calibrated.urdf"
    known = ["--model", urdf, "--tip", "ball_link", "--rig", rig, "--joint-laws", "none"]  # a URDF holds no laws
    printed("identify", table, *known, "--out", result, *held)
    said = printed("export", result, "--format", "urdf", "--model", urdf, "--out", out)
    assert "holds everything" in said
    stored = read_result(result)
    chain = load_robot(str(out), None, "ball_link").chain
    observations = read_table(table, chain.joint_units)
    judged = np.isin(observations.place, ["frontcenter", "frontleft", "frontright"])
    # nothing of the robot is fitted: only the rig's own unknowns, the ball's place among them
    none = np.zeros(len(chain.parameters), dtype=bool)
    again = identify(chain, read_rig(rig), observations, free=none, hold_out=judged)
    document = stored.held_out
    assert document["mean_mm"] < 0.25
    # the ball's place is estimated again without the robot's prior, which moves the error by micrometres
    assert 1e3 * again.held_out.figures["m"].mean == pytest.approx(document["mean_mm"], abs=5e-3)
    q = observations.q
    before = load_robot(str(urdf), None, "ball_link").chain
    np.testing.assert_allclose(
        forward(chain, chain.params_nominal, q),
        forward(before, stored.column("value")[stored.column("of") == "robot"], q),
        atol=1e-12,
    )
