"""The interface of a term of the joint law. ``model.joint_law`` adds the terms up and contains their registry.

A term's file names its class as ``TERM``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain_structure import Structure
from truearm.types import Floats


class Term(ABC):
    """One term of the joint law, for those joints of a chain that have parameters of it.

    Joint readings q are (j, n) here, joints first: θ = Σ terms is computed for thousands of poses at once, and the
    values of one joint are contiguous. Complex params or q must be propagated, so that a complex step can check
    derivatives.

    A term that needs the robot's geometry uses the nominal one (``structure.links(structure.params_nominal)``,
    ``chain_frames.far_frames``). θ may depend on all joint readings but not on the identified links; otherwise the
    derivatives by these would be incomplete.
    """

    name: ClassVar[str]  # name of the term: last part of its parameters' names and key in a robot file's [jointN]
    unit: ClassVar[str | None]  # SI unit of its parameters; None: that of the joint's motion
    neutral: ClassVar[float] = 0.0  # value of the parameters at which the term has no effect
    affine: ClassVar[bool] = False  # its ∂θ/∂q is diagonal and the same for all q
    constant: ClassVar[bool] = False  # its ∂θ/∂parameter is 1 for all q
    nonzero: ClassVar[bool] = False  # 0 is not a possible value of its parameters
    learned: ClassVar[bool] = (
        False  # added to a chain by an identification (``model.law_chain``); not a key of robot files
    )

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
        """Return ∂value/∂q: (j, n) or (j, 1) if each joint's value depends only on its own reading, otherwise (j, j, n)."""

    @abstractmethod
    def by_parameters(self, params: Floats, q: Floats) -> Floats:
        """Return ∂value/∂parameter (m, n) of the joint of each parameter; not called for a ``constant`` term."""
