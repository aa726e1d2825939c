"""A robot judged by observations that it was not fitted to: which rows can judge, and what they say.

What the rig does not know (a socket's place, a line's pose, a ball's) is settled on the judging rows themselves, with the
robot fixed, as nothing could be predicted there otherwise. Rows that fit such unknowns whatever they say are no judges.

How large an error should be if the robot is as it was identified, with covariance P, follows from both. Of whitened rows
with noise ε and the robot's error δ, r = ε − A δ, the rig's unknowns J u (with their priors, as rows of their own below J)
take the part H r away, H = U₁U₁ᵀ of the thin SVD's U₁ beside J. What is left has the covariance

    (I − H) + (I − H) A P Aᵀ (I − H) .

Whether the errors are of that size is one χ² test. With P as the prior of the robot's parameters about the identified ones the
least sum of squares, data and priors together, is χ² with as many degrees of freedom as there are residuals and priors more
than unknowns: rᵀ(I + A P Aᵀ)⁻¹r after the rig. What rows share, the robot's error and the rig's, is in it exactly, and so is
how much n rows can tell. Directions of the robot that the identification did not see have no prior. The residuals of that fit are
tested for systematic errors as those of any other (``systematic``).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.fit import fit
from truearm.estimate.information import RANK_TOLERANCE, fold, half, observe, seen, spectrum, with_prior
from truearm.estimate.lm import DAMPING_START
from truearm.estimate.measured_order import measured_order
from truearm.estimate.prediction import MOVES
from truearm.estimate.problem import Problem, Rigs, build_problem, settled, without_knowledge
from truearm.estimate.solution import Options
from truearm.estimate.systematic import FitChi2, systematic_errors
from truearm.estimate.whitened_rows import whitened_blocks
from truearm.kinds.group import unit_columns
from truearm.model.chain import Chain
from truearm.types import Floats, ObservationTable, Residuals, SystematicErrors

LEVEL = 0.99  # of consistent sessions that are called so
LEAST_FREEDOM = 1e-6  # share of a row's residuals that must be left to judge by; rounding leaves 1e-12


class Judgement(NamedTuple):
    """What n rows say of a robot."""

    error: Residuals  # sizes of the rows' residuals by unit
    judging: NDArray[np.bool_]  # (n,) False for rows that fit whatever they say
    n_settled: int  # unknowns of the rig that were settled on these rows
    problem: Problem
    x: Floats  # (P,)


class Expected(NamedTuple):
    """What n rows should say of a robot that is as identified: mean squares of the errors in one SI unit.

    NaN and False of rows without such an error.
    """

    by_noise: Floats  # (n,) by the sigmas that rig and table declare
    by_parameters: Floats  # (n,) by the parameters' covariance
    unseen: NDArray[np.bool_]  # (n,) rows that a direction moves of which the identification saw nothing


def judge(chain: Chain, rig: Rigs, table: ObservationTable, params: Floats) -> Judgement:
    """Judge the robot with parameters (p,) by a table. Raises ProblemError as ``build_problem``."""
    # The known distance between sockets must not help to place them: the error is the spread about each socket.
    problem = without_knowledge(build_problem(chain, rig, table))
    x = np.concatenate([params, problem.start[problem.n_robot :]])
    rig_only = np.arange(x.size) >= problem.n_robot
    found = fit(problem, rig_only, x, Options(), DAMPING_START)
    error = {unit: np.abs(residual) for unit, residual in found.information.residual.items()}
    return Judgement(error, has_freedom(problem, rig_only, found.x), int(rig_only.sum()), problem, found.x)


def expected(judgement: Judgement, covariance: Floats, unseen: Floats) -> Mapping[str, Expected]:
    """What the rows of a judgement should say, by SI unit, with the robot's covariance (p, p) and ``unseen`` directions (p, d).

    The largest weight of each direction is 1.
    """
    problem, x, p = settled(judgement.problem, judgement.x), judgement.x, judgement.problem.n_robot
    parts = [part for part in whitened_blocks(problem, x, np.ones(x.size, dtype=bool)) if part.row is not None]
    jac = np.concatenate([part.jac.reshape(-1, x.size) for part in parts])
    taken = _taken(jac[:, p:], problem.prior_sigma[p:])
    left = jac[:, :p] - taken @ (taken.T @ jac[:, :p])
    due = {
        unit: Expected(np.full(problem.n_rows, np.nan), np.full(problem.n_rows, np.nan), np.zeros(problem.n_rows, bool))
        for unit in judgement.error
    }
    at = 0
    for part in parts:
        n, width, _ = part.jac.shape
        mine = slice(at, at + n * width)
        for unit, components in unit_columns(part.components).items():
            root, to = part.noise_root[:, components], due[unit]
            fitted, by_robot = (root @ whole[mine].reshape(n, width, -1) for whole in (taken, left))
            to.by_noise[part.row] = np.maximum((root**2).sum(axis=(1, 2)) - (fitted**2).sum(axis=(1, 2)), 0.0)
            square = np.einsum("nwp,pr,nwr->n", by_robot, covariance, by_robot, optimize=True)
            to.by_parameters[part.row] = np.maximum(square, 0.0)
            to.unseen[part.row] = np.abs(by_robot @ unseen).max(axis=(1, 2), initial=0.0) > MOVES
        at += n * width
    return due


class Consistency(NamedTuple):
    """How the rows agree with declared noise and the calibration's covariance.

    ``chi2`` of ``freedom`` degrees is at most ``limit`` with probability LEVEL if the robot is as identified.
    """

    chi2: float
    freedom: int
    limit: float
    systematic: SystematicErrors | None

    @property
    def explained(self) -> bool:
        """Whether noise and covariance explain the errors, and nothing is off."""
        return self.chi2 <= self.limit and self.systematic is None


def consistency(
    judgement: Judgement, table: ObservationTable, covariance: Floats, unseen: Floats
) -> Consistency | None:
    """Test a judgement of the ``table``'s rows; arguments as of ``expected``. None without a degree of freedom."""
    problem, x, p = judgement.problem, judgement.x, judgement.problem.n_robot
    known = np.diag(covariance) > 0.0
    columns = np.concatenate([known | unseen.any(axis=1), np.ones(x.size - p, dtype=bool)])
    prior = np.concatenate([np.full(int(columns[:p].sum()), np.inf), problem.prior_sigma[p:]])
    information = with_prior(observe(problem, x, columns), (problem.start - x)[columns], prior)
    rows = _precision_root(covariance[np.ix_(columns[:p], columns[:p])])
    k = int(columns.sum())
    triangle = np.zeros((k + 1, k + 1))
    triangle[:k, :k], triangle[:k, k] = information.root, information.rhs
    triangle = fold(triangle, np.pad(rows, ((0, 0), (0, k + 1 - rows.shape[1]))))
    whole = information._replace(root=triangle[:k, :k], rhs=triangle[:k, k])
    parts = spectrum(whole.root)
    fitted = half(parts).T @ (whole.root.T @ whole.rhs)
    freedom = information.n_residuals + len(rows) - int(seen(parts).sum())
    if freedom < 1:
        return None
    chi2 = max(information.chi2 - float(fitted @ fitted), 0.0)
    limit = float(special.chdtri(freedom, 1.0 - LEVEL))
    how = measured_order(table, np.ones(len(table), dtype=bool))
    wrong = systematic_errors(problem, x, columns, whole, FitChi2(chi2, freedom, chi2 <= limit), how)
    return Consistency(chi2, freedom, limit, wrong)


