"""The examination of an estimate: what may be wrong beside the model's parameters, and the error that this leaves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from truearm.checks.averaging import Claim, averaged, unseen
from truearm.checks.catalogue import catalogue
from truearm.checks.evidence import Design, rows_of
from truearm.checks.noise import Kernel
from truearm.checks.search import Detection, checked, sized
from truearm.checks.whitened import WhitenedFit, whitened_fit
from truearm.estimate.measured_order import measured_order
from truearm.estimate.prediction import FIRST_ORDER, MOST_POSES, body_motion, measured_jacobian
from truearm.estimate.problem import build_problem, modelled_of
from truearm.estimate.systematic_score import span_in_table
from truearm.estimate.whitened_rows import only
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, forward
from truearm.results import MOVES, Effect, Estimate
from truearm.types import Floats, Indices, Rigs, thinned

GROSS = 30.0  # σ of the residuals: a fit this distorted shows only that the inputs are wrong


@dataclass(frozen=True)
class Finding:
    """A fault that the rows show: its names, the most probable first, and its size.

    ``or_names`` are those that no data of these poses can distinguish from the first. ``rows`` [first, after last) are
    those of the user's table, None for all. ``sizes`` ± ``sigmas`` (d,) are in SI ``units``.
    """

    names: tuple[str, ...]
    or_names: tuple[str, ...]
    rows: tuple[int, int] | None
    sizes: Floats
    sigmas: Floats
    units: tuple[str, ...]
    drop: float  # of χ²
    freedom: int
    log_evidence: float  # nats, beside no fault
    gain: float  # share of the squares of left-out rows that it removes
    gain_t: float  # in standard errors

    @property
    def name(self) -> str:
        return self.names[0]


@dataclass(frozen=True)
class Examination:
    """All findings about an estimate, in the order of the search, and the error that the tool may have.

    ``step`` (P,) applies the mean of the findings' rivals to the estimate's values; ``refused`` are beyond chance under
    the learned noise but do not predict rows that were left out; ``unseen`` cannot show in these rows.
    """

    findings: tuple[Finding, ...]
    noise: Kernel
    claim: Claim
    step: Floats
    refused: tuple[str, ...]
    unseen: tuple[str, ...]


def examined(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    estimate: Estimate,
    prior_sigma: Floats | None = None,
    effects: tuple[Effect, ...] = (),
) -> Examination | None:
    """Examine an estimate from ``identify``, with its prior (p,) of the robot and its systematic ``effects``.

    Returns None for a fit without degrees of freedom, or one distorted beyond GROSS. Findings that move the tool too far
    for an analysis of first order, such as all sockets of a place where nothing else knows the scale, are none.
    """
    fitted = estimate.fitted
    modelled = [effect.select(fitted) for effect in modelled_of(chain, rig, table, effects)]
    problem = build_problem(chain, rig, table.select(fitted), prior_sigma, modelled)
    if estimate.weight.size:
        problem = only(problem, estimate.weight[fitted] > 0.0)
    fit = whitened_fit(problem, estimate.value, estimate.free, measured_order(table, chain, fitted))
    spread = float(fit.residual @ fit.residual) / max(fit.residual.size, 1)
    if fit.residual.size <= fit.jac.shape[1] or not np.isfinite(spread) or spread > GROSS**2:
        return None
    result = checked(fit, catalogue(fit), places_of(table, fit))
    gram = tool_gram(chain, rig, table.select(fitted), estimate)
    claim = averaged(result, gram)
    if claim.shift > FIRST_ORDER * farthest(chain, estimate, table.q[fitted]):
        result = replace(result, detections=())
        claim = averaged(result, gram)
    step = np.zeros(estimate.value.size)
    step[estimate.free] = claim.step
    return Examination(
        tuple(finding_of(detection, result.build_design, fit) for detection in result.detections),
        result.build_design.kernel,
        claim,
        step,
        result.refused,
        unseen(result.table, result.build_design.variance),
    )


def farthest(chain: Chain, estimate: Estimate, q: Floats) -> float:
    """Return the largest distance [m] of the end from the base over poses q (n, j)."""
    few = q[thinned(len(q), MOST_POSES)]
    ends = forward(chain, estimate.value[: estimate.n_robot_parameters], few)[:, :3, 3]
    return float(np.linalg.norm(ends, axis=1).max())


def finding_of(detection: Detection, design: Design, fit: WhitenedFit) -> Finding:
    """Return a finding in rows of the user's table."""
    span, best = rows_of(detection.best), detection.best
    rows = None if span is None else span_in_table(*span, fit.how)
    sizes, sigmas = sized(detection, design)
    units = best.hypothesis.units
    return Finding(
        detection.names,
        detection.aliases,
        rows,
        sizes,
        sigmas,
        units,
        best.drop,
        best.freedom,
        best.log_evidence,
        *detection.gain,
    )


def places_of(table: ObservationTable, fit: WhitenedFit) -> Indices | None:
    """Return the numbers (n,) of the places of the fit's rows; None if the table has none."""
    place = table.place[fit.how.row]
    return np.unique(place, return_inverse=True)[1] if (place != "").all() else None


def tool_gram(chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate) -> Floats:
    """Return Γ (k, k) [m²]: the mean square motion of the measured points, over their poses, by the free parameters.

    A motion of all points together does not count where the observations do not determine the base.
    """
    few = table.select(thinned(len(table), MOST_POSES))
    points, flat = measured_jacobian(chain, rig, few, estimate)
    if np.abs(flat @ estimate.unseen).max(initial=0.0) > MOVES:
        body, _ = np.linalg.qr(body_motion(points))
        flat = flat - body @ (body.T @ flat)
    motion = flat[:, estimate.free]
    return np.asarray(motion.T @ motion / len(few))
