"""The chain compared with independent matrix products, and its derivatives with complex steps and differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from truearm.errors import RobotError
from truearm.model.chain import (
    Chain,
    about,
    along,
    forward,
    joint_frames,
    link_frames,
    point_forward,
    point_jacobians,
    trace_link,
    trace_point,
)
from truearm.model.chain_structure import Joint, Parameter
from truearm.model.law_chain import with_laws
from truearm.model.robot_file import builtin_robot
from truearm.model.transforms import MOTIONS, Element, cos_sin
from truearm.types import SagMasses

AMOUNT = st.floats(-3.0, 3.0, allow_nan=False)


@st.composite
def chains(draw):
    """Any mix of named constants, fixed constants and joints, with and without gain and offset parameters."""
    elements, parameters, joints = [], [], []

    def name_a_parameter(unit, nominal, *law):
        parameters.append(Parameter(f"p{len(parameters)}", unit, nominal, *law))
        return len(parameters) - 1

    for kind in draw(st.lists(st.sampled_from("cfj"), min_size=1, max_size=14)):
        motion, amount = draw(st.sampled_from(MOTIONS)), draw(AMOUNT)
        unit = "m" if motion[0] == "t" else "rad"
        if kind == "f":
            elements.append(Element(motion, amount))
            continue
        if kind == "c":
            elements.append(Element(motion, parameter=name_a_parameter(unit, amount)))
            continue
        if draw(st.booleans()):
            name_a_parameter(unit, amount, "offset", len(joints))
        if draw(st.booleans()):
            name_a_parameter("1", draw(st.floats(0.5, 2.0)), "gain", len(joints))
        elements.append(Element(motion, amount, joint=len(joints)))
        joints.append(Joint(f"q{len(joints)}", "prismatic" if unit == "m" else "revolute", -3.0, 3.0))
    return Chain("random", tuple(elements), tuple(parameters), tuple(joints))


def product(chain, params, q):
    """T_base_end of one pose as a plain product of matrices."""
    out = np.eye(4)
    for e in chain.elements:
        amount = e.value if e.parameter is None else params[e.parameter]
        if e.joint is not None:
            law = {p.term: params[i] for i, p in enumerate(chain.parameters) if p.joint == e.joint}
            amount = law.get("offset", e.value) + law.get("gain", 1.0) * q[e.joint]
        out = out @ plain(e.motion, amount)
    return out


def plain(motion, amount):
    c, s = np.cos(amount), np.sin(amount)
    rotations = {"rx": [[1, 0, 0], [0, c, -s], [0, s, c]], "ry": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}
    rotations["rz"] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    out = np.eye(4, dtype=np.result_type(amount, float))
    if motion in rotations:
        out[:3, :3] = rotations[motion]
    else:
        out[MOTIONS.index(motion), 3] = amount
    return out


@settings(max_examples=60, deadline=None, derandomize=True)
@given(chain=chains(), data=st.data())
def test_forward_is_the_product_of_the_elements(chain, data):
    q = np.array(data.draw(st.lists(AMOUNT, min_size=len(chain.joints), max_size=len(chain.joints))), dtype=float)
    expected = product(chain, chain.params_nominal, q)
    # Lengths below 3 m times 14 factors: rounding stays below 14 · 42 m · eps.
    np.testing.assert_allclose(forward(chain, chain.params_nominal, q), expected, atol=1e-13)
    p_end = np.array([0.3, -0.2, 0.5])
    moved = (expected @ np.append(p_end, 1.0))[:3]
    np.testing.assert_allclose(point_forward(chain, chain.params_nominal, q, p_end), moved, atol=1e-13)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(chain=chains(), seed=st.integers(0, 2**32 - 1))
def test_jacobians_are_complex_steps_and_central_differences(chain, seed):
    rng = np.random.default_rng(seed)
    q, p_end, params = rng.uniform(-3, 3, (2, len(chain.joints))), rng.uniform(-1, 1, (2, 3)), chain.params_nominal
    _, jac_params, jac_joints = point_jacobians(chain, params, q, p_end)

    def p_base(params, q):
        return np.array([(product(chain, params, q[i]) @ np.append(p_end[i], 1.0))[:3] for i in range(2)])

    for i in range(params.size):
        up, down, step = params.copy(), params.copy(), params.astype(complex)
        up[i], down[i], step[i] = params[i] + 1e-5, params[i] - 1e-5, params[i] + 1e-30j
        # Central differences: h²/6 times a third derivative of at most 50 m, plus eps·50 m/h.
        np.testing.assert_allclose(jac_params[..., i], (p_base(up, q) - p_base(down, q)) / 2e-5, atol=1e-8)
        np.testing.assert_allclose(jac_params[..., i], p_base(step, q).imag / 1e-30, atol=1e-12)
    for i in range(q.shape[1]):
        step = q.astype(complex)
        step[:, i] += 1e-30j
        np.testing.assert_allclose(jac_joints[..., i], p_base(params, step).imag / 1e-30, atol=1e-12)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(chain=chains(), seed=st.integers(0, 2**32 - 1))
def test_along_is_the_point_jacobian_read_along_a_direction(chain, seed):
    rng = np.random.default_rng(seed)
    q, p_end, u = rng.uniform(-3, 3, (4, len(chain.joints))), rng.uniform(-1, 1, 3), rng.normal(size=(4, 3))
    _, jac_params, jac_joints = point_jacobians(chain, chain.params_nominal, q, p_end)
    rows = along(trace_point(chain, chain.params_nominal, q, p_end), u)
    np.testing.assert_allclose(rows.jac_params, np.einsum("nc,ncp->np", u, jac_params), atol=1e-12)
    np.testing.assert_allclose(rows.jac_joints, np.einsum("nc,ncj->nj", u, jac_joints), atol=1e-12)
    rot = forward(chain, chain.params_nominal, q)[:, :3, :3]
    np.testing.assert_allclose(rows.jac_point, np.einsum("nc,nck->nk", u, rot), atol=1e-12)


def check_links(chain, params, rng):
    """Compare derivatives of points and directions on all links with complex steps."""
    j = len(chain.joints)
    link = np.arange(1, j + 1)
    q, point, u = rng.uniform(-3, 3, (j, j)), rng.uniform(-1, 1, (j, 3)), rng.normal(size=(j, 3))
    trace = trace_link(chain, params, q, link, point)
    moved, turned = along(trace, u), about(trace, u)

    def moves(params, q):
        """The points along u, and the frames' derivatives by the imaginary part."""
        frames = link_frames(chain, params, q, link)
        at = np.einsum("nik,nk->ni", frames[:, :3, :3], point) + frames[:, :3, 3]
        spin = frames[:, :3, :3].imag @ frames[:, :3, :3].real.swapaxes(1, 2)
        axis = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        return (at.imag * u).sum(axis=1) / 1e-30, (axis * u).sum(axis=1) / 1e-30

    for i in range(params.size):
        step = moves(params + 1e-30j * (np.arange(params.size) == i), q)
        np.testing.assert_allclose((moved.jac_params[:, i], turned.jac_params[:, i]), step, atol=1e-12)
    for i in range(j):
        step = moves(params, q + 1e-30j * (np.arange(j) == i))
        np.testing.assert_allclose((moved.jac_joints[:, i], turned.jac_joints[:, i]), step, atol=1e-12)
    frames = link_frames(chain, params, q, link)
    np.testing.assert_allclose(frames[-1], forward(chain, params, q[-1]), atol=1e-13)
    np.testing.assert_allclose(moved.jac_point, np.einsum("ni,nik->nk", u, frames[:, :3, :3]), atol=1e-12)
    end = moved.wrenches[-1] @ moved.basis.end  # force and moment in the frame of the end, axis by axis
    np.testing.assert_allclose(end[::2], moved.jac_point[-1], atol=1e-12)
    assert not (moved.wrenches[:-1] @ moved.basis.end).any()


