"""The search: the most probable hypothesis beyond chance, its rivals; the same again with it as a parameter of the fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from truearm.checks.catalogue import KNOTS, LEAST_ROWS, Hypothesis, Profiles, Spans
from truearm.checks.evidence import Design, Weighed, build_design, rows_of, weigh
from truearm.checks.held_out import LeftOut, left_out_blocks
from truearm.checks.noise import DECLARED, ODD, ODD_ORDER, learned_noise
from truearm.checks.whitened import WhitenedFit
from truearm.estimate.ties import largest_first
from truearm.types import Floats, Indices

LEVEL = 1e-3  # probability that a clean data set gives any finding
RIVAL = math.log(100.0)  # a rival is at least a hundredth as probable
MOST_FINDINGS = 8
SAME = 1.0 - 1e-6  # cosine of the angles between columns that no data can distinguish
FEW_SPANS = 60  # of a hypothesis where rows share noise
UNCONFIRMED = 0.025  # probability that chance alone makes left-out rows so much better
OWN_EDGE = 8  # rows from the edge of a place, where the model's errors make steps


@dataclass(frozen=True)
class Detection:
    """A hypothesis beyond chance, those that explain the rows as well, and those that no rows can distinguish from it."""

    best: Weighed
    rivals: tuple[Weighed, ...]
    aliases: tuple[str, ...]
    columns: Floats  # (m, d) of the best candidate

    @property
    def names(self) -> tuple[str, ...]:
        """Return all names that the rows do not decide between, the most probable first."""
        return (self.best.name, *(rival.name for rival in self.rivals))


@dataclass(frozen=True)
class Search:
    """The findings in order, the design with all of them, and the evidence of every hypothesis given them."""

    detections: tuple[Detection, ...]
    design: Design
    table: tuple[Weighed, ...]
    blocks: Indices  # (n,) of rows to leave out together
    refused: tuple[str, ...] = ()  # beyond chance, but they do not predict rows that were left out


def columns_of(detections: Sequence[Detection], fit: WhitenedFit) -> Floats:
    """Return the columns (m, d) of findings."""
    return np.concatenate([np.zeros((fit.residual.size, 0)), *(detection.columns for detection in detections)], axis=1)


def searched(bare: Design, hypotheses: Sequence[Hypothesis], blocks: Indices) -> Search:
    """Return the findings, each the most probable given those before it; ``bare`` is the design without any.

    A finding must predict each of the ``blocks`` (n,) from the others, or it is refused with its rivals. Under the
    declared noise the search then ends: what is less probable explains the same residuals.
    """
    detections: list[Detection] = []
    refused: tuple[str, ...] = ()
    fit, log_count = bare.fit, math.log(max(len(hypotheses), 1))
    while True:
        design = bare.extended(columns_of(detections, fit))
        table = tuple(weigh(hypothesis, design) for hypothesis in hypotheses)
        significant = [
            weighed
            for weighed in table
            if weighed.log_chance + log_count < math.log(LEVEL) and weighed.log_evidence > 0.0
        ]
        if significant and len(detections) < MOST_FINDINGS and not refused:
            detection = detected(by_evidence(significant)[0], table, design)
            held_out = LeftOut(fit, columns_of(detections, fit), blocks)
            gain = held_out.gain(held_out.residual_with(detection.columns))
            if bare.kernel.declared or special.stdtr(len(held_out.blocks) - 1, -gain.t) < UNCONFIRMED:
                detections.append(detection)
                continue
            refused = detection.names
        return Search(tuple(detections), design, table, blocks, refused)


def by_evidence(table: Sequence[Weighed]) -> list[Weighed]:
    """Return hypotheses, the most probable first; equals, which rounding would order, in their own order."""
    return [table[number] for number in largest_first([weighed.log_evidence for weighed in table])]


def detected(likely: Weighed, table: Sequence[Weighed], design: Design) -> Detection:
    """Return a finding with its ends refined, those nearly as probable, and those that no rows can tell from it."""
    row, best = design.fit.row, refined(likely, design)
    rivals = [
        weighed for weighed in table if weighed.name != best.name and weighed.log_evidence > best.log_evidence - RIVAL
    ]
    rivals = by_evidence(rivals)
    columns = best.hypothesis.candidate(best.best, row)
    aliases = tuple(
        weighed.name for weighed in rivals if is_same(columns, weighed.hypothesis.candidate(weighed.best, row), design)
    )
    return Detection(best, tuple(rivals), aliases, columns)


def is_same(first: Floats, second: Floats, design: Design) -> bool:
    """Return whether columns (m, d) differ only by what the fit follows anyway: then no size of data decides."""
    bases = []
    for columns in (first, second):
        whitened = design.columns(columns)
        u, singular, _ = np.linalg.svd(design.without(whitened), full_matrices=False)
        bases.append(u[:, singular > 1e-4 * np.linalg.norm(whitened)])
    if bases[0].shape != bases[1].shape or not bases[0].size:
        return False
    return bool(np.linalg.svd(bases[0].T @ bases[1], compute_uv=False).min() > SAME)


def refined(best: Weighed, design: Design) -> Weighed:
    """Return a span with its ends moved row by row between the rows that were tried; the evidence stays that of the search."""
    span = rows_of(best)
    if span is None:
        return best
    (first, last), n = span, design.fit.n
    reach = max(n // (KNOTS - 1), 1)
    for side in (0, 1, 0):
        values = np.arange(max((first, last)[side] - reach, 0), min((first, last)[side] + reach, n) + 1)
        if (side == 0 and first == 0) or (side == 1 and last == n):
            continue
        spans = np.stack(
            [values, np.full(values.size, last)] if side == 0 else [np.full(values.size, first), values], 1
        )
        spans = spans[(spans[:, 1] - spans[:, 0] >= LEAST_ROWS) & (spans[:, 1] - spans[:, 0] < n)]
        again = weigh(replace(best.hypothesis, candidates=Spans(spans)), design)
        first, last = (int(edge) for edge in spans[again.best])
    fine = weigh(replace(best.hypothesis, candidates=Spans(np.array([[first, last]]))), design)
    return fine._replace(log_evidence=best.log_evidence, log_chance=best.log_chance)


def checked(fit: WhitenedFit, hypotheses: Sequence[Hypothesis], places: Indices | None = None) -> Search:
    """Return the findings under the declared noise; where that does not describe the rows, under a noise learned from them.

    A finding must also predict blocks of rows that were left out: ``places`` (n,) numbers if the rows have several,
    otherwise stretches in the order of measurement.
    """
    blocks, bare = left_out_blocks(fit.n, places), build_design(fit, DECLARED)
    if bare.chi2 < special.chdtri(bare.freedom, 1.0 - ODD / 2.0):  # too small, which no finding explains
        kernel = learned_noise(fit)
        return searched(build_design(fit, kernel), thinned(hypotheses, fit.n, places), blocks)
    plain = searched(bare, hypotheses, blocks)
    still_odd = is_odd(plain.design)
    if not (still_odd or is_odd(bare)):
        return plain
    kernel = learned_noise(fit)
    explained = sum(detection.best.log_evidence - math.log(len(hypotheses)) for detection in plain.detections)
    if kernel.declared or (not still_odd and explained > kernel.gain):
        return plain
    return searched(build_design(fit, kernel), thinned(hypotheses, fit.n, places), blocks)


def is_odd(design: Design) -> bool:
    """Return whether the remaining residuals are larger than the declared noise gives, or correlate in their order."""
    high = special.chdtri(design.freedom, ODD / 2.0)
    residual, product = design.remainder[: design.fit.residual.size], 0.0
    for number in np.unique(design.fit.component):
        series = residual[design.fit.component == number]
        product += float(series[1:] @ series[:-1])
    chi2 = float(residual @ residual)
    return bool(chi2 > high) or abs(product) / max(chi2, 1e-300) * math.sqrt(residual.size) > ODD_ORDER


def thinned(hypotheses: Sequence[Hypothesis], n: int, places: Indices | None) -> list[Hypothesis]:
    """Return the hypotheses with fewer spans, and none that begins or ends at the edge of a place."""
    out = []
    for hypothesis in hypotheses:
        if isinstance(hypothesis.candidates, Profiles):
            out.append(hypothesis)
            continue
        spans = hypothesis.candidates.edges
        if places is not None:
            edges = np.flatnonzero(np.diff(places, prepend=-1, append=-1) != 0)
            rivals = np.abs(spans[:, :, None] - edges).min(axis=2) <= OWN_EDGE
            spans = spans[(~rivals | (spans == 0) | (spans == n)).all(axis=1)]
        spans = spans[:: -(-len(spans) // FEW_SPANS) or 1]
        if len(spans):
            out.append(replace(hypothesis, candidates=Spans(spans)))
    return out
