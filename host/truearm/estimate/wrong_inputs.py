"""Explanations for an absurd fit: alternative interpretations of the inputs that are tried and ranked.

If a robot's residuals after identification are larger than the tolerances of a drawing (1 mm, 5 mrad), or its fit does
not converge, the cause is rarely the robot. (If a trial fit, which runs longer, ends within the tolerances, only the
iteration was stopped early.) The usual mistakes in a lab are tried:

- units: joints in degrees labelled as radians or the reverse; a measured column or the rig's points in millimetres
  labelled as metres or the reverse; readings in inches (``other_readings``, as robot and joints);
- rotations in another convention, left-handed axes, joint readings one row late or early, one joint in another unit
  (``misread_columns``);
- joints: two exchanged, their order reversed or shifted, wrong signs of any of them;
- robot: the other built-in robots with the same number of joints;
- labels: names exchanged, renamed in a cycle, or wrong in some groups of rows (``label_search``);
- stuck joint: the reading of one joint is identical to the last digit in a run of rows while others move
  (``rows_apart``, as the next one);
- set-up: the first or the last rows belong to another one (also tried if the tests for systematic errors find nothing
  though χ² is MISFIT times too large);
- bars: rows of one mount, or all rows, were measured with another bar than they name (``swapped_bars``);
- rig: one chuck, sphere, socket or bar is not where, or as long as, the rig says (``wrong_constants``);
- held parameters: too few were free, and those that are free by default explain the rest, even if only by less. Then
  the inputs are correct and the fit is as requested.

Each interpretation is fitted to the same few rows under the same wide prior (``trial_fit``); ``better_fit`` decides
whether it explains the observations.

The most probable explanation is listed first. With unknown variances, the logarithm of the evidence is −½ Σ log σ² over
the residuals; rows that an interpretation leaves out count with the variance of the given one. An interpretation that
multiplies m of n measured numbers by a factor f has the density of the numbers as given only with the Jacobian fᵐ: its
χ² is therefore multiplied by f^(−2m/n), as if its residuals were converted back. Without it, a thousandth of any
reading would fit an arm that was to stay on a plane. It never counts in favour: readings that are all alike would fit
in any larger unit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from truearm.estimate.better_fit import HUNDREDFOLD, Found, explains, found_in, some_rows
from truearm.estimate.label_search import AS_WELL, FAR, NEAR, Search, relabellings
from truearm.estimate.label_sentences import label_sentences
from truearm.estimate.misread_columns import joint_in_other_unit, likeliest, mirrored, other_rotations, shifted_rows
from truearm.estimate.other_readings import Candidate, Interpretation, in_other_units, of_other_joints, of_other_robots
from truearm.estimate.rows_apart import other_set_up, stuck_joint
from truearm.estimate.solvers import SOLVERS
from truearm.estimate.swapped_bars import other_bars
from truearm.estimate.systematic import GROSS
from truearm.estimate.ties import largest_first
from truearm.estimate.trial_fit import Trial, tried
from truearm.estimate.uncertainty import LEAST_FREEDOM
from truearm.estimate.wrong_constants import wrong_constants
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Estimate, Explanation, Figures, Relabelling, Unusable, WrongInput
from truearm.text import counted
from truearm.types import Mask, Rigs
from truearm.units import UNITS

MISFIT = 4.0  # χ²/ν: with less, rows that do not fit are not worth a search
TENFOLD = 0.1  # of χ²
NOISE_LEVEL = 0.01  # probability that declared noise alone leaves a larger χ²
MOST_NAMED = 3
SURELY = 6.0  # standard deviations, of a displacement that its own uncertainty does not explain
MOST_HELD = 6  # names of parameters
AS_LIKELY = 4.0  # χ² of explanations that are reported with the best
FAR_FETCHED = 1.0  # score of a wrong constant that is not reported beside a better explanation


def diagnosed(
    estimate: Estimate,
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    free: Mask,
    robots: Mapping[str, Candidate] | None = None,
    usual: Mask | None = None,
    allowed: Collection[str] = (),
) -> Estimate:
    """Return the estimate with explanations if it is doubtful, and with the reason if it is not usable.

    ``free`` (p,) are the parameters requested for identification, before any were fixed by default; ``usual`` (p,)
    those that the robot has free by default; ``robots`` are others to try. Items that are ``allowed`` to be off were
    fitted.
    """
    explanations: tuple[Explanation, ...] = ()
    labels = Search((), "not needed")
    finished = _finished(chain, rig, table, estimate.fitted, free) if _unconverged(estimate) else None
    if absurd(estimate) and finished is None:
        explanations, labels = explanations_of(chain, rig, table, estimate.fitted, free, robots or {}, usual, allowed)
    elif elsewhere(estimate) or (finished is not None and max(finished.moved, finished.shifted) > FAR):
        explanations, labels = _as_described(chain, rig, table, estimate.fitted, free, robots or {})
    elif estimate.chi2_reduced > GROSS**2:  # within a drawing's tolerances: only a constant can be so little wrong
        explanations = _constants(chain, rig, table, estimate.fitted, free, allowed)
    elif estimate.systematic is None and estimate.chi2_reduced > max(estimate.chi2_band[1], MISFIT):
        explanations = _apart(chain, rig, table, estimate.fitted, free)
    estimate = replace(estimate, relabellings=labels.found, relabelling_search=labels.status, explanations=explanations)
    if any(one.what is not WrongInput.HELD for one in explanations):
        # To first order about a fit that wrong inputs distort, other rows and items would seem to be off.
        estimate = replace(estimate, systematic=None)
    return replace(estimate, unusable=_unusable(estimate))


def explanations_of(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    rows: Mask,
    free: Mask,
    robots: Mapping[str, Candidate],
    usual: Mask | None = None,
    allowed: Collection[str] = (),
) -> tuple[tuple[Explanation, ...], Search]:
    """Return explanations of the ``rows`` (n,) of a table better than the given inputs, the most probable first; and labels."""
    n = int(rows.sum())
    labels = Search((), "not needed")
    given = table.select(some_rows(rows))
    before = tried(chain, rig, given, free)
    if before is None or before.freedom < 1.0:
        return (), labels
    found: list[Found] = []
    if usual is not None and (usual & ~free).any():
        # A few parameters do not show which interpretation is correct: all are judged with the robot's default free
        # set.
        held, free = usual & ~free, usual | free
        freed = Interpretation(_held(chain, held), chain, rig, given, free)
        found += _explaining(WrongInput.HELD, [freed], before, 1.0)
        before = tried(chain, rig, given, free)
        if found or before is None or before.freedom < 1.0:
            return _ranked(found), labels
    constants = list(wrong_constants(chain, rig, given, free, before, allowed))
    found += _other_bars(chain, rig, table, rows, free, before)
    if found or any(of.fit.moved < NEAR for of in constants):
        return _ranked([*found, *constants]), labels
    for what, readings in _every_reading(chain, rig, table, rows, given, free, robots):
        found += _explaining(what, readings, before)
        if found and what is not WrongInput.AXES:  # a mirrored arm may also have other signs of joints
            break
    if not found:
        found += stuck_joint(chain, rig, table, np.flatnonzero(rows), free, before)
    if not found:
        found += other_set_up(chain, rig, table, np.flatnonzero(rows), free, before)
    if all(of.explanation.what in (WrongInput.AXES, WrongInput.SET_UP) for of in found):
        # Two points exchanged that lie alike on either side of a plane are the mirror images of each other.
        labels = relabellings(chain, rig, table, rows, free, [of.fit for of in found])
        found += _by_labels(labels, table, n)
    found += constants
    return _ranked(found), labels


def _other_bars(
    chain: Chain, rig: Rigs, table: ObservationTable, rows: Mask, free: Mask, before: Trial
) -> Iterator[Found]:
    """Return the runs of rows with another bar, or the bars exchanged, that explain the observations."""
    some = some_rows(rows)
    every = other_bars(chain, rig, table, np.flatnonzero(rows), some, free)
    leave_out = {one.reading.text: one.leave_out for one in every}
    for one in likeliest([one.reading for one in every]):
        after = tried(one.chain, one.rig, one.table, one.free)
        if after is not None and explains(before, after, len(every)):
            found = found_in(WrongInput.BAR, one.text, len(one.table), before, after, len(every))
            yield found._replace(explanation=found.explanation._replace(apply=leave_out[one.text]))


def _every_reading(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    rows: Mask,
    given: ObservationTable,
    free: Mask,
    robots: Mapping[str, Candidate],
) -> Iterator[tuple[WrongInput, list[Interpretation]]]:
    """Return interpretations of each type, the most common mistake first; ``given`` are some of the ``rows`` (n,)."""
    some = some_rows(rows)
    yield WrongInput.UNITS, list(in_other_units(chain, rig, given, free))
    yield WrongInput.ROTATIONS, list(other_rotations(chain, rig, given, free))
    yield WrongInput.SHIFTED, list(shifted_rows(chain, rig, table, some, free))
    yield WrongInput.ROBOT, list(of_other_robots(chain, rig, given, robots))
    yield WrongInput.AXES, list(mirrored(chain, rig, given, free))
    yield WrongInput.JOINTS, [*of_other_joints(chain, rig, given, free), *joint_in_other_unit(chain, rig, given, free)]


def _finished(chain: Chain, rig: Rigs, table: ObservationTable, rows: Mask, free: Mask) -> Trial | None:
    """Return the fit of some ``rows`` (n,) if it is as good as with correct inputs: then the iteration ended too early."""
    fit = tried(chain, rig, table.select(some_rows(rows)), free)
    within = fit is not None and all(rms <= UNITS[unit].weak_sigma for unit, rms in fit.rms.items())
    return fit if within else None


def _as_described(
    chain: Chain, rig: Rigs, table: ObservationTable, rows: Mask, free: Mask, robots: Mapping[str, Candidate]
) -> tuple[tuple[Explanation, ...], Search]:
    """Return labels that place base and tool where they were described, and robots and units with links as described.

    The fit has no other sign of error: another robot of the same arrangement of axes fits as well, with other links, and a
    joint in another unit with another gain.
    """
    given = table.select(some_rows(rows))
    before = tried(chain, rig, given, free)
    found: list[Found] = []
    if before is not None and before.shifted > FAR:
        for what, readings in (
            (WrongInput.ROBOT, of_other_robots(chain, rig, given, robots)),
            (WrongInput.JOINTS, joint_in_other_unit(chain, rig, given, free)),
        ):
            for one in readings:
                after = tried(one.chain, one.rig, one.table, one.free, goal=AS_WELL * before.reduced)
                if after is not None and after.shifted < NEAR and after.reduced <= AS_WELL * before.reduced:
                    found.append(found_in(what, one.text, len(given), before, after, 1))
    labels = Search((), "not needed")
    if any(of.fit.moved < NEAR for of in found):  # then nothing is left for labels to explain
        return _ranked(found), labels
    if before is None or before.moved > FAR:  # else only a parameter that the rows hardly see is far off
        labels = relabellings(chain, rig, table, rows, free)
    return _ranked([*found, *_by_labels(labels, table, int(rows.sum()))]), labels


def _constants(
    chain: Chain, rig: Rigs, table: ObservationTable, rows: Mask, free: Mask, allowed: Collection[str]
) -> tuple[Explanation, ...]:
    """Return the constants of the rig that explain some ``rows`` (n,)."""
    given = table.select(some_rows(rows))
    before = tried(chain, rig, given, free)
    if before is None or before.freedom < 1.0:
        return ()
    return _ranked(list(wrong_constants(chain, rig, given, free, before, allowed)))


def _apart(chain: Chain, rig: Rigs, table: ObservationTable, rows: Mask, free: Mask) -> tuple[Explanation, ...]:
    """Return first or last ``rows`` (n,) without which the declared noise explains the others.

    A joint that steps by a degree bends a fit too far for tests of first order, but leaves less than a millimetre.
    """
    given = table.select(some_rows(rows))
    before = tried(chain, rig, given, free)
    if before is None or before.freedom < 1.0:
        return ()
    found = other_set_up(chain, rig, table, np.flatnonzero(rows), free, before, TENFOLD)
    return _ranked([of for of in found if of.fit.reduced <= _largest_by_noise(of.fit)])


def _largest_by_noise(fit: Trial) -> float:
    """Return the largest χ²/ν that declared noise alone leaves, but for a probability of NOISE_LEVEL."""
    return float(special.chdtri(fit.freedom, NOISE_LEVEL) / fit.freedom)


def absurd(estimate: Estimate) -> bool:
    """Return whether correct inputs hardly give such a fit: not converged, or residuals beyond a drawing's tolerances."""
    return _unconverged(estimate) or _beyond(estimate, "weak_sigma")


