"""Error curves and sag of joints, added to an estimate of the geometry where the evidence in the data carries them.

``with_joint_laws`` begins at a least-squares estimate. Without any law that pays it is returned as it is: the noise a pose
that keeps evidence honest would spoil the geometry of an arm whose errors it mistakes for noise. Else the estimate's robot
gets the laws' parameters behind its own, fitted with everything else under the learned noise. What judges the fit (χ²)
stays against the declared noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from truearm.estimate.identify import judged, merged, modelled_of, moves, rms_of
from truearm.estimate.information import observe
from truearm.estimate.law_candidates import candidates
from truearm.estimate.law_curves import strongest_periods
from truearm.estimate.law_fit import LawProblem, Learned, Posterior, gated, law_problem, learn, posterior
from truearm.estimate.law_rows import law_rows
from truearm.estimate.law_systematic import law_systematic
from truearm.estimate.mean_error import mean_errors
from truearm.estimate.measured_order import measured_order, poses
from truearm.estimate.pose_effect import LEAST_SHARE
from truearm.estimate.pose_noise import PoseNoise
from truearm.estimate.problem import Rigs, build_problem
from truearm.estimate.solvers import SOLVERS, LawMode, Loss
from truearm.estimate.uncertainty import goodness
from truearm.estimate.whitened_rows import only
from truearm.model.chain import Chain
from truearm.model.joint_terms.curve import Curve
from truearm.model.joint_terms.sag import Sag
from truearm.model.law_chain import DOWN, with_laws
from truearm.types import (
    CurveKnots,
    Effect,
    Estimate,
    Floats,
    JointLaws,
    Law,
    LawStep,
    MeanError,
    ObservationTable,
    PoseError,
    TriedLaw,
)
from truearm.units import UNITS

LEAST_FREEDOM = 20  # residuals beyond the geometry's parameters
JOINT_NOISE = 1e-4  # rad, to begin with
GEOMETRY, SAG, CURVES = "geometry", "sag", "curves"


@dataclass(frozen=True)
class LawRequest:
    """Which laws to try. ``prior_sigma`` and ``effects`` are those of the estimate, ``gravity`` of the robot: None, not known."""

    mode: LawMode
    prior_sigma: Floats | None = None
    effects: tuple[Effect, ...] = ()
    gravity: tuple[float, float, float] | None = None


class _Fitted(NamedTuple):
    """Laws that were kept and the estimate with them."""

    kept: tuple[Law, ...]
    estimate: Estimate
    learned: Learned
    dropped: dict[Law, float]


def with_joint_laws(
    chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate, request: LawRequest
) -> tuple[Chain, Estimate]:
    """Return the robot with the laws that the evidence carries, and the estimate with their parameters.

    Both are those that were given where nothing was asked for, where ``auto`` has nothing to do, where the rows cannot show laws and where no law pays;
    ``Estimate.joint_laws`` says which, None in the first two cases.
    """
    if request.mode is LawMode.NONE or (request.mode is LawMode.AUTO and _nothing_to_explain(estimate)):
        return chain, estimate
    gravity = request.gravity or DOWN
    laws, reasons = candidates(chain, table.q[estimate.fitted], request.mode, gravity)
    why_none = _why_none(estimate)
    if why_none:
        laws, reasons = [], [why_none]
    work = _Work(chain, rig, table, estimate, request)
    steps = [_step(GEOMETRY, estimate)]
    best = None
    tried: dict[Law, float] = {}
    for name, some in ((SAG, [law for law in laws if not isinstance(law, CurveKnots)]), (CURVES, laws)):
        if some and (name == SAG or any(isinstance(law, CurveKnots) for law in some)):
            found = work.fitted(some)
            tried |= found.dropped | dict(found.learned.nats)
            steps.append(_step(name, found.estimate))
            best = found if found.kept else best
            if name == CURVES:
                best = found if found.kept else None
    kept = best.kept if best else ()
    report = JointLaws(
        request.mode,
        kept,
        tuple(_tried(chain, law, nats, best, table.q[estimate.fitted]) for law, nats in tried.items()),
        tuple(steps),
        tuple(reasons),
        gravity,
        request.gravity is not None,
    )
    if best is None:
        return chain, replace(estimate, joint_laws=report)
    noise = best.learned.noise
    report = replace(
        report, noise_factor=noise.sensor, noise_shared=math.sqrt(noise.shared), noise_joint=math.sqrt(noise.joint)
    )
    return with_laws(chain, kept), replace(best.estimate, joint_laws=report)


def _nothing_to_explain(estimate: Estimate) -> bool:
    """Whether the declared noise explains the residuals, or the fit is none that laws could be added to."""
    low, high = estimate.chi2_band
    explained = low <= estimate.chi2_reduced <= high
    return bool(explained or estimate.unusable or estimate.status != "converged" or not _takes_laws(estimate))


def _takes_laws(estimate: Estimate) -> bool:
    return SOLVERS[estimate.solver].has_loss and estimate.loss == Loss.LINEAR


def _why_none(estimate: Estimate) -> str:
    """Why no laws are tried at all; "" where they are."""
    if not _takes_laws(estimate):
        return f"joint laws are fitted with the solvers lm and map and the linear loss, not with {estimate.solver} and {estimate.loss}"
    if not estimate.chi2_freedom >= LEAST_FREEDOM:
        return f"{estimate.n_observations} rows are too few: {LEAST_FREEDOM} degrees of freedom beyond the geometry are needed"
    wrong = estimate.systematic
    if wrong is not None and wrong.chi2_reduced <= estimate.chi2_band[1]:
        return "the systematic errors that were found explain what the geometry leaves: correct or allow them first"
    return ""


@dataclass(frozen=True)
class _Work:
    chain: Chain
    rig: Rigs
    table: ObservationTable
    before: Estimate
    request: LawRequest

    def fitted(self, laws: Sequence[Law]) -> _Fitted:
        """Try laws; the estimate is the one before where none is kept."""
        start = PoseNoise(max(self.before.chi2_reduced / 2.0, 1e-3), 0.0, JOINT_NOISE**2)
        learned = learn(self.problem(laws), {}, start)
        kept, learned, dropped = gated(self.problem, laws, learned)
        if not kept:
            return _Fitted((), self.before, learned, dropped)
        of = self.problem(kept)
        return _Fitted(kept, self.estimate(of, learned), learned, dropped)

    def problem(self, laws: Sequence[Law]) -> LawProblem:
        """Compile the rows that were fitted for a robot with laws."""
        chain, before, prior = with_laws(self.chain, laws), self.before, self.request.prior_sigma
        if prior is not None:
            prior = np.append(prior, np.full(len(chain.parameters) - len(self.chain.parameters), np.inf))
        fitted = before.fitted
        effects = modelled_of(self.chain, self.rig, self.table, self.request.effects)
        problem = build_problem(
            chain, self.rig, self.table.select(fitted), prior, [one.select(fitted) for one in effects]
        )
        problem = only(problem, before.weight[fitted] > 0.0)
        known = dict(zip(before.parameter_names, before.value, strict=True))
        free = dict(zip(before.parameter_names, before.free, strict=True))
        columns = np.array([free.get(name, True) for name in problem.names])
        start = np.array([known.get(name, 0.0) for name in problem.names])
        return law_problem(problem, columns, start, laws, poses(self.table.select(fitted)))

    def estimate(self, of: LawProblem, learned: Learned) -> Estimate:
        """The estimate before, with all that the laws change."""
        before, problem = self.before, of.problem
        fitted = posterior(of, learned)
        found = _centred(of, fitted, self.table.q[before.fitted])
        x, p = found.x, problem.n_robot
        at, added = before.n_robot_parameters, p - before.n_robot_parameters
        is_law = np.arange(x.size) >= at
        is_law[p:] = False

        covariance = np.zeros((x.size, x.size))
        covariance[np.ix_(of.columns, of.columns)] = found.covariance
        covariance = _without_null(covariance, before, problem.names, problem.units)
        identifiable = np.insert(before.identifiable, [at] * added, True)
        sigma = np.where(identifiable & of.columns, np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.nan)
        seen = observe(problem, x, np.zeros(x.size, dtype=bool))
        effects = modelled_of(self.chain, self.rig, self.table, self.request.effects)
        held = ~(before.fitted | before.left_out)
        held_out, error = judged(problem, x, self.rig, self.table, held, effects)
        rows = law_rows(of, found, learned.noise)
        freedom = before.rank + _followed(of, found)
        quality = goodness(seen.chi2, seen.n_residuals, np.zeros(round(freedom)))
        unexplained: Mapping[str, MeanError] = {}
        if quality.reduced > quality.band[1]:
            unexplained = mean_errors(error, poses(self.table.select(held)), held_out=True) or mean_errors(
                rows.left_out, of.pose, held_out=False
            )
        how = measured_order(self.table, before.fitted)
        wrong = law_systematic(of, fitted, learned.noise, how, quality)
        if wrong is not None:
            wrong = replace(wrong, moves=moves(problem.chain, x, x + wrong.shift, self.table.q[before.fitted]))
        number = np.cumsum(before.fitted) - 1  # of each row among those that were fitted
        return replace(
            before,
            parameter_names=problem.names,
            units=problem.units,
            nominal=problem.start,
            value=x,
            sigma=sigma,
            free=of.columns,
            identifiable=identifiable,
            covariance=covariance,
            n_robot_parameters=p,
            rms_after=rms_of(seen.residual),
            residual=merged(seen.residual, error, before.fitted, held),
            held_out=held_out,
            chi2_reduced=quality.reduced,
            chi2_freedom=quality.freedom,
            chi2_band=quality.band,
            unexplained=unexplained,
            distance=np.where(before.fitted, rows.distance[number], np.nan),
            suspect=before.fitted & rows.beyond[number],
            systematic=wrong,
            parts=rows.parts,
            pose_error=_pose_error(of, learned.noise),
            suggested_free=np.append(before.suggested_free, np.zeros(added, dtype=bool)),
            with_outliers=before.with_outliers
            and before.with_outliers._replace(value=np.insert(before.with_outliers.value, [at] * added, 0.0)),
        )


def _pose_error(of: LawProblem, noise: PoseNoise) -> PoseError | None:
    """What the rows of a pose share, where as many rows as for a fit without laws share theirs."""
    count = np.bincount(of.pose)
    if not noise.shared or count[count > 1].sum() < max(LEAST_SHARE * of.pose.size, 1.0):
        return None
    return PoseError(math.sqrt(noise.shared), noise.sensor, int((count > 1).sum()))


def _step(name: str, estimate: Estimate) -> LawStep:
    return LawStep(name, estimate.rms_after, estimate.held_out)


def _followed(of: LawProblem, found: Posterior) -> float:
    """Degrees of freedom that the laws follow the data with: tr(A C)."""
    marginal = found.weighed.marginal.information
    return float((marginal * found.covariance[np.ix_(of.is_law, of.is_law)]).sum())


def _centred(of: LawProblem, found: Posterior, q: Floats) -> Posterior:
    """With each curve's mean over the poses moved into its joint's offset, where that is fitted. No prediction changes.

    The constant of a curve and the offset are one number to any observation; centred, what a controller without curves
    does is best, and so is a robot outside the covered range.
    """
    chain, column = of.problem.chain, np.flatnonzero(of.columns)
    offsets = {chain.parameters[i].joint: i for i in chain.law.offset.parameters.tolist()}
    curve = Curve.of_chain(chain)
    weights = curve.by_parameters(of.start, q.T).mean(axis=1)
    change = np.eye(column.size)
    for law in of.laws:
        offset = offsets.get(law.joint)
        if isinstance(law, CurveKnots) and offset is not None and of.columns[offset]:
            mine = curve.joints == law.joint
            at = np.searchsorted(column, curve.parameters[mine])
            change[np.searchsorted(column, offset), at] += weights[mine]
            change[np.ix_(at, at)] -= weights[mine]
    x = found.x.copy()
    law_and_offset = change - np.eye(column.size)
    moved = np.where(of.is_law, x[column], 0.0)
    x[column] += law_and_offset @ moved
    return found._replace(x=x, covariance=change @ found.covariance @ change.T)


def _without_null(covariance: Floats, before: Estimate, names: Sequence[str], units: Sequence[str]) -> Floats:
    """The covariance (P, P) without what directions have that no observation sees: there it is the weak prior's."""
    if not before.null_space:
        return covariance
    at = {name: i for i, name in enumerate(names)}
    null = np.zeros((len(names), len(before.null_space)))
    for k, direction in enumerate(before.null_space):
        null[[at[name] for name in direction.names], k] = direction.weights
    scale = np.array([UNITS[unit].wide_sigma for unit in units])[:, None]
    basis, _ = np.linalg.qr(null / scale)
    keep = np.eye(len(names)) - scale * basis @ (basis.T / scale.T)
    return np.asarray(keep @ covariance @ keep.T)


def _tried(chain: Chain, law: Law, nats: float, best: _Fitted | None, q: Floats) -> TriedLaw:
    term = Curve.name if isinstance(law, CurveKnots) else Sag.name
    joint = chain.joints[law.joint].name
    if best is None or law not in best.kept:
        return TriedLaw(joint, term, nats, kept=False)
    whole = with_laws(chain, best.kept)
    params = best.estimate.value[: len(whole.parameters)]
    kind = Curve if isinstance(law, CurveKnots) else Sag
    added = kind.of_chain(whole).value(params, q.T)[law.joint]
    covered = float(q[:, law.joint].min()), float(q[:, law.joint].max())
    periods = strongest_periods(whole, law, params, covered) if isinstance(law, CurveKnots) else ()
    return TriedLaw(joint, term, nats, True, float(added.std()), covered, periods)
