"""Systematic errors in the residuals of a finished fit: what was off, from which row on, and by how much.

**Score test.** Let e (m,) be the whitened residuals, J their derivatives by all free parameters, and Q an orthonormal
basis of J's columns. Prior information about the rig enters as additional rows. A prior of the robot does not: a false
one would be reported as a systematic error. An item that is off has the whitened derivatives C (m, d): by a chuck's
coordinates, a bar's zero, a joint's reading or a motion of the base, each times a profile over the rows. With
C⊥ = (I − QQᵀ)C,

    V = C⊥ᵀC⊥ = CᵀC − (QᵀC)ᵀ(QᵀC) ,  β̂ = V⁺ Cᵀe⊥ ,  drop of χ² = eᵀC⊥ V⁺ C⊥ᵀe ~ χ²(rank V) without the error.

The drop is exactly that of refitting the linear problem with β free (added variables; Cook and Weisberg 1982, Rao
1948). Anything that the parameters can follow, such as a motion of all chucks that the base's parameters undo, has no
part in C⊥.

**Change points.** A step that begins at row k needs the sums of CᵀC, QᵀC and Cᵀe over the rows from k on, which are
differences of one cumulative sum. All steps of an item therefore cost as much as one. A joint that is off over an
interval of rows is searched for between every two of WINDOW_KNOTS, then between their neighbours row by row. A ball that
is not seated makes a bar longer in one run of rows with the same items mounted.

**Drifts.** A drift is linear in time, from the first row of a session to its last, or linear in the box's temperature
if that changed. Its zero is unknown, so an offset is fitted with it.

**Last moves.** An error of a joint that is linear in the direction of its last move (backlash) or in the move itself. A
joint at a large angle has probably come from a smaller one, so only the part of these is tested that cubic polynomials of
the joint readings do not follow. On a regular path even this part follows what the model lacks, such as curves of gears:
in a grid of a UR10 it explained 2.6 % of χ² for a joint that has no such error once the curves are fitted. Where the noise
does not explain χ², less than LEAST_SHARE of it is therefore not reported.

**Blocks.** Rows that do not fit the rest: each first or last part of a run of rows with one item mounted. Leaving e_B
out reduces χ² by e_BᵀQ_B(I − Q_BᵀQ_B)⁻¹Q_Bᵀe_B + e_Bᵀe_B, which is χ² with as many degrees of freedom as e_B has
residuals.

**Multiplicity.** A family is all candidates of one item and form, such as "a step of chuck c2". By Bonferroni's
inequality, first within the family and then over the families, P(max over k > u) ≤ Σ P(χ²_k > u), the probability that
a clean data set gives any finding is at most LEVEL, regardless of how the candidates depend on each other.

**Which of several.** Steps of a chuck, of a sphere and of a joint explain much of the same residuals. Of those beyond
chance the most probable is reported. Each number of an item has the weak prior of its unit (``units``) and every start
row of a step is equally probable, so the logarithm of the evidence is ½ drop − ½ Σ log(1 + λ) − log(candidates), with λ
the eigenvalues of V in units of that prior (Kass and Raftery 1995). Candidates at least a hundredth as probable are
reported with it. An item that would have to be off by more than MOST_OFF, such as a bar with a gain near 0 that makes all
lengths alike, explains nothing.

**Steps and gradual changes.** A zero that wanders for an hour looks like a step at some row, and as certain. With each
step, the evidence of a random walk of the same item, and of each that can drift, is therefore compared. One of the same
item that is not less probable, or of another one at least a hundredth as probable, is among the other explanations.

**Several errors.** The columns of the best finding are added to Q and the rest is searched again, until nothing beyond
chance is left. Then each finding is tested again with all others as parameters. If one is not beyond chance any more,
because another one explains the same residuals, the least probable is dropped and the search continues without its
family. The reported figures are those of this joint test.

**Gross errors.** If GROSS σ distort a fit, the first-order analysis shows only which rows distort it, so only blocks
are searched.

**Rows of one pose** have correlated errors: the arm's repeatability at that pose, and errors that the model lacks. Where
they could add more than MOST_SHARED to the variance of a sum over the rows, or χ²/ν is out of its range even with the
findings as parameters, a finding must also be beyond chance by the spread of its poses' scores. Their sum of squares
takes the place of V, with each residual from a fit without its pose, e_g → (I − H_gg)⁻¹e_g, because a few poses attract
the fit (the jackknife, CR3: Bell and McCaffrey 2002). The statistic follows Hotelling's T² with

    η = d(d + 1) / Σ_g [(tr W_g)² + tr W_g²]

degrees of freedom, where W_g is the share of pose g in V (Pustejovsky and Tipton 2018), or with those that the scores'
fourth moments show, if these are fewer: then some poses are noisier. A step in few poses is therefore hardly ever beyond
chance. Of a block, a pose counts as one residual.

**Where the model is wrong anyway.** If χ²/ν is outside its range, the noise is unknown. A drop with d degrees of
freedom is then tested against the remaining unexplained variance, F(d, ν − d), and in the joint test again by poses as
above. Along a path, poses that follow each other are close together, so smooth model errors are correlated in the order
of measurement and can mimic steps in it. The variance of every sum over that order is therefore multiplied by 1 + 2 Σ
ρ_k, with ρ_k the autocorrelation of the remaining residuals at a lag of k poses, summed as long as it is beyond chance
(Bartlett 1946). The rows of a block must be off by more than NOISIER times the noise of the others, because noise can
differ between rows. A finding must also reduce the sum of squares of rows held out in contiguous stretches of the order
by SURE standard errors, paired by pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.prediction import FIRST_ORDER, MOST_POSES
from truearm.estimate.problem import Problem
from truearm.estimate.systematic_candidates import blocks_of_rows, families, searched
from truearm.estimate.systematic_confirmation import confirmed, held_out_squares, judging_rows
from truearm.estimate.systematic_effects import Errors
from truearm.estimate.systematic_score import (
    Best,
    FitChi2,
    Fitted,
    Measured,
    ScoreTest,
    effect_columns,
    effect_of,
    span_in_table,
    unfollowed,
    whiten_rows,
)
from truearm.model.chain import Chain, forward
from truearm.results import OffBy, SystematicError, SystematicErrors
from truearm.types import Floats, rms
from truearm.units import UNITS

GROSS = 30.0  # σ of the noise: to first order, a fit this distorted shows only which rows distort it


def systematic_errors(
    problem: Problem,
    x: Floats,
    columns: NDArray[np.bool_],
    fit: Fitted,
    goodness: FitChi2,
    how: Measured,
    q: Floats,
) -> SystematicErrors | None:
    """Return the errors beyond chance in a fit of the problem's ``columns`` that ended at x (P,).

    They are in the order of the search, each the most probable one given those before it. If the joint test drops one,
    the whole search is repeated without its family, from the findings that are left. The module docstring describes the
    tests. ``q`` (n, j) are the joint readings of the rows.

    None if nothing is found, if the findings move the end too far for tests of first order, and for a fit without degrees
    of freedom or with residuals that are not finite.
    """
    rows = whiten_rows(problem, x, columns, fit)
    if not (rows.row.size and goodness.freedom >= 1.0 and np.isfinite([goodness.chi2, *rows.residual]).all()):
        return None
    gross = goodness.chi2 > GROSS**2 * goodness.freedom
    every = [] if gross else [of.summed(problem.errors, rows, how) for of in families(problem, rows, how)]
    every += blocks_of_rows(how)
    test = ScoreTest(problem.errors, rows, how, goodness, math.log(max(len(every), 1)))
    found: list[Best] = []
    while True:
        likely, together = searched(found, every, test)
        found, after = confirmed(likely, test, together)
        dropped = [one.family for one in likely if all(one.family is not of.family for of in found)]
        if not dropped:
            break
        every = [family for family in every if all(family is not of for of in dropped)]
        test = test._replace(inflation=after.inflation)
    if not found:
        return None
    described, part = _described(found, test, after.state)
    shift = np.zeros(x.size)
    shift[columns] = -fit.root @ part
    if _beyond_first_order(problem.chain, x, shift, q):
        return None
    before, left = (held_out_squares(of, how)[judging_rows(after.rows, how)].sum() for of in (rows, after.rows))
    ratio = math.sqrt(left / before) if before > 0.0 else math.nan
    reduced = after.state.chi2 / max(after.state.freedom, 1.0)
    return SystematicErrors(described, reduced, shift, held_out_ratio=ratio)


def with_robot_prior(
    found: SystematicErrors | None, columns: NDArray[np.bool_], root: Floats, half: Floats
) -> SystematicErrors | None:
    """Return the findings with the shift of a fit that has a prior of the robot; the tests are those of a fit without it.

    Without the prior, the shift is large along combinations that the rows hardly determine: the prior holds them.
    ``root`` (r, k) is R of the rows and the rig's prior for the ``columns``, ``half`` (k, s) is S with S Sᵀ the covariance
    of the fit with all priors. The gradient RᵀR Δ is that of the rows, so the step is S Sᵀ RᵀR Δ.
    """
    if found is None:
        return None
    shift = found.shift.copy()
    shift[columns] = half @ (half.T @ (root.T @ (root @ shift[columns])))
    return replace(found, shift=shift)


def moves(chain: Chain, x: Floats, there: Floats, q: Floats) -> float:
    """Return the RMS distance [m] over the poses between the end's origins for the parameters of x and of ``there``."""
    p = len(chain.parameters)
    apart = forward(chain, there[:p], q)[:, :3, 3] - forward(chain, x[:p], q)[:, :3, 3]
    return rms(np.linalg.norm(apart, axis=1))


