"""The parameter vector after a step: numbers are added, orientations are rotated.

A rotation vector ω is rotated by Δ to first order, exp([ω']×) = exp([J_l(ω) Δ]×)·exp([ω]×). If Δ were added instead, a
step that only rolls a line device about its own axis would also tilt it, by the square of the roll. The axis is known
to about 1e-5 rad and the roll hardly at all, so this valley would be too strongly curved for a fit to leave it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.problem import Problem
from truearm.model.rotation import turned
from truearm.types import Floats

Step = Callable[[Floats, Floats], Floats]  # x (k,) and Δ (k,) to the new x


def added(x: Floats, delta: Floats) -> Floats:
    """Return x + Δ."""
    return x + delta


def stepper(problem: Problem, columns: NDArray[np.bool_]) -> Step:
    """Return the step of x[columns]; an orientation with a fixed component is added to."""
    x_size = problem.start.size
    triples = {tuple(triple) for group in problem.groups for triple in group.orientations().tolist()}
    free = sorted(triple for triple in triples if max(triple) < x_size and columns[list(triple)].all())
    if not free:
        return added
    at = (np.cumsum(columns) - 1)[np.array(free)]

    def step(x: Floats, delta: Floats) -> Floats:
        there = x + delta
        there[at] = turned(x[at], delta[at])
        return there

    return step
