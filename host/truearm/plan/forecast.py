"""A forecast of what a plan will determine, before measuring: the linear algebra of the identification on planned rows.

To first order, information does not depend on the readings, only on the poses. The planned poses are therefore turned
into a table with the lengths that the model predicts, after the rows that were already measured. The sigmas are those
that ``identify`` will report as long as the model is close to the truth. Errors of 10 mm and 50 mrad change them by a
few per cent. The parameters that ``identify`` fixes, and the priors that it assumes by default, follow from the same
rows (``choose_defaults``).

Error curves are linear in their coefficients, so their covariance too depends on the poses only. Their prior is fixed
and has the size found on real arms (docs/explanation/real-arms.md): TYPICAL at lengths of 0.1 to 0.2 rad. The noise is
the declared one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import PlanError
from truearm.estimate.circumstances import poses
from truearm.estimate.defaults import choose_defaults
from truearm.estimate.identifiability import hardly_seen, identifiability
from truearm.estimate.information import covariance, of_rows, seen, spectrum, with_prior
from truearm.estimate.law_candidates import LENGTHS, candidates, gravity_of, law_priors
from truearm.estimate.law_curves import SampledCurve, sampled_curves
from truearm.estimate.law_fit import Learned, law_problem, posterior
from truearm.estimate.pose_noise import PoseNoise
from truearm.estimate.prediction import seen_covariance
from truearm.estimate.problem import Problem, build_problem, settled
from truearm.estimate.solvers import LawMode, Prior
from truearm.estimate.uncertainty import covariance_root, prior_named, weak_prior, wide_prior
from truearm.estimate.whitened_rows import whitened_blocks
from truearm.kinds.registry import end_points
from truearm.kinds.registry import points as points_of_rig
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, forward, point_forward, point_jacobians
from truearm.model.joint_law import terms
from truearm.model.law_chain import with_laws
from truearm.model.robot import Branch, Capsules, Robot
from truearm.plan.branches import Arm, make_arm
from truearm.results import Defaults, NullDirection
from truearm.types import Floats, Plan, Rig, rms
from truearm.units import DEG, MRAD, UNITS

TYPICAL = 2e-4  # rad, at each of the lengths
TYPICAL_LENGTHS = (0.1, 0.2)  # rad
UNSEEN = 0.7  # of the prior's standard deviation: above it the poses carry almost no information
LEAST_GAP = math.radians(3.0)
SECTION = math.radians(30.0)


@dataclass(frozen=True)
class Aim:
    """Where accuracy is wanted: joints (n, j) of poses, and the relevant points of the end, spheres or targets by name.

    Three points account for orientation too; one alone does not. Without any point, the end's origin is used.
    """

    q: Floats
    points: tuple[str, ...] = ()


@dataclass(frozen=True)
class Forecast:
    """The expected report of an identification with all rows, measured and planned.

    ``sigma`` is NaN where a parameter is unidentifiable or fixed. ``cartesian`` (n,) [m]: expected error of each of the
    aim's points at each of its poses, None where no meaningful figure exists; ``relative`` as in PredictedError.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    free: NDArray[np.bool_]
    sigma: Floats
    rank: int
    null_space: tuple[NullDirection, ...]
    hardly_seen: tuple[NullDirection, ...]
    cartesian: Floats | None
    relative: bool
    n_rows: int
    defaults: Defaults  # what ``identify`` will fix or assume

    @property
    def cartesian_rms(self) -> float:
        """Return the RMS over the region [m]; NaN if there is none."""
        return float("nan") if self.cartesian is None else rms(self.cartesian)