def elsewhere(estimate: Estimate) -> bool:
    """Return whether parameters moved far from their described values: wrong labels may rotate a fixture.

    If the observations hardly determine one of them, such as the turn of the base about nearly collinear chucks, it may
    be far away with correct labels, and others follow it along its arc.
    """
    p = estimate.n_robot_parameters
    wide = np.array([UNITS[unit].wide_sigma for unit in estimate.units[:p]])
    moved = np.abs(estimate.value - estimate.nominal)[:p]
    far = moved > FAR * wide
    sigma = np.nan_to_num(estimate.sigma[:p])  # NaN: not identifiable
    return bool(far.any() and (moved > SURELY * sigma)[far].all())


def _unusable(estimate: Estimate) -> Unusable | None:
    if _unconverged(estimate):
        return Unusable.NOT_CONVERGED
    if not estimate.chi2_freedom >= LEAST_FREEDOM:
        return Unusable.NO_FREEDOM
    if any(one.what is WrongInput.HELD for one in estimate.explanations):
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
    return any(of.rms > getattr(UNITS[unit], tolerance) for unit, of in figures.items())


def _explaining(
    what: WrongInput, readings: Sequence[Interpretation], before: Trial, ratio: float = HUNDREDFOLD
) -> Iterator[Found]:
    """Return the interpretations that explain the observations and reduce χ² below ``ratio`` of its value."""
    for one in readings:
        jacobian = max(math.exp(-2.0 * one.log_jacobian / before.n_residuals), 1.0)
        after = tried(one.chain, one.rig, one.table, one.free, goal=ratio * before.reduced / jacobian)
        after = after and after._replace(reduced=jacobian * after.reduced)
        if after is not None and explains(before, after, len(readings), ratio):
            yield found_in(what, one.text, len(one.table), before, after, len(readings))


