"""Passes along a line device, measured in motion: which leg was which line, and the rows of it (hop 5).

The magnetostrictive head says where the magnet is along the device (its y) at the edge of each interrogation, two
transducers how far aside (x and z) by samples that show what was their group delay earlier, the robot where its joints
were. At each instant of a row, that of an interrogation, all three are the values of cubics through what was said within the
same time before and after (``local_fit``): wide enough for seven readings of the joints and a tenth of a second. A row is
made only where that time is whole: no sample, reading or life of a clock is missing in it, and nothing is extrapolated.

Rows are taken where the magnet moves steadily, at nine tenths of its median speed or more: how fast a robot starts and
stops is no matter of kinematics. They follow each other as closely as their windows do not overlap and the device's
noise has forgotten the last one: by its integrated correlation time, of what a polynomial through eight windows leaves.

What a row says of its own noise is the readings' noise, averaged as the fit averages it, and the speed times the error of
the clocks. What the rig declares of the device comes on top where the row is used.

The clocks' errors count as if every row had its own, though in one life of box and controller all rows share it: measured
in the simulator, it differs by ± 4 µs from pass to pass where the bounds are 230 to 250 µs. That does no harm. A common error is
τ's, to which it adds: σ(τ) is of τ as the lines show it, and as the robot's delay it may be wrong by the bounds. What differs
between the lives of a session, or even from pass to pass by the whole bound, is up and down along each line in turn, which no
robot looks like: the variance of no combination of the robot's parameters becomes 1.0001 times what it is said to be (four lines there and
back at 100 mm/s, 0.14 ms, device poses unknown; 1.01 with poses known to 0.1 mm). It would matter past devices whose place is known
exactly: 1.7 times with an error per pass, 2.4 driven one way in two lives of the clocks, 3.9 if τ is declared known too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from truearm.session.device_clock import DeviceClock
from truearm.session.joint_readings import JointStream
from truearm.session.legs import Leg, LegSamples, Readings, Samples, readings_of, samples_of
from truearm.session.local_fit import LEAST, MISSED, fit_locally
from truearm.session.lvdt import extension, railed
from truearm.session.sample_statistics import mean_variance
from truearm.types import Floats

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

ALONG, ACROSS = ("magnetostrictive",), ("transverse_a", "transverse_b")  # channels of the device's y; x and z
WANTED = (ALONG, ACROSS)
REASONS = (
    "too short",
    "too long",
    "gap",
    "out of range",
    "no stop pulses",
    "noisy",
    "not along the line",
    "no samples",
    "no clock",
    "no plan match",
    "ambiguous",
)
READINGS = 7.0  # periods of the robot's readings that a window is wide
LEAST_WINDOW_S = 0.1
LONGEST_S = 300.0
LEAST_TRAVEL = 0.01  # m that the magnet moves along in a pass
LEAST_ROWS = 5
STEADY = 0.9  # of the median speed
REACH = 1.2  # periods from a window's end to the first sample in it; one more would be a sample that is missing
STOPPED = 0.8  # share of a window's interrogations that a stop pulse must have answered
NOISY = 5.0  # times the median residual of the pass
MICRON = 1e-6
STRETCH = 8  # windows; over so much a polynomial of degree TREND is the motion, and what it leaves the noise
TREND = 8
FORGOTTEN = 2.0  # integrated correlation times after which noise is new


@dataclass(frozen=True)
class LineRules:
    """``points``: rows of a pass at most; None: as many as the noise allows. ``pose_tolerance`` in rad (or m). ``reach`` [m]: how
    far aside the transducers are believed."""

    points: int | None = None
    pose_tolerance: float = np.pi / 180.0
    reach: float = np.inf


@dataclass(frozen=True)
class Pass:
    """One motion along a line and what became of it; ``reason`` is "" if it gave rows, else one of REASONS.

    ``direction`` is +1 where y rises. The r rows: instants on the host's clock, joints and their rates, the device's
    reading and the standard deviation of its own noise and of its time, without what the rig declares. ``noise`` (3,) [m] and ``q_noise`` (j,) are of
    single readings about the motion; ``q_error`` [rad or m] bounds the error of the interpolated joints. ``dropped``: rows
    that could not be made, by reason.
    """

    leg: Leg
    mounted: dict[str, str]
    reason: str = ""
    pose: int | None = None  # of the plan, the line's end
    direction: int = 0
    speed: float = float("nan")  # m/s, median
    window_ns: int = 0  # before and after a row
    t_host_ns: Ints = field(default_factory=lambda: np.empty(0, np.int64))  # (r,)
    q: Floats = field(default_factory=lambda: np.empty((0, 0)))  # (r, j)
    q_rate: Floats = field(default_factory=lambda: np.empty((0, 0)))  # (r, j)
    xyz: Floats = field(default_factory=lambda: np.empty((0, 3)))  # (r, 3)
    xyz_sigma: Floats = field(default_factory=lambda: np.empty((0, 3)))  # (r, 3)
    noise: Floats = field(default_factory=lambda: np.full(3, np.nan))
    q_noise: Floats = field(default_factory=lambda: np.empty(0))
    q_error: float = float("nan")
    correlation_s: float = float("nan")
    time_sigma_s: float = float("nan")
    clock_bound_ns: float = float("nan")
    n_samples: int = 0
    dropped: dict[str, int] = field(default_factory=dict)

    @property
    def group(self) -> str:
        """What the rows of this direction have in common, for ``--hold-out shell=``."""
        return f"{self.mounted['line']}-{'up' if self.direction > 0 else 'down'}"


@dataclass(frozen=True)
class _Signals:
    """What was said during a leg, in seconds since it began: times, values and the pieces that are whole."""

    y_t: Floats
    y: Floats  # (n, 1), of answered interrogations
    shots_t: Floats
    shots_piece: Ints
    across_t: Floats
    across: Floats  # (m, 2)
    across_piece: Ints
    off_t: Floats  # (k,) samples of the transducers at a rail or beyond their reach
    q_t: Floats
    q: Floats
    q_piece: Ints
    half_s: float


def measure(
    passing: Pass, heard: LegSamples, clocks: Mapping[int, DeviceClock], joints: JointStream, rules: LineRules
) -> Pass | None:
    """The pass with its rows or with the reason why it has none; None where nothing moved along the device.

    Raises SessionError for a channel without a calibration to metres.
    """
    along, across = (samples_of(heard, k, clocks) for k in range(len(WANTED)))
    readings = readings_of(heard, joints)
    if along is None or across is None:
        said = len(heard.pieces) == len(WANTED)
        return replace(passing, reason="no clock" if said else "no samples")
    bound_ns = max(along.bound_ns, across.bound_ns)
    passing = replace(passing, clock_bound_ns=bound_ns, time_sigma_s=_time_sigma(bound_ns, passing.leg, joints))
    signals = _signals(along, across, readings, passing.leg.start_host_ns, rules.reach)
    if signals is None:
        return replace(passing, reason="gap")
    grid = np.arange(signals.half_s, 1e-9 * (passing.leg.end_host_ns - passing.leg.start_host_ns), signals.half_s)
    why = _wrong(signals, grid)
    coarse = fit_locally(signals.y_t, signals.y, grid, signals.half_s)
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
    first, last = np.flatnonzero(steady)[[0, -1]]  # windows keep within: the ramps are not theirs
    span = float(grid[first]), float(grid[last])
    with np.errstate(invalid="ignore"):
        lost = (why != "") & (coarse.rate[:, 0] * direction >= STEADY * passing.speed)
    lost[first : last + 1] = False  # rows in between are told one by one
    beyond = Counter(why[lost][::2].tolist())  # a row is as wide as two steps of the grid
    return _rows(passing, signals, span, beyond, along.period_ns, joints.step, rules)


def _time_sigma(bound_ns: float, leg: Leg, joints: JointStream) -> float:
    """Standard deviation [s] of a row's time, but for what is constant, which the time offset τ takes up.

    Within their bounds nothing is known of the clocks' errors, the box's and the robot's: uniform.
    """
    robot_ns = joints.clocks[leg.segment].bound_at(np.array([leg.start_s, leg.end_s])).max()
    return 1e-9 * float(np.hypot(bound_ns, robot_ns) / np.sqrt(3.0))


def _signals(along: Samples, across: Samples, readings: Readings, start_ns: int, reach: float) -> _Signals | None:
    if readings.t_ns.size < LEAST:
        return None

    def seconds(t_ns: Ints) -> Floats:
        return np.asarray(1e-9 * (t_ns - start_ns))

    answered = along.counts[:, 0] > 0
    aside = np.stack([extension(across.counts[:, k], channel) for k, channel in enumerate(across.channels)], axis=1)
    on = ~railed(across.counts).any(axis=1) & (np.abs(aside) <= reach).all(axis=1)
    period = 1e-9 * float(np.median(np.diff(readings.t_ns)))
    return _Signals(
        y_t=seconds(along.t_ns[answered]),
        y=extension(along.counts[answered], along.channels[0]),
        shots_t=seconds(along.t_ns),
        shots_piece=along.piece,
        across_t=seconds(across.t_ns[on]),
        across=aside[on],
        across_piece=across.piece[on],
        off_t=seconds(across.t_ns[~on]),
        q_t=seconds(readings.t_ns),
        q=readings.q,
        q_piece=readings.piece,
        half_s=0.5 * max(LEAST_WINDOW_S, READINGS * period),
    )


def _wrong(s: _Signals, centres: Floats) -> NDArray[np.str_]:
    """Why no row can be made at each instant (r,); "" where one can."""
    why = np.full(centres.size, "", dtype="U20")
    why[_count(s.y_t, centres, s.half_s) < STOPPED * _count(s.shots_t, centres, s.half_s)] = "no stop pulses"
    why[_count(s.off_t, centres, s.half_s) > 0] = "out of range"
    whole = _whole(s.shots_t, s.shots_piece, centres, s.half_s) & _whole(s.q_t, s.q_piece, centres, s.half_s)
    whole &= _whole(s.across_t, s.across_piece, centres, s.half_s) | (why == "out of range")
    why[~whole] = "gap"
    return why


def _count(t: Floats, centres: Floats, half_s: float) -> Ints:
    return np.asarray(np.searchsorted(t, centres + half_s, side="right") - np.searchsorted(t, centres - half_s))


def _whole(t: Floats, piece: Ints, centres: Floats, half_s: float) -> Mask:
    """Where the window is filled from end to end by one whole piece."""
    if t.size < LEAST:
        return np.zeros(centres.size, dtype=bool)
    low = np.searchsorted(t, centres - half_s)
    high = np.searchsorted(t, centres + half_s, side="right") - 1
    a, b = np.minimum(low, t.size - 1), np.maximum(high, 0)
    reach = REACH * float(np.median(np.diff(t)))
    filled = (t[a] - (centres - half_s) < reach) & (centres + half_s - t[b] < reach)
    return np.asarray((high - low + 1 >= LEAST) & filled & (piece[a] == piece[b]))


def _steady(forward: Floats) -> Mask:
    """The instants at which the magnet moves on at its median speed or nearly; ``forward`` (r,) [m/s]."""
    moving = forward > (1.0 - STEADY) * forward.max()
    return np.asarray(forward >= STEADY * float(np.median(forward[moving])), dtype=bool)


def _rows(
    passing: Pass,
    s: _Signals,
    span: tuple[float, float],
    beyond: Counter[str],
    period_ns: int,
    step: Floats,
    rules: LineRules,
) -> Pass:
    """The rows between two times; ``beyond``: why some before and after could not be made. ``step`` (j,): quantisation of the joints."""
    first, last = span
    correlation, correlation_s = _correlation(s, first, last, 1e-9 * period_ns)
    passing = replace(passing, correlation_s=correlation_s, window_ns=round(1e9 * s.half_s))
    centres = _instants(s.y_t, first + s.half_s, last - s.half_s, 2.0 * s.half_s, FORGOTTEN * correlation_s, rules)
    why = _wrong(s, centres)
    along = fit_locally(s.y_t, s.y, centres, s.half_s)
    aside = fit_locally(s.across_t, s.across, centres, s.half_s)
    joints = fit_locally(s.q_t, s.q, centres, s.half_s)
    rms = _beside(along.rms, aside.rms)
    sound = np.isfinite(rms).all(axis=1) & np.isfinite(joints.rms).all(axis=1)
    why[(why == "") & ~sound] = "gap"
    slow = passing.direction * along.rate[:, 0] < STEADY * passing.speed
    kept = (why == "") & ~slow
    if kept.any():
        limit = np.maximum(NOISY * np.median(rms[kept], axis=0), MICRON)
        why[kept & (rms > limit).any(axis=1)] = "noisy"
        kept &= why == ""
    passing = replace(passing, dropped=dict(Counter(why[why != ""].tolist()) + beyond))
    if kept.sum() < LEAST_ROWS:
        return _without_rows(passing, Counter(passing.dropped))
    noise = np.sqrt(np.mean(rms[kept] ** 2, axis=0))
    leverage = np.stack([aside.leverage, along.leverage, aside.leverage], axis=1)[kept]
    own = noise**2 * np.minimum(leverage * correlation, 1.0)
    by_time = (_beside(along.rate, aside.rate)[kept] * passing.time_sigma_s) ** 2
    return replace(
        passing,
        t_host_ns=passing.leg.start_host_ns + np.rint(1e9 * centres[kept]).astype(np.int64),
        q=joints.value[kept],
        q_rate=joints.rate[kept],
        xyz=_beside(along.value, aside.value)[kept],
        xyz_sigma=np.sqrt(own + by_time),
        noise=noise,
        q_noise=np.maximum(np.sqrt(np.mean(joints.rms[kept] ** 2, axis=0)), step / np.sqrt(12.0)),
        q_error=float(np.max(MISSED * joints.rms[kept] + 0.5 * step)),  # a joint that hardly moves stays on one step
        n_samples=int(along.n[kept].sum()),
    )


def _beside(y: Floats, xz: Floats) -> Floats:
    """What is of y (r, 1) between what is of x and z (r, 2), as the device's axes are."""
    return np.stack([xz[:, 0], y[:, 0], xz[:, 1]], axis=1)


