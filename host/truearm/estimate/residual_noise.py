"""Covariance of a residual: that of the sensors plus that of the joint readings through the arm (errors in variables).

A reading q has an error δq of covariance S_q, so the residual measured − predicted(q) has the covariance

    C⁻¹ = S_x + J_q S_q J_qᵀ

(Renders, Rossignol, Becquet, Hanus 1991, (7)–(12), there "C_i"), with J_q the derivative by the readings, updated at
each linearisation. Without S_q the covariance of the estimate is far too small (docs/explanation/estimation.md).

The weights stay constant while a step is evaluated, or a solver that compares χ² would see them change, and stall
(``information.weighed``).

A link lags its encoder by half the backlash b, on the side s = ±1 that the joint came from: it is at q − ½ b s. Where
the side is unknown, ½ b is noise (docs/decisions/0017-dwells-and-noise.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.errors import ProblemError
from truearm.kinds.table import ObservationTable
from truearm.schema import Matrix
from truearm.text import counted
from truearm.types import Floats, Rig

ROUNDING = 1e-9  # relative to joint_cov, which contains ½ b_j squared


def residual_cov(sensor_cov: Floats, jac_joints: Floats, joint_cov: Floats | None) -> Floats:
    """Return S_x + J_q S_q J_qᵀ of n observations with w residuals each.

    sensor_cov : (n, w) variances or (n, w, w); jac_joints : (n·w, j); joint_cov : (j, j), or None for exact readings.
    Returns ``sensor_cov`` for exact readings, (n, 1) for w = 1, and (n, w, w) otherwise.
    """
    if joint_cov is None:
        return sensor_cov
    n, w = sensor_cov.shape[:2]
    if w == 1:
        joint = ((jac_joints @ joint_cov) * jac_joints).sum(axis=1, keepdims=True)
        return np.asarray(sensor_cov.reshape(n, 1) + joint)
    jac = jac_joints.reshape(n, w, -1)
    joint = jac @ joint_cov @ np.swapaxes(jac, 1, 2)
    if sensor_cov.ndim == 2:
        joint[:, range(w), range(w)] += sensor_cov
        return np.asarray(joint)
    return np.asarray(joint + sensor_cov)


def whiten(stacked: Floats, cov: Floats) -> None:
    """Divide (k, w, n) in place by the root of n covariances, (n, w) variances or (n, w, w).

    With C⁻¹ = L Lᵀ they become L⁻¹ rows, whose noise has unit covariance.
    """
    if cov.ndim == 2:
        stacked *= 1.0 / np.sqrt(cov.T)
        return
    root = np.moveaxis(np.linalg.cholesky(cov), 0, 2).copy()  # (w, w, n)
    for i in range(len(root)):  # forward substitution, all observations at once
        for j in range(i):
            stacked[:, i] -= root[i, j] * stacked[:, j]
        stacked[:, i] /= root[i, i]


def checked_joint_cov(matrix: Matrix, joints: int) -> Floats | None:
    """Return (j, j) from a rig's ``joint_cov``, None if it is empty or zero. Raises ProblemError for another size."""
    if matrix and len(matrix) != joints:
        raise ProblemError(
            f"the rig's joint noise is of {counted(len(matrix), 'joint')}, the robot has {joints}; "
            "give joint_sigma_rad (or joint_cov_si) one entry per joint"
        )
    cov = np.array(matrix)
    return cov if cov.any() else None


class Backlash(NamedTuple):
    """``width`` (j,): b [rad, m]; ``cov_of_known_sides`` (j, j): covariance of a joint reading whose side is known."""

    width: Floats
    cov_of_known_sides: Floats

    @classmethod
    def of(cls, rig: Rig, joint_cov: Floats | None) -> Backlash | None:
        """Return the backlash of a rig with this ``joint_cov``, or None if it has none.

        Raises ProblemError if the two are inconsistent.
        """
        if not rig.backlash:
            return None
        width, sigma = np.array(rig.backlash), np.array(rig.backlash_sigma)
        if joint_cov is None or width.shape != joint_cov.shape[:1] or sigma.shape != width.shape:
            raise ProblemError("backlash needs joint_cov; backlash and backlash_sigma need one value for each joint")
        left = np.diag(joint_cov) - 0.25 * width**2
        if (left < -ROUNDING * np.diag(joint_cov)).any():
            raise ProblemError("joint_cov must include the backlash: a joint's sigma must be at least half of it")
        cov = joint_cov.copy()
        np.fill_diagonal(cov, np.maximum(left, 0.0) + 0.25 * sigma**2)
        return cls(width, cov)

    def links(self, table: ObservationTable) -> Floats:
        """Return the joint positions of the links (n, j), corrected where the side is known."""
        return np.asarray(table.q - 0.5 * self.width * np.nan_to_num(table.side, nan=0.0))

    def unknown(self, table: ObservationTable) -> Floats:
        """Return the remaining standard deviation of the links (n, j): half the backlash where the side is unknown."""
        return np.where(np.isnan(table.side), 0.5 * np.abs(self.width), 0.0)
