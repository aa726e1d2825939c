"""The nominal robot without further terms of its joint law, for terms that need the arm's geometry.

A term is part of the law and cannot ask it for joint angles. Here these are offset and gain alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from truearm.model.constant_folding import link_transforms
from truearm.model.frames import far_frames
from truearm.model.joint_terms.gain import Gain
from truearm.model.joint_terms.offset import Offset
from truearm.types import Floats

if TYPE_CHECKING:
    from truearm.model.chain import Chain


class NominalArm:
    """A chain of j joints with its nominal parameters; ``motions`` are the joints'."""

    def __init__(self, chain: Chain) -> None:
        self.motions = chain.motions
        self._params = chain.params_nominal
        self._links = link_transforms(chain, self._params)
        self._offset, self._gain = Offset.of_chain(chain), Gain.of_chain(chain)

    def frames(self, q: Floats) -> list[Floats]:
        """Frames (n, 4, 4) in the base frame at readings q (j, n): each joint's after its motion (j of them), then the end."""
        angles = self._offset.value(self._params, q) + self._gain.value(self._params, q)
        return far_frames(self._links, self.motions, angles.T)

    def by_joints(self, q: Floats) -> Floats:
        """(j, 1) by how much each joint moves where its reading moves by one."""
        return self._gain.by_joints(self._params, q)
