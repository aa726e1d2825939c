"""The evidence of hypotheses in whitened residuals, and the probability that chance gives as much.

With Q an orthonormal basis of what the fit can follow (its parameters, what is known of the rig, and findings), a
candidate with the columns C (m, d) has

    M = Cᵀ(I − QQᵀ)C ,   b = Cᵀr ,   r = (I − QQᵀ)e ,

and β ~ N(0, s²I) in units of the typical size. All of it follows from the eigenvalues λ and vectors V of M and y = Vᵀb.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special

from truearm.checks.catalogue import Hypothesis, Profiles
from truearm.checks.noise import Kernel
from truearm.checks.whitened import WhitenedFit
from truearm.estimate.information import RANK_TOLERANCE
from truearm.estimate.ties import first_within
from truearm.types import Floats, Indices, Mask

SCALES = np.array([0.2, 1.0, 5.0])  # of the typical size, equally probable
SHOWN = 3.0  # standard deviations
SEEN = 1e-8  # share of a column's square that must remain after the parameters
WIDEST = 30.0  # of the typical size: the prior of a finding, which the rows have shown already


class Sums(NamedTuple):
    """M (c, d, d) and b (c, d) of c candidates beside the parameters, and tr CᵀC (c,)."""

    square: Floats
    score: Floats
    size: Floats


@dataclass(frozen=True)
class Design:
    """What a fit can follow: rows of residuals, then those of knowledge and of the findings' prior, divided by the noise."""

    fit: WhitenedFit
    kernel: Kernel
    jac: Floats  # (m + κ, k) by the parameters
    residual: Floats  # (m + κ,)
    basis: Floats  # (m + κ + f, r) Q, of the parameters and then of the f columns of findings
    root: Floats  # (k, ·) S with Q = jac S for the parameters alone, so that S Sᵀ is their covariance
    remainder: Floats  # (m + κ + f,) (I − QQᵀ) residual
    freedom: float  # residuals minus what they determine
    bare: Design | None = None  # without findings; None: this is it
    sums: dict[Hypothesis, Sums] = field(default_factory=dict)  # of hypotheses beside the parameters

    @property
    def chi2(self) -> float:
        return float(self.remainder @ self.remainder)

    @property
    def variance(self) -> float:
        """Return the variance of the noise: 1 as declared, otherwise that of the rest."""
        return 1.0 if self.kernel.declared else max(self.chi2 / max(self.freedom, 1.0), 1e-12)

    @cached_property
    def follow(self) -> Floats:
        """Return the dual (m, r + 1) of the basis, without that of ``bare``, and of the remainder."""
        own = self.basis[:, 0 if self.bare is None else self.bare.basis.shape[1] :]
        whole = np.concatenate([own, self.remainder[:, None]], axis=1)
        return self.kernel.dual(whole[: self.fit.residual.size])

    def columns(self, columns: Floats) -> Floats:
        """Return columns (m, d) divided by the noise, with zeros for the rows of knowledge."""
        out = np.zeros((len(self.basis), columns.shape[1]))
        out[: len(columns)] = self.kernel.whiten(columns)
        return out

    def without(self, columns: Floats) -> Floats:
        """Return (I − QQᵀ) by."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    def extended(self, findings: Floats) -> Design:
        """Return the design with further columns ``findings`` (m, f), about a wide prior."""
        f = findings.shape[1]
        if not f:
            return self
        columns = np.concatenate([self.columns(findings), np.eye(f) / WIDEST])
        padded = np.concatenate([self.basis, np.zeros((f, self.basis.shape[1]))])
        columns = columns / np.linalg.norm(columns, axis=0)
        for _ in range(2):
            columns = columns - padded @ (padded.T @ columns)
        u, singular, _ = np.linalg.svd(columns, full_matrices=False)
        added = u[:, singular > RANK_TOLERANCE]
        remainder = np.concatenate([self.remainder, np.zeros(f)])
        return replace(
            self,
            basis=np.concatenate([padded, added], axis=1),
            remainder=remainder - added @ (added.T @ remainder),
            freedom=self.freedom - float((added[: self.fit.residual.size] ** 2).sum()),
            bare=self,
        )


def build_design(fit: WhitenedFit, kernel: Kernel, robot_prior: bool = False) -> Design:
    """Return what the parameters of a fit can follow."""
    m = fit.residual.size
    prior = (fit.prior_jac, fit.prior_residual) if robot_prior else (fit.leeway, np.zeros(len(fit.leeway)))
    top = kernel.whiten(np.concatenate([fit.jac, fit.residual[:, None]], axis=1))
    jac = np.concatenate([top[:, :-1], fit.knowledge_jac, prior[0]])
    residual = np.concatenate([top[:, -1], fit.knowledge_residual, prior[1]])
    scale = np.linalg.norm(jac, axis=0)
    scale = np.maximum(scale, RANK_TOLERANCE * scale.max(initial=1e-300))  # a parameter may move nothing
    u, singular, vt = np.linalg.svd(jac / scale, full_matrices=False)
    significant = singular > RANK_TOLERANCE * singular.max(initial=0.0)
    basis, root = u[:, significant], vt[significant].T / singular[significant] / scale[:, None]
    freedom = m - float((basis[:m] ** 2).sum())
    return Design(fit, kernel, jac, residual, basis, root, residual - basis @ (basis.T @ residual), freedom)


class Moments(NamedTuple):
    """M and b of c candidates along the eigenvectors of M: λ (c, d), V (c, d, d), y (c, d); which λ are significant."""

    values: Floats
    vectors: Floats
    scores: Floats
    significant: Mask


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


def moments(hypothesis: Hypothesis, design: Design) -> Moments:
    """Return M and b of all candidates: those beside the parameters, less what findings and nuisance follow."""
    bare = design.bare or design
    if hypothesis not in bare.sums:
        bare.sums[hypothesis] = sums_of(hypothesis, bare)
    square, score, size = bare.sums[hypothesis]
    added = design.basis[:, bare.basis.shape[1] :]
    follow = design.follow[:, : added.shape[1]]
    if hypothesis.nuisance is not None:
        projected = design.without(design.columns(hypothesis.nuisance))
        u, singular, _ = np.linalg.svd(projected, full_matrices=False)
        u = u[:, singular > 1e-6 * singular.max(initial=0.0)]
        added = np.concatenate([added, u], axis=1)
        follow = np.concatenate([follow, design.kernel.dual(u[: len(follow)])], axis=1)
    if added.size:
        cross = products(hypothesis, follow, design.fit.row)
        square = square - cross @ cross.swapaxes(1, 2)
        score = score - cross @ (added[: len(bare.remainder)].T @ bare.remainder)
    values, vectors = np.linalg.eigh(square)
    return Moments(
        np.maximum(values, 0.0),
        vectors,
        np.einsum("cdk,cd->ck", vectors, score),
        values > np.maximum(SEEN * size[:, None], WIDEST**-2),
    )


def sums_of(hypothesis: Hypothesis, design: Design) -> Sums:
    """Return the sums of a hypothesis' candidates beside the parameters."""
    cross = products(hypothesis, design.follow, design.fit.row)
    by_basis, square = cross[:, :, :-1], squares(hypothesis, design)
    size = np.maximum(np.trace(square, axis1=1, axis2=2), 1e-300)
    return Sums(square - by_basis @ by_basis.swapaxes(1, 2), cross[:, :, -1], size)


