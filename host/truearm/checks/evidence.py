"""The evidence of hypotheses in whitened residuals, and the probability that chance gives as much.

With Q an orthonormal basis of what the fit can follow (its parameters, what is known of the rig, and findings), a
candidate with the columns C (m, d) has

    M = Cᵀ(I − QQᵀ)C ,   b = Cᵀr ,   r = (I − QQᵀ)e ,

and β ~ N(0, s²I) in units of the typical size. All of it follows from the eigenvalues λ and vectors V of M and y = Vᵀb.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special

from truearm.checks.catalogue import Hypothesis
from truearm.checks.whitened import Kernel, WhitenedFit
from truearm.estimate.information import RANK_TOLERANCE
from truearm.estimate.ties import first_within
from truearm.types import Floats, Indices

SCALES = np.array([0.2, 1.0, 5.0])  # of the typical size, equally probable
SHOWN = 3.0  # standard deviations
SEEN = 1e-8  # share of a column's square that must remain after the parameters
LEAST_CHANCE = 1e-300  # probability whose logarithm matters
WIDEST = 30.0  # of the typical size: the prior of a finding, which the rows have shown already


@dataclass(frozen=True)
class Design:
    """What a fit can follow: rows of residuals, then those of priors, divided by the noise."""

    fit: WhitenedFit
    kernel: Kernel
    basis: Floats  # (m + κ, r + f) Q, of the parameters and then of further columns
    follow: Floats  # (m, r) the dual of Q of the parameters
    root: Floats  # (k, ·) S with Q = jac S for the parameters alone, so that S Sᵀ is their covariance
    remainder: Floats  # (m + κ,) (I − QQᵀ) residual
    freedom: float  # residuals minus what they determine

    @property
    def chi2(self) -> float:
        return float(self.remainder @ self.remainder)

    @property
    def variance(self) -> float:
        """Return the variance of the noise: 1 as declared, otherwise that of the rest."""
        return 1.0 if self.kernel.declared else max(self.chi2 / max(self.freedom, 1.0), 1e-12)

    @cached_property
    def further(self) -> Floats:
        """Return the dual (m, f + 1) of Q of the further columns, and of the remainder."""
        further = self.basis[: len(self.follow), self.follow.shape[1] :]
        return self.kernel.dual(np.column_stack([further, self.remainder[: len(self.follow)]]))

    def without(self, columns: Floats) -> Floats:
        """Return columns (m, d) divided by the noise, (m + κ, d), without what the design follows."""
        out = np.zeros((len(self.basis), columns.shape[1]))
        out[: len(columns)] = self.kernel.whiten(columns)
        return np.asarray(out - self.basis @ (self.basis.T @ out))

    def extended(self, columns: Floats) -> Design:
        """Return the design with further ``columns`` (m, f), about a wide prior."""
        f = columns.shape[1]
        if not f:
            return self
        outside = np.concatenate([self.without(columns), np.eye(f) / WIDEST])
        outside /= np.linalg.norm(outside, axis=0)
        padded = np.concatenate([self.basis, np.zeros((f, self.basis.shape[1]))])
        outside -= padded @ (padded.T @ outside)  # again, for the last digits
        u, singular, _ = np.linalg.svd(outside, full_matrices=False)
        added = u[:, singular > RANK_TOLERANCE]
        remainder = np.concatenate([self.remainder, np.zeros(f)])
        return replace(
            self,
            basis=np.concatenate([padded, added], axis=1),
            remainder=remainder - added @ (added.T @ remainder),
            freedom=self.freedom - float((added[: self.fit.residual.size] ** 2).sum()),
        )


def build_design(fit: WhitenedFit, kernel: Kernel, prior: Floats) -> Design:
    """Return what the parameters of a fit can follow about a ``prior`` (κ, k + 1), one of the two of the fit."""
    m = fit.residual.size
    rows = np.concatenate([kernel.whiten(np.column_stack([fit.jac, fit.residual])), prior])
    jac, residual = rows[:, :-1], rows[:, -1]
    scale = np.linalg.norm(jac, axis=0)
    scale = np.maximum(scale, RANK_TOLERANCE * scale.max(initial=1e-300))  # a parameter may move nothing
    u, singular, vt = np.linalg.svd(jac / scale, full_matrices=False)
    significant = singular > RANK_TOLERANCE * singular.max(initial=0.0)
    basis, root = u[:, significant], vt[significant].T / singular[significant] / scale[:, None]
    remainder, freedom = residual - basis @ (basis.T @ residual), m - float((basis[:m] ** 2).sum())
    return Design(fit, kernel, basis, kernel.dual(basis[:m]), root, remainder, freedom)


class Moments(NamedTuple):
    """M and b of c candidates along the eigenvectors of M: λ (c, d), V (c, d, d), y (c, d); 0 where λ is insignificant.

    Of several hypotheses with the same candidates, h of each.
    """

    values: Floats
    vectors: Floats
    scores: Floats


class Weighed(NamedTuple):
    """A hypothesis with the evidence of its c candidates.

    ``log_evidence`` is averaged over scales and candidates, ``best`` the most probable candidate, ``log_chance`` the
    logarithm of the probability that noise gives such a ``drop`` of χ² with ``freedom`` degrees for any candidate.
    """

    hypothesis: Hypothesis
    moments: Moments
    by_scale: Floats  # (scales, c)
    best: int
    log_evidence: float
    drop: float
    freedom: int
    log_chance: float

    @property
    def name(self) -> str:
        return self.hypothesis.name

    @property
    def columns(self) -> Floats:
        """Return the columns (m, d) of the best candidate."""
        return self.hypothesis.candidate(self.best)


class BesideParameters(NamedTuple):
    """CᵀC of the c candidates of h hypotheses, and of their nuisance, beside what the parameters follow."""

    square: Floats  # (h, c, d + f, d + f)
    size: Floats  # (h, c, 1) trace of CᵀC over the d columns of the candidate, nothing taken off


def beside_parameters(hypotheses: Sequence[Hypothesis], design: Design) -> BesideParameters:
    """Return what hypotheses that are ``alike`` are beside the parameters, whatever the findings."""
    square, d = squares(hypotheses, design.kernel), hypotheses[0].sizes.size
    size = np.trace(square[..., :d, :d], axis1=2, axis2=3)[..., None]
    return BesideParameters(square - followed(hypotheses, products(hypotheses, design.follow)), size)


def followed(hypotheses: Sequence[Hypothesis], cross: Floats) -> Floats:
    """Return the products (h, c, d, d) of the candidates with what follows them, from the profiles' (h, p, d, x)."""
    h, p, d, x = cross.shape
    flat = cross.reshape(h, p * d, x)
    return hypotheses[0].candidates.of_squares((flat @ flat.swapaxes(1, 2)).reshape(h, p, d, p, d))


