"""The examination of an estimate: what may be wrong beside the model's parameters, and the error that this leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from truearm.checks.averaging import AllRows, Average, Choice, averaged, unseen
from truearm.checks.catalogue import LAST_MOVE
from truearm.checks.evidence import Design, Weighed, amount_of
from truearm.checks.search import RIVAL, Search, columns_of, gain, left_out, search_with_noise
from truearm.checks.whitened import MOST_ROWS, RowWeights, WhitenedFit, used_rows, whitened_fit
from truearm.errors import Argument, InputError
from truearm.estimate.circumstances import measured_order
from truearm.estimate.outliers import HEAVY, MOST_BAD, single
from truearm.estimate.parameter_update import stepper
from truearm.estimate.prediction import MOST_POSES, body_motion, measured_jacobian
from truearm.estimate.problem import BLOCK, build_problem
from truearm.estimate.solvers import Loss
from truearm.estimate.validation import Judgement, Ways
from truearm.estimate.whitened_rows import only
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import MOVES, Diagnosis, DriftWith, Effect, Estimate, Rival, Size, ToolClaim
from truearm.types import Floats, Mask, Rigs, thinned

GROSS = 30.0  # σ of the residuals: a fit this distorted shows only that the inputs are wrong
MEAN = "mean"
EVERY = ".all"  # ends the name of a hypothesis about all items of a type
LASTING = "eccentricity"  # the form of an error that stays in the arm: parameters alone would predict worse without it


class Applied(NamedTuple):
    """What applying causes of faults gives: the parameters' change, their mean square error then, and the claim."""

    change: Floats  # (P,)
    covariance: Floats  # (P, P)
    claim: ToolClaim


@dataclass(frozen=True)
class Examination:
    """The faults in an estimate, in the order of the search, and the error that the tool may have.

    ``free`` (P,) are the estimate's parameters of ``average``, ``rows`` all rows if some of them were examined.
    """

    faults: tuple[Diagnosis, ...]
    claim: ToolClaim
    average: Average
    free: Mask
    rows: AllRows | None = None

    def applied(self, names: Sequence[str]) -> Applied:
        """Return what applying some causes gives; the last of several causes of one fault holds.

        "mean" applies the mean of the rivals of each fault. Raises InputError for a cause that no fault has.
        """
        chosen: dict[int, int] = {}  # by finding, which of its steps
        for name in names:
            by_finding = {
                number: index
                for number, fault in enumerate(self.faults)
                for index, rival in enumerate((*fault.rivals, fault.mean))
                if rival.apply == name
            }
            if not by_finding:
                causes = [rival.apply for fault in self.faults for rival in fault.rivals if rival.apply]
                remedy = f"name one of {', '.join(causes)}" if causes else "these rows show no fault"
                raise InputError(Argument("apply"), f" {name}: no cause of a fault in these rows; {remedy}")
            chosen |= by_finding

        def step_of(average: Average) -> Floats:
            return sum((average.steps[number][k] for number, k in chosen.items()), np.zeros(len(average.gram)))

        average, change, chi2_reduced = self.average, np.zeros(self.free.size), self.claim.chi2_reduced
        change[self.free], covariance = step_of(average), np.zeros((change.size, change.size))
        if chosen and self.rows is not None:
            x, average, chi2_reduced = self.rows.applied(average, step_of)
            change = x - self.rows.x
        step = step_of(average)
        covariance[np.ix_(self.free, self.free)] = average.covariance(step)
        rivals, shift = average.moves(average.of_rivals()), average.moves(average.bias(step))
        return Applied(change, covariance, replace(self.claim, rivals=rivals, shift=shift, chi2_reduced=chi2_reduced))


