"""The information of the observations in square-root form: the linear algebra shared by all solvers.

Whitened rows [J | f] (each divided by its σ) are folded block by block into one triangle,

    R_aug = qr([R_aug; J_block | f_block]),   R_aug = [[R, z], [0, ρ]],

so that JᵀJ = RᵀR and Jᵀf = Rᵀz, and memory does not grow with the number of poses. For J = W X, with X the same for all
poses (model/chain.py), W is folded and the triangle is multiplied by X at the end. J itself is folded where X differs,
as for a sensor on a link. The triangle keeps the condition number of J. The normal equations of Goswami's (10) would
square it, and a rank test on them would have only half the digits. A prior adds the rows 1/σ with residuals
(mean − x)/σ.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs

from truearm.estimate.problem import Problem, blocks, note, pieces
from truearm.estimate.residual_noise import residual_cov, whiten
from truearm.kinds.group import Linearised
from truearm.model.chain import folded
from truearm.types import Floats, Residuals

RANK_TOLERANCE = 1e-10  # of the largest singular value; analytic Jacobians leave 1e-15 for null directions
_tpqrt = get_lapack_funcs("tpqrt", dtype=np.float64)
PANEL, MOST_PANELS = 8, 16  # columns that tpqrt eliminates at once, at least; of many columns, a sixteenth is faster
KEPT_BYTES = 30_000_000  # the thresholds follow up to 32 MiB
ROUNDING = 1e-13  # of the longest column: sums of some dozen terms of relative error 2e-16, with a margin


class Information(NamedTuple):
    """A linearised, whitened least-squares problem over k unknowns."""

    root: Floats  # (k, k) R
    rhs: Floats  # (k,) z
    chi2: float  # fᵀf
    n_residuals: int  # scalar ones, including priors
    residual: Residuals  # of the table's rows

    @property
    def half(self) -> Floats:
        """Return S (k, r) with S Sᵀ the covariance of the unknowns on the identifiable directions."""
        return half(spectrum(self.root))


class Spectrum(NamedTuple):
    """Singular values of the root with its columns scaled to length 1: root = U diag(singular) Vtᵀ diag(scale)."""

    u: Floats  # (k, k)
    singular: Floats  # (k,) descending
    vt: Floats  # (k, k)
    scale: Floats  # (k,)


def observe(problem: Problem, x: Floats, columns: NDArray[np.bool_]) -> Information:
    """Return the information of the observations, without priors, on x[columns], linearised at x (P,).

    Errors of the joint readings are weighted as they are at x.
    """
    _keep_freed_memory()
    robot, rig = columns[: problem.n_robot], columns[problem.n_robot :]
    twists = folded(problem.chain, x[: problem.n_robot]).basis.twists[:, robot]
    moving = np.asarray(twists.any(axis=1))
    n_used, n_rig = int(moving.sum()), int(rig.sum())
    # Of [W | rig | residual] where X is the same for all poses, and of [J | residual] where it is not.
    sizes = n_used + n_rig + 1, twists.shape[1] + n_rig + 1
    triangle, in_params = (np.zeros((size, size), order="F") for size in sizes)
    residual = problem.no_residuals()
    chi2, count = 0.0, 0
    for block in blocks(problem):
        lin = block.evaluate(problem.chain, x)
        note(block, lin.residual, residual)
        direct = lin.basis.direct
        by_robot, chosen = (lin.wrenches @ lin.basis.twists, robot) if direct else (lin.wrenches, moving)
        stacked = _stacked(by_robot, chosen, lin, rig)
        whiten(stacked, residual_cov(block.sensor_cov, lin.jac_joints, problem.joint_cov))
        chi2 += float((stacked[-1] ** 2).sum())
        count += lin.residual.size
        rows = stacked.reshape(len(stacked), -1).T
        if direct:
            in_params = fold(in_params, rows, overwrite=True)
        else:
            triangle = fold(triangle, rows, overwrite=True)
    rows = np.concatenate([triangle[:, :n_used] @ twists[moving], triangle[:, n_used:]], axis=1)
    triangle = fold(in_params, rows)
    return Information(triangle[:-1, :-1], triangle[:-1, -1], chi2, count, residual)


def _stacked(by_robot: Floats, moving: NDArray[np.bool_], lin: Linearised, rig: NDArray[np.bool_]) -> Floats:
    """Return the ``moving`` columns (b, w, n) of those by the robot, the rig's free unknowns, and the residuals."""
    width, n, _ = by_robot.shape
    n_moving = int(moving.sum())
    out = np.empty((n_moving + int(rig.sum()) + 1, width, n))
    np.compress(moving, by_robot.transpose(2, 0, 1), axis=0, out=out[:n_moving])
    np.compress(rig, lin.jac_rig.transpose(2, 0, 1), axis=0, out=out[n_moving:-1])
    out[-1] = lin.residual.reshape(n, width).T
    return out