def moments(hypotheses: Sequence[Hypothesis], design: Design, prepared: BesideParameters | None = None) -> Moments:
    """Return M and b of all candidates beside a design and the hypotheses' nuisance."""
    square, size = beside_parameters(hypotheses, design) if prepared is None else prepared
    cross, d = products(hypotheses, design.further), hypotheses[0].sizes.size
    square = square - followed(hypotheses, cross[..., :-1])
    score = hypotheses[0].candidates.of_profiles(cross[..., -1])[..., None]
    nuisance = square[..., d:, d:] + np.eye(square.shape[-1] - d) / WIDEST**2
    follow = np.linalg.solve(nuisance, square[..., d:, :d]).swapaxes(2, 3)
    square = square[..., :d, :d] - follow @ square[..., d:, :d]
    score = score[..., :d, :] - follow @ score[..., d:, :]
    values, vectors = np.linalg.eigh(square)
    significant = values > np.maximum(SEEN * size, WIDEST**-2)
    return Moments(values * significant, vectors, (vectors.swapaxes(2, 3) @ score)[..., 0] * significant)


def products(hypotheses: Sequence[Hypothesis], vectors: Floats) -> Floats:
    """Return Cᵀ times ``vectors`` (m, x) for each profile of each hypothesis, (h, p, d, x)."""
    first, columns = hypotheses[0], np.concatenate([hypothesis.columns for hypothesis in hypotheses], axis=1)
    by_profile = first.candidates.products(columns, first.fit.row, vectors)
    return by_profile.reshape(len(by_profile), len(hypotheses), -1, vectors.shape[1]).swapaxes(0, 1)


