"""Measure passes along a line device in motion.

A **leg** is a motion from one stop or turn to the next, found from the joint readings alone (``find_legs``). It ends
where the step between two bins is slow, or turns by more than a right angle.

A **row** is at the instant of an interrogation of the head that gives the position along the device (y). Cubics fitted
to the same time before and after give y, the transverse position (x, z) and the joints there. A row needs a complete
window: no missing sample or reading, no restart of a clock. Rows lie where the magnet moves steadily, with windows that
do not overlap and noise that is not correlated.

The noise of a row is that of the readings, averaged as by the fit, plus speed times the error of the clocks
(docs/decisions/0013-points-in-motion.md).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial import legendre
from numpy.typing import NDArray

from truearm.kinds.table import ObservationTable
from truearm.session.dwells import MICRON, mean_variance
from truearm.session.joint_format import UNNUMBERED
from truearm.session.joint_readings import BinTimes, JointStream
from truearm.session.samples import ChannelSamples, Samples, extension, railed
from truearm.types import Floats, Ints, Mask, rms_of_columns

SLOW = 2e-3  # rad/s or m/s; every line is driven faster, and a robot at rest is slower
SLOW_SHARE = 0.2  # of the fastest step before and after
HORIZON_S = 0.5
LEAST_MOVE = 5e-3  # rad or m of any joint
LONGEST_SILENCE_S = 2.0  # after a longer silence the robot may have been anywhere


@dataclass(frozen=True)
class Leg:
    """One motion: controller times [s], host times, and mean readings (j,) of the first and last bin.

    ``cut``: the leg begins or ends at the limits of the readings, not where the robot rested or turned.
    """

    segment: int
    start_s: float
    end_s: float
    q_start: Floats
    q_end: Floats
    cut: bool
    start_host_ns: int
    end_host_ns: int


def find_legs(stream: JointStream) -> list[Leg]:
    """Return all legs in order of time."""
    times = stream.bins.times
    if len(times.n) < 2:
        return []
    mean = stream.bins.means()
    step, seconds, joined = _steps(times, mean)
    speed = np.max(np.abs(step), axis=1) / seconds
    turns = np.einsum("ij,ij->i", step[1:], step[:-1]) < 0.0  # at bin k + 1
    # One more step at either end, before the readings began and after they ended
    joined, moving = np.pad(joined, 1), np.pad(joined & ~_slow(speed, seconds, stream.step), 1)
    first = np.flatnonzero(moving[1:-1] & (~moving[:-2] | np.append(False, turns)))
    last = np.flatnonzero(moving[1:-1] & (~moving[2:] | np.append(turns, False)))
    begins, ends = (
        joined[first],
        joined[last + 2],
    )  # with the slow steps, in which the robot was at the ends of its motion
    span = np.stack([first - (begins & ~moving[first]), last + 1 + (ends & ~moving[last + 2])])
    moved = np.max(np.abs(np.diff(mean[span], axis=0)), axis=(0, 2)) >= LEAST_MOVE
    runs = [(a, b, cut) for (a, b), cut in zip(span.T[moved].tolist(), (~(begins & ends))[moved].tolist(), strict=True)]
    segment = times.segment[[a for a, _, _ in runs]]
    t_s = np.array([(times.t_first_s[a], times.t_last_s[b]) for a, b, _ in runs]).reshape(-1, 2)
    rows = zip(segment.tolist(), t_s.tolist(), runs, stream.to_host_ns(segment, t_s).tolist(), strict=True)
    return [Leg(k, t[0], t[1], mean[a], mean[b], cut, *host) for k, t, (a, b, cut), host in rows]


def _steps(bins: BinTimes, mean: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return the change of the mean (b − 1, j) between successive bins, its time [s], and whether it is one motion."""
    middle = 0.5 * (bins.t_first_s + bins.t_last_s)
    seconds = np.diff(middle)
    joined = (np.diff(bins.segment) == 0) & (seconds > 0.0)
    joined &= bins.t_first_s[1:] - bins.t_last_s[:-1] < LONGEST_SILENCE_S
    return np.diff(mean, axis=0), np.where(joined, seconds, 1.0), joined


def _slow(speed: Floats, seconds: Floats, quantum: Floats) -> NDArray[np.bool_]:
    """Return the steps (b − 1,) at which a leg ends."""
    reach = max(1, round(HORIZON_S / float(np.median(seconds))))
    earlier, later = _highest_before(speed, reach), _highest_before(speed[::-1], reach)[::-1]
    lowest = SLOW + np.max(quantum, initial=0.0) / seconds
    return np.asarray((speed <= lowest) | (speed <= SLOW_SHARE * np.minimum(earlier, later)))


