"""Systematic errors in the residuals of a finished fit: what was off, from which row on, and by how much.

**Score test.** Let e (m,) be the whitened residuals, J their derivatives by all free parameters, and Q an orthonormal
basis of J's columns. Prior information about the rig enters as additional rows. A prior of the robot does not: a false
one would be reported as a systematic error. An item that is off has the whitened derivatives C (m, d): by a chuck's
coordinates, a bar's zero, a joint's reading or a motion of the base, each times a profile over the rows. With
C⊥ = (I − QQᵀ)C,

    V = C⊥ᵀC⊥ = CᵀC − (QᵀC)ᵀ(QᵀC) ,  β̂ = V⁺ Cᵀe⊥ ,  drop of χ² = eᵀC⊥ V⁺ C⊥ᵀe ~ χ²(rank V) without the error.

The drop is exactly that of refitting the linear problem with β free (added variables; Cook and Weisberg 1982, Rao
1948). Anything that the parameters can follow, such as a motion of all chucks that the base's parameters undo, has no
part in C⊥.

**Change points.** A step that begins at row k needs the sums of CᵀC, QᵀC and Cᵀe over the rows from k on, which are
differences of one cumulative sum. All steps of an item therefore cost as much as one. A joint that is off over an
interval of rows is searched for between every two of WINDOW_KNOTS.

**Drifts.** A drift is linear in time, from the first row of a session to its last, or linear in the box's temperature
if that changed. Its zero is unknown, so an offset is fitted with it.

**Blocks.** Rows that do not fit the rest: each first or last part of a run of rows with one item mounted. Leaving e_B
out reduces χ² by e_BᵀQ_B(I − Q_BᵀQ_B)⁻¹Q_Bᵀe_B + e_Bᵀe_B, which is χ² with as many degrees of freedom as e_B has
residuals.

**Multiplicity.** A family is all candidates of one item and form, such as "a step of chuck c2". By Bonferroni's
inequality, first within the family and then over the families, P(max over k > u) ≤ Σ P(χ²_k > u), the probability that
a clean data set gives any finding is at most LEVEL, regardless of how the candidates depend on each other.

**Which of several.** Steps of a chuck, of a sphere and of a joint explain much of the same residuals. Of those beyond
chance the most probable is reported. Each number of an item has the weak prior of its unit (``units``) and every start
row of a step is equally probable, so the logarithm of the evidence is ½ drop − ½ Σ log(1 + λ) − log(candidates), with λ
the eigenvalues of V in units of that prior (Kass and Raftery 1995). Candidates at least a hundredth as probable are
reported with it.

**Steps and gradual changes.** A zero that wanders for an hour looks like a step at some row, and as certain. With each
step, the evidence of a random walk of the same item, and of each that can drift, is therefore compared. One that is not
less probable is among the other explanations.

**Several errors.** The columns of the best finding are added to Q and the rest is searched again, until nothing beyond
chance is left. Then each finding is tested again with all others as parameters. If one is not beyond chance any more,
because another one explains the same residuals, the least probable is dropped and the search continues without its
family. The reported figures are those of this joint test.

**Gross errors.** If GROSS σ distort a fit, the first-order analysis shows only which rows distort it, so only blocks
are searched.

**Rows of one pose** have correlated errors: the arm's repeatability at that pose, and errors that the model lacks. Where
they could add more than MOST_SHARED to the variance of a sum over the rows, or χ²/ν is out of its range even with the
findings as parameters, a finding must also be beyond chance by the spread of its poses' scores. Their sum of squares
takes the place of V, with each residual from a fit without its pose, e_g → (I − H_gg)⁻¹e_g, because a few poses attract
the fit (the jackknife, CR3: Bell and McCaffrey 2002). The statistic follows Hotelling's T² with

    η = d(d + 1) / Σ_g [(tr W_g)² + tr W_g²]

degrees of freedom, where W_g is the share of pose g in V (Pustejovsky and Tipton 2018), or with those that the scores'
fourth moments show, if these are fewer: then some poses are noisier. A step in few poses is therefore hardly ever beyond
chance. Of a block, a pose counts as one residual.

**Where the model is wrong anyway.** If χ²/ν is outside its range, the noise is unknown. A drop with d degrees of
freedom is then tested against the remaining unexplained variance, F(d, ν − d), and in the joint test again by poses as
above. Along a path, poses that follow each other are close together, so smooth model errors are correlated in the order
of measurement and can mimic steps in it. The variance of every sum over that order is therefore multiplied by 1 + 2 Σ
ρ_k, with ρ_k the autocorrelation of the remaining residuals at a lag of k poses, summed as long as it is beyond chance
(Bartlett 1946). The rows of a block must be off by more than NOISIER times the noise of the others, because noise can
differ between rows. A finding must also reduce the sum of squares of rows held out in contiguous stretches of the order
by SURE standard errors, paired by pose.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.information import Information, half, spectrum
from truearm.estimate.problem import Problem, blocks
from truearm.estimate.residual_noise import residual_cov, whiten
from truearm.estimate.systematic_effects import Cause, Circumstances, Errors, error_columns, profile
from truearm.kinds.linearised import Indices
from truearm.types import DriftWith, Effect, Floats, OffBy, SystematicError, SystematicErrors
from truearm.units import UNITS

LEVEL = 1e-3  # probability that a clean data set gives any finding
MOST_FINDINGS = 6
MOST_STEPS = 400  # rows at which a step is searched for; of more, an evenly spaced selection
WINDOW_KNOTS = 36
WANDER_KNOTS = 12
WANDER_SIGMA = tuple(2.0**-k for k in range(7))  # of a step of a random walk, in priors of the item's unit
GROSS = 30.0  # σ of the noise: to first order, a fit this distorted shows only which rows distort it
LEAST_WARMING = 1.0  # °C: two steps of a microcontroller's internal sensor; less is not a temperature change
LEAST_ROWS = 5  # in which a step applies, and in which it does not: fewer are treated as outliers, one by one
AT_ONCE = 100_000  # derivatives of each component, 0.8 MB: observations of so many are whitened at once
SPANS = 64  # tested at once
MOST_BLOCK = 300  # rows: each of their residuals is a column
SEEN = 1e-8  # share of a column's square that must remain after the parameters
LIKELY = 0.95  # that an error begins and ends within the rows named
AS_LIKELY = math.log(100.0)  # explanations whose evidence differs by less are all reported
MOST_SHARED = 0.2  # check poses are fewer; where no other pose has several rows, their errors are part of the noise
NOISIER = 5.0  # times the noise of the others: rows with less than that are noisier, but not off
BLOCK_SIGMA = 10.0  # σ of the noise: how far a row that does not fit is off
STRETCHES, FOLDS = 40, 8  # of the order of measurement, to hold out
SURE = 2.0  # standard errors, of the held-out reduction and of an autocorrelation
LONGEST_LAG = 8  # of the poses, as a divisor, that autocorrelations are summed to


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


class _Whitened(NamedTuple):
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


class _Family(NamedTuple):
    """Candidates of one item and form: effects in the fitted rows from ``first`` up to but excluding ``last`` (w,)."""

    cause: Cause | None  # None: blocks of rows
    first: Indices
    last: Indices
    drift: DriftWith | None = None


class _Best(NamedTuple):
    """A family's most probable candidate, off in the fitted rows from ``first`` up to but excluding ``last``.

    ``within`` is the range of each of the two, of candidates that together have the probability LIKELY.
    ``log_count`` is the logarithm of the number of candidates, ``log_p`` that of the probability of such a drop by
    chance in the family, ``evidence`` that of its evidence. ``rivals`` explain the data nearly as well.
    """

    family: _Family
    first: int
    last: int
    drop: float
    freedom: int
    log_count: float
    log_p: float
    evidence: float
    within: tuple[tuple[int, int], tuple[int, int]]
    rivals: tuple[str, ...] = ()


class _Test(NamedTuple):
    """The rows of a fit to test: what can be off in them, how they were measured, χ², and the number of families.

    ``inflation`` is the factor by which unexplained errors that are correlated in the order of measurement enlarge drops
    of χ².
    """

    errors: Errors
    rows: _Whitened
    how: Measured
    state: FitChi2
    log_families: float
    inflation: float = 1.0

    def given(self, found: Sequence[_Best]) -> _Test:
        """Return the test with some findings as further parameters."""
        rows, state = self.rows, self.state
        for one in found:
            added = _directions(_effect_columns(one, self.errors, rows, self.how), rows)
            along = added.T @ rows.residual
            rows = rows._replace(
                added=np.concatenate([rows.added, added], axis=1), residual=rows.residual - added @ along
            )
            state = state.less(float(along @ along), along.size)
        return self._replace(rows=rows, state=state)

    def by_chance(self, log_p: float) -> bool:
        """Return whether clean data give such a probability within a family more often than LEVEL."""
        return log_p + self.log_families > math.log(LEVEL)


def systematic_errors(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], fit: Fitted, goodness: FitChi2, how: Measured
) -> SystematicErrors | None:
    """Return the errors beyond chance in a fit of the problem's ``columns`` that ended at x (P,).

    They are in the order of the search, each the most probable one given those before it. If the joint test drops one,
    the whole search is repeated without its family, from the findings that are left. The module docstring describes the
    tests. None if nothing is found, and for a fit without degrees of freedom or with
    residuals that are not finite.
    """
    rows = _whitened(problem, x, columns, fit)
    if not (rows.row.size and goodness.freedom >= 1.0 and np.isfinite([goodness.chi2, *rows.residual]).all()):
        return None
    gross = goodness.chi2 > GROSS**2 * goodness.freedom
    every = list(_blocks(how) if gross else _families(problem.causes, problem.errors, rows, how))
    test = _Test(problem.errors, rows, how, goodness, math.log(max(len(every), 1)))
    found: list[_Best] = []
    while True:
        searched = _searched(found, every, test)
        found, inflation = _confirmed(searched, test)
        dropped = [one.family for one in searched if all(one.family is not of.family for of in found)]
        if not dropped:
            break
        every = [family for family in every if all(family is not of for of in dropped)]
        test = test._replace(inflation=inflation)
    if not found:
        return None
    after = test.given(found)
    described, part = _described(found, test, after.state)
    shift = np.zeros(x.size)
    shift[columns] = -fit.root @ part
    before, left = (_held_out(of, how)[_judging(after.rows, how)].sum() for of in (rows, after.rows))
    ratio = math.sqrt(left / before) if before > 0.0 else math.nan
    return SystematicErrors(described, after.state.chi2 / max(after.state.freedom, 1.0), shift, held_out_ratio=ratio)


def _searched(found: Sequence[_Best], every: Sequence[_Family], test: _Test) -> list[_Best]:
    """Return the findings followed by all others beyond chance, one after the other, each given those before it."""
    out = list(found)
    now = test.given(out)
    while len(out) < MOST_FINDINGS:
        candidates = [_search(family, now) for family in every]
        beyond_chance = [of for of in candidates if of is not None and not test.by_chance(of.log_p)]
        if not beyond_chance:
            break
        best = max(beyond_chance, key=lambda of: of.evidence)
        near = sorted((of for of in beyond_chance if of is not best), key=lambda of: -of.evidence)
        rivals = tuple(
            _label(_in_fewer_rows(of, now), test.how) for of in near if of.evidence > best.evidence - AS_LIKELY
        )
        best = _in_fewer_rows(best._replace(rivals=(*_wanders(best, every, now), *rivals)), now)
        out.append(best)
        now = now.given([best])
    return out


def _wanders(best: _Best, every: Sequence[_Family], test: _Test) -> tuple[str, ...]:
    """Return the items whose gradual change explains the data at least as well as an error that begins or ends at a row."""
    if best.family.cause is None or best.family.drift or (best.first, best.last) == (0, test.how.row.size):
        return ()
    causes = {of.cause.name: of.cause for of in every if of.cause and (of.drift or of.cause is best.family.cause)}
    wander = {name: _wander_evidence(cause, test) for name, cause in causes.items()}
    return tuple(f"a gradual change of {name}" for name, of in wander.items() if of > best.evidence)


def _wander_evidence(cause: Cause, test: _Test) -> float:
    """Return the logarithm of the evidence of a random walk of an item, in WANDER_KNOTS steps of the most probable size."""
    rows, state = test.rows, test.state
    by = _columns(cause, test.errors, rows)
    edges = np.linspace(0, test.how.row.size, WANDER_KNOTS + 1)[:-1].round().astype(np.intp)
    cuts = [*np.searchsorted(rows.row, edges), int(np.searchsorted(rows.row, test.how.row.size))]
    d, r = by.shape[1], rows.basis.shape[1] + rows.added.shape[1]
    sums = np.zeros((WANDER_KNOTS, d, d + r + 1))  # over the rows from each step on
    for i, (a, b) in enumerate(pairwise(cuts)):
        across = by[a:b].T
        sums[: i + 1] += np.concatenate(
            [across @ by[a:b], across @ rows.of(slice(a, b)), (across @ rows.residual[a:b])[:, None]], axis=1
        )
    later = np.maximum.outer(np.arange(WANDER_KNOTS), np.arange(WANDER_KNOTS))
    square = sums[later, :, :d].transpose(0, 2, 1, 3).reshape(WANDER_KNOTS * d, -1)
    by_basis = sums[:, :, d:-1].reshape(WANDER_KNOTS * d, r)
    values, vectors = np.linalg.eigh(square - by_basis @ by_basis.T)
    values, along = np.maximum(values, 0.0), vectors.T @ sums[:, :, -1].ravel()
    variance = 1.0 if state.explained else state.chi2 / state.freedom
    felt = np.square(WANDER_SIGMA)[:, None] / variance
    gain = (felt * along**2 / (1.0 + felt * values)).sum(axis=1)
    half = gain / 2.0
    if not state.explained:
        half = np.log(state.chi2 / np.maximum(state.chi2 - gain, 1e-9 * state.chi2)) * state.freedom / 2.0
    evidence = half - np.log1p(felt * values).sum(axis=1) / 2.0 - math.log(len(WANDER_SIGMA))
    return float(evidence.max())


def _in_fewer_rows(best: _Best, test: _Test) -> _Best:
    """Return a step that is off before its row instead of from it on, if these are fewer rows and the data are the same.

    They are the same if the parameters follow the item's error in all rows: where the base or a tracker stood is
    unknown, only that it moved is known. The robot is then described as in most rows.
    """
    cause, n = best.family.cause, test.how.row.size
    if cause is None or best.family.drift or not 0 < best.first < n - best.first or best.last < n:
        return best
    by = _columns(cause, test.errors, test.rows)
    followed = not _left(by.T @ by, test.rows.along(by))[2].any()
    return best._replace(first=0, last=best.first, within=((0, 0), best.within[0])) if followed else best


def _confirmed(found: Sequence[_Best], test: _Test) -> tuple[list[_Best], float]:
    """Return the findings that hold with all others as parameters, with their figures of this joint test.

    Also returns the inflation of drops of χ² by the errors that remain.
    """
    left = list(found)
    while True:
        together = test.given(left)
        together = together._replace(inflation=1.0 if together.state.explained else _inflation(together.rows, test.how))
        again = _jointly(left, test, together)
        worst = max(range(len(left)), key=lambda i: again[i].log_p, default=None)
        if worst is None or not test.by_chance(again[worst].log_p):
            return again, together.inflation
        del left[worst]


def _jointly(found: Sequence[_Best], test: _Test, together: _Test) -> list[_Best]:
    """Return the findings, each with its figures given all others; a probability of 1 if held-out rows do not confirm it.

    ``together`` is the ``test`` with all of them as parameters, along ``along`` (m, D). The directions of one that are
    not those of the others are found among these D.
    """
    along = together.rows.added[:, test.rows.added.shape[1] :]
    columns = [_effect_columns(one, test.errors, test.rows, test.how) for one in found]
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
        log_p = float(_log_chance(np.array([drop / together.inflation]), np.array([freedom]), state)[0])
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


def _whitened(problem: Problem, x: Floats, columns: NDArray[np.bool_], fit: Fitted) -> _Whitened:
    """Return the whitened rows at x, in order."""
    k, r = fit.root.shape
    c, p = len(problem.errors.names), problem.n_robot
    some = [block for block in blocks(problem, max(1, AT_ONCE // (k + c))) if block.row is not None]
    of_rows = [np.repeat(block.row, block.sensor_cov.shape[1]) for block in some if block.row is not None]
    row = np.concatenate([np.zeros(0, dtype=np.intp), *of_rows])
    m = row.size
    if not m:
        return _Whitened(row, np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0)))
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
        parts = [by_robot, by_rig[:, :, columns[p:]], error_columns(lin, problem.errors.tool), residuals]
        stacked = np.concatenate([np.moveaxis(part, 2, 0) for part in parts])
        whiten(stacked, residual_cov(block.sensor_cov, lin.jac_joints, problem.joint_cov))
        whole = stacked.transpose(2, 1, 0).reshape(-1, len(stacked))
        mine = place[at : at + len(whole)]
        basis[mine], errors[mine], residual[mine] = whole[:, :k] @ fit.root, whole[:, k:-1], whole[:, -1]
        at += len(whole)
    residual[:m] -= basis[:m] @ fit.left
    if not np.isfinite(residual[:m]).all() or not np.isfinite(basis[:m]).all():
        return _Whitened(row[order], basis[:m], np.full(m, np.nan), errors[:m], np.zeros((m, 0)))
    known, off = _knowledge(basis[:m], residual[:m])
    end = m + off.size
    # Where the data hardly determine a direction, S has lost digits; a row that alone determines it must have no
    # residual.
    basis[m:end], residual[m:end] = known, off
    basis, residual = basis[:end], residual[:end]
    lower = np.linalg.cholesky(basis.T @ basis)
    basis = scipy.linalg.solve_triangular(lower, basis.T, lower=True, overwrite_b=True).T
    row = np.concatenate([row[order], np.full(off.size, problem.n_rows)])
    return _Whitened(row, basis, residual - basis @ (basis.T @ residual), errors[:end], np.zeros((end, 0)))


def _knowledge(basis: Floats, residual: Floats) -> tuple[Floats, Floats]:
    """Return rows (k, r) that complete a basis (m, r) to an orthonormal one, and their residuals (k,).

    The basis is then orthogonal to the residuals. Systematic errors do not enter these rows, so prior information
    matters only through how strongly it constrains the parameters.
    """
    values, vectors = np.linalg.eigh(np.eye(basis.shape[1]) - basis.T @ basis)
    some = values > SEEN
    root, along = np.sqrt(values[some]), vectors[:, some].T
    return root[:, None] * along, -(along @ (basis.T @ residual)) / root


def _families(causes: Sequence[Cause], errors: Errors, rows: _Whitened, how: Measured) -> Iterator[_Family]:
    """Return every item in every form in which it can be off."""
    n = how.row.size
    for cause in causes:
        used = np.unique(rows.row[rows.errors[:, errors.indices(cause.numbers)].any(axis=1)])
        if used.size < 2 * LEAST_ROWS:
            continue
        if cause.fault.constant:
            yield _Family(cause, np.array([0]), np.array([n]))
        if cause.fault.step:
            first = _even(used[LEAST_ROWS : 1 - LEAST_ROWS], MOST_STEPS)
            yield _Family(cause, first, np.full(first.size, n))
        if cause.fault.window:
            knots = np.append(_even(used, WINDOW_KNOTS), n)
            first, last = (knots[of] for of in np.triu_indices(knots.size, 1))
            enough = (np.searchsorted(used, last) - np.searchsorted(used, first) >= LEAST_ROWS) & (last - first < n)
            yield _Family(cause, first[enough], last[enough])
        if cause.fault.drift:
            for number in np.unique(how.session[used]):
                mine = np.flatnonzero(how.session == number)
                for drift in DriftWith:
                    family = _Family(cause, mine[:1], mine[-1:] + 1, drift)
                    along = how.table.during(drift, *_span(mine[0], mine[-1] + 1, how))
                    if along is not None and (drift is DriftWith.TIME or np.ptp(along) >= LEAST_WARMING):
                        yield family
    yield from _blocks(how)


def _blocks(how: Measured) -> Iterator[_Family]:
    """Return first and last parts of the runs, and complete runs, of at most half the rows."""
    n = how.row.size
    starts = np.concatenate([[0], np.flatnonzero(np.diff(how.run)) + 1, [n]])
    spans = set[tuple[int, int]]()
    for a, b in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        for cut in _even(np.arange(a, b + 1), max(MOST_STEPS // (starts.size - 1), 8)).tolist():
            spans |= {(a, cut), (cut, b)}
    kept = sorted((a, b) for a, b in spans if LEAST_ROWS <= b - a <= min(n // 2, MOST_BLOCK))
    if kept:
        first, last = np.array(kept).T
        yield _Family(None, first, last)


def _even(values: Indices, most: int) -> Indices:
    """Return at most this many of the values, evenly spaced, including the first and the last."""
    return values if values.size <= most else values[np.linspace(0, values.size - 1, most).astype(np.intp)]


def _search(family: _Family, test: _Test) -> _Best | None:
    """Return the family's best candidate, or None if the parameters can follow all of them."""
    errors, rows, how, state = test.errors, test.rows, test.how, test.state
    if family.cause is None:
        drop, freedom, known = _block_drops(family, rows)
    else:
        by = _columns(family.cause, errors, rows)
        if family.drift:
            by = _with_offset(by, _profile(family.drift, family.first[0], family.last[0], how)[rows.row])
        drop, freedom, known = _drops(by, family, rows)
    if not freedom.any():
        return None
    half_drop, variance = drop / 2.0, np.ones(1)
    if not state.explained:
        left = np.maximum(state.chi2 - drop, 1e-9 * state.chi2)
        half_drop, variance = np.log(state.chi2 / left) * state.freedom / 2.0, left / max(state.freedom, 1.0)
    log_count = math.log((freedom > 0).sum())
    evidence = half_drop - np.log1p(known / variance[:, None]).sum(axis=1) / 2.0 - log_count
    evidence = np.where(freedom > 0, evidence, -np.inf)
    at = int(np.argmax(evidence))
    log_p = float(_log_chance(drop[[at]] / test.inflation, freedom[[at]], state)[0]) + log_count
    first, last = int(family.first[at]), int(family.last[at])
    return _Best(
        family,
        first,
        last,
        float(drop[at]),
        int(freedom[at]),
        log_count,
        log_p,
        float(evidence[at]),
        _within(family, evidence),
    )


