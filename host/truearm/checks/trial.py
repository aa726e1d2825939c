"""Quick fits of some rows, which compare interpretations of the inputs under one wide prior.

The robot's parameters have the tolerances of manual mounting (``prior.wide_prior``), base and tool a metre and a
radian. The formulas are in docs/explanation/hypotheses.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from truearm.checks.evidence import log_beta
from truearm.errors import ProblemError
from truearm.estimate.fit import fit
from truearm.estimate.frame_choice import mounting
from truearm.estimate.information import observe
from truearm.estimate.levenberg_marquardt import DAMPING_START, Damping, Ends
from truearm.estimate.problem import Problem, build_problem
from truearm.estimate.solution import Options, goodness_of, rms_of
from truearm.estimate.uncertainty import wide_prior
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Effect
from truearm.types import Floats, Indices, Mask, Rigs, thinned
from truearm.units import UNITS

FEW_ROWS = 60  # that rank interpretations before the robot is fitted
MOST_ROWS = 200  # of a fit of the robot
STEPS = 20
STEPS_TO_PLACE = 8  # if only base, tool and rig are placed
DAMPING = 3e-3  # at the start: full steps far from the minimum are refused, but readings that are a tenth need some
WORTH = 0.01  # of χ², by all of the last steps: wrong inputs are wrong by centimetres
LEVEL = 1e-3  # probability that any interpretation explains correct inputs
HUNDREDFOLD = 0.01  # of χ²
FAR, NEAR = 10.0, 3.0  # tolerances of manual mounting: 100 mm or 0.5 rad, 30 mm or 0.16 rad
AS_WELL = 2.0  # of χ²
LARGEST_SHIFT = 5.0  # tolerances of manual mounting: the paper's PUMA differs by 1.3


@dataclass(frozen=True)
class Alternative:
    """An interpretation of the inputs, and the finding if it explains the observations.

    ``rows`` (m,) of the table are those that it explains. It multiplies the numbers of ``rescaled`` columns by factors.
    ``price`` [nats] is the logarithm of the number of ways from which the rows have chosen it, or of the odds against
    several mistakes.
    """

    chain: Chain
    rig: Rigs
    table: ObservationTable
    free: Mask  # (p,)
    rows: Indices
    code: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)
    effects: tuple[Effect, ...] = ()
    rescaled: Mapping[str, float] = field(default_factory=dict)
    price: float = 0.0


@dataclass(frozen=True)
class Trial:
    """A fit of an alternative that ended at x (P,): g χ²/ν with the Jacobian g of formula (13), ν, and RMS by SI unit.

    ``moved`` is the displacement of base or tool, and of an item of the rig with an effect, from the described place;
    ``shifted`` that of any other parameter of the robot; both in tolerances of manual mounting.
    """

    alternative: Alternative
    problem: Problem
    x: Floats
    reduced: float
    freedom: float
    rms: Mapping[str, float]
    moved: float
    shifted: float

    @property
    def parameters(self) -> dict[str, float]:
        return dict(zip(self.problem.names, self.x.tolist(), strict=True))

    @property
    def displacement(self) -> float:
        return max(self.moved, self.shifted)

    @property
    def plausible(self) -> bool:
        """Whether the residuals are within the tolerances of a drawing."""
        return all(rms <= UNITS[unit].weak_sigma for unit, rms in self.rms.items())


def log_evidence(before: Trial, after: Trial) -> float:
    """Return the logarithm of the evidence for an alternative, up to a constant.

    Rows that it leaves out gain nothing.
    """
    share = after.alternative.rows.size / before.alternative.rows.size
    gain = math.log(before.reduced / max(after.reduced, 1e-300))
    return 0.5 * (share * after.freedom * gain - after.displacement**2) - after.alternative.price


def log_chance_of_ratio(ratio: float, freedom: float) -> float:
    """Return the log probability that two mean squares of equal ``freedom`` have a ratio of at most ``ratio``."""
    half_freedom = np.array(max(freedom, 1.0) / 2.0)
    return float(log_beta(half_freedom, half_freedom, np.array(ratio / (1.0 + ratio))))


def log_chance_of_place(before: Trial, after: Trial) -> float:
    """Return the log probability that a right robot or rig is as far off as before, if it is where described after."""
    is_nearer = before.displacement > FAR and after.displacement < NEAR
    return float(special.log_ndtr(-before.displacement)) + math.log(2.0) if is_nearer else 0.0


def explains(before: Trial, after: Trial, count: int, least: float = HUNDREDFOLD) -> bool:
    """Return whether one of ``count`` alternatives explains the rows and is close to the described robot.

    Either its fit is far better, beyond chance. Or it is as good with the same readings, and places everything where it
    was described, while the inputs as given do not.
    """
    ratio, beyond = after.reduced / before.reduced, math.log(LEVEL / count)
    better = ratio < least and log_chance_of_ratio(ratio, after.freedom) < beyond
    nearer = not after.alternative.rescaled and ratio < AS_WELL and log_chance_of_place(before, after) < beyond
    return after.plausible and after.shifted < LARGEST_SHIFT and (better or nearer)


def trial_problem(
    chain: Chain, rig: Rigs, table: ObservationTable, free: Mask, effects: Sequence[Effect] = ()
) -> tuple[Problem, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the problem, its fitted columns (P,), and which parameters (P,) place base, tool or items with effects."""
    mounted = mounting(chain, chain.params_nominal).either
    prior = np.where(mounted, [UNITS[p.unit].vague_sigma for p in chain.parameters], wide_prior(chain))
    problem = build_problem(chain, rig, table, prior, effects)
    estimated = np.isin(problem.names, list(problem.effects))
    vague = np.where(estimated, [UNITS[unit].vague_sigma for unit in problem.units], problem.prior_sigma)
    placing = estimated | np.pad(mounted, (0, estimated.size - mounted.size))
    return replace(problem, prior_sigma=vague), problem.columns(free | mounted), placing


