"""Common structure of all kinds of observation: the positions of their unknowns, and the form of their derivatives.

The parameter vector x (P,) of a problem is the robot's params (p,) followed by the rig's unknowns: coordinates of
chucks, spheres and sockets, zero and gain of bars. A row refers to a coordinate by its index into *x followed by the
problem's known constants*. Knowledge and unknown coordinates are therefore read in the same way, and only the unknown ones
(index below P) have a column in the Jacobian.

The Jacobian is kept as the product ``wrenches @ twists`` for the robot's params (model/chain.py), as it is computed. An
estimator folds only the wrenches, which have fewer columns. Arrays (w, n, c) are stored component by component: all
poses of one column are contiguous.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from truearm.model.chain import PointDerivatives
from truearm.model.constant_folding import Basis
from truearm.types import Floats, Indices, Mask


class Linearised(NamedTuple):
    """Residuals and derivatives of n observations with w scalar residuals each; m = n·w, grouped by observation."""

    residual: Floats  # (m,) measured − predicted, in the units of the group's components
    wrenches: Floats  # (w, n, b)
    basis: Basis  # of the b columns
    jac_rig: Floats  # (w, n, P − p) ∂predicted/∂(the rig's unknowns)
    by_joints: Floats  # (w, n, j) ∂predicted/∂(joint readings)

    @property
    def jac_params(self) -> Floats:
        """(m, P) ∂predicted/∂x."""
        return self.jac_by(np.ones(self.basis.twists.shape[1] + self.jac_rig.shape[2], dtype=bool))

    def jac_by(self, columns: Mask) -> Floats:
        """Return (m, k) ∂predicted/∂x[columns]."""
        return _by_observation(self.by_columns(columns))

    def by_columns(self, columns: Mask) -> Floats:
        """Return the same as ``jac_by``, (w, n, k); what ``jac_rig`` has beyond the mask is left out."""
        robot, rig = np.split(columns, [self.basis.twists.shape[1]])
        by_rig = self.jac_rig[:, :, np.flatnonzero(rig)]
        return np.concatenate([self.wrenches @ self.basis.twists[:, robot], by_rig], axis=2)

    @property
    def jac_joints(self) -> Floats:
        """(m, j) ∂predicted/∂(joint readings)."""
        return _by_observation(self.by_joints)


def linearised(
    residual: Floats, derivative: PointDerivatives, x: Floats, *columns: tuple[Indices, Floats]
) -> Linearised:
    """Return residuals, (m,) or (n, w), with the ``derivative`` of their predictions by the robot, and those by the rig at x (P,).

    Each of the ``columns`` are the indices (n, c) of some of the rig's numbers and the derivatives (w, n, c) by these.
    """
    p = derivative.basis.twists.shape[1]
    jac_rig = zero_columns(derivative.wrenches, x.size - p)
    w, n = derivative.wrenches.shape[:2]
    if residual.size != w * n:
        raise ValueError(f"residuals have the shape {residual.shape}, derivatives that of {n} rows with {w} residuals")
    for index, values in columns:
        if values.shape != (w, *index.shape):
            raise ValueError(
                f"derivatives by the rig have the shape {values.shape}, and not (w, n, c) = {(w, *index.shape)}"
            )
        scatter(jac_rig, index - p, values)
    return Linearised(residual.ravel(), derivative.wrenches, derivative.basis, jac_rig, derivative.jac_joints)


def gather(x: Floats, constants: Floats, index: Indices) -> Floats:
    """Return the values at ``index`` (n, c) of x followed by constants; each of the c is contiguous in memory."""
    return np.concatenate([x, constants]).take(index.T).T


def zero_columns(wrenches: Floats, count: int) -> Floats:
    """Return zeros (w, n, count) to go with wrenches (w, n, b), for ``scatter`` to write to."""
    return np.zeros((count, *wrenches.shape[:2]), wrenches.dtype).transpose(1, 2, 0)


def scatter(jac_rig: Floats, index: Indices, values: Floats) -> None:
    """Add ``values`` (w, n, c) to the columns ``index`` (n, c) of jac_rig (w, n, r) in place.

    ``index`` counts from the rig's first unknown; constants, from r on, have no column.
    """
    unknown = index < jac_rig.shape[2]
    for k in np.flatnonzero(unknown.any(axis=0)):
        if (index[:, k] == index[0, k]).all():  # usually one device
            jac_rig[:, :, index[0, k]] += values[:, :, k]
            continue
        rows = np.flatnonzero(unknown[:, k])
        jac_rig[:, rows, index[rows, k]] += values[:, rows, k]


def _by_observation(derivatives: Floats) -> Floats:
    """Reshape (w, n, c) to (n·w, c)."""
    width, n, count = derivatives.shape
    return np.swapaxes(derivatives, 0, 1).reshape(n * width, count)