def examined(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    estimate: Estimate,
    effects: tuple[Effect, ...] = (),
    any_base: bool = False,
) -> Examination | None:
    """Examine an estimate from ``identify`` that has ``effects`` as parameters.

    ``any_base``: the pose of the base is a choice of frame. Returns None for a fit without degrees of freedom, or one
    distorted beyond GROSS. Of more than MOST_ROWS a selection is examined.
    """
    if estimate.chi2_freedom < 1.0:
        return None
    fitted = estimate.fitted
    sigma = estimate.prior_sigma[: len(chain.parameters)]
    problem = only(build_problem(chain, rig, table, sigma, effects, fitted), estimate.weight[fitted] > 0.0)
    measured = measured_order(table, chain, fitted)
    whole = None if used_rows(problem).size == len(table) else build_problem(chain, rig, table)
    gram = tool_gram(chain, rig, table.select(~estimate.left_out), estimate, any_base)
    covariance = estimate.covariance[np.ix_(estimate.free, estimate.free)]
    laws = estimate.law_parameters, estimate.law_prior

    def by_weights(weight: Floats) -> Examination | None:
        weights = RowWeights(weight[fitted], estimate.weight[fitted])

        def rows_at(x: Floats, rows: slice | None = None) -> WhitenedFit:
            return whitened_fit(problem, x, estimate.free, measured, weights, laws, rows, whole)

        examination = examination_of(rows_at(estimate.value), gram, covariance, table, estimate.free)
        count = used_rows(problem).size
        if examination is None or not examination.faults or count <= MOST_ROWS:
            return examination  # nothing to apply: the rows need not be kept
        slices = [slice(first, first + BLOCK) for first in range(0, count, BLOCK)]
        move, pulled = stepper(problem, estimate.free), bool((weights.fitted != weights.examined).any())
        of_all = AllRows(
            estimate.value, estimate.free, move, measured, pulled, lambda x: (rows_at(x, rows) for rows in slices)
        )
        return replace(examination, rows=of_all)

    weight = row_weights(estimate)
    if single(weight[fitted] < 1.0):
        return by_weights(weight)
    examination = by_weights(np.ones(len(table)))
    # Rows that a loss ignores may be those of one item that is wrong: all of them together show it.
    is_explained = examination is not None and bool(examination.faults)
    return examination if is_explained or bool((weight == 1.0).all()) else by_weights(weight)


def row_weights(estimate: Estimate) -> Floats:
    """Return the weights (n,) with which an estimate's rows are examined: 1, or less where a robust loss ignores them.

    The residual of such a row then counts as its standard deviation: many together still show a fault. All rows count
    fully if the loss does not fit the others either: a wrong chuck bends it to some of its own rows.
    """
    follows_others = estimate.suspect[estimate.fitted].mean() <= MOST_BAD and estimate.chi2_reduced < HEAVY
    if estimate.loss == Loss.LINEAR or not follows_others:
        return np.ones(estimate.fitted.size)
    return np.where(estimate.suspect, np.maximum(estimate.distance, 1.0) ** -2.0, 1.0)


def faults_beside(judgement: Judgement, ways: Ways, table: ObservationTable) -> tuple[Diagnosis, ...]:
    """Return the faults in the ``table``'s rows of a judgement, with the calibration's covariance as knowledge."""
    problem, x = judgement.problem, judgement.x
    problem = replace(problem, prior_sigma=np.where(judgement.settled, problem.prior_sigma, np.inf))
    measured = measured_order(table, problem.chain, np.ones(len(table), dtype=bool))
    even = np.ones(len(table))
    fit = whitened_fit(problem, x, ways.columns, measured, RowWeights(even, even))
    k = ways.matrix.shape[1]
    if fit.residual.size <= k:
        return ()
    prior = np.column_stack([fit.prior[:, :-1] @ ways.matrix, fit.prior[:, -1]])
    prior = np.concatenate([prior, np.eye(ways.known, k + 1)])
    fit = replace(fit, jac=fit.jac @ ways.matrix, prior=prior, wide_prior=prior, arm={})
    examination = examination_of(fit, np.zeros((k, k)), np.zeros((k, k)), table, np.ones(k, dtype=bool))
    return examination.faults if examination else ()


def examination_of(
    fit: WhitenedFit, gram: Floats, covariance: Floats, table: ObservationTable, free: Mask
) -> Examination | None:
    """Return the examination of a fit with the ``covariance`` (k, k); ``gram`` (k, k) [m²] is what moves the tool.

    None for a fit too far from its rows for an analysis of first order.
    """
    if not float(fit.residual @ fit.residual) <= GROSS**2 * fit.residual.size:
        return None
    result = search_with_noise(fit)
    average, kernel = averaged(result, gram, covariance), result.design.kernel
    declared = result.declared.extended(columns_of(result.detections, fit))
    chi2_reduced = declared.chi2 / max(declared.freedom, 1.0)
    claim = ToolClaim(
        *average.decomposition(),
        noise=kernel.name,
        noise_factor=kernel.scale,
        chi2_reduced=chi2_reduced,
        unseen=unseen(result, average),
        refused=result.refused,
    )
    return Examination(diagnoses(result, average, table), claim, average, free)


