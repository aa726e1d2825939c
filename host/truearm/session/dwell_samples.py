"""Reduce the samples of each dwell to the mean reading of a sensor, or give the reason why it has none.

No dwell uses samples from across a gap. When the joints stand still, the arm beyond its encoders may still swing or
creep, and the bar shows it. The dwell therefore begins where the samples, too, stay at the level of its second half
(``settled_from()``), given the sensor's noise and its correlation. That noise is the median over the first LEARNT
dwells. A single dwell may have up to four times that variance, but not more: otherwise a swing that never ends would
pass for noise. A quarter of the declared repeatability is tolerated. An exponential tail of that size leaves less than
half of it in the mean, and adds at most a hundredth to the variance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from truearm.kinds.kind import DwellSensor
from truearm.session.dwells import GUARD_S, LEAST_DWELL_S, Dwell, begun_at
from truearm.session.joint_readings import JointStream
from truearm.session.sample_noise import (
    LEAST_BLOCKS,
    Settled,
    block_means,
    block_variance,
    mean_of,
    quick_noise,
    rests_within,
    rings,
    settled_from,
)
from truearm.session.samples import Samples, extension, railed
from truearm.types import Floats
from truearm.units import MM, MS, NS, UM

LEAST_SAMPLES = 8
BLOCK_S = 0.025  # averaging interval: short compared with the period of an arm's swing (5 to 20 Hz)
UNSETTLED = 0.25  # of the declared repeatability
LEARNT = 50  # dwells
OWN_NOISE = 4.0  # times the usual variance
NOISY = 5.0  # times the median noise of all dwells
DRIFT_SIGMAS = 6.0
MICRON = 1e-6  # a ball-bar's spheres are not rounder: less noise, ringing or drift does not reject a dwell


class Noise(NamedTuple):
    """Noise of the sensor at rest: variance [m²] of a block's mean, and sample standard deviation [m] by
    ``quick_noise()``.

    NaN: unknown.
    """

    block_var: float
    quick: float


def usual_noise(dwells: Iterable[Samples | None]) -> Noise:
    """Return the median noise of the sensor over several dwells."""
    noises = []
    for samples_of_dwell in dwells:
        if samples_of_dwell is not None:
            _, counts = samples_of_dwell.longest()
            if counts.size >= 2 * LEAST_BLOCKS * (block := block_length(samples_of_dwell)):
                samples = extension(counts, samples_of_dwell.channels[0])
                noises.append((block_variance(samples, block), quick_noise(samples)))
    return Noise(*np.median(noises, axis=0).tolist()) if noises else Noise(float("nan"), float("nan"))


def block_length(samples: Samples) -> int:
    """Return the number of samples in BLOCK_S."""
    return max(1, round(BLOCK_S / (1e-9 * samples.period_ns)))


def measured(dwell: Dwell, samples: Samples, sensor: DwellSensor, joints: JointStream, usual: Noise) -> Dwell:
    """Return the dwell with its mean length, or with the reason why it has none."""
    begin_ns, counts = samples.longest()
    dwell = replace(dwell, clock_bound_ns=samples.bound_ns)
    if samples.bound_ns > 1e9 * GUARD_S:
        return replace(dwell, reason="clock", detail=f"±{MS.text(NS.to_si(samples.bound_ns), '.0f')}")
    period_s = 1e-9 * samples.period_ns
    if counts.size < LEAST_SAMPLES or period_s * (counts.size + 1) < LEAST_DWELL_S:
        return replace(dwell, reason="gap", detail=f"{period_s * counts.size:.2f} s at most without a gap")
    if samples.fault.any():
        return replace(dwell, reason="rail", detail="the converter's fault")
    stretched = extension(counts, samples.channels[0])
    length = sensor.zero + sensor.gain * stretched
    block = block_length(samples)
    at_rest = settled(length, block, sensor.gain**2 * usual.block_var, max(UNSETTLED * sensor.sigma, MICRON))
    # Samples before the first block belong to it.
    first = counts.size % block + int(at_rest.first) * block if at_rest is not None and at_rest.first else 0
    unsettled = at_rest if period_s * (counts.size - first + 1) < LEAST_DWELL_S else None
    if unsettled is not None:
        first = 0
    else:
        mean = mean_of(length[first:])
        dwell = replace(dwell, sigma=float(np.sqrt(mean.value_var + sensor.sigma**2)), **mean._asdict())
    if first:
        late_s = 1e-9 * (begin_ns - dwell.start_host_ns) + period_s * first
        dwell = begun_at(dwell, dwell.start_s + late_s, begin_ns + first * samples.period_ns, joints)
    rails, reach = np.count_nonzero(railed(counts[first:])), float(np.max(np.abs(stretched[first:])))
    noise_limit = NOISY * abs(sensor.gain) * usual.quick
    reason, detail = "", ""
    if rails:
        reason, detail = "rail", f"{rails} of {counts.size - first} samples"
    elif reach > 0.5 * sensor.travel:
        reason, detail = "out of travel", f"{MM.text(reach, '.1f')} of ±{MM.text(0.5 * sensor.travel, '.1f')}"
    elif unsettled is not None and (quick := quick_noise(length)) > max(noise_limit, MICRON):
        reason, detail = "noisy", _noise_words(quick, noise_limit)
    elif unsettled is not None:  # a swing or creep that is still visible in the last blocks
        off = float(np.max(np.abs(unsettled.deviation[-round(LEAST_DWELL_S / (block * period_s)) :])))
        reason = "ringing" if rings(unsettled) else "drift"
        detail = f"{UM.text(off, '.0f')} off, {UM.text(float(unsettled.bound), '.0f')} allowed"
    # A drift within the bar's declared repeatability is already covered by it.
    elif abs(dwell.drift) > max(DRIFT_SIGMAS * dwell.drift_sigma, sensor.sigma, MICRON):
        reason, detail = "drift", f"{UM.text(dwell.drift, '+.0f')} in {period_s * dwell.n_samples:.1f} s"
    return replace(dwell, reason=reason, detail=detail)


def settled(length: Floats, block: int, usual_var: float, floor: float) -> Settled | None:
    """Return where the lengths (n,) [m] come to rest, in blocks of the given length; None if there are too few samples
    or if they rest from the first.

    ``usual_var`` [m²]: variance of a block's mean at rest, NaN if unknown.
    """
    means = block_means(length, block)
    if means.size < LEAST_BLOCKS or rests_within(means, floor):
        return None
    own_var = block_variance(length, block)
    variance = own_var if np.isnan(usual_var) else min(max(own_var, usual_var), OWN_NOISE * usual_var)
    return settled_from(means, variance, floor)


def without_noisy(dwells: Sequence[Dwell]) -> list[Dwell]:
    """Return the dwells; those much noisier than most get that as their reason."""
    noise = [dwell.noise for dwell in dwells if not dwell.reason]
    limit = max(NOISY * float(np.median(noise)), MICRON) if noise else np.inf
    return [
        replace(d, reason="noisy", detail=_noise_words(d.noise, limit)) if not d.reason and d.noise > limit else d
        for d in dwells
    ]


def _noise_words(noise: float, limit: float) -> str:
    return f"{UM.text(noise, '.1f')}, {UM.text(limit, '.1f')} allowed"
