"""Sag: the deflection of a joint under the weight that it carries, with unknown masses, on the nominal geometry.

    δθ_i = Σ_k s_ik · g·(axis_i × (p_k − origin_i))

p_k are the origins of the frames of further joints and of the end. The sum is the torque of unit masses there. s_ik is
joint i's compliance times the mass at p_k [rad per kg·m, with g of length 1]. The parameter of (i, k) has ``basis`` (k,
gx, gy, gz), where g is the direction of gravity in the base frame.

k counts frames: 0 to n − 1 are those of the n joints, n is the end, and n + 1 is the centre of the chain's payload. The
mass of the payload is known, so that the parameter of (i, n + 1) is the compliance of joint i alone.

Like a curve, a sag has no key in a robot file: ``model.law_chain`` adds it to a chain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain_structure import Structure
from truearm.model.joint_terms.term import NominalArm, Term
from truearm.model.transforms import axis_of, cross
from truearm.types import Floats


class Sag(Term):
    """s_ik [rad per kg·m]: the rotation of joint i per torque of a unit mass at frame k, or of the payload."""

    name = "sag"
    unit = "rad"
    learned = True

    def __init__(self, structure: Structure, parameters: NDArray[np.intp]) -> None:
        super().__init__(structure, parameters)
        self._arm = NominalArm(structure)
        basis = np.array([structure.parameters[i].basis for i in parameters]).reshape(-1, 4)
        self._frames, self._gravity = basis[:, 0].astype(int), basis[:, 1:]
        self._payload = structure.payload
        self._mass = np.where(self._frames > len(structure.joints), self._payload.mass, 1.0)

    def value(self, params: Floats, q: Floats) -> Floats:
        torque = self._torques(q)
        out = np.zeros(q.shape, np.result_type(params, torque))
        np.add.at(out, self.joints, params[self.parameters][:, None] * torque)
        return out

    def by_joints(self, params: Floats, q: Floats) -> Floats:
        frames, rates = self._arm.frames(q), self._arm.by_joints(q)
        axes, origins = self._lines(frames)
        out = np.zeros((len(q), *q.shape), np.result_type(params, frames[0]))
        for row, (i, k) in enumerate(zip(self.joints, self._frames, strict=True)):
            gravity = self._gravity[row, :, None]
            pull, moment = cross(gravity, axes[i]), cross(axes[i], origins[k] - origins[i])
            for mover, motion in enumerate(self._arm.motions[:k] if k < len(q) else self._arm.motions):
                if motion[0] == "t" and mover <= i:  # a slide before the joint moves joint and mass
                    continue
                if motion[0] == "t":
                    by = pull * axes[mover]
                elif mover >= i:
                    by = pull * cross(axes[mover], origins[k] - origins[mover])
                else:  # rotates joint and mass equally
                    by = cross(gravity, axes[mover]) * moment
                compliance = params[self.parameters[row]] * self._mass[row]
                out[i, mover] += compliance * rates[mover] * by.sum(axis=0)
        return out

    def by_parameters(self, params: Floats, q: Floats) -> Floats:
        return self._torques(q)

    def _torques(self, q: Floats) -> Floats:
        """Return torques (m, n) [kg·m] of unit masses and of the payload, with gravity of length 1."""
        axes, origins = self._lines(self._arm.frames(q))
        rows = [
            mass * (cross(gravity[:, None], axes[i]) * (origins[k] - origins[i])).sum(axis=0)
            for i, k, gravity, mass in zip(self.joints, self._frames, self._gravity, self._mass, strict=True)
        ]
        return np.stack(rows) if rows else np.zeros((0, q.shape[1]))

    def _lines(self, frames: list[Floats]) -> tuple[list[Floats], list[Floats]]:
        """Return axes of the joints, and origins of all frames with the payload's centre after them, (3, n) each."""
        axes = [frame[:, :3, axis_of(motion)].T for frame, motion in zip(frames, self._arm.motions, strict=False)]
        payload = frames[-1][:, :3, :3] @ np.array(self._payload.centre) + frames[-1][:, :3, 3]
        ends = (frame[:, :3, 3] for frame in frames)
        return [np.ascontiguousarray(axis) for axis in axes], [np.ascontiguousarray(p.T) for p in (*ends, payload)]


TERM = Sag