def products(hypothesis: Hypothesis, vectors: Floats, row: Indices) -> Floats:
    """Return Cᵀ times ``vectors`` (m, x) for each candidate, (c, d, x).

    Those of spans are differences of one cumulative sum.
    """
    columns, candidates = hypothesis.columns, hypothesis.candidates
    if isinstance(candidates, Profiles):
        return np.stack([hypothesis.candidate(number, row).T @ vectors for number in range(hypothesis.count)])
    edges, (first, last), cuts, inside = cuts_of(candidates.edges, row)
    product = (columns[inside][:, :, None] * vectors[inside][:, None, :]).reshape(inside.size, -1)
    upto = np.zeros((edges.size, product.shape[1]))
    np.cumsum(np.add.reduceat(product, cuts, axis=0), axis=0, out=upto[1:])
    return np.asarray((upto[last] - upto[first]).reshape(last.size, columns.shape[1], -1))


def squares(hypothesis: Hypothesis, design: Design) -> Floats:
    """Return CᵀC (c, d, d) of the candidates, divided by the noise."""
    kernel, row, candidates = design.kernel, design.fit.row, hypothesis.candidates
    if isinstance(candidates, Profiles):
        every = (kernel.whiten(hypothesis.candidate(number, row)) for number in range(hypothesis.count))
        return np.stack([columns.T @ columns for columns in every])
    if kernel.plain:
        return products(hypothesis, hypothesis.columns / kernel.scale**2, row)
    # The rows before an edge have the columns U; those of a span are U_b − U_a.
    edges, (first, last), _, _ = cuts_of(candidates.edges, row)
    before = row[:, None] < edges
    d = hypothesis.columns.shape[1]
    upto = kernel.whiten((hypothesis.columns[:, None, :] * before[:, :, None]).reshape(len(row), -1))
    gram = (upto.T @ upto).reshape(edges.size, d, edges.size, d).swapaxes(1, 2)
    return np.asarray(gram[last, last] - gram[last, first] - gram[first, last] + gram[first, first])