def _within(family: _Family, evidence: Floats) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the ranges of ``first`` and ``last`` of the family's most probable candidates (w,), up to the next ones."""
    order = np.argsort(-evidence, kind="stable")
    share = np.cumsum(np.exp(evidence[order] - evidence[order[0]]))
    likely = order[: int(np.searchsorted(share, LIKELY * share[-1])) + 1]

    def span(values: Indices) -> tuple[int, int]:
        every = np.unique(values)
        low, high = np.searchsorted(every, [values[likely].min(), values[likely].max()])
        before, after = every[max(low - 1, 0)], every[min(high + 1, every.size - 1)]
        return int(before + 1 if low else before), int(after - 1 if high + 1 < every.size else after)

    return span(family.first), span(family.last)


def _columns(cause: Cause, errors: Errors, rows: _Whitened) -> Floats:
    """Return the change (m, d) of the whitened predictions by an item, each number off by the weak prior of its unit."""
    weak = [UNITS[errors.unit(number)].weak_sigma for number in cause.numbers]
    return np.asarray(rows.errors[:, errors.indices(cause.numbers)] * weak)


def _drops(by: Floats, family: _Family, rows: _Whitened) -> tuple[Floats, Indices, Floats]:
    """Return the drop of χ² (w,), degrees of freedom (w,) and eigenvalues of V (w, d) for the family's spans.

    The effects are offsets along ``by`` (m, d).
    """
    edges, at = np.unique(np.concatenate([family.first, family.last]), return_inverse=True)
    cuts = np.searchsorted(rows.row, edges)
    w, d, r = family.first.size, by.shape[1], rows.basis.shape[1] + rows.added.shape[1]
    sums = np.zeros((edges.size, d, d + r + 1))
    for i, (a, b) in enumerate(pairwise(cuts)):
        across = by[a:b].T
        sums[i + 1, :, :d] = sums[i, :, :d] + across @ by[a:b]
        sums[i + 1, :, d:-1] = sums[i, :, d:-1] + across @ rows.of(slice(a, b))
        sums[i + 1, :, -1] = sums[i, :, -1] + across @ rows.residual[a:b]
    parts = []
    for some in np.array_split(np.arange(w), max(1, -(-w // SPANS))):
        of = sums[at[w:][some]] - sums[at[:w][some]]
        values, vectors, seen = _left(of[:, :, :d], of[:, :, d:-1])
        along = np.einsum("wij,wi->wj", vectors, of[:, :, -1])
        drop = np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0).sum(axis=1)
        parts.append((drop, seen.sum(axis=1), np.where(seen, values, 0.0)))
    drop, freedom, known = (np.concatenate(part) for part in zip(*parts, strict=True))
    return drop, freedom, known


def _left(square: Floats, by_basis: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return eigenvalues (…, d) and vectors of V = CᵀC − (QᵀC)ᵀ(QᵀC), and which of them are significant."""
    values, vectors = np.linalg.eigh(square - by_basis @ np.swapaxes(by_basis, -1, -2))
    return values, vectors, values > SEEN * np.trace(square, axis1=-2, axis2=-1)[..., None]


def _block_drops(family: _Family, rows: _Whitened) -> tuple[Floats, Indices, Floats]:
    """Return the same as ``_drops``, for leaving out each of the spans: eᵀ(I − Q Qᵀ)⁻¹e of its residuals.

    This is the form in the module docstring by Woodbury's identity. Spans with a common start or end are parts of the
    longest: with its I − Q Qᵀ = L Lᵀ they are sums of the squares of L⁻¹e.
    """
    cuts = np.searchsorted(rows.row, np.stack([family.first, family.last]))
    drop = np.zeros(family.first.size)
    begins, ends = (np.unique(side, return_inverse=True, return_counts=True) for side in cuts)
    forwards = begins[2][begins[1]] >= ends[2][ends[1]]
    for side, some in ((0, forwards), (1, ~forwards)):
        for at in np.unique(cuts[side, some]):
            mine = np.flatnonzero(some & (cuts[side] == at))
            which = slice(int(cuts[0, mine].min()), int(cuts[1, mine].max()))
            q, e = (part[:: -1 if side else 1] for part in (rows.of(which), rows.residual[which]))
            if not e.size:
                continue
            lower = np.linalg.cholesky(np.eye(e.size) * (1.0 + SEEN) - q @ q.T)
            squares = np.append(0.0, np.cumsum(scipy.linalg.solve_triangular(lower, e, lower=True) ** 2))
            drop[mine] = squares[cuts[1, mine] - cuts[0, mine]]
    freedom = cuts[1] - cuts[0]
    known = np.where(np.arange(freedom.max()) < freedom[:, None], BLOCK_SIGMA**2, 0.0)
    return drop, freedom, known


def _log_chance(drop: Floats, freedom: Indices, state: FitChi2) -> Floats:
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


def _effect(best: _Best, how: Measured) -> Effect | None:
    """Return the candidate as an effect in rows of the user's table."""
    if best.family.cause is None:
        return None
    first, last = _span(best.first, best.last, how)
    return Effect(best.family.cause.name, first, None if last == how.total else last, best.family.drift)


def _span(first: int, last: int, how: Measured) -> tuple[int, int]:
    """Return the first row and the one after the last in the user's table, from those among the fitted rows."""
    return (int(how.row[first]) if first else 0), (how.total if last == how.row.size else int(how.row[last]))


def _profile(drift: DriftWith | None, first: int, last: int, how: Measured) -> Floats:
    """Return the profile (n + 1,) over the fitted rows, with 0 for knowledge."""
    return np.append(profile(Effect("", *_span(first, last, how), drift), how.table)[how.row], 0.0)


def _effect_columns(best: _Best, errors: Errors, rows: _Whitened, how: Measured) -> Floats:
    """Return the effect's change (m, d) of the whitened predictions; for a block, one column per residual."""
    if best.family.cause is None:
        a, b = np.searchsorted(rows.row, [best.first, best.last])
        return np.eye(rows.row.size, b - a, -a)
    by = _columns(best.family.cause, errors, rows)
    profile_of_rows = _profile(best.family.drift, best.first, best.last, how)[rows.row]
    return _with_offset(by, profile_of_rows) if best.family.drift else np.asarray(by * profile_of_rows[:, None])


def _with_offset(by: Floats, profile_of_rows: Floats) -> Floats:
    """Return columns (m, d) times a drift's profile (m,), followed by the columns themselves (m, 2d in total).

    The second half is an offset, needed because the moment at which a drifting item was correct is unknown.
    """
    return np.concatenate([by * profile_of_rows[:, None], by], axis=1)


def _directions(by: Floats, rows: _Whitened) -> Floats:
    """Return an orthonormal basis (m, d') of the part of the columns (m, d) that the parameters cannot follow."""
    left = rows.without(rows.without(by))
    _, vectors, seen = _left(by.T @ by, rows.along(by))
    # The lengths of V's smallest directions are known to rounding only, so the columns themselves are made orthonormal.
    return np.asarray(np.linalg.qr(left @ vectors[:, seen])[0])


def _by_poses(one: _Best, own: Floats, test: _Test, together: _Test, left_out: Floats) -> float:
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
    gain, judging = _held_out(without, how) - _held_out(rows, how), _judging(rows, how)[mine]
    pose = how.pose[rows.row[mine]]
    of_pose = np.bincount(pose[judging], gain[mine][judging])[np.unique(pose[judging])]
    error = math.sqrt(of_pose.size * float(of_pose.var()) * together.inflation)
    return log_p if of_pose.sum() > SURE * error else 0.0


def _cluster_chance(found: Floats, added: Floats, left_out: Floats, rows: _Whitened, test: _Test) -> float:
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
    return float(_log_chance(np.array([drop]), np.array([d]), unknown)[0])


def _block_chance(one: _Best, explained: bool, state: FitChi2, drop: float, how: Measured) -> float:
    """Return the log probability that rows which are not off, but whose errors a pose shares, fit this badly.

    ``state`` is χ² without the rows, which has fallen by ``drop``. In the worst case a pose is one residual.
    Where declared noise does not explain χ² with them, they may also be NOISIER than the others, which alone would bring
    χ² without them into its range.
    """
    poses = np.unique(how.pose[one.first : one.last]).size
    if explained:
        return float(_log_chance(np.array([drop * poses / one.freedom]), np.array([poses]), state)[0])
    per_pose = one.freedom / poses
    drop /= per_pose * state.chi2 / state.freedom * NOISIER**2  # over the variance of the others
    freedom = max(state.freedom / per_pose, 1.0)
    of_poses = FitChi2(drop + freedom, freedom + poses, 0.0)
    return float(_log_chance(np.array([drop]), np.array([poses]), of_poses)[0])


def _left_out(rows: _Whitened, how: Measured) -> Floats:
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


def _inflation(rows: _Whitened, how: Measured) -> float:
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


def _judging(rows: _Whitened, how: Measured) -> NDArray[np.bool_]:
    """Return a mask (m,) of all residuals except knowledge and those of blocks, which were left out."""
    lengths = sum(np.einsum("ij,ij->i", of, of) for of in (rows.basis, rows.added))
    return np.asarray((lengths < 1.0 - SEEN) & (rows.row < how.row.size))


def _held_out(rows: _Whitened, how: Measured) -> Floats:
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


def _label(best: _Best, how: Measured) -> str:
    effect = _effect(best, how)
    first, last = _span(best.first, best.last, how)
    return f"rows {first + 1} to {last}" if effect is None else str(effect)


def _described(found: Sequence[_Best], test: _Test, after: FitChi2) -> tuple[tuple[SystematicError, ...], Floats]:
    """Return the findings with their sizes, from a fit of all of them together, and their effect (r,) along Q.

    ``after`` is χ² of that fit.
    """
    errors, rows, how = test.errors, test.rows, test.how
    parts = [_effect_columns(best, errors, rows, how) for best in found]
    by = np.concatenate(parts, axis=1)
    values, vectors, seen = _left(by.T @ by, rows.along(by))
    root = vectors[:, seen] / np.sqrt(values[seen])
    scale = 1.0 if after.explained else max(math.sqrt(after.chi2 / max(after.freedom, 1.0)), 1.0)
    value, covariance = root @ (root.T @ (by.T @ rows.residual)), scale**2 * root @ root.T
    unseen = np.abs(vectors[:, ~seen]).max(axis=1, initial=0.0) > 1e-6 * np.abs(vectors).max(axis=1)
    out, at = [], 0
    for best, part in zip(found, parts, strict=True):
        numbers = () if best.family.cause is None else best.family.cause.numbers
        mine = slice(at, at + (len(numbers) or part.shape[1]))  # for a drift, without its offset
        at += part.shape[1]
        off_by = _off_by(numbers, errors, value[mine], covariance[mine, mine], unseen[mine])
        chance = math.exp(min(best.log_p + test.log_families, 0.0))
        span, effect = _span(best.first, best.last, how), _effect(best, how)
        (first, last), (first_most, last_most) = (_span(*of, how) for of in zip(*best.within, strict=True))
        within = (first, first_most), (last, last_most)
        out.append(SystematicError(effect, span, within, *off_by, best.drop, best.freedom, chance, best.rivals))
    return tuple(out), rows.basis.T @ (by @ value)


def _off_by(
    numbers: Sequence[str], errors: Errors, value: Floats, covariance: Floats, unseen: NDArray[np.bool_]
) -> tuple[tuple[OffBy, ...], str, float, float]:
    """Return the error of each number, and the norm ± σ of those that are identifiable and have the first one's unit."""
    if not numbers:
        return (), "", math.nan, math.nan
    units = [errors.unit(number) for number in numbers]
    weak = np.array([UNITS[unit].weak_sigma for unit in units])
    value = np.where(unseen, math.nan, value * weak)
    sigma = np.where(unseen, math.nan, weak * np.sqrt(np.diag(covariance)))
    alike = np.array([unit == units[0] for unit in units]) & ~unseen
    off_by = tuple(map(OffBy, numbers, units, value.tolist(), sigma.tolist()))
    if not alike.any():
        return off_by, units[0], math.nan, math.nan
    size = float(np.linalg.norm(value[alike]))
    along = value[alike] / size if size > 0.0 else np.zeros(int(alike.sum()))
    spread = (covariance * np.outer(weak, weak))[np.ix_(alike, alike)]
    return off_by, units[0], size, math.sqrt(float(along @ spread @ along))
