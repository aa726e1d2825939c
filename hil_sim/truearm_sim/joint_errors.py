"""What a true arm's joints do beyond geometry: gears that err with the joint's angle, joints that give under the arm's weight.

Both say how far the links stand from where the encoders read them, as a function of the joints alone. They are the simulator's own and
know nothing of the joint law that an identification fits (``truearm.model.joint_law``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from truearm.model.chain import Chain, forward, joint_frames
from truearm.model.transforms import axis_of
from truearm.types import Floats

GRAVITY = 9.80665  # m/s²
_PHASES = 0x6EA2  # of their random numbers, beside the seed


class JointError(Protocol):
    """An error of the joints that depends on the joints alone."""

    def at(self, q: Floats) -> Floats:
        """Return how far the links stand from their encoders (k, j) [rad, m] at encoder readings q (k, j)."""


@dataclass(frozen=True)
class GearError:
    """Sines of the joint's angle, one for each of n periods, all of one amplitude; the phases are each joint's own."""

    amplitude: float  # rad
    periods: Floats  # (n,) rad
    phases: Floats  # (n, j) rad

    @staticmethod
    def drawn(amplitude: float, periods: tuple[float, ...], joints: int, seed: int) -> GearError:
        """Return an error whose phases are drawn from the seed."""
        drawn = np.random.default_rng([seed, _PHASES]).uniform(0.0, 2.0 * np.pi, (len(periods), joints))
        return GearError(amplitude, np.array(periods), drawn)

    def at(self, q: Floats) -> Floats:
        """See ``JointError``."""
        turns = 2.0 * np.pi * q[:, None] / self.periods[:, None] + self.phases
        return np.asarray(self.amplitude * np.sin(turns).sum(axis=1))


@dataclass(frozen=True)
class Sag:
    """Joints as springs under the weight of the links: each link's mass lies halfway from its joint to the next, the last one's to the end.

    A joint yields by −(∂V/∂θ)/stiffness, V the potential energy; gravity is along −z of the base. Prismatic joints do not yield.
    """

    chain: Chain
    params: Floats  # (p,)
    masses: Floats  # (j,) kg, of the link that each joint moves
    stiffness: float  # N·m/rad

    def at(self, q: Floats) -> Floats:
        """See ``JointError``."""
        chain, params = self.chain, self.params
        frames = joint_frames(chain, params, q)
        origins = frames[:, :, :3, 3]
        far = np.concatenate([origins[:, 1:], forward(chain, params, q)[:, None, :3, 3]], axis=1)
        middles = 0.5 * (origins + far)
        out = np.zeros(q.shape)
        for i, motion in enumerate(chain.motions):
            if motion[0] == "r":
                axis = frames[:, i, :3, axis_of(motion)]
                levers = np.cross(axis[:, None], middles[:, i:] - origins[:, i : i + 1])
                out[:, i] = -GRAVITY / self.stiffness * (levers[..., 2] @ self.masses[i:])
        return np.asarray(out / chain.law.gain.of(params))
