"""Dwells: where the robot stood still, from its joint readings alone (hop 5).

How much a reading moves while the robot rests is not declared anywhere, so the readings say it themselves: the range of each
joint over windows of four bins (0.2 s), of which the tenth percentile belongs to rest as long as the robot rests a tenth of
the time. With n Gaussian readings a window that percentile is 2.6 (n = 16) to 4.3 (n = 100) standard deviations; three
times it is a threshold of 8 to 13, which rest does not cross and motion does at once. The threshold is never below two steps
of the quantisation nor below a microradian.

Bins that share a window whose range keeps below the threshold belong together; a chain of them is a dwell. Its beginning is
discarded (the arm still swings although the encoders stand), and what is left must keep below the threshold as a whole, lest
a creep slower than the threshold in each window pass.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from truearm.sync.joints import Bins, JointStream
from truearm.types import Floats

WINDOW_BINS = 4
QUIET_SHARE = 0.1
QUIET_FACTOR = 3.0
LEAST_MOTION = 1e-6  # rad or m
SHORTEST_S = 0.25  # shorter pauses (a turn of direction) are no attempt at a dwell and not listed

REASONS = (
    "too short",
    "still moving",
    "gap",
    "rail",
    "out of travel",
    "noisy",
    "no samples",
    "no clock",
    "no plan match",
    "ambiguous",  # the plan holds this pose with different fittings, and nothing says which were mounted
)


@dataclass(frozen=True)
class DwellRules:
    """What a dwell must be to give an observation. Times in s, ``pose_tolerance`` in rad (or m), the same for all joints."""

    settle_s: float = 0.5  # discarded at the beginning
    shortest_s: float = 1.0  # at least so much must be left
    longest_s: float = 60.0  # no more than this is used: a robot parked overnight is one dwell too
    guard_s: float = 0.1  # discarded at the end: the robot's clock runs late by an unknown latency
    pose_tolerance: float = np.pi / 180.0


@dataclass(frozen=True)
class Dwell:
    """One stop of the robot and what became of it. ``reason`` is "" if it gave an observation, else one of REASONS.

    ``start_s``, ``end_s``: controller time of the part that is used, the settling time left out. ``q_cov`` is the
    covariance of single readings about their mean, quantisation included. ``value`` [m] is the mean length of the bar,
    ``value_var`` [m²] the variance of that mean from the samples alone, ``sigma`` [m] with the declared repeatability.
    """

    segment: int
    start_s: float
    end_s: float
    q: Floats  # (j,) mean reading
    q_cov: Floats  # (j, j)
    n_readings: int
    reason: str = ""
    start_host_ns: int = 0
    end_host_ns: int = 0
    value: float = float("nan")
    value_var: float = float("nan")
    sigma: float = float("nan")
    noise: float = float("nan")  # m, standard deviation of a sample
    drift: float = float("nan")  # m, of a straight line through the samples, from end to end
    n_samples: int = 0
    n_eff: float = 0.0
    clock_bound_ns: float = float("nan")
    pose: int | None = None  # row of the plan
    mounted: dict[str, str] = field(default_factory=dict)  # bar, chuck, sphere, shell
    q_cmd: Floats = field(default_factory=lambda: np.empty(0))  # (j,) mean commanded, NaN if not said; nothing uses it


def find_dwells(stream: JointStream, rules: DwellRules) -> list[Dwell]:
    """All stops in order of time; those that the joint readings already rule out carry their reason."""
    bins = stream.bins
    if bins is None:
        return []
    ranges, whole = _window_ranges(bins)
    if not np.any(whole):
        return []
    threshold = motion_threshold(ranges[whole], stream.step)
    quiet = whole & np.all(ranges <= threshold, axis=1)
    return [
        _dwell(bins, slice(first, last), rules, threshold, stream.step)
        for first, last in _runs(quiet, len(bins.n))
        if bins.t_last_s[last - 1] - bins.t_first_s[first] >= SHORTEST_S
    ]


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


def _dwell(bins: Bins, run: slice, rules: DwellRules, threshold: Floats, step: Floats) -> Dwell:
    t0 = bins.t_first_s[run.start]
    settled = np.flatnonzero(
        (bins.t_first_s[run] >= t0 + rules.settle_s) & (bins.t_last_s[run] <= t0 + rules.settle_s + rules.longest_s)
    )
    used = slice(run.start + settled[0], run.start + settled[-1] + 1) if settled.size else run
    q, q_cov, n = _statistics(bins, used, step)
    start, end = float(bins.t_first_s[used.start]), float(bins.t_last_s[used.stop - 1]) - rules.guard_s
    reason = ""
    if not settled.size or end - start < rules.shortest_s:
        reason = "too short"
    elif np.any(np.max(bins.high[used], axis=0) - np.min(bins.low[used], axis=0) > threshold):
        reason = "still moving"
    q_cmd = np.average(bins.commanded[used], axis=0, weights=bins.n[used])
    return Dwell(int(bins.segment[run.start]), start, end, q, q_cov, n, reason, q_cmd=q_cmd)


def _statistics(bins: Bins, used: slice, step: Floats) -> tuple[Floats, Floats, int]:
    """Mean (j,) and covariance (j, j) of the readings in these bins; the latter at least that of the quantisation."""
    n, mean = bins.n[used], bins.mean[used]
    total = int(np.sum(n))
    q = np.sum(n[:, None] * mean, axis=0) / total
    between = (mean - q) * np.sqrt(n)[:, None]
    scatter = np.sum(bins.scatter[used], axis=0, dtype=np.float64) + between.T @ between
    # The smallest change seen is the step of a quantised reading; of a fine one it is next to nothing.
    return q, scatter / max(1, total - 1) + np.diag(step**2) / 12.0, total
