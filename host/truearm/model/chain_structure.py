"""The structure of a chain: its elementary transforms, its parameters and its joints, without the joint law.

The terms of the joint law are built on this; ``model.chain`` adds the law and the kinematics.

**Mimic joints** have no encoder and move with another joint, as in the parallelogram of a palletizer. The reading of one is
``multiplier``·q + ``offset`` of the joint that it follows. Its true angle follows from this reading by its own law, so a
robot with mimic joints is an ordinary serial chain.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.model.transforms import Element, axis_of, cross, elementary, mixed
from truearm.types import Floats, Indices, Payload


class Mimic(NamedTuple):
    """What a mimic joint follows: the index of another joint, which mimics none."""

    followed: int
    multiplier: float
    offset: float  # rad or m


NO_MIMICS: Mapping[int, Mimic] = {}


def units_of(n_readings: int, joint_units: Sequence[str], mimics: Collection[int]) -> Sequence[str]:
    """Return the units of the readings of all joints, or of all that are not mimic joints if there are as many readings."""
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


# ----------------------------------------------------------------------------------------------------- constant folding
#
# What is equal for all poses, computed once for each set of params: the links (runs of constants) and the matrix that
# converts wrenches to derivatives by parameters (derived in chain.py). Twists and wrenches are ordered by axis here,
# (v_x, w_x, v_y, w_y, v_z, w_z), and likewise force and moment. A joint about an axis rotates two such pairs into each other
# and leaves the third unchanged.


class Constants(NamedTuple):
    """The c constants of a chain, in runs before, between and after its joints: j + 1 links."""

    axis: Indices  # (c,)
    turns: NDArray[np.bool_]  # (c,) about the axis; False: along it
    value: Floats  # (c,) of the fixed ones
    parameter: Indices  # (c,) −1 for the fixed ones
    inwards: Indices  # (longest run, j + 1) each link's constants, starting from its far end, padded with c
    named: Sequence[Indices]  # of each link: its constants that are parameters


class Columns(NamedTuple):
    """The b columns of ``wrenches``: the six in the base frame, then those that each joint adds, then those of its law."""

    of_law: Floats  # (p, b) 1 where a column is the derivative by a parameter of a joint's law
    changed: Sequence[
        tuple[list[int], Floats]
    ]  # of each joint: the wrench components that it changes, and their columns
    constant: tuple[
        Indices, Indices, Indices
    ]  # parameters of laws with ∂θ/∂parameter = 1, their joints, their components


class Basis(NamedTuple):
    """What the b columns of ``wrenches`` stand for; the first six are always the wrench in the base frame."""

    twists: Floats  # (b, p) ``wrenches`` @ twists are the derivatives by the parameters
    end: Floats  # (b, 6) ``wrenches`` @ end is the wrench in the frame of the last link
    direct: bool = False  # the derivatives are columns themselves (``direct_basis``)


class Folded(NamedTuple):
    """A chain's constants multiplied out for one set of params."""

    transforms: Floats  # (j + 1, 4, 4) the links
    carries: Floats  # (j + 1, 6, 6) a wrench from a link's near frame to its far frame
    basis: Basis


@cache
def direct_basis(p: int) -> Basis:
    """Return that of 6 + 6 + p columns: the wrench in the base frame, that at the end, the derivatives by p parameters."""
    return Basis(np.eye(12 + p, p, -12), np.eye(12 + p, 6, -6), direct=True)


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


def fold(constants: Constants, columns: Columns, params: Floats) -> Folded:
    """Return all constants multiplied out for params (p,)."""
    transforms, beyond = multiplied(constants, params)
    carries = _carries(transforms)
    twists, end = _combined(constants, columns, _twists_beyond(constants, beyond), carries)
    for array in (transforms, carries, twists, end):
        array.setflags(write=False)
    return Folded(transforms, carries, Basis(twists, end))


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


def _twists_beyond(constants: Constants, beyond: Floats) -> Floats:
    """Return Ad(B⁻¹)ξ (c, 6) for unit motions: w' = Rᵀw, v' = Rᵀ(v − t × w) with B = (R, t)."""
    rot, shift = beyond[:, :3, :3], beyond[:, :3, 3:]
    index, k, turns = np.arange(len(beyond)), constants.axis, constants.turns[:, None]
    a, b = (k + 1) % 3, (k + 2) % 3  # t × e_k = t_b e_a − t_a e_b
    axis = rot[index, k]
    lever = shift[index, a] * rot[index, b] - shift[index, b] * rot[index, a]
    return np.stack([np.where(turns, lever, axis), np.where(turns, axis, 0.0)], axis=2).reshape(-1, 6)


def _carries(transforms: Floats) -> Floats:
    """Return matrices (n, 6, 6) to frames (R, t): force' = Rᵀ force, moment' = Rᵀ(moment − t × force)."""
    rot, shift = transforms[:, :3, :3], transforms[:, :3, 3:]
    out = np.zeros((len(transforms), 3, 2, 3, 2), dtype=transforms.dtype)
    out[:, :, 0, :, 0] = out[:, :, 1, :, 1] = np.swapaxes(rot, 1, 2)
    lever = cross(np.moveaxis(shift, 1, 0), np.moveaxis(rot, 1, 0))  # −r·(t × f) = (t × r)·f for R's columns r
    out[:, :, 1, :, 0] = np.moveaxis(lever, 0, 2)
    return out.reshape(-1, 6, 6)


def _combined(constants: Constants, columns: Columns, twists_beyond: Floats, carries: Floats) -> tuple[Floats, Floats]:
    """Return ``twists`` (b, p), each parameter's twist times the wrench in its frame by the b columns of ``wrenches``, and ``end``."""
    wrenches = np.zeros((len(carries), 6, columns.of_law.shape[1]), dtype=twists_beyond.dtype)
    wrenches[0, :, :6] = carries[0]
    for i, (new, unit) in enumerate(columns.changed):
        next_wrench = wrenches[i].copy()
        next_wrench[new] = unit
        np.matmul(carries[i + 1], next_wrench, out=wrenches[i + 1])
    twists = columns.of_law.astype(twists_beyond.dtype)
    parameters, joints, axes = columns.constant
    twists[parameters] = wrenches[joints, axes]
    for members, wrench in zip(constants.named, wrenches, strict=True):
        twists[constants.parameter[members]] = twists_beyond[members] @ wrench
    return np.ascontiguousarray(twists.T), np.ascontiguousarray(wrenches[-1].T)


def on_axis(motion: str) -> int:
    """Return the index of the wrench component on a joint's axis: the force along it, or the moment about it."""
    return 2 * axis_of(motion) + (motion[0] == "r")


def new_numbers(motion: str) -> list[int]:
    """Return the wrench components that a joint changes: all across its axis, or only the moments if it is prismatic."""
    k = axis_of(motion)
    across = [i for axis in ((k + 1) % 3, (k + 2) % 3) for i in (2 * axis, 2 * axis + 1)]
    return across if motion[0] == "r" else across[1::2]


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
