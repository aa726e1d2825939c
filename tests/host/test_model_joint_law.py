"""The joint law: values by hand, derivatives by complex steps, the inverse; also with a further, coupled term."""

from dataclasses import replace

import numpy as np
import pytest
from term_bench import register

from truearm.errors import RobotError
from truearm.model.chain import forward, joint_jacobian, point_forward, point_jacobians
from truearm.model.chain_structure import Parameter
from truearm.model.robot import parse_robot
from truearm.model.robot_file import builtin_robot
from truearm.model.robot_mounting import mountings, own_law

H = 1e-30  # of a complex step: no cancellation


@pytest.fixture
def further_terms(monkeypatch):
    register(monkeypatch)


def with_terms(chain, *terms):
    """Return the chain with a further parameter for each (term, joint)."""
    more = [Parameter(f"more{i}", "rad", 0.0, *law) for i, law in enumerate(terms)]
    return replace(chain, name=f"{chain.name} and {terms}", parameters=(*chain.parameters, *more))


COUPLED = (("sway", 1), ("ripple", 4), ("ripple", 2), ("sway", 4), ("ripple", 4))


def cases(rng):
    """Return chains with laws of every kind, and params away from special values."""
    puma, ur = builtin_robot("puma560").chain, builtin_robot("ur10e").chain
    for chain in (puma, ur, with_terms(puma, *COUPLED), with_terms(ur, ("ripple", 0)), with_terms(ur, ("sway", 5))):
        yield chain, chain.params_nominal + rng.uniform(-0.05, 0.05, len(chain.parameters))


def test_a_points_derivatives_go_through_the_law(further_terms):
    rng = np.random.default_rng(2)
    for chain, params in cases(rng):
        q, p_end = rng.uniform(-3, 3, (3, len(chain.joints))), np.array([0.1, -0.2, 0.3])
        point, jac_params, jac_joints = point_jacobians(chain, params, q, p_end)
        np.testing.assert_allclose((forward(chain, params, q) @ [*p_end, 1.0])[..., :3], point, atol=1e-13)
        for k, step in enumerate(1j * H * np.eye(len(params))):
            moved = point_forward(chain, params + step, q, p_end).imag / H
            np.testing.assert_allclose(jac_params[..., k], moved, atol=1e-12)
        end = forward(chain, params, q)
        jac_end = joint_jacobian(chain, params, q)
        for k, step in enumerate(1j * H * np.eye(q.shape[1])):
            moved = point_forward(chain, params, q + step, p_end).imag / H
            np.testing.assert_allclose(jac_joints[..., k], moved, atol=1e-12)
            rate = forward(chain, params, q + step).imag / H
            spin = rate[:, :3, :3] @ np.swapaxes(end[:, :3, :3], -1, -2)
            np.testing.assert_allclose(jac_end[:, :3, k], rate[:, :3, 3], atol=1e-12)
            np.testing.assert_allclose(jac_end[:, 3:, k], spin[:, (2, 0, 1), (1, 2, 0)], atol=1e-12)


def test_the_inverse_comes_back(further_terms):
    rng = np.random.default_rng(4)
    for chain, params in cases(rng):
        q = rng.uniform(-3, 3, (500, len(chain.joints)))
        angles = chain.law.angles(params, q)
        np.testing.assert_allclose(chain.law.readings(params, angles), q, atol=1e-12)
        np.testing.assert_allclose(chain.law.readings(params, angles, near=q + 0.1), q, atol=1e-12)


def test_near_a_singular_law_the_inverse_is_right_or_none(further_terms):
    """a·sin(q) with a = −1 stands still at q = 0: close to it the inverse is ill-conditioned, but what it says is true."""
    chain = with_terms(builtin_robot("ur10e").chain, ("ripple", 2))
    params = chain.params_nominal.copy()
    params[-1] = -1.0
    q = np.zeros((4, 6))
    q[:, 2] = 0.0, 1e-4, 0.3, 1.0
    angles = chain.law.angles(params, q)
    found = chain.law.readings(params, angles)
    said = ~np.isnan(found).any(axis=1)
    assert said[2:].all()
    np.testing.assert_allclose(found[2:], q[2:], atol=1e-9)
    np.testing.assert_allclose(chain.law.angles(params, found[said]), angles[said], atol=1e-9)
    params[-1] = 30.0  # turns back and forth: where the way there ends nowhere, nothing is said
    angles = chain.law.angles(params, np.random.default_rng(6).uniform(-3, 3, (200, 6)))
    found = chain.law.readings(params, angles)
    said = ~np.isnan(found).any(axis=1)
    np.testing.assert_allclose(chain.law.angles(params, found[said]), angles[said], atol=1e-9)


def test_what_has_no_inverse_loses_no_other_pose(further_terms):
    chain = with_terms(builtin_robot("ur10e").chain, ("sway", 1))
    params = chain.params_nominal.copy()
    params[-1] = 0.01
    angles = np.zeros((3, 6))
    angles[1] = np.nan
    found = chain.law.readings(params, angles)
    assert np.isnan(found[1]).all()
    assert np.isfinite(found[[0, 2]]).all()
    chain = parse_robot(PLANAR).chain
    params = chain.params_nominal.copy()
    params[chain.parameter_names.index("joint1.gain")] = 0.0
    assert not np.isfinite(chain.law.readings(params, np.array([0.5, 0.1]))[0])


def test_mountings_take_offsets_out_whatever_the_law(further_terms):
    """T_i(q) = B·R(q)·E with R's law that of ``own_law``: exact, with a coupled term on the first and the last joint too."""
    rng = np.random.default_rng(7)
    chain = with_terms(builtin_robot("puma560").chain, ("sway", 0), ("ripple", 5))
    nominal = chain.params_nominal
    identified = nominal + rng.uniform(-0.1, 0.1, nominal.size)
    own = own_law(chain, nominal, identified)
    changed = [chain.parameter_names[i] for i in np.flatnonzero(own != identified)]
    assert changed == ["joint1.offset", "joint6.offset"]
    links = [i for i, name in enumerate(chain.parameter_names) if name.startswith(("link1.", "link7."))]
    own[links] = nominal[links]
    q = rng.uniform(-2, 2, (20, 6))
    found = mountings(chain, nominal, identified)
    expected = found.base @ forward(chain, own, q) @ found.tool
    np.testing.assert_allclose(forward(chain, identified, q), expected, atol=1e-13)


def test_a_robot_file_names_a_further_term(further_terms):
    robot = parse_robot(
        PLANAR.replace("gain = { design = -2.0 }", "gain = { design = -2.0 }\nsway_deg = { design = 0.0 }")
    )
    at = robot.chain.parameter_names.index("joint1.sway")
    assert robot.chain.parameters[at] == Parameter("joint1.sway", "rad", 0.0, "sway", 0)
    assert robot.chain.parameter_names[at - 1] == "joint1.gain"
    with pytest.raises(RobotError, match="transform: item 1: sway_deg: must be"):
        parse_robot(PLANAR.replace("gain = { design = -2.0 }", "gain = { design = -2.0 }\nsway_deg = 0.0"))


PLANAR = """
name = "planar"
convention = "elementary"
nominal = "design"
base_frame = "base"
end_frame = "end"
[[transform]]
motion = "rz"
joint = "joint1"
lower_deg = -180.0
upper_deg = 180.0
offset_rad = { design = 0.1 }
gain = { design = -2.0 }
[[transform]]
motion = "tx"
name = "arm"
amount_m = { design = 0.5 }
[[transform]]
motion = "tx"
joint = "joint2"
lower_m = 0.0
upper_m = 1.0
offset_m = { design = 0.3 }
"""
