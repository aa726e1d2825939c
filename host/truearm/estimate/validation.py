"""Validation of a robot on observations that it was not fitted to: which rows can be used, and what they show.

Unknowns of the rig (a socket's position, a line's pose) are estimated from the validation rows themselves, with the
robot fixed. Rows that fit such unknowns exactly, whatever the reading, are not used. Unknowns that the identification
estimated can be kept; they are then validated together with the robot.

How large the errors should be follows from the covariance P of the robot and of what is kept with it
(docs/explanation/estimation.md). One χ² test decides. With P as the prior, the minimum sum of squares of data and
priors is χ². Its degrees of freedom are the residuals and priors in excess of unknowns. This accounts for errors that
rows share. Null directions have no prior. ``checks`` examines the residuals like those of any other fit.

The mean error at poses that were not fitted has an interval, and is compared with that of the nominal robot
(``mean_errors``, ``with_gain``): rows of one pose have correlated errors, so poses are counted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.circumstances import poses
from truearm.estimate.fit import fit
from truearm.estimate.identifiability import project_out
from truearm.estimate.information import RANK_TOLERANCE, fold, half, observe, seen, spectrum, with_prior
from truearm.estimate.problem import Problem, build_problem, settled, without_knowledge
from truearm.estimate.uncertainty import covariance_root
from truearm.estimate.whitened_rows import whitened_blocks
from truearm.kinds.group import unit_columns
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import MOVES, Effect, Estimate, Gain, MeanChange, MeanError, Unusable
from truearm.types import Floats, Indices, Residuals, Rigs

NOTHING: Mapping[str, float] = MappingProxyType({})
CONFIDENCE = 0.99  # probability that a consistent session is reported as consistent
FELT = 1e-6  # of the effect of a single parameter
LEAST_FREEDOM = 1e-6  # share of a row's residuals that must remain for validation; rounding leaves 1e-12
MEAN_CONFIDENCE = 0.95  # of the interval of a mean error
LEAST_POSES = 2
CHANCE = 0.05  # of poses that seem to differ
SMALLEST = 1e-9  # m, rad: rounding of exact data is less


class Judgement(NamedTuple):
    """The errors of a robot on n rows."""

    residual: Residuals
    judging: NDArray[np.bool_]  # (n,) False for rows that fit whatever the reading
    problem: Problem
    x: Floats  # (P,)
    settled: NDArray[np.bool_]  # (P,) unknowns of the rig estimated on these rows; all others are as identified

    @property
    def error(self) -> Residuals:
        """Return the magnitudes of the residuals."""
        return {unit: np.abs(residual) for unit, residual in self.residual.items()}

    @property
    def identified(self) -> tuple[str, ...]:
        """Return the names of the parameters kept as identified: the robot's, then those of the rig."""
        return tuple(name for name, settled in zip(self.problem.names, self.settled, strict=True) if not settled)


class Expected(NamedTuple):
    """The expected errors on n rows if the robot is as identified: mean squares of the errors in one SI unit.

    NaN and False for rows without such an error.
    """

    by_noise: Floats  # (n,) from the sigmas declared in rig and table
    by_parameters: Floats  # (n,) from the parameters' covariance
    unseen: NDArray[np.bool_]  # (n,) rows affected by a null direction of the identification


def judge(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    params: Floats,
    kept: Mapping[str, float] = NOTHING,
    place: NDArray[np.bool_] | None = None,
    allowed: Sequence[Effect] = (),
) -> Judgement:
    """Evaluate the robot with parameters (p,) on a table.

    Raises ProblemError for the same reasons as ``build_problem``.

    kept : values of the rig's unknowns, by name, that are kept instead of estimated; others are skipped.
    allowed : systematic errors in all rows that the identification estimated; those that are kept are parameters here
    too.
    place : (p,) parameters of the robot that are fitted to these rows like the rig's unknowns: the pose of base and
    tool.
    """
    plain = build_problem(chain, rig, table)
    causes = {cause.name: cause for cause in plain.causes}
    modelled = [effect for effect in allowed if effect.what in causes and set(causes[effect.what].numbers) <= set(kept)]
    problem = build_problem(chain, rig, table, None, modelled) if modelled else plain
    return judge_problem(problem, {**dict(zip(chain.parameter_names, params, strict=True)), **kept}, place)


def judge_problem(problem: Problem, known: Mapping[str, float], place: NDArray[np.bool_] | None = None) -> Judgement:
    """Evaluate the rows of a problem with the robot, and the unknowns of the rig, that are ``known`` by name.

    place : (p,) parameters of the robot that are fitted nevertheless.
    """
    # The known distance between sockets must not help to place them: the error is the spread about each socket.
    problem = without_knowledge(problem)
    settle = np.array([name not in known for name in problem.names])
    columns = settle.copy()
    columns[: problem.n_robot] |= False if place is None else place
    solution = fit(problem, columns, problem.at(known))
    judging = has_freedom(problem, columns, solution.x)
    return Judgement(solution.information.residual, judging, problem, solution.x, settle)