def _instants(y_t: Floats, first: float, last: float, width: float, forgotten: float, rules: LineRules) -> Floats:
    """The interrogations (r,) at which rows are made, evenly spaced, with windows that do not overlap."""
    most = max(1, int((last - first) / width) + 1)
    n = max(1, int((last - first) / max(width, forgotten)) + 1) if rules.points is None else min(rules.points, most)
    wanted = np.linspace(first, last, n) if n > 1 else np.array([0.5 * (first + last)])
    after = np.clip(np.searchsorted(y_t, wanted), 1, y_t.size - 1)
    nearer = wanted - y_t[after - 1] < y_t[after] - wanted
    return np.unique(y_t[after - nearer])


def _correlation(s: _Signals, first: float, last: float, period_s: float) -> tuple[Floats, float]:
    """How many samples of x, y, z (3,) the noise needs to be new, and the longest of these times [s]."""
    channels = ((s.across_t, s.across[:, 0]), (s.y_t, s.y[:, 0]), (s.across_t, s.across[:, 1]))
    count, longest = np.ones(3), period_s
    for k, (t, values) in enumerate(channels):
        left, fitted = _noise(t, values, np.arange(first, last, 2.0 * STRETCH * s.half_s))
        if fitted:
            variance, noise = mean_variance(left, fitted)
            count[k] = max(1.0, variance * left.size / noise**2) if noise > 0.0 else 1.0
            longest = max(longest, count[k] * float(np.median(np.diff(t))))
    return count, longest


def _noise(t: Floats, values: Floats, starts: Floats) -> tuple[Floats, int]:
    """What a polynomial through each stretch leaves, one stretch after the other, and how many coefficients that took."""
    cuts = np.searchsorted(t, starts)
    parts = []
    for a, b in pairwise(cuts.tolist()):
        if b - a > 4 * (TREND + 1):
            u = np.linspace(-1.0, 1.0, b - a)
            parts.append(values[a:b] - legendre.legval(u, legendre.legfit(u, values[a:b], TREND)))
    return np.concatenate([np.empty(0), *parts]), (TREND + 1) * len(parts)


def _without_rows(passing: Pass, why: Counter[str]) -> Pass:
    """The pass with what mostly prevented its rows."""
    (reason, _), *_ = why.most_common(1) or [("too short", 0)]
    return replace(passing, reason=reason or "too short")
