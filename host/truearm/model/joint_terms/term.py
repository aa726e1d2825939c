"""What a term of the joint law has to say of itself; ``model.joint_law`` adds the terms up and has their registry.

A term's file names its class as ``TERM``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

if TYPE_CHECKING:
    from truearm.model.chain import Chain


class Term(ABC):
    """One term of the joint law, for those joints of a chain that have parameters of it.

    Joint readings q are (j, n) here, joints first: θ = Σ terms is computed for thousands of poses at once, and what belongs
    to one joint lies together. Complex params or q must pass through unharmed, so that a complex step checks derivatives.

    A term that needs the robot's geometry takes the nominal one from ``chain`` (``constant_folding.link_transforms``, ``frames.far_frames``): θ may depend
    on all joint readings, but not on the identified links, whose derivatives would otherwise be incomplete.
    """

    name: ClassVar[str]  # of the term, the last part of its parameters' names, and its key in a robot file's [jointN]
    unit: ClassVar[str | None]  # SI unit of its parameters; None: that of the joint's motion
    neutral: ClassVar[float] = 0.0  # the parameters' value at which the term says nothing
    affine: ClassVar[bool] = False  # its ∂θ/∂q is diagonal and the same for all q
    constant: ClassVar[bool] = False  # its ∂θ/∂parameter is 1 for all q
    nonzero: ClassVar[bool] = False  # 0 is no possible value of its parameters
    learned: ClassVar[bool] = (
        False  # an identification adds it to a chain (``model.law_chain``); robot files have no key of it
    )

    def __init__(self, chain: Chain, parameters: NDArray[np.intp]) -> None:
        """``parameters`` (m,): indices of the chain's parameters of this term, in their order."""
        self.parameters = parameters
        self.joints = np.array([chain.parameters[i].joint for i in parameters], dtype=np.intp)  # (m,)
        self.of_every_joint = np.array_equal(self.joints, np.arange(len(chain.joints)))  # one parameter each, in order
        self.without = np.full(len(chain.joints), self.neutral)  # (j,) the values of joints that have no parameter

    @classmethod
    def of_chain(cls, chain: Chain) -> Self:
        """Return the term with all its parameters of a chain."""
        mine = [i for i, parameter in enumerate(chain.parameters) if parameter.term == cls.name]
        return cls(chain, np.array(mine, dtype=np.intp))

    @classmethod
    def unit_of(cls, joint_kind: str) -> str:
        """SI unit of the parameters of a joint, "revolute" or "prismatic"."""
        return cls.unit or ("m" if joint_kind == "prismatic" else "rad")

    def of(self, params: Floats) -> Floats:
        """(j,) the joints' parameters, for a term of one parameter a joint."""
        if self.of_every_joint:
            return np.asarray(params[self.parameters])
        out = self.without.astype(np.result_type(params, float))
        out[self.joints] = params[self.parameters]
        return out

    @abstractmethod
    def value(self, params: Floats, q: Floats) -> Floats:
        """What the term adds to the joints' true angles or positions, (j, n) or (j, 1) [rad or m]."""

    @abstractmethod
    def by_joints(self, params: Floats, q: Floats) -> Floats:
        """∂value/∂q: (j, n) or (j, 1) where each joint's value depends on its own reading alone, else (j, j, n)."""

    @abstractmethod
    def by_parameters(self, params: Floats, q: Floats) -> Floats:
        """(m, n) ∂value/∂parameter, of the joint that the parameter belongs to; not asked of a ``constant`` term."""