@settings(max_examples=30, deadline=None, derandomize=True)
@given(chain=chains(), seed=st.integers(0, 2**32 - 1))
def test_points_of_any_link(chain, seed):
    if chain.joints:
        check_links(chain, chain.params_nominal, np.random.default_rng(seed))


def test_points_of_any_link_of_an_arm_that_sags():
    """The weight beyond a joint twists it, so a link moves with joints beyond it."""
    sags = [SagMasses(joint, (3, 6), (0.0, 0.0, -1.0)) for joint in (1, 2)]
    chain = with_laws(builtin_robot("puma560").chain, sags)
    check_links(chain, chain.params_nominal + 1e-3, np.random.default_rng(8))


def test_a_link_that_is_not_there():
    with pytest.raises(RobotError):
        link_frames(scara(), scara().params_nominal, np.zeros((2, 3)), np.array([1, 4]))


def test_cosine_and_sine_by_the_half_angle():
    rng = np.random.default_rng(4)
    turns = np.pi * np.arange(-6, 7) / 2
    angle = np.concatenate([turns, turns + 1e-9, np.nextafter(turns, 9), rng.uniform(-1e3, 1e3, 1000)])
    # Four roundings of 1.1e-16, and the tangent's own (up to 4 units in the last place).
    np.testing.assert_allclose(np.stack(cos_sin(angle)), np.stack([np.cos(angle), np.sin(angle)]), atol=1e-15)


