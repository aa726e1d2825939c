"""What the observations can see of the robot, and the directions that they cannot, in parameter names.

The rig's unknowns are projected out first: of the scaled root A = [A_robot | A_rig] remains (I − U Uᵀ) A_robot, U a
basis of A_rig's range. Its singular values fall into two groups; the smaller ones are rounding (1e-15) if the Jacobian
is analytic, and the ratio between the groups, the gap, tells how safe the count is (Goswami 1993: "counting the number
of nonzero singular values of H or J").

Null directions are made readable: of all bases of the null space the one in which each direction has a parameter of
its own (a pivot, weight 1 in it and 0 in the others); all other parameters appear only as needed to undo the pivot.

A set to free is suggested by the same columns: pivoted QR takes the one with the longest part that is not yet explained,
until nothing is left. Which of several equivalent parameters to hold is a matter of taste, and the papers' taste comes
with the robot's file (``Robot.free``): preferred columns are taken before all others. The columns taken before remain
taken when rows are added, since rows cannot make independent columns dependent; so what an addition would add is the
difference of two such sets.

A direction may count and still be useless. Poses of one tool orientation lose three combinations of parameters, but only
if the arm keeps that orientation exactly; a real one does to some milliradians, which lifts the three far above rounding.
So directions are also held against what a maker's drawing tells, a ``unit`` for each parameter (1 mm, 5 mrad, 0.001 of a
gain): columns whitened and in these units have a singular value s for a combination that the data alone tell to 1/s of
them, and where s < 1 it is hardly seen.

So is a time offset of the joint readings that is told to no better than a millisecond, a tenth of a millimetre at 100 mm/s.
Lines driven one way at constant speed tell nothing of it, but speeds are never quite constant, so it is no null direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from truearm.estimate.information import RANK_TOLERANCE, scaled_columns
from truearm.types import Floats, NullDirection, Observability

NO_PART = 1e-6  # weight, in scaled parameters, below which a parameter takes no part in a direction
SMALL_PART = 0.05  # the same, in units, for a direction that is hardly seen, in which all parameters have some part


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
    singular, null_robot = null_basis(project_out(robot, rig))
    _, null_rig = null_basis(rig)
    _, null_all = null_basis(scaled)
    rank = n_robot - null_robot.shape[1]
    # A change of the robot alters no prediction only together with what it does to the rig.
    jac_rig = -np.linalg.pinv(rig, rcond=RANK_TOLERANCE) @ (robot @ null_robot)
    directions = (
        *_directions(null_robot, scale, names, beside=jac_rig),
        *_directions(null_rig, scale[n_robot:], names[n_robot:]),
    )
    identifiable = np.linalg.norm(null_all, axis=1) < NO_PART
    return Identifiability(rank, _gap(singular, rank), singular, identifiable, directions)


def observability(root: Floats, n_robot: int, chosen: NDArray[np.bool_], unit: Floats, n_rows: int) -> Observability:
    """Indices of the robot's ``chosen`` (n_robot,) columns with the rig projected out; ``unit`` (n_robot,) scales them.

    The columns are whitened by the noise, so a singular value s is how many σ of noise a change by one unit makes, over
    all ``n_rows`` scalar residuals. With c columns: o1 = (Πs)^(1/c)/√n (Borm and Menq 1991), o2 = s_min/s_max (Driels
    and Pathre 1990), o3 = s_min (Nahvi and others 1994), o4 = s_min²/s_max (Nahvi and Hollerbach 1996). All are 0 where
    something is not seen at all, NaN where there is nothing to see.
    """
    singular = np.linalg.svd(_in_units(root, n_robot, unit)[:, chosen], compute_uv=False)
    if singular.size == 0 or n_rows == 0:
        return Observability(*(float("nan"),) * 4)
    least, most = float(singular[-1]), float(singular[0])
    if least <= RANK_TOLERANCE * most:
        return Observability(0.0, 0.0, 0.0, 0.0)
    mean = float(np.exp(np.log(singular).mean()))
    return Observability(mean / float(np.sqrt(n_rows)), least / most, least, least**2 / most)


def suggested_free(
    root: Floats, n_robot: int, prefer: NDArray[np.bool_], taken: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """(n_robot,) a largest set of the robot's columns that the data tell apart from each other and from the rig.

    ``prefer`` columns come first, ``taken`` ones, which must be independent, before them.
    """
    scaled, _ = scaled_columns(root)
    rest = project_out(scaled[:, :n_robot], scaled[:, n_robot:])
    out = np.zeros(n_robot, dtype=bool) if taken is None else taken.copy()
    for group in (prefer & ~out, ~prefer & ~out):
        left = project_out(rest[:, group], rest[:, out])
        if left.size == 0:
            continue
        triangle, order = scipy.linalg.qr(left, mode="r", pivoting=True)
        rank = int((np.abs(np.diag(triangle)) > RANK_TOLERANCE).sum())
        out[np.flatnonzero(group)[order[:rank]]] = True
    return out


def hardly_seen(root: Floats, n_robot: int, unit: Floats, names: Sequence[str]) -> tuple[NullDirection, ...]:
    """Directions of the robot's columns that count, but that the data tell to no better than ``unit`` (n_robot,)."""
    rest = _in_units(root, n_robot, unit)
    if rest.size == 0:
        return ()
    _, singular, vt = np.linalg.svd(rest)
    weak = (singular < 1.0) & (singular > RANK_TOLERANCE * singular[0])
    return _directions(vt[weak].T, 1.0 / unit, names[:n_robot], SMALL_PART)


