"""Error curves as numbers to plot and store: values, standard deviations, covered readings and strongest periods."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain import Chain
from truearm.model.joint_terms.curve import Curve
from truearm.results import Period
from truearm.types import CurveKnots, Floats, Law

STEP = math.radians(0.5)  # between samples
LARGEST_CYCLES = 60  # per turn
PERIODS = 3
LEAST_PERIODS = 2.0  # within the longest covered interval, unless it is a complete turn
SLOW_DEGREE = 4  # of the polynomial that stands for everything slower than that
TURN = 2.0 * math.pi


class SampledCurve(NamedTuple):
    """A joint's rotation beyond offset and gain, over all readings that its curve extends over."""

    joint: str
    readings: Floats  # (n,) rad
    error: Floats  # (n,) rad
    sigma: Floats  # (n,) rad
    covered: NDArray[np.bool_]  # (n,) near a fitted reading
    intervals: tuple[tuple[float, float], ...]  # rad, those of ``covered``


class SineAmplitudes(NamedTuple):
    """The amplitudes of single sines in a curve, where its readings determine them.

    ``cycles`` (m,) per turn and ``amplitude`` (m,) [rad]. Sines closer than ``resolution`` [cycles per turn] cannot be
    distinguished. All are empty or NaN if the curve is too short.
    """

    cycles: Floats
    amplitude: Floats
    resolution: float


def sampled_curves(chain: Chain, laws: Sequence[Law], params: Floats, covariance: Floats) -> tuple[SampledCurve, ...]:
    """Return the error curves of a chain with laws at params (p,), with their covariance (p, p)."""
    curves, curve = [], Curve.of_chain(chain)
    for law in laws:
        if not isinstance(law, CurveKnots):
            continue
        readings = law_readings(law)
        coefficients = np.flatnonzero(curve.joints == law.joint)
        q = np.zeros((len(chain.joints), readings.size))
        q[law.joint] = readings
        jac, columns = curve.by_parameters(params, q)[coefficients].T, curve.parameters[coefficients]
        variance = np.einsum("ni,ij,nj->n", jac, covariance[np.ix_(columns, columns)], jac)
        sigma = np.sqrt(np.maximum(variance, 0.0))
        name = chain.joints[law.joint].name
        curves.append(SampledCurve(name, readings, jac @ params[columns], sigma, law.covers(readings), law.covered))
    return tuple(curves)


def law_readings(law: CurveKnots) -> Floats:
    """Return evenly spaced readings (n,) [rad] over a curve's knots; over one turn if it is periodic."""
    high = law.first + (TURN if law.periodic else (law.count - 1) * law.spacing)
    return np.linspace(law.first, high, max(2, math.ceil((high - law.first) / STEP) + 1))


def sine_amplitudes(curve: SampledCurve) -> SineAmplitudes:
    """Return the amplitudes of the sines of a curve over its covered readings."""
    return _sine_amplitudes(curve, curve.error)[0]


def strongest_periods(curve: SampledCurve) -> tuple[Period, ...]:
    """Return the strongest sines of a curve over its covered readings, each removed before the search for the next."""
    remaining, periods = curve.error.copy(), list[Period]()
    for _ in range(PERIODS):
        sines, waves = _sine_amplitudes(curve, remaining)
        distance = np.abs(np.subtract.outer(sines.cycles, [period.cycles for period in periods]))
        resolved = np.flatnonzero((distance >= sines.resolution).all(axis=1))
        if not resolved.size or not sines.amplitude[resolved].max() > 0.0:
            break
        best = int(resolved[np.argmax(sines.amplitude[resolved])])
        periods.append(Period(float(sines.cycles[best]), float(sines.amplitude[best])))
        remaining[curve.covered] -= waves[best]
    return tuple(periods)


def _sine_amplitudes(curve: SampledCurve, error: Floats) -> tuple[SineAmplitudes, Floats]:
    """Return the amplitudes of m sines in an error (n,) at its r covered readings, and each sine at these (m, r).

    Every sine is fitted together with a slow polynomial, whose part would otherwise pass for the lowest cycles.
    """
    longest = max((high - low for low, high in curve.intervals), default=0.0)
    whole = longest >= TURN
    lowest = 1 if whole else math.ceil(LEAST_PERIODS * TURN / longest) if longest else LARGEST_CYCLES + 1
    readings, values = curve.readings[curve.covered], error[curve.covered]
    cycles = np.arange(float(lowest), LARGEST_CYCLES + 1.0)
    if not cycles.size:
        return SineAmplitudes(cycles, cycles, math.nan), np.zeros((0, readings.size))
    middle, half = 0.5 * (readings[-1] + readings[0]), 0.5 * (readings[-1] - readings[0])
    slow = np.polynomial.legendre.legvander((readings - middle) / half, 0 if whole else SLOW_DEGREE)
    basis, _ = np.linalg.qr(slow)
    sines = np.stack([np.cos(cycles[:, None] * readings), np.sin(cycles[:, None] * readings)], axis=1)
    faster = sines - (sines @ basis) @ basis.T
    amplitudes = np.linalg.solve(faster @ faster.swapaxes(1, 2), (faster @ values)[..., None])
    waves = (amplitudes * sines).sum(axis=1)
    return SineAmplitudes(cycles, np.linalg.norm(amplitudes[..., 0], axis=1), TURN / longest), waves
