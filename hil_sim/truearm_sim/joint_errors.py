"""Errors of a true arm's joints beyond geometry: gear errors by the angle, and joints that yield under weight.

Both are offsets of the links from the encoder readings, as a function of the joints alone. They belong to the simulator
and are independent of the joint law that an identification fits (``truearm.model.joint_law``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from truearm.model.chain import Chain, forward, joint_frames
from truearm.model.transforms import axis_of
from truearm.types import Floats

GRAVITY = 9.80665  # m/s²
_PHASES = 0x6EA2  # of their random numbers, in addition to the seed


class JointError(Protocol):
    """An error of the joints that depends only on the joints."""

    def at(self, q: Floats) -> Floats:
        """Return the offset of the links from their encoders (k, j) [rad, m] at encoder readings q (k, j)."""


@dataclass(frozen=True)
class GearError:
    """Sines of the joint's angle, one for each of n periods, all with one amplitude; each joint has its own phases."""

    amplitude: float  # rad
    periods: Floats  # (n,) rad
    phases: Floats  # (n, j) rad

    @staticmethod
    def drawn(amplitude: float, periods: tuple[float, ...], joints: int, seed: int) -> GearError:
        """Return an error whose phases are random, from the seed."""
        drawn = np.random.default_rng([seed, _PHASES]).uniform(0.0, 2.0 * np.pi, (len(periods), joints))
        return GearError(amplitude, np.array(periods), drawn)

    def at(self, q: Floats) -> Floats:
        """See ``JointError``."""
        turns = 2.0 * np.pi * q[:, None] / self.periods[:, None] + self.phases
        return np.asarray(self.amplitude * np.sin(turns).sum(axis=1))


@dataclass(frozen=True)
class Sag:
    """Joints as springs under the weight of the links.

    The mass of each link lies halfway from its joint to the next; that of the last, halfway to the end. A joint yields
    by −(∂V/∂θ)/stiffness, where V is the potential energy; gravity is along −z of the base. Prismatic joints do not
    yield.
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
