"""The joint test of ``systematic``: which findings hold given all others, pose by pose and in held-out rows."""

from __future__ import annotations

import math
from collections.abc import Sequence

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
from truearm.types import Floats

NOISIER = 5.0  # times the noise of the others: rows with less than that are noisier, but not off
STRETCHES, FOLDS = 40, 8  # of the order of measurement, to hold out
SURE = 2.0  # standard errors, of the held-out reduction and of an autocorrelation
LONGEST_LAG = 8  # of the poses, as a divisor, that autocorrelations are summed to


def confirmed(found: Sequence[Best], test: ScoreTest) -> tuple[list[Best], float]:
    """Return the findings that hold with all others as parameters, with their figures of this joint test.

    Also returns the inflation of drops of χ² by the errors that remain.
    """
    left = list(found)
    while True:
        together = test.given(left)
        together = together._replace(
            inflation=1.0 if together.state.explained else path_inflation(together.rows, test.how)
        )
        again = _jointly(left, test, together)
        worst = max(range(len(left)), key=lambda i: again[i].log_p, default=None)
        if worst is None or not test.by_chance(again[worst].log_p):
            return again, together.inflation
        del left[worst]


def _jointly(found: Sequence[Best], test: ScoreTest, together: ScoreTest) -> list[Best]:
    """Return the findings, each with its figures given all others; a probability of 1 if held-out rows do not confirm it.

    ``together`` is the ``test`` with all of them as parameters, along ``along`` (m, D). The directions of one that are
    not those of the others are found among these D.
    """
    along = together.rows.added[:, test.rows.added.shape[1] :]
    columns = [effect_columns(one, test.errors, test.rows, test.how) for one in found]
    ways, step = [along.T @ of for of in columns], along.T @ test.rows.residual
    explained = together.state.explained
    by_poses, left_out = not explained or test.how.shared, None
    again = []
    for i, (one, by) in enumerate(zip(found, columns, strict=True)):
        others = _span_of([of for k, of in enumerate(ways) if k != i], along.shape[1])
        left = ways[i] - others @ (others.T @ ways[i])
        values, vectors = np.linalg.eigh(left.T @ left)
        seen = values > SEEN * np.trace(by.T @ by)
        own = left @ vectors[:, seen] / np.sqrt(values[seen])
        drop, freedom = float(((own.T @ step) ** 2).sum()), own.shape[1]
        state = together.state if explained else together.state.more(drop, freedom)
        log_p = float(log_chance(np.array([drop / together.inflation]), np.array([freedom]), state)[0])
        noisier = one.family.cause is None and not test.state.explained  # without a block, χ² may be in its range
        if (by_poses or noisier) and not test.by_chance(log_p + one.log_count):
            left_out = _left_out(together.rows, test.how) if left_out is None else left_out
            log_p = max(log_p, _by_poses(one, own, test, together, left_out))
        again.append(one._replace(drop=drop, freedom=freedom, log_p=min(log_p + one.log_count, 0.0)))
    return again


def _span_of(ways: Sequence[Floats], size: int) -> Floats:
    """Return an orthonormal basis (size, r) of some columns (size, ·)."""
    if not ways:
        return np.zeros((size, 0))
    basis, weight, _ = np.linalg.svd(np.concatenate(ways, axis=1), full_matrices=False)
    return np.asarray(basis[:, weight > math.sqrt(SEEN) * weight.max(initial=0.0)])


def _by_poses(one: Best, own: Floats, test: ScoreTest, together: ScoreTest, left_out: Floats) -> float:
    """Return the log probability of a finding by chance without the assumption that residuals are independent.

    Where the noise is unknown it is 0 if held-out rows do not confirm the finding. ``together`` is the ``test`` with all
    findings as parameters along D further directions, of which ``own`` (D, d) are this finding's, and ``left_out`` (m,)
    are its residuals by fits without their poses.
    """
    rows, how, before = together.rows, test.how, test.rows.added
    along = rows.added[:, before.shape[1] :]
    added = along @ own
    found = added.T @ test.rows.residual
    if one.family.cause is None:
        log_p = _block_chance(one, test.state.explained, together.state, float(found @ found), how)
    else:
        log_p = _cluster_chance(found, added, left_out, rows, together)
    if together.state.explained or test.by_chance(log_p + one.log_count):
        return log_p
    mine = rows.row < how.row.size
    rest = np.linalg.svd(own)[0][:, own.shape[1] :]
    without = rows._replace(
        added=np.concatenate([before, along @ rest], axis=1), residual=rows.residual + added @ found
    )
    gain, judging = held_out_squares(without, how) - held_out_squares(rows, how), judging_rows(rows, how)[mine]
    pose = how.pose[rows.row[mine]]
    of_pose = np.bincount(pose[judging], gain[mine][judging])[np.unique(pose[judging])]
    error = math.sqrt(of_pose.size * float(of_pose.var()) * together.inflation)
    return log_p if of_pose.sum() > SURE * error else 0.0


def _cluster_chance(found: Floats, added: Floats, left_out: Floats, rows: WhitenedResiduals, test: ScoreTest) -> float:
    """Return the log probability of a size ``found`` (d,) along directions ``added`` (m, d) for clusters of poses.

    The directions are orthonormal, and ``left_out`` (m,) are the residuals by fits without their poses.
    """
    mine, d = rows.row < test.how.row.size, found.size
    pose = test.how.pose[rows.row[mine]]
    scores, weights = np.zeros((int(pose.max()) + 1, d)), np.zeros((int(pose.max()) + 1, d, d))
    np.add.at(scores, pose, added[mine] * left_out[mine, None])
    np.add.at(weights, pose, added[mine][:, :, None] * added[mine][:, None, :])
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
    variance, total = float((series**2).sum()), 1.0
    if variance <= 0.0:
        return total
    for lag in range(1, len(series) // LONGEST_LAG):
        correlation = float((series[:-lag] * series[lag:]).sum()) / variance
        if correlation < SURE / math.sqrt(series.size):
            break
        total += 2.0 * correlation
    return total


def judging_rows(rows: WhitenedResiduals, how: Measured) -> NDArray[np.bool_]:
    """Return a mask (m,) of all residuals except knowledge and those of blocks, which were left out."""
    lengths = sum(np.einsum("ij,ij->i", of, of) for of in (rows.basis, rows.added))
    return np.asarray((lengths < 1.0 - SEEN) & (rows.row < how.row.size))


def held_out_squares(rows: WhitenedResiduals, how: Measured) -> Floats:
    """Return squared residuals (m,) of each row by the fit without its fold, linearised: (I − Q_F Q_Fᵀ)⁻¹ e_F.

    A fold is every FOLDS-th of STRETCHES contiguous stretches of the order of measurement.
    """
    stretch = (np.arange(how.row.size) * STRETCHES) // how.row.size
    out, fold = np.zeros(rows.row.size), np.append(stretch % FOLDS, FOLDS)[rows.row]  # knowledge is never held out
    for number in range(FOLDS):
        mine = fold == number
        q, e = rows.of(mine), rows.residual[mine]
        rest = np.eye(q.shape[1]) * (1.0 + SEEN) - q.T @ q
        out[mine] = (e + q @ np.linalg.solve(rest, q.T @ e)) ** 2
    return out
