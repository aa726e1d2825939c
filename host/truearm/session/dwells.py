"""Dwells: where the robot stood still, from its joint readings, and what the ball-bar's sensor says of each (hop 5).

How much a reading moves while the robot rests is not declared anywhere, so the readings say it themselves: the range of each
joint over windows of four bins (0.2 s), of which the tenth percentile belongs to rest as long as the robot rests a tenth of
the time. With n Gaussian readings a window that percentile is 2.6 (n = 16) to 4.3 (n = 100) standard deviations; three
times it is a threshold of 8 to 13, which rest does not cross and motion does at once. The threshold is never below two steps
of the quantisation nor below a microradian.

Bins that share a window whose range keeps below the threshold belong together; a chain of them is a stop. What still creeps
below that threshold is left out by ``settled_from()``: a dwell begins where the bins' means keep to the level of the stop's
second half, within what bins of resting stops differ by. Some of the beginning is left out in any case: the robot's clock may
run late, and a window may reach into the motion.

**What the sensor says** (``measured()``): where it had settled, its mean, and whether it may be used. The joints stood; the arm beyond its encoders may still swing or creep, and the bar shows it. The dwell therefore begins where
the samples, too, keep to the level of its second half (``settled_from()``), by the sensor's own noise and its correlation. What
that noise is the first LEARNT dwells say, in the middle; a dwell may have up to four times that variance itself, but not more: a
swing that never ends would pass for noise. A quarter of the declared repeatability is nothing to wait for: what an exponential
tail of that size leaves in the mean is less than half of it again, and adds at most a hundredth to the variance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from truearm.session.joint_readings import Bins, JointStream, pairs
from truearm.session.samples import (
    LEAST_BLOCKS,
    DwellSamples,
    MeanOfSamples,
    Settled,
    bar_length,
    block_means,
    block_variance,
    extension,
    mean_of,
    out_of_travel,
    quick_noise,
    railed,
    rings,
    settled_from,
)
from truearm.types import BallBar, Floats
from truearm.units import MM, MS, NS, UM

WINDOW_BINS = 4
QUIET_SHARE = 0.1
QUIET_FACTOR = 3.0
LEAST_MOTION = 1e-6  # rad or m
SHORTEST_S = 0.25  # shorter pauses (a turn of direction) are no attempt at a dwell and not listed

DOUBTFUL = "doubtful"  # plan and operator agree on what was mounted, the readings do not bear it out
NEED_WORDS = ("contradiction", "ambiguous", DOUBTFUL)  # a word of the operator settles it: truearm relabel
REASONS = (
    "too short",
    "still moving",  # the joints
    "ringing",  # the sensor, from side to side
    "drift",  # the sensor, one way
    "gap",
    "rail",
    "out of travel",
    "noisy",
    "no samples",
    "no clock",
    "clock",  # its bound is larger than the guard
    "no plan match",
    "contradiction",  # at a pose of the plan, but something else was confirmed
    DOUBTFUL,
    "ambiguous",  # the plan holds this pose with different fittings, and nothing says which were mounted
)


@dataclass(frozen=True)
class DwellRules:
    """What a dwell must be to give an observation. Times in s, ``pose_tolerance`` in rad (or m), the same for all joints."""

    settle_s: float = 0.2  # discarded at the beginning in any case; where robot or sensor settle later, more
    shortest_s: float = 1.0  # at least so much must be left
    longest_s: float = 60.0  # no more than this is used: a robot parked overnight is one dwell too
    guard_s: float = 0.1  # discarded at the end: the robot's clock runs late by an unknown latency
    pose_tolerance: float = np.pi / 180.0


@dataclass(frozen=True)
class Dwell:
    """One stop of the robot and what became of it. ``reason`` is "" if it gave an observation, else one of REASONS, and
    ``detail`` says how much of it.

    ``stood_s``: controller time at which the joints stood; ``start_s``, ``end_s``: of the part that is used, where robot and
    sensor had settled. ``bins``: first and past the last of the readings in it. ``q_cov`` is the
    covariance of single readings about their mean, quantisation included. ``value`` [m] is the mean length of the bar,
    ``value_var`` [m²] the variance of that mean from the samples alone, ``sigma`` [m] with the declared repeatability.
    """

    segment: int
    start_s: float
    end_s: float
    q: Floats  # (j,) mean reading
    q_cov: Floats  # (j, j)
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
    drift: float = float("nan")  # m, of a straight line through the samples, from end to end
    drift_sigma: float = float("nan")  # m, its standard deviation
    n_samples: int = 0
    n_eff: float = 0.0
    clock_bound_ns: float = float("nan")
    pose: int | None = None  # row of the plan
    mounted: dict[str, str] = field(default_factory=dict)  # bar, chuck, sphere, shell


def find_dwells(stream: JointStream, rules: DwellRules) -> list[Dwell]:
    """All stops in order of time; those that the joint readings already rule out carry their reason."""
    return [] if stream.bins is None else find_stops(stream.bins, stream.step, rules)


def find_stops(bins: Bins, step: Floats, rules: DwellRules) -> list[Dwell]:
    """The stops of whatever is in the bins, by its own noise and its step (j,)."""
    quiet = whole = _whole_windows(bins)
    if not np.any(whole):
        return []
    for joint, smallest in enumerate(step):  # one by one: a session may hold half a million bins
        ranges = _window_ranges(bins, joint)
        quiet = quiet & (ranges <= motion_threshold(ranges[whole], smallest))
    runs = [
        slice(first, last)
        for first, last in _runs(quiet, len(bins.n))
        if bins.t_last_s[last - 1] - bins.t_first_s[first] >= SHORTEST_S
    ]
    rest = _Rest(resting_variance(bins, runs), np.maximum(1.001 * step, LEAST_MOTION), step)
    return [_dwell(bins, run, rules, rest) for run in runs]


@dataclass(frozen=True)
class _Rest:
    """How much each joint's readings move at rest: variance of a bin's mean, what nobody cares about, step; all (j,)."""

    bin_var: Floats
    floor: Floats
    step: Floats


def resting_variance(bins: Bins, runs: list[slice]) -> Floats:
    """Variance (j,) of the mean of a bin at rest: the median over the second halves of all stops long enough to say it."""
    halves = [bins.mean[(run.start + run.stop) // 2 : run.stop] for run in runs]
    spread = [np.var(half, axis=0, ddof=1) for half in halves if len(half) >= LEAST_BLOCKS]
    return np.asarray(np.median(spread, axis=0)) if spread else np.zeros(bins.mean.shape[1])


def motion_threshold(ranges: Floats, step: float) -> float:
    """Largest range of a joint in a window that is still rest, from the ranges (w,) of whole windows."""
    rest = float(np.quantile(ranges, QUIET_SHARE))
    return max(QUIET_FACTOR * rest, 2.001 * step, LEAST_MOTION)


def _whole_windows(bins: Bins) -> NDArray[np.bool_]:
    """Of which bins (b,) the three followers are there without a gap between."""
    b = len(bins.n)
    whole = np.arange(b) <= b - WINDOW_BINS
    for k in range(1, WINDOW_BINS):
        whole[:-k] &= ~bins.gap[k:]
    return whole


def _window_ranges(bins: Bins, joint: int) -> Floats:
    """Range (b,) of a joint over each bin and its three followers."""
    high, low = bins.high[:, joint].copy(), bins.low[:, joint].copy()
    for k in range(1, WINDOW_BINS):
        np.maximum(high[:-k], bins.high[k:, joint], out=high[:-k])
        np.minimum(low[:-k], bins.low[k:, joint], out=low[:-k])
    return high - low


def _runs(quiet: NDArray[np.bool_], b: int) -> Iterator[tuple[int, int]]:
    """First and past-the-last bin of each chain of bins that quiet windows tie together."""
    tied = np.zeros(b, dtype=bool)  # bin k to bin k + 1
    for k in range(WINDOW_BINS - 1):
        tied[k:] |= quiet[: b - k]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], tied, [False]]).astype(np.int8)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        yield int(first), min(int(last) + 1, b)


def _dwell(bins: Bins, run: slice, rules: DwellRules, rest: _Rest) -> Dwell:
    stood = float(bins.t_first_s[run.start])
    inside = np.flatnonzero(
        (bins.t_first_s[run] >= stood + rules.settle_s)
        & (bins.t_last_s[run] <= stood + rules.settle_s + rules.longest_s)
    )
    if not inside.size:
        left = max(0.0, float(bins.t_last_s[run.stop - 1]) - stood - rules.settle_s - rules.guard_s)
        return _of_bins(bins, run, rules, rest.step, stood, "too short", f"{left:.2f} s")
    used = slice(run.start + int(inside[0]), run.start + int(inside[-1]) + 1)
    whole = _seconds(bins, used, rules)
    if whole < rules.shortest_s:
        return _of_bins(bins, used, rules, rest.step, stood, "too short", f"{max(0.0, whole):.2f} s")
    first, late = _settled(bins, used, rest)
    settled = slice(min(used.start + first, used.stop - 1), used.stop)
    if first and _seconds(bins, settled, rules) < rules.shortest_s:
        swing = float(np.ptp(bins.mean[used][:, late]))
        return _of_bins(bins, used, rules, rest.step, stood, "still moving", f"joint {late + 1} by {swing:.2g} rad")
    return _of_bins(bins, settled, rules, rest.step, stood)


def _settled(bins: Bins, used: slice, rest: _Rest) -> tuple[int, int]:
    """The first of these bins from which all joints rest, and the joint that settles last."""
    means, n = bins.mean[used], bins.n[used]
    if len(means) < LEAST_BLOCKS:
        return 0, 0
    fewer = float(np.median(n) / np.min(n))  # a bin cut by the rest of the recording has fewer readings, so more noise
    firsts = settled_from(np.ascontiguousarray(means.T), fewer * rest.bin_var, rest.floor).first
    return int(np.max(firsts)), int(np.argmax(firsts))


def _seconds(bins: Bins, used: slice, rules: DwellRules) -> float:
    return float(bins.t_last_s[used.stop - 1]) - rules.guard_s - float(bins.t_first_s[used.start])


def _of_bins(
    bins: Bins, used: slice, rules: DwellRules, step: Floats, stood: float, reason: str = "", detail: str = ""
) -> Dwell:
    return Dwell(
        segment=int(bins.segment[used.start]),
        start_s=float(bins.t_first_s[used.start]),
        end_s=float(bins.t_last_s[used.stop - 1]) - rules.guard_s,
        stood_s=stood,
        reason=reason,
        detail=detail,
        **_readings(bins, used, step),
    )


def begun_at(dwell: Dwell, start_s: float, start_host_ns: int, stream: JointStream) -> Dwell:
    """The dwell with a later beginning, its joints' mean and covariance from what is left.

    Where less than a bin is left of the readings, the last one is taken: the joints rest in all of them.
    """
    if stream.bins is None or start_s <= dwell.start_s:
        return dwell
    first, end = dwell.bins
    first += int(np.searchsorted(stream.bins.t_first_s[first:end], start_s))
    used = slice(min(first, end - 1), end)
    read = _readings(stream.bins, used, stream.step)
    return replace(dwell, start_s=start_s, start_host_ns=start_host_ns, **read)


class _Readings(TypedDict):
    """What a dwell says of the readings in its bins."""

    q: Floats
    q_cov: Floats
    n_readings: int
    bins: tuple[int, int]


def _readings(bins: Bins, used: slice, step: Floats) -> _Readings:
    """Means (j,) and covariance (j, j) of the readings in these bins; the latter at least that of the quantisation."""
    n, mean = bins.n[used], bins.mean[used]
    total = int(np.sum(n))
    q = np.sum(n[:, None] * mean, axis=0) / total
    between = (mean - q) * np.sqrt(n)[:, None]
    first, second = pairs(mean.shape[1])
    scatter = between.T @ between
    within = np.sum(bins.scatter[used], axis=0, dtype=np.float64)
    scatter[first, second] += within
    scatter[second, first] = scatter[first, second]
    # The smallest change seen is the step of a quantised reading; of a fine one it is next to nothing.
    return _Readings(
        q=q,
        q_cov=scatter / max(1, total - 1) + np.diag(step**2) / 12.0,
        n_readings=total,
        bins=(used.start, used.stop),
    )


# ------------------------------------------------------------------------------------------------- what the sensor says

LEAST_SAMPLES = 8
BLOCK_S = 0.025  # samples looked at together: short against a swing of an arm (5 to 20 Hz)
UNSETTLED = 0.25  # of the declared repeatability
LEARNT = 50  # dwells
OWN_NOISE = 4.0  # times the usual variance
NOISY = 5.0  # times the median noise of all dwells
DRIFT_SIGMAS = 6.0
MICRON = 1e-6  # a ball-bar's joints are not rounder: less noise, ringing or drift condemns no dwell


@dataclass(frozen=True)
class Sensing:
    """What is the same for all dwells of a session. ``any_clock``: it has exchanges; ``noise``: of the sensor."""

    rules: DwellRules
    joints: JointStream
    any_clock: bool
    noise: Noise


class Noise(NamedTuple):
    """Of the sensor at rest: variance [m²] of the mean of a block, standard deviation [m] of samples by ``quick_noise()``; NaN: not known."""

    block_var: float
    quick: float


def usual_noise(taken: Sequence[DwellSamples]) -> Noise:
    """The noise of the sensor in the middle of several dwells."""
    found = []
    for one in taken:
        counts = one.longest
        if one.channel is not None and counts.size >= 2 * LEAST_BLOCKS * (block := block_length(one)):
            samples = extension(counts, one.channel)
            found.append((block_variance(samples, block), quick_noise(samples)))
    return Noise(*np.median(found, axis=0).tolist()) if found else Noise(float("nan"), float("nan"))


def block_length(taken: DwellSamples) -> int:
    """How many samples of a dwell are BLOCK_S."""
    return max(1, round(BLOCK_S / (1e-9 * taken.period_ns)))


def measured(dwell: Dwell, taken: DwellSamples, bar: BallBar, sensing: Sensing) -> Dwell:
    """The dwell with its mean length, or with the reason why it has none."""
    rules = sensing.rules
    begin_ns, counts = taken.longest_piece
    if not counts.size or taken.channel is None:
        return replace(dwell, reason="no samples" if sensing.any_clock else "no clock")
    dwell = replace(dwell, clock_bound_ns=taken.bound_ns)
    if taken.bound_ns > 1e9 * rules.guard_s:
        return replace(dwell, reason="clock", detail=f"±{MS.text(NS.to_si(taken.bound_ns), '.0f')}")
    period_s = 1e-9 * taken.period_ns
    if counts.size < LEAST_SAMPLES or period_s * (counts.size + 1) < rules.shortest_s:
        return replace(dwell, reason="gap", detail=f"{period_s * counts.size:.2f} s whole")
    if taken.fault:
        return replace(dwell, reason="rail", detail="the converter's fault")
    stretched = extension(counts, taken.channel)
    length = bar_length(stretched, bar)
    block = block_length(taken)
    found = settled(length, block, bar.gain**2 * sensing.noise.block_var, max(UNSETTLED * bar.sigma, MICRON))
    first = _first_sample(found, counts.size, block)
    if period_s * (counts.size - first + 1) < rules.shortest_s:
        reason, detail = _unusable(counts, stretched, bar)
        quick = quick_noise(length)
        if not reason and quick > max(NOISY * abs(bar.gain) * sensing.noise.quick, MICRON):
            reason, detail = "noisy", _noise_words(quick, NOISY * abs(bar.gain) * sensing.noise.quick)
        elif not reason:
            reason, detail = _unsettled(found, round(rules.shortest_s / (block * period_s)))
        return replace(dwell, reason=reason, detail=detail)
    dwell = _with_mean(dwell, mean_of(length[first:]), bar)
    if first:
        late_s = 1e-9 * (begin_ns - dwell.start_host_ns) + period_s * first
        dwell = begun_at(dwell, dwell.start_s + late_s, begin_ns + first * taken.period_ns, sensing.joints)
    reason, detail = _unusable(counts[first:], stretched[first:], bar)
    # A drift within the bar's declared repeatability is covered by it.
    if not reason and abs(dwell.drift) > max(DRIFT_SIGMAS * dwell.drift_sigma, bar.sigma, MICRON):
        reason, detail = "drift", f"{UM.text(dwell.drift, '+.0f')} in {period_s * dwell.n_samples:.1f} s"
    return replace(dwell, reason=reason, detail=detail)


def settled(length: Floats, block: int, usual_var: float, floor: float) -> Settled | None:
    """Where the lengths (n,) [m] come to rest, in blocks of so many samples; None where there are too few to say.

    ``usual_var`` [m²]: of a block's mean at rest, NaN where not known.
    """
    means = block_means(length, block)
    if means.size < LEAST_BLOCKS:
        return None
    own = block_variance(length, block)
    variance = own if np.isnan(usual_var) else min(max(own, usual_var), OWN_NOISE * usual_var)
    return settled_from(means, variance, floor)


def without_noisy(dwells: Sequence[Dwell]) -> list[Dwell]:
    """The dwells, those much noisier than most with that as their reason."""
    noise = [dwell.noise for dwell in dwells if not dwell.reason]
    limit = max(NOISY * float(np.median(noise)), MICRON) if noise else np.inf
    return [
        replace(d, reason="noisy", detail=_noise_words(d.noise, limit)) if not d.reason and d.noise > limit else d
        for d in dwells
    ]


def _first_sample(found: Settled | None, n: int, block: int) -> int:
    """The first of n samples at rest; the first ones that are in no block count with their neighbours."""
    return n % block + int(found.first) * block if found is not None and found.first else 0


def _with_mean(dwell: Dwell, of: MeanOfSamples, bar: BallBar) -> Dwell:
    return replace(
        dwell,
        value=of.mean,
        value_var=of.variance,
        sigma=float(np.sqrt(of.variance + bar.sigma**2)),
        noise=of.noise,
        drift=of.drift,
        drift_sigma=of.drift_sigma,
        n_samples=of.n,
        n_eff=of.n_eff,
    )


def _unusable(counts: NDArray[Any], stretched: Floats, bar: BallBar) -> tuple[str, str]:
    """Reason and detail of samples that say nothing of the length; "" where they do."""
    at_rail = int(np.count_nonzero(railed(counts)))
    if at_rail:
        return "rail", f"{at_rail} of {counts.size} samples"
    if np.any(out_of_travel(stretched, bar)):
        return "out of travel", f"{MM.text(float(np.max(np.abs(stretched))), '.1f')} of ±{MM.of(0.5 * bar.travel):.1f}"
    return "", ""


def _unsettled(found: Settled | None, last: int) -> tuple[str, str]:
    """The swing or creep that so many last blocks still show."""
    if found is None:
        return "gap", ""
    off = float(np.max(np.abs(found.deviation[-last:])))
    return "ringing" if rings(found) else "drift", f"{UM.text(off, '.0f')} off, {UM.of(found.bound):.0f} allowed"


def _noise_words(noise: float, limit: float) -> str:
    return f"{UM.text(noise, '.1f')}, {UM.of(limit):.1f} allowed"
