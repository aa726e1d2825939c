"""Iterated maximum a posteriori (Renders 1991, II-E) with one fixed prior: the default for a line's problem.

Each linearisation takes the paper's batch solution (12), corrected so that the prior keeps its own mean,

    Δ = (M_θ + ΣJᵢᵀCᵢJᵢ)⁻¹ [ΣJᵢᵀCᵢΔxᵢ + M_θ(θ₀ − θ)] ,   Cᵢ = (S_x + J₂S_qJ₂ᵀ)⁻¹ ,

in square-root form and as a full step: with a prior, the information is regular and Gauss–Newton needs no damping. Only
if a full step would increase the cost is Marquardt's damping used, so that a poor start ends at the same point as ``lm``.
The prior is centred on the nominal values in every iteration. Prior and data each count once, so the inverse of the
final information is the covariance of the error (II-G).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.fit import fit
from truearm.estimate.problem import Problem
from truearm.estimate.solution import Options, Solution
from truearm.types import Floats


def solve(problem: Problem, columns: NDArray[np.bool_], x: Floats, options: Options) -> Solution:
    """Maximise the posterior over x[columns] from x (P,)."""
    return fit(problem, columns, x, options._replace(damping=options.damping.from_full_steps()))
