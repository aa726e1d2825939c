"""What the observations can determine of the robot, and the null directions in terms of named parameters.

The rig's unknowns are projected out first. The singular values of the rest form two groups, of which the smaller ones
are rounding errors (1e-15). Their gap shows how reliable the rank is (Goswami 1993).

Each null direction has a parameter of its own, with weight 1 there and 0 in the others. Pivoted QR of the same columns
gives a suggested free set, which begins with the preferred columns and, among equal ones (``ties``), with the first of
the robot's file.

A direction of full rank may be useless. With columns in units of a drawing's accuracy (1 mm, 5 mrad, 0.001 of a gain),
a singular value s determines a combination to 1/s units. Below 1 it is hardly identifiable
(docs/explanation/identifiability.md). So is a time offset known to a millisecond.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from truearm.estimate.information import RANK_TOLERANCE, fold, observe, with_prior
from truearm.estimate.problem import build_problem, settled
from truearm.estimate.ties import first_within, pivots
from truearm.kinds.proposals import Proposal
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Addition, NullDirection, Observability
from truearm.types import Floats, Rig, Rigs

SHORT = 0.01  # of the longest column
NO_PART = 1e-6  # weight, in scaled parameters, below which a parameter does not belong to a direction
SMALL_PART = 0.05  # the same, in units, for a hardly identifiable direction, to which all parameters contribute


class Identifiability(NamedTuple):
    """Rank of the robot's free parameters with the rig projected out, and the null space."""

    rank: int
    gap: float  # smallest kept over largest dropped singular value; inf if none was dropped
    singular: Floats  # (r,) of the robot's part
    identifiable: NDArray[np.bool_]  # (k,)
    null_space: tuple[NullDirection, ...]  # as printed: without parts below NO_PART
    unseen: Floats  # (k, d) the same space exactly, in SI units, each direction with a largest weight of 1


def identifiability(root: Floats, n_robot: int, names: Sequence[str]) -> Identifiability:
    """Analyse a root (k, k) whose first ``n_robot`` columns are the robot's.

    ``names`` are those of the k parameters.
    """
    scaled, scale = rank_columns(root)
    robot, rig = scaled[:, :n_robot], scaled[:, n_robot:]
    singular, null_robot = null_basis(project_out(robot, rig))
    _, null_rig = null_basis(rig)
    _, null_all = null_basis(scaled)
    rank = n_robot - null_robot.shape[1]
    # A null direction of the robot leaves predictions unchanged only together with the matching change of the rig.
    jac_rig = -np.linalg.pinv(rig, rcond=RANK_TOLERANCE) @ (robot @ null_robot)
    directions = (
        *_directions(null_robot, scale, names, beside=jac_rig),
        *_directions(null_rig, scale[n_robot:], names[n_robot:]),
    )
    identifiable = np.linalg.norm(null_all, axis=1) < NO_PART
    unseen = null_all / scale[:, None]
    unseen /= np.abs(unseen).max(axis=0, initial=1e-300)
    return Identifiability(rank, _gap(singular, rank), singular, identifiable, directions, unseen)


def observability(root: Floats, n_robot: int, chosen: NDArray[np.bool_], unit: Floats, n_rows: int) -> Observability:
    """Return the observability indices of the robot's ``chosen`` (n_robot,) columns, with the rig projected out.

    ``unit`` (n_robot,) scales the columns, which are whitened by the noise, so a singular value s is the change in σ of
    noise per unit, over all ``n_rows`` scalar residuals. With c columns: o1 = (Πs)^(1/c)/√n (Borm and Menq 1991), o2 =
    s_min/s_max (Driels and Pathre 1990), o3 = s_min (Nahvi and others 1994), o4 = s_min²/s_max (Nahvi and Hollerbach
    1996). All are 0 if any direction is unidentifiable, and NaN if there are no columns.
    """
    singular = np.linalg.svd(_in_units(root, n_robot, unit)[:, chosen], compute_uv=False)
    if singular.size == 0 or n_rows == 0:
        return Observability(*(float("nan"),) * 4)
    smallest, largest = float(singular[-1]), float(singular[0])
    if smallest <= RANK_TOLERANCE * largest:
        return Observability(0.0, 0.0, 0.0, 0.0)
    mean = float(np.exp(np.log(singular).mean()))
    return Observability(mean / float(np.sqrt(n_rows)), smallest / largest, smallest, smallest**2 / largest)


