"""Error curves and sag of joints, added to an estimate of the geometry where the evidence in the data supports them.

``with_joint_laws`` starts from a least-squares estimate. If no law is worthwhile, that estimate is returned unchanged.
The noise per pose that the evidence requires would degrade the geometry of an arm whose errors it mistakes for noise.
Otherwise the parameters of the laws are appended to those of the estimate's robot and fitted together with everything
else under the learned noise. The fit is still judged (χ²) against the declared noise.

Bad rows bend the geometry and hide the laws, and the laws that were not fitted widen the gate for bad rows.
``laws_and_outliers`` breaks this circle. First, the geometry is fitted without the rows beyond the gate that its own
misfit widens (``outliers``), and laws are fitted to the others. Then every row is compared with its prediction by the
laws under the learned noise. Rows beyond that gate are left out if they ``matter``, and rows within it return, until
the set no longer changes. Where no law is kept without those rows, none is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from truearm.estimate.circumstances import payloads_of, poses
from truearm.estimate.defaults import LEAST_POSES, in_any_pose
from truearm.estimate.identifiability import spread
from truearm.estimate.identify import determined, judged, merged
from truearm.estimate.information import observe
from truearm.estimate.law_candidates import candidates, gravity_of, law_priors
from truearm.estimate.law_choice import LawChoice, regions, supported, without_absent
from truearm.estimate.law_curves import sampled_curves, sine_amplitudes, strongest_periods
from truearm.estimate.law_fit import JOINT_NOISE, LawProblem, law_problem, learn, nearer_geometry, posterior, scatter_of
from truearm.estimate.outliers import matter, misfit, single, within
from truearm.estimate.pose_noise import PoseNoise
from truearm.estimate.problem import Problem, build_problem, settled, without_knowledge
from truearm.estimate.row_errors import RowErrors, row_errors
from truearm.estimate.solution import rms_of
from truearm.estimate.solvers import SOLVERS, LawMode, Loss
from truearm.estimate.uncertainty import covariance_root, goodness
from truearm.estimate.validation import mean_errors
from truearm.estimate.whitened_rows import gate, only
from truearm.findings import Finding
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.model.joint_terms.curve import Curve
from truearm.model.joint_terms.sag import Sag
from truearm.model.law_chain import with_laws
from truearm.results import Diagnosis, Effect, Estimate, JointLaws, LawStep, MeanError, TriedLaw
from truearm.types import CurveKnots, Floats, Law, Mask, Rigs, thinned
from truearm.units import UNITS

MAX_ROUNDS = 6  # of fits with laws
SMALLEST = 1e-2  # of the prior σ of a coefficient, that of its difference from the others if they are bound together
LEAST_FREEDOM = 20  # residuals in excess of the geometry's parameters
ERRORS_EXPLAIN = Finding("no-law", {"explained_by": "faults"})
LARGER_RESIDUALS = Finding("no-law", {"larger": True})
GEOMETRY, LAWS = "geometry", "laws"


@dataclass(frozen=True)
class LawRequest:
    """The laws to try.

    ``prior_sigma`` and ``effects`` are those of the estimate, and ``faults`` those that its rows show. ``gravity`` is
    that of the robot file, None if not given.
    """

    mode: LawMode
    prior_sigma: Floats
    effects: tuple[Effect, ...] = ()
    faults: tuple[Effect, ...] = ()
    gravity: tuple[float, float, float] | None = None


class WithLaws(NamedTuple):
    """The robot with its laws, the estimate with their parameters, and how they were chosen, None if no law is kept."""

    chain: Chain
    estimate: Estimate
    choice: LawChoice | None = None


def laws_and_outliers(
    geometry: Estimate,
    refit: Callable[[Mask], Estimate],
    with_laws: Callable[[Estimate, LawChoice | None], WithLaws],
) -> WithLaws:
    """Return the result of ``with_laws`` for the geometry without outlying rows.

    ``refit`` fits the geometry without some rows (n,) of the table. ``with_laws`` is given the choice of laws of the
    round before: a few rows more or less only drop laws.
    """
    outlying, seen = geometry.outlying, set[bytes]()
    excludes_others = not np.array_equal(outlying, geometry.weight == 0.0)
    best = with_laws(refit(outlying) if excludes_others else geometry, None)
    if excludes_others and best.choice is None:
        return with_laws(geometry, None)
    for _ in range(MAX_ROUNDS):
        seen.add(outlying.tobytes())
        outlying = best.estimate.outlying
        if best.choice is None or outlying.tobytes() in seen or not single(outlying[geometry.fitted]):
            break
        further = with_laws(refit(outlying), best.choice)
        if further.choice is None:
            break
        best = further
    return best


def with_joint_laws(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    estimate: Estimate,
    request: LawRequest,
    nearly: LawChoice | None,
) -> WithLaws:
    """Return the robot with the laws that the evidence supports, and the estimate with their parameters.

    Both are returned unchanged if nothing was requested, if ``auto`` has nothing to do, if the rows cannot determine
    laws, or if no law is worthwhile. ``Estimate.joint_laws`` records which; it is None in the first two cases.
    ``nearly``: the choice of laws for nearly the same rows, of which only those that were kept are tried; None: all
    are.
    """
    if request.mode is LawMode.NONE or (request.mode is LawMode.AUTO and _nothing_to_explain(chain, estimate, table)):
        return WithLaws(chain, estimate)
    fitted = table.select(estimate.fitted)
    gravity, payloads = gravity_of(fitted, request.gravity), tuple(dict.fromkeys(payloads_of(rig, fitted)))
    laws, reasons = candidates(chain, fitted.q, request.mode, gravity, payloads)
    work, fit, choice = _Work(chain, rig, table, estimate, request), estimate, None
    steps, why_none = [LawStep(GEOMETRY, fit.rms_after, fit.held_out)], _why_none(chain, estimate)
    if laws and not why_none:
        choice = work.supported(laws, nearly)
        fit = work.fitted(choice) if choice.kept else estimate
        steps.append(LawStep(LAWS, fit.rms_after, fit.held_out))
        if request.faults and not choice.kept:
            why_none = ERRORS_EXPLAIN
        elif fit.chi2_reduced > estimate.chi2_reduced:
            # The posterior is linear about what was learned, which may be far along weakly determined combinations.
            why_none = LARGER_RESIDUALS
    if why_none:
        fit, choice, steps, reasons = estimate, None, steps[:1], [why_none]
    tried = {**choice.dropped, **choice.learned.nats} if choice else {}
    kept = choice.kept if choice else ()
    readings = fitted.q, work.anywhere.q
    report = JointLaws(
        request.mode,
        kept,
        tuple(_tried(chain, law, nats, kept, fit.value, *readings) for law, nats in tried.items()),
        tuple(steps),
        tuple(reasons),
        gravity.direction,
        gravity.known,
        payloads,
    )
    return WithLaws(with_laws(chain, kept), replace(fit, joint_laws=report), choice if kept else None)


def _nothing_to_explain(chain: Chain, estimate: Estimate, table: ObservationTable) -> bool:
    """Return whether the declared noise explains the residuals, or the fit is unsuitable for adding laws.

    A fault of a joint, such as an eccentric code wheel, is what laws describe. If observations of one kind have one
    unit, their sigmas may all be too large, which hides what laws would explain. If there are several, only some may
    be: the single factor learned from all of them would be too small for the others, and laws would follow their noise.
    """
    low, high = estimate.chi2_band
    of_one = np.unique(table.kind[estimate.fitted]).size == len(estimate.residual) == 1
    too_large = estimate.chi2_reduced < low and of_one
    explained = estimate.chi2_reduced <= high and not (too_large or _joint_errs(chain, estimate))
    explained = explained or estimate.without_bad_rows is not None
    return bool(explained or estimate.unusable or estimate.status != "converged" or not _takes_laws(estimate))


def is_of_joint(chain: Chain, fault: Diagnosis) -> bool:
    """Return whether a fault is most probably one of a joint, which laws describe."""
    return fault.rivals[0].name.rpartition(".")[0] in {joint.name for joint in chain.joints}


def _joint_errs(chain: Chain, estimate: Estimate) -> bool:
    return any(is_of_joint(chain, fault) for fault in estimate.faults)


def _takes_laws(estimate: Estimate) -> bool:
    return SOLVERS[estimate.solver].has_loss and estimate.loss == Loss.LINEAR


def _why_none(chain: Chain, estimate: Estimate) -> Finding | None:
    """Return why no laws are tried at all; None if they are."""
    if not _takes_laws(estimate):
        return Finding("no-law", {"solver": str(estimate.solver), "loss": str(estimate.loss)})
    if not estimate.chi2_freedom >= LEAST_FREEDOM:
        return Finding("no-law", {"rows": estimate.n_observations, "freedom": LEAST_FREEDOM})
    if estimate.faults and estimate.covariance_explains and not _joint_errs(chain, estimate):
        return ERRORS_EXPLAIN
    if estimate.without_bad_rows is not None:
        return Finding("no-law", {"explained_by": "bad rows"})
    return None


@dataclass(frozen=True)
class _Work:
    chain: Chain
    rig: Rigs
    table: ObservationTable
    geometry: Estimate
    request: LawRequest

    def supported(self, laws: Sequence[Law], nearly: LawChoice | None) -> LawChoice:
        """Return those of some laws that the rows support beside faults.

        ``nearly``: the choice of nearly the same rows.
        """
        noise = PoseNoise.of(max(self.geometry.chi2_reduced / 2.0, 1e-3), len(self.chain.joints), JOINT_NOISE)
        fitted, make = self.table.select(self.geometry.fitted), partial(self.problem, beside=self.request.faults)
        choice = supported(make, laws, regions(fitted, poses(fitted)), nearly or noise)
        problem = self.problem(choice.kept)
        learned = learn(problem, noise) if choice.kept and self.request.faults else choice.learned
        return without_absent(problem, learned, choice)

    @property
    def anywhere(self) -> ObservationTable:
        """Return some of the fitted rows in random poses."""
        rows = np.flatnonzero(self.geometry.fitted)
        return in_any_pose(self.chain, self.table.select(rows[thinned(rows.size, LEAST_POSES)]))

    def rows(self, laws: Sequence[Law], beside: tuple[Effect, ...]) -> Problem:
        """Compile the fitted rows, and those left out as outliers, for a robot with laws and further effects."""
        chain, prior, fitted = with_laws(self.chain, laws), self.request.prior_sigma, self.geometry.fitted
        prior = np.append(prior, np.full(len(chain.parameters) - prior.size, np.inf))
        return build_problem(chain, self.rig, self.table, prior, (*self.request.effects, *beside), fitted)

    def problem(self, laws: Sequence[Law], beside: tuple[Effect, ...] = ()) -> LawProblem:
        """Return the problem of the rows that are no outliers."""
        geometry, fitted = self.geometry, self.geometry.fitted
        problem = only(self.rows(laws, beside), geometry.weight[fitted] > 0.0)
        values = dict(zip(geometry.parameter_names, geometry.value, strict=True))
        free = dict(zip(geometry.parameter_names, geometry.free, strict=True))
        columns = np.array([free.get(name, True) for name in problem.names])
        start = np.array([values.get(name, 0.0) for name in problem.names])
        rows = self.table.select(fitted)
        return law_problem(problem, columns, start, poses(rows), law_priors(self.chain, laws, rows.q))

    def fitted(self, choice: LawChoice) -> Estimate:
        """Return the estimate of the geometry with everything that the kept laws change."""
        laws_problem, learned = self.problem(choice.kept), choice.learned
        geometry, problem, fitted = self.geometry, laws_problem.problem, posterior(laws_problem, learned)
        anywhere = without_knowledge(build_problem(problem.chain, self.rig, self.anywhere))
        nearer = nearer_geometry(laws_problem, anywhere, fitted, geometry.chi2_reduced)
        seen = observe(problem, nearer.x, np.zeros(nearer.x.size, dtype=bool))
        held = ~(geometry.fitted | geometry.left_out)
        held_out, error = judged(problem, nearer.x, self.rig, self.table, held, self.request.effects)
        x, p = nearer.x, problem.n_robot
        n_geometry, added = geometry.n_robot_parameters, p - geometry.n_robot_parameters
        is_law = np.arange(x.size) >= n_geometry
        is_law[p:] = False

        covariance = np.zeros((x.size, x.size))
        covariance[np.ix_(laws_problem.columns, laws_problem.columns)] = nearer.covariance
        sight = determined(settled(problem, x), x, laws_problem.columns & ~is_law)
        covariance = _without_null(covariance, sight.unseen, problem.units)
        identifiable = np.insert(geometry.identifiable, [n_geometry] * added, True)
        sigma = np.where(identifiable & laws_problem.columns, np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.nan)
        prior_sigma = problem.prior_sigma.copy()
        sizes = laws_problem.sizes(learned.variances) @ laws_problem.prior.spectra
        prior_root = laws_problem.basis * np.sqrt(sizes)
        prior_sigma[is_law] = np.linalg.norm(prior_root, axis=1)
        weight, columns = geometry.weight[geometry.fitted], laws_problem.acting().columns
        acts = columns[laws_problem.columns]
        root = covariance_root(fitted.covariance[np.ix_(acts, acts)])
        rows = row_errors(
            self.rows(laws_problem.laws, ()), fitted.x, columns, root, weight, laws_problem.pose, learned.noise
        )
        freedom = geometry.rank + fitted.freedom
        quality = goodness(seen.chi2, seen.n_residuals, np.zeros(round(freedom)))
        judging = held_out is not None
        unfitted = merged({} if judging else rows.left_out, error if judging else {}, geometry.fitted, held)
        unexplained: Mapping[str, MeanError] = {}
        if not quality.explained:
            unexplained = mean_errors(unfitted, poses(self.table), held_out=judging)
        distance = np.full(len(self.table), np.nan)
        distance[geometry.fitted] = rows.distance
        return replace(
            geometry,
            parameter_names=problem.names,
            units=problem.units,
            nominal=problem.start,
            value=x,
            sigma=sigma,
            free=laws_problem.columns,
            identifiable=identifiable,
            null_space=sight.null_space,
            unseen=sight.unseen,
            covariance=covariance,
            n_robot_parameters=p,
            rms_after=rms_of(seen.residual),
            residual=merged(seen.residual, error, geometry.fitted, held),
            held_out=held_out,
            chi2_reduced=quality.reduced,
            chi2_freedom=quality.freedom,
            chi2_band=quality.band,
            unexplained=unexplained,
            unfitted_error=unfitted,
            distance=distance,
            suspect=spread(rows.beyond | (weight == 0.0), geometry.fitted),
            outlying=spread(_outlying(rows, weight > 0.0), geometry.fitted),
            scatter=scatter_of(laws_problem, learned),
            faults=(),
            claim=None,
            prior_sigma=prior_sigma,
            law_prior=_precision_root(prior_root),
            parts=rows.parts,
            suggested_free=np.append(geometry.suggested_free, np.zeros(added, dtype=bool)),
            with_outliers=geometry.with_outliers
            and geometry.with_outliers._replace(
                value=np.insert(geometry.with_outliers.value, [n_geometry] * added, 0.0)
            ),
        )


def _precision_root(root: Floats) -> Floats:
    """Return W (l, l) with W Wᵀ the inverse of R Rᵀ, R being ``root`` (l, f).

    Directions without variance get nearly none.
    """
    covariance = root @ root.T
    covariance += np.diag(SMALLEST**2 * np.maximum(np.diag(covariance), np.finfo(float).tiny))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)).T)


def _outlying(rows: RowErrors, fitted: Mask) -> Mask:
    """Return which rows (n,) to leave out next, after a fit with laws of the ``fitted`` rows (n,)."""
    square = np.nan_to_num(rows.distance) ** 2
    staying = within(square, gate(rows.width) * misfit(square, rows.width, fitted), fitted)
    staying_out, leaving = ~fitted & ~staying, fitted & ~staying
    return staying_out | leaving if matter(np.where(fitted, square, 0.0), leaving) else staying_out


def _without_null(covariance: Floats, unseen: Floats, units: Sequence[str]) -> Floats:
    """Return the covariance (P, P) without null directions (P, d), along which it is that of the weak prior."""
    scale = np.array([UNITS[unit].wide_sigma for unit in units])[:, None]
    basis, _ = np.linalg.qr(unseen / scale)
    keep = np.eye(len(units)) - scale * basis @ (basis.T / scale.T)
    return np.asarray(keep @ covariance @ keep.T)


def _tried(
    chain: Chain, law: Law, nats: float, kept: Sequence[Law], value: Floats, q: Floats, anywhere: Floats
) -> TriedLaw:
    """Return what became of a law; ``q`` (n, j) are the fitted readings, ``anywhere`` (m, j) random ones."""
    kind, joint = Curve if isinstance(law, CurveKnots) else Sag, chain.joints[law.joint].name
    if law not in kept:
        return TriedLaw(joint, kind.name, nats, kept=False)
    whole = with_laws(chain, kept)
    params = value[: len(whole.parameters)]
    added = kind.of_chain(whole).value(params, q.T)[law.joint]
    tried = TriedLaw(joint, kind.name, nats, True, float(added.std()))
    if kind is Sag:
        every = np.append(added, kind.of_chain(whole).value(params, anywhere.T)[law.joint])
        if every.any():  # a joint may have the torque of a payload alone, of which the chain has none
            tried = replace(tried, range_share=float(np.ptp(added) / np.ptp(every)))
        return tried
    (curve,) = sampled_curves(whole, [law], params, np.zeros((params.size, params.size)))
    periods, resolution = strongest_periods(curve), sine_amplitudes(curve).resolution
    return replace(tried, covered=curve.intervals, periods=periods, resolution_cycles=resolution)
