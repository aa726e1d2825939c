"""The search: the most probable hypothesis beyond chance, its rivals; the same again with it as a parameter of the fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from truearm.checks.catalogue import KNOTS, LEAST_ROWS, Hypothesis, Profiles, Spans
from truearm.checks.evidence import Design, Weighed, design, rows_of, size_of, weigh
from truearm.checks.held_out import UNKNOWN, Gain, gain_of, left_out_blocks
from truearm.checks.noise import DECLARED, Kernel, is_odd, learned_noise
from truearm.checks.whitened import WhitenedFit
from truearm.types import Floats, Indices

LEVEL = 1e-3  # probability that a clean data set gives any finding
RIVAL = math.log(100.0)  # a rival is at least a hundredth as probable
MOST_FINDINGS = 8
SAME = 1.0 - 1e-6  # cosine of the angles between columns that no data can distinguish
FEW_SPANS = 60  # of a hypothesis where rows share noise
LEAST_T = 2.0  # standard errors by which left-out rows must be better
OWN_EDGE = 8  # rows from the edge of a place, where the model's errors make steps


@dataclass(frozen=True)
class Found:
    """A hypothesis beyond chance, those that explain the rows as well, and those that no rows can distinguish from it.

    ``gain`` is what it gives in rows that were left out.
    """

    best: Weighed
    rivals: tuple[Weighed, ...]
    aliases: tuple[str, ...]
    columns: Floats  # (m, d) of the best candidate
    gain: Gain = UNKNOWN

    @property
    def names(self) -> tuple[str, ...]:
        """Return all names that the rows do not decide between, the most probable first."""
        return (self.best.name, *(rival.name for rival in self.rivals))


@dataclass(frozen=True)
class Search:
    """The findings in order, the design with all of them, and the evidence of every hypothesis given them."""

    found: tuple[Found, ...]
    design: Design
    table: tuple[Weighed, ...]
    refused: tuple[str, ...] = ()  # beyond chance, but they do not predict rows that were left out


def columns_of(found: Sequence[Found], fit: WhitenedFit) -> Floats:
    """Return the columns (m, d) of findings."""
    return np.concatenate([np.zeros((fit.residual.size, 0)), *(of.columns for of in found)], axis=1)


def searched(fit: WhitenedFit, every: Sequence[Hypothesis], kernel: Kernel, required: Indices | None = None) -> Search:
    """Return the findings, each the most probable given those before it.

    ``required``: blocks (n,) of rows; a finding must then predict each from the others, or it is refused with its rivals.
    """
    found: list[Found] = []
    refused: list[str] = []
    many = math.log(max(len(every), 1))
    while True:
        now = design(fit, kernel, columns_of(found, fit))
        table = tuple(weigh(one, now) for one in every)
        beyond = [one for one in table if one.log_chance + many < math.log(LEVEL) and one.log_evidence > 0.0]
        beyond.sort(key=lambda one: -one.log_evidence)
        new = None
        for likely in beyond if len(found) < MOST_FINDINGS else ():
            if likely.name in refused:
                continue
            new = found_with_rivals(likely, table, now, refused)
            if required is None:
                break
            gain = gain_of(fit, columns_of(found, fit), new.columns, required)
            if gain.share > 0.0 and gain.t >= LEAST_T:
                break
            refused += new.names
            new = None
        if new is None:
            return Search(tuple(found), now, table, tuple(dict.fromkeys(refused)))
        found.append(new)


def found_with_rivals(likely: Weighed, table: Sequence[Weighed], of: Design, refused: Sequence[str]) -> Found:
    """Return a finding with its ends refined, those nearly as probable, and those that no rows can tell from it."""
    row, best = of.fit.row, refined(likely, of)
    near = [one for one in table if one.name != best.name and one.log_evidence > best.log_evidence - RIVAL]
    near = sorted((one for one in near if one.name not in refused), key=lambda one: -one.log_evidence)
    columns = best.hypothesis.candidate(best.best, row)
    aliases = tuple(one.name for one in near if is_same(columns, one.hypothesis.candidate(one.best, row), of))
    return Found(best, tuple(near), aliases, columns)


def is_same(one: Floats, other: Floats, of: Design) -> bool:
    """Return whether columns (m, d) differ only by what the fit follows anyway: then no size of data decides."""
    bases = []
    for columns in (one, other):
        by = of.columns(columns)
        u, singular, _ = np.linalg.svd(of.without(by), full_matrices=False)
        bases.append(u[:, singular > 1e-4 * np.linalg.norm(by)])
    if bases[0].shape != bases[1].shape or not bases[0].size:
        return False
    return bool(np.linalg.svd(bases[0].T @ bases[1], compute_uv=False).min() > SAME)


def refined(best: Weighed, of: Design) -> Weighed:
    """Return a span with its ends moved row by row between the rows that were tried; the evidence stays that of the search."""
    span = rows_of(best)
    if span is None:
        return best
    (first, last), n = span, of.fit.n
    reach = max(n // (KNOTS - 1), 1)
    for side in (0, 1, 0):
        values = np.arange(max((first, last)[side] - reach, 0), min((first, last)[side] + reach, n) + 1)
        if (side == 0 and first == 0) or (side == 1 and last == n):
            continue
        tried = np.stack(
            [values, np.full(values.size, last)] if side == 0 else [np.full(values.size, first), values], 1
        )
        tried = tried[(tried[:, 1] - tried[:, 0] >= LEAST_ROWS) & (tried[:, 1] - tried[:, 0] < n)]
        again = weigh(replace(best.hypothesis, candidates=Spans(tried)), of)
        first, last = (int(edge) for edge in tried[again.best])
    fine = weigh(replace(best.hypothesis, candidates=Spans(np.array([[first, last]]))), of)
    return fine._replace(log_evidence=best.log_evidence, log_chance=best.log_chance)


def checked(fit: WhitenedFit, every: Sequence[Hypothesis], places: Indices | None = None) -> Search:
    """Return the findings under the declared noise; where that does not describe the rows, under a noise learned from them.

    With a learned noise, a finding must also predict blocks of rows that were left out: ``places`` (n,) numbers if the
    rows have several, otherwise stretches in the order of measurement.
    """
    plain = searched(fit, every, DECLARED)
    before = design(fit, DECLARED, columns_of((), fit))
    odd = [is_odd(of.rest[: fit.row.size], fit.component, of.freedom) for of in (before, plain.design)]
    blocks = left_out_blocks(fit.n, places)
    if not any(odd):
        return with_gains(plain, blocks)
    kernel = learned_noise(fit)
    told = sum(of.best.log_evidence for of in plain.found)
    if kernel.declared or (not odd[1] and told > kernel.gain):
        return with_gains(plain, blocks)
    return with_gains(searched(fit, thinned(every, fit.n, places), kernel, blocks), blocks)


def with_gains(result: Search, blocks: Indices) -> Search:
    """Return a search whose findings have their gain in left-out blocks of rows (n,)."""
    fit = result.design.fit
    found = []
    for of in result.found:
        others = columns_of([other for other in result.found if other is not of], fit)
        found.append(replace(of, gain=gain_of(fit, others, of.columns, blocks)))
    return replace(result, found=tuple(found))


def thinned(every: Sequence[Hypothesis], n: int, places: Indices | None) -> list[Hypothesis]:
    """Return the hypotheses with fewer spans, and none that begins or ends at the edge of a place."""
    out = []
    for one in every:
        if isinstance(one.candidates, Profiles):
            out.append(one)
            continue
        spans = one.candidates.edges
        if places is not None:
            edges = np.flatnonzero(np.diff(places, prepend=-1, append=-1) != 0)
            near = np.abs(spans[:, :, None] - edges).min(axis=2) <= OWN_EDGE
            spans = spans[(~near | (spans == 0) | (spans == n)).all(axis=1)]
        spans = spans[:: -(-len(spans) // FEW_SPANS) or 1]
        if len(spans):
            out.append(replace(one, candidates=Spans(spans)))
    return out


def sized(found: Found, of: Design) -> tuple[Floats, Floats]:
    """Return the sizes (d,) [SI] of a finding beside all others of its design, and their standard deviations."""
    value, covariance = size_of(found.best, of.variance)
    return value * found.best.hypothesis.sizes, np.sqrt(np.diag(covariance)) * found.best.hypothesis.sizes