def expected(judgement: Judgement, covariance: Floats, unseen: Floats) -> Mapping[str, Expected]:
    """Return the expected errors on the rows of a judgement, by SI unit.

    ``covariance`` (k, k) and the null directions ``unseen`` (k, d), each with a largest weight of 1, are those of the
    parameters kept as identified.
    """
    problem, x, rig = settled(judgement.problem, judgement.x), judgement.x, judgement.settled
    blocks = [block for block in whitened_blocks(problem, x, np.ones(x.size, dtype=bool)) if block.row is not None]
    jac = np.concatenate([block.jac.reshape(-1, x.size) for block in blocks])
    settled_basis = _taken(jac[:, rig], problem.prior_sigma[rig])
    remaining = jac[:, ~rig] - settled_basis @ (settled_basis.T @ jac[:, ~rig])
    due = {
        unit: Expected(np.full(problem.n_rows, np.nan), np.full(problem.n_rows, np.nan), np.zeros(problem.n_rows, bool))
        for unit in judgement.residual
    }
    first = 0
    for block in blocks:
        n, width, _ = block.jac.shape
        scalars = slice(first, first + n * width)
        for unit, components in unit_columns(block.components).items():
            root, to = block.noise_root[:, components], due[unit]
            fitted, by_robot = (root @ columns[scalars].reshape(n, width, -1) for columns in (settled_basis, remaining))
            to.by_noise[block.row] = np.maximum((root**2).sum(axis=(1, 2)) - (fitted**2).sum(axis=(1, 2)), 0.0)
            square = np.einsum("nwp,pr,nwr->n", by_robot, covariance, by_robot, optimize=True)
            to.by_parameters[block.row] = np.maximum(square, 0.0)
            to.unseen[block.row] = np.abs(by_robot @ unseen).max(axis=(1, 2), initial=0.0) > MOVES
        first += n * width
    return due


class Ways(NamedTuple):
    """Directions ``matrix`` (k, r) in which the parameters in ``columns`` (P,) may differ from those of a judgement.

    The first ``known`` have the prior N(0, 1): together they have the covariance of the calibration.
    """

    columns: NDArray[np.bool_]
    matrix: Floats
    known: int


class Consistency(NamedTuple):
    """Consistency of the rows with declared noise and the calibration's covariance.

    ``chi2`` with ``freedom`` degrees is at most ``limit`` with probability CONFIDENCE if the robot is as identified.
    """

    chi2: float
    freedom: int
    limit: float
    ways: Ways


def consistency(judgement: Judgement, covariance: Floats, unseen: Floats) -> Consistency | None:
    """Test a judgement; arguments as for ``expected``. None without a degree of freedom."""
    problem, x, settle = judgement.problem, judgement.x, judgement.settled
    identified = np.flatnonzero(~settle)
    spread = covariance_root(covariance)
    spread = spread[:, spread.any(axis=0)]
    columns = settle.copy()
    columns[identified] = spread.any(axis=1) | unseen.any(axis=1)
    prior = np.where(settle, problem.prior_sigma, np.inf)[columns]
    information = with_prior(observe(problem, x, columns), (problem.start - x)[columns], prior)
    # Identified directions have their covariance as the prior, null directions have none; then the rig's unknowns.
    rig = np.eye(x.size)[columns][:, settle]
    of_robot, elsewhere = (np.zeros((x.size, matrix.shape[1])) for matrix in (spread, unseen))
    of_robot[identified], elsewhere[identified] = spread, unseen
    unknown = elsewhere[columns] @ _felt(information.root, elsewhere[columns], rig)
    directions = np.concatenate([of_robot[columns], unknown, rig], axis=1)
    k = directions.shape[1]
    along = np.concatenate([information.root @ directions, information.rhs[:, None]], axis=1)
    triangle = fold(fold(np.zeros((k + 1, k + 1)), along), np.eye(spread.shape[1], k + 1))
    decomposition = spectrum(triangle[:k, :k])
    root = half(decomposition)
    reduction = root.T @ (triangle[:k, :k].T @ triangle[:k, k])
    freedom = information.n_residuals + spread.shape[1] - int(seen(decomposition).sum())
    if freedom < 1:
        return None
    chi2 = max(information.chi2 - float(reduction @ reduction), 0.0)
    limit = float(special.chdtri(freedom, 1.0 - CONFIDENCE))
    return Consistency(chi2, freedom, limit, Ways(columns, directions, spread.shape[1]))


def _felt(root: Floats, unseen: Floats, rig: Floats) -> Floats:
    """Return combinations (d, e) of ``unseen`` directions (k, d) that move the rows as no rig's unknowns (k, s) can.

    They do so by more than FELT times the effect of a single parameter, in the information's ``root`` (k, k).
    """
    _, size, vt = np.linalg.svd(project_out(root @ unseen, root @ rig), full_matrices=False)
    return np.asarray(vt[size > FELT * np.linalg.norm(root, axis=0).max(initial=0.0)].T)


