"""The parameter vector after a step: numbers are added, orientations are rotated, and the base moves along a screw.

A rotation vector ω is rotated by Δ to first order, exp([ω']×) = exp([J_l(ω) Δ]×)·exp([ω]×). If Δ were added instead, a
step that only rolls a line device about its own axis would also tilt it, by the square of the roll. The axis is known
to about 1e-5 rad and the roll hardly at all, so this valley would be too strongly curved for a fit to leave it.

The base is the same case on a larger scale. Rotating it about a line through nearly collinear chucks, together with the
chucks, changes no length; only what is known about the places of the chucks limits it. With ξ = (ω, v) the twist of the
base by Δ, the base therefore moves by exp(ξ), and a point c beside it moves to exp(ξ) c + Δ_c − (ω × c + v), which is
c + Δ_c to first order. Where numbers are added instead, a step may only be so long that its arcs, about half a metre in
radius, deviate from their tangents by less than the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.problem import Problem
from truearm.kinds.linearised import Indices
from truearm.model.chain import Chain, Element
from truearm.model.rotation import left_jacobian, rotation, rotation_vector, turned
from truearm.model.transforms import axis_of, elementary
from truearm.types import Floats

Step = Callable[[Floats, Floats], Floats]  # x (k,) and Δ (k,) to the new x
STRAIGHT = 1e-5  # rad: the arc of such a turn deviates from its tangent by 0.05 nm at a metre
NEWTON_STEPS = 8  # from parameters that are added to those of the base's pose
ARRIVED = 1e-12  # rad, m


def added(x: Floats, delta: Floats) -> Floats:
    """Return x + Δ."""
    return x + delta


def stepper(problem: Problem, columns: NDArray[np.bool_]) -> Step:
    """Return the step of x[columns]; an orientation, base or point with a fixed number is added to."""
    turning = _free_triples(columns, [group.orientations() for group in problem.groups])
    base = _base(problem.chain, columns)
    beside = _free_triples(columns, [group.beside_base() for group in problem.groups])
    if not (turning.size or base):
        return added

    def step(x: Floats, delta: Floats) -> Floats:
        there = x + delta
        there[turning] = turned(x[turning], delta[turning])
        return _with_base(base, beside, x, there) if base else there

    return step


def _free_triples(columns: NDArray[np.bool_], every: Sequence[Indices]) -> Indices:
    """Return the indices (r, 3) in x[columns] of those triples in x that are unknown and free."""
    triples = {tuple(triple) for some in every for triple in some.tolist()}
    free = sorted(triple for triple in triples if max(triple) < columns.size and columns[list(triple)].all())
    return (np.cumsum(columns) - 1)[np.array(free, dtype=np.intp).reshape(-1, 3)]


def _base(chain: Chain, columns: NDArray[np.bool_]) -> tuple[Element, ...]:
    """Return the constants before the first joint, with parameters as in x[columns]; none unless they can turn any way."""
    number = np.cumsum(columns) - 1
    first = tuple(takewhile(lambda element: element.joint is None, chain.elements))
    named = [element for element in first if element.parameter is not None]
    if sum(e.motion[0] == "r" for e in named) < 3 or not all(columns[e.parameter] for e in named):
        return ()
    return tuple(
        element if element.parameter is None else replace(element, parameter=int(number[element.parameter]))
        for element in first
    )


class _Pose(NamedTuple):
    """The base at some parameters, and its twist (6, b), (ω, v) in the rig's frame, by each of them."""

    transform: Floats  # (4, 4)
    twists: Floats


def _posed(base: Sequence[Element], x: Floats) -> _Pose:
    here, twists = np.eye(4), []
    for element in base:
        axis = here[:3, axis_of(element.motion)]
        if element.parameter is not None:
            turns = element.motion[0] == "r"
            twists.append([*axis, *np.cross(here[:3, 3], axis)] if turns else [0.0, 0.0, 0.0, *axis])
        here = here @ elementary(element.motion, element.value if element.parameter is None else x[element.parameter])
    return _Pose(here, np.array(twists).T)


def _with_base(base: Sequence[Element], beside: Indices, x: Floats, added_to: Floats) -> Floats:
    """Return x (k,) after a step that moves base and points along the screw; ``added_to`` is x + Δ, and remains otherwise.

    It is returned unchanged if the turn is so small that this makes no difference, or if no parameters give the pose.
    """
    at = [element.parameter for element in base if element.parameter is not None]
    here = _posed(base, x)
    omega, v = np.split(here.twists @ (added_to - x)[at], 2)
    if np.linalg.norm(omega) <= STRAIGHT:
        return added_to
    rot, shift = rotation(omega), left_jacobian(omega) @ v
    goal = np.eye(4)
    goal[:3, :3], goal[:3, 3] = rot, shift
    goal, out = goal @ here.transform, added_to.copy()
    for _ in range(NEWTON_STEPS):
        now = _posed(base, out)
        left = goal @ np.linalg.inv(now.transform)
        error = np.concatenate([rotation_vector(left[:3, :3]), left[:3, 3]])
        if np.abs(error).max() <= ARRIVED:
            points = x[beside]
            out[beside] += points @ rot.T + shift - points - (np.cross(omega, points) + v)
            return out
        out[at] += np.linalg.lstsq(now.twists, error, rcond=None)[0]
    return added_to