def squares(hypotheses: Sequence[Hypothesis], kernel: Kernel) -> Floats:
    """Return CᵀV⁻¹C (h, c, d + f, d + f) of the candidates and their nuisance."""
    first, h = hypotheses[0], len(hypotheses)
    columns = np.concatenate([hypothesis.columns for hypothesis in hypotheses], axis=1) / kernel.scale
    candidates, row, width = first.candidates, first.fit.row, first.columns.shape[1]
    if not kernel.shared:
        by_profile = candidates.products(columns, row, columns, power=2).reshape(-1, h, width, h, width)
        return candidates.of_profiles(np.einsum("phdhe->hpde", by_profile))
    gram: Floats | float = 0.0
    for residuals, precision in kernel.precisions:
        for index in residuals.T:
            half = candidates.products(columns[index], row[index], precision)
            by_row = half.reshape(-1, len(index)).T
            p = len(half)
            crossed = candidates.products(columns[index], row[index], by_row).reshape(p, h, width, p, h, width)
            gram = gram + np.einsum("phdqhe->hpdqe", crossed)
    return candidates.of_squares(np.asarray(gram))


def weigh(hypotheses: Sequence[Hypothesis], design: Design, prepared: BesideParameters | None = None) -> list[Weighed]:
    """Return the evidence of hypotheses that are ``alike``, and the probability of chance."""
    sums = moments(hypotheses, design, prepared)
    eigenvalues, scores, significant = sums.values, sums.scores, sums.values > 0.0
    variance, square = design.variance, SCALES[:, None, None, None] ** 2
    gain = square * scores**2 / variance / (variance + square * eigenvalues)
    by_scale = 0.5 * gain.sum(axis=3) - 0.5 * np.log1p(square * eigenvalues / variance).sum(axis=3)
    drop = (scores**2 / np.where(significant, eigenvalues, 1.0)).sum(axis=2)
    freedom = significant.sum(axis=2)
    chance = log_chance(drop, freedom, design).min(axis=1)
    by_candidate, weighed = np.logaddexp.reduce(by_scale, axis=0), []
    count = hypotheses[0].candidates.number * SCALES.size
    for k, hypothesis in enumerate(hypotheses):
        best = first_within(by_candidate[k])
        log_evidence = float(np.logaddexp.reduce(by_candidate[k])) - math.log(count)
        log_chance_of_any = min(float(chance[k]) + math.log(drop.shape[1]), 0.0)
        strength = float(drop[k, best]), int(freedom[k, best]), log_chance_of_any
        own = Moments(*(array[k] for array in sums))
        weighed.append(Weighed(hypothesis, own, by_scale[:, k], best, log_evidence, *strength))
    return weighed


def log_chance(drop: Floats, freedom: Indices, design: Design) -> Floats:
    """Return the log probability that noise gives such drops (c,) of χ²; 0 without a degree of freedom."""
    d = np.maximum(freedom, 1).astype(float)
    if design.kernel.declared:
        log_p = np.log(np.maximum(special.chdtrc(d, drop), LEAST_CHANCE))
    else:
        # F(d, ν − d) of drop/d over the remaining variance; its tail is an incomplete beta function of remaining χ².
        a = np.maximum(design.freedom - d, 0.5) / 2.0
        log_p = log_beta(a, d / 2.0, 1.0 - drop / design.chi2)
    return np.where(freedom == 0, 0.0, log_p)


def log_beta(a: Floats, b: Floats, x: Floats) -> Floats:
    """Return the logarithm of the regularised incomplete beta function, at least that of LEAST_CHANCE."""
    p = special.betainc(a, b, np.maximum(x, 0.0))  # rounding can make a drop exceed χ²
    return np.asarray(np.log(np.maximum(p, LEAST_CHANCE)))


def amount_of(
    weighed: Weighed, variance: float, scale: float = SCALES[-1], is_named: bool = True
) -> tuple[Floats, Floats, Floats]:
    """Return by how much the best candidate is off with the prior of a scale, its uncertainty, and what is hidden.

    That is β (d,) in typical sizes, a root (d, r) of its covariance, and a basis (d, d − r) of hidden directions, where
    β is 0. Hidden are those of which the rows say less than the typical size does, unless the hypothesis ``is_named``
    and they are SHOWN.
    """
    values, vectors, scores = (array[weighed.best] for array in weighed.moments)
    eigenvalues, scores = values / variance, scores / variance
    stated = (eigenvalues > 1.0) | (is_named & (scores**2 > SHOWN**2 * eigenvalues))
    root = vectors[:, stated] / np.sqrt(eigenvalues[stated] + scale**-2.0)
    return root @ (root.T @ (vectors @ scores)), root, vectors[:, ~stated]