def suggested_free(
    root: Floats, n_robot: int, prefer: NDArray[np.bool_], taken: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Return a largest set (n_robot,) of the robot's columns that are distinguishable from each other and from the rig.

    ``taken`` columns, which must be independent, come first, then ``prefer`` columns.
    """
    scaled, _ = rank_columns(root)
    projected = project_out(scaled[:, :n_robot], scaled[:, n_robot:])
    out = np.zeros(n_robot, dtype=bool) if taken is None else taken.copy()
    for group in (prefer & ~out, ~prefer & ~out):
        undistinguished = project_out(projected[:, group], projected[:, out])
        if undistinguished.size == 0:
            continue
        out[np.flatnonzero(group)[pivots(undistinguished, RANK_TOLERANCE)]] = True
    return out


def hardly_seen(root: Floats, n_robot: int, unit: Floats, names: Sequence[str]) -> tuple[NullDirection, ...]:
    """Return identifiable directions of the robot's columns, determined no better than ``unit`` (n_robot,)."""
    weak = _weak_directions(root, n_robot, unit, RANK_TOLERANCE)
    return _directions(weak.T, 1.0 / unit, names[:n_robot], SMALL_PART)


def weakly_identifiable(root: Floats, n_robot: int, unit: Floats, least: float = -1.0) -> NDArray[np.bool_]:
    """Return a mask (n_robot,) of the columns in directions that the data determine no better than ``unit`` (n_robot,).

    Directions with a singular value up to ``least`` of the largest do not count: with RANK_TOLERANCE, null directions.
    """
    return np.asarray((np.abs(_weak_directions(root, n_robot, unit, least)) > SMALL_PART).any(axis=0))


def _weak_directions(root: Floats, n_robot: int, unit: Floats, least: float) -> Floats:
    """Return the directions (d, n_robot), in units, with a singular value from ``least`` of the largest up to 1."""
    _, singular, vt = np.linalg.svd(_in_units(root, n_robot, unit))
    return np.asarray(vt[(singular < 1.0) & (singular > least * singular.max(initial=0.0))])


def is_weakly_identifiable(root: Floats, column: int, unit: float) -> bool:
    """Return whether the data determine this parameter no better than ``unit``, all others being unknown."""
    projected = project_out(root[:, [column]], np.delete(root, column, axis=1))
    return float(np.linalg.norm(projected)) * unit < 1.0


def identifiable_columns(
    root: Floats, n_robot: int, unit: Floats, taken: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Return as many columns (n_robot,) as there are directions known to better than ``unit``, ``taken`` ones first."""
    columns = _in_units(root, n_robot, unit)
    out = np.zeros(n_robot, dtype=bool) if taken is None else taken.copy()
    count = int((np.linalg.svd(columns, compute_uv=False) >= 1.0).sum() - out.sum())
    if count > 0:
        out[np.flatnonzero(~out)[pivots(project_out(columns[:, ~out], columns[:, out]), most=count)]] = True
    return out


def _in_units(root: Floats, n_robot: int, unit: Floats) -> Floats:
    """Return the robot's whitened columns with the rig projected out, in units of their parameters."""
    scaled, scale = rank_columns(root)
    return np.asarray(project_out(scaled[:, :n_robot], scaled[:, n_robot:]) * (scale[:n_robot] * unit))


def rank_columns(root: Floats) -> tuple[Floats, Floats]:
    """Return the root with columns of length 1, and the divisors (k,), for a decision about rank.

    A column that is far shorter than the longest is divided by SHORT of that and stays shorter than 1. It may be a
    difference of terms as long as the longest: scaled up, their rounding would pass for information.
    """
    length = np.linalg.norm(root, axis=0)
    scale = np.maximum(length, SHORT * length.max(initial=0.0))
    scale[scale == 0.0] = 1.0
    return root / scale, scale


def project_out(wanted: Floats, unwanted: Floats) -> Floats:
    """Return (I − U Uᵀ) wanted, with U an orthonormal basis of the columns of ``unwanted``."""
    if unwanted.size == 0:
        return wanted
    basis = scipy.linalg.orth(unwanted, rcond=RANK_TOLERANCE)
    return np.asarray(wanted - basis @ (basis.T @ wanted))


def null_basis(matrix: Floats) -> tuple[Floats, Floats]:
    """Return singular values (c,) and an orthonormal basis (c, d) of the null space of a matrix with scaled columns."""
    columns = matrix.shape[1]
    if columns == 0:
        return np.zeros(0), np.zeros((0, 0))
    _, singular, vt = np.linalg.svd(matrix)
    singular = np.pad(singular, (0, columns - singular.size))
    # Columns have length 1 (or less, projected): the largest singular value is of order 1 unless nothing is
    # identifiable.
    rank = int((singular > RANK_TOLERANCE * max(singular.max(), 1.0)).sum())
    return singular, vt[rank:].T


def _gap(singular: Floats, rank: int) -> float:
    if rank in (0, singular.size) or singular[rank] == 0.0:
        return float("inf")
    return float(singular[rank - 1] / singular[rank])


def _directions(
    basis: Floats, scale: Floats, names: Sequence[str], smallest: float = NO_PART, beside: Floats | None = None
) -> tuple[NullDirection, ...]:
    """Return the null space (c, d), scaled, as readable directions in SI units, each with a largest weight of 1.

    ``beside`` (·, d) are additional rows of the directions, after those of the basis.
    """
    d = basis.shape[1]
    if d == 0:
        return ()
    own_parameters = sorted(pivots(basis.T))
    directions = basis if beside is None else np.concatenate([basis, beside])
    out = []
    for column in (directions @ np.linalg.inv(basis[own_parameters])).T:
        members = np.flatnonzero(np.abs(column) > smallest).tolist()
        weights = column[members] / scale[members]
        weights = weights / weights[first_within(np.abs(weights))]
        out.append(NullDirection(tuple(names[i] for i in members), tuple(float(w) for w in weights)))
    return tuple(out)


def spread(flags: NDArray[np.bool_], columns: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return flags (p,) for all columns: ``flags`` (k,) for the k that ``columns`` (p,) selects, False elsewhere."""
    out = np.zeros(columns.size, dtype=bool)
    out[columns] = flags
    return out


def additions(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    names: Sequence[str],
    root: Floats,
    known: Mapping[str, float],
    taken: NDArray[np.bool_],
    unit: Floats | None = None,
) -> tuple[Addition, ...]:
    """Return the proposals (``Kind.proposals``) that help, each on its own, the most useful first.

    Each is tried: rows such as it would give at the estimate are folded into the existing information. root (k, k) is
    the information on the free parameters ``names`` (k,), of which the first ``taken.size`` are the robot's. Those
    ``taken`` are distinguishable, to better than ``unit`` (taken.size,) if it is given. ``known`` is the estimate by
    name.
    """
    if taken.all() or len(table) == 0:
        return ()
    estimated = _at(chain, known)
    helpful = []
    for proposal, prefix in _proposals(estimated, rig, table):
        wide = _with(estimated, proposal, prefix, names, root, known)
        determined = (
            suggested_free(wide, taken.size, taken, taken)
            if unit is None
            else identifiable_columns(wide, taken.size, unit, taken)
        )
        gained = np.flatnonzero(determined & ~taken).tolist()
        if gained:
            gained_names = tuple(names[i] for i in gained)
            text = f"{proposal.text} with the rig {prefix[:-1]}" if prefix else proposal.text
            helpful.append(Addition(proposal.kind, proposal.names, int(determined.sum()), gained_names, text))
    return tuple(sorted(helpful, key=lambda a: -a.rank))


def _with(
    estimated: Chain,
    proposal: Proposal,
    prefix: str,
    names: Sequence[str],
    root: Floats,
    known: Mapping[str, float],
) -> Floats:
    """Return the root with the rows of a proposal folded in, its new unknowns after all others."""
    problem = build_problem(estimated, proposal.rig, proposal.rows)
    of_problem = [*problem.names[: problem.n_robot], *(prefix + name for name in problem.names[problem.n_robot :])]
    x = np.array([known.get(name, start) for name, start in zip(of_problem, problem.start, strict=True)])
    columns = np.array([name in names or name not in known for name in of_problem])
    theirs = [name for name, is_unknown in zip(of_problem, columns, strict=True) if is_unknown]
    all_names = [*names, *(name for name in theirs if name not in names)]
    wide = np.zeros((len(theirs), len(all_names)))
    # Prior information on the new items; that on the rest is already in the root.
    sigma = np.where([name in names for name in theirs], np.inf, problem.prior_sigma[columns])
    data = with_prior(observe(settled(problem, x), x, columns), np.zeros(len(theirs)), sigma)
    wide[:, [all_names.index(name) for name in theirs]] = data.root
    padded = np.zeros((len(all_names), len(all_names)))
    padded[: len(names), : len(names)] = root
    return fold(padded, wide)


def _proposals(estimated: Chain, rigs: Rigs, table: ObservationTable) -> Iterator[tuple[Proposal, str]]:
    """Return what each kind of a rig's rows proposes at the estimate, and the prefix of the rig's unknowns' names.

    A kind without rows would propose equipment that the user does not have.
    """
    for name in dict.fromkeys(table.rig.tolist()):
        rig = rigs if isinstance(rigs, Rig) else rigs[name]
        rows = table.select(table.rig == name)
        for kind_name, kind in kinds().items():
            if kind.proposals is not None and kind_name in rows.kind:
                for proposal in kind.proposals(estimated, rig, rows, np.random.default_rng(0)):
                    yield proposal, f"{name}." if name and rig is not rigs else ""


def _at(chain: Chain, known: Mapping[str, float]) -> Chain:
    """Return the chain with the estimate as its nominal values, so that new items are placed by the estimate."""
    return replace(chain, parameters=tuple(replace(p, nominal=known[p.name]) for p in chain.parameters))
