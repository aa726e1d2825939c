"""Which candidates to measure: greedy optimal choice with exchange refinement.

With whitened rows J_i (w, k) of a candidate and M the information of what is known and chosen, in units of what was
believed of each parameter beforehand (so that the prior alone is M = I and metres compare with radians), P = M⁻¹ and
S = I + J_i P J_iᵀ, one more candidate changes

- log det M by log det S: what D-optimality takes most of (the volume of the confidence ellipsoid);
- tr(LᵀPL) by −‖S^(−1/2) J_i P L‖²: A-optimality with L = I (the mean variance of the parameters), I-optimality with
  L Lᵀ = the mean of J_rᵀJ_r over the user's region (the mean variance of a point's position there), and E-optimality with
  L the eigenvector of the largest eigenvalue of P (the worst direction), taken again at each step.

Each step takes the best candidate and adds its block J_iᵀJ_i to M. The order is nested: the first n of it are the
choice of n, so a budget in minutes is a matter of where to stop. Where time counts, a candidate that needs the bar put on
again counts by what it brings a second: ``setup`` is how much dearer the first one of a group is than a further one. The
exchange (Fedorov 1972) then takes every chosen candidate out and puts the best one in its place, as long as that helps;
with setups, one of a group that is there.

Measured, one core, with one exchange pass: 400 of 5000 candidates of one row and 36 parameters take 0.4 s (D, A), 0.5 s (E) or 1.8 s (I).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from truearm.errors import PlanError
from truearm.plan.criteria import Criterion
from truearm.progress import steps_of
from truearm.types import Floats

GAIN = 1e-9  # of the criterion, relative: a swap that brings less is rounding


def choose(
    rows: Floats,
    known: Floats,
    n: int,
    criterion: str = "D",
    region: Floats | None = None,
    passes: int = 1,
    group: NDArray[np.intp] | None = None,
    setup: float = 0.0,
) -> NDArray[np.intp]:
    """The best ``n`` of N candidates in the order of their choice.

    rows (N, w, k): whitened rows, columns in units of the prior; known (k, k): information of the prior and of what was
    measured already, in the same units. ``region`` (r, k): L of I-optimality, transposed. ``passes``: exchanges at most.
    ``group`` (N,): what needs a setup of its own, ``setup`` times as dear as a candidate.
    Raises PlanError for an unknown criterion, I without a region, and more candidates wanted than there are.
    """
    wanted = _checked(rows, n, criterion, region)
    information, chosen = known.copy(), list[int]()
    left = np.ones(len(rows), dtype=bool)
    group = np.zeros(len(rows), dtype=np.intp) if group is None else group
    here = np.zeros(len(rows), dtype=bool)  # of a group that was begun
    for _ in steps_of(range(n), f"choosing {n} of {len(rows)} poses"):
        worth = np.where(here, 1.0, 1.0 / (1.0 + setup)) * left
        best = _best(rows, information, worth, wanted, region)
        information += rows[best].T @ rows[best]
        chosen.append(best)
        left[best] = False
        here |= group == group[best]
    if setup > 0.0:
        left &= here
    for _ in range(passes):
        if not _exchange(rows, information, chosen, left, wanted, region):
            break
    return np.array(chosen, dtype=np.intp)


def value(information: Floats, criterion: Criterion, region: Floats | None = None) -> float:
    """What the criterion makes smaller: −log det M, tr P, the largest eigenvalue of P, or tr(LᵀPL)."""
    match criterion:
        case Criterion.D:
            return -float(np.linalg.slogdet(information)[1])
        case Criterion.E:
            return float(np.linalg.eigvalsh(_inverse(information))[-1])
        case Criterion.A:
            return float(np.trace(_inverse(information)))
        case Criterion.I:
            covariance = _inverse(information)
            return float(np.trace(covariance if region is None else region @ covariance @ region.T))
        case _:
            assert_never(criterion)


def _exchange(
    rows: Floats,
    information: Floats,
    chosen: list[int],
    left: NDArray[np.bool_],
    criterion: Criterion,
    region: Floats | None,
) -> bool:
    """One pass over all chosen; whether any was exchanged. ``information``, ``chosen`` and ``left`` follow."""
    changed = False
    now = value(information, criterion, region)
    for place, old in steps_of(list(enumerate(chosen)), "exchanging chosen poses for better ones"):
        without = information - rows[old].T @ rows[old]
        left[old] = True
        best = _best(rows, without, left.astype(float), criterion, region)
        after = without + rows[best].T @ rows[best]
        then = value(after, criterion, region) if best != old else now
        if then < now - GAIN * abs(now):
            information[:], now, chosen[place], changed = after, then, best, True
        left[chosen[place]] = False
    return changed


def _best(rows: Floats, information: Floats, worth: Floats, criterion: Criterion, region: Floats | None) -> int:
    """The candidate that brings most, times what it is ``worth`` (N,), 0 for none."""
    covariance = _inverse(information)
    gain = (_gain_of_single_rows if rows.shape[1] == 1 else _gain)(rows, covariance, criterion, region)
    return int(np.argmax(np.where(worth > 0.0, gain * worth, -np.inf)))


def _gain_of_single_rows(rows: Floats, covariance: Floats, criterion: Criterion, region: Floats | None) -> Floats:
    """``_gain`` where w is 1: S is a number, and a division does what a solution of N systems of one equation would."""
    single = rows[:, 0]
    through = single @ covariance  # (N, k)
    total = np.einsum("nk,nk->n", through, single) + 1.0
    if criterion is Criterion.D:
        return np.asarray(np.log(total))
    toward = through if criterion is Criterion.A else through @ _directions(covariance, criterion, region)
    return np.asarray(np.einsum("nk,nk->n", toward, toward) / total)


def _gain(rows: Floats, covariance: Floats, criterion: Criterion, region: Floats | None) -> Floats:
    """(N,) by how much a candidate makes the criterion smaller."""
    through = rows @ covariance  # (N, w, k)
    total = np.einsum("nwk,nvk->nwv", through, rows) + np.eye(rows.shape[1])
    if criterion is Criterion.D:
        return np.asarray(np.linalg.slogdet(total)[1])
    toward = through @ _directions(covariance, criterion, region)
    return np.asarray(np.sum(toward * np.linalg.solve(total, toward), axis=(1, 2)))


def _directions(covariance: Floats, criterion: Criterion, region: Floats | None) -> Floats:
    """L (k, ·)."""
    match criterion:
        case Criterion.I if region is not None:
            return np.asarray(region.T)
        case Criterion.E:
            return np.asarray(np.linalg.eigh(covariance)[1][:, -1:])
        case Criterion.I | Criterion.A | Criterion.D:
            return np.eye(len(covariance))
        case _:
            assert_never(criterion)


def _inverse(information: Floats) -> Floats:
    inverse = np.linalg.inv(information)
    return np.asarray(0.5 * (inverse + inverse.T))


def _checked(rows: Floats, n: int, criterion: str, region: Floats | None) -> Criterion:
    if criterion not in tuple(Criterion):
        raise PlanError(f"criterion {criterion!r} is not known; use {', '.join(Criterion)}")
    if criterion == Criterion.I and region is None:
        raise PlanError("an I-optimal choice needs the region in which the error should be small")
    if not 1 <= n <= len(rows):
        raise PlanError(f"{n} of {len(rows)} candidates cannot be chosen; ask for fewer poses or more candidates")
    return Criterion(criterion)


def condensed(jacobian: Floats, own: Floats | None = None) -> Floats:
    """Rows (at most k, k) with the information of jacobian (m, k), after unknowns of their ``own`` (m, u) are fitted."""
    if own is not None:
        basis, singular, _ = np.linalg.svd(own, full_matrices=False)
        basis = basis[:, singular > 1e-10 * singular.max(initial=0.0)]
        jacobian = jacobian - basis @ (basis.T @ jacobian)
    return np.asarray(np.linalg.qr(jacobian, mode="r")) if len(jacobian) > jacobian.shape[1] else jacobian


def as_blocks(parts: Sequence[Floats]) -> Floats:
    """(N, w, k) of parts with different numbers of rows, filled up with zeros, which say nothing."""
    width = max(len(part) for part in parts)
    out = np.zeros((len(parts), width, parts[0].shape[1]))
    for i, part in enumerate(parts):
        out[i, : len(part)] = part
    return out
