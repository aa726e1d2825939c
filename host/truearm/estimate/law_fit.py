"""Geometry, rig and joint laws fitted together, their variances and the noise a pose learned by the evidence.

The laws are fitted with the geometry, not to its residuals: a geometry without sag has swallowed most of it. A law that raises
the log evidence by less than GATE nats is dropped; one below EARNEST is dropped for good where the evidence, with the noise
learned again without it, is no lower than that either. Evidence without a gate makes small data worse.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from truearm.estimate.evidence import Marginal, Weighed, block_nats, learned, revived, weigh
from truearm.estimate.law_candidates import prior_blocks
from truearm.estimate.pose_noise import (
    PoseNoise,
    PoseSample,
    learned_noise,
    normal_matrix,
    pose_samples,
    unknowns_of_rows,
)
from truearm.estimate.problem import Problem
from truearm.estimate.whitened_rows import only
from truearm.kinds.linearised import Indices
from truearm.types import Floats, Law
from truearm.units import UNITS

GATE = 6.0  # nats
EARNEST = 25.0  # nats
START = 0.2  # of the cap: standard deviations to begin with
LEARNING_POSES = 3000  # a random choice of more learns variances and noise
NOISE_POSES = 1000  # of these learn the noise
ROUNDS = 12  # of linearising, learning the variances and learning the noise
FIRST_STEPS, STEPS = 30, 12  # of the variances, in the first rounds and later
NOISE_END = 0.02  # a round that changes the noise's variances by less is the last
SHARED_START = 1e-10  # m²
NOTHING = (1e-3, 1e-14, 1e-13)  # noise below this adds nothing: it may fall for ever
RIG_SIGMA = 10.0  # m, rad: what no prior holds stays finite where the data see nothing


@dataclass(frozen=True, eq=False)
class LawProblem:
    """A problem whose robot has laws. The prior of what is not a law is about ``reference`` (P,) with ``sigma`` (k,)."""

    problem: Problem
    columns: NDArray[np.bool_]  # (P,) what is fitted, k of them
    is_law: NDArray[np.bool_]  # (k,)
    pose: Indices  # (n_rows,)
    start: Floats  # (P,) as fitted without laws
    reference: Floats  # (P,)
    sigma: Floats  # (k,)
    laws: tuple[Law, ...]

    def some(self, n: int) -> LawProblem:
        """With a random choice of at most n poses."""
        numbers = np.unique(self.pose)
        if numbers.size <= n:
            return self
        kept = np.random.default_rng(0).permutation(numbers)[:n]
        return replace(self, problem=only(self.problem, np.isin(self.pose, kept)))

    @property
    def shares_poses(self) -> bool:
        """Whether any pose has several rows."""
        return bool((np.bincount(self.pose) > 1).any())


def law_problem(
    problem: Problem, columns: NDArray[np.bool_], start: Floats, laws: Sequence[Law], pose: Indices
) -> LawProblem:
    """A problem whose robot has these laws, their parameters the robot's last; ``start`` (P,): the rest as fitted without.

    What no prior holds has a weak one about ``start``, so that redundant parameters are welcome.
    """
    blocks = prior_blocks(laws)
    is_law = np.zeros(columns.size, dtype=bool)
    is_law[problem.n_robot - (blocks[-1].columns.stop if blocks else 0) : problem.n_robot] = True
    declared = np.isfinite(problem.prior_sigma)
    sigma = np.array([UNITS[unit].wide_sigma for unit in problem.units])
    sigma[problem.n_robot :] = RIG_SIGMA
    sigma[declared] = problem.prior_sigma[declared]
    reference = np.where(declared, problem.start, start)
    return LawProblem(problem, columns, is_law[columns], pose, start, reference, sigma[columns], tuple(laws))


class Learned(NamedTuple):
    """What the evidence chose: the variances of each law's prior, the noise, and by how many nats each law pays.

    ``evidence`` is the log evidence of the rows that were learned from.
    """

    variances: Mapping[Law, Floats]
    noise: PoseNoise
    nats: Mapping[Law, float]
    evidence: float


class Posterior(NamedTuple):
    """The unknowns at some variances and noise: x (P,), the covariance (k, k) and the log evidence."""

    x: Floats
    covariance: Floats
    weighed: Weighed
    evidence: float


def learn(of: LawProblem, variances: Mapping[Law, Floats], noise: PoseNoise) -> Learned:
    """Learn variances and noise from at most LEARNING_POSES poses; ``variances`` may lack laws, which begin small."""
    part, blocks = of.some(LEARNING_POSES), prior_blocks(of.laws)
    values = [
        variances.get(law, np.full(len(block.kernels), (START * block.cap) ** 2))
        for law, block in zip(of.laws, blocks, strict=True)
    ]
    shared = of.shares_poses
    if shared and not noise.shared:
        noise = noise._replace(shared=SHARED_START)
    every = max(1, np.unique(part.pose[_rows_used(part.problem)]).size // NOISE_POSES)
    x = of.start
    for i in range(ROUNDS):
        marginal, rest = _marginal(part, x, noise)
        values = learned(marginal, blocks, revived(marginal, blocks, values), FIRST_STEPS if i < 2 else STEPS)
        here = _posterior(part, x, rest, weigh(marginal, blocks, values))
        samples = _samples(part, x, here, every)
        x, old, noise = here.x, noise, learned_noise(samples, noise, shared)
        new, before = np.array(noise), np.array(old)
        if i > 2 and np.all((np.abs(new - before) <= NOISE_END * new) | (new < NOTHING)):
            break
    nats = {law: block_nats(here.weighed, b, v) for law, b, v in zip(of.laws, blocks, values, strict=True)}
    return Learned(dict(zip(of.laws, values, strict=True)), noise, nats, here.evidence)


def gated(
    make: Callable[[Sequence[Law]], LawProblem], laws: Sequence[Law], found: Learned
) -> tuple[tuple[Law, ...], Learned, dict[Law, float]]:
    """Drop the laws that the evidence does not carry; ``make`` makes the problem with some laws.

    Returns the laws that are kept, what was learned with them, and the nats at which each of the others was dropped.
    """
    dropped: dict[Law, float] = {}
    sure: set[Law] = set()
    while True:
        weak = [law for law in laws if found.nats[law] < GATE]
        if weak:
            dropped |= {law: found.nats[law] for law in weak}
            laws = [law for law in laws if law not in weak]
            found = learn(make(laws), found.variances, found.noise)
            continue
        doubtful = [law for law in laws if found.nats[law] < EARNEST and law not in sure]
        if not doubtful:
            return tuple(laws), found, dropped
        weakest = min(doubtful, key=found.nats.__getitem__)
        without = learn(make([law for law in laws if law != weakest]), found.variances, found.noise)
        gain = found.evidence - without.evidence
        if gain < GATE:
            dropped[weakest] = gain
            laws, found = [law for law in laws if law != weakest], without
        else:
            sure.add(weakest)


def posterior(of: LawProblem, found: Learned, rounds: int = 2) -> Posterior:
    """All poses at what was learned, linearised where it ends."""
    x, blocks = of.start, prior_blocks(of.laws)
    for _ in range(rounds):
        marginal, rest = _marginal(of, x, found.noise)
        here = _posterior(of, x, rest, weigh(marginal, blocks, [found.variances[law] for law in of.laws]))
        x = here.x
    return here


class _Rest(NamedTuple):
    """What is not a law, integrated out: solutions (k − l, l + 1) for the laws' columns and the residual, and more."""

    solved: Floats
    covariance: Floats  # (k − l, k − l) with the laws known
    evidence: float  # of no laws


