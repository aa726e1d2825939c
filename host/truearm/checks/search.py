"""The search: the most probable hypothesis beyond chance, its rivals; the same again with it as a parameter of the fit.

What a finding gives in blocks of rows that were left out is a second test.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, repeat
from typing import NamedTuple

import numpy as np
from scipy import linalg, special

from truearm.checks.catalogue import Hypothesis, alike, catalogue, rows_used, spans_of
from truearm.checks.evidence import WIDEST, BesideParameters, Design, Weighed, beside_parameters, build_design, weigh
from truearm.checks.whitened import DECLARED, WhitenedFit, learned_noise
from truearm.estimate.ties import largest_first
from truearm.types import Floats, Indices

LEVEL = 1e-3  # at most: probability that a clean data set gives any finding
RIVAL = math.log(100.0)  # a rival is at least a hundredth as probable
MOST_FINDINGS = 8
SAME = 1.0 - 1e-6  # cosine of the angles between columns that no data can distinguish
UNCONFIRMED = 0.025  # probability that chance alone makes left-out rows so much better
BLOCKS = 12  # contiguous stretches of the order of measurement, which are left out in turn
FEWEST_BLOCKS = 3
LEAST_SHARE = 1e-9  # share of a direction that other rows determine: less is rounding
ODD = 1e-3  # probability that χ² of noise as declared is so small or so large
ODD_ORDER = 4.0  # standard deviations of the correlation of neighbours

# Hypotheses with the ends of a candidate at any rows between the next knots, by that candidate; and their information.
Finer = dict[tuple[Hypothesis, int], tuple[Hypothesis, BesideParameters]]


@dataclass(frozen=True)
class Detection:
    """A hypothesis beyond chance, those that explain the rows as well, and those that no rows distinguish from it."""

    best: Weighed
    rivals: tuple[Weighed, ...]
    aliases: tuple[str, ...]


@dataclass(frozen=True)
class Search:
    """The findings in order, the design with all of them, and the evidence of every hypothesis given them."""

    detections: tuple[Detection, ...]
    design: Design  # with the declared or the learned noise
    table: tuple[Weighed, ...]
    without_findings: Design  # otherwise as ``design``
    as_fitted: Design  # without findings, with the declared noise and the prior of the fit
    block: Indices  # (m,) of residuals to leave out together
    refused: tuple[str, ...] = ()  # beyond chance, but they do not predict rows that were left out

    @property
    def declared(self) -> Design:
        """Return the design without findings, with the declared noise."""
        design, fit = self.without_findings, self.design.fit
        return design if design.kernel.declared else build_design(fit, DECLARED, fit.wide_prior)

    @cached_property
    def response(self) -> Floats:
        """Return by how much (k, m) the parameters follow errors of the residuals."""
        design, fit = self.as_fitted, self.as_fitted.fit
        if (fit.pull != 1.0).any():
            pulled = replace(fit, jac=fit.jac * fit.pull[:, None], residual=fit.residual * fit.pull)
            design = build_design(pulled, DECLARED, fit.prior)
        return design.root @ (design.basis[: fit.pull.size].T * fit.pull)

    def beside(self, detection: Detection) -> Floats:
        """Return the columns (m, d) of all other findings."""
        return columns_of([finding for finding in self.detections if finding is not detection], self.design.fit)


def columns_of(detections: Sequence[Detection], fit: WhitenedFit) -> Floats:
    """Return the columns (m, d) of findings."""
    columns = [detection.best.columns for detection in detections]
    return np.concatenate([np.zeros((fit.residual.size, 0)), *columns], axis=1)


def search_with_noise(fit: WhitenedFit) -> Search:
    """Return the findings under the declared noise, or a noise learned from the rows if that does not describe them.

    Noise is learned without findings, and beside them if they leave odd residuals or explain less than that noise does.
    What explains more is taken.
    """
    hypotheses = catalogue(fit)
    declared, as_fitted = build_design(fit, DECLARED, fit.wide_prior), build_design(fit, DECLARED, fit.prior)
    plain = searched(declared, hypotheses, as_fitted)
    is_small = declared.chi2 < special.chdtri(declared.freedom, 1.0 - ODD / 2.0)  # which no finding explains
    still_odd = is_odd(plain.design)
    if not (is_small or is_odd(declared) or still_odd):
        return plain
    kernel = learned_noise(fit)
    if not is_small:
        log_count, findings = log_counts(hypotheses), [detection.best for detection in plain.detections]
        explained = sum(finding.log_evidence - log_count[finding.hypothesis.kind] for finding in findings)
        is_doubtful = still_odd or explained < kernel.gain
        learned = learned_noise(fit.extended(columns_of(plain.detections, fit), WIDEST)) if is_doubtful else DECLARED
        kernel = learned if explained + learned.gain > kernel.gain else kernel
    if kernel.declared:
        return plain
    return searched(build_design(fit, kernel, fit.wide_prior), hypotheses, as_fitted)


def is_odd(design: Design) -> bool:
    """Return whether the remaining residuals are larger than the declared noise gives, or correlate in their order."""
    high = special.chdtri(design.freedom, ODD / 2.0)
    residual, product = design.remainder[: design.fit.residual.size], 0.0
    for number in np.unique(design.fit.component):
        series = residual[design.fit.component == number]
        product += float(series[1:] @ series[:-1])
    chi2 = float(residual @ residual)
    return bool(chi2 > high) or abs(product) / max(chi2, 1e-300) * math.sqrt(residual.size) > ODD_ORDER


def searched(without_findings: Design, hypotheses: Sequence[Hypothesis], as_fitted: Design) -> Search:
    """Return the findings, each the most probable given those before it.

    ``without_findings`` and ``as_fitted`` are designs of ``Search``. If the noise was learned, a finding must predict
    each block of rows from the others, or it is refused with its rivals and the search ends: what is less probable
    explains the same residuals.
    """
    fit, log_count = without_findings.fit, log_counts(hypotheses)
    block = left_out_blocks(fit.n, fit.measured.place)[fit.row]
    sets = alike(hypotheses)
    prepared = [beside_parameters(members, without_findings) for members in sets]
    detections: list[Detection] = []
    finer: Finer = {}
    refused: tuple[str, ...] = ()
    while True:
        design = without_findings.extended(columns_of(detections, fit))
        by_set = chain.from_iterable(map(weigh, sets, repeat(design), prepared))
        evidence = {weighed.hypothesis: weighed for weighed in by_set}
        table = tuple(evidence[hypothesis] for hypothesis in hypotheses)
        significant = {weighed.name for weighed in table if is_significant(weighed, log_count[weighed.hypothesis.kind])}
        if not significant or refused or len(detections) == MOST_FINDINGS:
            return Search(tuple(detections), design, table, without_findings, as_fitted, block, refused)
        detection = detected(significant, table, design, finer)
        baseline = as_fitted.extended(columns_of(detections, fit))
        residual = left_out(baseline.extended(detection.best.columns), block)
        if without_findings.kernel.declared or gain(left_out(baseline, block), residual, block).chance < UNCONFIRMED:
            detections.append(detection)
        else:
            refused = tuple(weighed.name for weighed in (detection.best, *detection.rivals))


def log_counts(hypotheses: Sequence[Hypothesis]) -> dict[str, float]:
    """Return the logarithm of the number of hypotheses that each of a kind counts as, as if all kinds had as many."""
    counts = Counter(hypothesis.kind for hypothesis in hypotheses)
    return {kind: math.log(count * len(counts)) for kind, count in counts.items()}


def is_significant(weighed: Weighed, log_count: float) -> bool:
    """Return whether chance hardly gives such a reduction of χ² to any hypothesis, by the logarithm of their number."""
    return weighed.log_chance + log_count < math.log(LEVEL) and weighed.log_evidence > 0.0


def detected(significant: Collection[str], table: Sequence[Weighed], design: Design, finer: Finer) -> Detection:
    """Return the most probable of the ``significant`` hypotheses with its rivals and aliases.

    Steps and runs have their ends refined before they are compared: a large error has no evidence between two knots.
    """
    refinements = [refined(weighed, design, finer) for weighed in table]
    likely = [refinements[number] for number in largest_first([weighed.log_evidence for weighed in refinements])]
    best = next(weighed for weighed in likely if weighed.name in significant)
    threshold = best.log_evidence - RIVAL
    rivals = tuple(rival for rival in likely if rival is not best and rival.log_evidence > threshold)
    return Detection(best, rivals, tuple(rival.name for rival in rivals if is_same(best, rival, design)))


def is_same(first: Weighed, second: Weighed, design: Design) -> bool:
    """Return whether hypotheses differ only by what the fit follows anyway: then no size of data decides."""
    bases = []
    for columns in (first.columns, second.columns):
        u, singular, _ = np.linalg.svd(design.without(columns), full_matrices=False)
        bases.append(u[:, singular > 1e-4 * np.linalg.norm(design.kernel.whiten(columns))])
    if bases[0].shape != bases[1].shape or not bases[0].size:
        return False
    return bool(np.linalg.svd(bases[0].T @ bases[1], compute_uv=False).min() > SAME)


def refined(best: Weighed, design: Design, finer: Finer) -> Weighed:
    """Return a step or run with its ends at any rows between the next knots, if that has more evidence.

    Its evidence is a mean over all rows at which its ends may lie. A large error has its ends at certain rows, and
    between two knots far less evidence. What ``finer`` has, it has beside all findings.
    """
    hypothesis, key = best.hypothesis, (best.hypothesis, best.best)
    if hypothesis.candidates.pairs is None:
        return best
    if key not in finer:
        rows, spans = rows_used(hypothesis.columns, design.fit), hypothesis.candidates.spans
        ends = []
        for end, knots in zip(spans[best.best].tolist(), map(np.unique, spans.T), strict=True):
            index = int(np.searchsorted(knots, end))
            first, last = knots[[max(index - 1, 0), min(index + 1, knots.size - 1)]]
            ends.append(np.union1d(rows[(first <= rows) & (rows <= last)], end))
        moved = sum(choices.size > 1 for choices in ends)
        tried = np.stack(np.meshgrid(*ends), axis=-1).reshape(-1, 2)
        candidates = spans_of(tried, design.fit.n, rows.size**moved / max(moved, 1))
        fine_hypothesis = replace(hypothesis, candidates=candidates)
        finer[key] = fine_hypothesis, beside_parameters([fine_hypothesis], design)
    (fine,) = weigh([finer[key][0]], design, finer[key][1])
    return max(best, fine, key=lambda weighed: weighed.log_evidence)


class LeftOutGain(NamedTuple):
    """What a finding gives in rows that were left out; NaN with fewer than FEWEST_BLOCKS, since one place says nothing.

    ``chance`` gives as much with a probability of the smaller one of two tests over the blocks, doubled. Student's t
    suits gains of equal size. A step in few rows gives their blocks far more than all others, which Wilcoxon's signed
    ranks do not mind.
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
    inverse does not exist, which only these rows determine, such as the sockets of a place, are fitted to them: their
    residual is 0, and stays so.
    """
    out = np.empty(block.size)
    for number in np.unique(block):
        inside = block == number
        basis = design.basis[: block.size][inside]
        share, residual = np.eye(len(basis)) - basis @ basis.T, design.remainder[: block.size][inside]
        factor = linalg.cho_factor(share + LEAST_SHARE * np.eye(len(basis)))
        value = linalg.cho_solve(factor, residual)
        out[inside] = value + linalg.cho_solve(factor, residual - share @ value)  # as without LEAST_SHARE
    return out


def gain(baseline: Floats, residual: Floats, block: Indices) -> LeftOutGain:
    """Return the gain of the residuals (m,) of left-out blocks after something was added to the fit."""
    numbers = np.unique(block)
    squares, later = (np.bincount(block, series**2)[numbers] for series in (baseline, residual))
    less = np.asarray(squares - later, dtype=float)
    if less.size < FEWEST_BLOCKS:
        return LeftOutGain(math.nan, math.nan, math.nan)
    t = float(less.mean() / max(less.std(ddof=1) / math.sqrt(less.size), 1e-12))
    chance = min(special.stdtr(less.size - 1, -t), chance_of_ranks(less))
    return LeftOutGain(float(less.sum() / squares.sum()), t, float(2.0 * chance))


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
