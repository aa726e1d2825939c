"""What the observations can see of the robot, and the directions that they cannot, in parameter names.

The rig's unknowns are projected out first: of the scaled root A = [A_robot | A_rig] remains (I − U Uᵀ) A_robot, U a
basis of A_rig's range. Its singular values fall into two groups; the smaller ones are rounding (1e-15) if the Jacobian
is analytic, and the ratio between the groups, the gap, tells how safe the count is (Goswami 1993: "counting the number
of nonzero singular values of H or J").

Null directions are made readable: of all bases of the null space the one in which each direction has a parameter of
its own (a pivot, weight 1 in it and 0 in the others); all other parameters appear only as needed to undo the pivot.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from truearm.estimate.information import RANK_TOLERANCE, scaled_columns
from truearm.types import Floats, NullDirection

NO_PART = 1e-6  # weight, in scaled parameters, below which a parameter takes no part in a direction


class Identifiability(NamedTuple):
    """Rank of the robot's free parameters with the rig projected out, and everything that is not seen."""

    rank: int
    gap: float  # smallest kept over largest dropped singular value; inf if none was dropped
    singular: Floats  # (r,) of the robot's part
    identifiable: NDArray[np.bool_]  # (k,)
    null_space: tuple[NullDirection, ...]


def identifiability(root: Floats, n_robot: int, names: Sequence[str]) -> Identifiability:
    """Analyse a root (k, k) whose first ``n_robot`` columns are the robot's; ``names`` are the k parameters'."""
    scaled, scale = scaled_columns(root)
    robot, rig = scaled[:, :n_robot], scaled[:, n_robot:]
    singular, null_robot = _null_basis(project_out(robot, rig))
    _, null_rig = _null_basis(rig)
    _, null_all = _null_basis(scaled)
    rank = n_robot - null_robot.shape[1]
    directions = (
        *_directions(null_robot, scale[:n_robot], names[:n_robot]),
        *_directions(null_rig, scale[n_robot:], names[n_robot:]),
    )
    identifiable = np.linalg.norm(null_all, axis=1) < NO_PART
    return Identifiability(rank, _gap(singular, rank), singular, identifiable, directions)


def project_out(wanted: Floats, unwanted: Floats) -> Floats:
    """(I − U Uᵀ) wanted, U an orthonormal basis of the columns of ``unwanted``."""
    if unwanted.shape[1] == 0:
        return wanted
    u, singular, _ = np.linalg.svd(unwanted, full_matrices=False)
    basis = u[:, singular > RANK_TOLERANCE * singular.max(initial=0.0)]
    return np.asarray(wanted - basis @ (basis.T @ wanted))


def _null_basis(matrix: Floats) -> tuple[Floats, Floats]:
    """Singular values (c,) and an orthonormal basis (c, d) of the null space of a matrix with scaled columns."""
    columns = matrix.shape[1]
    if columns == 0:
        return np.zeros(0), np.zeros((0, 0))
    _, singular, vt = np.linalg.svd(matrix)
    singular = np.pad(singular, (0, columns - singular.size))
    # Columns have length 1 (or less, projected): the largest singular value is of order 1 unless nothing is seen.
    rank = int((singular > RANK_TOLERANCE * max(singular.max(), 1.0)).sum())
    return singular, vt[rank:].T


def _gap(singular: Floats, rank: int) -> float:
    if rank in (0, singular.size) or singular[rank] == 0.0:
        return float("inf")
    return float(singular[rank - 1] / singular[rank])


def _directions(basis: Floats, scale: Floats, names: Sequence[str]) -> tuple[NullDirection, ...]:
    """The null space (c, d), scaled, as readable directions in SI units, each with its largest weight 1."""
    d = basis.shape[1]
    if d == 0:
        return ()
    pivots = scipy.linalg.qr(basis.T, mode="r", pivoting=True)[1][:d]
    own = basis @ np.linalg.inv(basis[pivots])
    out = []
    for column in own[:, np.argsort(pivots)].T:
        part = np.flatnonzero(np.abs(column) > NO_PART).tolist()
        weights = column[part] / scale[part]
        weights = weights / weights[np.argmax(np.abs(weights))]
        out.append(NullDirection(tuple(names[i] for i in part), tuple(float(w) for w in weights)))
    return tuple(out)
