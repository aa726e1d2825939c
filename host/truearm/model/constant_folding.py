"""What of a chain is the same for all poses, multiplied out once for each set of params.

These are its links (runs of constants) and the matrix that makes derivatives by parameters of wrenches (chain.py
derives it). Twists and wrenches go axis by axis here, (v_x, w_x, v_y, w_y, v_z, w_z), force and moment likewise: a joint
about an axis turns two such pairs into each other and leaves the third alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.model.transforms import axis_of, cross, mixed
from truearm.types import Floats

if TYPE_CHECKING:
    from truearm.model.chain import Chain, Element


class Constants(NamedTuple):
    """c constants of a chain, in runs before, between and after its joints: j + 1 links."""

    axis: NDArray[np.intp]  # (c,)
    turns: NDArray[np.bool_]  # (c,) about the axis; False: along it
    value: Floats  # (c,) of the fixed ones
    parameter: NDArray[np.intp]  # (c,) −1 for the fixed ones
    link: NDArray[np.intp]  # (c,)
    inwards: NDArray[np.intp]  # (longest run, j + 1) each link's constants from its far end on, c after the last


class Folded(NamedTuple):
    """A chain's constants multiplied out for one set of params."""

    transforms: Floats  # (j + 1, 4, 4) the links
    carries: Floats  # (j + 1, 6, 6) a wrench from a link's near frame to its far frame
    twists: Floats  # (b, p)


def constants_of(elements: Sequence[Element]) -> Constants:
    """The elements that are no joints, as arrays."""
    constant = np.array([e.joint is None for e in elements], dtype=bool)
    link = np.cumsum(~constant)[constant]
    some = [e for e in elements if e.joint is None]
    runs = [np.flatnonzero(link == i)[::-1] for i in range(len(elements) - len(some) + 1)]
    inwards = np.full((max(map(len, runs)), len(runs)), len(some), dtype=np.intp)
    for i, run in enumerate(runs):
        inwards[: len(run), i] = run
    return Constants(
        axis=np.array([axis_of(e.motion) for e in some], dtype=np.intp),
        turns=np.array([e.motion[0] == "r" for e in some], dtype=bool),
        value=np.array([e.value for e in some]),
        parameter=np.array([-1 if e.parameter is None else e.parameter for e in some], dtype=np.intp),
        link=link,
        inwards=inwards,
    )


def folded(chain: Chain, params: Floats) -> Folded:
    """All constants multiplied out.

    Remembered for the last few params: poses come in blocks, and 54 constants take 0.16 ms, as long as 500 poses.
    """
    return _folded(chain, params.tobytes(), params.dtype.str)


def link_transforms(chain: Chain, params: Floats) -> Floats:
    """(j + 1, 4, 4) the links alone. Unlike ``folded`` it asks nothing of the joint law, so that a term of the law may ask it."""
    return _multiplied(chain.constants, _amounts(chain.constants, params))[0]


@lru_cache(maxsize=4)
def _folded(chain: Chain, params: bytes, dtype: str) -> Folded:
    constants = chain.constants
    transforms, beyond = _multiplied(constants, _amounts(constants, np.frombuffer(params, dtype)))
    carries = _carries(transforms)
    twists = _combined(chain, _twists_beyond(constants, beyond), carries)
    for array in (transforms, carries, twists):
        array.setflags(write=False)
    return Folded(transforms, carries, twists)


def _amounts(constants: Constants, params: Floats) -> Floats:
    """(c,) the constants' lengths and angles."""
    named = constants.parameter >= 0
    amount = constants.value.astype(params.dtype)
    amount[named] = params[constants.parameter[named]]
    return amount


