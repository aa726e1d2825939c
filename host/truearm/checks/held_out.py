"""What a finding gives in rows that were not used to estimate it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from truearm.checks.evidence import WIDEST
from truearm.checks.whitened import WhitenedFit
from truearm.types import Floats, Indices

BLOCKS = 12  # contiguous stretches of the order of measurement
FEWEST_PLACES = 3


class Gain(NamedTuple):
    """The share of the squares of left-out rows that a finding removes, and its size in standard errors over the blocks."""

    share: float
    t: float


UNKNOWN = Gain(math.nan, math.nan)


def left_out_blocks(n: int, places: Indices | None) -> Indices:
    """Return the block (n,) of each row: its place, or one of BLOCKS stretches."""
    if places is not None and np.unique(places).size >= FEWEST_PLACES:
        return places
    return np.arange(n) * BLOCKS // n


def gain_of(fit: WhitenedFit, neighbours: Floats, columns: Floats, blocks: Indices) -> Gain:
    """Return the gain of a finding's columns (m, d) beside those of others (m, d').

    Each block is predicted by a fit to all other rows: x = (H − H_b)⁻¹(g − g_b), with H and g of all rows and knowledge.
    """
    block = blocks[fit.row]
    squares = []
    for added in (neighbours, np.concatenate([neighbours, columns], axis=1)):
        jac = np.concatenate([fit.jac, added], axis=1)
        prior = np.zeros((len(fit.knowledge_jac) + len(fit.prior_jac) + added.shape[1], jac.shape[1]))
        knowledge = np.concatenate([fit.knowledge_jac, fit.prior_jac])
        prior[: len(knowledge), : knowledge.shape[1]] = knowledge
        prior[len(knowledge) :, knowledge.shape[1] :] = np.eye(added.shape[1]) / WIDEST
        scale = np.maximum(np.linalg.norm(np.concatenate([jac, prior]), axis=0), 1e-300)
        jac, prior = jac / scale, prior / scale
        targets = np.concatenate([fit.knowledge_residual, fit.prior_residual, np.zeros(added.shape[1])])
        information, score = jac.T @ jac + prior.T @ prior, jac.T @ fit.residual + prior.T @ targets
        each = []
        for number in np.unique(block):
            rows = block == number
            reduced = information - jac[rows].T @ jac[rows] + 1e-12 * np.eye(len(score))
            x = np.linalg.solve(reduced, score - jac[rows].T @ fit.residual[rows])
            each.append(float(((fit.residual[rows] - jac[rows] @ x) ** 2).sum()))
        squares.append(np.array(each))
    less = squares[0] - squares[1]
    error = float(less.std(ddof=1)) / math.sqrt(less.size) if less.size > 1 else math.inf
    return Gain(float(less.sum() / squares[0].sum()), float(less.mean() / max(error, 1e-12)))
