"""The structure of a chain: its elementary transforms, its parameters and its joints, without the joint law.

The terms of the joint law are built on this; ``model.chain`` adds the law and the kinematics.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from truearm.model.constant_folding import Constants, constants_of, multiplied
from truearm.model.mimic import Mimic, completed
from truearm.model.transforms import Element
from truearm.types import Floats, Indices, Payload

GEOMETRY = "geometry"
NO_PAYLOAD = Payload(0.0)


@dataclass(frozen=True)
class Parameter:
    """A named constant of the robot; ``unit`` is its SI unit, ``nominal`` its design value.

    ``term`` is what it belongs to: "geometry" (a link between joints), or a term of the law of the ``joint`` (an
    index): "offset", "gain" or the name of another of ``joint_law.terms``. ``basis`` holds the data that the term needs
    about the parameter.
    """

    name: str
    unit: str
    nominal: float
    term: str = GEOMETRY
    joint: int | None = None
    basis: tuple[float, ...] = ()


@dataclass(frozen=True)
class Joint:
    """A joint; ``kind`` is "revolute" or "prismatic", and the limits are those of the joint reading q [rad or m].

    The reading of a joint with a ``mimic`` follows from that of another joint.
    """

    name: str
    kind: str
    lower: float
    upper: float
    mimic: Mimic | None = None


@dataclass(frozen=True)
class Structure:
    """Elementary transforms from the base frame to the end frame, with the parameters and joints they refer to.

    ``payload`` acts on the sag of joints, where an identification found how.
    """

    name: str
    elements: tuple[Element, ...]
    parameters: tuple[Parameter, ...]
    joints: tuple[Joint, ...]
    base_frame: str = "base"
    end_frame: str = "end"
    payload: Payload = NO_PAYLOAD

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @cached_property
    def joint_units(self) -> tuple[str, ...]:
        """Return "rad" or "m" for each joint."""
        return tuple("m" if joint.kind == "prismatic" else "rad" for joint in self.joints)

    @cached_property
    def mimics(self) -> dict[int, Mimic]:
        """Return what each mimic joint follows, by its index."""
        return {index: joint.mimic for index, joint in enumerate(self.joints) if joint.mimic is not None}

    @cached_property
    def motors(self) -> list[int]:
        """Return the joints that are not mimic joints."""
        return [index for index, joint in enumerate(self.joints) if joint.mimic is None]

    def completed(self, q: Floats) -> Floats:
        """Return the readings of all joints (…, j), from those of all joints or of the motors alone."""
        return completed(q, self.mimics, len(self.joints))

    @cached_property
    def first_moved(self) -> Indices:
        """Return the first link (p,) that each parameter moves: link k follows k joints, and the last one is the end."""
        first = np.array([0 if p.joint is None else p.joint + 1 for p in self.parameters], dtype=np.intp)
        for joints, members in enumerate(self.constants.named):
            first[self.constants.parameter[members]] = min(joints + 1, len(self.joints))
        return first

    @cached_property
    def limits(self) -> Floats:
        """Return the lower and upper limits (2, j) of the joint readings [rad or m], infinite where there is none."""
        limits = np.array([(joint.lower, joint.upper) for joint in self.joints], dtype=float).reshape(-1, 2).T
        limits.setflags(write=False)
        return limits

    @cached_property
    def params_nominal(self) -> Floats:
        """Return the design values (p,), read-only."""
        nominal = np.array([p.nominal for p in self.parameters], dtype=float)
        nominal.setflags(write=False)
        return nominal

    @cached_property
    def movers(self) -> tuple[Element, ...]:
        """Return the elements of the j joints."""
        return tuple(e for e in self.elements if e.joint is not None)

    @cached_property
    def motions(self) -> tuple[str, ...]:
        """Return the joints' motions (j,), such as "rz" for a rotation about z."""
        return tuple(mover.motion for mover in self.movers)

    @cached_property
    def constants(self) -> Constants:
        """Return the elements that are not joints."""
        return constants_of(self.elements)

    def links(self, params: Floats) -> Floats:
        """Return the transforms (j + 1, 4, 4) before, between and after the joints, for params (p,)."""
        return multiplied(self.constants, params)[0]
