"""Probability of what was mounted at each dwell of a ball-bar session, from all available evidence.

docs/decisions/0026-what-was-mounted.md explains the model. The hidden state of a dwell is a pairing of the rig, or
something that is not in it. ``transition`` models how operators change it. Evidence is what was typed, except where it
repeats the plan, and the reading. The forward-backward algorithm of a hidden Markov model weighs runs of dwells
(Rabiner 1989, Proc. IEEE 77, III-B).

The robot is fitted at the same time, linearised about the nominal one, to dwells weighted by the probability of their
pairing. A dwell is judged by the fit without its run, given the dwell before. Fit and judgement alternate, with a noise
that falls along NOISE (deterministic annealing).

The labels of fits with the weak and the wide prior are weighted by the pseudo-marginal likelihood (Geisser & Eddy 1979,
JASA 74, 153).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.linalg import cho_factor, cho_solve

from truearm.estimate.problem import blocks, build_problem
from truearm.estimate.uncertainty import weak_prior, wide_prior
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.progress import steps_of
from truearm.types import BAR_MOUNTED, Floats, Indices, Mask, Rig

Pairing = tuple[str, str, str]  # bar, chuck, sphere

# How operators change what is mounted, as probabilities. The result is insensitive to the second digit.
DONE = 0.9  # the plan asks for another pairing, and it is mounted
FORGOTTEN = 0.05  # the old one remains
PUT_RIGHT = 0.1  # at a dwell where the plan asks for nothing new, a wrong mounting is corrected to the planned one
UNASKED = 2e-3  # anything else, at any dwell
FOREIGN = 1e-3  # something that is not in the rig
ANOTHER_PART = 0.1  # a wrong mounting differs in one part, and with this probability in each further part
# How much likelier a pairing that the plan does not ask for is named when it is mounted than when it is not.
TYPED = 20.0

# m, of a reading about the fitted robot, round by round
NOISE = (5e-3, 4e-3, 3e-3, 2.5e-3, 2e-3, 1.5e-3, 1e-3, 7e-4, 5e-4, 3e-4, 3e-4, 3e-4)
TAIL, TAIL_SIGMAS = 0.01, 10.0  # a reading may be off although the pairing is correct
LOST = 0.02  # a sensor is beyond its stroke although the bar is within
# m, rad and 1: σ of rig values declared as unknown. They are described nevertheless: if a chuck were farther off than
# the travel that a plan keeps in reserve (22 mm), the bar would leave its stroke.
DIFFUSE = 0.02
MOST_PAIRINGS = 150

SURE = 0.998  # minimum probability of a label based on the evidence alone
SUPPORTED = 0.97  # minimum probability of a label on which plan and operator agree, if the readings lower it


@dataclass(frozen=True)
class Readings:
    """The dwells of a session, in order."""

    q: Floats  # (n, j) rad or m
    extension: Floats  # (n,) m, of the sensor; NaN: no reading
    beyond: Mask  # (n,) no reading because the sensor is beyond its stroke

    @property
    def read(self) -> Mask:
        """Return a mask (n,) of dwells with a reading."""
        return np.isfinite(self.extension)


@dataclass(frozen=True)
class Words:
    """What plan and operator state about each of n dwells.

    ``planned``: the pairings that the plan may have mounted, () if unknown. ``typed``: what was entered since the dwell
    before, in order.
    """

    planned: Sequence[Sequence[Pairing]]
    typed: Sequence[Sequence[Pairing]]


@dataclass(frozen=True)
class MountingChances:
    """The probability of each mounting at each dwell.

    ``probability`` (n, k + 1) is that of each of the k ``pairings`` at each dwell, with a last column for none of them.
    ``by_words`` is the same from plan and operator input, without the readings.
    """

    pairings: tuple[Pairing, ...]
    probability: Floats
    by_words: Floats

    def likeliest(self, dwell: int) -> tuple[Pairing | None, float]:
        """Return the most probable pairing of a dwell (None: something not in the rig), and its probability."""
        best = int(self.probability[dwell].argmax())
        return (*self.pairings, None)[best], float(self.probability[dwell, best])

    def supports(self, dwell: int, label: Pairing | None) -> bool:
        """Return whether a label on which plan and operator agree holds: it is certain enough, or not contradicted."""
        if label is None or label not in self.pairings:
            return False
        k = self.pairings.index(label)
        return bool(self.probability[dwell, k] >= min(SUPPORTED, self.by_words[dwell, k]))


def mountings(chain: Chain, rig: Rig, readings: Readings, words: Words, free: Mask) -> MountingChances:
    """Return what was mounted at each dwell. ``free`` (p,): the robot's parameters that are fitted.

    Raises ProblemError if dwells and robot are inconsistent.
    """
    pairings = candidates(rig, words)
    transitions, log_words = _course(words, pairings)
    fits = (_Fit(chain, rig, readings, pairings, free, prior) for prior in (weak_prior(chain), wide_prior(chain)))
    probabilities, evidences = zip(*(_annealed(fit, transitions, log_words) for fit in fits), strict=True)
    by_words, _ = state_probabilities(transitions, log_words, np.zeros_like(log_words), np.zeros_like(log_words))
    return MountingChances(pairings, np.average(probabilities, axis=0, weights=special.softmax(evidences)), by_words)


def candidates(rig: Rig, words: Words) -> tuple[Pairing, ...]:
    """Return all pairings of a rig; for a rig with very many, those named by plan or operator."""
    pairings = tuple(product(rig.bars, rig.chucks, rig.spheres))
    if len(pairings) <= MOST_PAIRINGS:
        return pairings
    named = {pairing for of_dwell in (*words.planned, *words.typed) for pairing in of_dwell}
    return tuple(pairing for pairing in pairings if pairing in named)


def _annealed(fit: _Fit, transitions: Sequence[Floats], log_words: Floats) -> tuple[Floats, float]:
    """Return state probabilities (n, k + 1) and their evidence.

    Fit and labels are alternated under decreasing noise [m].
    """
    nothing = np.zeros_like(log_words)
    probability, evidence = state_probabilities(transitions, log_words, nothing, nothing)
    if not fit.readings.read.any():
        return probability, evidence
    for fit.noise in steps_of(NOISE, "comparing labels with the readings"):
        probability, _ = state_probabilities(transitions, log_words, *fit.densities(fit.judge(probability)))
        fit.move(probability)
    return state_probabilities(transitions, log_words, *fit.densities(fit.judge(probability)))


def _course(words: Words, pairings: Sequence[Pairing]) -> tuple[list[Floats], Floats]:
    """Return the transition to each dwell (the first from anything), and the log-likelihood (n, k + 1) of input.

    The input is the operator's.
    """
    number = {pairing: i for i, pairing in enumerate(pairings)}
    log_words = np.zeros((len(words.planned), len(pairings) + 1))
    wrong = mistakes(pairings)
    transitions = []
    wanted: list[int] = []
    follows_words = not any(words.planned)
    for i, (planned, typed) in enumerate(zip(words.planned, words.typed, strict=True)):
        last_typed = [number[pairing] for pairing in typed if pairing in number][-1:]
        current = last_typed if follows_words else [number[pairing] for pairing in planned if pairing in number]
        # An operator with a wrong part in hand confirms the request anyway.
        if follows_words or not set(last_typed) <= set(current):
            log_words[i, last_typed] += np.log(TYPED)
        asked = bool(current) and set(current) != set(wanted)
        wanted = current or wanted
        transitions.append(transition(wrong, wanted, asked))
    transitions[0][:] = transitions[0][:-1].mean(axis=0)  # what was mounted before the first dwell belongs to the rig
    return transitions, log_words


def mistakes(pairings: Sequence[Pairing]) -> Floats:
    """Return (k, k) the probability that each pairing is mounted by mistake instead of the wanted one (row)."""
    pairs = np.array(pairings)
    differing = (pairs[:, None] != pairs).sum(axis=2)
    share = np.where(differing > 0, ANOTHER_PART ** (differing - 1.0), 0.0)
    return np.asarray(share / np.maximum(share.sum(axis=1, keepdims=True), ANOTHER_PART**2))


def transition(wrong: Floats, wanted: Sequence[int], asked: bool) -> Floats:
    """Return probabilities (k + 1, k + 1) of the transition from the old to the new mounting.

    ``wanted`` are the pairings that the plan may want, and ``asked`` is whether it wants them from this dwell on;
    ``wrong`` (k, k): ``mistakes``.
    """
    k, goal = len(wrong), np.array(wanted, dtype=np.intp)
    out = np.full((k + 1, k + 1), UNASKED / k)
    out[:, k] = FOREIGN
    out[np.diag_indices(k + 1)] += FORGOTTEN if asked else 1.0 - PUT_RIGHT
    if goal.size:
        out[:, goal] += (DONE if asked else PUT_RIGHT) / goal.size
    if asked:
        out[:, :k] += (1.0 - DONE - FORGOTTEN) * wrong[goal].mean(axis=0)
    return np.asarray(out / out.sum(axis=1, keepdims=True))


def state_probabilities(
    transitions: Sequence[Floats], log_words: Floats, came: Floats, stayed: Floats
) -> tuple[Floats, float]:
    """Return the probability (n, s) of each state at each dwell (forward-backward algorithm), and the log-likelihood.

    ``transitions`` (s, s) lead to each dwell, the first from the mean over all states. ``log_words`` (n, s) are
    log-likelihoods of the operator input; ``came`` (n, s) those of the readings if the state changed before, ``stayed``
    if it did not.
    """
    top = np.maximum(came, stayed).max(axis=1, keepdims=True)
    came, stayed = np.exp(came - top + log_words), np.exp(stayed - top + log_words)
    n = len(came)
    forward, backward, scale = np.empty_like(came), np.ones_like(came), np.empty(n)
    forward[0] = transitions[0].mean(axis=0) * came[0]
    scale[0] = forward[0].sum()
    forward[0] /= scale[0]
    for i in range(1, n):
        stay = forward[i - 1] * transitions[i].diagonal()
        step = (forward[i - 1] @ transitions[i] - stay) * came[i] + stay * stayed[i]
        scale[i] = step.sum()
        forward[i] = step / scale[i]
    for i in range(n - 2, -1, -1):
        ahead = backward[i + 1]
        step = transitions[i + 1] @ (came[i + 1] * ahead)
        step += transitions[i + 1].diagonal() * (stayed[i + 1] - came[i + 1]) * ahead
        backward[i] = step / step.sum()
    both = forward * backward
    return np.asarray(both / both.sum(axis=1, keepdims=True)), float(np.log(scale).sum() + top.sum())


class _Misfits(NamedTuple):
    """Readings less predictions for the candidates by the fit without the dwell's run, and their σ, all (n, k) [m].

    ``given``: given the dwell before, in the same state; NaN if there is none.
    """

    misfit: Floats
    sigma: Floats
    given: Floats
    given_sigma: Floats


class _Fit:
    """The robot fitted to the dwells, linearised about its current parameters.

    ``pairings``: the k that each dwell may belong to; ``prior`` (p,): σ of the robot's parameters.
    """

    def __init__(
        self,
        chain: Chain,
        rig: Rig,
        readings: Readings,
        pairings: Sequence[Pairing],
        free: Mask,
        prior: Floats,
    ) -> None:
        self.readings, self.noise = readings, NOISE[0]
        self.n, self.k = len(readings.q), len(pairings)
        bars = [rig.bars[bar] for bar, _, _ in pairings]
        self.gain, self.half = np.array([(bar.gain, 0.5 * bar.travel) for bar in bars]).T
        extension = np.where(readings.read, readings.extension, 0.0)
        table = ObservationTable(
            q=np.repeat(readings.q, self.k, axis=0),
            kind="ball_bar",
            value=([bar.zero for bar in bars] + self.gain * extension[:, None]).ravel(),
            **dict(zip(BAR_MOUNTED, np.tile(pairings, (self.n, 1)).T, strict=True)),
        )
        self.problem = build_problem(chain, rig, table, prior)
        self.columns = self.problem.columns(free)
        self.prior = 1.0 / np.minimum(self.problem.prior_sigma[self.columns], DIFFUSE) ** 2
        self.x = self.problem.start.copy()
        self._linearise()

    def _linearise(self) -> None:
        residual, jac = np.empty(self.n * self.k), np.empty((self.n * self.k, int(self.columns.sum())))
        for group in blocks(self.problem):
            if group.row is not None:
                lin = group.evaluate(self.problem.chain, self.x)
                residual[group.row], jac[group.row] = lin.residual, lin.jac_by(self.columns)
        self.residual, self.jac = residual.reshape(self.n, self.k), jac.reshape(self.n, self.k, -1)

    def _normal(self, probability: Floats) -> tuple[Indices, Floats, Floats, Floats, Floats, Floats]:
        """Return the most probable candidate of each dwell, its weight in the fit [1/m²], derivatives and residual.

        These are (n,), (n,), (n, p), (n,). The weight is 0 where it is improbable. Then information and right-hand side
        of the prior and all dwells.
        """
        rows, best = np.arange(self.n), probability[:, : self.k].argmax(axis=1)
        likely = probability[rows, best]
        weight = np.where(self.readings.read & (likely > 0.5), likely, 0.0) / self.noise**2
        jac, residual = self.jac[rows, best], self.residual[rows, best]
        weighted = jac * weight[:, None]
        error = (self.problem.start - self.x)[self.columns]
        info = np.diag(self.prior) + weighted.T @ jac
        return best, weight, jac, residual, info, self.prior * error + weighted.T @ residual

    def move(self, probability: Floats) -> None:
        """Fit to all dwells, weighted by the probability of their candidates."""
        *_, info, rhs = self._normal(probability)
        self.x[self.columns] += cho_solve(cho_factor(info), rhs)
        self._linearise()

    def judge(self, probability: Floats) -> _Misfits:
        """Compare each dwell with the fit without its run."""
        best, weight, jac, residual, info, rhs = self._normal(probability)
        misfits = _Misfits(*(np.full((self.n, self.k), np.nan) for _ in range(4)))

        def compare(left_out: slice, dwells: slice, are_run: bool) -> None:
            """Compare dwells with the fit without ``left_out``, each given the one before; a run's also alone."""
            less = jac[left_out] * weight[left_out, None]
            root = np.linalg.inv(np.linalg.cholesky(info - less.T @ jac[left_out]))
            delta = root.T @ (root @ (rhs - less.T @ residual[left_out]))
            dwell_jac = self.jac[dwells].reshape(-1, delta.size)  # one product, not one for each dwell
            misfit = self.residual[dwells] - (dwell_jac @ delta).reshape(-1, self.k)
            along = (dwell_jac @ root.T).reshape(-1, self.k, delta.size)
            variance = (along**2).sum(axis=2) + self.noise**2
            if are_run:
                misfits.misfit[dwells], misfits.sigma[dwells] = misfit, np.sqrt(variance)
            ratio = (along[1:] * along[:-1]).sum(axis=2) / variance[:-1]
            both = (self.readings.read[dwells][1:] & self.readings.read[dwells][:-1])[:, None]
            later = slice(dwells.start + 1, dwells.stop)
            misfits.given[later] = np.where(both, misfit[1:] - ratio * misfit[:-1], np.nan)
            misfits.given_sigma[later] = np.sqrt(np.maximum(variance[1:] - ratio**2 * variance[:-1], self.noise**2))

        runs_of_best = runs(best)
        for run in runs_of_best:
            compare(run, run, are_run=True)
        for previous, run in pairwise(runs_of_best):
            compare(slice(previous.start, run.stop), slice(run.start - 1, run.start + 1), are_run=False)
        fitted = np.flatnonzero(weight > 0.0)
        followers = fitted[(fitted > 0) & (best[fitted] == best[fitted - 1])]
        widen(misfits.misfit, misfits.sigma, fitted, best)
        widen(misfits.given, misfits.given_sigma, followers, best)
        return misfits

    def densities(self, misfits: _Misfits) -> tuple[Floats, Floats]:
        """Return log-likelihoods (n, k + 1) [1/m] of each dwell's reading, if the state changed before and if not."""
        k, read, beyond = self.k, self.readings.read, self.readings.beyond & ~self.readings.read
        came = np.zeros((self.n, k + 1))
        came[read, :k] = log_density(misfits.misfit[read], misfits.sigma[read], misfits.sigma[read])
        came[read, k] = -np.log(2.0 * self.half.max())
        predicted, sigma = -misfits.misfit[beyond] / self.gain, misfits.sigma[beyond] / np.abs(self.gain)
        inside = special.ndtr((self.half - predicted) / sigma) - special.ndtr((-self.half - predicted) / sigma)
        came[beyond, :k] = np.log(np.maximum(1.0 - inside, LOST))
        came[beyond, k] = np.log(0.5)
        stayed = came.copy()
        follows = read & np.isfinite(misfits.given[:, 0])
        stayed[follows, :k] = log_density(misfits.given[follows], misfits.given_sigma[follows], misfits.sigma[follows])
        return came, stayed


def log_density(misfit: Floats, sigma: Floats, wide: Floats) -> Floats:
    """Return the log density of a misfit: a normal distribution of ``sigma`` plus a wide tail of ``wide``."""

    def normal(s: Floats) -> Floats:
        return np.asarray(-0.5 * (misfit / s) ** 2 - np.log(s) - 0.5 * np.log(2.0 * np.pi))

    return np.asarray(np.logaddexp(np.log(1.0 - TAIL) + normal(sigma), np.log(TAIL) + normal(TAIL_SIGMAS * wide)))


def widen(misfit: Floats, sigma: Floats, rows: Indices, best: Indices) -> None:
    """Increase σ if the usual misfit of some rows' most probable candidates is larger."""
    ratio = np.abs(misfit[rows, best[rows]]) / sigma[rows, best[rows]]
    if np.isfinite(ratio).any():
        sigma *= max(1.0, float(np.nanmedian(ratio)) / float(special.ndtri(0.75)))


def runs(labels: Indices) -> list[slice]:
    """Return the runs of equal labels (n,)."""
    edges = (np.flatnonzero(np.diff(labels)) + 1).tolist()
    return [slice(a, b) for a, b in pairwise([0, *edges, len(labels)])]