def _multiplied(constants: Constants, amount: Floats) -> tuple[Floats, Floats]:
    """The links' transforms (j + 1, 4, 4) and, for each constant, (c, 4, 4) the product of what follows it in its link.

    All links go together, each from its far end inwards: one by one 54 constants would take four times as long.
    """
    own = np.concatenate([mixed(constants.axis, constants.turns, amount), np.eye(4)[None]])
    beyond = np.empty_like(own)
    here = np.broadcast_to(np.eye(4, dtype=own.dtype), (constants.inwards.shape[1], 4, 4))
    for which in constants.inwards:
        beyond[which] = here
        here = own[which] @ here
    return here.copy(), beyond[:-1]


def _twists_beyond(constants: Constants, beyond: Floats) -> Floats:
    """(c, 6) Ad(B⁻¹)ξ of unit motions: w' = Rᵀw, v' = Rᵀ(v − t × w) with B = (R, t)."""
    rot, shift = beyond[:, :3, :3], beyond[:, :3, 3:]
    each, k, turns = np.arange(len(beyond)), constants.axis, constants.turns[:, None]
    a, b = (k + 1) % 3, (k + 2) % 3  # t × e_k = t_b e_a − t_a e_b
    axis = rot[each, k]
    lever = shift[each, a] * rot[each, b] - shift[each, b] * rot[each, a]
    return np.stack([np.where(turns, lever, axis), np.where(turns, axis, 0.0)], axis=2).reshape(-1, 6)


def _carries(transforms: Floats) -> Floats:
    """(n, 6, 6) wrenches seen in frames (R, t): force' = Rᵀ force, moment' = Rᵀ(moment − t × force)."""
    rot, shift = transforms[:, :3, :3], transforms[:, :3, 3:]
    out = np.zeros((len(transforms), 3, 2, 3, 2), dtype=transforms.dtype)
    out[:, :, 0, :, 0] = out[:, :, 1, :, 1] = np.swapaxes(rot, 1, 2)
    lever = cross(np.moveaxis(shift, 1, 0), np.moveaxis(rot, 1, 0))  # −r·(t × f) = (t × r)·f for R's columns r
    out[:, :, 1, :, 0] = np.moveaxis(lever, 0, 2)
    return out.reshape(-1, 6, 6)


def _combined(chain: Chain, twists_beyond: Floats, carries: Floats) -> Floats:
    """``twists`` (b, p): every parameter's twist times the wrench in its frame, written in the b numbers of ``wrenches``.

    Their order is that of ``chain.along``: the six in the base frame, then what each joint makes new, then what its law does.
    """
    motions, law, constants = chain.motions, chain.law, chain.constants
    b = 6 + sum(len(new_numbers(m)) for m in motions) + len(law.of_column)
    twists = np.zeros((len(chain.parameters), b), dtype=twists_beyond.dtype)
    far, at = [carries[0] @ np.eye(6, b)], 6
    for i, motion in enumerate(motions):
        new = new_numbers(motion)
        near = far[i].copy()
        near[new] = np.eye(len(new), b, at)
        at += len(new)
        own = law.of_column[law.columns[i]]
        twists[own, at + np.arange(len(own))] = 1.0
        at += len(own)
        far.append(carries[i + 1] @ near)
    for parameter, joint in law.constant:
        twists[parameter] = far[joint][on_axis(motions[joint])]
    named = constants.parameter >= 0
    wrench = np.stack(far)[constants.link[named]]
    twists[constants.parameter[named]] = (twists_beyond[named, None] @ wrench)[:, 0]
    return np.ascontiguousarray(twists.T)


def on_axis(motion: str) -> int:
    """Which of a wrench's six numbers a joint feels: the force along, or the moment about its axis."""
    return 2 * axis_of(motion) + (motion[0] == "r")


def new_numbers(motion: str) -> list[int]:
    """Which of a wrench's six numbers a joint changes: all across its axis, or of a prismatic one the moments."""
    k = axis_of(motion)
    across = [i for axis in ((k + 1) % 3, (k + 2) % 3) for i in (2 * axis, 2 * axis + 1)]
    return across if motion[0] == "r" else across[1::2]
