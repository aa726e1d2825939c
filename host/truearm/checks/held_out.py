"""What a finding gives in rows that were not used to estimate it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import special

from truearm.checks.evidence import Design
from truearm.types import Floats, Indices

BLOCKS = 12  # contiguous stretches of the order of measurement
FEWEST_BLOCKS = 3
LEAST = 1e-9  # share of a direction that other rows determine: less is rounding


class Gain(NamedTuple):
    """What a finding gives in rows that were left out; NaN with fewer than FEWEST_BLOCKS, since one place says nothing.

    ``chance`` gives as much with a probability of the smaller one of two tests over the blocks, doubled. Student's t suits
    gains of equal size. A step in few rows gives their blocks far more than all others, which Wilcoxon's signed ranks do
    not mind.
    """

    share: float  # of the squares of left-out rows that it removes
    t: float  # in standard errors over the blocks
    chance: float


def left_out_blocks(n: int, places: Indices | None) -> Indices:
    """Return the block (n,) of each row: its place, or one of BLOCKS stretches if the rows have none."""
    return np.arange(n) * BLOCKS // n if places is None else places


def left_out(design: Design, block: Indices) -> Floats:
    """Return the residuals (m,) of each ``block`` (m,) in a fit to all other rows.

    They are (I − QQᵀ)⁻¹ times those of the fit to all rows, with Q the rows of the block. Directions in which the
    inverse does not exist, which only these rows determine, such as the sockets of a place, are fitted to them.
    """
    out = np.empty(block.size)
    for number in np.unique(block):
        inside = np.flatnonzero(block == number)
        values, u = np.linalg.eigh(design.basis[inside] @ design.basis[inside].T)
        share = 1.0 - values
        factor = np.where(share > LEAST, 1.0 / np.maximum(share, LEAST), 0.0)
        residual = design.remainder[inside]
        out[inside] = residual + u @ ((factor - 1.0) * (u.T @ residual))
    return out


def gain(before: Floats, after: Floats, block: Indices) -> Gain:
    """Return the gain of the residuals (m,) of left-out blocks after something was added to the fit."""
    numbers = np.unique(block)
    squares, later = (np.bincount(block, residual**2)[numbers] for residual in (before, after))
    less = np.asarray(squares - later, dtype=float)
    if less.size < FEWEST_BLOCKS:
        return Gain(math.nan, math.nan, math.nan)
    t = float(less.mean() / max(less.std(ddof=1) / math.sqrt(less.size), 1e-12))
    chance = min(special.stdtr(less.size - 1, -t), chance_of_ranks(less))
    return Gain(float(less.sum() / squares.sum()), t, float(2.0 * chance))


def chance_of_ranks(less: Floats) -> float:
    """Return the probability that Wilcoxon's sum of the ranks of positive differences (n,) is so large without a gain.

    It is exact where no differences are equal: each rank counts with probability ½. ``scipy.stats.wilcoxon`` gives the
    same, but takes 0.3 s to import.
    """
    order = np.argsort(np.abs(less), kind="stable")
    probability = np.ones(1)  # of each sum
    for rank in range(1, less.size + 1):
        probability = 0.5 * (np.pad(probability, (0, rank)) + np.pad(probability, (rank, 0)))
    ranks = 1 + np.flatnonzero(less[order] > 0.0)
    return float(probability[ranks.sum() :].sum())
