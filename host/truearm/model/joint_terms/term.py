"""The interface of a term of the joint law, and what every law has: offset and gain.

``model.joint_law`` adds the terms up and contains their registry. Every other term has a file, which names its class as
``TERM``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain_structure import Structure, far_frames
from truearm.types import Floats


class Term(ABC):
    """One term of the joint law, for those joints of a chain that have parameters of it.

    Joint readings q are (j, n) here, joints first: θ = Σ terms is computed for thousands of poses at once, and the
    values of one joint are contiguous. Complex params or q must be propagated, so that a complex step can check
    derivatives.

    A term that needs the robot's geometry uses the nominal one (``structure.links(structure.params_nominal)``,
    ``chain_structure.far_frames``). θ may depend on all joint readings but not on the identified links; otherwise the
    derivatives by these would be incomplete.
    """

    name: ClassVar[str]  # name of the term: last part of its parameters' names and key in a robot file's [jointN]
    unit: ClassVar[str | None]  # SI unit of its parameters; None: that of the joint's motion
    neutral: ClassVar[float] = 0.0  # value of the parameters at which the term has no effect
    affine: ClassVar[bool] = False  # its ∂θ/∂q is diagonal and the same for all q
    constant: ClassVar[bool] = False  # its ∂θ/∂parameter is 1 for all q
    nonzero: ClassVar[bool] = False  # 0 is not a possible value of its parameters
    # added to a chain by an identification (``model.law_chain``); not a key of robot files
    learned: ClassVar[bool] = False

    def __init__(self, structure: Structure, parameters: NDArray[np.intp]) -> None:
        """Create the term for ``parameters`` (m,): indices of the chain's parameters of this term, in order."""
        self.parameters = parameters
        self.joints = np.array([structure.parameters[i].joint for i in parameters], dtype=np.intp)  # (m,)
        # whether each joint has one parameter, in order
        self.of_every_joint = np.array_equal(self.joints, np.arange(len(structure.joints)))
        self.without = np.full(len(structure.joints), self.neutral)  # (j,) the values for joints without a parameter

    @classmethod
    def of_chain(cls, structure: Structure) -> Self:
        """Return the term with all its parameters in a chain."""
        indices = [i for i, parameter in enumerate(structure.parameters) if parameter.term == cls.name]
        return cls(structure, np.array(indices, dtype=np.intp))

    @classmethod
    def unit_of(cls, joint_kind: str) -> str:
        """Return the SI unit of the parameters of a "revolute" or "prismatic" joint."""
        return cls.unit or ("m" if joint_kind == "prismatic" else "rad")

    def of(self, params: Floats) -> Floats:
        """Return the joints' parameters (j,), for a term with one parameter per joint."""
        if self.of_every_joint:
            return np.asarray(params[self.parameters])
        out = self.without.astype(np.result_type(params, float))
        out[self.joints] = params[self.parameters]
        return out

    @abstractmethod
    def value(self, params: Floats, q: Floats) -> Floats:
        """Return the term's contribution to the joints' true angles or positions, (j, n) or (j, 1) [rad or m]."""

    @abstractmethod
    def by_joints(self, params: Floats, q: Floats) -> Floats:
        """Return ∂value/∂q: (j, n) or (j, 1) if each joint's value depends on its own reading only, else (j, j, n)."""

    @abstractmethod
    def by_parameters(self, params: Floats, q: Floats) -> Floats:
        """Return ∂value/∂parameter (m, n) of the joint of each parameter; not called for a ``constant`` term."""


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


class NominalArm:
    """A chain of j joints with its nominal parameters; ``motions`` are those of the joints."""

    def __init__(self, structure: Structure) -> None:
        self.motions = structure.motions
        self._params = structure.params_nominal
        self._links = structure.links(self._params)
        self._offset, self._gain = Offset.of_chain(structure), Gain.of_chain(structure)

    def frames(self, q: Floats) -> list[Floats]:
        """Return frames (n, 4, 4) in the base frame at readings q (j, n): each joint's once moved, then the end's."""
        angles = self._offset.value(self._params, q) + self._gain.value(self._params, q)
        return far_frames(self._links, self.motions, angles.T)

    def by_joints(self, q: Floats) -> Floats:
        """Return the motion of each joint per unit of its reading, (j, 1)."""
        return self._gain.by_joints(self._params, q)