def _marginal(of: LawProblem, x: Floats, noise: PoseNoise) -> tuple[Marginal, _Rest]:
    """What the poses say of the laws, linearised at x (P,), about no laws and the reference of the rest."""
    normals = normal_matrix(of.problem, x, of.columns, of.pose, noise)
    n, rhs, square = normals.matrix[:-1, :-1], normals.matrix[:-1, -1], float(normals.matrix[-1, -1])
    moved = (x - of.reference)[of.columns]
    square += float(moved @ (2.0 * rhs + n @ moved))
    rhs = rhs + n @ moved
    rest, law = ~of.is_law, of.is_law
    weight = 1.0 / of.sigma[rest]
    inner = n[np.ix_(rest, rest)] + np.diag(weight**2)
    scale = 1.0 / np.sqrt(np.diag(inner))  # metres and radians alike, before the condition is squared
    factor = scipy.linalg.cho_factor(inner * scale * scale[:, None], check_finite=False)
    right = np.column_stack([n[np.ix_(rest, law)], rhs[rest]])
    solved = scale[:, None] * scipy.linalg.cho_solve(factor, scale[:, None] * right, check_finite=False)
    inverse = scale[:, None] * scipy.linalg.cho_solve(factor, np.diag(scale), check_finite=False)
    a = n[np.ix_(law, law)] - right[:, :-1].T @ solved[:, :-1]
    b = rhs[law] - right[:, :-1].T @ solved[:, -1]
    logdet = 2.0 * float((np.log(np.diag(factor[0])) - np.log(scale) - np.log(weight)).sum())
    evidence = -0.5 * (normals.logdet + square - float(rhs[rest] @ solved[:, -1]) + logdet)
    return Marginal(0.5 * (a + a.T), b), _Rest(solved, inverse, evidence)


def _posterior(of: LawProblem, x: Floats, rest: _Rest, weighed: Weighed) -> Posterior:
    c, covariance = weighed.posterior()
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
    return Posterior(out, full, weighed, rest.evidence + weighed.nats)


def _samples(of: LawProblem, x: Floats, here: Posterior, every: int) -> list[PoseSample]:
    """The poses' residuals at the posterior, linearised at x."""
    mix = unknowns_of_rows(of.problem, x, of.columns)
    step = mix @ np.append((x - here.x)[of.columns], 1.0)
    return pose_samples(of.problem, x, of.pose, step, mix[:, :-1] @ here.covariance @ mix[:, :-1].T, every)


def _rows_used(problem: Problem) -> Indices:
    """The rows of the table that a problem has observations of."""
    return np.concatenate([group.row for group in problem.groups if group.row is not None])
