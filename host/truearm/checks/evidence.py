"""The evidence of hypotheses in whitened residuals, and the probability that chance gives as much.

With Q an orthonormal basis of what the fit can follow (its parameters, what is known of the rig, and findings), a
candidate with the columns C (m, d) has

    M = Cᵀ(I − QQᵀ)C ,   b = Cᵀr ,   r = (I − QQᵀ)e ,

and β ~ N(0, s²I) in units of the typical size. All of it follows from the eigenvalues λ and vectors V of M and y = Vᵀb.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from truearm.checks.catalogue import Hypothesis, Profiles
from truearm.checks.noise import Kernel
from truearm.checks.whitened import WhitenedFit
from truearm.estimate.systematic_score import FitChi2, log_chance
from truearm.types import Floats, Indices, Mask

SCALES = np.array([0.2, 1.0, 5.0])  # of the typical size, equally probable
SHOWN = 3.0  # standard deviations
SEEN = 1e-8  # share of a column's square that must remain after the parameters
WIDEST = 30.0  # of the typical size: the prior of a finding, which the rows have shown already
ROUNDING = 1e-11  # of the largest singular value


@dataclass(frozen=True)
class Design:
    """What a fit can follow: rows of residuals, then those of knowledge, divided by the noise.

    ``jac`` (m + κ, k + d): by the k parameters and the d columns of findings, with their prior below.
    """

    fit: WhitenedFit
    kernel: Kernel
    jac: Floats
    residual: Floats  # (m + κ,)
    basis: Floats  # (m + κ, r) Q
    root: Floats  # (k + d, r) S with Q = jac S, so that S Sᵀ is the covariance
    remainder: Floats  # (m + κ,) (I − QQᵀ) residual
    freedom: float  # residuals minus what they determine

    @property
    def chi2(self) -> float:
        return float(self.remainder @ self.remainder)

    @property
    def variance(self) -> float:
        """Return the variance of the noise: 1 as declared, otherwise that of the rest."""
        return 1.0 if self.kernel.declared else max(self.chi2 / max(self.freedom, 1.0), 1e-12)

    def columns(self, columns: Floats) -> Floats:
        """Return columns (m, d) divided by the noise, with zeros for the rows of knowledge."""
        out = np.zeros((len(self.jac), columns.shape[1]))
        out[: len(columns)] = self.kernel.whiten(columns)
        return out

    def without(self, columns: Floats) -> Floats:
        """Return (I − QQᵀ) by."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))


def build_design(fit: WhitenedFit, kernel: Kernel, findings: Floats, robot_prior: bool = False) -> Design:
    """Return what a fit with further columns ``findings`` (m, d) can follow."""
    m, k, d = fit.residual.size, fit.jac.shape[1], findings.shape[1]
    prior = (fit.prior_jac, fit.prior_residual) if robot_prior else (np.zeros((0, k)), np.zeros(0))
    knowledge = np.concatenate([fit.knowledge_jac, prior[0]])
    top = kernel.whiten(np.concatenate([fit.jac, findings, fit.residual[:, None]], axis=1))
    jac = np.zeros((m + len(knowledge) + d, k + d))
    jac[:m], jac[m : m + len(knowledge), :k] = top[:, :-1], knowledge
    jac[m + len(knowledge) :, k:] = np.eye(d) / WIDEST
    residual = np.concatenate([top[:, -1], fit.knowledge_residual, prior[1], np.zeros(d)])
    scale = np.maximum(np.linalg.norm(jac, axis=0), 1e-300)
    u, singular, vt = np.linalg.svd(jac / scale, full_matrices=False)
    significant = singular > ROUNDING * singular.max(initial=0.0)
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
    """Return M and b of all candidates."""
    nuisance = None
    if hypothesis.nuisance is not None:
        projected = design.without(design.columns(hypothesis.nuisance))
        nuisance = np.linalg.svd(projected, full_matrices=False)
    if isinstance(hypothesis.candidates, Profiles):
        sums = []
        for number in range(hypothesis.count):
            columns = design.columns(hypothesis.candidate(number, design.fit.row))
            projected = design.without(columns)
            if nuisance is not None:
                basis = nuisance[0][:, nuisance[1] > 1e-6 * nuisance[1].max(initial=0.0)]
                projected = projected - basis @ (basis.T @ projected)
            sums.append((projected.T @ projected, projected.T @ design.remainder, np.trace(columns.T @ columns)))
        square, score, size = (np.array(part) for part in zip(*sums, strict=True))
    elif design.kernel.plain:
        square, score, size = sums_of_spans(hypothesis.columns, hypothesis.candidates.edges, design)
    else:
        square, score, size = grams_of_spans(hypothesis.columns, hypothesis.candidates.edges, design)
    values, vectors = np.linalg.eigh(square)
    return Moments(
        np.maximum(values, 0.0), vectors, np.einsum("cdk,cd->ck", vectors, score), values > SEEN * size[:, None]
    )


