"""Joint fit of geometry, rig and joint laws, with their variances and the noise per pose learned by evidence.

The laws are fitted together with the geometry rather than to its residuals, because a geometry without sag has already
absorbed most of it. ``law_choice`` decides which laws are kept.

Poses in a corner of the joint space determine the sum of geometry and laws there, but not elsewhere. The evidence keeps
one of several combinations, whose extrapolation may be worse than that of the geometry. The estimate is therefore moved
towards the geometry as far as the fitted rows permit (``nearer_geometry``): an RMS change elsewhere as large as what the
geometry leaves costs as much as one residual of one σ (docs/explanation/estimation.md). Where many poses determine the
laws, this changes nothing. The covariance of the result is P plus the square of the move, its mean square error if
x ~ N(x, P).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from truearm.estimate.evidence import (
    Coefficients,
    Marginal,
    PriorBlock,
    block_nats,
    coefficients,
    learned,
    revived,
    seen_by,
    weigh,
)
from truearm.estimate.information import eliminated, observe
from truearm.estimate.law_candidates import acting, prior_blocks
from truearm.estimate.pose_noise import (
    PoseNoise,
    RowsByPose,
    learned_noise,
    noise_change,
    pose_information,
    pose_rows,
    pose_samples,
)
from truearm.estimate.problem import Problem
from truearm.estimate.whitened_rows import only
from truearm.progress import steps_of
from truearm.types import Floats, Indices, Law, Mask
from truearm.units import UNITS

START = 0.2  # of the cap: initial standard deviations
LEARNING = (
    3000,
    9000,
)  # poses and residuals: variances and noise are learned from a random selection of at most so many
FOR_NOISE = (1000, 3000)  # of these, for the noise
MOST_OF_POSE = 72  # residuals of a pose that count among these: repeats must not take the place of poses
LEAST_ROUNDS = 3  # without anything learned before
ROUNDS = 12  # of linearising, learning the variances and learning the noise
WITHOUT_SCATTER = 2  # of them: laws and robot are already those of the rows
STEPS = 8  # of the variances in a round
NOISE_END = 0.01  # the last round changes the variance of the rows by less
SHARED_START = 1e-10  # m² and rad²
RIG_SIGMA = 10.0  # m, rad: keeps unknowns without a prior finite along null directions


@dataclass(frozen=True, eq=False)
class LawProblem:
    """A problem whose robot has laws. Parameters other than laws have a prior about ``reference`` (P,) with ``sigma`` (k,)."""

    problem: Problem
    columns: NDArray[np.bool_]  # (P,) the k fitted ones
    is_law: NDArray[np.bool_]  # (k,)
    pose: Indices  # (n_rows,)
    start: Floats  # (P,) as fitted without laws
    reference: Floats  # (P,)
    sigma: Floats  # (k,)
    laws: tuple[Law, ...]
    blocks: tuple[PriorBlock, ...]  # of the laws' coefficients

    def acting(self) -> LawProblem:
        """Return the problem of the coefficients that act at any reading: all others have no column in the rows."""
        acts = np.concatenate([np.zeros(0, bool), *(acting(law) for law in self.laws)])
        active = np.ones(self.is_law.size, dtype=bool)
        active[self.is_law] = acts
        columns = self.columns.copy()
        columns[columns] = active
        blocks, first = [], 0
        for block in self.blocks:
            chosen = acts[block.columns]
            last = first + int(chosen.sum())
            blocks.append(replace(block, columns=slice(first, last), kernels=block.kernels[:, chosen][..., chosen]))
            first = last
        is_law, sigma = self.is_law[active], self.sigma[active]
        return replace(self, columns=columns, is_law=is_law, sigma=sigma, blocks=tuple(blocks))

    def some(self) -> LawProblem:
        """Return the problem of the ``acting`` coefficients and at most LEARNING random poses."""
        share, numbers = self.times(LEARNING), np.unique(self.pose)
        if share <= 1.0:
            return self.acting()
        chosen = np.random.default_rng(0).permutation(numbers)[: int(numbers.size / share)]
        return replace(self.acting(), problem=only(self.problem, np.isin(self.pose, chosen)))

    def rows(self, x: Floats, stride: int = 1) -> Iterator[RowsByPose]:
        """Return ``pose_rows`` of the fitted unknowns at x (P,)."""
        return pose_rows(self.problem, x, self.columns, self.pose, stride)

    def times(self, limits: tuple[int, int]) -> float:
        """Return how many times as many poses or residuals there are, whichever is more."""
        residuals = 0
        for group in (group for group in self.problem.groups if group.row is not None):
            of_pose = np.unique(self.pose[group.row], return_counts=True)[1] * group.sensor_cov.shape[1]
            residuals += int(np.minimum(of_pose, MOST_OF_POSE).sum())
        poses = np.unique(self.pose[_rows_used(self.problem)]).size
        return max(poses / limits[0], residuals / limits[1])

    @property
    def shares_poses(self) -> bool:
        """Return whether any pose has several rows."""
        return bool((np.bincount(self.pose) > 1).any())


def law_problem(
    problem: Problem, columns: NDArray[np.bool_], start: Floats, laws: Sequence[Law], pose: Indices
) -> LawProblem:
    """Return a problem whose robot has these laws, with their parameters last; ``start`` (P,): the rest, fitted without.

    Unknowns without a prior get a weak one about ``start``, so redundant parameters are allowed.
    """
    blocks = tuple(prior_blocks(laws))
    is_law = np.zeros(columns.size, dtype=bool)
    is_law[problem.n_robot - (blocks[-1].columns.stop if blocks else 0) : problem.n_robot] = True
    declared = np.isfinite(problem.prior_sigma)
    sigma = np.array([UNITS[unit].wide_sigma for unit in problem.units])
    sigma[problem.n_robot :] = RIG_SIGMA
    sigma[declared] = problem.prior_sigma[declared]
    reference = np.where(declared, problem.start, start)
    return LawProblem(problem, columns, is_law[columns], pose, start, reference, sigma[columns], tuple(laws), blocks)


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

    The transpose of ``law_root`` (m, l) times it is the data's information about the laws; ``prior_root`` (l, p) times
    its transpose is their prior.
    """

    x: Floats
    covariance: Floats
    evidence: float
    law_root: Floats
    prior_root: Floats


