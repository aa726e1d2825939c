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
    rest: Floats  # (m + κ,) (I − QQᵀ) residual
    freedom: float  # residuals minus what they determine

    @property
    def chi2(self) -> float:
        return float(self.rest @ self.rest)

    @property
    def variance(self) -> float:
        """Return the variance of the noise: 1 as declared, otherwise that of the rest."""
        return 1.0 if self.kernel.declared else max(self.chi2 / max(self.freedom, 1.0), 1e-12)

    def columns(self, by: Floats) -> Floats:
        """Return columns (m, d) divided by the noise, with zeros for the rows of knowledge."""
        out = np.zeros((len(self.jac), by.shape[1]))
        out[: len(by)] = self.kernel.whiten(by)
        return out

    def without(self, by: Floats) -> Floats:
        """Return (I − QQᵀ) by."""
        return np.asarray(by - self.basis @ (self.basis.T @ by))


def design(fit: WhitenedFit, kernel: Kernel, findings: Floats, robot_prior: bool = False) -> Design:
    """Return what a fit with further columns ``findings`` (m, d) can follow."""
    m, k, d = fit.residual.size, fit.jac.shape[1], findings.shape[1]
    prior = (fit.prior_jac, fit.prior_residual) if robot_prior else (np.zeros((0, k)), np.zeros(0))
    known = np.concatenate([fit.known_jac, prior[0]])
    top = kernel.whiten(np.concatenate([fit.jac, findings, fit.residual[:, None]], axis=1))
    jac = np.zeros((m + len(known) + d, k + d))
    jac[:m], jac[m : m + len(known), :k] = top[:, :-1], known
    jac[m + len(known) :, k:] = np.eye(d) / WIDEST
    residual = np.concatenate([top[:, -1], fit.known_residual, prior[1], np.zeros(d)])
    scale = np.maximum(np.linalg.norm(jac, axis=0), 1e-300)
    u, singular, vt = np.linalg.svd(jac / scale, full_matrices=False)
    seen = singular > ROUNDING * singular.max(initial=0.0)
    basis, root = u[:, seen], vt[seen].T / singular[seen] / scale[:, None]
    freedom = m - float((basis[:m] ** 2).sum())
    return Design(fit, kernel, jac, residual, basis, root, residual - basis @ (basis.T @ residual), freedom)


class Moments(NamedTuple):
    """M and b of c candidates along the eigenvectors of M: λ (c, d), V (c, d, d), y (c, d); which λ are significant."""

    values: Floats
    vectors: Floats
    along: Floats
    seen: Mask


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


def moments(hypothesis: Hypothesis, of: Design) -> Moments:
    """Return M and b of all candidates."""
    beside = None
    if hypothesis.beside is not None:
        left = of.without(of.columns(hypothesis.beside))
        beside = np.linalg.svd(left, full_matrices=False)
    if isinstance(hypothesis.candidates, Profiles):
        parts = []
        for number in range(hypothesis.count):
            by = of.columns(hypothesis.candidate(number, of.fit.row))
            left = of.without(by)
            if beside is not None:
                basis = beside[0][:, beside[1] > 1e-6 * beside[1].max(initial=0.0)]
                left = left - basis @ (basis.T @ left)
            parts.append((left.T @ left, left.T @ of.rest, np.trace(by.T @ by)))
        square, score, size = (np.array(part) for part in zip(*parts, strict=True))
    elif of.kernel.plain:
        square, score, size = sums_of_spans(hypothesis.columns, hypothesis.candidates.edges, of)
    else:
        square, score, size = grams_of_spans(hypothesis.columns, hypothesis.candidates.edges, of)
    values, vectors = np.linalg.eigh(square)
    return Moments(
        np.maximum(values, 0.0), vectors, np.einsum("cdk,cd->ck", vectors, score), values > SEEN * size[:, None]
    )