def placed(
    alternative: Alternative, steps: int = STEPS_TO_PLACE, start: Mapping[str, float] | None = None
) -> Trial | None:
    """Return the nominal robot with base, tool and rig fitted to a few rows; None if they define no problem.

    ``start``: parameters after fewer steps.
    """
    return _trial(alternative, np.zeros_like(alternative.free), FEW_ROWS, steps, start)


def fitted(alternative: Alternative, start: Mapping[str, float] | None = None) -> Trial | None:
    """Return the fit of the robot, base, tool and rig to some rows; None if they define no problem.

    ``start`` are parameters after ``placed``.
    """
    if start is None and (trial := placed(alternative)) is not None:
        start = trial.parameters
    return _trial(alternative, alternative.free, MOST_ROWS, STEPS, start)


def _trial(
    alternative: Alternative, free: Mask, most: int, steps: int, start: Mapping[str, float] | None
) -> Trial | None:
    """Return a fit of the ``free`` parameters to at most so many rows; None if they define no problem."""
    rows = alternative.rows[thinned(alternative.rows.size, most)]
    table, effects = alternative.table.select(rows), alternative.effects
    rescaled = alternative.rescaled.items()
    try:
        with np.errstate(all="ignore"):
            problem, columns, placing = trial_problem(alternative.chain, alternative.rig, table, free, effects)
            n = sum(len(group.sensor_cov) * len(group.COMPONENTS) for group in problem.groups)
            log_jacobian = sum(np.isfinite(table[name]).sum() * math.log(factor) for name, factor in rescaled)
            jacobian = max(math.exp(-2.0 * log_jacobian / n), 1.0)  # readings that are all alike fit in any larger unit
            solution = fit(problem, columns, problem.at(start or {}), idle_options(steps, DAMPING))
            quality = goodness_of(problem, columns, solution)
    except (ProblemError, np.linalg.LinAlgError):
        return None
    if not np.isfinite(quality.reduced):
        return None
    moves = np.abs(solution.x - problem.start) / np.array([UNITS[unit].wide_sigma for unit in problem.units])
    return Trial(
        alternative,
        problem,
        solution.x,
        jacobian * quality.reduced,
        quality.freedom,
        rms_of(solution.information.residual),
        float(moves[placing].max(initial=0.0)),
        float(moves[: free.size][~placing[: free.size]].max(initial=0.0)),
    )


def idle_options(steps: int, damping: float = DAMPING_START) -> Options:
    """Return the options of a fit that only distinguishes right from wrong inputs."""
    return Options(max_iterations=steps, damping=Damping(damping, correctors=0), ends=Ends(WORTH, predicted=WORTH))


def misfit(chain: Chain, rig: Rigs, table: ObservationTable, parameters: Mapping[str, float]) -> Floats:
    """Return squares (n,) of the rows' residuals at named parameters, in units of a drawing's tolerances.

    NaN for rows that use parameters without a value. Raises ProblemError.
    """
    problem = build_problem(chain, rig, table)
    nothing = np.zeros(len(problem.names), dtype=bool)
    residual = observe(problem, problem.at(parameters), nothing).residual
    squares = [(of_unit / UNITS[unit].weak_sigma) ** 2 for unit, of_unit in residual.items()]
    return np.asarray(np.nansum(squares, axis=0))
