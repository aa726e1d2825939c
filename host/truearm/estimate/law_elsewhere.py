"""What a fit with laws changes where nothing was measured, limited to what the geometry alone leaves unexplained.

Poses in a corner of the joint space determine the sum of geometry and laws there, but not elsewhere. The evidence keeps
one of several combinations, whose extrapolation may be worse than that of the geometry. A change of the predictions
elsewhere that is much larger than what the geometry leaves is more likely an extrapolation than a law.

The estimate is therefore moved towards the geometry as far as the fitted rows permit. An RMS change as large as what
the geometry leaves costs as much as one residual of one σ (docs/explanation/estimation.md). Where many poses determine
the laws, this changes nothing. The covariance of the result is P plus the square of the move, its mean square error if
x ~ N(x, P).
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from truearm.estimate.information import observe
from truearm.estimate.law_fit import LawProblem, Posterior
from truearm.estimate.problem import Problem


def nearer_geometry(of: LawProblem, anywhere: Problem, found: Posterior, misfit: float) -> Posterior:
    """Return the posterior moved towards ``of.start``, the geometry alone, where the rows do not determine the difference.

    ``anywhere`` has rows of the same fixtures in random poses, and ``misfit`` is the reduced χ² of the geometry.
    """
    at = np.array([of.problem.names.index(name) for name in anywhere.names])
    middle = 0.5 * (found.x + of.start)[at]  # makes the change exact to second order
    seen = observe(anywhere, middle, of.columns[at])
    used = (np.cumsum(of.columns) - 1)[at[of.columns[at]]]
    root = seen.root / np.sqrt(max(misfit, np.finfo(float).tiny) * seen.n_residuals)
    change = root @ (found.x - of.start)[of.columns][used]
    cross = root @ found.covariance[used]
    inner = np.eye(len(root)) + cross[:, used] @ root.T
    move = -cross.T @ scipy.linalg.solve(inner, change, assume_a="pos", check_finite=False)
    x = found.x.copy()
    x[of.columns] += move
    return found._replace(x=x, covariance=found.covariance + np.outer(move, move))
