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
        used = np.ones(self.is_law.size, dtype=bool)
        used[self.is_law] = acts
        columns = self.columns.copy()
        columns[columns] = used
        blocks, first = [], 0
        for block in self.blocks:
            kept = acts[block.columns]
            last = first + int(kept.sum())
            blocks.append(replace(block, columns=slice(first, last), kernels=block.kernels[:, kept][..., kept]))
            first = last
        return replace(self, columns=columns, is_law=self.is_law[used], sigma=self.sigma[used], blocks=tuple(blocks))

    def some(self) -> LawProblem:
        """Return the problem of the ``acting`` coefficients and at most LEARNING random poses."""
        share, numbers = self.times(LEARNING), np.unique(self.pose)
        if share <= 1.0:
            return self.acting()
        kept = np.random.default_rng(0).permutation(numbers)[: int(numbers.size / share)]
        return replace(self.acting(), problem=only(self.problem, np.isin(self.pose, kept)))

    def rows(self, x: Floats, every: int = 1) -> Iterator[RowsByPose]:
        """Return ``pose_rows`` of the fitted unknowns at x (P,)."""
        return pose_rows(self.problem, x, self.columns, self.pose, every)

    def times(self, most: tuple[int, int]) -> float:
        """Return how many times as many poses or residuals there are, whichever is more."""
        residuals = 0
        for group in (group for group in self.problem.groups if group.row is not None):
            of_pose = np.unique(self.pose[group.row], return_counts=True)[1] * group.sensor_cov.shape[1]
            residuals += int(np.minimum(of_pose, MOST_OF_POSE).sum())
        poses = np.unique(self.pose[_rows_used(self.problem)]).size
        return max(poses / most[0], residuals / most[1])

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


def learn(of: LawProblem, start: PoseNoise | Learned, rounds: int = ROUNDS, shared: bool = True) -> Learned:
    """Learn variances and noise from at most LEARNING poses; without ``shared``, no error that the rows of a pose share.

    They start from what was learned with more laws; with a noise alone, all variances start small.
    """
    part = of.some()
    blocks = part.blocks
    if isinstance(start, Learned):
        values, noise, x, least = [start.variances[law] for law in of.laws], start.noise, start.x, 0
    else:
        values = [np.full(len(block.kernels), (START * block.cap) ** 2) for block in blocks]
        noise, x, least = start, of.start, LEAST_ROUNDS
    shared = shared and of.shares_poses
    if shared and not noise.shared:
        noise = noise._replace(shared=SHARED_START, turned=SHARED_START)
    every = max(1, int(part.times(FOR_NOISE)))
    for i in steps_of(range(rounds), "learning the sizes of joint laws and noise"):
        rows = list(part.rows(x)) if every == 1 else []  # more would take much memory
        marginal, rest = _marginal(part, x, rows or part.rows(x), noise)
        seen = seen_by(marginal, blocks)
        values = learned(seen, blocks, revived(seen, blocks, values), STEPS)
        weighed = weigh(seen, blocks, values)
        found = coefficients(marginal, weighed, blocks, values)
        here = _posterior(part, x, marginal, rest, found, weighed.nats)
        step = (x - here.x)[part.columns]
        samples = pose_samples(rows or part.rows(x, every), step, here.covariance)
        x, old, noise = here.x, noise, learned_noise(samples, noise, shared)
        if i >= least and noise_change(samples, old, noise) < NOISE_END:
            break
    nats = {law: block_nats(weighed, b, v) for law, b, v in zip(of.laws, blocks, values, strict=True)}
    return Learned(dict(zip(of.laws, values, strict=True)), noise, nats, here.evidence, x)


def nats_of_scatter(of: LawProblem, found: Learned) -> float:
    """Return how much the learned noise raises the log evidence over that of the sensors alone, as declared times a factor."""
    alone = PoseNoise.of(found.noise.sensor, found.noise.joint.size)
    sensors = learn(of, found._replace(noise=alone), WITHOUT_SCATTER, shared=False)
    return max(found.evidence - sensors.evidence, 0.0)