def sums_of_spans(columns: Floats, spans: Indices, design: Design) -> tuple[Floats, Floats, Floats]:
    """Return M (c, d, d), b (c, d) and tr CᵀC (c,) of spans (c, 2) of rows with independent noise.

    CᵀC, QᵀC and Cᵀr over a span are differences of one cumulative sum.
    """
    row = design.fit.row
    edges, index = np.unique(spans, return_inverse=True)
    first, last = index.reshape(spans.shape).T
    m, d = columns.shape
    inside = np.arange(np.searchsorted(row, edges[0]), np.searchsorted(row, edges[-1]))
    nuisance = np.concatenate([columns, design.basis[:m], design.remainder[:m, None]], axis=1)[inside]
    cuts = np.searchsorted(row, edges) - inside[0]
    product = (columns[inside][:, :, None] * nuisance[:, None, :]).reshape(inside.size, -1)
    upto = np.zeros((edges.size, product.shape[1]))
    np.cumsum(np.add.reduceat(product, cuts[:-1], axis=0), axis=0, out=upto[1:])
    sums = (upto[last] - upto[first]).reshape(last.size, d, -1)
    square, by_basis = sums[:, :, :d], sums[:, :, d:-1]
    return square - by_basis @ by_basis.swapaxes(1, 2), sums[:, :, -1], np.trace(square, axis1=1, axis2=2)


def grams_of_spans(columns: Floats, spans: Indices, design: Design) -> tuple[Floats, Floats, Floats]:
    """Return the same for noise that rows share: the columns of a span are U_b − U_a, with U of the rows up to an edge."""
    row = design.fit.row
    edges, index = np.unique(spans, return_inverse=True)
    first, last = index.reshape(spans.shape).T
    d = columns.shape[1]
    before = row[:, None] < edges
    upto = design.columns((columns[:, None, :] * before[:, :, None]).reshape(len(columns), -1))
    projected = design.without(upto)
    gram = (projected.T @ projected).reshape(edges.size, d, edges.size, d).swapaxes(1, 2)
    score, size = (projected.T @ design.remainder).reshape(-1, d), (upto**2).sum(axis=0).reshape(-1, d).sum(axis=1)
    square = gram[last, last] - gram[last, first] - gram[first, last] + gram[first, first]
    return square, score[last] - score[first], np.maximum(size[last] - size[first], 1e-300)


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
    state = FitChi2(design.chi2, design.freedom, np.inf if design.kernel.declared else 0.0)
    chance = log_chance(drop, freedom, state)
    best = int(np.argmax(each))
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


def size_of(weighed: Weighed, variance: float, scale: float = SCALES[-1]) -> tuple[Floats, Floats]:
    """Return β (d,) of the best candidate and its covariance (d, d), in typical sizes, with the prior of a scale.

    Directions of which the rows say less than the typical size does, and that are not SHOWN, have β = 0 and no variance:
    nothing is claimed about them.
    """
    sums, number = weighed.moments, weighed.best
    information = sums.values[number] / variance
    square = np.divide(
        sums.scores[number] ** 2,
        sums.values[number] * variance,
        where=sums.significant[number],
        out=np.zeros_like(information),
    )
    stated = sums.significant[number] & ((information > 1.0) | (square > SHOWN**2))
    vectors = sums.vectors[number][:, stated]
    covariance = (vectors / (information[stated] + scale**-2.0)) @ vectors.T
    return covariance @ (sums.vectors[number] @ (sums.scores[number] / variance)), covariance


def rows_of(weighed: Weighed) -> tuple[int, int] | None:
    """Return the span of rows of the best candidate; None if it is a profile."""
    candidates = weighed.hypothesis.candidates
    if isinstance(candidates, Profiles):
        return None
    first, last = candidates.edges[weighed.best].tolist()
    return first, last
