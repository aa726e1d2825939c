"""The robot in the lab: its true parameters, as opposed to its controller's model, and its speed.

The truth is random about the design: each length and angle that the robot file allows to be identified has its own
tolerance, as in a manufacturer's drawing. Encoders count whole turns, so gains are as designed. The PUMA 560 is the one
that Goswami measured (Table II).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from truearm.model.chain_structure import GEOMETRY
from truearm.model.joint_terms.term import Offset
from truearm.model.robot import Robot
from truearm.types import Floats
from truearm_sim.arm import Arm

PAPER = "puma560"  # moves as the PUMA 560 does, and has the rig of the paper
MEASURED = "optimised"  # the set of parameters that is the truth if a robot file has one
JOINT_SPEED, JOINT_ACCELERATION = 1.2, 5.0  # rad/s, rad/s², of other arms
SLIDE_SPEED, SLIDE_ACCELERATION = 0.3, 1.0  # m/s, m/s², of their prismatic joints
_TRUTH = 0x7207  # of the truth's random numbers, in addition to the seed


@dataclass(frozen=True)
class Tolerance:
    """Standard deviations of a true arm's lengths [m] and angles [rad] about the design."""

    length: float = 5e-4
    angle: float = 2e-3

    def of(self, unit: str) -> float:
        """Return the standard deviation by a parameter's unit; 0 for a ratio."""
        return {"m": self.length, "rad": self.angle}.get(unit, 0.0)


def true_params(robot: Robot, seed: int, tolerance: Tolerance | None = None) -> Floats:
    """Return the true parameters (p,): the measured ones of a robot file unless a tolerance is given.

    Otherwise random ones.

    The random ones depend on the seed.
    """
    if tolerance is None and MEASURED in robot.parameter_sets:
        return robot.parameter_sets[MEASURED]
    tolerance = tolerance or Tolerance()
    chain = robot.chain
    drawn = np.array([p.term in (GEOMETRY, Offset.name) for p in chain.parameters]) & robot.free
    sigma = np.array([tolerance.of(p.unit) for p in chain.parameters]) * drawn
    normal = np.random.default_rng([seed, _TRUTH]).standard_normal(len(sigma))
    return np.asarray(chain.params_nominal + sigma * normal)


def moving(robot: Robot, arm: Arm | None = None) -> Arm:
    """Return an arm, a stiff one by default, with this robot's speed and with its backlash on all joints."""
    arm = arm or Arm()
    joints = robot.chain.joints
    if arm.backlash:
        arm = replace(arm, backlash=tuple(np.resize(arm.backlash, len(joints)).tolist()))
    if robot.chain.name == PAPER:
        return arm
    slides = [joint.kind == "prismatic" for joint in joints]
    return replace(
        arm,
        speed=tuple(SLIDE_SPEED if slide else JOINT_SPEED for slide in slides),
        acceleration=tuple(SLIDE_ACCELERATION if slide else JOINT_ACCELERATION for slide in slides),
    )
