"""The deviation from a straight line between two corrected targets.

Only the ends of a move are corrected. Between them the controller drives its own model along a line: evenly in
position, and about one axis in orientation. If the correction differs from one end to the other, the true tool leaves
the line between the ends. This module computes the deviation at SAMPLES points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.correct.model_pair import ModelPair, believed, reached
from truearm.model.chain import Chain
from truearm.model.inverse import inverse, singular_value
from truearm.model.poses import apart, inverted, moved
from truearm.types import Floats

SAMPLES = 9  # points between the ends: the deviation is smooth, largest near the middle


class StraightMoves(NamedTuple):
    """n moves: the largest deviation of the true tool from the line, and the smallest margins, with both ends.

    Of a line that the controller's model cannot follow, the limits are those as far as it can.
    """

    deviation: Floats  # (n,) m, NaN if the line cannot be followed
    singular_value: Floats  # (n,) of the nominal robot, NaN likewise
    limits: Floats  # (n, j) rad or m to each joint's nearest limit, negative beyond it
    drivable: NDArray[np.bool_]  # (n,) whether the controller's model follows the line without a jump of a joint


JUMP = 1.0  # rad, m of a joint between samples: more means another configuration, or passing a singularity


def straight_moves(pair: ModelPair, q_start: Floats, commanded: Floats, tool: Floats) -> StraightMoves:
    """Drive straight from joint readings (n, j) to commanded poses ``commanded`` (n, 4, 4) of the end.

    ``tool`` (n, 4, 4) is the pose of the tool in the end frame.
    """
    begin = believed(pair, q_start) @ tool
    motion = apart(commanded @ tool, begin)
    path = [np.asarray(q_start, dtype=float)]
    drivable, lost = np.ones(len(commanded), dtype=bool), np.zeros(len(commanded), dtype=bool)
    for share in np.linspace(0.0, 1.0, SAMPLES + 2)[1:]:
        q = inverse(pair.chain, pair.nominal, moved(begin, share * motion) @ inverted(tool), path[-1])
        drivable &= np.abs(q - path[-1]).max(axis=-1) < JUMP
        lost |= np.isnan(q).any(axis=-1)
        path.append(np.where(np.isnan(q), path[-1], q))
    places = np.array([(reached(pair, q) @ tool)[:, :3, 3] for q in path])
    singular = np.min([singular_value(pair.chain, pair.nominal, q) for q in path], axis=0)
    limits = np.min([limit_margins(pair.chain, q) for q in path], axis=0)
    deviation, singular = (np.where(lost, np.nan, values) for values in (_deviation(places), singular))
    return StraightMoves(deviation, singular, limits, drivable & (limits >= 0.0).all(axis=1))


def limit_margins(chain: Chain, q: Floats) -> Floats:
    """Return the distance (…, j) [rad or m] of joint readings (…, j) to the nearest limit of each.

    It is negative outside the limits, and inf where there is none.
    """
    lower, upper = chain.limits
    return np.asarray(np.minimum(q - lower, upper - q))


def _deviation(places: Floats) -> Floats:
    """Return the largest distance (n,) of points (samples, n, 3) from the line between the first and the last."""
    chord = places[-1] - places[0]
    length = np.linalg.norm(chord, axis=-1, keepdims=True)
    along = np.divide(chord, length, out=np.zeros_like(chord), where=length > 0.0)
    offset = places - places[0]
    offset = offset - (offset * along).sum(axis=-1, keepdims=True) * along
    return np.asarray(np.linalg.norm(offset, axis=-1).max(axis=0))
