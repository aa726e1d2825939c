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
    return int(np.argmax(values >= _threshold(values.max(), margin)))


def largest_first(values: Sequence[float] | Floats) -> list[int]:
    """Return the indices of values in descending order; values that differ by rounding alone keep their order."""
    values = np.asarray(values, dtype=float)
    remaining, order = np.argsort(-values, kind="stable"), list[int]()
    while remaining.size:
        tied = values[remaining] >= _threshold(values[remaining[0]], MARGIN)
        order += sorted(remaining[tied].tolist())
        remaining = remaining[~tied]
    return order


def _threshold(largest: float, margin: float) -> float:
    return largest - margin * abs(largest)


def pivots(matrix: Floats, tolerance: float = 0.0, most: int | None = None) -> list[int]:
    """Return independent columns of a matrix (m, c), at most ``most``.

    Each is the one with the longest part that those before it do not explain, as in QR with column pivoting, as long as
    that is longer than ``tolerance``.
    """
    unexplained, columns = matrix.copy(), list[int]()
    for _ in range(min(*matrix.shape, matrix.size if most is None else most)):
        length = np.linalg.norm(unexplained, axis=0)
        column = first_within(length, OF_LENGTHS)
        if length[column] <= tolerance:
            break
        columns.append(column)
        axis = unexplained[:, column] / length[column]
        unexplained -= np.outer(axis, axis @ unexplained)
        unexplained[:, column] = 0.0
    return columns
