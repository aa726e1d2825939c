"""Errors that the rows of one pose share: a random effect a pose, its variance, and what it makes of the covariance.

Several reflectors on one tool, or the same pose measured again, do not err independently: what the model does not hold of the arm
moves all of them together. So the whitened residuals are taken to have the covariance

    R = m I + p Z Zᵀ ,

m the variance of a row's own noise in terms of the declared one, p [m²] that of each component of a translation of the end at a pose,
and Z (N, 3K) the whitened derivatives by the translations of the K poses: of a pose's rows, so that R is one block a pose.

With Q = J S an orthonormal basis of what the parameters follow (P = S Sᵀ) and M = I − Q Qᵀ, two quadratic forms of the residuals
e = M y have the expectations (Rao 1971, MINQUE; unbiased, and for equally many rows a pose the analysis of variance)

    E eᵀe = m tr M + p tr(ZᵀMZ) ,   E |Zᵀe|² = m tr(ZᵀMZ) + p ‖ZᵀMZ‖² .

Their covariance where p is 0 is 2m² times the same matrix, which says whether p is beyond chance. The parameters stay where least
squares has them, as unmodelled errors that are not alike for the points of a pose would bend weights that were learnt from them; what
changes is the covariance of such an estimate, P + S((m − 1) QᵀQ + p (ZᵀQ)ᵀZᵀQ) Sᵀ. A prior, which rests on no row, counts in it as declared.

Where each pose has one row nothing tells m from p but the model, and nothing is estimated; nor where fewer than half of the rows share
their pose with others, as check poses do, since single rows would decide.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.estimate.problem import Problem, blocks
from truearm.estimate.residual_noise import residual_cov, whiten
from truearm.kinds.linearised import Indices
from truearm.types import Floats, PoseError

LEVEL = 0.05  # of fits without such errors that show some by chance
TRANSLATIONS = slice(0, 6, 2)  # of ``Linearised.wrenches``: the forces
LEAST_SHARE = 0.5  # of the rows that share their pose with others
TOLD = 1e-6  # share of p's information that m must leave


class PoseEffect(NamedTuple):
    """Errors shared by the rows of a pose, and the covariance (k, k) of least-squares estimates with them."""

    error: PoseError
    covariance: Floats


class _Sums(NamedTuple):
    """What the rows say, whitened."""

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
    """The errors that rows of one ``pose`` (n_rows,) share at the estimate x (P,); ``root`` (k, r) is S there.

    None where fewer than half of the rows share their pose with others, or where these err no more alike than by chance.
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
    row = max(float(row), 1.0)  # no less than was declared
    more = (row - 1.0) * sums.basis + variance * crossed
    return PoseEffect(PoseError(math.sqrt(variance), row, sums.n_several), root @ (np.eye(len(more)) + more) @ root.T)


def _sums(problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats, pose: Indices) -> _Sums | None:
    """The sums over the poses; None where too few have several rows."""
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
