"""What a finding gives in rows that were not used to estimate it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from truearm.checks.evidence import Design
from truearm.types import Floats, Indices

BLOCKS = 12  # contiguous stretches of the order of measurement
FEWEST_BLOCKS = 3
LEAST = 1e-9  # share of a direction that other rows determine: less is rounding


class Gain(NamedTuple):
    """The share of the squares of left-out rows that a finding removes, and its size in standard errors over the blocks.

    NaN with fewer than FEWEST_BLOCKS: one place says nothing about others.
    """

    share: float
    t: float


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
    squares, less = _by_block(before, after, block)
    if less.size < FEWEST_BLOCKS:
        return Gain(math.nan, math.nan)
    error = float(less.std(ddof=1)) / math.sqrt(less.size)
    return Gain(float(less.sum() / squares.sum()), float(less.mean() / max(error, 1e-12)))


def chance(before: Floats, after: Floats, block: Indices) -> float:
    """Return the probability that chance gives such a gain: the smaller one of two tests over the blocks, doubled.

    Student's t suits gains of equal size. A step in few rows gives their blocks far more than all others, which
    Wilcoxon's signed ranks do not mind. NaN with fewer than FEWEST_BLOCKS.
    """
    _, less = _by_block(before, after, block)
    if less.size < FEWEST_BLOCKS:
        return math.nan
    by_t = special.stdtr(less.size - 1, -gain(before, after, block).t)
    return float(2.0 * min(by_t, stats.wilcoxon(less, alternative="greater", method="exact").pvalue))


def _by_block(before: Floats, after: Floats, block: Indices) -> tuple[Floats, Floats]:
    """Return the sum of squares before of each block, and by how much it is less after."""
    numbers = np.unique(block)
    squares, later = (np.bincount(block, residual**2)[numbers].astype(float) for residual in (before, after))
    return squares, squares - later