def sums_of_spans(by: Floats, spans: Indices, of: Design) -> tuple[Floats, Floats, Floats]:
    """Return M (c, d, d), b (c, d) and tr CᵀC (c,) of spans (c, 2) of rows with independent noise.

    CᵀC, QᵀC and Cᵀr over a span are differences of one cumulative sum.
    """
    row = of.fit.row
    edges, at = np.unique(spans, return_inverse=True)
    first, last = at.reshape(spans.shape).T
    m, d = by.shape
    inside = np.arange(np.searchsorted(row, edges[0]), np.searchsorted(row, edges[-1]))
    beside = np.concatenate([by, of.basis[:m], of.rest[:m, None]], axis=1)[inside]
    cuts = np.searchsorted(row, edges) - inside[0]
    product = (by[inside][:, :, None] * beside[:, None, :]).reshape(inside.size, -1)
    upto = np.zeros((edges.size, product.shape[1]))
    np.cumsum(np.add.reduceat(product, cuts[:-1], axis=0), axis=0, out=upto[1:])
    sums = (upto[last] - upto[first]).reshape(last.size, d, -1)
    square, by_basis = sums[:, :, :d], sums[:, :, d:-1]
    return square - by_basis @ by_basis.swapaxes(1, 2), sums[:, :, -1], np.trace(square, axis1=1, axis2=2)


def grams_of_spans(by: Floats, spans: Indices, of: Design) -> tuple[Floats, Floats, Floats]:
    """Return the same for noise that rows share: the columns of a span are U_b − U_a, with U of the rows up to an edge."""
    row = of.fit.row
    edges, at = np.unique(spans, return_inverse=True)
    first, last = at.reshape(spans.shape).T
    d = by.shape[1]
    before = row[:, None] < edges
    upto = of.columns((by[:, None, :] * before[:, :, None]).reshape(len(by), -1))
    left = of.without(upto)
    gram = (left.T @ left).reshape(edges.size, d, edges.size, d).swapaxes(1, 2)
    score, size = (left.T @ of.rest).reshape(-1, d), (upto**2).sum(axis=0).reshape(-1, d).sum(axis=1)
    square = gram[last, last] - gram[last, first] - gram[first, last] + gram[first, first]
    return square, score[last] - score[first], np.maximum(size[last] - size[first], 1e-300)


def weigh(hypothesis: Hypothesis, of: Design) -> Weighed:
    """Return the evidence of a hypothesis and the probability of chance."""
    by = moments(hypothesis, of)
    known, along = np.where(by.seen, by.values, 0.0), np.where(by.seen, by.along, 0.0)
    variance, square = of.variance, SCALES[:, None, None] ** 2
    gain = square * along**2 / variance / (variance + square * known)
    by_scale = 0.5 * gain.sum(axis=2) - 0.5 * np.log1p(square * known / variance).sum(axis=2)
    each = np.logaddexp.reduce(by_scale, axis=0) - np.log(SCALES.size)
    drop = (along**2 / np.where(by.seen, by.values, 1.0)).sum(axis=1)
    freedom = by.seen.sum(axis=1)
    state = FitChi2(of.chi2, of.freedom, np.inf if of.kernel.declared else 0.0)
    chance = log_chance(drop, freedom, state)
    best = int(np.argmax(each))
    return Weighed(
        hypothesis,
        by,
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
    by, number = weighed.moments, weighed.best
    known = by.values[number] / variance
    square = np.divide(
        by.along[number] ** 2, by.values[number] * variance, where=by.seen[number], out=np.zeros_like(known)
    )
    told = by.seen[number] & ((known > 1.0) | (square > SHOWN**2))
    vectors = by.vectors[number][:, told]
    covariance = (vectors / (known[told] + scale**-2.0)) @ vectors.T
    return covariance @ (by.vectors[number] @ (by.along[number] / variance)), covariance


def rows_of(weighed: Weighed) -> tuple[int, int] | None:
    """Return the span of rows of the best candidate; None if it is a profile."""
    candidates = weighed.hypothesis.candidates
    if isinstance(candidates, Profiles):
        return None
    first, last = candidates.edges[weighed.best].tolist()
    return first, last
