"""Joint fit of geometry, rig and joint laws, with their variances and the noise per pose learned by evidence.

The laws are fitted together with the geometry rather than to its residuals, because a geometry without sag has already
absorbed most of it. ``law_choice`` decides which laws are kept. docs/explanation/estimation.md derives everything here.

Linearised, measured − predicted = J_g·g + G·f + noise. g, geometry and rig, is integrated out. The modes f are
independent, f_j ~ N(0, s_j) with s = v·spectra, and the variances v maximise the evidence (MacKay 1992, Neural
Computation 4(3)). With A = G Gᵀ, L Lᵀ = I + Gᵀ S G, X = L⁻¹ Gᵀ and V = XᵀX, the covariance of the modes is S − S V S.

Poses in a corner of the joint space determine the sum of geometry and laws there, but not elsewhere. The estimate is
therefore moved towards the geometry as far as the fitted rows permit (``nearer_geometry``). Where many poses determine
the laws, this changes nothing. The covariance of the result is P plus the square of the move.

The arm's own scatter is learned in the same way in a fit without laws (``learned_scatter``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.special import chdtri

from truearm.estimate.information import observe
from truearm.estimate.law_candidates import LawPrior, acting
from truearm.estimate.pose_noise import (
    MOTIONS,
    PoseNoise,
    RowsByPose,
    independent,
    learned_noise,
    noise_change,
    pose_information,
    pose_rows,
    pose_samples,
)
from truearm.estimate.problem import Problem
from truearm.estimate.uncertainty import Goodness
from truearm.estimate.whitened_rows import only
from truearm.progress import steps_of
from truearm.results import Scatter
from truearm.types import Floats, Indices, Law, Mask
from truearm.units import UNITS

START = 0.2  # of the cap: initial standard deviations
LEARNING = (
    3000,
    9000,
)  # poses and residuals: variances and noise are learned from a random selection of at most so many
FOR_NOISE = 3  # one of so many of these, for the noise
MOST_OF_POSE = 72  # residuals of a pose that count among these: repeats must not take the place of poses
LINEARISED = 3  # rounds, without anything learned before; then x hardly changes
ROUNDS = 12  # of learning the variances and learning the noise
WITHOUT_SCATTER = 2  # of them: laws and robot are already those of the rows
NOISE_END = 0.01  # the last round changes the variance of the rows by less
SHARED_START = 1e-10  # m² and rad²
RIG_SIGMA = 10.0  # m, rad: keeps unknowns without a prior finite along null directions
ROUNDING = 1e-13  # of the information about an unknown, more than rounding leaves along null directions
UNSEEN = 1e-3  # a prior at its cap gains half of this in nats along a neglected direction of the data
REVIVED = 0.03  # of the cap: least √v where learning starts, because zero is a stationary point
STEPS = 8  # of the variances, for one noise

_pstrf = get_lapack_funcs("pstrf", dtype=np.float64)
# Of the limit. Variances cannot be negative, so noise of the sensors passes for the arm's in 1 of 300 fits.
LEVEL = 0.05
LEAST_SHARE = 0.5  # of the rows must share their pose with others
JOINT_NOISE = 1e-4  # rad, initial value


class ModePrior(NamedTuple):
    """The prior of f modes: ``spectra`` (v, f) per variance, and the scale ``cap`` (v,) of the hyperprior on √v."""

    spectra: Floats
    cap: Floats


class Seen(NamedTuple):
    """The subspace of f that the data determine: A = G Gᵀ and b = G β, with G (f, r) and β (r,)."""

    root: Floats
    rhs: Floats


class ModesAt(NamedTuple):
    """f at given variances: the log evidence [nats] relative to that without laws, and the factors of z and V."""

    x: Floats  # (r, f)
    z: Floats  # (f,)
    nats: float


def seen_by(information: Floats, rhs: Floats, prior: ModePrior) -> Seen:
    """Return the directions of f that the data determine, from A (f, f) and b (f,)."""
    if not rhs.size:
        return Seen(np.zeros((0, 0)), np.zeros(0))
    scale = np.sqrt(prior.cap**2 @ prior.spectra)
    factor, pivot, rank, _ = _pstrf(scale[:, None] * information * scale, UNSEEN, lower=1)
    lower, order = np.tril(factor[:, :rank]), pivot - 1
    root = np.empty_like(lower)
    root[order] = lower / scale[order, None]
    return Seen(root, solve_lower(lower[:rank], (scale * rhs)[order[:rank]]))


def modes_at(data: Seen, sizes: Floats) -> ModesAt:
    """Return f at the prior variances ``sizes`` (f,)."""
    half = np.sqrt(sizes)[:, None] * data.root
    lower, y, nats = _evidence(data, half.T @ half)
    # On its own the transpose is in LAPACK's order, which takes half the time of one array with the right side.
    x = solve_lower(lower, data.root.T)
    return ModesAt(x, x.T @ y, nats)


def nats_of(data: Seen, sizes: Floats, number: Indices) -> list[float]:
    """Return by how much [nats] the log evidence falls without the modes of each ``number`` (f,), others unchanged."""
    half = np.sqrt(sizes)[:, None] * data.root
    square = half.T @ half
    dropped = (half[number == law] for law in range(int(number.max(initial=-1)) + 1))
    total = _evidence(data, square)[2]
    return [total - _evidence(data, square - modes.T @ modes)[2] for modes in dropped]


def _evidence(data: Seen, square: Floats) -> tuple[Floats, Floats, float]:
    """Return L (r, r) with L Lᵀ = I + Gᵀ S G, L⁻¹β (r,) and the log evidence [nats]; ``square`` (r, r) is Gᵀ S G."""
    lower = np.asarray(np.linalg.cholesky(np.eye(data.rhs.size) + square), dtype=float)
    y = solve_lower(lower, data.rhs)
    return lower, y, 0.5 * float(data.rhs @ data.rhs - y @ y) - float(np.log(np.diag(lower)).sum())


def solve_lower(lower: Floats, right_side: Floats) -> Floats:
    """Return L⁻¹ times a right side."""
    if not lower.size:
        return np.zeros_like(right_side)
    return np.asarray(scipy.linalg.solve_triangular(lower, right_side, lower=True, check_finite=False))


def learned(data: Seen, prior: ModePrior, variances: Floats) -> Floats:
    """Return the variances (v,) that maximise the evidence with the hyperprior, at most STEPS from where they are."""
    from scipy.optimize import minimize  # slow to import, and large

    def cost(size: Floats) -> tuple[float, Floats]:
        modes = modes_at(data, (size * prior.cap) ** 2 @ prior.spectra)
        slope = prior.spectra @ (modes.z**2 - (modes.x**2).sum(axis=0))
        return 0.5 * float(size @ size) - modes.nats, size * (1.0 - prior.cap**2 * slope)

    if not variances.size:
        return variances
    start = np.maximum(np.sqrt(variances) / prior.cap, REVIVED)
    options = {"maxiter": STEPS, "ftol": 1e-5}
    optimum = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=[(0.0, None)] * start.size, options=options)
    return np.asarray((optimum.x * prior.cap) ** 2)


@dataclass(frozen=True, eq=False)
class LawProblem:
    """A problem whose robot has laws, linear in g, about ``reference`` (P,) in units of ``sigma`` (g,), and in modes f.

    ``basis`` (l, f) makes coefficients of laws from their modes, ``prior`` is that of the modes.
    """

    problem: Problem
    columns: NDArray[np.bool_]  # (P,) the k fitted ones
    is_law: NDArray[np.bool_]  # (k,) l of them
    pose: Indices  # (n_rows,)
    start: Floats  # (P,) as fitted without laws
    reference: Floats  # (P,)
    sigma: Floats  # (g,)
    laws: tuple[Law, ...]
    basis: Floats
    prior: ModePrior
    law_of_mode: Indices  # (f,)
    law_of_variance: Indices  # (v,)

    def acting(self) -> LawProblem:
        """Return the problem of the coefficients that act at any reading: all others have no column in the rows."""
        acts = np.concatenate([np.zeros(0, bool), *(acting(law) for law in self.laws)])
        active = np.ones(self.is_law.size, dtype=bool)
        active[self.is_law] = acts
        columns = self.columns.copy()
        columns[columns] = active
        return replace(self, columns=columns, is_law=self.is_law[active], basis=self.basis[acts])

    def some(self) -> tuple[LawProblem, int]:
        """Return the problem of the ``acting`` coefficients in at most LEARNING random poses, and a stride.

        Every so manieth of these poses is enough to learn the noise.
        """
        residuals, numbers = 0, set[int]()
        for group in self.problem.groups:
            if group.row is not None:
                poses, rows = np.unique(self.pose[group.row], return_counts=True)
                residuals += int(np.minimum(rows * group.sensor_cov.shape[1], MOST_OF_POSE).sum())
                numbers.update(poses.tolist())
        share = max(len(numbers) / LEARNING[0], residuals / LEARNING[1])
        stride = max(1, int(FOR_NOISE * min(share, 1.0)))
        if share <= 1.0:
            return self.acting(), stride
        chosen = np.random.default_rng(0).permutation(np.unique(self.pose))
        is_chosen = np.isin(self.pose, chosen[: int(chosen.size / share)])
        return replace(self.acting(), problem=only(self.problem, is_chosen)), stride

    def rows(self, x: Floats) -> Iterator[RowsByPose]:
        """Return the ``independent`` poses' rows of the fitted unknowns at x (P,)."""
        return independent(pose_rows(self.problem, x, self.columns, self.pose))

    def by_modes(self, matrix: Floats, x: Floats) -> Floats:
        """Return ``matrix`` (n, k + 1) times T (k + 1, g + f + 1).

        Rows [J|residual at x] times T are derivatives by g and f, and residuals at the reference.

        The basis has a block for each law; one product with all of it costs several times as much.
        """
        by_laws, laws = matrix[:, :-1][:, self.is_law], []
        for number in range(len(self.laws)):
            modes = self.law_of_mode == number
            rows = self.basis[:, modes].any(axis=1)
            laws.append(by_laws[:, rows] @ self.basis[np.ix_(rows, modes)])
        residual = matrix[:, :-1] @ (x - self.reference)[self.columns] + matrix[:, -1]
        return np.column_stack([matrix[:, :-1][:, ~self.is_law] * self.sigma, *laws, residual])

    def sizes(self, variances: Mapping[Law, Floats]) -> Floats:
        """Return the variances (v,) of all laws."""
        return np.concatenate([np.zeros(0), *(variances[law] for law in self.laws)])


