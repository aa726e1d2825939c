"""A forecast of how well an identification with error curves would determine them, before measuring.

Curves are linear in their coefficients, so their covariance depends on the poses and not on the readings. Their prior
here is fixed and has the size found on real arms (docs/explanation/real-arms.md): TYPICAL at lengths of 0.1 to 0.2 rad.
The noise is the declared one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.circumstances import poses
from truearm.estimate.law_candidates import LENGTHS, candidates, gravity_of, law_priors
from truearm.estimate.law_curves import SampledCurve, sampled_curves
from truearm.estimate.law_fit import Learned, law_problem, posterior
from truearm.estimate.pose_noise import PoseNoise
from truearm.estimate.problem import build_problem
from truearm.estimate.solvers import LawMode
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.model.joint_law import terms
from truearm.model.law_chain import with_laws
from truearm.plan.forecast import Knowledge, all_rows
from truearm.types import rms

TYPICAL = 2e-4  # rad, at each of the lengths
TYPICAL_LENGTHS = (0.1, 0.2)  # rad
UNSEEN = 0.7  # of the prior's standard deviation: above it the poses carry almost no information
LEAST_GAP = math.radians(3.0)
SECTION = math.radians(30.0)


@dataclass(frozen=True)
class CurveForecast:
    """The forecast of a joint's error curve from planned rows.

    ``ranges``: the readings [rad] that planned poses cover, in sections of at most SECTION, each with the RMS standard
    deviation [rad] of the curve; ``sigma`` [rad]: the same over all of them; ``unseen`` [rad]: ranges of readings
    between the lowest and the highest that the poses do not determine.
    """

    joint: str
    ranges: tuple[RangeSigma, ...]
    sigma: float
    unseen: tuple[tuple[float, float], ...]


class RangeSigma(NamedTuple):
    """A range of a joint's readings [rad], and the RMS standard deviation [rad] of its error curve there."""

    lower: float
    upper: float
    sigma: float


def curve_forecasts(knowledge: Knowledge, planned: ObservationTable) -> tuple[CurveForecast, ...]:
    """Return a forecast for every joint that would have an error curve."""
    table = all_rows(knowledge, planned)
    chain, n = _geometry(knowledge)
    laws, _ = candidates(chain, table.q, LawMode.CURVE, gravity_of(table, None))
    if not laws:
        return ()
    with_curves = with_laws(chain, laws)
    problem = build_problem(with_curves, knowledge.rig, table)
    added = len(with_curves.parameters) - n
    columns = np.ones(problem.start.size, dtype=bool)
    columns[:n] = knowledge.free[:n]
    start = problem.start.copy()
    start[:n] = knowledge.params[:n]
    laws_problem = law_problem(problem, columns, start, poses(table), law_priors(chain, laws, table.q))
    prior = np.where(np.isin(LENGTHS, TYPICAL_LENGTHS), TYPICAL**2, 0.0)
    noise = PoseNoise.of(1.0, len(chain.joints))
    learned = posterior(laws_problem, Learned(dict.fromkeys(laws, prior), noise, {}, math.nan, laws_problem.start))
    covariance = np.zeros((n + added, n + added))
    free = np.flatnonzero(columns[: n + added])
    covariance[np.ix_(free, free)] = learned.covariance[: free.size, : free.size]
    curves = sampled_curves(with_curves, laws, np.zeros(n + added), covariance)
    return tuple(_forecast(curve, UNSEEN * math.sqrt(prior.sum())) for curve in curves)


def _forecast(curve: SampledCurve, unseen: float) -> CurveForecast:
    """Return the forecast of a curve with its standard deviations; those above ``unseen`` [rad] carry no information."""
    readings, sigma = curve.readings, curve.sigma
    between = (readings >= curve.intervals[0][0]) & (readings <= curve.intervals[-1][1])
    sections = [
        section
        for run in _runs(curve.covered)
        for section in np.array_split(run, math.ceil(float(np.ptp(readings[run])) / SECTION) or 1)
    ]
    ranges = tuple(
        RangeSigma(float(readings[rows[0]]), float(readings[rows[-1]]), rms(sigma[rows])) for rows in sections
    )
    gaps = [readings[run] for run in _runs(between & (~curve.covered | (sigma > unseen)))]
    unseen_ranges = tuple((float(gap[0]), float(gap[-1])) for gap in gaps if np.ptp(gap) >= LEAST_GAP)
    return CurveForecast(curve.joint, ranges, rms(sigma[curve.covered]), unseen_ranges)


def _runs(flags: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the indices of each run of True."""
    rows = np.flatnonzero(flags)
    return np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if rows.size else []


def _geometry(knowledge: Knowledge) -> tuple[Chain, int]:
    """Return the chain without the laws that an earlier result added, and its number of parameters."""
    learned = {term.name for term in terms() if term.learned}
    geometric = tuple(p for p in knowledge.chain.parameters if p.term not in learned)
    return replace(knowledge.chain, parameters=geometric), len(geometric)
