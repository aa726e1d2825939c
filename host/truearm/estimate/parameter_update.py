"""Where a step leads: numbers are added, orientations are turned.

A rotation vector ω is turned by Δ to the first order, exp([ω']×) = exp([J_l(ω) Δ]×)·exp([ω]×). Added, a step that only rolls a
line device about its own axis would also tilt it, by the square of the roll, where the axis is known to some 1e-5 rad
and the roll hardly at all: a valley so curved that a fit stays in it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.problem import Problem
from truearm.model.rotation import turned
from truearm.types import Floats

Step = Callable[[Floats, Floats], Floats]  # x (k,) and Δ (k,) to where Δ leads


def added(x: Floats, delta: Floats) -> Floats:
    """x + Δ."""
    return x + delta


def stepper(problem: Problem, columns: NDArray[np.bool_]) -> Step:
    """The step of x[columns]; an orientation of which some component is held is added to."""
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
