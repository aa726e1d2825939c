"""Offset: the joint's true angle when the sum of the other terms is zero."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from truearm.model.joint_terms.term import Term
from truearm.types import Floats

if TYPE_CHECKING:
    from truearm.model.chain import Chain


class Offset(Term):
    """A constant [rad or m]; for a joint without a parameter it is the fixed ``value`` of the joint's element."""

    name = "offset"
    unit = None
    affine = True
    constant = True

    def __init__(self, chain: Chain, parameters: NDArray[np.intp]) -> None:
        super().__init__(chain, parameters)
        self.without = np.array([mover.value for mover in chain.movers])

    def value(self, params: Floats, q: Floats) -> Floats:
        return self.of(params)[:, None]

    def by_joints(self, params: Floats, q: Floats) -> Floats:
        return np.zeros((len(self.without), 1))

    def by_parameters(self, params: Floats, q: Floats) -> Floats:
        return np.ones((len(self.parameters), 1))


TERM = Offset