def _ranked(found: Sequence[Found]) -> tuple[Explanation, ...]:
    """Return the best explanation, and those that explain as much nearly as well."""
    if not found:
        return ()
    found = [found[i] for i in largest_first([-of.score for of in found])]
    best = found[0]
    beside = [of for of in found if of.fit.reduced <= AS_LIKELY * best.fit.reduced]
    # An item far from its place, with base and tool rotated to it, is what wrong labels look like.
    beside = [
        of for of in beside if of.explanation.what is not WrongInput.CONSTANT or of.score < best.score + FAR_FETCHED
    ]
    if best.explanation.what is not WrongInput.SET_UP:
        beside = [of for of in beside if of.explanation.what is not WrongInput.SET_UP]
    ranked = [best, *(of for of in beside if of is not best)]
    return tuple(of.explanation for of in ranked[:MOST_NAMED])


def _held(chain: Chain, held: Mask) -> str:
    """Return a mask (p,) of the fixed parameters."""
    names = [name for name, one in zip(chain.parameter_names, held, strict=True) if one]
    more = f" and {len(names) - MOST_HELD} more" if len(names) > MOST_HELD else ""
    are = "is" if len(names) == 1 else "are"
    return f"{counted(len(names), 'parameter')} that the robot has free by default {are} held: {', '.join(names[:MOST_HELD])}{more}"


def _by_labels(labels: Search, table: ObservationTable, n: int) -> Iterator[Found]:
    before, after = labels.before, labels.after
    if before is not None and after is not None:
        text = "; ".join(label_sentences(labels.found, table))
        if before.moved > FAR and after.moved < NEAR and after.reduced > HUNDREDFOLD * before.reduced:
            text += "; or base or tool is mounted rotated, which the robot file should then describe"
        chance = math.exp(labels.log_chance)
        explanation = Explanation(
            WrongInput.LABELS, text, _few_in_one_run(labels.found, n), n, before.rms, after.rms, chance
        )
        yield Found(explanation, after, math.log(after.reduced / before.reduced))


def _few_in_one_run(found: Sequence[Relabelling], n: int) -> str:
    """Return the rows with a wrong label as rows to leave out, if they follow each other and are few of ``n``; otherwise ""."""
    rows = sorted(row for one in found for row in one.rows)
    together = rows[-1] - rows[0] == len(rows) - 1
    return f"{rows[0] + 1}:{rows[-1] + 1}" if together and len(rows) <= n // 2 else ""
