"""What all kinds of observation share: where their unknowns stand, and what they give back.

The parameter vector x (P,) of a problem is the robot's params (p,) followed by the rig's unknowns: coordinates of
chucks, spheres and sockets, zero and gain of bars. A row refers to a coordinate by its index into *x followed by the
problem's known constants*, so that known and unknown coordinates are read the same way, and only the unknown ones
(index below P) have a column in the Jacobian.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Indices = NDArray[np.intp]
AnyRows = TypeVar("AnyRows", bound="DataclassInstance")


class Linearised(NamedTuple):
    """Residuals and derivatives of a batch of observations; m scalar residuals, those of one observation together."""

    residual: Floats  # (m,) measured − predicted [m]
    jac_params: Floats  # (m, P) ∂predicted/∂x
    jac_joints: Floats  # (m, j) ∂predicted/∂(joint readings)


def take(rows: AnyRows, which: slice | NDArray[Any]) -> AnyRows:
    """Some of the observations; every field but the shared constants has them as its first axis."""
    return replace(rows, **{f.name: getattr(rows, f.name)[which] for f in fields(rows) if f.name != "constants"})


def gather(x: Floats, constants: Floats, index: Indices) -> Floats:
    """Values at ``index`` (n, c) of x followed by constants; each of the c lies together in memory."""
    return np.concatenate([x, constants]).take(index.T).T


def widen(jac_robot: Floats, n_params: int) -> Floats:
    """The robot's columns (m, p) followed by zeros for the rig's unknowns, (m, P); columns lie together in memory.

    Without unknowns of the rig it is the robot's columns themselves.
    """
    m, p = jac_robot.shape
    if p == n_params:
        return jac_robot
    return np.concatenate([jac_robot.T, np.zeros((n_params - p, m), jac_robot.dtype)]).T


def scatter(jac: Floats, index: Indices, values: Floats) -> None:
    """Add ``values`` (m, c) to the columns ``index`` (m, c) of jac (m, P) in place; constants have no column."""
    unknown = index < jac.shape[1]
    if not unknown.any():
        return
    rows = np.arange(jac.shape[0])
    for k in np.flatnonzero(unknown.any(axis=0)):
        some = unknown[:, k]
        jac[rows[some], index[some, k]] += values[some, k]