def learn(problem: LawProblem, start: PoseNoise | Learned, rounds: int = ROUNDS, shared: bool = True) -> Learned:
    """Learn variances and noise from at most LEARNING poses; without ``shared``, no error that the rows of a pose share.

    They start from what was learned with more laws; with a noise alone, all variances start small.
    """
    sample = problem.some()
    blocks = sample.blocks
    if isinstance(start, Learned):
        values, noise, x, least_rounds = [start.variances[law] for law in problem.laws], start.noise, start.x, 0
    else:
        values = [np.full(len(block.kernels), (START * block.cap) ** 2) for block in blocks]
        noise, x, least_rounds = start, problem.start, LEAST_ROUNDS
    shared = shared and problem.shares_poses
    if shared and not noise.shared:
        noise = noise._replace(shared=SHARED_START, turned=SHARED_START)
    stride = max(1, int(sample.times(FOR_NOISE)))
    for i in steps_of(range(rounds), "learning the sizes of joint laws and noise"):
        rows = list(sample.rows(x)) if stride == 1 else []  # more would take much memory
        marginal, geometry = _marginal(sample, x, rows or sample.rows(x), noise)
        data = seen_by(marginal, blocks)
        values = learned(data, blocks, revived(data, blocks, values), STEPS)
        weighed = weigh(data, blocks, values)
        estimates = coefficients(marginal, weighed, blocks, values)
        fit = _posterior(sample, x, marginal, geometry, estimates, weighed.nats)
        step = (x - fit.x)[sample.columns]
        samples = pose_samples(rows or sample.rows(x, stride), step, fit.covariance)
        x, old, noise = fit.x, noise, learned_noise(samples, noise, shared)
        if i >= least_rounds and noise_change(samples, old, noise) < NOISE_END:
            break
    nats = {law: block_nats(weighed, b, v) for law, b, v in zip(problem.laws, blocks, values, strict=True)}
    return Learned(dict(zip(problem.laws, values, strict=True)), noise, nats, fit.evidence, x)


def nats_of_scatter(problem: LawProblem, learning: Learned) -> float:
    """Return how much the learned noise raises the log evidence over that of the sensors alone, as declared times a factor."""
    alone = PoseNoise.of(learning.noise.sensor, learning.noise.joint.size)
    sensors = learn(problem, learning._replace(noise=alone), WITHOUT_SCATTER, shared=False)
    return max(learning.evidence - sensors.evidence, 0.0)


