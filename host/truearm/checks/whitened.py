"""The rows of a finished fit, whitened by their noise, and their derivatives by everything that can be off.

Their noise may be another than the declared one.

Residuals may not be as declared: of another size, or shared by rows near each other. The kernels are V = σ²[(1 − a) I +
a K] over the rows. K correlates rows near in the order of measurement, rows of one mount, or rows of similar joint
readings. The one with the greatest restricted likelihood is taken, if it is better than the declared noise by the
number of kernels tried.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from truearm.estimate.circumstances import Measured
from truearm.estimate.frame_choice import mounting
from truearm.estimate.problem import Problem
from truearm.estimate.residual_noise import residual_cov, whiten
from truearm.estimate.systematic_effects import Cause, Errors, error_columns
from truearm.estimate.ties import first_within
from truearm.estimate.whitened_rows import only
from truearm.kinds.group import Group, KindFault
from truearm.model.chain import forward
from truearm.model.joint_terms.curve import Curve
from truearm.types import Floats, Indices
from truearm.units import UNITS

MOST_ROWS = 1000  # of a longer table, an evenly spaced selection is examined
SHARES = (0.1, 0.3, 0.6, 0.9)  # of the variance that rows share
# Kernels with their widths: rows, and standard deviations of the joint readings.
SHAPES = (("order", 2.0), ("order", 8.0), ("order", 40.0), ("mount", 0.0), ("pose", 0.1), ("pose", 0.3), ("pose", 1.0))
STRETCH = 50  # rows; of a longer table, stretches of as many are judged
MOST_JUDGED = 400  # rows

(_potri,) = linalg.get_lapack_funcs(("potri",), dtype=np.float64)


class ArmParameter(NamedTuple):
    """A free parameter of the robot: its column of the derivatives, its SI unit, and its value."""

    column: int
    unit: str
    value: float


@dataclass(frozen=True)
class WhitenedFit:
    """m scalar residuals of n rows in the order of measurement, whitened by the declared noise, and k free parameters.

    To first order, residual = jac δ + (columns of whatever is off) β + noise of unit variance. ``prior`` and
    ``wide_prior`` (·, k + 1) are further rows of derivatives and residuals: what the rig says of its numbers, distances
    between sockets, and the robot's prior. ``wide_prior`` has a wide one about the fit instead, because a false one
    would be reported as a fault of the rig.
    """

    row: Indices  # (m,) from 0 to n − 1
    component: Indices  # (m,) numbers: scalar residuals of one kind and unit
    jac: Floats  # (m, k)
    residual: Floats  # (m,)
    pull: Floats  # (m,) 1; of a robust loss the root of the weight in the fit, relative to that of the whitened row
    prior: Floats
    wide_prior: Floats
    fault_jac: Floats  # (m, c) by everything in ``errors``
    errors: Errors  # names and SI units of these c columns
    causes: tuple[Cause, ...]  # items with the numbers that are off together
    fitted: frozenset[str]  # numbers that the fit estimates about a wide prior or none: no offset of theirs is a fault
    curved: frozenset[str]  # joints with an error curve, which has the once-a-turn error of a code wheel
    kind_faults: tuple[KindFault, ...]  # of the kinds, with whitened columns (m, d)
    axes: Floats  # (n, 3, 3) of the end in the base frame
    arm: Mapping[str, ArmParameter]  # by name, without those of joint laws
    measured: Measured  # the circumstances of the n rows

    @property
    def n(self) -> int:
        return int(self.measured.row.size)

    def by_numbers(self, names: Sequence[str]) -> tuple[Floats, list[str]]:
        """Return the derivatives (m, d) by some numbers that can be off, and their SI units."""
        index = self.errors.indices(names)
        return self.fault_jac[:, index], [self.errors.units[i] for i in index]

    def extended(self, columns: Floats, widest: float) -> WhitenedFit:
        """Return the fit with further ``columns`` (m, f) as parameters, within ``widest`` of 0."""
        f, k = columns.shape[1], self.jac.shape[1]
        padded = np.insert(self.wide_prior, [k] * f, 0.0, axis=1)
        added = np.pad(np.eye(f) / widest, ((0, 0), (k, 1)))
        return replace(self, jac=np.column_stack([self.jac, columns]), wide_prior=np.concatenate([padded, added]))


class SharedNoise(NamedTuple):
    """Noise of c components that the same n' rows have: their residuals (n', c), and L (n', n') of V = L Lᵀ."""

    residuals: Indices
    root: Floats


@dataclass(frozen=True)
class Kernel:
    """The noise of the rows, V times the square of a scale, in units of the declared one."""

    name: str = "declared"
    scale: float = 1.0  # ratio of its standard deviation to the declared one
    gain: float = 0.0  # nats over the declared noise, less the price
    shared: tuple[SharedNoise, ...] = field(default=(), repr=False)

    @property
    def declared(self) -> bool:
        return self.name == "declared"

    @property
    def log_determinant(self) -> float:
        """Return log det V."""
        return float(sum(2.0 * residuals.shape[1] * np.log(np.diag(root)).sum() for residuals, root in self.shared))

    @cached_property
    def precisions(self) -> tuple[tuple[Indices, Floats], ...]:
        """Return the residuals (n', c) of each set of rows with V⁻¹ (n', n')."""
        return tuple((residuals, linalg.cho_solve((root, True), np.eye(len(root)))) for residuals, root in self.shared)

    def whiten(self, columns: Floats) -> Floats:
        """Return columns (m, d) divided by the root of the noise's covariance."""
        return self._of_each(partial(linalg.solve_triangular, lower=True), columns / self.scale)

    def dual(self, vectors: Floats) -> Floats:
        """Return L⁻ᵀ vectors (m, x): the product of whitened columns with vectors is that of the columns with these."""
        return self._of_each(partial(linalg.solve_triangular, lower=True, trans="T"), vectors / self.scale)

    def spread(self, columns: Floats) -> Floats:
        """Return Lᵀ columns (m, d): their Gram matrix is columnsᵀ V columns."""
        return self._of_each(lambda root, by_row: root.T @ by_row, columns * self.scale)

    def _of_each(self, product: Callable[[Floats, Floats], Floats], vectors: Floats) -> Floats:
        for residuals, root in self.shared:
            by_row = vectors[residuals]
            vectors[residuals] = product(root, by_row.reshape(len(root), -1)).reshape(by_row.shape)
        return vectors


DECLARED = Kernel()


class RowWeights(NamedTuple):
    """The weights (n,) of a table's rows: the declared variance is divided by that with which they are examined."""

    examined: Floats
    fitted: Floats  # by the loss


def used_rows(problem: Problem) -> Indices:
    """Return the rows that a problem has, in order."""
    rows = np.concatenate([group.row for group in problem.groups if group.row is not None])
    return np.flatnonzero(np.bincount(rows))  # at once, unlike unique rows


def whitened_fit(
    problem: Problem,
    x: Floats,
    columns: NDArray[np.bool_],
    measured: Measured,
    weights: RowWeights,
    laws: tuple[range, Floats | None] = (range(0), None),
    rows: slice | None = None,
    whole: Problem | None = None,
) -> WhitenedFit:
    """Return the whitened rows of a fit of x[columns] that ended at x (P,); rows left out are not in ``problem``.

    These are some ``rows`` of the problem's, or else MOST_ROWS of all; ``whole`` is the problem of the whole table if
    that has more. ``measured`` describes the rows of the problem's table. The prior of the coefficients of joint
    ``laws`` is knowledge: it follows from the rows themselves, and without it they would explain anything. With it
    comes a root (l, l) of its precision.
    """
    row_in_table = np.arange(problem.n_rows) if whole is None else measured.row
    whole, x_whole = (problem, x) if whole is None else (whole, whole.at(dict(zip(problem.names, x, strict=True))))
    rows_used = used_rows(problem)
    examined = rows_used[:: -(-rows_used.size // MOST_ROWS)] if rows is None else rows_used[rows]
    problem, measured = only(problem, np.isin(np.arange(problem.n_rows), examined)), measured.take(examined)
    p, k = problem.n_robot, int(columns.sum())
    faults = [
        {(f.item, f.form): f for f in faults_of(whole, x_whole, row_in_table[group.row])}
        if group.row is not None
        else {}
        for group in problem.groups
    ]
    forms = {key: fault for group_faults in faults for key, fault in group_faults.items()}
    pieces, knowledge, components = [], [np.zeros((0, k + 1))], 0
    for group, group_faults in zip(problem.groups, faults, strict=True):
        by_faults = [
            group_faults.get(
                key, fault._replace(columns=np.zeros((*group.sensor_cov.shape[1::-1], fault.columns.shape[2])))
            )
            for key, fault in forms.items()
        ]
        whitened = _whitened_group(group, [fault.columns for fault in by_faults], problem, x, columns)
        if group.row is None:
            knowledge.append(whitened[:, [*range(k), -1]])
            continue
        width = len(group.COMPONENTS)
        whitened *= np.sqrt(np.repeat(weights.examined[group.row], width))[:, None]
        numbers = np.tile(np.arange(components, components + width), len(group.row))
        pieces.append((np.repeat(group.row, width), numbers, whitened))
        components += width
    row, component, whitened = (np.concatenate(piece) for piece in zip(*pieces, strict=True))
    order = np.argsort(row, kind="stable")
    whitened = whitened[order]
    ends = np.cumsum([k, len(problem.errors.names), *(fault.columns.shape[2] for fault in forms.values())])
    jac, fault_jac, *by_forms, residual = np.split(whitened, ends, axis=1)

    arm = ~problem.of_rig
    of_laws, law_prior = laws
    arm[of_laws] = False
    wide, vague = (np.array([getattr(UNITS[u], size) for u in problem.units]) for size in ("wide_sigma", "vague_sigma"))
    mounted = np.pad(mounting(problem.chain, x[:p]).either, (0, wide.size - p))
    leeway, error = np.where(mounted, vague, wide), problem.start - x
    rig_prior, free = np.concatenate(knowledge), np.flatnonzero(columns).tolist()

    def with_prior(sigma: Floats, error: Floats) -> Floats:
        rows = np.diag(1.0 / sigma)
        if law_prior is not None:
            rows[np.ix_(of_laws, of_laws)] = law_prior.T
        return np.concatenate([rig_prior, np.column_stack([rows, rows @ error])[columns][:, [*free, -1]]])

    return WhitenedFit(
        row=np.searchsorted(examined, row[order]),
        component=component[order],
        jac=jac,
        residual=residual[:, 0],
        pull=np.sqrt(weights.fitted / weights.examined)[row[order]],
        prior=with_prior(problem.prior_sigma, error),
        wide_prior=with_prior(np.where(arm, leeway, problem.prior_sigma), np.where(arm, 0.0, error)),
        fault_jac=fault_jac,
        errors=problem.errors,
        causes=problem.causes,
        fitted=frozenset(np.array(problem.names)[problem.prior_sigma >= wide].tolist()),
        curved=frozenset(problem.chain.joints[i].name for i in Curve.of_chain(problem.chain).joints.tolist()),
        kind_faults=tuple(f._replace(columns=by) for f, by in zip(forms.values(), by_forms, strict=True)),
        axes=forward(problem.chain, x[:p], measured.table.q[measured.row])[:, :3, :3],
        arm={
            problem.names[i]: ArmParameter(column, problem.units[i], float(x[i]))
            for column, i in enumerate(free)
            if arm[i]
        },
        measured=measured,
    )


def faults_of(whole: Problem, x: Floats, row: Indices) -> list[KindFault]:
    """Return the faults at x (P,) of some rows (n,) of one group, each given the row before it in the ``whole`` table.

    Hysteresis depends on that.
    """
    for group in whole.groups:
        if group.row is not None and row[0] in group.row:
            inside = np.flatnonzero(np.isin(group.row, row))
            taken = np.union1d(inside, np.maximum(inside - 1, 0))
            faults, kept = group.take(taken).faults(whole.chain, x), np.searchsorted(taken, inside)
            return [fault._replace(columns=fault.columns[:, kept]) for fault in faults]
    return []


def _whitened_group(
    group: Group, by_faults: Sequence[Floats], problem: Problem, x: Floats, columns: NDArray[np.bool_]
) -> Floats:
    """Return derivatives by x[columns], ``problem.errors`` and faults, and residuals: (n·w, k + c + f + 1)."""
    lin = group.opened(problem.chain, x)
    residual = lin.residual.reshape(len(group.sensor_cov), -1).T[:, :, None]
    derivatives = [lin.by_columns(columns), error_columns(lin, problem.errors.bodies), *by_faults, residual]
    stacked = np.concatenate([np.moveaxis(derivative, 2, 0) for derivative in derivatives])
    whiten(stacked, residual_cov(group.sensor_cov, lin.jac_joints, problem.joint_cov))
    return stacked.transpose(2, 1, 0).reshape(-1, len(stacked))


def learned_noise(fit: WhitenedFit) -> Kernel:
    """Return the noise with the greatest restricted likelihood, or the declared one."""
    rows = judged_rows(fit.n)
    inside = np.isin(fit.row, rows)
    row = np.searchsorted(rows, fit.row[inside])
    moves = fit.jac[inside].any(axis=0)  # of the others, such as far knots of a curve, there is only the prior
    jac = fit.jac[inside][:, moves]
    prior = fit.wide_prior[:, np.append(moves, True)][fit.wide_prior[:, :-1][:, moves].any(axis=1)]
    length = np.maximum(np.linalg.norm(np.concatenate([jac, prior[:, :-1]]), axis=0), 1e-300)
    judged = replace(
        fit,
        row=row,
        component=fit.component[inside],
        jac=jac / length,
        residual=fit.residual[inside],
        wide_prior=prior / np.append(length, 1.0),
    )
    shapes = [(name, width) for name, width in SHAPES if name != "mount" or np.unique(fit.measured.run[rows]).size > 1]
    choices = [("white", 0.0, 0.0), *((*shape, share) for shape in shapes for share in SHARES)]
    declared, _ = restricted_likelihood(judged, DECLARED)
    likelihoods = [restricted_likelihood(judged, kernel_of(judged, rows, *choice)) for choice in choices]
    best = first_within([value for value, _ in likelihoods])
    value, scale = likelihoods[best]
    gain = value - declared - math.log(len(choices))
    if gain <= 0.0:
        return DECLARED
    return replace(kernel_of(fit, np.arange(fit.n), *choices[best]), scale=scale, gain=gain)


def restricted_likelihood(fit: WhitenedFit, kernel: Kernel) -> tuple[float, float]:
    """Return the restricted log-likelihood of the residuals, and the scale of the noise.

    −½[ν log σ² + χ²/σ² + log det V + log det(Jᵀ V⁻¹ J)], with σ² = χ²/ν unless the kernel is the declared one. The
    columns of J are of similar length.
    """
    m, k = fit.jac.shape
    white = kernel.whiten(np.column_stack([fit.jac, fit.residual]))
    data = white.T @ white
    lower = np.linalg.cholesky(data + fit.wide_prior.T @ fit.wide_prior + 1e-12 * np.eye(k + 1))
    inverse = _potri(lower[:k, :k], lower=1)[0]  # the lower triangle
    chi2 = float(lower[k, k] ** 2)
    freedom = m - float((inverse * (2.0 * np.tril(data[:k, :k], -1) + np.diag(np.diag(data)[:k]))).sum())
    variance = 1.0 if kernel.declared else max(chi2 / max(freedom, 1.0), 1e-12)
    cost = freedom * math.log(variance) + chi2 / variance + kernel.log_determinant
    return -0.5 * cost - float(np.log(np.diag(lower)[:k]).sum()), math.sqrt(variance)


def judged_rows(n: int) -> Indices:
    """Return all rows, or of many, contiguous stretches."""
    if n <= MOST_JUDGED:
        return np.arange(n)
    starts = np.linspace(0, n - STRETCH, MOST_JUDGED // STRETCH).astype(np.intp)
    return np.unique(starts[:, None] + np.arange(STRETCH))


def similarity(fit: WhitenedFit, rows: Indices, name: str, width: float) -> Floats:
    """Return the kernel K (n', n') of some rows; ``width`` in rows, or in standard deviations of the joint readings."""
    if name == "order":
        return np.asarray(np.exp(-np.abs(rows[:, None] - rows) / width))
    if name == "mount":
        run = fit.measured.run[rows]
        return np.asarray(run[:, None] == run, dtype=float)
    readings = fit.measured.table.q[fit.measured.row]
    z = ((readings - readings.mean(axis=0)) / np.maximum(readings.std(axis=0), 1e-9))[rows] / np.sqrt(readings.shape[1])
    square = (z**2).sum(axis=1)
    return np.asarray(np.exp(-0.5 * np.maximum(square[:, None] + square - 2.0 * z @ z.T, 0.0) / width**2))


def kernel_of(fit: WhitenedFit, rows: Indices, name: str, width: float, share: float) -> Kernel:
    """Return (1 − share) I + share K over the ``rows`` of a fit, once for all components that the same rows have."""
    if not share:
        return Kernel(name)
    covariance = (1.0 - share) * np.eye(rows.size) + share * similarity(fit, rows, name, width)
    sets: dict[bytes, list[Indices]] = {}
    for number in np.unique(fit.component):
        residuals = np.flatnonzero(fit.component == number)
        sets.setdefault(fit.row[residuals].tobytes(), []).append(residuals)
    stacks = [np.stack(stack, axis=1) for stack in sets.values()]
    row_sets = (fit.row[residuals[:, 0]] for residuals in stacks)
    roots = (linalg.cholesky(covariance[np.ix_(members, members)], lower=True) for members in row_sets)
    return Kernel(name, shared=tuple(map(SharedNoise, stacks, roots)))
