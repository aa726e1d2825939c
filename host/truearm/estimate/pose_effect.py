"""Errors shared by the rows of one pose: a random effect per pose, its variance, and its effect on the covariance.

Several reflectors on one tool, or repeated measurements of a pose, do not have independent errors: unmodelled errors of
the arm move all of them together. The whitened residuals are therefore assumed to have the covariance

    R = m I + p Z Zᵀ ,

where m is the variance of a row's own noise relative to the declared one, p [m²] the variance of each component of a
translation of the end at a pose, and Z (N, 3K) the whitened derivatives by the translations of the K poses. R has one
block per pose.

With Q = J S an orthonormal basis of the range of the parameters (P = S Sᵀ) and M = I − Q Qᵀ, two quadratic forms of the
residuals e = M y have the expectations (Rao 1971, MINQUE; unbiased, and the analysis of variance if all poses have
equally many rows)

    E eᵀe = m tr M + p tr(ZᵀMZ) ,   E |Zᵀe|² = m tr(ZᵀMZ) + p ‖ZᵀMZ‖² .

For p = 0 their covariance is 2m² times the same matrix, which determines whether p is beyond chance. The parameters
keep their least-squares values, because unmodelled errors that differ between the points of a pose would distort
weights learned from them. Only the covariance of the estimate changes, to P + S((m − 1) QᵀQ + p (ZᵀQ)ᵀZᵀQ) Sᵀ. A prior,
which is not based on any row, enters it as declared.

If each pose has one row, only the model distinguishes m from p, and nothing is estimated. The same holds if fewer than
half of the rows share their pose with others, as with check poses, because single rows would decide.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.problem import Problem, blocks
from truearm.estimate.residual_noise import residual_cov, whiten
from truearm.results import PoseError
from truearm.types import Floats, Indices

LEVEL = 0.05  # of fits without such errors that show some by chance
TRANSLATIONS = slice(0, 6, 2)  # of ``Linearised.wrenches``: the forces
LEAST_SHARE = 0.5  # of the rows must share their pose with others
TOLD = 1e-6  # share of p's information that must remain given m


class PoseEffect(NamedTuple):
    """Errors shared by the rows of a pose, and the covariance (k, k) of least-squares estimates including them."""

    error: PoseError
    covariance: Floats


class _Sums(NamedTuple):
    """Whitened sums over the rows."""

    n: int  # scalar residuals
    n_several: int  # poses with several rows
    own: Floats  # (K, 3, 3) ZᵀZ of each pose
    by_basis: Floats  # (3K, r) ZᵀQ
    along: Floats  # (3K,) Zᵀe
    basis: Floats  # (r, r) QᵀQ
    chi2: float  # eᵀe


def pose_effect(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats, pose: Indices
) -> PoseEffect | None:
    """Return the errors shared by rows of one ``pose`` (n_rows,) at the estimate x (P,), where ``root`` (k, r) is S.

    None if fewer than half of the rows share their pose with others, or if their errors are no more alike than by
    chance.
    """
    sums = _sums(problem, x, columns, root, pose)
    if sums is None:
        return None
    crossed = sums.by_basis.T @ sums.by_basis
    of_pose = sums.by_basis.reshape(len(sums.own), 3, -1)
    both = np.trace(sums.own, axis1=1, axis2=2).sum() - np.trace(crossed)
    square = (
        (sums.own**2).sum()
        - 2.0 * np.einsum("kir,kij,kjr->", of_pose, sums.own, of_pose, optimize=True)
        + (crossed**2).sum()
    )
    expects = np.array([[sums.n - np.trace(sums.basis), both], [both, square]])
    own_part = square - both**2 / expects[0, 0] if expects[0, 0] >= 1.0 else 0.0
    if not own_part > TOLD * square:
        return None
    row, variance = np.linalg.solve(expects, [sums.chi2, float(sums.along @ sums.along)])
    if not variance > -special.ndtri(LEVEL) * max(row, 0.0) * math.sqrt(2.0 / own_part):
        return None
    row = max(float(row), 1.0)  # at least as declared
    more = (row - 1.0) * sums.basis + variance * crossed
    return PoseEffect(PoseError(math.sqrt(variance), row, sums.n_several), root @ (np.eye(len(more)) + more) @ root.T)


def _sums(problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats, pose: Indices) -> _Sums | None:
    """Return the sums over the poses; None if too few have several rows."""
    rows = np.concatenate([group.row for group in problem.groups if group.row is not None] or [np.zeros(0, np.intp)])
    _, number, count = np.unique(pose[rows], return_inverse=True, return_counts=True)
    if count[count > 1].sum() < max(LEAST_SHARE * rows.size, 1.0):
        return None
    k, r = count.size, root.shape[1]
    at = np.zeros(pose.size, dtype=np.intp)
    at[rows] = number.ravel()
    own, by_basis, along = np.zeros((k, 3, 3)), np.zeros((k, 3, r)), np.zeros((k, 3))
    basis, chi2, n_scalar = np.zeros((r, r)), 0.0, 0
    for block in blocks(problem):
        if block.row is None:
            continue
        lin = block.evaluate(problem.chain, x)
        n = len(block.row)
        moved = lin.wrenches[..., TRANSLATIONS].swapaxes(0, 1).reshape(-1, 3)
        stacked = np.concatenate([moved, lin.jac_params[:, columns] @ root, lin.residual[:, None]], axis=1)
        stacked = stacked.reshape(n, -1, r + 4)
        whiten(stacked.T, residual_cov(block.sensor_cov, lin.jac_joints, problem.joint_cov))
        z = stacked[:, :, :3].swapaxes(1, 2)
        np.add.at(own, at[block.row], z @ stacked[:, :, :3])
        np.add.at(by_basis, at[block.row], z @ stacked[:, :, 3:-1])
        np.add.at(along, at[block.row], (z @ stacked[:, :, -1:])[..., 0])
        flat = stacked.reshape(-1, r + 4)
        basis += flat[:, 3:-1].T @ flat[:, 3:-1]
        chi2 += float(flat[:, -1] @ flat[:, -1])
        n_scalar += len(flat)
    return _Sums(n_scalar, int((count > 1).sum()), own, by_basis.reshape(3 * k, r), along.ravel(), basis, chi2)