def cuts_of(spans: Indices, row: Indices) -> tuple[Indices, Indices, Indices, Indices]:
    """Return the different edges of spans (c, 2), the indices (2, c) of each among them, and for the residuals between the
    first and the last edge, where each stretch begins and their indices.
    """
    edges, index = np.unique(spans, return_inverse=True)
    inside = np.arange(np.searchsorted(row, edges[0]), np.searchsorted(row, edges[-1]))
    return edges, index.reshape(spans.shape).T, np.searchsorted(row, edges[:-1]) - inside[0], inside


def weigh(hypothesis: Hypothesis, design: Design) -> Weighed:
    """Return the evidence of a hypothesis and the probability of chance."""
    sums = moments(hypothesis, design)
    information, scores = np.where(sums.significant, sums.values, 0.0), np.where(sums.significant, sums.scores, 0.0)
    variance, square = design.variance, SCALES[:, None, None] ** 2
    gain = square * scores**2 / variance / (variance + square * information)
    by_scale = 0.5 * gain.sum(axis=2) - 0.5 * np.log1p(square * information / variance).sum(axis=2)
    each = np.logaddexp.reduce(by_scale, axis=0) - np.log(SCALES.size)
    drop = (scores**2 / np.where(sums.significant, sums.values, 1.0)).sum(axis=1)
    freedom = sums.significant.sum(axis=1)
    chance = log_chance(drop, freedom, design)
    best = first_within(each)
    return Weighed(
        hypothesis,
        sums,
        by_scale,
        best,
        float(np.logaddexp.reduce(each) - np.log(each.size)),
        float(drop[best]),
        int(freedom[best]),
        min(float(chance.min()) + float(np.log(each.size)), 0.0),
    )


def log_chance(drop: Floats, freedom: Indices, design: Design) -> Floats:
    """Return the log probability that noise gives such drops (c,) of χ²; 0 without a degree of freedom."""
    d = np.maximum(freedom, 1).astype(float)
    if design.kernel.declared:
        p, half_drop = special.chdtrc(d, drop), np.maximum(drop, 1e-300) / 2.0
        tail = (d / 2.0 - 1.0) * np.log(half_drop) - half_drop - special.gammaln(d / 2.0)
    else:
        # F(d, ν − d) of drop/d over the remaining variance; its tail is an incomplete beta function of the remaining χ².
        a = np.maximum(design.freedom - d, 0.5) / 2.0
        remaining = np.clip(1.0 - drop / design.chi2, 1e-300, 1.0 - 1e-15)  # rounding can make a drop exceed χ²
        p = special.betainc(a, d / 2.0, remaining)
        tail = a * np.log(remaining) + (d / 2.0 - 1.0) * np.log1p(-remaining) - np.log(a) - special.betaln(a, d / 2.0)
    deep = p < 1e-280
    return np.where(freedom == 0, 0.0, np.where(deep, tail, np.log(np.where(deep, 1.0, p))))


class Amount(NamedTuple):
    """β (d,) in typical sizes, a root (d, r) of its covariance, and a basis (d, d − r) of what the rows do not show of it."""

    size: Floats
    root: Floats
    hidden: Floats


def amount_of(weighed: Weighed, variance: float, scale: float = SCALES[-1], is_named: bool = True) -> Amount:
    """Return by how much the best candidate is off, with the prior of a scale.

    Directions of which the rows say less than the typical size does are hidden, unless the hypothesis ``is_named`` and
    they are SHOWN: their β is 0.
    """
    sums, number = weighed.moments, weighed.best
    information = np.where(sums.significant[number], sums.values[number], 0.0) / variance
    scores, vectors = sums.scores[number] / variance, sums.vectors[number]
    is_shown = (scores**2 > SHOWN**2 * information) & sums.significant[number]
    stated = (information > 1.0) | (is_named & is_shown)
    root = vectors[:, stated] / np.sqrt(information[stated] + scale**-2.0)
    return Amount(root @ (root.T @ (vectors @ scores)), root, vectors[:, ~stated])


def rows_of(weighed: Weighed) -> tuple[int, int] | None:
    """Return the span of rows of the best candidate; None if it is a profile."""
    candidates = weighed.hypothesis.candidates
    if isinstance(candidates, Profiles):
        return None
    first, last = candidates.edges[weighed.best].tolist()
    return first, last
