"""The score test of ``systematic``: whitened residuals, what can be off in them, and the chance of a drop of χ²."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.circumstances import Circumstances, beside_pose
from truearm.estimate.information import Information, half, spectrum
from truearm.estimate.problem import Problem, blocks
from truearm.estimate.residual_noise import residual_cov, whiten
from truearm.estimate.systematic_effects import Cause, Errors, error_columns, profile
from truearm.results import DriftWith, Effect
from truearm.types import Floats, Indices
from truearm.units import UNITS

LEVEL = 1e-3  # probability that a clean data set gives any finding
SPANS = 64  # of a family, tested at once
AT_ONCE = 100_000  # derivatives of each component, 0.8 MB: observations of so many are whitened at once
SEEN = 1e-8  # share of a column's square that must remain after the parameters
MOST_SHARED = 0.2  # check poses are fewer; where no other pose has several rows, their errors are part of the noise


class Measured(NamedTuple):
    """The circumstances in which n rows were measured, in order."""

    row: Indices  # (n,) in the user's table
    table: Circumstances  # of all rows of that table
    session: Indices  # (n,) numbers; a drift extends over one session
    run: Indices  # (n,) numbers; the same items are mounted during a run
    pose: Indices  # (n,) numbers; residuals of one pose have correlated errors

    @property
    def total(self) -> int:
        """Return the number of rows of the user's table."""
        return len(self.table)

    @property
    def shared(self) -> bool:
        """Return whether errors of a pose would add more than MOST_SHARED to the variance of a sum over the rows."""
        count = np.unique(self.pose, return_counts=True)[1]
        return float((count.astype(float) ** 2).sum()) > (1.0 + MOST_SHARED) * self.pose.size


class FitChi2(NamedTuple):
    """χ² of the fit, its degrees of freedom, and the upper limit of χ²/ν; 0 if the noise is not the declared one."""

    chi2: float
    freedom: float
    limit: float

    @property
    def explained(self) -> bool:
        """Return whether the declared noise explains χ²."""
        return self.chi2 <= self.limit * self.freedom

    def more(self, drop: float, freedom: int) -> FitChi2:
        """Return χ² with fewer parameters."""
        return FitChi2(self.chi2 + drop, self.freedom + freedom, self.limit)

    def less(self, drop: float, freedom: int) -> FitChi2:
        """Return χ² with further parameters; after gross errors only rounding may be left."""
        return FitChi2(max(self.chi2 - drop, 1e-9 * self.chi2), max(self.freedom - freedom, 1.0), self.limit)


class Fitted(NamedTuple):
    """The directions that the parameters follow.

    These are columns S (k, r) with S Sᵀ the covariance, including prior information about the rig, and the remaining
    step along them (r,).
    """

    root: Floats
    left: Floats

    @classmethod
    def of(cls, fit: Information) -> Fitted:
        root = half(spectrum(fit.root))
        return cls(root, root.T @ (fit.root.T @ fit.rhs))


class WhitenedResiduals(NamedTuple):
    """The rows' m scalar residuals in the order of measurement, minus the parameters' part; parameter knowledge follows.

    Findings that became parameters are further columns ``added`` of Q. They stand alone because ``basis`` is large, and
    the same for all tests of a fit.
    """

    row: Indices  # (m,) of the n fitted rows, n for knowledge
    basis: Floats  # (m, r) Q
    residual: Floats  # (m,) e⊥
    errors: Floats  # (m, c) whitened ``error_columns``
    added: Floats  # (m, D)

    def of(self, some: slice | NDArray[np.bool_] | Indices) -> Floats:
        """Return some rows of Q with the added columns (·, r + D)."""
        return np.concatenate([self.basis[some], self.added[some]], axis=1)

    def along(self, by: Floats) -> Floats:
        """Return byᵀQ (d, r + D) of columns (m, d)."""
        return np.concatenate([by.T @ self.basis, by.T @ self.added], axis=1)

    def without(self, by: Floats) -> Floats:
        """Return the part of columns (m, d) that Q does not span."""
        return np.asarray(by - self.basis @ (self.basis.T @ by) - self.added @ (self.added.T @ by))


