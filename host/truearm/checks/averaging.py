"""The stated error of the tool, averaged over what may be wrong.

A hypothesis with the posterior β ~ (β̂, P_β) shifts the parameters by −S A β with A = Sᵀ Jᵀ C: to first order, what the
fit makes of β. With T = Sᵀ Γ S, and Γ the mean over the poses of the squared motion of the tool by the parameters, its
mean square error is

    β̂ᵀAᵀT A β̂ + tr(AᵀT A P_β) .
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import special

from truearm.checks.evidence import SCALES, SHOWN, Design, Weighed, build_design, size_of, weigh
from truearm.checks.noise import DECLARED
from truearm.checks.search import Detection, Search, columns_of
from truearm.types import Floats

PRIOR = 0.03  # probability that a kind of fault is there, shared by the items that it can befall
LEAST_WEIGHT = 1e-5


class Part(NamedTuple):
    """One explanation of a finding: its probability among its rivals, and what applying it does to the parameters."""

    name: str
    weight: float
    step: Floats  # (k,) from the fit to the fit with it as a parameter
    moves: float  # [m] RMS motion of the tool by that step
    spread: float  # [m²] mean square error that the uncertainty of its size adds


@dataclass(frozen=True)
class Claim:
    """The stated RMS error of the tool [m], in parts whose squares add up, for a fit without the findings.

    ``parameters``: by the noise of the rows. ``unnamed``: by faults that the rows neither show nor exclude.
    ``rivals``: by not knowing which of the rivals it is. ``shift``: by not applying their mean. ``choices`` are the
    explanations of each finding, and ``step`` (k,) applies the mean of all of them.
    """

    parameters: float
    unnamed: float
    rivals: float
    shift: float
    choices: tuple[tuple[Part, ...], ...]
    step: Floats

    @property
    def as_fitted(self) -> float:
        """Return the error of the parameters without any finding applied."""
        return math.hypot(self.applied, self.shift)

    @property
    def applied(self) -> float:
        """Return the error with the mean of the rivals applied."""
        return math.hypot(self.parameters, self.unnamed, self.rivals)


def averaged(result: Search, gram: Floats) -> Claim:
    """Return the claim of a search; ``gram`` (k, k) [m²] is Γ."""
    fit, kernel = result.build_design.fit, result.build_design.kernel
    fitted = build_design(fit, DECLARED, columns_of((), fit), robot_prior=True)  # as the parameters were fitted
    tool = fitted.root.T @ gram @ fitted.root
    noise = kernel.spread(fitted.basis[: fit.residual.size]) * np.sqrt(result.build_design.variance)
    knowledge = fitted.basis[fit.residual.size :]
    parameters = float(np.trace(tool @ (noise.T @ noise + knowledge.T @ knowledge)))
    weights = posterior(result.table)
    likely = [
        (weighed, float(weight)) for weighed, weight in zip(result.table, weights, strict=True) if weight > LEAST_WEIGHT
    ]
    unnamed = 0.0
    for weighed, weight in likely:
        part = explanation(weighed, weight, result.build_design, fitted, tool)
        unnamed += weight * (part.moves**2 + part.spread)
    step, rivals, choices = np.zeros(fit.jac.shape[1]), 0.0, []
    for detection in result.detections:
        options = explanations(detection, result, fitted, tool)
        mean = np.sum([part.weight * part.step for part in options], axis=0)
        apart = [float((part.step - mean) @ gram @ (part.step - mean)) for part in options]
        rivals += sum(part.weight * (square + part.spread) for part, square in zip(options, apart, strict=True))
        step += mean
        choices.append(options)
    shift = math.sqrt(max(float(step @ gram @ step), 0.0))
    return Claim(math.sqrt(parameters), math.sqrt(unnamed), math.sqrt(rivals), shift, tuple(choices), step)


def posterior(table: Sequence[Weighed]) -> Floats:
    """Return the probability of each hypothesis beside "nothing", which shares of PRIOR for its kind give."""
    share = Counter(weighed.hypothesis.kind for weighed in table)
    log = np.array([weighed.log_evidence + np.log(PRIOR / share[weighed.hypothesis.kind]) for weighed in table])
    return np.asarray(np.exp(log - special.logsumexp(np.append(log, 0.0))))


def explanation(weighed: Weighed, weight: float, design: Design, fitted: Design, tool: Floats) -> Part:
    """Return what the best candidate does to the parameters; its size is that of the ``design``."""
    scale = float(SCALES[np.argmax(weighed.by_scale[:, weighed.best])])
    size, covariance = size_of(weighed, design.variance, scale)
    columns = weighed.hypothesis.candidate(weighed.best, design.fit.row)
    loading = fitted.basis[: len(columns)].T @ columns
    step = -loading @ size
    moves, spread = math.sqrt(float(step @ tool @ step)), float(np.trace(loading.T @ tool @ loading @ covariance))
    return Part(weighed.name, weight, fitted.root @ step, moves, spread)


def explanations(detection: Detection, result: Search, fitted: Design, tool: Floats) -> tuple[Part, ...]:
    """Return the finding and its rivals by their probability, beside all other findings."""
    fit = result.build_design.fit
    neighbours = columns_of([neighbour for neighbour in result.detections if neighbour is not detection], fit)
    design = build_design(fit, result.build_design.kernel, neighbours)
    options = [weigh(weighed.hypothesis, design) for weighed in (detection.best, *detection.rivals)]
    log = np.array([weighed.log_evidence for weighed in options])
    weights = np.exp(log - special.logsumexp(log))
    return tuple(
        explanation(weighed, float(w), design, fitted, tool) for weighed, w in zip(options, weights, strict=True)
    )


def unseen(table: Sequence[Weighed], variance: float) -> tuple[str, ...]:
    """Return the hypotheses whose typical size no row shows: in no candidate and no direction by SHOWN."""
    return tuple(
        weighed.name for weighed in table if float(weighed.moments.values.max(initial=0.0)) / variance < SHOWN**2
    )
