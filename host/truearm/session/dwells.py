"""Dwells: where the robot stood still, from its joint readings (hop 5); what the sensor says of them is in ``measure``.

How much a reading moves while the robot rests is not declared anywhere, so the readings say it themselves: the range of each
joint over windows of four bins (0.2 s), of which the tenth percentile belongs to rest as long as the robot rests a tenth of
the time. With n Gaussian readings a window that percentile is 2.6 (n = 16) to 4.3 (n = 100) standard deviations; three
times it is a threshold of 8 to 13, which rest does not cross and motion does at once. The threshold is never below two steps
of the quantisation nor below a microradian.

Bins that share a window whose range keeps below the threshold belong together; a chain of them is a stop. What still creeps
below that threshold is left out by ``settled_from()``: a dwell begins where the bins' means keep to the level of the stop's
second half, within what bins of resting stops differ by. Some of the beginning is left out in any case: the robot's clock may
run late, and a window may reach into the motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from truearm.session.joint_readings import Bins, JointStream
from truearm.session.sample_statistics import LEAST_BLOCKS, settled_from
from truearm.types import Floats

WINDOW_BINS = 4
QUIET_SHARE = 0.1
QUIET_FACTOR = 3.0
LEAST_MOTION = 1e-6  # rad or m
SHORTEST_S = 0.25  # shorter pauses (a turn of direction) are no attempt at a dwell and not listed

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
    q_cmd: Floats = field(default_factory=lambda: np.empty(0))  # (j,) mean commanded, NaN if not said; nothing uses it


def find_dwells(stream: JointStream, rules: DwellRules) -> list[Dwell]:
    """All stops in order of time; those that the joint readings already rule out carry their reason."""
    return [] if stream.bins is None else find_stops(stream.bins, stream.step, rules)


def find_stops(bins: Bins, step: Floats, rules: DwellRules) -> list[Dwell]:
    """The stops of whatever is in the bins, by its own noise and its step (j,)."""
    ranges, whole = _window_ranges(bins)
    if not np.any(whole):
        return []
    threshold = motion_threshold(ranges[whole], step)
    quiet = whole & np.all(ranges <= threshold, axis=1)
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


def motion_threshold(ranges: Floats, step: Floats) -> Floats:
    """Largest range (j,) of the joints in a window that is still rest, from the ranges (w, j) of whole windows."""
    rest = np.quantile(ranges, QUIET_SHARE, axis=0)
    return np.asarray(np.maximum(np.maximum(QUIET_FACTOR * rest, 2.001 * step), LEAST_MOTION))


def _window_ranges(bins: Bins) -> tuple[Floats, NDArray[np.bool_]]:
    """Range (b, j) over each bin and its three followers, and whether there are such without a gap between."""
    b = len(bins.n)
    high, low, whole = bins.high.copy(), bins.low.copy(), np.arange(b) <= b - WINDOW_BINS
    for k in range(1, WINDOW_BINS):
        np.maximum(high[:-k], bins.high[k:], out=high[:-k])
        np.minimum(low[:-k], bins.low[k:], out=low[:-k])
        whole[:-k] &= ~bins.gap[k:]
    return high - low, whole


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
    firsts = [settled_from(means[:, j], fewer * rest.bin_var[j], rest.floor[j]).first for j in range(means.shape[1])]
    return max(firsts), int(np.argmax(firsts))


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
    q_cmd: Floats
    n_readings: int
    bins: tuple[int, int]


def _readings(bins: Bins, used: slice, step: Floats) -> _Readings:
    """Means (j,) and covariance (j, j) of the readings in these bins; the latter at least that of the quantisation."""
    n, mean = bins.n[used], bins.mean[used]
    total = int(np.sum(n))
    q = np.sum(n[:, None] * mean, axis=0) / total
    between = (mean - q) * np.sqrt(n)[:, None]
    scatter = np.sum(bins.scatter[used], axis=0, dtype=np.float64) + between.T @ between
    # The smallest change seen is the step of a quantised reading; of a fine one it is next to nothing.
    return _Readings(
        q=q,
        q_cov=scatter / max(1, total - 1) + np.diag(step**2) / 12.0,
        q_cmd=np.average(bins.commanded[used], axis=0, weights=n),
        n_readings=total,
        bins=(used.start, used.stop),
    )
