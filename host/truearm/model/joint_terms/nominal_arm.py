"""The nominal robot with offset and gain only, for terms of the joint law that need the arm's geometry.

A term is part of the joint law, so it cannot obtain joint angles from it. Here the law consists of offset and gain.
"""

from __future__ import annotations

from truearm.model.chain_frames import far_frames
from truearm.model.chain_structure import Structure
from truearm.model.joint_terms.gain import Gain
from truearm.model.joint_terms.offset import Offset
from truearm.types import Floats


class NominalArm:
    """A chain of j joints with its nominal parameters; ``motions`` are those of the joints."""

    def __init__(self, structure: Structure) -> None:
        self.motions = structure.motions
        self._params = structure.params_nominal
        self._links = structure.links(self._params)
        self._offset, self._gain = Offset.of_chain(structure), Gain.of_chain(structure)

    def frames(self, q: Floats) -> list[Floats]:
        """Return frames (n, 4, 4) in the base frame at readings q (j, n): each joint's after its motion, then the end."""
        angles = self._offset.value(self._params, q) + self._gain.value(self._params, q)
        return far_frames(self._links, self.motions, angles.T)

    def by_joints(self, q: Floats) -> Floats:
        """Return the motion of each joint per unit of its reading, (j, 1)."""
        return self._gain.by_joints(self._params, q)
