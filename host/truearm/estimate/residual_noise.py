"""Covariance of a residual: that of the sensors plus that of the joint readings through the arm (errors in variables).

A reading q has an error δq of covariance S_q, so the residual measured − predicted(q) has the covariance

    C⁻¹ = S_x + J_q S_q J_qᵀ

(Renders, Rossignol, Becquet, Hanus 1991, (7)–(12), there "C_i"), with J_q the derivative by the readings, updated at
each linearisation. Without S_q the covariance of the estimate is far too small (docs/explanation/estimation.md).

The weights stay constant while a step is evaluated: a solver that compares χ² before and after would otherwise see them
change, and stall. ``information.weighed`` returns a problem with the weights of one x. At the end they are those of the
estimate.
"""

from __future__ import annotations

import numpy as np

from truearm.errors import ProblemError
from truearm.schema import Matrix
from truearm.text import counted
from truearm.types import Floats


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
