"""A line device: a target that the robot drives along a straight line, measured in the device's axes.

y is the longitudinal coordinate (magnetostrictive, about 1 m), x and z are the two transverse ones (magnetic, some
millimetres). Each placement of the device is a line with six unknowns of its own (Renders, Rossignol, Becquet, Hanus
1991, II-H); the geometry and its derivatives are those of a tracker with a very long, thin field (``position.py``).

Points exactly on a line (transverse readings 0) do not see the device's roll about it: one direction less a line. The
line stands in the room by hand, so it is first placed by its own readings through the nominal robot: by least squares
of all its points, or by the two-point rule, which lays it through its two ends. Least squares starts nearer (on the
same simulated data 12 mm against 20–23 mm), both end at the same place.

The time offset needs the line driven there and back: at constant speed in one direction τ cannot be told from the
device's longitudinal place.
"""

from __future__ import annotations

import numpy as np

from truearm.observe.position import PositionRows, evaluate
from truearm.types import Floats

__all__ = ["PLACEMENTS", "PositionRows", "evaluate", "placement_weights"]

PLACEMENTS = ("least_squares", "two_point")
LONGITUDINAL = 1  # y
FAINT = 1e-9  # beside the two ends, the other points settle the roll and nothing else


def placement_weights(xyz: Floats, rule: str) -> Floats:
    """(n,) weights for ``position.place`` of a line's points (n, 3) by one of PLACEMENTS."""
    if rule == "least_squares":
        return np.ones(len(xyz))
    weights = np.full(len(xyz), FAINT)
    weights[[np.argmin(xyz[:, LONGITUDINAL]), np.argmax(xyz[:, LONGITUDINAL])]] = 1.0
    return weights
