"""Choices among values that can be equal: by order, not by rounding.

Two parameters that do the same have columns of one length, and two items that do the same explain as much. Computed
values of equal size differ in the last digits, and by how much depends on the processor. A choice between them takes
the first: of parameters in the order of the robot's file, of items in that of the rig.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from truearm.types import Floats

MARGIN = 1e-6  # relative: far beyond rounding, far below any difference that matters
OF_LENGTHS = 1e-3  # of columns, which rounding changes more when they are nearly dependent on those before


def first_within(values: Sequence[float] | Floats, margin: float = MARGIN) -> int:
    """Return the index of the first value that is the largest, or less by at most ``margin`` of it."""
    values = np.asarray(values)
    return int(np.argmax(values >= _least(values.max(), margin)))


def largest_first(values: Sequence[float] | Floats) -> list[int]:
    """Return the indices of values in descending order; those that are as large as one before them, in their own order."""
    values = np.asarray(values, dtype=float)
    left, out = np.argsort(-values, kind="stable"), list[int]()
    while left.size:
        alike = values[left] >= _least(values[left[0]], MARGIN)
        out += sorted(left[alike].tolist())
        left = left[~alike]
    return out


def _least(largest: float, margin: float) -> float:
    return largest - margin * abs(largest)


def pivots(matrix: Floats, tolerance: float = 0.0, most: int | None = None) -> list[int]:
    """Return independent columns of a matrix (m, c), at most ``most``.

    Each is the one with the longest part that those before it do not explain, as in QR with column pivoting, as long as
    that is longer than ``tolerance``.
    """
    left, out = matrix.copy(), list[int]()
    for _ in range(min(*left.shape, left.size if most is None else most)):
        length = np.linalg.norm(left, axis=0)
        column = first_within(length, OF_LENGTHS)
        if length[column] <= tolerance:
            break
        out.append(column)
        axis = left[:, column] / length[column]
        left -= np.outer(axis, axis @ left)
        left[:, column] = 0.0
    return out
