"""URDF: geometry compared with Rodrigues' formula, names, and refusal of unsafe files."""

import math

import numpy as np
import pytest

from truearm.errors import RobotError
from truearm.model.chain import forward, joint_frames
from truearm.model.urdf import MAX_TEXT, capsules_from_urdf, chain_from_urdf

LIMIT = '<limit lower="-2" upper="2" effort="1" velocity="1"/>'


def joint(name, kind, parent, child, axis="0 0 1", xyz="0 0 0", rpy="0 0 0", more=LIMIT):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{more}</joint>'
    )


def robot(*joints, links="abcde"):
    return "<robot name='r'>" + "".join(f"<link name='{n}'/>" for n in links) + "".join(joints) + "</robot>"


def rodrigues(axis, angle):
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


ARM = robot(
    joint("j1", "revolute", "a", "b", "1 2 -2", "0.1 0.2 0.3", "0.4 -0.5 0.6"),
    joint("j2", "continuous", "b", "c", "0 0 -1", "0 0 0.5", more=""),
    joint("j3", "prismatic", "c", "d", "0 -3 4", "0.05 0 0"),
    joint("tool", "fixed", "d", "e", xyz="0 0 0.07", rpy="0 1.5 0", more=""),
)


def test_arbitrary_axes_by_rodrigues():
    chain = chain_from_urdf(ARM)
    q = np.array([0.7, -1.1, 0.08])
    roll, pitch, yaw = (rodrigues(axis, a) for axis, a in zip(np.eye(3), (0.4, -0.5, 0.6), strict=True))
    p, rot = np.array([0.1, 0.2, 0.3]), yaw @ pitch @ roll @ rodrigues([1, 2, -2], q[0])
    p, rot = p + rot @ [0, 0, 0.5], rot @ rodrigues([0, 0, -1], q[1])
    p = p + rot @ [0.05, 0, 0] + rot @ (np.array([0, -0.6, 0.8]) * q[2]) + rot @ [0, 0, 0.07]
    rot = rot @ rodrigues([0, 1, 0], 1.5)
    pose = forward(chain, chain.params_nominal, q)
    np.testing.assert_allclose(pose[:3, 3], p, atol=1e-14)
    np.testing.assert_allclose(pose[:3, :3], rot, atol=1e-14)


def test_names_units_limits_if_any_and_frames():
    chain = chain_from_urdf(ARM)
    origin = [f"j1.{k}" for k in ("x", "y", "z", "yaw", "pitch", "roll", "offset", "gain")]
    assert list(chain.parameter_names[:8]) == origin
    assert [p.unit for p in chain.parameters[:8]] == ["m"] * 3 + ["rad"] * 4 + ["1"]
    assert list(chain.parameter_names[-6:]) == [f"tool.{k}" for k in ("x", "y", "z", "yaw", "pitch", "roll")]
    assert chain.parameters[chain.parameter_names.index("j3.offset")].unit == "m"
    assert [(j.name, j.kind, j.lower, j.upper) for j in chain.joints] == [
        ("j1", "revolute", -2.0, 2.0),
        ("j2", "revolute", -np.inf, np.inf),
        ("j3", "prismatic", -2.0, 2.0),
    ]
    assert (chain.name, chain.base_frame, chain.end_frame) == ("r", "a", "e")
    (hinge,) = chain_from_urdf(robot(joint("j1", "revolute", "a", "b", more=""), links="ab")).joints
    assert (hinge.lower, hinge.upper) == (-math.inf, math.inf)


def test_base_and_tip_choose_a_path_and_ignore_the_rest():
    mimic = '<mimic joint="j1"/>' + LIMIT
    text = robot(
        joint("j1", "revolute", "a", "b"),
        joint("j2", "revolute", "b", "c"),
        joint("finger", "prismatic", "b", "d", more=mimic),
        joint("free", "floating", "c", "e", more=""),
    )
    assert [j.name for j in chain_from_urdf(text, tip="c").joints] == ["j1", "j2"]
    assert [j.name for j in chain_from_urdf(text, base="b", tip="c").joints] == ["j2"]
    with pytest.raises(RobotError, match=r"2 end links.* d, e"):
        chain_from_urdf(text)
    assert [j.name for j in chain_from_urdf(text, tip="d").joints] == ["j1", "finger"]
    with pytest.raises(RobotError, match=r"free: .*floating"):
        chain_from_urdf(text, tip="e")


