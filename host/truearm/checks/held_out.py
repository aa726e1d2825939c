"""What a finding gives in rows that were not used to estimate it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import linalg

from truearm.checks.evidence import WIDEST
from truearm.checks.whitened import WhitenedFit
from truearm.types import Floats, Indices

BLOCKS = 12  # contiguous stretches of the order of measurement
FEWEST_PLACES = 3
JITTER = 1e-12  # of the square of a column


class Gain(NamedTuple):
    """The share of the squares of left-out rows that a finding removes, and its size in standard errors over the blocks."""

    share: float
    t: float


def left_out_blocks(n: int, places: Indices | None) -> Indices:
    """Return the block (n,) of each row: its place, or one of BLOCKS stretches."""
    if places is not None and np.unique(places).size >= FEWEST_PLACES:
        return places
    return np.arange(n) * BLOCKS // n


class LeftOut:
    """Predictions of each block of rows by a fit to all others, with the columns (m, d) of findings as parameters.

    x = (H − H_b)⁻¹(g − g_b), with H and g of all rows and knowledge. Further columns enter by their Schur complement.
    What only the rows of a block determine, such as the sockets of a place, is fitted to these.
    """

    def __init__(self, fit: WhitenedFit, findings: Floats, blocks: Indices) -> None:
        d, k = findings.shape[1], fit.jac.shape[1]
        knowledge = np.concatenate([fit.knowledge_jac, fit.prior_jac])
        prior = np.zeros((len(knowledge) + d, k + d))
        prior[: len(knowledge), :k], prior[len(knowledge) :, k:] = knowledge, np.eye(d) / WIDEST
        jac = np.concatenate([fit.jac, findings], axis=1)
        scale = np.maximum(np.linalg.norm(np.concatenate([jac, prior]), axis=0), 1e-300)
        self.jac, prior, self.target = jac / scale, prior / scale, fit.residual
        targets = np.concatenate([fit.knowledge_residual, fit.prior_residual, np.zeros(d)])
        information, self.score = self.jac.T @ self.jac + prior.T @ prior, self.jac.T @ self.target + prior.T @ targets
        block = blocks[fit.row]
        self.rows = [np.flatnonzero(block == number) for number in np.unique(block)]
        jitter = JITTER * np.eye(k + d)
        self.factors = [
            linalg.cho_factor(information - self.jac[inside].T @ self.jac[inside] + jitter) for inside in self.rows
        ]
        self.own = [self._own_columns(inside, prior) for inside in self.rows]
        self.residual = np.empty_like(self.target)
        for inside, factor, local in zip(self.rows, self.factors, self.own, strict=True):
            score = self.score - self.jac[inside].T @ self.target[inside]
            predicted = self.jac[inside] @ linalg.cho_solve(factor, score)
            self.residual[inside] = without(local, self.target[inside] - predicted)

    def _own_columns(self, inside: Indices, prior: Floats) -> Floats:
        """Return an orthonormal basis of what only a block's rows ``of`` determine."""
        elsewhere = np.ones(len(self.jac), dtype=bool)
        elsewhere[inside] = False
        alone = ~(self.jac[elsewhere].any(axis=0) | prior.any(axis=0))
        return np.linalg.qr(self.jac[inside][:, alone])[0]

    def residual_with(self, columns: Floats) -> Floats:
        """Return the residuals (m,) of all blocks with columns (m, d) as further parameters."""
        out = np.empty_like(self.residual)
        cross, square, score = self.jac.T @ columns, columns.T @ columns, columns.T @ self.target
        for inside, factor, local in zip(self.rows, self.factors, self.own, strict=True):
            mine = columns[inside]
            others = cross - self.jac[inside].T @ mine
            solved = linalg.cho_solve(
                factor, np.column_stack([others, self.score - self.jac[inside].T @ self.target[inside]])
            )
            reduced = square - mine.T @ mine + np.eye(len(square)) / WIDEST**2 - others.T @ solved[:, :-1]
            size = np.linalg.solve(reduced, score - mine.T @ self.target[inside] - others.T @ solved[:, -1])
            out[inside] = self.residual[inside] - without(local, (mine - self.jac[inside] @ solved[:, :-1]) @ size)
        return out

    def gain(self, residual: Floats) -> Gain:
        """Return the gain of residuals (m,) over those without further columns."""
        before, after = (
            np.array([float(r[inside] @ r[inside]) for inside in self.rows]) for r in (self.residual, residual)
        )
        less = before - after
        error = float(less.std(ddof=1)) / math.sqrt(less.size) if less.size > 1 else math.inf
        return Gain(float(less.sum() / before.sum()), float(less.mean() / max(error, 1e-12)))


def without(basis: Floats, values: Floats) -> Floats:
    """Return values (n,) without their part along an orthonormal basis (n, r)."""
    return np.asarray(values - basis @ (basis.T @ values))