def law_problem(
    problem: Problem, columns: Mask, start: Floats, pose: Indices, priors: Mapping[Law, LawPrior]
) -> LawProblem:
    """Return a problem whose robot has laws with ``priors``: its last parameters.

    ``start`` (P,) is the fit without them.

    Unknowns without a prior get a weak one about ``start``, so redundant parameters are allowed.
    """
    basis = scipy.linalg.block_diag(np.zeros((0, 0)), *(prior.basis for prior in priors.values()))
    spectra = scipy.linalg.block_diag(np.zeros((0, 0)), *(prior.spectra for prior in priors.values()))
    counts = np.array([prior.spectra.shape for prior in priors.values()], dtype=np.intp).reshape(-1, 2)
    caps = np.repeat([prior.cap for prior in priors.values()], counts[:, 0])
    law_of_variance, law_of_mode = (np.repeat(np.arange(len(priors)), count) for count in counts.T)
    is_law = np.zeros(columns.size, dtype=bool)
    is_law[problem.n_robot - len(basis) : problem.n_robot] = True
    declared = np.isfinite(problem.prior_sigma)
    sigma = np.array([UNITS[unit].wide_sigma for unit in problem.units])
    sigma[problem.n_robot :] = RIG_SIGMA
    sigma[declared] = problem.prior_sigma[declared]
    reference = np.where(declared, problem.start, start)
    prior = ModePrior(spectra, caps)
    sigma = sigma[columns & ~is_law]
    unknowns = problem, columns, is_law[columns], pose, start, reference, sigma
    return LawProblem(*unknowns, tuple(priors), basis, prior, law_of_mode, law_of_variance)


