"""Arms as capsules: they enclose the arm according to independent kinematics, and collisions are found."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.host import plan_bench as bench

from truearm.model.chain import forward, joint_frames
from truearm.model.robot_file import builtin_names, builtin_robot
from truearm.plan.measurement_limits import SHORT, Sizes, along_joints, clear, link_ends, make_shapes, segment_distance
from truearm.types import Point, Rig


def rigid(axis, angle, place):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
    pose[:3, 3] = place
    return pose


def turned(angle):
    return rigid((0, 0, 1), angle, (0, 0, 0))


def ur5e_links(q):
    """Poses of the links shoulder, upper arm, forearm, wrist 1 and wrist 2 as Universal_Robots_ROS2_Description places them
    (config/ur5e/default_kinematics.yaml), in the frame "base", half a turn from "base_link"."""
    shoulder = rigid((0, 0, 1), 0.0, (0, 0, 0.1625)) @ turned(q[0])
    upper = shoulder @ rigid((1, 0, 0), np.pi / 2, (0, 0, 0)) @ turned(q[1])
    fore = upper @ rigid((1, 0, 0), 0.0, (-0.425, 0, 0)) @ turned(q[2])
    wrist1 = fore @ rigid((1, 0, 0), 0.0, (-0.3922, 0, 0.1333)) @ turned(q[3])
    wrist2 = wrist1 @ rigid((1, 0, 0), np.pi / 2, (0, -0.0997, 0)) @ turned(q[4])
    return shoulder, upper, fore, wrist1, wrist2


DESCRIBED = {name: links for name in builtin_names() if (links := builtin_robot(name).capsules) is not None}

# Points on the surfaces of links, in their frames: of a tube of 55 mm about the upper arm's axis, 138 mm beside the joints', of
# one of 45 mm about the forearm's, 7 mm beside, of the housings' flat ends (from the collision meshes' outermost planes).
UR5E_SURFACE = [
    (
        1,
        [
            (x, 0.055 * np.cos(a), 0.138 + 0.055 * np.sin(a))
            for x in np.linspace(-0.4, 0.0, 9)
            for a in np.linspace(0, 6, 9)
        ],
    ),
    (1, [(x, 0.0, z) for x in (0.0, -0.425) for z in (0.06, 0.21)]),
    (
        2,
        [
            (x, 0.045 * np.cos(a), 0.007 + 0.045 * np.sin(a))
            for x in np.linspace(-0.39, 0.0, 9)
            for a in np.linspace(0, 6, 9)
        ],
    ),
    (3, [(0.0, 0.0, -0.0733), (0.0, 0.0, 0.0387), (0.039, 0.0, 0.0)]),
    (4, [(0.0, 0.053, 0.0), (0.0, -0.057, 0.0), (0.0, 0.0, 0.039)]),
]


def puma560_links(q):
    """Poses of column, shoulder, upper arm, forearm and wrist from Fu, Gonzalez, Lee (1987), table 2.1: x along the upper
    arm and the forearm, z along axes 2 and 3 away from the column, at the column's axis for the upper arm."""
    shoulder = rigid((0, 0, 1), q[0], (0, 0, 0.6604))
    upper = shoulder @ rigid((1, 0, 0), -np.pi / 2, (0, 0, 0)) @ turned(q[1])
    fore = upper @ rigid((0, 0, 1), q[2] - np.pi / 2, (0.4318, 0, 0.14909)) @ rigid((0, 0, 1), 0.0, (0, -0.02032, 0))
    wrist = fore @ rigid((1, 0, 0), 0.0, (0.43307, 0, 0)) @ rigid((1, 0, 0), q[3], (0, 0, 0))
    return np.eye(4), shoulder, upper, fore, wrist


