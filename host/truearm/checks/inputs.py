"""Whether the inputs of a fit are right: other interpretations of table and rig are tried if it is doubtful.

A fit may not converge, or leave residuals larger than the tolerances of a drawing (1 mm, 5 mrad). Base, tool or links
may be far from where they were described. The cause is rarely the robot. All interpretations of ``alternatives`` are
then ranked by their evidence in a few rows, and the best are fitted. The formulas are in
docs/explanation/hypotheses.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from truearm.checks.alternatives import Robots, other_interpretations
from truearm.checks.examination import GROSS
from truearm.checks.labels import relabelled
from truearm.checks.search import RIVAL
from truearm.checks.trial import (
    FAR,
    HUNDREDFOLD,
    Alternative,
    Trial,
    explains,
    fitted,
    log_chance_of_place,
    log_chance_of_ratio,
    log_evidence,
    placed,
)
from truearm.estimate.solvers import SOLVERS
from truearm.estimate.uncertainty import LEAST_FREEDOM
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Estimate, Explanation, Figures, Unusable
from truearm.types import Mask, Rigs
from truearm.units import UNITS

STEPS_TO_RANK = 2  # to place base, tool and rig
MOST_PLACED, MOST_FITTED = 8, 4  # the best alternatives that go on
MISFIT = 4.0  # χ²/ν: with less, rows that do not fit are not worth a search
TENFOLD = 0.1  # of χ²
NOISE_LEVEL = 0.01  # probability that declared noise alone leaves a larger χ²
SURELY = 6.0  # standard deviations, of a displacement that its own uncertainty does not explain
HELD = "held-parameters"


def checked_inputs(
    estimate: Estimate,
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    free: Mask,
    usual: Mask,
    robots: Callable[[], Robots],
    allowed: Collection[str] = (),
) -> Estimate:
    """Return the estimate with explanations if it is doubtful, and with the reason if it is not usable.

    ``free`` (p,) are the parameters requested for identification, before any were fixed by default; ``usual`` (p,)
    those that the robot has free by default; ``robots`` are others to try. Items that are ``allowed`` to be off were
    fitted.
    """
    inputs = Alternative(chain, rig, table, free, np.flatnonzero(estimate.fitted))
    explanations: tuple[Explanation, ...] = ()
    tried = 0
    beyond = _unconverged(estimate) or _beyond(estimate, "weak_sigma")  # what correct inputs hardly give
    doubtful = beyond or is_elsewhere(estimate) or estimate.chi2_reduced > GROSS**2
    # Rows left out as outliers may be what is left of a mount with a wrong name, some of whose rows fit by chance.
    are_several, bent = int(estimate.outlying.sum()) > 1, estimate.chi2_reduced > max(estimate.chi2_band[1], MISFIT)
    misfit = not estimate.faults and (are_several or bent)
    original = fitted(inputs) if doubtful or misfit else None
    if original is not None and original.freedom >= 1.0:
        # The trial ran longer than a fit that only needs more iterations.
        finished = _unconverged(estimate) and original.plausible and original.displacement <= FAR
        if doubtful and not finished:
            explanations, tried = explanations_of(original, usual, robots(), allowed)
        elif misfit:
            explanations, tried = other_set_up(original, bent)
    estimate = replace(estimate, explanations=explanations, alternatives_tried=tried)
    return replace(estimate, unusable=_unusable(estimate))


def explanations_of(
    original: Trial, usual: Mask, robots: Robots, allowed: Collection[str] = ()
) -> tuple[tuple[Explanation, ...], int]:
    """Return explanations of the rows that are better than the inputs as given, and how many were tried."""
    inputs = original.alternative
    held = usual & ~inputs.free
    if held.any():
        # A few parameters do not show which interpretation is correct: all are judged with the robot's default ones.
        names = [name for name, is_held in zip(inputs.chain.parameter_names, held, strict=True) if is_held]
        inputs = replace(inputs, free=usual | inputs.free)
        freed = fitted(replace(inputs, code=HELD, values={"names": names}))
        if freed is None or freed.freedom < 1.0:
            return (), 1
        if explains(original, freed, 1, 1.0):
            return (_explanation(original, freed, 1),), 1
        original = freed
    alternatives = other_interpretations(inputs, robots, allowed)
    tried = 2 + len(alternatives)
    trials = explaining(original, alternatives, tried)
    if not any(trial.reduced < HUNDREDFOLD * original.reduced for trial in trials):
        labels, runs = relabelled(inputs)  # pays for each run: one mistake that explains all rows is more probable
        trials = explaining(original, [*(trial.alternative for trial in trials), *[labels] * bool(runs)], tried)
    rivals = [trial for trial in trials if log_evidence(original, trial) > log_evidence(original, trials[0]) - RIVAL]
    return tuple(_explanation(original, trial, tried) for trial in rivals), tried


def other_set_up(original: Trial, bent: bool) -> tuple[tuple[Explanation, ...], int]:
    """Return the rows with other labels or another set-up, if the declared noise explains all others.

    A joint that steps by a degree bends a fit too far for an analysis of first order, but leaves less than a
    millimetre. Unless the fit is ``bent`` without outliers, only other labels explain these: rows between them that fit
    are not apart.
    """
    labels, runs = relabelled(original.alternative)
    if not bent and labels.code != "wrong-labels":
        return (), 1
    after = fitted(labels) if runs else None
    if after is None or not explains(original, after, 1, TENFOLD):
        return (), 1
    by_noise = special.chdtri(after.freedom, NOISE_LEVEL) / after.freedom
    return ((_explanation(original, after, 1),) if after.reduced <= by_noise else ()), 1


def explaining(original: Trial, alternatives: Sequence[Alternative], count: int) -> list[Trial]:
    """Return the trials of alternatives that explain the rows, the most probable first, of those best in quick fits."""
    quick = _ranked(original, [placed(alternative, STEPS_TO_RANK) for alternative in alternatives])[:MOST_PLACED]
    best = _ranked(original, [placed(trial.alternative, start=trial.parameters) for trial in quick])[:MOST_FITTED]
    trials = _ranked(original, [fitted(trial.alternative, trial.parameters) for trial in best])
    return [trial for trial in trials if explains(original, trial, count)]


def _ranked(original: Trial, trials: Sequence[Trial | None]) -> list[Trial]:
    return sorted(filter(None, trials), key=lambda trial: -log_evidence(original, trial))


def _explanation(original: Trial, after: Trial, count: int) -> Explanation:
    """Return what is reported of an alternative after its trial, one of ``count``, with the chance of (14)."""
    inputs = after.alternative
    by_fit = log_chance_of_ratio(after.reduced / original.reduced, after.freedom)
    chance = math.exp(min(min(by_fit, log_chance_of_place(original, after)) + math.log(count), 0.0))
    values = dict(inputs.values)
    if inputs.effects:
        (effect,) = inputs.effects  # an alternative differs by one mistake
        values["off"] = [
            f"{name.rpartition('.')[2]} {UNITS[unit].scale.text(size, '.3g')}"
            for name, unit, size in zip(
                after.problem.names, after.problem.units, after.x - after.problem.start, strict=True
            )
            if name == str(effect) or name.startswith(f"{effect}.")
        ]
    return Explanation(inputs.code, values, inputs.rows.size, original.rms, after.rms, chance)


def is_elsewhere(estimate: Estimate) -> bool:
    """Return whether parameters moved far from their described values: wrong labels may rotate a fixture.

    If the observations hardly determine one of them, such as the turn of the base about nearly collinear chucks, it may
    be far away with correct labels, and others follow it along its arc.
    """
    p = estimate.n_robot_parameters
    wide = np.array([UNITS[unit].wide_sigma for unit in estimate.units[:p]])
    moved = np.abs(estimate.value - estimate.nominal)[:p]
    displaced = moved > FAR * wide
    sigma = np.nan_to_num(estimate.sigma[:p])  # NaN: not identifiable
    return bool(displaced.any() and (moved > SURELY * sigma)[displaced].all())


def _unusable(estimate: Estimate) -> Unusable | None:
    if _unconverged(estimate):
        return Unusable.NOT_CONVERGED
    if not estimate.chi2_freedom >= LEAST_FREEDOM:
        return Unusable.NO_FREEDOM
    if any(explanation.code == HELD for explanation in estimate.explanations):
        return None
    if estimate.explanations:
        return Unusable.WRONG_INPUTS
    return Unusable.RESIDUALS if _beyond(estimate, "wide_sigma") else None


def _unconverged(estimate: Estimate) -> bool:
    return estimate.status != "converged" and not SOLVERS[estimate.solver].ends_by_recipe


def _beyond(estimate: Estimate, tolerance: str) -> bool:
    """Return whether the rows used have an RMS beyond a tolerance that the declared noise does not explain."""
    if estimate.chi2_reduced <= estimate.chi2_band[1]:
        return False
    figures = Figures.by_unit(estimate.residual, estimate.used)
    return any(of_unit.rms > getattr(UNITS[unit], tolerance) for unit, of_unit in figures.items())
