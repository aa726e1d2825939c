"""The robot in the form that formats need: every joint about or along the z axis of its own frame, without mountings.

    T(q) = B · S_0 · Z_1(θ_1) · S_1 · … · Z_j(θ_j) · S_j · E

B and E are the mountings (``model.mountings``), S_i rigid constants, Z_i a rotation about z or a motion along it, and θ
the true joint angles by the joint law.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from truearm.errors import RobotError
from truearm.model.chain import Chain
from truearm.model.chain_frames import far_frames
from truearm.model.chain_structure import Joint
from truearm.model.joint_law import JointLaw
from truearm.model.joint_terms.term import Term
from truearm.model.robot_mounting import NONE, mountings, own_law, own_links
from truearm.model.transforms import elementary
from truearm.types import Floats

# transforms that turn z into the axis of a motion
_TO_AXIS = {"x": elementary("ry", 0.5 * np.pi), "y": elementary("rx", -0.5 * np.pi), "z": np.eye(4)}


class LinkFrames(NamedTuple):
    """A robot of j joints."""

    name: str
    joints: tuple[Joint, ...]
    links: Floats  # (j + 1, 4, 4) S
    law: JointLaw
    params: Floats  # (p,) of the law, without offsets that are mountings
    base: Floats  # (4, 4) B
    tool: Floats  # (4, 4) E
    base_frame: str
    end_frame: str

    @property
    def offsets(self) -> Floats:
        """Offsets (j,) [rad or m]."""
        return self.law.offset.of(self.params)

    @property
    def gains(self) -> Floats:
        """Gains (j,)."""
        return self.law.gain.of(self.params)

    @property
    def further_terms(self) -> tuple[Term, ...]:
        """The terms of the law other than offset and gain; ``params[term.parameters]`` are for ``term.joints``."""
        return tuple(term for term in self.law.terms if term not in (self.law.offset, self.law.gain))

    @property
    def first(self) -> Floats:
        """The transform before the first joint, including the mounting."""
        return np.asarray(self.base @ self.links[0])

    @property
    def last(self) -> Floats:
        """The transform after the last joint, including the mounting."""
        return np.asarray(self.links[-1] @ self.tool)


def link_frames(chain: Chain, nominal: Floats, calibrated: Floats, with_mountings: bool = True) -> LinkFrames:
    """Return the robot with calibrated parameters (p,); its mountings are relative to the nominal parameters (p,).

    With ``with_mountings`` False they are left out: B and E are then identities.
    """
    links = own_links(chain, nominal, calibrated)
    axes = [np.eye(4), *(_TO_AXIS[motion[1]] for motion in chain.motions), np.eye(4)]
    turned = np.stack(
        [axis.T @ link @ next_axis for link, (axis, next_axis) in zip(links, pairwise(axes), strict=True)]
    )
    mounted = mountings(chain, nominal, calibrated) if with_mountings else NONE
    return LinkFrames(
        name=chain.name,
        joints=chain.joints,
        links=turned,
        law=chain.law,
        params=own_law(chain, nominal, calibrated),
        base=mounted.base,
        tool=mounted.tool,
        base_frame=chain.base_frame,
        end_frame=chain.end_frame,
    )


def predicted(robot: LinkFrames, q: Floats) -> Floats:
    """Return T(q), (n, 4, 4), at joint readings q (n, j)."""
    links = np.stack([robot.first, *robot.links[1:-1], robot.last])
    motions = ["tz" if joint.kind == "prismatic" else "rz" for joint in robot.joints]
    return far_frames(links, motions, robot.law.angles(robot.params, q))[-1]


def joint_motion(joint: Joint, amount: float) -> Floats:
    """Return Z (4, 4)."""
    return elementary("tz" if joint.kind == "prismatic" else "rz", amount)


def check_gains(robot: LinkFrames, format_name: str) -> None:
    """Raise RobotError for a gain other than 1, which ``format_name`` cannot store."""
    for joint, gain in zip(robot.joints, robot.gains, strict=True):
        if gain != 1.0:
            raise RobotError(f"joint {joint.name} has gain {gain:g}, but {format_name} has no gains; refit with gain 1")