def _highest_before(speed: Floats, reach: int) -> Floats:
    """Return the maximum of each step and the ``reach`` steps before it."""
    return np.asarray(sliding_window_view(np.append(np.zeros(reach), speed), reach + 1).max(axis=1))


DEGREE = 3
LEAST = DEGREE + 3  # samples per window
MISSED = 9.0 / 8.0  # error at the middle divided by the RMS of the residuals


class LocalFits(NamedTuple):
    """Local fits at r instants of c signals.

    Value (r, c), rate (r, c) [1/s], RMS residual (r, c) for n − 4 degrees of freedom, number of samples n (r,), and
    variance of the value (r,) for white noise of variance 1.
    """

    value: Floats
    rate: Floats
    rms: Floats
    n: NDArray[np.int64]
    leverage: Floats


def fit_locally(t: Floats, values: Floats, centres: Floats, half_s: float) -> LocalFits:
    """Fit cubics around ``centres`` (r,) [s] to samples ``values`` (n, c) at ascending ``t`` (n,) [s].

    w is ``half_s``.

    NaN where a window holds fewer than LEAST samples. The caller must check that a window is complete.
    """
    r, c = centres.size, values.shape[1]
    low, high = np.searchsorted(t, centres - half_s), np.searchsorted(t, centres + half_s, side="right")
    value, rate, rms = (np.full((r, c), np.nan) for _ in range(3))
    out = LocalFits(value, rate, rms, high - low, np.full(r, np.nan))
    for k in np.flatnonzero(high - low >= LEAST):
        window = slice(low[k], high[k])
        u = (t[window] - centres[k]) / half_s
        q, triangle = np.linalg.qr(np.vander(u, DEGREE + 1, increasing=True))
        if np.abs(np.diag(triangle)).min() < 1e-6:  # all samples at one time
            continue
        of_samples = q.T @ values[window]
        inverse = np.linalg.inv(triangle)
        out.value[k], out.rate[k] = (inverse @ of_samples)[:2]
        out.rate[k] /= half_s
        residuals = values[window] - q @ of_samples
        out.rms[k] = np.sqrt(np.sum(residuals**2, axis=0) / (u.size - DEGREE - 1))
        out.leverage[k] = float(inverse[0] @ inverse[0])
    return out


READINGS = 7.0  # width of a window in periods of the robot's readings
LEAST_WINDOW_S = 0.1
LONGEST_S = 300.0
LEAST_TRAVEL = 0.01  # least travel [m] of the magnet along the device in a pass
LEAST_ROWS = 5
STEADY = 0.9  # of the median speed
LOST = 1.6  # in robot periods: a larger step between readings means that one is missing
REACH = 1.2  # periods from a window's end to its first sample; one more would mean a missing sample
STOPPED = 0.8  # share of a window's interrogations that must have a stop pulse
NOISY = 5.0  # multiple of the median residual of the pass
STRETCH = 8  # windows; over this length a polynomial of degree TREND is the motion, and its residual is noise
TREND = 8
FORGOTTEN = 2.0  # integrated correlation times after which noise is independent


@dataclass(frozen=True)
class LinePass:
    """One motion along a line and its outcome; ``reason`` is "" if it gave rows.

    ``direction`` is +1 where y rises. ``table``: the r rows; their ``xyz_sigma`` is of the device's own noise and of
    its time, excluding the uncertainty declared by the rig. ``noise`` (3,) [m] and ``q_noise`` (j,) are standard
    deviations of single readings about the motion. ``q_error`` [rad or m] bounds the error of the interpolated joints.
    ``dropped``: rows that could not be made, by reason.
    """

    leg: Leg
    mounted: dict[str, str]
    reason: str = ""
    pose: int | None = None  # of the plan, the line's end
    direction: int = 0
    speed: float = float("nan")  # m/s, median
    window_ns: int = 0  # before and after a row
    table: ObservationTable = field(default_factory=lambda: ObservationTable(q=np.empty((0, 0)), kind="line"))
    noise: Floats = field(default_factory=lambda: np.full(3, np.nan))
    q_noise: Floats = field(default_factory=lambda: np.empty(0))
    q_error: float = float("nan")
    correlation_s: float = float("nan")
    time_sigma_s: float = float("nan")
    clock_bound_ns: float = float("nan")
    n_samples: int = 0
    dropped: dict[str, int] = field(default_factory=dict)


