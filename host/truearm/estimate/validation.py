"""A robot judged by observations that it was not fitted to: which rows can judge, and what they say.

What the rig does not know (a socket's place, a line's pose, a ball's) is settled on the judging rows themselves, with the
robot fixed, as nothing could be predicted there otherwise. Rows that fit such unknowns whatever they say are no judges. Unknowns
that the identification found may be kept as it left them: they are then judged with the robot.

How large an error should be if the robot, and what is kept beside it, is as it was identified, with covariance P, follows from both.
Of whitened rows with noise ε and the robot's error δ, r = ε − A δ, the rig's other unknowns J u (with their priors, as rows of their
own below J) take the part H r away, H = U₁U₁ᵀ of the thin SVD's U₁ beside J. What is left has the covariance

    (I − H) + (I − H) A P Aᵀ (I − H) .

Whether the errors are of that size is one χ² test. With P as the prior of the robot's parameters about the identified ones the
least sum of squares, data and priors together, is χ² with as many degrees of freedom as there are residuals and priors more
than unknowns: rᵀ(I + A P Aᵀ)⁻¹r after the rig. What rows share, the robot's error and the rig's, is in it exactly, and so is
how much n rows can tell. Directions of the robot that the identification did not see have no prior. The residuals of that fit are
tested for systematic errors as those of any other (``systematic``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.effects import Circumstances, modelled_effects
from truearm.estimate.fit import fit
from truearm.estimate.information import RANK_TOLERANCE, fold, half, observe, seen, spectrum, with_prior
from truearm.estimate.lm import DAMPING_START
from truearm.estimate.measured_order import measured_order
from truearm.estimate.prediction import MOVES
from truearm.estimate.problem import Problem, Rigs, build_problem, settled, without_knowledge
from truearm.estimate.solution import Options
from truearm.estimate.systematic import FitChi2, Fitted, systematic_errors
from truearm.estimate.uncertainty import covariance_root
from truearm.estimate.whitened_rows import whitened_blocks
from truearm.kinds.group import unit_columns
from truearm.model.chain import Chain
from truearm.types import Effect, Floats, ObservationTable, Residuals, SystematicErrors

NOTHING: Mapping[str, float] = MappingProxyType({})
LEVEL = 0.99  # of consistent sessions that are called so
LEAST_FREEDOM = 1e-6  # share of a row's residuals that must be left to judge by; rounding leaves 1e-12


class Judgement(NamedTuple):
    """What n rows say of a robot."""

    error: Residuals  # sizes of the rows' residuals by unit
    judging: NDArray[np.bool_]  # (n,) False for rows that fit whatever they say
    problem: Problem
    x: Floats  # (P,)
    settled: NDArray[np.bool_]  # (P,) unknowns of the rig that were settled on these rows; all others are as identified

    @property
    def identified(self) -> tuple[str, ...]:
        """The names of the parameters that are as identified: the robot's, then what was kept of the rig."""
        return tuple(name for name, settled in zip(self.problem.names, self.settled, strict=True) if not settled)


class Expected(NamedTuple):
    """What n rows should say of a robot that is as identified: mean squares of the errors in one SI unit.

    NaN and False of rows without such an error.
    """

    by_noise: Floats  # (n,) by the sigmas that rig and table declare
    by_parameters: Floats  # (n,) by the parameters' covariance
    unseen: NDArray[np.bool_]  # (n,) rows that a direction moves of which the identification saw nothing


def judge(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    params: Floats,
    kept: Mapping[str, float] = NOTHING,
    place: NDArray[np.bool_] | None = None,
    allowed: Sequence[Effect] = (),
) -> Judgement:
    """Judge the robot with parameters (p,) by a table. Raises ProblemError as ``build_problem``.

    kept : values of the rig's unknowns that are held and not settled, by name; others are passed over.
    allowed : systematic errors in all rows that the identification estimated; of them those that are kept are parameters here too.
    place : (p,) parameters of the robot that are fitted to these rows as the rig's unknowns are: where base and tool stand.
    """
    # The known distance between sockets must not help to place them: the error is the spread about each socket.
    plain = build_problem(chain, rig, table)
    things = {cause.name: cause for cause in plain.causes}
    mine = [one for one in allowed if one.what in things and set(things[one.what].numbers) <= set(kept)]
    effects = modelled_effects(plain.causes, mine, Circumstances.of(table))
    problem = without_knowledge(build_problem(chain, rig, table, None, effects) if effects else plain)
    p = problem.n_robot
    values = [kept.get(name, start) for name, start in zip(problem.names[p:], problem.start[p:], strict=True)]
    x = np.concatenate([params, values])
    settle = np.array([i >= p and name not in kept for i, name in enumerate(problem.names)])
    columns = settle.copy()
    columns[:p] |= np.zeros(p, dtype=bool) if place is None else place
    found = fit(problem, columns, x, Options(), DAMPING_START)
    error = {unit: np.abs(residual) for unit, residual in found.information.residual.items()}
    return Judgement(error, has_freedom(problem, columns, found.x), problem, found.x, settle)


