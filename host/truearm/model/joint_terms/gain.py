"""Gain: by how much a joint truly moves where its reading moves by one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from truearm.model.joint_terms.term import Term
from truearm.types import Floats

if TYPE_CHECKING:
    from truearm.model.chain import Chain


class Gain(Term):
    """gain·q; of a joint without a parameter the gain is 1."""

    name = "gain"
    unit = "1"
    neutral = 1.0
    affine = True
    nonzero = True

    def __init__(self, chain: Chain, parameters: NDArray[np.intp]) -> None:
        super().__init__(chain, parameters)
        self._n_joints = len(chain.joints)

    def of(self, params: Floats) -> Floats:
        """(j,) the joints' gains."""
        if self.of_every_joint:
            return np.asarray(params[self.parameters])
        out = np.ones(self._n_joints, dtype=np.result_type(params, float))
        out[self.joints] = params[self.parameters]
        return out

    def value(self, params: Floats, q: Floats) -> Floats:
        return self.of(params)[:, None] * q

    def by_joints(self, params: Floats, q: Floats) -> Floats:
        return self.of(params)[:, None]

    def by_parameters(self, params: Floats, q: Floats) -> Floats:
        return q if self.of_every_joint else q[self.joints]


TERM = Gain