class Learned(NamedTuple):
    """The result of the evidence: the variances of each law's prior, the noise, and each law's gain in nats.

    ``evidence`` is the log evidence of the rows that were used to learn, and x (P,) the estimate from them.
    """

    variances: Mapping[Law, Floats]
    noise: PoseNoise
    nats: Mapping[Law, float]
    evidence: float
    x: Floats


class Posterior(NamedTuple):
    """The unknowns at given variances and noise: x (P,), the covariance (k, k) and the log evidence.

    ``freedom`` are the degrees of freedom of the laws, tr(A C).
    """

    x: Floats
    covariance: Floats
    evidence: float
    freedom: float


def learn(
    problem: LawProblem,
    start: PoseNoise | Learned,
    rounds: int = ROUNDS,
    shared: bool = True,
    least: float = -math.inf,
) -> Learned:
    """Learn variances and noise from at most LEARNING poses.

    They start from what was learned with more laws; with a noise alone, all variances start small. Without ``shared``,
    the rows of a pose share no error. Learning ends once
    the evidence is less than ``least`` with a noise that was learned beside the laws.
    """
    (sample, stride), linearisations = problem.some(), LINEARISED
    if isinstance(start, Learned):
        variances, noise, x, linearisations = problem.sizes(start.variances), start.noise, start.x, 1
    else:
        variances, noise, x = (START * problem.prior.cap) ** 2, start, problem.start
    shared = shared and bool((np.bincount(problem.pose) > 1).any())
    if shared and not noise.shared:
        noise = noise._replace(shared=SHARED_START, turned=SHARED_START)
    middle, rows = x, list[RowsByPose]()
    for i in steps_of(range(rounds), "learning the sizes of joint laws and noise"):
        if i < linearisations:
            middle, rows = x, list(sample.rows(x))
        data = _data(sample, middle, rows, noise)
        variances = learned(data.seen, problem.prior, variances)
        fit = _posterior(sample, middle, data, variances)
        if i and fit.evidence < least:
            break
        samples = pose_samples(rows, (middle - fit.x)[sample.columns], fit.covariance, stride)
        x, old, noise = fit.x, noise, learned_noise(samples, noise, shared)
        if i >= linearisations - 1 and noise_change(samples, old, noise) < NOISE_END:
            break
    nats = nats_of(data.seen, variances @ problem.prior.spectra, problem.law_of_mode)
    of_laws = {law: variances[problem.law_of_variance == number] for number, law in enumerate(problem.laws)}
    return Learned(of_laws, noise, dict(zip(problem.laws, nats, strict=True)), fit.evidence, x)