def expected(judgement: Judgement, covariance: Floats, unseen: Floats) -> Mapping[str, Expected]:
    """What the rows of a judgement should say, by SI unit, with covariance (k, k) and ``unseen`` directions (k, d) of what is as identified.

    The largest weight of each direction is 1.
    """
    problem, x, rig = settled(judgement.problem, judgement.x), judgement.x, judgement.settled
    parts = [part for part in whitened_blocks(problem, x, np.ones(x.size, dtype=bool)) if part.row is not None]
    jac = np.concatenate([part.jac.reshape(-1, x.size) for part in parts])
    taken = _taken(jac[:, rig], problem.prior_sigma[rig])
    left = jac[:, ~rig] - taken @ (taken.T @ jac[:, ~rig])
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
    problem, x, settle = judgement.problem, judgement.x, judgement.settled
    identified = np.flatnonzero(~settle)
    spread = covariance_root(covariance)
    spread = spread[:, spread.any(axis=0)]
    columns = settle.copy()
    columns[identified] = spread.any(axis=1) | unseen.any(axis=1)
    prior = np.where(settle, problem.prior_sigma, np.inf)[columns]
    information = with_prior(observe(problem, x, columns), (problem.start - x)[columns], prior)
    # What was seen varies with its covariance as the prior, what was not without one; then the rig's unknowns.
    rig = np.eye(x.size)[columns][:, settle]
    of_robot, elsewhere = (np.zeros((x.size, part.shape[1])) for part in (spread, unseen))
    of_robot[identified], elsewhere[identified] = spread, unseen
    unknown = elsewhere[columns] @ _felt(information.root, elsewhere[columns], rig)
    ways = np.concatenate([of_robot[columns], unknown, rig], axis=1)
    k = ways.shape[1]
    along = np.concatenate([information.root @ ways, information.rhs[:, None]], axis=1)
    triangle = fold(fold(np.zeros((k + 1, k + 1)), along), np.eye(spread.shape[1], k + 1))
    parts = spectrum(triangle[:k, :k])
    root = half(parts)
    left = root.T @ (triangle[:k, :k].T @ triangle[:k, k])
    freedom = information.n_residuals + spread.shape[1] - int(seen(parts).sum())
    if freedom < 1:
        return None
    chi2 = max(information.chi2 - float(left @ left), 0.0)
    limit = float(special.chdtri(freedom, 1.0 - LEVEL))
    how = measured_order(table, np.ones(len(table), dtype=bool))
    fitted = Fitted(ways @ root, left)
    wrong = systematic_errors(problem, x, columns, fitted, FitChi2(chi2, freedom, chi2 <= limit), how)
    return Consistency(chi2, freedom, limit, wrong)


def _felt(root: Floats, unseen: Floats, rig: Floats) -> Floats:
    """(d, e) the combinations of ``unseen`` directions (k, d) that move the rows otherwise than the rig's unknowns (k, s) can.

    By more than MOVES of what a single parameter does, in the information's ``root`` (k, k).
    """
    basis, weight, _ = np.linalg.svd(root @ rig, full_matrices=False)
    basis = basis[:, weight > RANK_TOLERANCE * weight.max(initial=0.0)]
    moves = root @ unseen
    _, size, vt = np.linalg.svd(moves - basis @ (basis.T @ moves), full_matrices=False)
    return np.asarray(vt[size > MOVES * np.linalg.norm(root, axis=0).max(initial=0.0)].T)


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
