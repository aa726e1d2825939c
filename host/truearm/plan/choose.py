"""The choice of candidates to measure: greedy optimal design with exchange refinement.

Let J_i (w, k) be the whitened rows of a candidate and M the information of what is known and chosen, in units of each
parameter's prior σ (so that the prior alone is M = I and metres are comparable with radians). With P = M⁻¹ and S = I +
J_i P J_iᵀ, one more candidate changes

- log det M by log det S: the criterion of D-optimality (the volume of the confidence ellipsoid);
- tr(LᵀPL) by −‖S^(−1/2) J_i P L‖²: A-optimality with L = I (the mean variance of the parameters), I-optimality with L
  Lᵀ = the mean of J_rᵀJ_r over the user's region (the mean variance of a point's position there), and E-optimality with
  L the eigenvector of the largest eigenvalue of P (the worst direction), recomputed at each step.

Each step takes the best candidate and adds its block J_iᵀJ_i to M. The order is nested: its first n candidates are the
choice of n, so a time budget only determines where to stop. If time counts, the gain of a candidate that requires
mounting the bar is counted per second: ``setup`` is the extra cost of the first candidate of a group relative to a
further one. The exchange (Fedorov 1972) then removes each chosen candidate in turn and replaces it by the best one, as
long as this helps; with setups, by one of a group already in use.

Measured on one core with one exchange pass: choosing 400 of 5000 candidates with one row and 36 parameters takes 0.4 s
(D, A), 0.5 s (E) or 1.8 s (I).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from truearm.errors import PlanError
from truearm.plan.criteria import Criterion
from truearm.progress import steps_of
from truearm.text import counted
from truearm.types import Floats

GAIN = 1e-9  # of the criterion, relative: a swap with a smaller gain is rounding


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
    """Return the best ``n`` of N candidates in the order of their choice.

    rows (N, w, k): whitened rows, columns in units of the prior; known (k, k): information of the prior and of existing
    measurements, in the same units. ``region`` (r, k): L of I-optimality, transposed. ``passes``: maximum number of
    exchange passes. ``group`` (N,): groups that each need a setup; its extra cost is ``setup`` times that of a
    candidate. Raises PlanError for an unknown criterion, I without a region, and more candidates wanted than there are.
    """
    wanted = _checked(rows, n, criterion, region)
    information, chosen = known.copy(), list[int]()
    left = np.ones(len(rows), dtype=bool)
    group = np.zeros(len(rows), dtype=np.intp) if group is None else group
    here = np.zeros(len(rows), dtype=bool)  # of a group already begun
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
    """Return the quantity that the criterion minimises: −log det M, tr P, the largest eigenvalue of P, or tr(LᵀPL)."""
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
    """Try once to exchange each chosen one; return whether any was. Updates ``information``, ``chosen``, ``left``."""
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
    """Return the candidate with the largest gain times its ``worth`` (N,); 0 excludes a candidate."""
    covariance = _inverse(information)
    gain = (_gain_of_single_rows if rows.shape[1] == 1 else _gain)(rows, covariance, criterion, region)
    return int(np.argmax(np.where(worth > 0.0, gain * worth, -np.inf)))


def _gain_of_single_rows(rows: Floats, covariance: Floats, criterion: Criterion, region: Floats | None) -> Floats:
    """Return ``_gain`` for w = 1: S is a number, so a division replaces solving N systems of one equation."""
    single = rows[:, 0]
    through = single @ covariance  # (N, k)
    total = np.einsum("nk,nk->n", through, single) + 1.0
    if criterion is Criterion.D:
        return np.asarray(np.log(total))
    toward = through if criterion is Criterion.A else through @ _directions(covariance, criterion, region)
    return np.asarray(np.einsum("nk,nk->n", toward, toward) / total)


def _gain(rows: Floats, covariance: Floats, criterion: Criterion, region: Floats | None) -> Floats:
    """Return by how much each candidate reduces the criterion (N,)."""
    through = rows @ covariance  # (N, w, k)
    total = np.einsum("nwk,nvk->nwv", through, rows) + np.eye(rows.shape[1])
    if criterion is Criterion.D:
        return np.asarray(np.linalg.slogdet(total)[1])
    toward = through @ _directions(covariance, criterion, region)
    return np.asarray(np.sum(toward * np.linalg.solve(total, toward), axis=(1, 2)))


def _directions(covariance: Floats, criterion: Criterion, region: Floats | None) -> Floats:
    """Return L (k, ·)."""
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
        raise PlanError("wrong-value", place="criterion", value=criterion, names=list(Criterion))
    if criterion == Criterion.I and region is None:
        raise PlanError(
            "criterion I needs the argument region: the rows of the region in which the error should be small"
        )
    if not 1 <= n <= len(rows):
        raise PlanError(
            f"only {counted(len(rows), 'candidate')} to choose {n} from; ask for fewer poses or more candidates"
        )
    return Criterion(criterion)


def condensed(jacobian: Floats, own: Floats | None = None) -> Floats:
    """Return rows (at most k, k) with the information of jacobian (m, k) after fitting their ``own`` (m, u)."""
    if own is not None:
        basis, singular, _ = np.linalg.svd(own, full_matrices=False)
        basis = basis[:, singular > 1e-10 * singular.max(initial=0.0)]
        jacobian = jacobian - basis @ (basis.T @ jacobian)
    return np.asarray(np.linalg.qr(jacobian, mode="r")) if len(jacobian) > jacobian.shape[1] else jacobian


def as_blocks(parts: Sequence[Floats]) -> Floats:
    """Return (N, w, k) from parts with different numbers of rows, padded with zeros, which carry no information."""
    width = max(len(part) for part in parts)
    out = np.zeros((len(parts), width, parts[0].shape[1]))
    for i, part in enumerate(parts):
        out[i, : len(part)] = part
    return out
