"""Gain: the true motion of a joint per unit of its reading."""

from __future__ import annotations

from truearm.model.joint_terms.term import Term
from truearm.types import Floats


class Gain(Term):
    """gain·q; for a joint without a parameter the gain is 1."""

    name = "gain"
    unit = "1"
    neutral = 1.0
    affine = True
    nonzero = True

    def value(self, params: Floats, q: Floats) -> Floats:
        return self.of(params)[:, None] * q

    def by_joints(self, params: Floats, q: Floats) -> Floats:
        return self.of(params)[:, None]

    def by_parameters(self, params: Floats, q: Floats) -> Floats:
        return q if self.of_every_joint else q[self.joints]


TERM = Gain