HOP = joint("j1", "revolute", "a", "b")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "valid XML"),
        ("<robot>", "valid XML"),
        ("<sdf/>", "starts with <sdf>"),
        ("<robot/>", "no links"),
        ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="arm.xacro"/></robot>', "<xacro:include>"),
        (robot(HOP, links="ab").replace("<robot", '<robot xmlns:x="http://ros.org/wiki/xacro"').replace("</robot>", '<x:gripper parent="b"/></robot>'), "<xacro:gripper>"),
        ("<!DOCTYPE robot []>" + robot(HOP, links="ab"), "document type"),
        ('<!DOCTYPE r [<!ENTITY a "1"><!ENTITY b "&a;&a;">]><robot name="&b;"/>', "document type"),
        ('<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot>&x;</robot>', "document type"),
        (robot(HOP, joint("j2", "revolute", "b", "a"), links="ab"), "no root links"),
        (robot(HOP, joint("j2", "revolute", "c", "d"), joint("j3", "revolute", "d", "c"), links="abcd"), "link 'c' form"),
            (robot(HOP, joint("j2", "revolute", "d", "c"), links="abcd"), "link 'c' .*link 'a'"),
        (robot(HOP, joint("j2", "revolute", "c", "b"), links="abc"), "more than one parent of link 'b'"),
        (robot(HOP, joint("j1", "revolute", "b", "c"), links="abc"), "more than one joint name 'j1'"),
        (robot(joint("j1", "ball", "a", "b"), links="ab"), "joint j1: type 'ball'"),
        (robot(joint("j1", "revolute", "a", "x"), links="ab"), "joint j1 .*link 'x'"),
        (robot(HOP.replace("<child link=\"b\"/>", ""), links="ab"), "no <child"),
        (robot(HOP.replace('name="j1"', ""), links="ab"), "joint without"),
        (robot(joint("j1", "revolute", "a", "b", xyz="0 nan 0"), links="ab"), "joint j1: origin xyz='0 nan 0'"),
        (robot(joint("j1", "revolute", "a", "b", xyz="0 inf 0"), links="ab"), "joint j1: origin xyz='0 inf 0'"),
        (robot(joint("j1", "revolute", "a", "b", xyz="0 0 333"), links="ab"), "larger than 100"),
        (robot(joint("j1", "revolute", "a", "b", xyz="0 0"), links="ab"), "needs 3 numbers"),
        (robot(joint("j1", "revolute", "a", "b", xyz="0_1 0 0"), links="ab"), "joint j1: origin xyz='0_1 0 0'"),
        (robot(joint("j1", "revolute", "a", "b", rpy="0 ${pi} 0"), links="ab"), "expand xacro"),
        (robot(joint("j1", "revolute", "a", "b", axis="0 0 0"), links="ab"), "joint j1: its axis"),
        (robot(joint("j1", "prismatic", "a", "b", more=""), links="ab"), "needs a <limit>"),
        (robot(joint("j1", "revolute", "a", "b", more='<limit lower="2" upper="1"/>'), links="ab"), "above its upper"),
        (robot(joint("j1", "fixed", "a", "b", more=""), links="ab"), "no joint moves"),
        (robot(links="a"), "same link"),
        (robot(HOP, links="ab") + " " * MAX_TEXT, "limit .* 8000000"),
        (robot(*[joint(f"j{i}", "revolute", f"l{i}", f"l{i + 1}") for i in range(70)], links=[f"l{i}" for i in range(71)]),
         "more than 64 joints"),
    ],
)  # fmt: skip
def test_bad_text_is_one_clear_line(text, says):
    tip = "c" if "'c'" in says else None
    with pytest.raises(RobotError, match=says) as caught:
        chain_from_urdf(text, base="a" if tip else None, tip=tip)
    assert "\n" not in str(caught.value)


