"""The structure of a chain: its elementary transforms, its parameters and its joints, without the joint law.

The terms of the joint law are built on this; ``model.chain`` adds the law and the kinematics.

**Mimic joints** have no encoder and move with another joint, as in the parallelogram of a palletizer. The reading of
one is ``multiplier``·q + ``offset`` of the joint that it follows. Its true angle follows from this reading by its own
law, so a robot with mimic joints is an ordinary serial chain.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.model.transforms import Element, axis_of, elementary, mixed
from truearm.types import Floats, Indices, Payload


class Mimic(NamedTuple):
    """What a mimic joint follows: the index of another joint, which mimics none."""

    followed: int
    multiplier: float
    offset: float  # rad or m


NO_MIMICS: Mapping[int, Mimic] = {}


def units_of(n_readings: int, joint_units: Sequence[str], mimics: Collection[int]) -> Sequence[str]:
    """Return the units of the readings of all joints, or of all that are not mimic joints if there are so many."""
    if n_readings != len(joint_units) - len(mimics):
        return joint_units
    return [unit for joint, unit in enumerate(joint_units) if joint not in mimics]


def completed(q: Floats, mimics: Mapping[int, Mimic], n_joints: int) -> Floats:
    """Return the readings of all joints (…, j), from those of all joints or of all that are not mimic joints.

    ``mimics``: by joint. The readings of mimic joints in ``q`` are not used.
    """
    if not mimics:
        return q
    moving = [joint for joint in range(n_joints) if joint not in mimics]
    readings = np.empty((*q.shape[:-1], n_joints), q.dtype)
    readings[..., moving] = q[..., moving] if q.shape[-1] == n_joints else q
    for joint, (followed, multiplier, offset) in mimics.items():
        readings[..., joint] = multiplier * readings[..., followed] + offset
    return readings


class Constants(NamedTuple):
    """The c constants of a chain, in runs before, between and after its joints: j + 1 links."""

    axis: Indices  # (c,)
    turns: NDArray[np.bool_]  # (c,) about the axis; False: along it
    value: Floats  # (c,) of the fixed ones
    parameter: Indices  # (c,) −1 for the fixed ones
    inwards: Indices  # (longest run, j + 1) each link's constants, starting from its far end, padded with c
    named: Sequence[Indices]  # of each link: its constants that are parameters


def constants_of(elements: Sequence[Element]) -> Constants:
    """Return the elements that are not joints, as arrays."""
    constant = np.array([e.joint is None for e in elements], dtype=bool)
    link = np.cumsum(~constant)[constant]
    fixed = [e for e in elements if e.joint is None]
    runs = [np.flatnonzero(link == i)[::-1] for i in range(len(elements) - len(fixed) + 1)]
    inwards = np.full((max(map(len, runs)), len(runs)), len(fixed), dtype=np.intp)
    for i, run in enumerate(runs):
        inwards[: len(run), i] = run
    parameter = np.array([-1 if e.parameter is None else e.parameter for e in fixed], dtype=np.intp)
    return Constants(
        axis=np.array([axis_of(e.motion) for e in fixed], dtype=np.intp),
        turns=np.array([e.motion[0] == "r" for e in fixed], dtype=bool),
        value=np.array([e.value for e in fixed]),
        parameter=parameter,
        inwards=inwards,
        named=[np.flatnonzero((link == i) & (parameter >= 0)) for i in range(len(runs))],
    )


def _amounts(constants: Constants, params: Floats) -> Floats:
    """Return the lengths and angles (c,) of the constants."""
    named = constants.parameter >= 0
    amount = constants.value.astype(params.dtype)
    amount[named] = params[constants.parameter[named]]
    return amount


def multiplied(constants: Constants, params: Floats) -> tuple[Floats, Floats]:
    """Return the links (j + 1, 4, 4) and, for each constant, the product (c, 4, 4) of what follows it in its link.

    All links are processed together, each starting from its far end: one by one, 54 constants would take four times as
    long.
    """
    amount = _amounts(constants, params)
    transforms = np.concatenate([mixed(constants.axis, constants.turns, amount), np.eye(4)[None]])
    beyond = np.empty_like(transforms)
    product = np.broadcast_to(np.eye(4, dtype=transforms.dtype), (constants.inwards.shape[1], 4, 4))
    for row in constants.inwards:
        beyond[row] = product
        product = transforms[row] @ product
    return product.copy(), beyond[:-1]


# ------------------------------------------------------------------------------------------------- frames along a chain


def far_frames(links: Floats, motions: Sequence[str], angles: Floats) -> list[Floats]:
    """Return frames (…, 4, 4) in the base frame: each joint's after its motion (j of them), then the end.

    links : (j + 1, 4, 4) constants before, between and after the joints. motions : "tx" … "rz" of each joint. angles :
    (…, j) true angles or positions [rad or m].
    """
    frame = np.broadcast_to(links[0], (*angles.shape[:-1], 4, 4))
    frames = []
    for i, motion in enumerate(motions):
        frame = frame @ elementary(motion, angles[..., i])
        frames.append(frame)
        frame = frame @ links[i + 1]
    return [*frames, frame]


# -------------------------------------------------------------------------------------------------------- the structure

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
        """Return the first link (p,) that each parameter moves: link k follows k joints, the last one is the end."""
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