class Family(NamedTuple):
    """Candidates of one item and form: effects in the fitted rows from ``first`` up to but excluding ``last`` (w,).

    Findings change neither CᵀC nor what the parameters of the fit leave of it, so these are summed once.
    """

    cause: Cause | None  # None: blocks of rows, which have neither
    first: Indices
    last: Indices
    drift: DriftWith | None = None
    runs: bool = False  # whether an error can begin and end between these rows only
    size: Floats = np.zeros(0)  # (w,) trace of CᵀC
    left: Floats = np.zeros((0, 0, 0))  # (w, d, d) V without findings

    def columns(self, errors: Errors, rows: WhitenedResiduals, how: Measured) -> Floats:
        """Return C (m, d) with the item off in all rows, or as its drift or backlash is (see ``by_profile``)."""
        assert self.cause is not None
        by = item_columns(self.cause, errors, rows)
        if self.drift:
            span = int(self.first[0]), int(self.last[0])
            of_rows = effect_profile(self.cause.name, self.drift, *span, how)
            if not self.drift.has_offset:
                of_rows[:-1] = beside_pose(of_rows[:-1], how.table.q[how.row])
            by = by_profile(by, self.drift, of_rows[rows.row])
        return by

    def summed(self, errors: Errors, rows: WhitenedResiduals, how: Measured) -> Family:
        """Return the family with its sums."""
        by = self.columns(errors, rows, how)
        d = by.shape[1]
        size, left = np.zeros(self.first.size), np.zeros((self.first.size, d, d))
        for some, sums in self.sums(by, (by, rows.basis), rows):
            square, by_basis = sums[:, :, :d], sums[:, :, d:]
            size[some] = np.trace(square, axis1=1, axis2=2)
            left[some] = square - by_basis @ by_basis.swapaxes(1, 2)
        return self._replace(size=size, left=left)

    def sums(self, by: Floats, of: Sequence[Floats], rows: WhitenedResiduals) -> Iterator[tuple[slice, Floats]]:
        """Return CᵀX (s, d, ·) for columns X (m, ·), the arrays ``of`` side by side, for SPANS candidates at a time.

        ``by`` (m, d) are the ``columns``, which a candidate's C has in its rows.
        """
        edges, at = np.unique(np.concatenate([self.first, self.last]), return_inverse=True)
        cuts = np.searchsorted(rows.row, edges)
        ends = np.cumsum([0, *(part.shape[1] for part in of)])
        upto = np.zeros((edges.size, by.shape[1], ends[-1]))
        for i, (a, b) in enumerate(pairwise(cuts)):
            for part, (left, right) in zip(of, pairwise(ends), strict=True):
                upto[i + 1, :, left:right] = by[a:b].T @ part[a:b]
        upto = np.cumsum(upto, axis=0, out=upto)
        w = self.first.size
        for k in range(0, w, SPANS):
            some = slice(k, min(k + SPANS, w))
            yield some, upto[at[w:][some]] - upto[at[:w][some]]


class Best(NamedTuple):
    """A family's most probable candidate, off in the fitted rows from ``first`` up to but excluding ``last``.

    ``within`` is the range of each of the two, of candidates that together have the probability LIKELY.
    ``log_count`` is the logarithm of the number of candidates, ``log_p`` that of the probability of such a drop by
    chance in the family, ``evidence`` that of its evidence. ``rivals`` explain the data nearly as well.
    """

    family: Family
    first: int
    last: int
    drop: float
    freedom: int
    log_count: float
    log_p: float
    evidence: float
    within: tuple[tuple[int, int], tuple[int, int]]
    rivals: tuple[str, ...] = ()


class ScoreTest(NamedTuple):
    """The rows of a fit to test: what can be off in them, how they were measured, χ², and the number of families.

    ``inflation`` is the factor by which unexplained errors that are correlated in the order of measurement enlarge drops
    of χ².
    """

    errors: Errors
    rows: WhitenedResiduals
    how: Measured
    state: FitChi2
    log_families: float
    inflation: float = 1.0

    def given(self, found: Sequence[Best]) -> ScoreTest:
        """Return the test with some findings as further parameters."""
        rows, state = self.rows, self.state
        for one in found:
            added = directions(effect_columns(one, self.errors, rows, self.how), rows)
            along = added.T @ rows.residual
            rows = rows._replace(
                added=np.concatenate([rows.added, added], axis=1), residual=rows.residual - added @ along
            )
            state = state.less(float(along @ along), along.size)
        return self._replace(rows=rows, state=state)

    def by_chance(self, log_p: float) -> bool:
        """Return whether clean data give such a probability within a family more often than LEVEL."""
        return log_p + self.log_families > math.log(LEVEL)