def test_bases_and_tips_that_are_none():
    with pytest.raises(RobotError, match=r"no link 'flange'.* a, b"):
        chain_from_urdf(robot(HOP, links="ab"), tip="flange")
    with pytest.raises(RobotError, match="no link 'world'"):
        chain_from_urdf(robot(HOP, links="ab"), base="world")
    # Universal Robots' base hangs on base_link, as the arm does.
    text = robot(joint("j1", "revolute", "a", "b"), joint("beside", "fixed", "a", "d", more=""))
    with pytest.raises(RobotError, match=r"base 'a', .*'d'"):
        chain_from_urdf(text, base="d", tip="b")
    with pytest.raises(RobotError, match="no links"):
        chain_from_urdf("<robot>" + "<a>" * 200_000 + "</a>" * 200_000 + "</robot>")


def collision(shape, xyz="0 0 0", rpy="0 0 0"):
    return f'<collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry></collision>'


def with_shapes(**shapes):
    text = ARM
    for name, shape in shapes.items():
        text = text.replace(f"<link name='{name}'/>", f"<link name='{name}'>{shape}</link>")
    return text


def test_capsules_contain_the_collision_shapes_wherever_the_joints_are():
    """Corners of a box and rims of a cylinder, moved by the links' own poses: those of a chain that ends at the link."""
    half, radius, length = np.array([0.05, 0.3, 0.02]), 0.04, 0.4
    text = with_shapes(
        a=collision('<sphere radius="0.1"/>', "0 0 0.05"),
        c=collision('<box size="0.1 0.6 0.04"/>', "0.1 0 0", "0 0 0.3"),
        e=collision('<cylinder radius="0.04" length="0.4"/>', "0 0.02 0", "1 0 0"),
    )
    chain = chain_from_urdf(text)
    capsules = capsules_from_urdf(text, chain)
    assert capsules.joint == (0, 2, 3)
    q = np.array([0.7, -1.1, 0.08])
    frames = np.concatenate([np.eye(4)[None], joint_frames(chain, chain.params_nominal, q)])[list(capsules.joint)]
    ends = capsules.ends @ frames[:, :3, :3].swapaxes(1, 2) + frames[:, None, :3, 3]
    np.testing.assert_allclose(ends[0], [[0, 0, 0.05]] * 2)
    turn = np.linspace(0, 2 * np.pi, 40)
    rim = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(40, 0.5 * length)], axis=1)
    box = rodrigues([0, 0, 1], 0.3) @ (np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8) * half[:, None])
    cylinder = rodrigues([1, 0, 0], 1.0) @ np.concatenate([rim, -rim]).T
    for k, tip, points in ((1, "c", np.add(box.T, [0.1, 0, 0])), (2, "e", np.add(cylinder.T, [0, 0.02, 0]))):
        part = chain_from_urdf(text, tip=tip)
        pose = forward(part, part.params_nominal, q[: len(part.joints)])
        there = points @ pose[:3, :3].T + pose[:3, 3]
        along = ends[k, 1] - ends[k, 0]
        share = np.clip((there - ends[k, 0]) @ along / (along @ along), 0.0, 1.0)
        distance = np.linalg.norm(there - ends[k, 0] - share[:, None] * along, axis=1)
        np.testing.assert_allclose(distance, capsules.radius[k], rtol=1e-9)


def test_an_arm_of_meshes_has_no_capsules():
    for text in (ARM, with_shapes(b=collision('<sphere radius="0.1"/>'), c=collision('<mesh filename="c.stl"/>'))):
        assert capsules_from_urdf(text, chain_from_urdf(text)) is None
    for shape, word in (('<sphere radius="0"/>', "greater than 0"), ('<box size="1 2"/>', "needs 3 numbers")):
        text = with_shapes(b=collision(shape))
        with pytest.raises(RobotError, match=f"^URDF link b: collision: .*{word}"):
            capsules_from_urdf(text, chain_from_urdf(text))
