"""Systematic errors in the residuals of a fit with joint laws: the tests of ``systematic`` under the learned noise.

The laws' parameters, limited by their prior, are among the fitted parameters, so a law is not reported as a systematic
error.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg

from truearm.estimate.information import observe
from truearm.estimate.law_fit import LawProblem, Posterior
from truearm.estimate.pose_noise import PoseNoise, with_pose_noise
from truearm.estimate.problem import Problem
from truearm.estimate.systematic import systematic_errors
from truearm.estimate.systematic_score import FitChi2, Fitted, Measured
from truearm.estimate.uncertainty import Goodness
from truearm.estimate.whitened_rows import only
from truearm.results import SystematicErrors
from truearm.types import Floats, Indices

MOST_NUMBERS = 1_200_000  # of the tested rows' derivatives, 10 MB; of more, evenly spaced poses are tested


def law_systematic(
    of: LawProblem, found: Posterior, noise: PoseNoise, how: Measured, declared: Goodness, q: Floats
) -> SystematicErrors | None:
    """Return the systematic errors beyond chance in the fitted rows, or None if there are none.

    ``q`` (n, j) are the joint readings, ``declared`` is the goodness of fit under the declared noise; χ² remains relative to the declared noise.
    """
    problem = with_pose_noise(only(of.problem, _tested(of)), found.x, noise)
    fitted, goodness = _fitted(of, found, problem)
    wrong = systematic_errors(problem, found.x, of.columns, fitted, goodness, how, q)
    if wrong is None:
        return None
    return replace(wrong, chi2_reduced=wrong.chi2_reduced * declared.reduced * goodness.freedom / goodness.chi2)


def _fitted(of: LawProblem, found: Posterior, problem: Problem) -> tuple[Fitted, FitChi2]:
    """Return what the parameters follow of the problem's rows, and χ² under the learned noise.

    The noise was learned from the same residuals, so the declared one cannot show what is beyond chance.
    """
    data = observe(problem, found.x, of.columns)
    prior = _prior_root(of, found)
    seen = data.root @ prior
    lower = np.linalg.cholesky(np.eye(prior.shape[1]) + seen.T @ seen)
    root = scipy.linalg.solve_triangular(lower, prior.T, lower=True).T
    # The remaining step: of these rows and of the prior, which pulls towards the reference.
    away = np.linalg.lstsq(prior, (found.x - of.reference)[of.columns], rcond=None)[0]
    left = root.T @ (data.root.T @ data.rhs) - scipy.linalg.solve_triangular(lower, away, lower=True)
    fitted = Fitted(root, left)
    chi2 = data.chi2 - float(data.rhs @ data.rhs) + _remaining(data.root, data.rhs, fitted)
    freedom = data.n_residuals - float(((data.root @ root) ** 2).sum())
    return fitted, FitChi2(chi2, freedom, limit=0.0)


def _remaining(root: Floats, rhs: Floats, fitted: Fitted) -> float:
    """Return the part of χ² within the triangle's rows after the remaining step."""
    return float(((rhs - root @ (fitted.root @ fitted.left)) ** 2).sum())


def _tested(of: LawProblem) -> np.ndarray:
    """Return a mask (n_rows,) of all rows, or of those of evenly spaced poses."""
    width = max((group.sensor_cov.shape[1] for group in of.problem.groups if group.row is not None), default=1)
    most = max(1, MOST_NUMBERS // (width * int(of.columns.sum())))
    every = -(-of.pose.size // most)
    numbers: Indices = np.unique(of.pose)[::every]
    return np.isin(of.pose, numbers)


def _prior_root(of: LawProblem, found: Posterior) -> Floats:
    """Return W (k, r), where W Wᵀ is the prior covariance of the unknowns."""
    law = np.flatnonzero(of.is_law)
    rest = np.flatnonzero(~of.is_law)
    out = np.zeros((of.is_law.size, rest.size + found.prior_root.shape[1]))
    out[rest, np.arange(rest.size)] = of.sigma[rest]
    out[law, rest.size :] = found.prior_root
    return out