def whiten_rows(problem: Problem, x: Floats, columns: NDArray[np.bool_], fit: Fitted) -> WhitenedResiduals:
    """Return the whitened rows at x, in order."""
    k, r = fit.root.shape
    c, p = len(problem.errors.names), problem.n_robot
    some = [block for block in blocks(problem, max(1, AT_ONCE // (k + c))) if block.row is not None]
    of_rows = [np.repeat(block.row, block.sensor_cov.shape[1]) for block in some if block.row is not None]
    row = np.concatenate([np.zeros(0, dtype=np.intp), *of_rows])
    m = row.size
    if not m:
        return WhitenedResiduals(row, np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0)))
    order = np.argsort(row, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(m)
    # Block by block into arrays with room for knowledge: with many rows, each copy of one would be tens of megabytes.
    basis, errors, residual = np.empty((m + r, r)), np.zeros((m + r, c)), np.empty(m + r)
    at = 0
    for block in some:
        lin = block.opened(problem.chain, x)
        by_robot, by_rig = lin.wrenches @ lin.twists[:, columns[:p]], lin.jac_rig[:, :, : x.size - p]
        residuals = lin.residual.reshape(len(block.sensor_cov), -1).T[:, :, None]
        parts = [by_robot, by_rig[:, :, columns[p:]], error_columns(lin, problem.errors.bodies), residuals]
        stacked = np.concatenate([np.moveaxis(part, 2, 0) for part in parts])
        whiten(stacked, residual_cov(block.sensor_cov, lin.jac_joints, problem.joint_cov))
        whole = stacked.transpose(2, 1, 0).reshape(-1, len(stacked))
        mine = place[at : at + len(whole)]
        basis[mine], errors[mine], residual[mine] = whole[:, :k] @ fit.root, whole[:, k:-1], whole[:, -1]
        at += len(whole)
    residual[:m] -= basis[:m] @ fit.left
    if not np.isfinite(residual[:m]).all() or not np.isfinite(basis[:m]).all():
        return WhitenedResiduals(row[order], basis[:m], np.full(m, np.nan), errors[:m], np.zeros((m, 0)))
    known, off = _knowledge(basis[:m], residual[:m])
    end = m + off.size
    # Where the data hardly determine a direction, S has lost digits; a row that alone determines it must have no
    # residual.
    basis[m:end], residual[m:end] = known, off
    basis, residual = basis[:end], residual[:end]
    lower = np.linalg.cholesky(basis.T @ basis)
    basis = scipy.linalg.solve_triangular(lower, basis.T, lower=True, overwrite_b=True).T
    row = np.concatenate([row[order], np.full(off.size, problem.n_rows)])
    return WhitenedResiduals(row, basis, residual - basis @ (basis.T @ residual), errors[:end], np.zeros((end, 0)))


def _knowledge(basis: Floats, residual: Floats) -> tuple[Floats, Floats]:
    """Return rows (k, r) that complete a basis (m, r) to an orthonormal one, and their residuals (k,).

    The basis is then orthogonal to the residuals. Systematic errors do not enter these rows, so prior information
    matters only through how strongly it constrains the parameters.
    """
    values, vectors = np.linalg.eigh(identity_minus(basis.T))
    some = values > SEEN
    root, along = np.sqrt(values[some]), vectors[:, some].T
    del vectors
    off = -(along @ (basis.T @ residual)) / root
    along *= root[:, None]
    return along, off


def identity_minus(q: Floats, more: float = 0.0) -> Floats:
    """Return (1 + more) I − q qᵀ (n, n) of q (n, r), without a further matrix of this size."""
    out = q @ q.T
    np.negative(out, out=out)
    out[range(len(out)), range(len(out))] += 1.0 + more
    return np.asarray(out)


def item_columns(cause: Cause, errors: Errors, rows: WhitenedResiduals) -> Floats:
    """Return the change (m, d) of the whitened predictions by an item, each number off by the weak prior of its unit."""
    weak = [UNITS[errors.unit(number)].weak_sigma for number in cause.numbers]
    return np.asarray(rows.errors[:, errors.indices(cause.numbers)] * weak)


def unfollowed(square: Floats, by_basis: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return eigenvalues (…, d) and vectors of V = CᵀC − (QᵀC)ᵀ(QᵀC), and which of them are significant."""
    values, vectors = np.linalg.eigh(square - by_basis @ np.swapaxes(by_basis, -1, -2))
    return values, vectors, values > SEEN * np.trace(square, axis1=-2, axis2=-1)[..., None]


def log_chance(drop: Floats, freedom: Indices, state: FitChi2) -> Floats:
    """Return the log probability of such a drop by chance; 0 without a degree of freedom."""
    d = np.maximum(freedom, 1).astype(float)
    if state.explained:
        p, half_drop = special.chdtrc(d, drop), np.maximum(drop, 1e-300) / 2.0
        tail = (d / 2.0 - 1.0) * np.log(half_drop) - half_drop - special.gammaln(d / 2.0)
    else:
        # F(d, ν − d) of drop/d over the remaining variance; its tail is an incomplete beta function of the remaining
        # χ².
        a = np.maximum(state.freedom - d, 0.5) / 2.0
        left = np.clip(1.0 - drop / state.chi2, 1e-300, 1.0 - 1e-15)  # rounding can make a drop exceed χ²
        p = special.betainc(a, d / 2.0, left)
        tail = a * np.log(left) + (d / 2.0 - 1.0) * np.log1p(-left) - np.log(a) - special.betaln(a, d / 2.0)
    deep = p < 1e-280
    return np.where(freedom == 0, 0.0, np.where(deep, tail, np.log(np.where(deep, 1.0, p))))


def effect_of(best: Best, how: Measured) -> Effect | None:
    """Return the candidate as an effect in rows of the user's table."""
    if best.family.cause is None:
        return None
    first, last = span_in_table(best.first, best.last, how)
    return Effect(best.family.cause.name, first, None if last == how.total else last, best.family.drift)


def span_in_table(first: int, last: int, how: Measured) -> tuple[int, int]:
    """Return the first row and the one after the last in the user's table, from those among the fitted rows."""
    return (int(how.row[first]) if first else 0), (how.total if last == how.row.size else int(how.row[last]))


def label(best: Best, how: Measured) -> str:
    effect = effect_of(best, how)
    first, last = span_in_table(best.first, best.last, how)
    return f"rows {first + 1} to {last}" if effect is None else str(effect)


def effect_profile(what: str, drift: DriftWith | None, first: int, last: int, how: Measured) -> Floats:
    """Return the profile (n + 1,) over the fitted rows, with 0 for knowledge."""
    return np.append(profile(Effect(what, *span_in_table(first, last, how), drift), how.table)[how.row], 0.0)


def effect_columns(best: Best, errors: Errors, rows: WhitenedResiduals, how: Measured) -> Floats:
    """Return the effect's change (m, d) of the whitened predictions; for a block, one column per residual."""
    cause, drift = best.family.cause, best.family.drift
    if cause is None:
        a, b = np.searchsorted(rows.row, [best.first, best.last])
        return np.eye(rows.row.size, b - a, -a)
    of_rows = effect_profile(cause.name, drift, best.first, best.last, how)[rows.row]
    return by_profile(item_columns(cause, errors, rows), drift, of_rows)


def by_profile(by: Floats, drift: DriftWith | None, profile_of_rows: Floats) -> Floats:
    """Return columns (m, d) times a profile (m,); for a drift followed by the columns themselves (m, 2d in total).

    The second half is an offset, needed because the moment at which a drifting item was correct is unknown.
    """
    out = np.asarray(by * profile_of_rows[:, None])
    return np.concatenate([out, by], axis=1) if drift and drift.has_offset else out


def directions(by: Floats, rows: WhitenedResiduals) -> Floats:
    """Return an orthonormal basis (m, d') of the part of the columns (m, d) that the parameters cannot follow."""
    left = rows.without(rows.without(by))
    _, vectors, seen = unfollowed(by.T @ by, rows.along(by))
    # The lengths of V's smallest directions are known to rounding only, so the columns themselves are made orthonormal.
    return np.asarray(np.linalg.qr(left @ vectors[:, seen])[0])
