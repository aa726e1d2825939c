"""Find dwells, the times when the robot stood still, and reduce the samples of each to the mean reading of a sensor.

How much a reading varies at rest is estimated from the readings: the tenth percentile of each joint's range over
windows of four bins (0.2 s). Three times that is the threshold, 8 to 13 standard deviations of a reading, but at least
two steps of the quantisation and one microradian.

A chain of windows below the threshold is a stop. ``settled_from()`` removes slow creep: a dwell begins where the bin
means stay at the level of the stop's second half. The beginning of a stop is always discarded: the robot's clock may
run late, and a window may extend into the motion.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import islice
from statistics import NormalDist
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from truearm.kinds.kind import DwellSensor
from truearm.session.joint_readings import BIN_S, NOTED_S, BinJoints, Bins, BinTimes, JointStream, binned
from truearm.session.samples import ChannelSamples, Samples, extension, railed
from truearm.types import NEED_DECISION, Floats
from truearm.units import MM, MS, NS, UM

# ------------------------------------------------------------------------------------------------------- noise and rest

SOKAL = 5.0
LEAST_LAGS = 8  # alternating noise (of a high-passed converter) has a small τ after one lag


class MeanOfSamples(NamedTuple):
    """Statistics of a mean.

    ``value_var``: variance of the mean; ``noise``: standard deviation of one sample; ``n_eff``: number of independent
    samples; ``drift``: end-to-end change of the least-squares line; ``drift_sigma``: its standard deviation.
    """

    value: float
    value_var: Annotated[float, Meta(ge=0.0)]
    noise: float
    n_samples: int
    n_eff: float
    drift: float
    drift_sigma: float


def mean_of(samples: Floats) -> MeanOfSamples:
    """Return the mean of n ≥ 8 evenly spaced samples (n,) in any unit."""
    n = samples.size
    # Noise about the line: a drift is neither noise nor correlation and is judged separately.
    mean, drift, about_line = _line(samples)
    variance, noise = mean_variance(about_line, fitted=2)
    n_eff = noise**2 / variance if variance > 0.0 else float(n)
    drift_sigma = float(np.sqrt(12.0 * variance))  # a slope's variance is σ²/Σx², Σx² = n/12
    return MeanOfSamples(mean, variance, noise, n, n_eff, drift, drift_sigma)


def _line(samples: Floats) -> tuple[float, float, Floats]:
    """Return the mean of samples (n,), the end-to-end change of their least-squares line, and its residuals (n,)."""
    mean, place = float(np.mean(samples)), np.linspace(-0.5, 0.5, samples.size)
    drift = float(place @ (samples - mean) / (place @ place))
    return mean, drift, samples - mean - drift * place


def mean_variance(deviation: Floats, fitted: int = 1) -> tuple[float, float]:
    """Return the variance of the mean of n samples and the standard deviation of one, from their deviations (n,).

    The mean of correlated samples has the variance C / n, with the sum C of the autocovariances. The sum ends at the
    first lag that is five times the integrated correlation time (Sokal, "Monte Carlo methods in statistical mechanics",
    1997, §3), and is corrected for the estimated mean (Wolff, Comput. Phys. Commun. 156, 2004, eq. 49).

    ``fitted``: 1 for deviations from the mean, 2 from the least-squares line, which lowers each Γ(k) by the same amount
    again.
    """
    n = deviation.size
    padded = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(deviation, padded)
    gamma = np.fft.irfft(spectrum * spectrum.conj(), padded)[: n // 2] / (n - np.arange(n // 2))
    if gamma[0] <= 0.0:
        return 0.0, 0.0
    tau = np.cumsum(gamma) / gamma[0] - 0.5  # τ(W), 1/2 for white noise
    lags = np.arange(tau.size)
    enough = np.flatnonzero(lags >= np.maximum(LEAST_LAGS, SOKAL * tau))
    window = int(enough[0]) if enough.size else tau.size - 1
    total = 2.0 * gamma[0] * max(float(tau[window]), 0.0)
    bias = fitted * total / n
    gamma0 = float(gamma[0]) + bias
    total = max(total + (2 * window + 1) * bias, gamma0 / n)
    return total / n, float(np.sqrt(gamma0))


FALSE_ALARM = 1e-4  # five dwells, for seven channels in 7200 dwells
LEAST_BLOCKS = 4


class Settled(NamedTuple):
    """Where one or several signals come to rest.

    ``first`` (…): index of the first block at rest, or the number of blocks if none is. ``level`` (…): mean of the
    second half. ``deviation`` (…, b): block means minus the level. ``bound`` (…): allowed deviation of one block.
    """

    first: NDArray[np.intp]
    level: Floats
    deviation: Floats
    bound: Floats


def settled_from(means: Floats, block_var: Floats | float, floor: Floats | float) -> Settled:
    """Return where the means (…, b) of consecutive blocks come to rest.

    Each has the variance ``block_var`` (…) by noise.

    Rest is defined by a stop's second half. Stretches of 1, 2, 4 … blocks are compared with its level: short ones show
    ringing, long ones creep. Rest begins after the last stretch that deviates by more than noise or ``floor`` explains.
    Noise alone truncates a fraction FALSE_ALARM of stops.
    """
    b = means.shape[-1]
    half = b // 2
    level, deviation = _from_level(means)
    level_var = np.asarray(block_var) / (b - half)
    sums = np.concatenate([np.zeros((*means.shape[:-1], 1)), np.cumsum(deviation, axis=-1)], axis=-1)
    widths = [1 << k for k in range(max(1, half).bit_length())]
    sigmas = _sigmas(b * len(widths))
    first = np.zeros(means.shape[:-1], dtype=np.intp)
    for width in widths:
        stretch = (sums[..., width:] - sums[..., :-width]) / width
        bound = np.maximum(floor, sigmas * np.sqrt(block_var / width + level_var))
        off = np.abs(stretch) > bound[..., None]
        last = off.shape[-1] - np.argmax(off[..., ::-1], axis=-1)
        first = np.maximum(first, np.where(np.any(off, axis=-1), last, 0))
    return Settled(first, level, deviation, np.maximum(floor, sigmas * np.sqrt(block_var + level_var)))


def rests_within(means: Floats, floor: Floats | float) -> bool:
    """Return whether ``settled_from()`` finds all signals at rest from their first block, whatever their noise.

    A stretch deviates by no more than the largest deviation of its blocks, and every bound is at least ``floor`` (…).
    """
    _, deviation = _from_level(means)
    # Sums of blocks are rounded: that adds far less than one part in a million to the deviation of a stretch.
    return bool(np.all(np.abs(deviation).max(axis=-1) <= np.asarray(floor) * (1.0 - 1e-6)))


def _from_level(means: Floats) -> tuple[Floats, Floats]:
    """Return the mean (…) of the second half of the blocks (…, b), and the deviations (…, b) from it."""
    level = np.mean(means[..., means.shape[-1] // 2 :], axis=-1)
    return level, means - level[..., None]


@cache
def _sigmas(stretches: int) -> float:
    """Return the deviation, in σ, that one of so many stretches exceeds with probability FALSE_ALARM."""
    return -NormalDist().inv_cdf(FALSE_ALARM / (2.0 * stretches))


def block_means(samples: Floats, length: int) -> Floats:
    """Return the means (n // length,) of consecutive blocks of samples (n,).

    The first n % length samples are not used.
    """
    count = samples.size // length
    return np.asarray(samples[samples.size - count * length :].reshape(count, length).mean(axis=1))


def block_variance(samples: Floats, length: int) -> float:
    """Return the variance of the mean of a block of this length, from the second half of samples (n,) about its line.

    This is the larger of two values, derived from the correlation for a mean of many blocks and from the spread of the
    blocks. If neighbouring noise cancels, long means are far quieter than short ones.
    """
    _, _, about_line = _line(samples[samples.size // 2 :])
    of_mean, _ = mean_variance(about_line, fitted=2)
    means = block_means(about_line, length)
    spread = float(np.var(means, ddof=1)) if means.size > 1 else 0.0
    return max(of_mean * about_line.size / length, spread)


def quick_noise(samples: Floats) -> float:
    """Return the standard deviation of white samples (n,), n > 2, from their second differences.

    A swing of an arm hardly changes these.
    """
    return float(np.sqrt(np.mean(np.square(np.diff(samples, n=2))) / 6.0))


def rings(settled: Settled) -> bool:
    """Return whether deviations from the level change sides, as in a swing.

    If they stay on one side, it is a creep or a drift.
    """
    side = np.sign(settled.deviation[np.abs(settled.deviation) > settled.bound])
    return int(np.count_nonzero(np.diff(side))) >= 2


# --------------------------------------------------------------------------------------------------- stops of the robot

WINDOW_BINS = 4
QUIET_SHARE = 0.1
QUIET_FACTOR = 3.0
LEAST_MOTION = 1e-6  # rad or m
PAUSE_S = 0.25  # shorter pauses (a change of direction) are not attempts at a dwell and are not listed
SETTLE_S = 0.2  # always discarded at the beginning; more if robot or sensor settle later
LEAST_DWELL_S = 1.0  # minimum that must remain
LONGEST_DWELL_S = 60.0  # maximum that is used: a robot parked overnight is one dwell too
GUARD_S = 0.1  # discarded at the end: the robot's clock runs late by an unknown latency
POSE_TOLERANCE = np.pi / 180.0  # rad (or m), for every joint: what is nearer to a pose of the plan is at it


def needs_decision(reason: str, planned: bool) -> bool:
    """Return whether ``truearm session relabel`` can settle a dwell with this reason, with or without a plan."""
    return reason in NEED_DECISION or (reason == "no plan match" and not planned)


@dataclass(frozen=True)
class Dwell:
    """A stop of the robot and its outcome.

    ``reason`` is "" if it gave an observation, else one that ``report.session_findings.REJECTED`` explains, MOUNTING,
    "contradiction" (with a pose of the plan) or DOUBTFUL. ``detail`` quantifies it. ``stood_s``: controller time during
    which the joints stood still. ``start_s``, ``end_s``: the part that is used, in which robot and sensor had settled.
    ``bins``: first and past-the-last bin of its readings. ``q_var``: variances of single readings about their mean,
    including quantisation. ``value`` [m]: mean length of the bar. ``value_var`` [m²]: variance of that mean from the
    samples alone. ``sigma`` [m]: its standard deviation including the declared repeatability.
    """

    segment: int
    start_s: float
    end_s: float
    q: Floats  # (j,) mean reading
    q_var: Floats  # (j,)
    n_readings: int
    stood_s: float
    bins: tuple[int, int]
    reason: str = ""
    detail: str = ""
    start_host_ns: int = 0
    end_host_ns: int = 0
    value: float = float("nan")
    value_var: float = float("nan")
    sigma: float = float("nan")
    noise: float = float("nan")  # m, standard deviation of a sample
    drift: float = float("nan")  # m, end-to-end change of a straight line fitted to the samples
    drift_sigma: float = float("nan")  # m, its standard deviation
    n_samples: int = 0
    n_eff: float = 0.0
    clock_bound_ns: float = float("nan")
    pose: int | None = None  # row of the plan
    mounted: dict[str, str] = field(default_factory=dict)  # bar, chuck, sphere, shell


def find_dwells(stream: JointStream, bar: ChannelSamples | None = None) -> list[Dwell]:
    """Return all stops in order of time; those ruled out by the readings carry their reason.

    Where joints were noted by hand, they are the rests of the ``bar``.
    """
    if bar is not None and has_manual_joints(stream):
        return manual_dwells(stream, bar)
    dwells = find_stops(stream.bins, stream.step)
    segment = np.array([dwell.segment for dwell in dwells], np.int64)
    times = np.array([(dwell.start_s, dwell.end_s) for dwell in dwells]).reshape(-1, 2)
    host = zip(dwells, stream.to_host_ns(segment, times).tolist(), strict=True)
    return [replace(dwell, start_host_ns=start, end_host_ns=end) for dwell, (start, end) in host]


def find_stops(bins: Bins, step: Floats) -> list[Dwell]:
    """Return the stops of the signals in the bins, given their own noise and their step (j,)."""
    if len(bins) < WINDOW_BINS:
        return []
    times, windows = bins.times, len(bins) - WINDOW_BINS + 1
    # Of windows (b − 3,): which are without a gap, and in which all joints are quiet
    quiet = complete = ~np.logical_or.reduce([times.gap[k : windows + k] for k in (1, 2, 3)])
    if not np.any(complete):
        return []
    for joint, smallest in enumerate(step):  # one by one: a session may hold half a million bins
        ranges = _window_ranges(bins, joint)
        at_rest = QUIET_FACTOR * float(np.quantile(ranges[complete], QUIET_SHARE))
        quiet = quiet & (ranges <= max(at_rest, 2.001 * smallest, LEAST_MOTION))
    # A chain of windows ties its bins together.
    tied = np.convolve(quiet, np.ones(WINDOW_BINS - 1)) > 0.0
    edges = np.flatnonzero(np.diff(tied, prepend=False, append=False))
    runs = [
        slice(first, last + 1)
        for first, last in edges.reshape(-1, 2).tolist()
        if times.t_last_s[last] - times.t_first_s[first] >= PAUSE_S
    ]
    bin_var = resting_variance(bins, runs, len(step))
    return [_dwell(bins, run, bin_var, step) for run in runs]


def resting_variance(bins: Bins, runs: list[slice], joints: int) -> Floats:
    """Return the variance (j,) of a bin's mean at rest: the median over the second halves of all long stops."""
    halves = (bins.joints((run.start + run.stop) // 2, run.stop).mean for run in runs)
    spread = [np.var(half, axis=0, ddof=1) for half in halves if len(half) >= LEAST_BLOCKS]
    return np.asarray(np.median(spread, axis=0)) if spread else np.zeros(joints)


def _window_ranges(bins: Bins, joint: int) -> Floats:
    """Return the range (b − 3,) of a joint over the bins of each window."""
    mean, below, above, _ = bins.joint(joint)
    high, low = mean + above, mean - below
    for k in (1, 2):  # of two bins, then of four
        high, low = np.maximum(high[:-k], high[k:]), np.minimum(low[:-k], low[k:])
    return np.asarray(high - low)


def _dwell(bins: Bins, run: slice, bin_var: Floats, step: Floats) -> Dwell:
    """Return the dwell of a stop. ``bin_var`` (j,): variance of a bin's mean at rest."""
    begins_s = bins.times.t_first_s
    stood = float(begins_s[run.start])
    begin_s = stood + SETTLE_S
    inside = np.flatnonzero((begins_s[run] >= begin_s) & (bins.times.t_last_s[run] <= begin_s + LONGEST_DWELL_S))
    span = slice(run.start + int(inside[0]), run.start + int(inside[-1]) + 1) if inside.size else run
    lasts_s = _end_s(bins, span) - (float(begins_s[span.start]) if inside.size else begin_s)
    if not inside.size or lasts_s < LEAST_DWELL_S:
        return of_bins(bins, span, step, stood, "too short", f"{max(0.0, lasts_s):.2f} s")
    first, late = _settled(bins, span, bin_var, step)
    settled = slice(min(span.start + first, span.stop - 1), span.stop)
    if first and _end_s(bins, settled) - begins_s[settled.start] < LEAST_DWELL_S:
        swing = float(np.ptp(bins.joints(span.start, span.stop).mean[:, late]))
        return of_bins(bins, span, step, stood, "still moving", f"joint {late + 1} by {swing:.2g} rad")
    return of_bins(bins, settled, step, stood)


def _settled(bins: Bins, span: slice, bin_var: Floats, step: Floats) -> tuple[int, int]:
    """Return the first of these bins from which all joints rest, and the joint that settles last."""
    means, n = bins.joints(span.start, span.stop).mean, bins.times.n[span]
    if len(means) < LEAST_BLOCKS:
        return 0, 0
    signals, floor = np.ascontiguousarray(means.T), np.maximum(1.001 * step, LEAST_MOTION)
    if rests_within(signals, floor):
        return 0, 0
    fewer = float(np.median(n) / np.min(n))  # a bin cut short by the end of the recording has fewer readings
    firsts = settled_from(signals, fewer * bin_var, floor).first
    return int(np.max(firsts)), int(np.argmax(firsts))


def _end_s(bins: Bins, span: slice) -> float:
    return float(bins.times.t_last_s[span.stop - 1]) - GUARD_S


def of_bins(bins: Bins, span: slice, step: Floats, stood: float, reason: str = "", detail: str = "") -> Dwell:
    return Dwell(
        segment=int(bins.times.segment[span.start]),
        start_s=float(bins.times.t_first_s[span.start]),
        end_s=_end_s(bins, span),
        stood_s=stood,
        reason=reason,
        detail=detail,
        **_readings(bins, span, step),
    )


def begun_at(dwell: Dwell, start_s: float, start_host_ns: int, stream: JointStream) -> Dwell:
    """Return the dwell with a later beginning, with joint mean and variances from the remaining readings.

    If less than one bin of readings remains, the last bin is used: the joints are at rest in all of them.
    """
    if start_s <= dwell.start_s:
        return dwell
    first, end = dwell.bins
    first += int(np.searchsorted(stream.bins.times.t_first_s[first:end], start_s))
    span = slice(min(first, end - 1), end)
    read = _readings(stream.bins, span, stream.step)
    return replace(dwell, start_s=start_s, start_host_ns=start_host_ns, **read)


def _readings(bins: Bins, span: slice, step: Floats) -> dict[str, Any]:
    """Return the mean and the variances (j,) of the readings in these bins; the latter at least of quantisation."""
    n, (mean, _, _, scatter) = bins.times.n[span], bins.joints(span.start, span.stop)
    total = int(np.sum(n))
    q = np.sum(n[:, None] * mean, axis=0) / total
    squares = n @ (mean - q) ** 2 + np.sum(scatter, axis=0, dtype=np.float64)
    # For a quantised reading the smallest change seen is the step; for a fine one it is negligible.
    q_var = squares / max(1, total - 1) + step**2 / 12.0
    return {"q": q, "q_var": q_var, "n_readings": total, "bins": (span.start, span.stop)}


# ---------------------------------------------------------------------------------------------- manually noted joints


def has_manual_joints(stream: JointStream) -> bool:
    """Return whether the readings are too far apart to show when the robot stood still."""
    return stream.readings == 1 or stream.rate_hz * NOTED_S < 1.0


def manual_dwells(stream: JointStream, samples: ChannelSamples) -> list[Dwell]:
    """Return one dwell per reading, in order.

    Manually noted joints arrive every few seconds, so they cannot show when the robot stood still. The ball-bar's
    length can, by ``find_stops()``. A reading noted while the bar rested belongs to that rest; two that differ in one
    rest mean that the robot moved unseen. Those in no rest, or in one with another reading, carry their reason. A
    motion that keeps the length constant remains undetected.
    """
    bins = stream.bins
    stops = find_stops(sensor_bins(samples), step=np.zeros(1))
    rests = [stop for stop in stops if stop.reason != "too short"]
    end_s = np.array([*(stop.end_s + GUARD_S for stop in rests), -np.inf])
    times, mean = bins.times, bins.means()
    noted_ns = stream.to_host_ns(times.segment, times.t_first_s)
    rest_of = np.searchsorted([stop.stood_s for stop in rests], 1e-9 * noted_ns, side="right") - 1
    rest_of[1e-9 * noted_ns > end_s[rest_of]] = -1
    dwells = []
    for k, (number, t_ns) in enumerate(zip(rest_of.tolist(), noted_ns.tolist(), strict=True)):
        alike = np.flatnonzero(rest_of == number)
        span = float(np.max(np.abs(mean[alike] - mean[k])))
        dwell = of_bins(bins, slice(k, k + 1), stream.step, float(times.t_first_s[k]))
        dwell = replace(dwell, end_s=dwell.start_s, start_host_ns=t_ns, end_host_ns=t_ns)
        if number < 0:
            detail = "the bar did not rest when the joints were noted"
            dwells.append(replace(dwell, reason="still moving", detail=detail))
        elif span > POSE_TOLERANCE:
            detail = f"{len(alike)} readings in one rest, {span:.3f} rad apart"
            dwells.append(replace(dwell, reason="ambiguous", detail=detail))
        elif k == alike[0]:
            dwells.append(_resting(dwell, rests[number], t_ns))
    return dwells


def sensor_bins(samples: ChannelSamples) -> Bins:
    """Return the sensor's extension in bins of BIN_S [s of the host's clock], as a single joint.

    Samples at a rail are left out: an open coil is quiet but not at rest. Raises SessionError if the channel has no
    calibration.
    """
    bins, last_piece, last_s = Bins(), -1, -np.inf
    for batch in samples:
        t_s = np.asarray(1e-9 * batch.t_ns, np.float64)
        rails = railed(batch.counts[:, 0])
        piece = batch.piece + np.cumsum(rails)
        key = 1e9 * piece + np.floor((t_s - t_s[0]) / BIN_S)
        metres = extension(batch.counts[:, :1], batch.channels[0])
        silent = np.diff(piece[~rails], prepend=last_piece) > 0
        last_piece = int(batch.piece[-1])
        times, joints = binned(0, t_s[~rails], metres[~rails], key[~rails], silent)
        filled = times.n * batch.period_ns >= 0.5e9 * BIN_S
        times = BinTimes(*(column[filled] for column in times))
        silence_s = times.t_first_s - np.append(last_s, times.t_last_s[:-1])[: len(times.n)]
        bins.append(times._replace(gap=times.gap | (silence_s > 2.0 * BIN_S)), BinJoints(*(c[filled] for c in joints)))
        last_s = np.append(last_s, times.t_last_s)[-1]
    return bins


def _resting(dwell: Dwell, stop: Dwell, t_host_ns: int) -> Dwell:
    """Return a noted dwell over the complete rest of the sensor.

    ``stop``: that rest [s of the host's clock]. ``t_host_ns``: when the joints were noted, which is ``dwell.start_s``.
    """
    begin, end, stood = (round(1e9 * t) for t in (stop.start_s, stop.end_s, stop.stood_s))
    noted_s = dwell.start_s
    return replace(
        dwell,
        stood_s=noted_s + 1e-9 * (stood - t_host_ns),
        start_s=noted_s + 1e-9 * (begin - t_host_ns),
        end_s=noted_s + 1e-9 * (end - t_host_ns),
        start_host_ns=begin,
        end_host_ns=end,
        reason=stop.reason,
        detail=stop.detail.replace("rad", "m").removeprefix("joint 1 "),
    )


# ---------------------------------------------------------------------------------------------------- the sensor's mean

LEAST_SAMPLES = 8
BLOCK_S = 0.025  # averaging interval: short compared with the period of an arm's swing (5 to 20 Hz)
UNSETTLED = 0.25  # of the declared repeatability
LEARNT = 50  # dwells
OWN_NOISE = 4.0  # times the usual variance
NOISY = 5.0  # times the median noise of all dwells
DRIFT_SIGMAS = 6.0
MICRON = 1e-6  # a ball-bar's spheres are not rounder: less noise, ringing or drift does not reject a dwell


class Noise(NamedTuple):
    """Noise of the sensor at rest: variance [m²] of a block's mean, and standard deviation [m] by ``quick_noise()``.

    NaN: unknown.
    """

    block_var: float
    quick: float


def usual_noise(dwells: Iterable[Samples | None]) -> Noise:
    """Return the median noise of the sensor over the first LEARNT dwells."""
    noises = []
    for samples_of_dwell in islice(dwells, LEARNT):
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
    """Return the dwell with its mean length, or with the reason why it has none.

    No dwell uses samples from across a gap. When the joints stand still, the arm beyond its encoders may still swing or
    creep, and the bar shows it. The dwell therefore begins where the samples, too, stay at the level of its second
    half, given the ``usual`` noise, the median over the first LEARNT dwells, and its correlation. A single dwell may
    have up to four times that variance, but not more: otherwise a swing that never ends would pass for noise. A quarter
    of the declared repeatability is tolerated. An exponential tail of that size leaves less than half of it in the
    mean, and adds at most a hundredth to the variance.
    """
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
    """Return where the lengths (n,) [m] come to rest, in blocks of the given length.

    None if there are too few samples or if they rest from the first.

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