def scara():
    """Two revolute joints and a prismatic one along −z, whose gain is not a parameter."""
    elements = (
        Element("rz", joint=0),
        Element("tx", parameter=2),
        Element("rz", joint=1),
        Element("tx", 0.3),
        Element("rx", np.pi),
        Element("tz", joint=2),
    )
    named = (
        ("t1.offset", "rad", 0.0, "offset", 0),
        ("t1.gain", "1", 1.0, "gain", 0),
        ("a1", "m", 0.4),
        ("t3.offset", "m", 0.1, "offset", 2),
    )
    joints = (Joint("t1", "revolute", -3, 3), Joint("t2", "revolute", -3, 3), Joint("t3", "prismatic", 0, 0.2))
    return Chain("scara", elements, tuple(Parameter(*n) for n in named), joints)


def test_batches_of_any_shape():
    chain, rng = scara(), np.random.default_rng(1)
    q = rng.uniform(-1, 1, (2, 5, 3))
    pose = forward(chain, chain.params_nominal, q)
    assert pose.shape == (2, 5, 4, 4)
    assert joint_frames(chain, chain.params_nominal, q).shape == (2, 5, 3, 4, 4)
    p_base, jac_params, jac_joints = point_jacobians(chain, chain.params_nominal, q, np.zeros(3))
    assert (p_base.shape, jac_params.shape, jac_joints.shape) == ((2, 5, 3), (2, 5, 3, 4), (2, 5, 3, 3))
    one = point_jacobians(chain, chain.params_nominal, q[1, 3], np.zeros(3))
    for batched, single in zip((p_base, jac_params, jac_joints), one, strict=True):
        np.testing.assert_allclose(batched[1, 3], single, atol=1e-15)


def test_a_scara_and_its_joint_frames_by_hand():
    pose = forward(scara(), scara().params_nominal, np.array([np.pi / 2, -np.pi / 2, 0.05]))
    np.testing.assert_allclose(pose[:3, 3], [0.3, 0.4, -0.15], atol=1e-15)
    np.testing.assert_allclose(pose[:3, 2], [0, 0, -1], atol=1e-15)
    chain = scara()
    frames = joint_frames(chain, chain.params_nominal, np.array([np.pi / 2, 0.0, 0.0]))
    np.testing.assert_allclose(frames[1, :3, 3], [0.0, 0.4, 0.0], atol=1e-15)
    np.testing.assert_allclose(frames[2, :3, 3], [0.0, 0.7, -0.1], atol=1e-15)


def test_names_shapes_and_whole_numbers():
    elements = (Element("tx", parameter=0), Element("tx", parameter=1), Element("rz", joint=0))
    with pytest.raises(RobotError, match="same name"):
        Chain("bad", elements, 2 * (Parameter("x", "m", 0.0),), (Joint("a", "revolute", -1, 1),))
    chain = scara()
    with pytest.raises(RobotError, match="3 joints"):
        forward(chain, chain.params_nominal, np.zeros(4))
    with pytest.raises(RobotError, match="4 parameters"):
        forward(chain, np.zeros(5), np.zeros(3))
    # Integer params must not cut a fixed constant, 0.7 rad, to 0.
    elements = (Element("rx", 0.7), Element("tx", parameter=0), Element("rz", joint=0), Element("ty", 0.5))
    chain = Chain("c", elements, (Parameter("a", "m", 0.0),), (Joint("j", "revolute", -3.0, 3.0),))
    np.testing.assert_array_equal(forward(chain, np.array([1]), np.array([2])), forward(chain, [1.0], [2.0]))
    whole, real = (
        point_jacobians(chain, np.array([1], kind), np.array([[2]], kind), np.zeros(3)) for kind in (int, float)
    )
    for a, b in zip(whole, real, strict=True):
        np.testing.assert_array_equal(a, b)