@dataclass(frozen=True)
class Knowledge:
    """What is known before a plan: chain, rig, the model's parameters (p,) now, what is free, and measured rows.

    ``rig_values``: estimates of the rig's unknowns by name, from an earlier result. ``prior``: the one that
    ``identify`` will use; parameters that it fixes by default are also fixed here. None: neither applies, only the rows
    count. ``branch`` and ``links`` belong to the arm; None if they are not described.
    """

    chain: Chain
    rig: Rig
    params: Floats
    free: NDArray[np.bool_]  # (p,)
    measured: ObservationTable | None = None
    rig_values: Mapping[str, float] | None = None
    prior: Prior | None = None
    branch: Branch | None = None
    links: Capsules | None = None
    deciding: frozenset[str] = frozenset()  # what to mount, such as "chuck c2", to decide between causes of a fault

    @classmethod
    def design(cls, robot: Robot, rig: Rig) -> Knowledge:
        """Return what is known of a robot that has not been measured yet: its file."""
        chain = robot.chain
        return cls(chain, rig, chain.params_nominal, robot.free, branch=robot.branch, links=robot.capsules)


def arm_of(knowledge: Knowledge, rng: np.random.Generator) -> Arm:
    """Return the arm at the current parameters. Raises PlanError if it has no branch to stay in."""
    if knowledge.branch is None:
        raise PlanError(f"robot {knowledge.chain.name} has no branch; add [branch] to its file")
    return make_arm(knowledge.chain, knowledge.params, knowledge.branch, rng)


def forecast(knowledge: Knowledge, planned: ObservationTable, aim: Aim | None = None) -> Forecast:
    """Return rank, null space, sigmas and Cartesian error if the ``planned`` rows are measured."""
    knowledge, prior_sigma, defaults = _as_identified(knowledge, planned)
    problem, x, columns = compiled(knowledge, planned)
    n_robot = int(knowledge.free.sum())
    seen_by_rows = of_rows(settled(problem, x), x, columns)
    root, decomposition = seen_by_rows.root, spectrum(seen_by_rows.root)
    names = problem.names_of(columns)
    sight = identifiability(root, n_robot, names)
    believed = np.full(len(names), np.inf)
    believed[:n_robot] = prior_sigma[knowledge.free]
    matrix = covariance(spectrum(with_prior(seen_by_rows, np.zeros(len(names)), believed).root))
    sigma = np.full(len(columns), np.nan)
    sigma[columns] = np.sqrt(np.where(sight.identifiable, np.diag(matrix), np.nan))
    unit = weak_prior(knowledge.chain)[knowledge.free]
    expected = None
    if aim is not None:
        points, jac = _aim_jacobian(knowledge, problem, x, aim)
        jac, null = jac[:, columns], decomposition.vt[~seen(decomposition)].T / decomposition.scale[:, None]
        unseen = jac @ (null / np.abs(null).max(axis=0, initial=1e-300))
        expected = seen_covariance(points, unseen, jac @ covariance_root(matrix), bool(defaults.base))
    return Forecast(
        names=problem.names,
        units=problem.units,
        free=columns,
        sigma=sigma,
        rank=sight.rank,
        null_space=sight.null_space,
        hardly_seen=hardly_seen(root, n_robot, unit, names),
        cartesian=None if expected is None else np.linalg.norm(expected.half.reshape(len(expected.points), -1), axis=1),
        relative=aim is not None and (expected is None or expected.relative),
        n_rows=len(planned) + (0 if knowledge.measured is None else len(knowledge.measured)),
        defaults=defaults,
    )


def candidate_rows(knowledge: Knowledge, planned: ObservationTable) -> tuple[list[Floats], Floats]:
    """Return the input of ``choose``: rows (w, k) of every planned observation, and the known information (k, k).

    Everything is in units of the prior: the robot's parameters by ``wide_prior``, the rig's by the sigmas in the rig.
    Unknown entries of the rig count as known to ``Unit.vague_sigma``. The prior is part of the known information.
    """
    problem, x, columns = compiled(knowledge, planned)
    unit = prior_unit(knowledge, problem, columns)
    rows: list[Floats] = [np.zeros((0, unit.size))] * len(planned)
    information = np.eye(unit.size)
    n_measured = 0 if knowledge.measured is None else len(knowledge.measured)
    for block in whitened_blocks(settled(problem, x), x, columns):
        jac = block.jac * unit
        if block.row is None:
            information += np.einsum("nwk,nwl->kl", jac, jac)
            continue
        old = block.row < n_measured
        information += np.einsum("nwk,nwl->kl", jac[old], jac[old])
        for row, block_of_row in zip(block.row[~old], jac[~old], strict=True):
            rows[row - n_measured] = block_of_row
    return rows, information


