"""The joint test of ``systematic``: which findings hold given all others, pose by pose and in held-out rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.systematic_score import (
    AT_ONCE,
    SEEN,
    Best,
    FitChi2,
    Measured,
    ScoreTest,
    WhitenedResiduals,
    effect_columns,
    log_chance,
)
from truearm.estimate.ties import first_within
from truearm.types import Floats

NOISIER = 5.0  # times the noise of the others: rows with less than that are noisier, but not off
STRETCHES, FOLDS = 40, 8  # of the order of measurement, to hold out
SURE = 2.0  # standard errors, of the held-out reduction and of an autocorrelation
LONGEST_LAG = 8  # of the poses, as a divisor, that autocorrelations are summed to


def confirmed(found: Sequence[Best], test: ScoreTest, together: ScoreTest) -> tuple[list[Best], ScoreTest]:
    """Return the findings that hold with all others as parameters, with their figures of this joint test.

    ``together`` is the ``test`` with all of them as parameters. Also returns it with those that hold, and the inflation
    of drops of χ² by the errors that remain.
    """
    left = list(found)
    while True:
        together = together._replace(
            inflation=1.0 if together.state.explained else path_inflation(together.rows, test.how)
        )
        again, own = _jointly(left, test, together)
        worst = first_within([of.log_p for of in again]) if again else None
        if worst is None or not test.by_chance(again[worst].log_p):
            return again, together
        del left[worst]
        together = _given_up(own[worst], test, together)


def _given_up(own: Floats, test: ScoreTest, together: ScoreTest) -> ScoreTest:
    """Return ``together``, the ``test`` with D further directions, without those of one finding, ``own`` (D, d)."""
    rows, before = together.rows, test.rows.added
    along, rest = rows.added[:, before.shape[1] :], np.linalg.svd(own)[0][:, own.shape[1] :]
    step = own.T @ (along.T @ test.rows.residual)
    without = rows._replace(
        added=np.concatenate([before, along @ rest], axis=1), residual=rows.residual + along @ (own @ step)
    )
    return together._replace(rows=without, state=together.state.more(float(step @ step), step.size))


class _LeftOut(NamedTuple):
    """Residuals by fits without their poses, squared residuals by fits without their folds, and rows that judge, (m,)."""

    pose: Floats
    fold: Floats  # (0,) where declared noise explains χ²
    judging: NDArray[np.bool_]

    @classmethod
    def of(cls, test: ScoreTest, how: Measured) -> _LeftOut:
        fold = np.zeros(0) if test.state.explained else held_out_squares(test.rows, how)
        return cls(_left_out(test.rows, how), fold, judging_rows(test.rows, how))


def _jointly(found: Sequence[Best], test: ScoreTest, together: ScoreTest) -> tuple[list[Best], list[Floats]]:
    """Return the findings, each with its figures given all others; a probability of 1 if held-out rows do not confirm it.

    ``together`` is the ``test`` with all of them as parameters, along ``along`` (m, D). The directions (D, d) of one
    that are not those of the others are found among these D, and returned too. Findings after one with a probability of
    1 are not tested: none can be less certain.
    """
    along = together.rows.added[:, test.rows.added.shape[1] :]
    columns = [effect_columns(one, test.errors, test.rows, test.how) for one in found]
    ways, step = [along.T @ of for of in columns], along.T @ test.rows.residual
    explained = together.state.explained
    by_poses, of_rows = not explained or test.how.shared, None
    again, owns = [], []
    for i, (one, by) in enumerate(zip(found, columns, strict=True)):
        others = _span_of([of for k, of in enumerate(ways) if k != i], along.shape[1])
        left = ways[i] - others @ (others.T @ ways[i])
        values, vectors = np.linalg.eigh(left.T @ left)
        seen = values > SEEN * np.trace(by.T @ by)
        own = left @ vectors[:, seen] / np.sqrt(values[seen])
        owns.append(own)
        drop, freedom = float(((own.T @ step) ** 2).sum()), own.shape[1]
        state = together.state if explained else together.state.more(drop, freedom)
        log_p = float(log_chance(np.array([drop / together.inflation]), np.array([freedom]), state)[0])
        noisier = one.family.cause is None and not test.state.explained  # without a block, χ² may be in its range
        if (by_poses or noisier) and not test.by_chance(log_p + one.log_count):
            of_rows = _LeftOut.of(together, test.how) if of_rows is None else of_rows
            log_p = max(log_p, _by_poses(one, own, test, together, of_rows))
        again.append(one._replace(drop=drop, freedom=freedom, log_p=min(log_p + one.log_count, 0.0)))
        if again[-1].log_p >= 0.0:
            break
    return again, owns


def _span_of(ways: Sequence[Floats], size: int) -> Floats:
    """Return an orthonormal basis (size, r) of some columns (size, ·)."""
    if not ways:
        return np.zeros((size, 0))
    basis, weight, _ = np.linalg.svd(np.concatenate(ways, axis=1), full_matrices=False)
    return np.asarray(basis[:, weight > math.sqrt(SEEN) * weight.max(initial=0.0)])


def _by_poses(one: Best, own: Floats, test: ScoreTest, together: ScoreTest, left_out: _LeftOut) -> float:
    """Return the log probability of a finding by chance without the assumption that residuals are independent.

    Where the noise is unknown it is 0 if held-out rows do not confirm the finding. ``together`` is the ``test`` with all
    findings as parameters along D further directions, of which ``own`` (D, d) are this finding's, and ``left_out`` belongs
    to it.
    """
    rows, how = together.rows, test.how
    added = rows.added[:, test.rows.added.shape[1] :] @ own
    found = added.T @ test.rows.residual
    if one.family.cause is None:
        log_p = _block_chance(one, test.state.explained, together.state, float(found @ found), how)
    else:
        log_p = _cluster_chance(found, added, left_out.pose, rows, together)
    if together.state.explained or test.by_chance(log_p + one.log_count):
        return log_p
    mine = rows.row < how.row.size
    gain = held_out_squares(_given_up(own, test, together).rows, how) - left_out.fold
    judging = left_out.judging & mine
    pose = how.pose[rows.row[judging]]
    of_pose = np.bincount(pose, gain[judging])[np.bincount(pose) > 0]
    error = math.sqrt(of_pose.size * float(of_pose.var()) * together.inflation)
    return log_p if of_pose.sum() > SURE * error else 0.0


def _cluster_chance(found: Floats, added: Floats, left_out: Floats, rows: WhitenedResiduals, test: ScoreTest) -> float:
    """Return the log probability of a size ``found`` (d,) along directions ``added`` (m, d) for clusters of poses.

    The directions are orthonormal, and ``left_out`` (m,) are the residuals by fits without their poses.
    """
    mine, d = rows.row < test.how.row.size, found.size
    pose = test.how.pose[rows.row[mine]]
    columns = added[mine].T.copy()
    scores = np.stack([np.bincount(pose, of * left_out[mine]) for of in columns], axis=1)
    weights = np.empty((len(scores), d, d))
    for i, j in zip(*np.tril_indices(d), strict=True):
        weights[:, i, j] = weights[:, j, i] = np.bincount(pose, columns[i] * columns[j])
    values, vectors = np.linalg.eigh(scores.T @ scores)
    if values[0] <= 0.0:
        return 0.0
    turn = vectors / np.sqrt(values)
    traces = np.trace(weights, axis1=1, axis2=2) ** 2 + (weights**2).sum(axis=(1, 2))
    fourth = ((scores @ turn) ** 2).sum(axis=1) ** 2
    clusters = min(d * (d + 1) / traces.sum(), d * (d + 2) / fourth.sum()) / test.inflation
    freedom = clusters - d + 1.0
    if freedom <= 0.0:
        return 0.0
    drop = float(((turn.T @ found) ** 2).sum()) / test.inflation * freedom / clusters
    unknown = FitChi2(drop + freedom, freedom + d, 0.0)
    return float(log_chance(np.array([drop]), np.array([d]), unknown)[0])


def _block_chance(one: Best, explained: bool, state: FitChi2, drop: float, how: Measured) -> float:
    """Return the log probability that rows which are not off, but whose errors a pose shares, fit this badly.

    ``state`` is χ² without the rows, which has fallen by ``drop``. In the worst case a pose is one residual.
    Where declared noise does not explain χ² with them, they may also be NOISIER than the others, which alone would bring
    χ² without them into its range.
    """
    poses = np.unique(how.pose[one.first : one.last]).size
    if explained:
        return float(log_chance(np.array([drop * poses / one.freedom]), np.array([poses]), state)[0])
    per_pose = one.freedom / poses
    drop /= per_pose * state.chi2 / state.freedom * NOISIER**2  # over the variance of the others
    freedom = max(state.freedom / per_pose, 1.0)
    of_poses = FitChi2(drop + freedom, freedom + poses, 0.0)
    return float(log_chance(np.array([drop]), np.array([poses]), of_poses)[0])


def _left_out(rows: WhitenedResiduals, how: Measured) -> Floats:
    """Return the residuals (m,) of each pose by the fit without it, linearised: (I − Q_g Q_gᵀ)⁻¹ e_g; 0 for knowledge."""
    out, at = np.zeros(rows.row.size), np.flatnonzero(rows.row < how.row.size)
    pose = how.pose[rows.row[at]]
    at = at[np.argsort(pose, kind="stable")]
    _, first, size = np.unique(np.sort(pose), return_index=True, return_counts=True)
    width = rows.basis.shape[1] + rows.added.shape[1]
    for count in np.unique(size):
        starts = first[size == count]
        for some in np.array_split(starts, -(-starts.size * count * (width + count) // AT_ONCE)):
            which = at[some[:, None] + np.arange(count)]
            q = rows.of(which.ravel()).reshape(some.size, count, width)
            e = rows.residual[which][..., None]
            if count <= width:
                rest = np.eye(count) * (1.0 + SEEN) - q @ q.swapaxes(1, 2)
                out[which] = np.linalg.solve(rest, e)[..., 0]
            else:
                rest = np.eye(width) * (1.0 + SEEN) - q.swapaxes(1, 2) @ q
                out[which] = (e + q @ np.linalg.solve(rest, q.swapaxes(1, 2) @ e))[..., 0]
    return out


def path_inflation(rows: WhitenedResiduals, how: Measured) -> float:
    """Return the ratio of the variance of sums over consecutive poses to that of sums over independent ones, at least 1."""
    mine = rows.row < how.row.size
    order = np.argsort(how.pose[rows.row[mine]], kind="stable")
    pose, residual = how.pose[rows.row[mine]][order], rows.residual[mine][order]
    place = np.arange(pose.size) - np.searchsorted(pose, pose)
    series = np.zeros((int(pose[-1]) + 1, int(place.max()) + 1))
    series[pose, place] = residual
    # Products at all lags at once: with as many zeros after the series, its cyclic correlation is the ordinary one.
    waves = np.fft.rfft(series, 2 * len(series), axis=0)
    products = np.fft.irfft((np.abs(waves) ** 2).sum(axis=1))[: max(len(series) // LONGEST_LAG, 1)]
    if products[0] <= 0.0:
        return 1.0
    correlation = products[1:] / products[0]
    chance = correlation < SURE / math.sqrt(series.size)
    return 1.0 + 2.0 * float(correlation[: np.argmax(np.append(chance, True))].sum())


def judging_rows(rows: WhitenedResiduals, how: Measured) -> NDArray[np.bool_]:
    """Return a mask (m,) of all residuals except knowledge and those of blocks, which were left out."""
    lengths = sum(np.einsum("ij,ij->i", of, of) for of in (rows.basis, rows.added))
    return np.asarray((lengths < 1.0 - SEEN) & (rows.row < how.row.size))


def held_out_squares(rows: WhitenedResiduals, how: Measured) -> Floats:
    """Return squared residuals (m,) of each row by the fit without its fold, linearised: (I − Q_F Q_Fᵀ)⁻¹ e_F.

    A fold is every FOLDS-th of STRETCHES contiguous stretches of the order of measurement.
    """
    begins = -(-np.arange(STRETCHES + 1) * how.row.size // STRETCHES)
    stretches = [slice(a, b) for a, b in pairwise(np.searchsorted(rows.row, begins))]
    out, size = np.zeros(rows.row.size), rows.basis.shape[1] + rows.added.shape[1]  # knowledge is never held out
    for number in range(FOLDS):
        rest, along = np.eye(size) * (1.0 + SEEN), np.zeros(size)
        for mine in stretches[number::FOLDS]:
            q = rows.of(mine)
            rest -= q.T @ q
            along += q.T @ rows.residual[mine]
        by_basis, by_added = np.split(np.linalg.solve(rest, along), [rows.basis.shape[1]])
        for mine in stretches[number::FOLDS]:
            out[mine] = (rows.residual[mine] + rows.basis[mine] @ by_basis + rows.added[mine] @ by_added) ** 2
    return out