def _taken(jac: Floats, prior_sigma: Floats) -> Floats:
    """Return U₁ (m, r) of whitened derivatives (m, u) by the rig's unknowns."""
    has_prior = np.isfinite(prior_sigma)
    stacked = np.concatenate([jac, np.diag(1.0 / np.where(has_prior, prior_sigma, np.inf))[has_prior]])
    stacked = stacked / np.maximum(np.linalg.norm(stacked, axis=0), 1e-300)
    basis, weight, _ = np.linalg.svd(stacked, full_matrices=False)
    return np.asarray(basis[: len(jac), weight > RANK_TOLERANCE * weight.max(initial=0.0)])


def has_freedom(problem: Problem, columns: NDArray[np.bool_], x: Floats) -> NDArray[np.bool_]:
    """Return a mask (n,) of rows that the unknowns x[columns], estimated on them, cannot fit whatever the reading.

    The trace of a row's block of the hat matrix J (JᵀJ)⁺ Jᵀ equals its number of residuals if they fit by construction,
    as for the only seat in a socket.
    """
    free = np.ones(problem.n_rows, dtype=bool)
    if not columns.any():
        return free
    groups = [group for group in problem.groups if group.row is not None]
    jac = [group.evaluate(problem.chain, x).jac_by(columns) for group in groups]
    hat = (_taken(np.concatenate(jac), np.full(int(columns.sum()), np.inf)) ** 2).sum(axis=1)
    for group, share in zip(groups, np.split(hat, np.cumsum([len(rows) for rows in jac])[:-1]), strict=True):
        free[group.row] = share.reshape(len(group.sensor_cov), -1).mean(axis=1) <= 1.0 - LEAST_FREEDOM
    return free


def mean_errors(error: Residuals, pose: Indices, held_out: bool) -> Mapping[str, MeanError]:
    """Return mean errors by SI unit, from the errors (n,) of rows (NaN for none) and their poses' numbers (n,).

    The interval is that of the mean of the poses' mean errors (Student's t). Without held-out rows, each pose was left
    out in turn (``row_errors``). Empty for fewer than two poses.
    """
    means = {}
    for unit, errors in error.items():
        (by_pose,) = pose_means(pose, errors)
        n = by_pose.size
        if n < LEAST_POSES:
            continue
        half = float(special.stdtrit(n - 1, (1.0 + MEAN_CONFIDENCE) / 2.0) * by_pose.std(ddof=1) / np.sqrt(n))
        mean = float(by_pose.mean())
        means[unit] = MeanError(mean, max(mean - half, 0.0), mean + half, n, held_out)
    return means


def pose_means(pose: Indices, *errors: Floats) -> list[Floats]:
    """Return the mean magnitude of each of some errors (n,) at every pose that has rows with all of them."""
    judged = np.isfinite(errors).all(axis=0)
    _, number, count = np.unique(pose[judged], return_inverse=True, return_counts=True)
    return [np.bincount(number.ravel(), np.abs(error[judged])) / count for error in errors]


def with_gain(table: ObservationTable, estimate: Estimate) -> Estimate:
    """Return the estimate with its gain, and as not usable if it is worse than the nominal robot.

    Calibrated and nominal robot, with base and tool placed, are compared pose by pose. d is the mean magnitude of a
    pose's errors after the calibration, less that before. It is at most the distance between the two predictions, so no
    outlier dominates. t is the mean of d in its standard errors: better is below the quantile of Student's t for
    CHANCE, worse above that for 1 − CHANCE. With residuals in several units, a robot that is better in one of them is
    better. Unchanged if it is not usable already, or did not converge: then its errors say nothing.
    """
    if estimate.unusable or estimate.status != "converged":
        return estimate
    changes = mean_changes(estimate.unfitted_error_before, estimate.unfitted_error, poses(table))
    estimate = replace(estimate, mean_change=changes)
    return replace(estimate, unusable=Unusable.WORSE) if gain_of(changes) is Gain.WORSE else estimate


def gain_of(changes: Mapping[str, MeanChange]) -> Gain | None:
    """Return the gain over all units: that of the best one; None if there is nothing to compare."""
    gains = {change.gain for change in changes.values()}
    order = (Gain.BETTER, Gain.WORSE, Gain.NONE)
    return next((gain for gain in order if gain in gains), None)


def mean_changes(before: Residuals, after: Residuals, pose: Indices) -> Mapping[str, MeanChange]:
    """Return mean errors by SI unit, from the errors (n,) of rows (NaN for none) and their poses' numbers (n,)."""
    changes = {}
    for unit in before:
        nominal, calibrated = pose_means(pose, before[unit], after[unit])
        if nominal.size >= LEAST_POSES:
            gain = _gain(calibrated - nominal)
            changes[unit] = MeanChange(float(nominal.mean()), float(calibrated.mean()), nominal.size, gain)
    return changes


def _gain(change: Floats) -> Gain:
    """Return the gain for the changes (n,) of the poses' mean errors."""
    standard_error = float(change.std(ddof=1)) / np.sqrt(change.size)
    threshold = float(special.stdtrit(change.size - 1, 1.0 - CHANCE)) * standard_error
    if change.mean() < -threshold:
        return Gain.BETTER
    return Gain.WORSE if change.mean() > max(threshold, SMALLEST) else Gain.NONE