def region_root(knowledge: Knowledge, planned: ObservationTable, aim: Aim) -> Floats:
    """Return Lᵀ (at most k, k) of I-optimality in units of the prior; L Lᵀ is the mean of J_rᵀJ_r over the poses."""
    problem, x, columns = compiled(knowledge, planned)
    jac = _aim_jacobian(knowledge, problem, x, aim)[1][:, columns] * prior_unit(knowledge, problem, columns)
    return np.asarray(np.linalg.qr(jac / np.sqrt(len(jac) // 3), mode="r"))


def compiled(knowledge: Knowledge, planned: ObservationTable) -> tuple[Problem, Floats, NDArray[np.bool_]]:
    """Return the problem of all rows, the point x (P,) of its linearisation, and a mask (P,) of what is free."""
    table = all_rows(knowledge, planned)
    problem = build_problem(knowledge.chain, knowledge.rig, table)
    x = problem.at(knowledge.rig_values or {})
    x[: problem.n_robot] = knowledge.params
    return problem, x, problem.columns(knowledge.free)


def prior_unit(knowledge: Knowledge, problem: Problem, columns: NDArray[np.bool_]) -> Floats:
    """Return the standard deviations (k,) of the free columns."""
    rig = problem.prior_sigma[problem.n_robot :]
    units = problem.units[problem.n_robot :]
    vague = np.array([UNITS[unit].vague_sigma for unit in units])
    return np.concatenate([wide_prior(knowledge.chain), np.where(np.isfinite(rig), rig, vague)])[columns]


def bar_table(knowledge: Knowledge, plan: Plan) -> ObservationTable:
    """Return the plan as the rows that would be read if the model were exact."""
    p_sphere = np.array([knowledge.rig.spheres[name].xyz for name in plan.sphere])
    p_chuck = np.array([knowledge.rig.chucks[name].xyz for name in plan.chuck])
    lengths = np.linalg.norm(point_forward(knowledge.chain, knowledge.params, plan.q, p_sphere) - p_chuck, axis=1)
    return planned_table(plan.q, "ball_bar", value=lengths, **{name: getattr(plan, name) for name in Plan.IDS})


def planned_table(q: Floats, kind: str, **columns: Any) -> ObservationTable:
    """Return a table of one kind with the given columns."""
    return ObservationTable(columns, q=q, kind=kind, source=[f"planned pose {i}" for i in range(len(q))])


def all_rows(knowledge: Knowledge, planned: ObservationTable) -> ObservationTable:
    """Return the measured rows, if any, and the planned ones after them."""
    return planned if knowledge.measured is None else ObservationTable.joined([knowledge.measured, planned])


def _as_identified(knowledge: Knowledge, planned: ObservationTable) -> tuple[Knowledge, Floats, Defaults]:
    """Return what is known with only those parameters free that ``identify`` will free, its prior (p,), and why.

    σ is inf for parameters without a prior.
    """
    if knowledge.prior is None:
        return knowledge, prior_named(knowledge.chain, Prior.NONE), Defaults()
    rows, named = all_rows(knowledge, planned), np.zeros(knowledge.free.size, dtype=bool)
    where_needed = knowledge.prior is Prior.WHERE_NEEDED
    free, weak, chosen = choose_defaults(knowledge.chain, knowledge.rig, rows, knowledge.free, named, where_needed)
    sigma = weak if where_needed else prior_named(knowledge.chain, knowledge.prior)
    return replace(knowledge, free=free), sigma, chosen


def _aim_jacobian(knowledge: Knowledge, problem: Problem, x: Floats, aim: Aim) -> tuple[Floats, Floats]:
    """Return the positions (n, 3) of all points at all poses and their derivatives (3n, P)."""
    jacobians = [_point_jacobian(knowledge, problem, x, aim.q, name) for name in aim.points or ("",)]
    return np.concatenate([pair[0] for pair in jacobians]), np.concatenate([pair[1] for pair in jacobians])


def _point_jacobian(knowledge: Knowledge, problem: Problem, x: Floats, q: Floats, name: str) -> tuple[Floats, Floats]:
    """Return the same for one point, including derivatives by its own unknown coordinates. "": the end's origin."""
    point, columns = np.zeros(3), [-1, -1, -1]
    for kind, points_of_kind in end_points(knowledge.rig).items():
        if name in points_of_kind:
            names = [f"{kind}.{name}.{k}" for k in "xyz"]
            columns = [problem.names.index(unknown) if unknown in problem.names else -1 for unknown in names]
            point = np.array([x[i] if i >= 0 else v for i, v in zip(columns, points_of_kind[name].xyz, strict=True)])
    p_base, jac, _ = point_jacobians(knowledge.chain, x[: problem.n_robot], q, point)
    out = np.zeros((jac.shape[0], 3, x.size))
    out[:, :, : problem.n_robot] = jac
    if columns[0] >= 0:
        out[:, :, columns] = forward(knowledge.chain, x[: problem.n_robot], q)[:, :3, :3]
    return p_base, out.reshape(-1, x.size)


def with_rig_values(rig: Rig, values: Mapping[str, float]) -> Rig:
    """Return the rig with its points where an earlier result placed them; their sigmas are kept."""

    for column, field in points_of_rig().items():
        moved = {}
        for name, point in rig.named(field).items():
            x, y, z = (values.get(f"{column}.{name}.{k}", v) for k, v in zip("xyz", point.xyz, strict=True))
            moved[name] = replace(point, xyz=(x, y, z))
        rig = rig.with_named(field, moved)
    return rig


def curve_forecasts(knowledge: Knowledge, planned: ObservationTable) -> list[dict[str, Any]]:
    """Return a forecast for every joint that would have an error curve, as JSON.

    ``ranges``: the readings that planned poses cover, in sections of at most SECTION, each with the RMS standard
    deviation of the curve; ``sigma_mrad``: the same over all of them; ``unseen_deg``: ranges of readings between the
    lowest and the highest that the poses do not determine.
    """
    table = all_rows(knowledge, planned)
    chain, n = _geometry(knowledge)
    laws, _ = candidates(chain, table.q, LawMode.CURVE, gravity_of(table, None))
    if not laws:
        return []
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
    return [_curve_forecast(curve, UNSEEN * math.sqrt(prior.sum())) for curve in curves]


def _curve_forecast(curve: SampledCurve, unseen: float) -> dict[str, Any]:
    """Return the forecast of a curve with its standard deviations.

    Those above ``unseen`` [rad] carry no information.
    """
    readings, sigma = DEG.of(curve.readings), MRAD.of(curve.sigma)
    between = (curve.readings >= curve.intervals[0][0]) & (curve.readings <= curve.intervals[-1][1])
    sections = (
        section
        for run in _runs(curve.covered)
        for section in np.array_split(run, math.ceil(float(np.ptp(curve.readings[run])) / SECTION) or 1)
    )
    gaps = _runs(between & (~curve.covered | (curve.sigma > unseen)))
    return {
        "joint": curve.joint,
        "ranges": [
            {
                "lower_deg": float(readings[rows[0]]),
                "upper_deg": float(readings[rows[-1]]),
                "sigma_mrad": rms(sigma[rows]),
            }
            for rows in sections
        ],
        "sigma_mrad": rms(sigma[curve.covered]),
        "unseen_deg": [readings[gap[[0, -1]]].tolist() for gap in gaps if np.ptp(curve.readings[gap]) >= LEAST_GAP],
    }


def _runs(flags: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the indices of each run of True."""
    rows = np.flatnonzero(flags)
    return np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if rows.size else []


def _geometry(knowledge: Knowledge) -> tuple[Chain, int]:
    """Return the chain without the laws that an earlier result added, and its number of parameters."""
    learned = {term.name for term in terms() if term.learned}
    geometric = tuple(p for p in knowledge.chain.parameters if p.term not in learned)
    return replace(knowledge.chain, parameters=geometric), len(geometric)