def nats_of_scatter(problem: LawProblem, learning: Learned) -> float:
    """Return how much the learned noise raises the log evidence over the sensors', as declared times a factor."""
    alone = PoseNoise.of(learning.noise.sensor, learning.noise.joint.size)
    sensors = learn(problem, learning._replace(noise=alone), WITHOUT_SCATTER, shared=False)
    return max(learning.evidence - sensors.evidence, 0.0)


def posterior(problem: LawProblem, learning: Learned) -> Posterior:
    """Return the posterior of all poses with the learned variances and noise, linearised at what was learned."""
    active = problem.acting()
    data = _data(active, learning.x, active.rows(learning.x), learning.noise)
    return _posterior(problem, learning.x, data, problem.sizes(learning.variances))


class _Data(NamedTuple):
    """What rows say of the modes f with g integrated out, and of g for f = 0, in units of its prior."""

    seen: Seen
    g: Floats  # (g,)
    by_mode: Floats  # (g, f)
    root: Floats  # (g, g) R with R Rᵀ the covariance of g given f
    evidence: float  # without laws


def _data(problem: LawProblem, x: Floats, rows: Iterable[RowsByPose], noise: PoseNoise) -> _Data:
    """Return the information of rows that were linearised at x (P,)."""
    g = problem.sigma.size
    gram, logdet = pose_information(rows, problem.is_law.size + 1, noise)
    gram = problem.by_modes(problem.by_modes(gram, x).T, x)
    geometry = gram[:g, :g]
    prior = np.diag(1.0 + ROUNDING * np.diag(geometry))
    lower = np.asarray(np.linalg.cholesky(geometry + prior), dtype=float)
    half = solve_lower(lower, gram[:g, g:])
    remaining = gram[g:, g:] - half.T @ half
    logdet += 2.0 * float(np.log(np.diag(lower)).sum())
    root = solve_lower(lower, np.eye(g)).T
    seen = seen_by(remaining[:-1, :-1], remaining[:-1, -1], problem.prior)
    return _Data(seen, root @ half[:, -1], -root @ half[:, :-1], root, -0.5 * (logdet + float(remaining[-1, -1])))


def _posterior(problem: LawProblem, x: Floats, data: _Data, variances: Floats) -> Posterior:
    """Return x and its covariance for variances (v,); the rows may have had fewer columns of laws."""
    sizes = variances @ problem.prior.spectra
    at_sizes = modes_at(data.seen, sizes)
    by_g, law = problem.sigma[:, None], problem.is_law
    modes = np.concatenate([by_g * data.by_mode, problem.basis]) * sizes
    away = modes @ at_sizes.x.T
    half = modes / np.where(sizes > 0.0, np.sqrt(sizes), 1.0)
    covariance = half @ half.T - away @ away.T
    geometry, count = by_g * data.root, by_g.size
    covariance[:count, :count] += geometry @ geometry.T
    order = np.argsort(np.argsort(law, kind="stable"), kind="stable")  # of x[columns] in [geometry, laws]
    value = modes @ at_sizes.z
    value[:count] += problem.sigma * data.g
    out = x.copy()
    out[problem.columns] = problem.reference[problem.columns] + value[order]
    freedom = float(sizes @ (at_sizes.x**2).sum(axis=0))
    return Posterior(out, covariance[np.ix_(order, order)], data.evidence + at_sizes.nats, freedom)


