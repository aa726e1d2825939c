"""Systematic errors in the residuals of a fit with joint laws: the tests of ``systematic`` under the learned noise.

What the laws follow is part of what the parameters follow, so that a law is no systematic error, and their prior is what limits it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg

from truearm.estimate.information import observe
from truearm.estimate.law_fit import LawProblem, Posterior
from truearm.estimate.pose_noise import PoseNoise, with_pose_noise
from truearm.estimate.systematic import FitChi2, Fitted, Measured, systematic_errors
from truearm.estimate.uncertainty import Goodness
from truearm.estimate.whitened_rows import only
from truearm.kinds.linearised import Indices
from truearm.types import Floats, SystematicErrors

MOST_NUMBERS = 2_500_000  # of the tested rows' derivatives, 20 MB; of more rows an even choice of poses is tested


def law_systematic(
    of: LawProblem, found: Posterior, noise: PoseNoise, how: Measured, declared: Goodness
) -> SystematicErrors | None:
    """What is off beyond chance in the rows that were fitted; ``declared``: what the declared noise says of the fit.

    None where nothing is off. χ² stays against the declared noise.
    """
    x, columns = found.x, of.columns
    problem = with_pose_noise(only(of.problem, _tested(of)), x, noise)
    data = observe(problem, x, columns)
    prior = _prior_root(of, found)
    seen = data.root @ prior
    lower = np.linalg.cholesky(np.eye(prior.shape[1]) + seen.T @ seen)
    root = scipy.linalg.solve_triangular(lower, prior.T, lower=True).T
    # The step that is left: of these rows and of the prior, which pulls towards the reference.
    away = np.linalg.lstsq(prior, (x - of.reference)[columns], rcond=None)[0]
    left = root.T @ (data.root.T @ data.rhs) - scipy.linalg.solve_triangular(lower, away, lower=True)
    fitted = Fitted(root, left)
    chi2 = data.chi2 - float(data.rhs @ data.rhs) + _remaining(data.root, data.rhs, fitted)
    freedom = data.n_residuals - float(((data.root @ root) ** 2).sum())
    explained = not declared.reduced > declared.band[1]
    wrong = systematic_errors(problem, x, columns, fitted, FitChi2(chi2, freedom, explained), how)
    if wrong is None:
        return None
    return replace(wrong, chi2_reduced=wrong.chi2_reduced * declared.reduced * freedom / chi2)


def _remaining(root: Floats, rhs: Floats, fitted: Fitted) -> float:
    """The part of χ² within the triangle's rows, once the step that is left is done."""
    return float(((rhs - root @ (fitted.root @ fitted.left)) ** 2).sum())


def _tested(of: LawProblem) -> np.ndarray:
    """(n_rows,) all rows, or those of an even choice of poses."""
    width = max((group.sensor_cov.shape[1] for group in of.problem.groups if group.row is not None), default=1)
    most = max(1, MOST_NUMBERS // (width * int(of.columns.sum())))
    every = -(-of.pose.size // most)
    numbers: Indices = np.unique(of.pose)[::every]
    return np.isin(of.pose, numbers)


def _prior_root(of: LawProblem, found: Posterior) -> Floats:
    """W (k, r): W Wᵀ is the prior's covariance of the unknowns."""
    law = np.flatnonzero(of.is_law)
    rest = np.flatnonzero(~of.is_law)
    out = np.zeros((of.is_law.size, rest.size + found.weighed.root.shape[1]))
    out[rest, np.arange(rest.size)] = of.sigma[rest]
    out[law, rest.size :] = found.weighed.root
    return out