# Corners of the housings, from the meshes of nimasarli/puma560_description: the column, 150 mm thick; the shoulder's tube about axis 2;
# the upper arm's plate, 305 mm wide behind the elbow; the forearm, 150 mm wide at the elbow and 90 mm at the wrist; the wrist's tube.
PUMA560_SURFACE = [
    (0, [(0.075 * np.cos(a), 0.075 * np.sin(a), z) for a in np.linspace(0, 6, 9) for z in (0.0, 0.3, 0.58)]),
    (
        1,
        [
            (0.076 * np.cos(a), y, 0.076 * np.sin(a))
            for a in np.linspace(0, np.pi, 7)
            for y in np.linspace(-0.095, 0.18, 6)
        ],
    ),
    (2, [(x, y, z) for x, y in ((-0.17, 0.152), (0.05, 0.152), (0.43, 0.076), (0.495, 0.0)) for z in (0.195, 0.294)]),
    (2, [(x, -y, z) for x, y in ((-0.17, 0.152), (0.05, 0.152), (0.43, 0.076), (-0.228, 0.0)) for z in (0.195, 0.294)]),
    (3, [(x, y, z) for x, y in ((-0.1, 0.075), (-0.1, -0.075), (-0.148, 0.0)) for z in (-0.045, 0.045)]),
    (3, [(0.35, y, z) for y in (-0.043, 0.043) for z in (-0.045, 0.045)]),
    (4, [(x, 0.044 * np.cos(a), 0.044 * np.sin(a)) for a in np.linspace(0, 6, 9) for x in (-0.07, 0.04)]),
]


@pytest.mark.parametrize(
    ("name", "links_of", "surface"), [("ur5e", ur5e_links, UR5E_SURFACE), ("puma560", puma560_links, PUMA560_SURFACE)]
)
def test_an_arm_is_inside_its_capsules(name, links_of, surface):
    known = bench.known(name)
    shapes = make_shapes(known.chain, known.params, Rig(), Sizes(), known.links)
    q = np.random.default_rng(1).uniform(-3.0, 3.0, (20, 6))
    ends, radius = link_ends(shapes, q)[0], shapes.links.radius
    for posture, capsules in zip(q, ends, strict=True):
        links = links_of(posture)
        for link, points in surface:
            p = np.array(points) @ links[link][:3, :3].T + links[link][:3, 3]
            apart = segment_distance(p[:, None], p[:, None], capsules[:, 0], capsules[:, 1]) - radius
            assert apart.min(axis=1).max() < 1e-3


@pytest.mark.parametrize("name", builtin_names())
def test_an_arm_without_capsules_is_lines_through_its_joints(name):
    """Every joint's origin lies on them at any posture, but for SHORT."""
    chain = builtin_robot(name).chain
    shapes = make_shapes(chain, chain.params_nominal, Rig(), Sizes())
    q = np.random.default_rng(2).uniform(-1.0, 1.0, (10, len(chain.joints)))
    ends, _ = link_ends(shapes, q)
    origins = [*joint_frames(chain, chain.params_nominal, q)[:, :, :3, 3].swapaxes(0, 1)]
    for p in (np.zeros((10, 3)), *origins, forward(chain, chain.params_nominal, q)[:, :3, 3]):
        apart = segment_distance(p[:, None], p[:, None], ends[:, :, 0], ends[:, :, 1])
        assert apart.min(axis=1).max() <= SHORT + 1e-12
    assert (shapes.links.radius == Sizes().link).all()


def test_a_tables_arm_reaches_as_far_as_its_joints():
    """A slip of the hand in a table would leave a joint's origin bare; 150 mm is a UR5e's elbow beside its joint."""
    for name, links in DESCRIBED.items():
        chain = builtin_robot(name).chain
        plain = along_joints(chain, chain.params_nominal, 0.05)
        assert links.joint == tuple(sorted(links.joint))
        assert set(plain.joint) <= set(links.joint)
        q = np.zeros((1, len(chain.joints)))
        shapes = make_shapes(chain, chain.params_nominal, Rig(), Sizes(), links)
        ends = link_ends(shapes, q)[0][0]
        for p in joint_frames(chain, chain.params_nominal, q)[0, 1:, :3, 3]:
            apart = segment_distance(p, p, ends[:, 0], ends[:, 1]) - links.radius
            assert apart.min() < 0.1


def test_what_stands_in_the_way_of_a_sideways_upper_arm_is_found():
    """A post in the upper arm's tube, 138 mm beside the joints; and one as far on the other side, where nothing is."""
    known = bench.known("ur5e")
    q = np.deg2rad([[0.0, -20.0, -30.0, -40.0, -90.0, 0.0]])
    upper = ur5e_links(q[0])[1]
    for beside, free in ((0.138, False), (-0.138, True)):
        x, y, z = (upper @ np.array([-0.3, 0.0, beside, 1.0]))[:3].tolist()
        rig = Rig(chucks={"c": Point("c", (x, y, z))})
        assert clear(make_shapes(known.chain, known.params, rig, Sizes(), known.links), q, None)[0] == free
        shapes = make_shapes(known.chain, known.params, rig, Sizes())
        assert clear(shapes, q, None)[0]  # which lines through the joints would not