def posterior(of: LawProblem, found: Learned) -> Posterior:
    """Return the posterior of all poses with the learned variances and noise, linearised at what was learned."""
    blocks, part = of.blocks, of.acting()
    values = [found.variances[law] for law in of.laws]
    marginal, rest = _marginal(of, found.x, part.rows(found.x), found.noise, part.columns[of.columns])
    weighed = weigh(seen_by(marginal, blocks), blocks, values)
    return _posterior(of, found.x, marginal, rest, coefficients(marginal, weighed, blocks, values), weighed.nats)


class _Rest(NamedTuple):
    """Everything except laws, integrated out: solutions (k − l, l + 1) for the laws' columns and the residual, and more."""

    solved: Floats
    covariance: Floats  # (k − l, k − l) given the laws
    evidence: float  # without laws


def _marginal(
    of: LawProblem, x: Floats, rows: Iterable[RowsByPose], noise: PoseNoise, used: Mask | None = None
) -> tuple[Marginal, _Rest]:
    """Return the poses' information about the laws, linearised at x (P,), about no laws and the reference of the rest.

    The rows have derivatives by all unknowns, or those that are ``used`` (k,).
    """
    filled = np.ones(of.is_law.size + 1, dtype=bool)
    filled[:-1] = True if used is None else used
    triangle, logdet = pose_information(rows, int(filled.sum()), noise)
    root = np.zeros((len(triangle), filled.size))
    root[:, filled] = triangle
    root[:, -1] += root[:, :-1] @ (x - of.reference)[of.columns]
    order = np.concatenate([np.flatnonzero(~of.is_law), np.flatnonzero(of.is_law), [-1]])
    n = int((~of.is_law).sum())
    weight = 1.0 / of.sigma[~of.is_law]
    triangle, solved, left = eliminated(np.diag(weight), root[:, order])
    inverse = scipy.linalg.solve_triangular(triangle, np.eye(n), check_finite=False)
    logdet += 2.0 * float(np.log(np.abs(np.diag(triangle)) / weight).sum())
    evidence = -0.5 * (logdet + float((left[:, -1] ** 2).sum()))
    return Marginal(left[:, :-1], left[:, -1]), _Rest(inverse @ solved, inverse @ inverse.T, evidence)


def _posterior(
    of: LawProblem, x: Floats, marginal: Marginal, rest: _Rest, found: Coefficients, nats: float
) -> Posterior:
    c, covariance = found.value, found.covariance
    by_law = -rest.solved[:, :-1]
    law = of.is_law
    value, full = np.zeros(law.size), np.zeros((law.size, law.size))
    value[law], value[~law] = c, rest.solved[:, -1] + by_law @ c
    cross = by_law @ covariance
    full[np.ix_(law, law)] = covariance
    full[np.ix_(~law, law)], full[np.ix_(law, ~law)] = cross, cross.T
    full[np.ix_(~law, ~law)] = rest.covariance + cross @ by_law.T
    out = x.copy()
    out[of.columns] = of.reference[of.columns] + value
    return Posterior(out, full, rest.evidence + nats, marginal.root, found.prior_root)


def _rows_used(problem: Problem) -> Indices:
    """Return the rows of the table that a problem has observations of."""
    return np.concatenate([group.row for group in problem.groups if group.row is not None])


def nearer_geometry(of: LawProblem, anywhere: Problem, found: Posterior, misfit: float) -> Posterior:
    """Return the posterior moved towards ``of.start``, the geometry alone, where the rows do not determine the difference.

    ``anywhere`` has rows of the same fixtures in random poses, and ``misfit`` is the reduced χ² of the geometry.
    """
    at = np.array([of.problem.names.index(name) for name in anywhere.names])
    middle = 0.5 * (found.x + of.start)[at]  # makes the change exact to second order
    seen = observe(anywhere, middle, of.columns[at])
    used = (np.cumsum(of.columns) - 1)[at[of.columns[at]]]
    root = seen.root / np.sqrt(max(misfit, np.finfo(float).tiny) * seen.n_residuals)
    change = root @ (found.x - of.start)[of.columns][used]
    cross = root @ found.covariance[used]
    inner = np.eye(len(root)) + cross[:, used] @ root.T
    move = -cross.T @ scipy.linalg.solve(inner, change, assume_a="pos", check_finite=False)
    x = found.x.copy()
    x[of.columns] += move
    return found._replace(x=x, covariance=found.covariance + np.outer(move, move))