def _beyond_first_order(chain: Chain, x: Floats, shift: Floats, q: Floats) -> bool:
    """Return whether a shift (P,) of x moves the end too far for tests of first order, over the poses q (n, j).

    Where only the distance of two sockets determines the scale, for example, an error that frees it explains everything
    by an arm that shrinks to a point. No finding is then kept: without the one that moves the end farthest, other items
    seem to be off instead.
    """
    q = q[:: -(-len(q) // MOST_POSES)]
    farthest = np.linalg.norm(forward(chain, x[: len(chain.parameters)], q)[:, :3, 3], axis=1).max()
    return bool(moves(chain, x, x + shift, q) > FIRST_ORDER * farthest)


def _described(found: Sequence[Best], test: ScoreTest, after: FitChi2) -> tuple[tuple[SystematicError, ...], Floats]:
    """Return the findings with their sizes, from a fit of all of them together, and their effect (r,) along Q.

    ``after`` is χ² of that fit.
    """
    errors, rows, how = test.errors, test.rows, test.how
    parts = [effect_columns(best, errors, rows, how) for best in found]
    by = np.concatenate(parts, axis=1)
    values, vectors, seen = unfollowed(by.T @ by, rows.along(by))
    root = vectors[:, seen] / np.sqrt(values[seen])
    scale = 1.0 if after.explained else max(math.sqrt(after.chi2 / max(after.freedom, 1.0)), 1.0)
    value, covariance = root @ (root.T @ (by.T @ rows.residual)), scale**2 * root @ root.T
    unseen = np.abs(vectors[:, ~seen]).max(axis=1, initial=0.0) > 1e-6 * np.abs(vectors).max(axis=1)
    out, at = [], 0
    for best, part in zip(found, parts, strict=True):
        numbers = () if best.family.cause is None else best.family.cause.numbers
        mine = slice(at, at + (len(numbers) or part.shape[1]))  # for a drift, without its offset
        at += part.shape[1]
        off_by = _off_by(numbers, errors, value[mine], covariance[mine, mine], unseen[mine])
        chance = math.exp(min(best.log_p + test.log_families, 0.0))
        span, effect = span_in_table(best.first, best.last, how), effect_of(best, how)
        (first, last), (first_most, last_most) = (span_in_table(*of, how) for of in zip(*best.within, strict=True))
        within = (first, first_most), (last, last_most)
        out.append(SystematicError(effect, span, within, *off_by, best.drop, best.freedom, chance, best.rivals))
    return tuple(out), rows.basis.T @ (by @ value)


def _off_by(
    numbers: Sequence[str], errors: Errors, value: Floats, covariance: Floats, unseen: NDArray[np.bool_]
) -> tuple[tuple[OffBy, ...], str, float, float]:
    """Return the error of each number, and the norm ± σ of those that are identifiable and have the first one's unit."""
    if not numbers:
        return (), "", math.nan, math.nan
    units = [errors.unit(number) for number in numbers]
    weak = np.array([UNITS[unit].weak_sigma for unit in units])
    value = np.where(unseen, math.nan, value * weak)
    sigma = np.where(unseen, math.nan, weak * np.sqrt(np.diag(covariance)))
    alike = np.array([unit == units[0] for unit in units]) & ~unseen
    off_by = tuple(map(OffBy, numbers, units, value.tolist(), sigma.tolist()))
    if not alike.any():
        return off_by, units[0], math.nan, math.nan
    size = float(np.linalg.norm(value[alike]))
    along = value[alike] / size if size > 0.0 else np.zeros(int(alike.sum()))
    spread = (covariance * np.outer(weak, weak))[np.ix_(alike, alike)]
    return off_by, units[0], size, math.sqrt(float(along @ spread @ along))