def _precision_root(covariance: Floats) -> Floats:
    """(r, k) rows whose squares are the inverse of a covariance (k, k) along the directions in which it is not 0."""
    scale = np.sqrt(np.where(np.diag(covariance) > 0.0, np.diag(covariance), 1.0))
    values, vectors = np.linalg.eigh(covariance / scale / scale[:, None])
    some = values > RANK_TOLERANCE * values.max(initial=0.0)
    return np.asarray((vectors[:, some] / np.sqrt(values[some])).T / scale)


def _taken(jac: Floats, prior_sigma: Floats) -> Floats:
    """U₁ (m, r) of whitened derivatives (m, u) by the rig's unknowns."""
    known = np.isfinite(prior_sigma)
    stacked = np.concatenate([jac, np.diag(1.0 / np.where(known, prior_sigma, np.inf))[known]])
    stacked = stacked / np.maximum(np.linalg.norm(stacked, axis=0), 1e-300)
    basis, weight, _ = np.linalg.svd(stacked, full_matrices=False)
    return np.asarray(basis[: len(jac), weight > RANK_TOLERANCE * weight.max(initial=0.0)])


def has_freedom(problem: Problem, columns: NDArray[np.bool_], x: Floats) -> NDArray[np.bool_]:
    """Rows (n,) that the unknowns x[columns], settled on them, could not make to fit whatever they say.

    The trace of a row's block of the hat matrix J (JᵀJ)⁺ Jᵀ is its number of residuals where they fit by construction:
    the only seat in a socket, say.
    """
    free = np.ones(problem.n_rows, dtype=bool)
    if not columns.any():
        return free
    whole = [
        (group.row, group.evaluate(problem.chain, x).jac_params[:, columns])
        for group in problem.groups
        if group.row is not None
    ]
    basis, weight, _ = np.linalg.svd(np.concatenate([jac for _, jac in whole]), full_matrices=False)
    hat = np.sum(basis[:, weight > RANK_TOLERANCE * weight.max(initial=0.0)] ** 2, axis=1)
    at = 0
    for row, jac in whole:
        share = hat[at : at + len(jac)].reshape(row.size, -1).mean(axis=1)
        free[row[share > 1.0 - LEAST_FREEDOM]] = False
        at += len(jac)
    return free