class _Signal(NamedTuple):
    """Samples (n,) in order: times [s] since the start of the leg, values (n, c), and gap-free pieces."""

    t: Floats
    values: Floats
    piece: Ints

    def where(self, rows: NDArray[Any]) -> _Signal:
        """Return a selection of the samples."""
        return _Signal(self.t[rows], self.values[rows], self.piece[rows])


@dataclass(frozen=True)
class _Signals:
    """Signals during a leg.

    ``shots``: all interrogations, and ``y`` those that were answered. ``across``: without samples at a rail or beyond
    the reach of the transducers, which are at ``off_t`` (k,). ``half_s``: half of the window of a row. ``period_s``: of
    the interrogations. ``step`` (j,): quantisation of the joints.
    """

    y: _Signal
    shots: _Signal
    across: _Signal
    off_t: Floats
    q: _Signal
    half_s: float
    period_s: float
    step: Floats


def measure(
    passing: LinePass,
    samples: Sequence[ChannelSamples],
    joints: JointStream,
    any_clock: bool,
    reach: float,
    points: int | None,
) -> LinePass | None:
    """Return the pass with its rows or with the reason why it has none; None if nothing moved along the device.

    ``samples``: of the channels along and across the device. ``reach`` [m]: range within which the transducers are
    valid. ``points``: maximum number of rows; None: as many as the noise allows. Raises SessionError for a channel
    without a calibration to metres.
    """
    leg = passing.leg
    along, across = (_without_faults(channels.during(leg.start_host_ns, leg.end_host_ns)) for channels in samples)
    if along is None or across is None:
        return replace(passing, reason="no samples" if any_clock else "no clock")
    bound_ns = max(along.bound_ns, across.bound_ns)
    passing = replace(passing, clock_bound_ns=bound_ns, time_sigma_s=_time_sigma(bound_ns, leg, joints))
    signals = _signals(leg, along, across, joints, reach)
    if signals is None:
        return replace(passing, reason="gap")
    grid = np.arange(signals.half_s, 1e-9 * (leg.end_host_ns - leg.start_host_ns), signals.half_s)
    why = _wrong(signals, grid)
    coarse = fit_locally(*signals.y[:2], grid, signals.half_s)
    good = (why == "") & np.isfinite(coarse.rate[:, 0])
    if good.sum() < 2:
        return _without_rows(passing, Counter(why[~good].tolist()))
    if np.ptp(coarse.value[good]) < LEAST_TRAVEL:
        return replace(passing, reason="not along the line") if passing.pose is not None else None
    if passing.reason:
        return passing
    velocity = coarse.rate[:, 0] * good
    direction = 1 if np.nansum(velocity) > 0.0 else -1
    steady = _steady(np.nan_to_num(velocity * direction))
    passing = replace(passing, direction=direction, speed=float(np.median(np.abs(velocity[steady]))))
    first, last = np.flatnonzero(steady)[[0, -1]]  # windows stay within these: the ramps are excluded
    span = float(grid[first]), float(grid[last])
    with np.errstate(invalid="ignore"):
        lost = (why != "") & (coarse.rate[:, 0] * direction >= STEADY * passing.speed)
    lost[first : last + 1] = False  # rows in between are counted one by one
    beyond = Counter(why[lost][::2].tolist())  # a row is as wide as two steps of the grid
    return _rows(passing, signals, span, beyond, points)


def _readings(leg: Leg, joints: JointStream) -> tuple[_Signal, float]:
    """Return the robot's readings of a leg by time, and their period [s], NaN with fewer than two."""
    t, seq, q = joints.between(leg.segment, leg.start_s, leg.end_s)
    t, first = np.unique(t, return_index=True)
    seq, q = seq[first], q[first]
    if t.size < 2:
        return _Signal(t, q, seq), float("nan")
    intervals, t_ns = np.diff(t), joints.clocks[leg.segment].to_host_ns(t)
    numbered = (seq[1:] != UNNUMBERED) & (seq[:-1] != UNNUMBERED)
    broken = (intervals > LOST * float(np.median(intervals))) | (numbered & (np.diff(seq) != 1))
    piece = np.cumsum(np.append(False, broken))
    return _Signal(_seconds(t_ns, leg), q, piece), 1e-9 * float(np.median(np.diff(t_ns)))


def _seconds(t_ns: Ints, leg: Leg) -> Floats:
    return np.asarray(1e-9 * (t_ns - leg.start_host_ns))


