"""The parameter vector after a step: numbers are added, orientations are rotated, and the base moves along a screw.

docs/explanation/estimation.md has the formulas. If Δ were added to a rotation vector, a step that only rolls a line
device about its own axis would also tilt it, by the square of the roll. That valley would be too strongly curved for a
fit.

Rotating the base about a line through nearly collinear chucks, together with the chucks, changes no length. With ξ =
(ω, v) the twist of the base by Δ, the base moves by exp(ξ), and a point c beside it to

    exp(ξ) c + Δ_c − (ω × c + v) ,

which is c + Δ_c to first order. Where numbers are added, a step may only be so long that its arcs deviate from their
tangents by less than the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import takewhile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.circumstances import first_alike
from truearm.estimate.problem import Problem
from truearm.model.chain import Chain
from truearm.model.chain_structure import constants_of
from truearm.model.transforms import mixed, screw, skew, turned
from truearm.types import Floats, Indices

Step = Callable[[Floats, Floats], Floats]  # x (k,) and Δ (k,) to the new x
STRAIGHT = 1e-5  # rad: the arc of such a turn deviates from its tangent by 0.05 nm at a metre
NEWTON_STEPS = 8  # from parameters that are added to those of the base's pose
NEAR = 1e-6  # rad, m: the next of Newton's steps leaves about the square of it


def added(x: Floats, delta: Floats) -> Floats:
    """Return x + Δ."""
    return x + delta


def stepper(problem: Problem, columns: NDArray[np.bool_]) -> Step:
    """Return the step of x[columns]; an orientation, base or point with a fixed number is added to."""
    turning = _free_triples(columns, [group.orientations() for group in problem.groups])
    base = _base(problem.chain, columns)
    beside = _free_triples(columns, [group.beside_base() for group in problem.groups])
    if turning.size == 0 and base is None:
        return added

    def step(x: Floats, delta: Floats) -> Floats:
        moved = x + delta
        if turning.size:
            moved[turning] = turned(x[turning], delta[turning])
        return moved if base is None else _with_base(base, beside, x, moved)

    return step


def _free_triples(columns: NDArray[np.bool_], candidates: Sequence[Indices]) -> Indices:
    """Return the indices (r, 3) in x[columns] of those ``candidates`` (·, 3) that are free parameters, each once.

    Candidates are triples of indices in x (P,), or from P on for numbers that are known.
    """
    triples = np.concatenate([np.zeros((0, 3), dtype=np.intp), *candidates])
    free = triples[np.append(columns, False)[np.minimum(triples, columns.size)].all(axis=1)]
    return np.asarray((np.cumsum(columns) - 1)[free[first_alike(free.T)[0]]])


class _Base(NamedTuple):
    """The b constants before the first joint; ``parameter`` (b,) in x[columns], −1 for those without one."""

    axis: Indices
    turns: NDArray[np.bool_]
    value: Floats
    parameter: Indices
    named: NDArray[np.bool_]


def _base(chain: Chain, columns: NDArray[np.bool_]) -> _Base | None:
    """Return the base, with parameters as in x[columns]; None unless they can turn any way."""
    constants = constants_of(tuple(takewhile(lambda element: element.joint is None, chain.elements)))
    named = constants.parameter >= 0
    if constants.turns[named].sum() < 3 or not columns[constants.parameter[named]].all():
        return None
    number = (np.cumsum(columns) - 1)[constants.parameter]
    return _Base(constants.axis, constants.turns, constants.value, np.where(named, number, -1), named)


class _Pose(NamedTuple):
    """The base at some parameters, and its twist (6, b), (ω, v) in the rig's frame, by each of them."""

    rot: Floats  # (3, 3)
    origin: Floats  # (3,)
    twists: Floats


def _posed(base: _Base, x: Floats) -> _Pose:
    """Return the pose, constant by constant from the rig's frame on."""
    pose, twists = np.eye(4), []
    motions = mixed(base.axis, base.turns, np.where(base.named, x[base.parameter], base.value))
    for axis, turns, motion in zip(base.axis, base.turns, motions, strict=True):
        line, origin = pose[:3, axis], pose[:3, 3]
        twists.append(np.concatenate([line, skew(origin) @ line] if turns else [np.zeros(3), line]))
        pose = pose @ motion
    return _Pose(pose[:3, :3], pose[:3, 3], np.array(twists).T[:, base.named])


def _small_turn(rot: Floats) -> Floats:
    """Return sin θ times the axis of a rotation (3, 3) by θ.

    It is the rotation vector, but for θ³/6, which Newton's next step takes.
    """
    return 0.5 * np.array([rot[2, 1] - rot[1, 2], rot[0, 2] - rot[2, 0], rot[1, 0] - rot[0, 1]])


def _with_base(base: _Base, beside: Indices, x: Floats, added_to: Floats) -> Floats:
    """Return x (k,) after a step that moves base and points along the screw.

    ``added_to`` is x + Δ, as all other numbers remain. It is returned unchanged if the turn is so small that this makes
    no difference, or if no parameters give the pose.
    """
    numbers = base.parameter[base.named]
    pose = _posed(base, x)
    twist = pose.twists @ (added_to - x)[numbers]
    omega, v = np.split(twist, 2)
    if np.linalg.norm(omega) <= STRAIGHT:
        return added_to
    rot, shift = screw(twist)
    goal_rot, goal_origin = rot @ pose.rot, rot @ pose.origin + shift
    out = added_to.copy()
    for _ in range(NEWTON_STEPS):
        reached = _posed(base, out)
        remaining = goal_rot @ reached.rot.T
        error = np.concatenate([_small_turn(remaining), goal_origin - remaining @ reached.origin])
        out[numbers] += np.linalg.lstsq(reached.twists, error, rcond=None)[0]
        if np.abs(error).max() <= NEAR:
            points = x[beside]
            out[beside] += points @ rot.T + shift - points - (points @ skew(omega).T + v)
            return out
    return added_to