def weighed(problem: Problem, x: Floats) -> Problem:
    """Return the problem with each observation's covariance at x, joint readings included; unchanged if they are exact.

    For a solver that compares χ² at two x, which must have the same weights.
    """
    if problem.joint_cov is None:
        return problem
    groups = []
    for group in problem.groups:
        cov = [
            residual_cov(piece.sensor_cov, piece.evaluate(problem.chain, x).jac_joints, problem.joint_cov)
            for piece in pieces(group)
        ]
        groups.append(replace(group, sensor_cov=np.concatenate(cov)))
    return replace(problem, groups=tuple(groups), joint_cov=None)


def with_prior(information: Information, error: Floats, sigma: Floats) -> Information:
    """Add a prior: ``error`` = mean − x (k,), ``sigma`` (k,), inf for none."""
    has_prior = np.isfinite(sigma)
    if not has_prior.any():
        return information
    weight = 1.0 / sigma[has_prior]
    rows = np.zeros((weight.size, sigma.size + 1))
    rows[np.arange(weight.size), np.flatnonzero(has_prior)] = weight
    rows[:, -1] = error[has_prior] * weight
    k = sigma.size
    triangle = np.zeros((k + 1, k + 1))
    triangle[:k, :k], triangle[:k, k] = information.root, information.rhs
    triangle = fold(triangle, rows)
    chi2 = information.chi2 + float(rows[:, -1] @ rows[:, -1])
    return Information(
        triangle[:k, :k], triangle[:k, k], chi2, information.n_residuals + weight.size, information.residual
    )


def of_rows(problem: Problem, x: Floats, columns: NDArray[np.bool_]) -> Information:
    """Return the information at x about x[columns] of the rows and of the rig, without the robot's prior."""
    return with_prior(observe(problem, x, columns), (problem.start - x)[columns], problem.rig_prior[columns])


def fold(triangle: Floats, rows: Floats, overwrite: bool = False) -> Floats:
    """Fold rows (m, k) into an upper triangle (k, k); with ``overwrite`` both inputs may be overwritten.

    LAPACK's tpqrt uses the triangular structure, so nothing is stacked and R's zeros cost nothing: 0.16 µs per row of
    37 columns, half the time of numpy's qr.
    """
    if rows.size == 0:
        return triangle
    panel = min(max(PANEL, len(triangle) // MOST_PANELS), len(triangle))
    return np.asarray(_tpqrt(0, panel, triangle, rows, overwrite_a=overwrite, overwrite_b=overwrite)[0])


def _keep_freed_memory() -> None:
    """Keep the memory of the blocks' arrays in the process, at most about 60 MB.

    glibc returns large blocks to the system when they are freed, and each new array faults its pages in again, which
    takes a third of the time of a fit of 800 points. Its thresholds grow with the largest block that was freed
    (mallopt(3), M_MMAP_THRESHOLD), so one is allocated and freed untouched. With another allocator this has no effect.
    """
    np.empty(KEPT_BYTES, np.uint8)


def scaled_columns(root: Floats) -> tuple[Floats, Floats]:
    """Return the root with columns of length 1 (Marquardt 1963), and their former lengths (k,).

    Of a column without information, the length is 1.

    A column that is only rounding must not be scaled up and taken for information.
    """
    scale = np.linalg.norm(root, axis=0)
    empty = scale <= ROUNDING * scale.max(initial=0.0)
    scale[empty] = 1.0
    return np.where(empty, 0.0, root) / scale, scale


def spectrum(root: Floats) -> Spectrum:
    """Scale the columns and decompose the root."""
    scaled, scale = scaled_columns(root)
    u, singular, vt = np.linalg.svd(scaled)
    return Spectrum(u, singular, vt, scale)


def seen(parts: Spectrum) -> NDArray[np.bool_]:
    """Return a mask (k,) of the singular values that are information and not rounding."""
    return np.asarray(parts.singular > RANK_TOLERANCE * parts.singular.max(initial=0.0))


def half(parts: Spectrum) -> Floats:
    """Return S (k, r) with S Sᵀ the inverse of RᵀR on the identifiable directions."""
    identifiable = seen(parts)
    return np.asarray(parts.vt[identifiable].T / parts.singular[identifiable] / parts.scale[:, None])


def covariance(parts: Spectrum) -> Floats:
    """Return the inverse (k, k) of RᵀR on the identifiable directions."""
    root = half(parts)
    return np.asarray(root @ root.T)