def _without_faults(samples: Samples | None) -> Samples | None:
    """Return the samples that the converter did not flag; a piece ends where it did."""
    if samples is None or samples.fault.all():
        return None
    return replace(samples, piece=samples.piece + np.cumsum(samples.fault)).take(~samples.fault)


def _time_sigma(bound_ns: float, leg: Leg, joints: JointStream) -> float:
    """Return the standard deviation [s] of a row's time, without the constant part, which the time offset τ absorbs.

    Within their bounds, nothing is known about the clock errors of box and robot, so they are taken as uniform.
    """
    robot_ns = joints.clocks[leg.segment].bound_at(np.array([leg.start_s, leg.end_s])).max()
    return 1e-9 * float(np.hypot(bound_ns, robot_ns) / np.sqrt(3.0))


def _signals(leg: Leg, along: Samples, across: Samples, joints: JointStream, reach: float) -> _Signals | None:
    readings, period_s = _readings(leg, joints)
    if readings.t.size < LEAST:
        return None
    shots = _Signal(_seconds(along.t_ns, leg), extension(along.counts, along.channels[0]), along.piece)
    aside = np.stack([extension(across.counts[:, k], channel) for k, channel in enumerate(across.channels)], axis=1)
    transverse = _Signal(_seconds(across.t_ns, leg), aside, across.piece)
    on = np.asarray(~railed(across.counts).any(axis=1) & (np.abs(aside) <= reach).all(axis=1), dtype=bool)
    return _Signals(
        y=shots.where(np.flatnonzero(along.counts[:, 0] > 0)),
        shots=shots,
        across=transverse.where(on),
        off_t=transverse.t[~on],
        q=readings,
        half_s=0.5 * max(LEAST_WINDOW_S, READINGS * period_s),
        period_s=1e-9 * along.period_ns,
        step=joints.step,
    )


def _wrong(s: _Signals, centres: Floats) -> NDArray[np.str_]:
    """Return why no row can be made at each instant (r,); "" where one can."""
    why = np.full(centres.size, "", dtype="U20")
    why[_count(s.y.t, centres, s.half_s) < STOPPED * _count(s.shots.t, centres, s.half_s)] = "no stop pulses"
    why[_count(s.off_t, centres, s.half_s) > 0] = "out of range"
    complete = _whole(s.shots, centres, s.half_s) & _whole(s.q, centres, s.half_s)
    complete &= _whole(s.across, centres, s.half_s) | (why == "out of range")
    why[~complete] = "gap"
    return why


def _count(t: Floats, centres: Floats, half_s: float) -> Ints:
    return np.asarray(np.searchsorted(t, centres + half_s, side="right") - np.searchsorted(t, centres - half_s))


def _whole(signal: _Signal, centres: Floats, half_s: float) -> Mask:
    """Return where the window is filled from end to end by a single gap-free piece."""
    t, _, piece = signal
    if t.size < LEAST:
        return np.zeros(centres.size, dtype=bool)
    low = np.searchsorted(t, centres - half_s)
    high = np.searchsorted(t, centres + half_s, side="right") - 1
    a, b = np.minimum(low, t.size - 1), np.maximum(high, 0)
    reach = REACH * float(np.median(np.diff(t)))
    filled = (t[a] - (centres - half_s) < reach) & (centres + half_s - t[b] < reach)
    return np.asarray((high - low + 1 >= LEAST) & filled & (piece[a] == piece[b]))


def _steady(forward: Floats) -> Mask:
    """Return the instants at which the magnet moves at nearly its median speed or faster; ``forward`` (r,) [m/s]."""
    moving = forward > (1.0 - STEADY) * forward.max()
    return np.asarray(forward >= STEADY * float(np.median(forward[moving])), dtype=bool)


