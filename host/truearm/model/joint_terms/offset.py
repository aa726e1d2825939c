"""Offset: the joint's true angle when the sum of the other terms is zero."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain_structure import Structure
from truearm.model.joint_terms.term import Term
from truearm.types import Floats


class Offset(Term):
    """A constant [rad or m]; for a joint without a parameter it is the fixed ``value`` of the joint's element."""

    name = "offset"
    unit = None
    affine = True
    constant = True

    def __init__(self, structure: Structure, parameters: NDArray[np.intp]) -> None:
        super().__init__(structure, parameters)
        self.without = np.array([mover.value for mover in structure.movers])

    def value(self, params: Floats, q: Floats) -> Floats:
        return self.of(params)[:, None]

    def by_joints(self, params: Floats, q: Floats) -> Floats:
        return np.zeros((len(self.without), 1))

    def by_parameters(self, params: Floats, q: Floats) -> Floats:
        return np.ones((len(self.parameters), 1))


TERM = Offset