def posterior(problem: LawProblem, learning: Learned) -> Posterior:
    """Return the posterior of all poses with the learned variances and noise, linearised at what was learned."""
    x, noise, blocks, active = learning.x, learning.noise, problem.blocks, problem.acting()
    values = [learning.variances[law] for law in problem.laws]
    marginal, geometry = _marginal(problem, x, active.rows(x), noise, active.columns[problem.columns])
    weighed = weigh(seen_by(marginal, blocks), blocks, values)
    estimates = coefficients(marginal, weighed, blocks, values)
    return _posterior(problem, x, marginal, geometry, estimates, weighed.nats)


class _Geometry(NamedTuple):
    """Everything except laws, integrated out: solutions (k − l, l + 1) for the laws' columns and the residual, and more."""

    solved: Floats
    covariance: Floats  # (k − l, k − l) given the laws
    evidence: float  # without laws


def _marginal(
    problem: LawProblem, x: Floats, rows: Iterable[RowsByPose], noise: PoseNoise, active: Mask | None = None
) -> tuple[Marginal, _Geometry]:
    """Return the poses' information about the laws, linearised at x (P,), about no laws and the reference of the rest.

    The rows have derivatives by all unknowns, or those that are ``active`` (k,).
    """
    filled = np.ones(problem.is_law.size + 1, dtype=bool)
    filled[:-1] = True if active is None else active
    triangle, logdet = pose_information(rows, int(filled.sum()), noise)
    root = np.zeros((len(triangle), filled.size))
    root[:, filled] = triangle
    root[:, -1] += root[:, :-1] @ (x - problem.reference)[problem.columns]
    order = np.concatenate([np.flatnonzero(~problem.is_law), np.flatnonzero(problem.is_law), [-1]])
    n = int((~problem.is_law).sum())
    weight = 1.0 / problem.sigma[~problem.is_law]
    triangle, solved, reduced = eliminated(np.diag(weight), root[:, order])
    inverse = scipy.linalg.solve_triangular(triangle, np.eye(n), check_finite=False)
    logdet += 2.0 * float(np.log(np.abs(np.diag(triangle)) / weight).sum())
    evidence = -0.5 * (logdet + float((reduced[:, -1] ** 2).sum()))
    return Marginal(reduced[:, :-1], reduced[:, -1]), _Geometry(inverse @ solved, inverse @ inverse.T, evidence)


def _posterior(
    problem: LawProblem, x: Floats, marginal: Marginal, geometry: _Geometry, estimates: Coefficients, nats: float
) -> Posterior:
    c, covariance = estimates.value, estimates.covariance
    by_law = -geometry.solved[:, :-1]
    law = problem.is_law
    value, full = np.zeros(law.size), np.zeros((law.size, law.size))
    value[law], value[~law] = c, geometry.solved[:, -1] + by_law @ c
    cross = by_law @ covariance
    full[np.ix_(law, law)] = covariance
    full[np.ix_(~law, law)], full[np.ix_(law, ~law)] = cross, cross.T
    full[np.ix_(~law, ~law)] = geometry.covariance + cross @ by_law.T
    out = x.copy()
    out[problem.columns] = problem.reference[problem.columns] + value
    return Posterior(out, full, geometry.evidence + nats, marginal.root, estimates.prior_root)


def _rows_used(problem: Problem) -> Indices:
    """Return the rows of the table that a problem has observations of."""
    return np.concatenate([group.row for group in problem.groups if group.row is not None])


def nearer_geometry(of: LawProblem, anywhere: Problem, fit: Posterior, misfit: float) -> Posterior:
    """Return the posterior moved towards ``of.start``, the geometry alone, where the rows do not determine the difference.

    ``anywhere`` has rows of the same fixtures in random poses, and ``misfit`` is the reduced χ² of the geometry.
    """
    index = np.array([of.problem.names.index(name) for name in anywhere.names])
    middle = 0.5 * (fit.x + of.start)[index]  # makes the change exact to second order
    information = observe(anywhere, middle, of.columns[index])
    column = (np.cumsum(of.columns) - 1)[index[of.columns[index]]]
    root = information.root / np.sqrt(max(misfit, np.finfo(float).tiny) * information.n_residuals)
    change = root @ (fit.x - of.start)[of.columns][column]
    cross = root @ fit.covariance[column]
    inner = np.eye(len(root)) + cross[:, column] @ root.T
    move = -cross.T @ scipy.linalg.solve(inner, change, assume_a="pos", check_finite=False)
    x = fit.x.copy()
    x[of.columns] += move
    return fit._replace(x=x, covariance=fit.covariance + np.outer(move, move))