def _rows(
    passing: LinePass, s: _Signals, span: tuple[float, float], beyond: Counter[str], points: int | None
) -> LinePass:
    """Return the rows between two times. ``beyond``: why some rows before and after could not be made."""
    first, last = span
    correlation, correlation_s = _correlation(s, first, last)
    passing = replace(passing, correlation_s=correlation_s, window_ns=round(1e9 * s.half_s))
    centres = _instants(s.y.t, first + s.half_s, last - s.half_s, 2.0 * s.half_s, FORGOTTEN * correlation_s, points)
    why = _wrong(s, centres)
    along, aside, joints = (fit_locally(*signal[:2], centres, s.half_s) for signal in (s.y, s.across, s.q))
    rms = _beside(along.rms, aside.rms)
    sound = np.isfinite(rms).all(axis=1) & np.isfinite(joints.rms).all(axis=1)
    why[(why == "") & ~sound] = "gap"
    slow = passing.direction * along.rate[:, 0] < STEADY * passing.speed
    usable = (why == "") & ~slow
    if usable.any():
        limit = np.maximum(NOISY * np.median(rms[usable], axis=0), MICRON)
        why[usable & (rms > limit).any(axis=1)] = "noisy"
        usable &= why == ""
    passing = replace(passing, dropped=dict(Counter(why[why != ""].tolist()) + beyond))
    if usable.sum() < LEAST_ROWS:
        return _without_rows(passing, Counter(passing.dropped))
    noise = rms_of_columns(rms[usable])
    leverage = np.stack([aside.leverage, along.leverage, aside.leverage], axis=1)[usable]
    noise_var = noise**2 * np.minimum(leverage * correlation, 1.0)
    by_time = (_beside(along.rate, aside.rate)[usable] * passing.time_sigma_s) ** 2
    t_host_ns = passing.leg.start_host_ns + np.rint(1e9 * centres[usable]).astype(np.int64)
    table = ObservationTable(
        q=joints.value[usable],
        kind="line",
        shell=f"{passing.mounted['line']}-{'up' if passing.direction > 0 else 'down'}",
        line=passing.mounted.get("line", ""),
        target=passing.mounted.get("target", ""),
        time=1e-9 * t_host_ns,
        xyz=_beside(along.value, aside.value)[usable],
        xyz_sigma=np.sqrt(noise_var + by_time),
        q_rate=joints.rate[usable],
    )
    return replace(
        passing,
        table=table,
        noise=noise,
        q_noise=np.maximum(rms_of_columns(joints.rms[usable]), s.step / np.sqrt(12.0)),
        q_error=float(np.max(MISSED * joints.rms[usable] + 0.5 * s.step)),  # one that hardly moves stays on one step
        n_samples=int(along.n[usable].sum()),
    )


def _beside(y: Floats, xz: Floats) -> Floats:
    """Return y (r, 1) between x and z (r, 2), in the order of the device's axes."""
    return np.stack([xz[:, 0], y[:, 0], xz[:, 1]], axis=1)


def _instants(y_t: Floats, first: float, last: float, width: float, forgotten: float, points: int | None) -> Floats:
    """Return the interrogations (r,) at which rows are made, evenly spaced and with windows that do not overlap."""
    limit = max(1, int((last - first) / width) + 1)
    n = max(1, int((last - first) / max(width, forgotten)) + 1) if points is None else min(points, limit)
    instants = np.linspace(first, last, n) if n > 1 else np.array([0.5 * (first + last)])
    following = np.clip(np.searchsorted(y_t, instants), 1, y_t.size - 1)
    nearer = instants - y_t[following - 1] < y_t[following] - instants
    return np.unique(y_t[following - nearer])


def _correlation(s: _Signals, first: float, last: float) -> tuple[Floats, float]:
    """Return how many samples of x, y, z (3,) the noise stays correlated, and the longest of these times [s]."""
    channels = ((s.across, 0), (s.y, 0), (s.across, 1))
    count, longest = np.ones(3), s.period_s
    for k, (signal, column) in enumerate(channels):
        t, values = signal.t, signal.values[:, column]
        residuals, fitted = _noise(t, values, np.arange(first, last, 2.0 * STRETCH * s.half_s))
        if fitted:
            variance, noise = mean_variance(residuals, fitted)
            count[k] = max(1.0, variance * residuals.size / noise**2) if noise > 0.0 else 1.0
            longest = max(longest, count[k] * float(np.median(np.diff(t))))
    return count, longest


def _noise(t: Floats, values: Floats, starts: Floats) -> tuple[Floats, int]:
    """Return the residuals of a polynomial through each stretch, concatenated, and the number of coefficients used."""
    cuts = np.searchsorted(t, starts)
    residuals = []
    for a, b in pairwise(cuts.tolist()):
        if b - a > 4 * (TREND + 1):
            u = np.linspace(-1.0, 1.0, b - a)
            residuals.append(values[a:b] - legendre.legval(u, legendre.legfit(u, values[a:b], TREND)))
    return np.concatenate([np.empty(0), *residuals]), (TREND + 1) * len(residuals)


def _without_rows(passing: LinePass, why: Counter[str]) -> LinePass:
    """Return the pass with the most frequent reason for its missing rows."""
    (reason, _), *_ = why.most_common(1) or [("too short", 0)]
    return replace(passing, reason=reason or "too short")
