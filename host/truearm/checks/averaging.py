"""The stated error of the tool, averaged over what may be wrong.

A hypothesis with the posterior β ~ (β̂, P_β) shifts the parameters by −S A β with A = Sᵀ Jᵀ C: to first order, what the
fit makes of β. The error of the parameters then has the mean square

    S A (β̂ β̂ᵀ + P_β) Aᵀ Sᵀ .

The average over the hypotheses, in the place of the parameters' covariance, gives the error of anything that follows
from the parameters.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, islice
from typing import NamedTuple

import numpy as np
from scipy import special

from truearm.checks.catalogue import Candidates, Hypothesis, alike, catalogue
from truearm.checks.evidence import SCALES, WIDEST, Design, Weighed, amount_of, build_design, followed, products, weigh
from truearm.checks.search import RIVAL, Detection, Search
from truearm.checks.whitened import DECLARED, Kernel, WhitenedFit
from truearm.estimate.circumstances import Measured
from truearm.estimate.information import fold
from truearm.types import Floats, Mask

PRIOR = 0.03  # probability that a kind of fault is there, shared by the items that it can befall
LEAST_WEIGHT = 1e-5
HIDDEN = 5.0  # standard deviations that chance and the number of hypotheses hide
LINEARISATIONS = 3  # of all rows: the first leaves some thousandths of a step, the second the square of that
IN_ALL = Candidates(np.ones((1, 1)), np.array([[0, 1]]))


class Choice(NamedTuple):
    """One explanation of a finding: its probability among its rivals, and what applying it does to the parameters."""

    weighed: Weighed
    weight: float
    size: Floats  # (d,) β̂ in typical sizes
    step: Floats  # (k,) from the fit to the fit with it as a parameter
    root: Floats  # (k, d) R of R Rᵀ, the covariance that the uncertainty of its size adds


@dataclass(frozen=True)
class Average:
    """The error of the k parameters, and of the tool by Γ = ``gram`` (k, k) [m²].

    ``parameters`` (k, k) is their covariance by the noise of the rows, ``unnamed`` (k, u) a root of what faults add
    that the rows neither show nor exclude. ``choices`` are the explanations of each finding, ``kernel`` is the noise.
    """

    gram: Floats
    parameters: Floats
    unnamed: Floats
    choices: tuple[tuple[Choice, ...], ...]
    kernel: Kernel

    @cached_property
    def steps(self) -> list[list[Floats]]:
        """For each finding, the steps (k,) of its explanations in order, and last their mean by probability."""
        steps = [[choice.step for choice in choices] for choices in self.choices]
        weights = ([choice.weight for choice in choices] for choices in self.choices)
        return [[*shifts, np.array(weight) @ shifts] for shifts, weight in zip(steps, weights, strict=True)]

    def moves(self, root: Floats) -> float:
        """Return the tool's RMS motion [m] by a step (k,), or RMS error by a ``root`` (k, r) of the parameters'."""
        return math.sqrt(max(float(np.sum(root * (self.gram @ root))), 0.0))

    def of_rivals(self) -> Floats:
        """Return the root (k, r) of what not knowing the rival, and not knowing its size, add."""
        columns = [np.zeros((len(self.gram), 0))]
        for choices, (*_, mean) in zip(self.choices, self.steps, strict=True):
            for choice in choices:
                columns.append(math.sqrt(choice.weight) * np.column_stack([choice.step - mean, choice.root]))
        return np.concatenate(columns, axis=1)

    def bias(self, step: Floats | float = 0.0) -> Floats:
        """Return the mean error (k,) if a ``step`` (k,) was applied: the sum of the steps of some findings."""
        return np.asarray(sum((mean for *_, mean in self.steps), np.zeros(len(self.gram))) - step)

    def covariance(self, step: Floats | float = 0.0) -> Floats:
        """Return the mean square error (k, k) of the parameters if a ``step`` was applied."""
        root = np.column_stack([self.unnamed, self.of_rivals(), self.bias(step)])
        return np.asarray(self.parameters + root @ root.T)

    def error(self, step: Floats | float = 0.0) -> float:
        """Return the RMS error of the tool [m] if a ``step`` was applied."""
        return math.sqrt(float(np.trace(self.gram @ self.covariance(step))))

    def decomposition(self) -> tuple[float, float, float, float]:
        """Return the parts [m] of the error with nothing applied, as in ``ToolClaim``."""
        parameters = math.sqrt(float(np.trace(self.gram @ self.parameters)))
        return parameters, self.moves(self.unnamed), self.moves(self.of_rivals()), self.moves(self.bias())


def averaged(result: Search, gram: Floats, covariance: Floats) -> Average:
    """Return the averaged error of a search; ``covariance`` (k, k) is that of the fit.

    If the noise was learned, the covariance is that which it gives to the same parameters, if the tool's error is
    larger. Noise that rows do not share is as much less in the fit of all rows as that has more of them than were
    examined.
    """

    def tool(matrix: Floats) -> float:
        return float(np.trace(gram @ matrix))

    fitted, kernel = result.as_fitted, result.design.kernel
    if not kernel.declared:
        m = fitted.fit.residual.size
        noise = kernel.spread(fitted.basis[:m]) * np.sqrt(result.design.variance)
        half = np.concatenate([noise, fitted.basis[m:]]) @ fitted.root.T
        learned = half.T @ half
        if not kernel.shared:
            by_prior, variance = covariance @ fitted.fit.prior[:, :-1].T, kernel.scale**2 * result.design.variance
            of_all = variance * covariance + (1.0 - variance) * by_prior @ by_prior.T
            # Both are too large if there is scatter of the arm, or more rows.
            learned = min((learned, of_all), key=tool)
        covariance = max((covariance, learned), key=tool)
    unnamed = [np.zeros((len(gram), 0))]
    for weighed, weight in zip(result.table, probabilities(result.table, result.refused), strict=True):
        if weight > LEAST_WEIGHT:
            choice = choice_of(weighed, float(weight), result.design, result.response @ weighed.columns)
            unnamed.append(math.sqrt(weight) * np.column_stack([choice.step, choice.root]))
    choices = tuple(choices_of_finding(detection, result) for detection in result.detections)
    return Average(gram, covariance, np.concatenate(unnamed, axis=1), choices, kernel)


def probabilities(table: Sequence[Weighed], refused: Sequence[str]) -> Floats:
    """Return the probability of each hypothesis beside "nothing", which shares of PRIOR for its kind give.

    The evidence of those that were ``refused`` does not count: rows that were left out contradict it.
    """
    kinds = [weighed.hypothesis.kind for weighed in table]
    share = Counter(kinds)
    limit = [0.0 if weighed.name in refused else np.inf for weighed in table]
    log = np.minimum([weighed.log_evidence for weighed in table], limit) + np.log(
        [PRIOR / share[kind] for kind in kinds]
    )
    return np.asarray(np.exp(log - special.logsumexp(np.append(log, 0.0))))


def choice_of(
    weighed: Weighed, weight: float, design: Design, loading: Floats, is_named: bool = False, scale: float | None = None
) -> Choice:
    """Return what the best candidate does to the parameters by their ``loading`` (k, d).

    Its size is that of the ``design``, with a prior of a ``scale``, or the most probable one. A finding (``is_named``)
    is as large in directions that the rows do not show as in those that they do, beside one typical size. Of so few
    directions that is Student's t: twice the stated deviation covers as often as that of a normal distribution.
    """
    most_probable = float(SCALES[np.argmax(weighed.by_scale[:, weighed.best])])
    size, root, hidden = amount_of(weighed, design.variance, scale or most_probable, is_named)
    if is_named:
        freedom = root.shape[1] + 1
        wider = float(special.stdtrit(freedom, special.ndtr(2.0))) / 2.0
        root = np.column_stack([root, hidden * wider * math.sqrt((1.0 + float(size @ size)) / freedom)])
    return Choice(weighed, weight, size, -loading @ size, loading @ root)


def choices_of_finding(detection: Detection, result: Search) -> tuple[Choice, ...]:
    """Return the finding and its rivals by their probability, beside all other findings but for those refused."""
    design = result.without_findings.extended(result.beside(detection))
    rivals = (rival for rival in detection.rivals if rival.name not in result.refused)
    options = [weigh([weighed.hypothesis], design)[0] for weighed in (detection.best, *rivals)]
    threshold = max(weighed.log_evidence for weighed in options) - RIVAL
    options = [weighed for weighed in options if weighed.log_evidence > threshold]
    return choices_of(options, design, [result.response @ weighed.columns for weighed in options])


def choices_of(
    options: Sequence[Weighed], design: Design, loadings: Iterable[Floats], scale: float | None = None
) -> tuple[Choice, ...]:
    """Return explanations of which one is true, with their probabilities."""
    log = np.array([weighed.log_evidence for weighed in options])
    triples = zip(options, np.exp(log - special.logsumexp(log)).tolist(), loadings, strict=True)
    return tuple(choice_of(weighed, weight, design, loading, True, scale) for weighed, weight, loading in triples)


class AllRows(NamedTuple):
    """All rows of a fit that ended at x (P,), of which some were examined.

    ``blocks`` are their whitened rows at an x, ``free`` (P,) the k fitted parameters, ``move`` adds a step to them.
    ``pulled``: the fit has a robust loss.
    """

    x: Floats
    free: Mask
    move: Callable[[Floats, Floats], Floats]
    measured: Measured
    pulled: bool
    blocks: Callable[[Floats], Iterable[WhitenedFit]]

    def applied(self, average: Average, step_of: Callable[[Average], Floats]) -> tuple[Floats, Average, float]:
        """Return x (P,) with explanations applied, whose step (k,) ``step_of`` gives; the average and χ²/ν by all rows.

        It is the fit with their sizes as further parameters.
        """
        choices, x = [*chain.from_iterable(average.choices)], self.x.copy()
        courses = np.zeros((self.measured.total, len(choices)))
        for number, choice in enumerate(choices):
            courses[self.measured.row, number] = choice.weighed.hypothesis.course(choice.weighed.best, self.measured)

        def by_finding(values: Iterable[Floats]) -> list[list[Floats]]:
            in_turn = iter(values)
            return [[*islice(in_turn, len(members))] for members in average.choices]

        for _ in range(LINEARISATIONS):
            fit, columns, count = folded_blocks(self.blocks(x), choices, courses, 0)
            pulled, pulled_columns = fit, columns
            if self.pulled:
                pulled, pulled_columns, _ = folded_blocks(self.blocks(x), choices, courses, 1)
            design = build_design(fit, replace(average.kernel, shared=()), fit.wide_prior)
            design = replace(design, freedom=design.freedom + count - fit.residual.size)
            fitted = build_design(pulled, DECLARED, pulled.prior)
            loadings = [fitted.root @ (fitted.basis[: len(column)].T @ column) for column in pulled_columns]
            by_all = replace(average, choices=reweighed(average, design, by_finding(columns), by_finding(loadings)))
            step = fitted.root @ (fitted.basis.T @ np.append(pulled.residual, pulled.prior[:, -1]))
            x[self.free] = self.move(x[self.free], step + step_of(by_all))
        with_first = design.extended(np.concatenate([members[0] for members in by_finding(columns)], axis=1))
        return x, by_all, with_first.chi2 * average.kernel.scale**2 / max(with_first.freedom, 1.0)


def folded_blocks(
    blocks: Iterable[WhitenedFit], choices: Sequence[Choice], courses: Floats, power: int
) -> tuple[WhitenedFit, list[Floats], int]:
    """Return a few rows with the products of all blocks, the columns (·, d) of choices in them, and the count of rows.

    ``courses`` (N, c) are the profiles of the choices over the table's rows; rows that a choice touches where its
    profile is NaN are left out. Rows are multiplied by their pull to a ``power``. Beside them, the fit has the priors
    of the blocks.
    """
    size, count, triangle = [choice.size.size for choice in choices], 0, np.zeros((0, 0))
    for block in blocks:
        course = courses[block.measured.row][block.row]
        columns = {hypothesis.name: hypothesis.columns for hypothesis in catalogue(block, every=True)}
        pieces, known = [block.jac], np.ones(len(course), dtype=bool)
        for choice, d, profile in zip(choices, size, course.T, strict=True):
            touching = columns.get(choice.weighed.name, np.zeros((len(course), d)))[:, :d]
            known &= np.isfinite(profile) | ~touching.any(axis=1)
            pieces.append(touching * np.nan_to_num(profile)[:, None])
        rows = np.column_stack([*pieces, block.residual]) * block.pull[:, None] ** power
        rows = rows[known]
        triangle = fold(triangle if triangle.size else np.zeros((rows.shape[1], rows.shape[1])), rows)
        count += len(rows)
    jac, *by_choice, residual = np.split(triangle, np.cumsum([block.jac.shape[1], *size]), axis=1)
    first = np.zeros(len(triangle), dtype=np.intp)
    fit = replace(block, row=first, component=first, jac=jac, residual=residual[:, 0], pull=np.ones(len(triangle)))
    fit = replace(fit, fault_jac=np.zeros((len(triangle), 0)), kind_faults=(), axes=np.zeros((0, 3, 3)))
    return fit, by_choice, count


def reweighed(
    average: Average, design: Design, columns: Sequence[Sequence[Floats]], loadings: Sequence[Sequence[Floats]]
) -> tuple[tuple[Choice, ...], ...]:
    """Return the choices with their ``columns`` and ``loadings`` of all rows, beside the first of other findings.

    Under noise that rows share, probabilities and uncertainty stay those that examined rows give.
    """
    out = []
    for choices, of_finding, loadings_of_finding in zip(average.choices, columns, loadings, strict=True):
        others = [other[0] for other in columns if other is not of_finding]
        beside = design.extended(np.concatenate([design.fit.jac[:, :0], *others], axis=1))
        options = []
        for choice, column in zip(choices, of_finding, strict=True):
            hypothesis = choice.weighed.hypothesis
            in_all = IN_ALL._replace(among=hypothesis.candidates.number)
            of_all = replace(hypothesis, fit=design.fit, columns=column, candidates=in_all)
            options += weigh([of_all], beside)
        new = choices_of(options, beside, loadings_of_finding, WIDEST)
        if average.kernel.shared:
            pairs = zip(choices, new, strict=True)
            new = tuple(choice._replace(size=by_all.size, step=by_all.step) for choice, by_all in pairs)
        out.append(new)
    return tuple(out)


def unseen(result: Search, average: Average) -> dict[str, dict[str, float]]:
    """Return faults that need not show, and twice the stated error does not contain: their sizes by SI unit.

    Rows and a prior of the typical size give them a posterior, without a finding; HIDDEN standard deviations of it are
    hidden. Of each kind and its units it is the least size of any hypothesis, in its median candidate: a step at the
    first row is an offset. The kinds of findings are none.
    """
    fitted, limit = result.as_fitted, 2.0 * average.error()
    values, vectors = np.linalg.eigh(fitted.root.T @ average.gram @ fitted.root)
    follow = fitted.basis[: fitted.fit.residual.size] @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    named = {choice.weighed.hypothesis.kind for choices in average.choices for choice in choices}
    smallest: dict[tuple[str, ...], tuple[float, str, dict[str, float]]] = {}
    square = dict[Hypothesis, Floats]()
    for members in alike([weighed.hypothesis for weighed in result.table]):
        loading = products(members, follow)[:, :, : members[0].sizes.size]
        square |= zip(members, followed(members, loading), strict=True)
    for hypothesis, moments in ((weighed.hypothesis, weighed.moments) for weighed in result.table):
        root = HIDDEN * moments.vectors / np.sqrt(1.0 + moments.values / result.design.variance)[:, None]
        moves, directions = np.linalg.eigh(root.swapaxes(1, 2) @ square[hypothesis] @ root)
        median = int(np.argsort(moves[:, -1])[len(moves) // 2])
        motion = math.sqrt(max(moves[median, -1], 0.0))
        if motion > limit and hypothesis.kind not in named:
            size = root[median] @ directions[median, :, -1] * (limit / motion)
            sizes = {unit: float(np.linalg.norm(numbers)) for unit, numbers in hypothesis.by_unit(size).items()}
            fault, key = (float(np.linalg.norm(size)), hypothesis.name, sizes), (hypothesis.kind, *sizes)
            smallest[key] = min(fault, smallest.get(key, fault))
    return {name: size for _, name, size in sorted(smallest.values(), key=lambda fault: fault[:2])}
