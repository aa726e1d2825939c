"""A quick fit of some rows, to compare interpretations of the inputs with each other under one wide prior.

The robot's parameters have the tolerance of manual mounting (``prior.wide_prior``), base and tool a metre and a radian.
Anything that a wrong interpretation would need beyond that is implausible. All interpretations are judged alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.estimate.fit import fit
from truearm.estimate.frame_choice import mounting
from truearm.estimate.information import half, observe, spectrum
from truearm.estimate.levenberg_marquardt import idle
from truearm.estimate.prior import wide_prior
from truearm.estimate.problem import Problem, build_problem, modelled_of
from truearm.estimate.solution import Options, of_data
from truearm.estimate.uncertainty import goodness, prior_shares
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Effect, Figures
from truearm.types import Floats, Residuals, Rigs
from truearm.units import UNITS

# Wrong inputs are wrong by centimetres: the last thousandth of χ² in a curved valley is not worth its evaluations.
STEPS = 20
STEPS_TO_PLACE = 8  # if only base, tool and rig are placed
WORTH = 0.01  # of χ², by all of the last steps
RECENT = 3  # steps, of which the best one is taken for all those left


class Trial(NamedTuple):
    """A fit of ``n_residuals`` residuals of rows: χ²/ν, ν, RMS by SI unit, and every parameter by name.

    ``moved`` is the displacement of base or tool from the described pose, and ``shifted`` that of any other parameter
    of the robot, in tolerances of manual mounting. ``off`` is how far each fitted parameter is from its start.
    """

    reduced: float
    freedom: float
    rms: Mapping[str, float]
    known: Mapping[str, float]
    moved: float
    shifted: float
    names: tuple[str, ...]  # k fitted parameters
    off: Mapping[str, float]
    root: Floats  # (k, r): its product with its transpose is their covariance
    n_residuals: int


def placed(chain: Chain, rig: Rigs, table: ObservationTable, goal: float = 0.0) -> Trial:
    """Return the nominal robot with base, tool and rig fitted to the rows. Raises ProblemError.

    A fit that will not reach a χ²/ν of ``goal`` is of no use, and may end early.
    """
    return _trial(chain, rig, table, np.zeros(len(chain.parameters), dtype=bool), None, goal=goal)


def fitted(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    free: NDArray[np.bool_],
    effects: Sequence[Effect] = (),
    start: Trial | None = None,
    goal: float = 0.0,
) -> Trial:
    """Return the fit of the robot's ``free`` (p,) parameters, base, tool and rig to the rows. Raises ProblemError.

    ``effects`` are errors that are fitted too, without a limit on their size. ``goal`` is as for ``placed``.
    """
    return _trial(chain, rig, table, free, start or placed(chain, rig, table), effects, goal)


def trial_problem(
    chain: Chain, rig: Rigs, table: ObservationTable, free: NDArray[np.bool_], effects: Sequence[Effect] = ()
) -> tuple[Problem, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the problem, its fitted columns (P,), and the robot's parameters (p,) that place base or tool."""
    mounted = mounting(chain, chain.params_nominal).either
    prior = np.where(mounted, [UNITS[p.unit].vague_sigma for p in chain.parameters], wide_prior(chain))
    modelled = modelled_of(chain, rig, table, effects)
    problem = build_problem(chain, rig, table, prior, modelled)
    named = np.isin(problem.names, [one.effect.parameter(one.column) for one in modelled])
    vague = np.where(named, [UNITS[unit].vague_sigma for unit in problem.units], problem.prior_sigma)
    return replace(problem, prior_sigma=vague), problem.columns(free | mounted), mounted


def _trial(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    free: NDArray[np.bool_],
    start: Trial | None,
    effects: Sequence[Effect] = (),
    goal: float = 0.0,
) -> Trial:
    params = chain.params_nominal
    problem, columns, mounted = trial_problem(chain, rig, table, free, effects)
    count = sum(len(group.sensor_cov) * len(group.COMPONENTS) for group in problem.groups)
    if start is None:
        x = problem.start
        if problem.of_rig.any():
            x = fit(problem, problem.of_rig, x, _options(STEPS_TO_PLACE)).x
        found = fit(problem, columns, x, _options(STEPS_TO_PLACE, goal * count))
    else:
        found = fit(problem, columns, problem.at(start.known), _options(STEPS, goal * count))
    root = half(spectrum(found.information.root))
    quality = goodness(*of_data(problem, columns, found), prior_shares(root, found.prior_sigma))
    rms = {unit: figures.rms for unit, figures in Figures.by_unit(found.information.residual).items()}
    moves = np.abs(found.x[: free.size] - params) / wide_prior(chain)
    known = dict(zip(problem.names, found.x.tolist(), strict=True))
    off = dict(zip(problem.names, (found.x - problem.start).tolist(), strict=True))
    names = tuple(problem.names_of(columns))
    moved, shifted = (float(moves[of].max(initial=0.0)) for of in (mounted, ~mounted))
    return Trial(quality.reduced, quality.freedom, rms, known, moved, shifted, names, off, root, count)


def _options(steps: int, goal: float = 0.0) -> Options:
    """Return the options of a fit that only tells right from wrong inputs, which by a χ² above ``goal`` are wrong."""
    idles = idle(WORTH)

    def ends(chi2: Sequence[float]) -> bool:
        if idles(chi2):
            return True
        if len(chi2) <= RECENT:
            return False
        best = min(b / a for a, b in pairwise(chi2[-1 - RECENT :]))
        return chi2[-1] * best ** (steps + 1 - len(chi2)) > goal > 0.0

    return Options(max_iterations=steps, correctors=0, ends=ends)


def misfit(chain: Chain, rig: Rigs, table: ObservationTable, known: Mapping[str, float]) -> Floats:
    """Return squares (n,) of the rows' residuals with a trial's parameters, in units of a drawing's tolerances.

    NaN for rows that use parameters not in the trial. Raises ProblemError.
    """
    problem = build_problem(chain, rig, table)
    nothing = np.zeros(len(problem.names), dtype=bool)
    return square(observe(problem, problem.at(known), nothing).residual)


def square(residual: Residuals) -> Floats:
    """Return squares (n,) of rows' residuals in units of a drawing's tolerances, over all units."""
    parts = [(of / UNITS[unit].weak_sigma) ** 2 for unit, of in residual.items()]
    return np.asarray(np.nansum(parts, axis=0))


def tried(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    free: NDArray[np.bool_],
    effects: Sequence[Effect] = (),
    start: Trial | None = None,
    goal: float = 0.0,
) -> Trial | None:
    """Return the result of ``fitted``; None if rows and robot do not define a problem, or nothing is fitted."""
    try:
        with np.errstate(all="ignore"):
            found = fitted(chain, rig, table, free, effects, start, goal)
    except (ProblemError, np.linalg.LinAlgError):
        return None
    return found if np.isfinite(found.reduced) else None