def diagnoses(result: Search, average: Average, table: ObservationTable) -> tuple[Diagnosis, ...]:
    """Return the findings of a search, each with its rivals and what applying one of them, or their mean, gives."""
    out = []
    findings = zip(result.detections, average.choices, average.steps, strict=True)
    for detection, choices, steps in findings:
        other_findings = result.as_fitted.extended(result.beside(detection))
        baseline = left_out(other_findings, result.block)
        residuals = [left_out(other_findings.extended(choice.weighed.columns), result.block) for choice in choices]
        residuals += [np.array([choice.weight for choice in choices]) @ residuals]
        names = [*((*identity(choice.weighed), choice.weight) for choice in choices), (MEAN, MEAN, None, 1.0)]
        *rivals, mean = (
            Rival(*name, average.moves(step), average.error(step), *gain(baseline, residual, result.block)[:2])
            for name, step, residual in zip(names, steps, residuals, strict=True)
        )
        best, sizes = detection.best, sizes_of(choices[0].weighed, result.design)
        strength = best.drop, best.freedom, best.log_evidence
        mount = deciding(choices, result.design, table)
        out.append(Diagnosis(tuple(rivals), mean, detection.aliases, sizes, *strength, mount))
    return tuple(out)


def deciding(choices: Sequence[Choice], design: Design, table: ObservationTable) -> tuple[str, ...]:
    """Return the names mounted in the rows that would exclude most explanations if they were measured again at the end.

    Formula (12) of docs/explanation/hypotheses.md. Empty if no mount is expected to give one nat.
    """
    fit = design.fit
    predicted = np.array([fit.jac @ choice.step + at_the_end(choice.weighed) @ choice.size for choice in choices])
    square = (predicted - predicted[0]) ** 2 / (1.0 + ((fit.jac @ design.root) ** 2).sum(axis=1))
    run = fit.measured.run[fit.row]
    nats = 0.5 * np.array([np.bincount(run, difference) for difference in square])
    if nats.max() < 1.0:
        return ()
    best = np.argmax(np.minimum(nats, RIVAL).sum(axis=0))
    row = fit.measured.row[np.flatnonzero(fit.measured.run == best)[0]]
    columns = kinds()[str(table.kind[row])].grouped_by
    return tuple(f"{column} {table[column][row]}" for column in columns if table[column][row])


def at_the_end(weighed: Weighed) -> Floats:
    """Return the columns (m, d) of an explanation if all rows were measured again at the end of their session."""
    candidates = weighed.hypothesis.candidates
    row = int(candidates.spans[weighed.best, 1]) - 1 if candidates.drifts else -1
    return weighed.hypothesis.candidate(weighed.best, row)


def identity(weighed: Weighed) -> tuple[str, str, tuple[int, int] | None]:
    """Return an explanation's name, that by which it is applied, and its rows [first, after last) of the user's table.

    It is applied as an ``Effect``, which a fit can estimate, otherwise by its own name; "" if it has no remedy. The
    rows are None for all of a session.
    """
    hypothesis, candidates, measured = (
        weighed.hypothesis,
        weighed.hypothesis.candidates,
        weighed.hypothesis.fit.measured,
    )
    item, form = hypothesis.item, hypothesis.form
    first, last = measured.in_table(*candidates.spans[weighed.best].tolist())
    rows = None if candidates.pairs is None else (first, last)
    shape = candidates.drifts[weighed.best] if candidates.drifts else ""
    drift = DriftWith(shape) if shape in set(DriftWith) else LAST_MOVE.get(form)
    is_item = any(cause.name == item for cause in hypothesis.fit.causes)
    apply = hypothesis.name
    if item.endswith(EVERY) or form == LASTING:
        apply = ""
    elif shape and not drift:
        apply = f"{item}.{shape}_{form}"
    elif is_item and (drift or rows or form == "offset"):
        apply = str(Effect(item, first, None if last == measured.total else last, drift))
    return hypothesis.name, apply, rows


def sizes_of(weighed: Weighed, design: Design) -> tuple[Size, ...]:
    """Return the size of an explanation over its numbers of each unit."""
    value, root, _ = amount_of(weighed, design.variance)
    out = []
    for unit, numbers in weighed.hypothesis.by_unit(np.column_stack([value, root])).items():
        size = float(np.linalg.norm(numbers[:, 0]))
        along = numbers[:, 0] / max(size, 1e-300)
        out.append(Size(unit, size, float(np.linalg.norm(along @ numbers[:, 1:]))))
    return tuple(out)


def tool_gram(chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate, any_base: bool = False) -> Floats:
    """Return Γ (k, k) [m²]: the mean square motion of the measured points, over their poses, by the free parameters.

    A motion of all points together does not count where the observations do not determine the base, or with
    ``any_base``.
    """
    poses = table.select(thinned(len(table), MOST_POSES))
    points, flat = measured_jacobian(chain, rig, poses, estimate)
    if any_base or np.abs(flat @ estimate.unseen).max(initial=0.0) > MOVES:
        body, _ = np.linalg.qr(body_motion(points))
        flat = flat - body @ (body.T @ flat)
    motion = flat[:, estimate.free]
    return np.asarray(motion.T @ motion / len(poses))
