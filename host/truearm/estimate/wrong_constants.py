"""Constants of the rig that are wrong in all rows: a chuck that was entered 20 mm away, a bar with another zero.

The score test (``systematic``) is linear, so it does not apply to errors of centimetres, which distort the fit. Here
each item is freed in a quick fit of its own (``trial_fit``), which displaces it by the whole error. The derivatives at
the fit without any error rank the items first, and only the MOST_FITTED that would reduce χ² most are fitted. An item is
named if it explains the observations (``better_fit``), with all items counted as tried. How far base, tool and the item
itself are from their places counts against it in the evidence, in tolerances of manual mounting.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence

import numpy as np

from truearm.estimate.better_fit import HUNDREDFOLD, Found, explains, found_in
from truearm.estimate.information import observe, spectrum, with_prior
from truearm.estimate.information import seen as significant
from truearm.estimate.problem import build_problem
from truearm.estimate.solution import prior_error
from truearm.estimate.systematic_effects import Cause
from truearm.estimate.ties import largest_first
from truearm.estimate.trial_fit import Trial, trial_problem, tried
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Effect, WrongInput
from truearm.text import counted
from truearm.types import Floats, Mask, Rigs
from truearm.units import UNITS, Unit

MOST_FITTED = 4


def wrong_constants(
    chain: Chain, rig: Rigs, table: ObservationTable, free: Mask, before: Trial, allowed: Collection[str] = ()
) -> Iterator[Found]:
    """Return the items that explain the rows if they are elsewhere than the rig says.

    ``before`` is the fit with the rig as given. Items that are ``allowed`` to be off are not tried.
    """
    problem = build_problem(chain, rig, table)
    vague = dict(zip(problem.names, np.isinf(problem.prior_sigma), strict=True))
    causes = [
        cause
        for cause in problem.causes
        if cause.fault.constant
        and cause.name not in allowed
        and not all(vague.get(number, False) for number in cause.numbers)
    ]
    for cause in _likely(causes, chain, rig, table, free, before):
        after = tried(chain, rig, table, free, [Effect(cause.name)], before, HUNDREDFOLD * before.reduced)
        if after is None or not explains(before, after, len(causes)):
            continue
        units = [UNITS[problem.errors.unit(number)] for number in cause.numbers]
        text, allow = _text(cause, units, before, after), str(Effect(cause.name))
        far = max(abs(after.off[number]) / unit.wide_sigma for number, unit in zip(cause.numbers, units, strict=True))
        after = after._replace(moved=max(after.moved, far))
        found = found_in(WrongInput.CONSTANT, text, len(table), before, after, len(causes))
        explanation = found.explanation._replace(allow=allow)
        yield Found(explanation, after, found.score + after.moved**2 / len(table))


def _likely(
    causes: list[Cause], chain: Chain, rig: Rigs, table: ObservationTable, free: Mask, before: Trial
) -> list[Cause]:
    """Return the causes that would reduce χ² most, by the derivatives at the fit ``before``."""
    if len(causes) <= MOST_FITTED:
        return causes
    problem, columns, _ = trial_problem(chain, rig, table, free, [Effect(cause.name) for cause in causes])
    x = problem.at(before.known)
    seen = with_prior(observe(problem, x, columns), *prior_error(problem, columns, x))
    names = problem.names_of(columns)
    mine = [np.isin(names, cause.numbers) for cause in causes]
    parts = spectrum(seen.root[:, ~np.any(mine, axis=0)])
    followed = parts.u[:, : parts.singular.size][:, significant(parts)]
    drops = [_drop(seen.root[:, of], seen.rhs, followed) for of in mine]
    return [causes[i] for i in largest_first(drops)[:MOST_FITTED]]


def _drop(by: Floats, rhs: Floats, followed: Floats) -> float:
    """Return the drop of χ² by more columns (k, d) than those whose span is ``followed`` (k, r)."""
    rest = by - followed @ (followed.T @ by)
    along = np.linalg.lstsq(rest, rhs, rcond=None)[0]
    return float(rhs @ (rest @ along))


def _text(cause: Cause, units: Sequence[Unit], before: Trial, after: Trial) -> str:
    """Return by how much the item is off: the norm of the numbers in the unit of the first, and each number."""
    alike = [number for number, unit in zip(cause.numbers, units, strict=True) if unit is units[0]]
    off = np.array([after.off[number] for number in alike])
    at_these = [after.names.index(number) for number in alike]
    size = float(np.linalg.norm(off))
    sigma = float(np.linalg.norm((off / size if size > 0.0 else off) @ after.root[at_these]))
    scale = units[0].scale
    each = ", ".join(
        f"{number.rpartition('.')[2]} {unit.scale.text(after.off[number], '.3g')}"
        for number, unit in zip(cause.numbers, units, strict=True)
    )
    more = counted(len(cause.numbers), "further parameter")
    return (
        f"{cause.name} differs from the rig by {scale.text(size, '.3g')} (σ {scale.text(sigma, '.2g')}; {each}) in all rows; "
        f"χ² falls from {_chi2(before)} to {_chi2(after)} with {more}"
    )


def _chi2(trial: Trial) -> str:
    return f"{trial.reduced * trial.freedom:.{4 if math.isfinite(trial.reduced) else 1}g}"