def not_told(root: Floats, n_robot: int, unit: Floats, least: float = -1.0) -> NDArray[np.bool_]:
    """(n_robot,) the robot's columns in directions that the data tell to no better than ``unit`` (n_robot,).

    Those with a singular value up to ``least`` of the largest do not count: with RANK_TOLERANCE, what is not seen at all.
    """
    rest = _in_units(root, n_robot, unit)
    if rest.size == 0:
        return np.zeros(n_robot, dtype=bool)
    _, singular, vt = np.linalg.svd(rest)
    return np.asarray((np.abs(vt[(singular < 1.0) & (singular > least * singular[0])]) > SMALL_PART).any(axis=0))


def hardly_told(root: Floats, column: int, unit: float) -> bool:
    """Whether the data tell this one parameter, all others (robot and rig) being unknown, no better than ``unit``."""
    rest = project_out(root[:, [column]], np.delete(root, column, axis=1))
    return float(np.linalg.norm(rest)) * unit < 1.0


def told_apart(root: Floats, n_robot: int, unit: Floats, taken: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """(n_robot,) as many columns as there are directions told to better than ``unit``, the ``taken`` ones first."""
    rest = _in_units(root, n_robot, unit)
    out = np.zeros(n_robot, dtype=bool) if taken is None else taken.copy()
    more = int((np.linalg.svd(rest, compute_uv=False) >= 1.0).sum() - out.sum())
    if more > 0:
        order = scipy.linalg.qr(project_out(rest[:, ~out], rest[:, out]), mode="r", pivoting=True)[1]
        out[np.flatnonzero(~out)[order[:more]]] = True
    return out


def _in_units(root: Floats, n_robot: int, unit: Floats) -> Floats:
    """The robot's columns, whitened, the rig projected out, by units of their parameters."""
    scaled, scale = scaled_columns(root)
    return np.asarray(project_out(scaled[:, :n_robot], scaled[:, n_robot:]) * (scale[:n_robot] * unit))


def project_out(wanted: Floats, unwanted: Floats) -> Floats:
    """(I − U Uᵀ) wanted, U an orthonormal basis of the columns of ``unwanted``."""
    if unwanted.shape[1] == 0:
        return wanted
    u, singular, _ = np.linalg.svd(unwanted, full_matrices=False)
    basis = u[:, singular > RANK_TOLERANCE * singular.max(initial=0.0)]
    return np.asarray(wanted - basis @ (basis.T @ wanted))


def null_basis(matrix: Floats) -> tuple[Floats, Floats]:
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


def _directions(
    basis: Floats, scale: Floats, names: Sequence[str], least: float = NO_PART, beside: Floats | None = None
) -> tuple[NullDirection, ...]:
    """The null space (c, d), scaled, as readable directions in SI units, each with its largest weight 1.

    ``beside`` (·, d) are further rows of the directions, after those of the basis.
    """
    d = basis.shape[1]
    if d == 0:
        return ()
    pivots = scipy.linalg.qr(basis.T, mode="r", pivoting=True)[1][:d]
    whole = basis if beside is None else np.concatenate([basis, beside])
    own = whole @ np.linalg.inv(basis[pivots])
    out = []
    for column in own[:, np.argsort(pivots)].T:
        part = np.flatnonzero(np.abs(column) > least).tolist()
        weights = column[part] / scale[part]
        weights = weights / weights[np.argmax(np.abs(weights))]
        out.append(NullDirection(tuple(names[i] for i in part), tuple(float(w) for w in weights)))
    return tuple(out)


def spread(flags: NDArray[np.bool_], columns: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Flags of some columns among all: ``flags`` (k,) of the k that ``columns`` (p,) names, False elsewhere (p,)."""
    out = np.zeros(columns.size, dtype=bool)
    out[columns] = flags
    return out