def nearer_geometry(problem: LawProblem, anywhere: Problem, fit: Posterior, misfit: float) -> Posterior:
    """Return the posterior, moved towards the geometry alone (``problem.start``) where rows do not tell the two apart.

    ``anywhere`` has rows of the same fixtures in random poses, and ``misfit`` is the reduced χ² of the geometry.
    """
    index = np.array([problem.problem.names.index(name) for name in anywhere.names])
    middle = 0.5 * (fit.x + problem.start)[index]  # makes the change exact to second order
    information = observe(anywhere, middle, problem.columns[index])
    column = (np.cumsum(problem.columns) - 1)[index[problem.columns[index]]]
    root = information.root / np.sqrt(max(misfit, np.finfo(float).tiny) * information.n_residuals)
    change = root @ (fit.x - problem.start)[problem.columns][column]
    cross = root @ fit.covariance[column]
    inner = np.eye(len(root)) + cross[:, column] @ root.T
    move = -cross.T @ scipy.linalg.solve(inner, change, assume_a="pos", check_finite=False)
    x = fit.x.copy()
    x[problem.columns] += move
    return fit._replace(x=x, covariance=fit.covariance + np.outer(move, move))


def learned_scatter(
    problem: Problem, x: Floats, columns: NDArray[np.bool_], pose: Indices, fit: Goodness
) -> Scatter | None:
    """Return the scatter of the arm at the estimate x (P,); ``pose`` (n_rows,) are the numbers of the rows' poses.

    Parameters keep their least-squares values: unmodelled errors that differ between the points of a pose would distort
    weights learned from them. None where declared noise explains a ``fit`` to poses of single rows: nothing is left for
    the arm.
    """
    if fit.explained and not shared_poses(problem, pose):
        return None
    laws_problem = law_problem(problem, columns, x, pose, {})
    return scatter_of(laws_problem, learn(laws_problem, PoseNoise.of(1.0, len(problem.chain.joints), JOINT_NOISE)))


def scatter_of(problem: LawProblem, learned: Learned) -> Scatter:
    """Return the scatter that was learned beside the laws of a problem."""
    noise, joints = learned.noise, problem.problem.chain.joints
    return Scatter(
        noise.sensor,
        math.sqrt(noise.shared),
        math.sqrt(noise.turned),
        dict(zip((joint.name for joint in joints), np.sqrt(noise.joint).tolist(), strict=True)),
        tuple(joint.name for joint in joints if joint.kind != "revolute"),
        nats_of_scatter(problem, learned),
        shared_poses(problem.problem, problem.pose),
        {},
    )


def is_of_arm(scatter: Scatter) -> bool:
    """Return whether noise of the sensors alone would seldom raise the evidence for errors of the arm so much.

    Twice the nats are then χ² (Wilks), of at most as many degrees of freedom as the arm's errors have variances.
    """
    return bool(2.0 * scatter.nats > chdtri(len(scatter.joint) + 2, LEVEL))


def covariance_with(
    scatter: Scatter, problem: Problem, x: Floats, columns: NDArray[np.bool_], root: Floats, pose: Indices
) -> Floats:
    """Return the covariance (k, k) of least-squares estimates at x (P,), where ``root`` (k, r) is S.

    With Q = J S and the learned covariance R of the whitened rows it is S (I + Qᵀ(R − I)Q) Sᵀ. A prior, which is not
    based on any row, enters it as declared.
    """
    sigma = np.concatenate([np.repeat([scatter.shared, scatter.turned], MOTIONS), list(scatter.joint.values())])
    excess = np.eye(root.shape[1])
    for poses in pose_rows(problem, x, columns, pose):
        if not poses.is_knowledge:
            seen = poses.rows[..., :-1] @ root
            rows = seen.reshape(-1, root.shape[1])
            along = ((poses.moved * sigma).swapaxes(1, 2) @ seen).reshape(-1, root.shape[1])
            excess += max(scatter.factor - 1.0, 0.0) * rows.T @ rows + along.T @ along  # at least as declared
    return np.asarray(root @ excess @ root.T)


def shared_poses(problem: Problem, pose: Indices) -> int:
    """Return how many poses have several rows; 0 if fewer than half of the rows are in one of these."""
    rows = [group.row for group in problem.groups if group.row is not None]
    count = np.unique(pose[np.concatenate(rows)], return_counts=True)[1] if rows else np.zeros(0, np.intp)
    several = count[count > 1]
    return several.size if several.size and several.sum() >= LEAST_SHARE * count.sum() else 0
