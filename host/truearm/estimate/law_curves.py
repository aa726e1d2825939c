"""Error curves as numbers to plot and store: values, standard deviations, covered range and strongest periods."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain import Chain
from truearm.model.joint_terms.curve import Curve
from truearm.types import CurveKnots, Floats, Law, Period

STEP = math.radians(0.5)  # between samples
LARGEST_CYCLES = 60  # per turn
PERIODS = 3
SPECTRUM_SAMPLES = 720


class SampledCurve(NamedTuple):
    """A joint's rotation beyond offset and gain, over all readings that its curve covers."""

    joint: str
    readings: Floats  # (n,) rad
    error: Floats  # (n,) rad
    sigma: Floats  # (n,) rad
    covered: NDArray[np.bool_]  # (n,) within the range of the fitted rows' readings


def sampled_curves(
    chain: Chain, laws: Sequence[Law], params: Floats, covariance: Floats, lower: Floats, upper: Floats
) -> tuple[SampledCurve, ...]:
    """Return the error curves of a chain with laws at params (p,), with their covariance (p, p).

    ``lower`` and ``upper`` (j,) are the smallest and the largest readings of the fitted rows.
    """
    out, curve = [], Curve.of_chain(chain)
    for law in laws:
        if not isinstance(law, CurveKnots):
            continue
        i = law.joint
        low = law.first
        high = low + (2.0 * math.pi if law.periodic else (law.count - 1) * law.spacing)
        readings = np.linspace(low, high, max(2, math.ceil((high - low) / STEP) + 1))
        rows = _basis(chain, curve, i, readings)
        own = np.flatnonzero(curve.joints == i)
        jac, at = rows[own].T, curve.parameters[own]
        variance = np.einsum("ni,ij,nj->n", jac, covariance[np.ix_(at, at)], jac)
        covered = law.periodic | ((readings >= lower[i]) & (readings <= upper[i]))
        sigma = np.sqrt(np.maximum(variance, 0.0))
        out.append(SampledCurve(chain.joints[i].name, readings, jac @ params[at], sigma, covered))
    return tuple(out)


def spectrum(readings: Floats, error: Floats) -> tuple[Floats, Floats]:
    """Return cycles per turn (m,) and amplitudes [rad] of single sines in a curve, from the lowest that its range resolves."""
    span = float(readings[-1] - readings[0])
    cycles = np.arange(math.ceil(max(1.0, 2.0 * math.pi / span)), LARGEST_CYCLES + 1.0)
    waves = np.exp(-1j * cycles[:, None] * readings)
    return cycles, 2.0 * np.abs((waves * (error - error.mean())).mean(axis=1))


def strongest_periods(
    chain: Chain, law: CurveKnots, params: Floats, covered: tuple[float, float]
) -> tuple[Period, ...]:
    """Return the strongest sines of a curve over the covered range, each removed before the search for the next."""
    lower, upper = (law.first, law.first + 2.0 * math.pi) if law.periodic else covered
    readings = np.linspace(lower, upper, SPECTRUM_SAMPLES, endpoint=not law.periodic)
    curve = Curve.of_chain(chain)
    own = np.flatnonzero(curve.joints == law.joint)
    left = params[curve.parameters[own]] @ _basis(chain, curve, law.joint, readings)[own]
    out: list[Period] = []
    for _ in range(PERIODS):
        cycles, amplitude = spectrum(readings, left)
        best = int(np.argmax(amplitude))
        if not amplitude[best] > 0.0:
            break
        wave = np.column_stack([np.cos(cycles[best] * readings), np.sin(cycles[best] * readings), np.ones(left.size)])
        fitted = np.linalg.lstsq(wave, left, rcond=None)[0]
        left = left - wave @ fitted
        out.append(Period(float(cycles[best]), float(np.hypot(*fitted[:2]))))
    return tuple(out)


def _basis(chain: Chain, curve: Curve, joint: int, readings: Floats) -> Floats:
    """Return ∂θ/∂coefficient (m, n) of all curves' coefficients, with one joint at its readings (n,)."""
    q = np.zeros((len(chain.joints), readings.size))
    q[joint] = readings
    return curve.by_parameters(np.zeros(len(chain.parameters)), q)
