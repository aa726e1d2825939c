"""Measure passes along a line device in motion: assign legs to lines and compute their rows.

Three signals are combined. The magnetostrictive head gives the position of the magnet along the device (its y) at the
edge of each interrogation. Two transducers give the transverse position (x and z), in samples that are late by their
group delay. The robot gives its joints. Each row is at the instant of an interrogation. There, all three signals are
evaluated by cubics fitted over the same time before and after (``fit_locally()``), long enough for seven joint readings
and at least a tenth of a second. A row is made only where that window is complete: no missing sample or reading, no
restart of a clock, no extrapolation.

Rows are taken where the magnet moves steadily, at nine tenths of its median speed or more, because how fast a robot
starts and stops is not a matter of kinematics. They are as close together as possible without overlapping windows or
correlated device noise. The correlation is judged by the integrated correlation time of the residuals of a polynomial
through eight windows.

The noise stated for a row is the noise of the readings, averaged as by the fit, plus the speed times the error of the
clocks. The uncertainty that the rig declares for the device is added where the row is used.

The clock errors are treated as independent between rows, though all rows in one life of box and controller share them.
Measured in the simulator, the error differs by ± 4 µs from pass to pass where the bounds are 230 to 250 µs. This does
no harm. A common error adds to τ: σ(τ) describes τ as seen by the lines, and as the robot's delay it may be wrong by
the bounds. An error that differs between the lives of a session, or even from pass to pass by the full bound, moves
each line up and down in turn, unlike any robot parameter. It increases the variance of any combination of the robot's
parameters by a factor of at most 1.0001 over the stated one (four lines there and back at 100 mm/s, 0.14 ms, device
poses unknown; 1.01 with poses known to 0.1 mm). It would matter for devices with exactly known poses: a factor of 1.7
with an error per pass, 2.4 if driven one way in two lives of the clocks, 3.9 if τ is also declared known.

**Collecting data during legs** (``Listener``) works batch by batch, so only open legs are in memory. A leg is closed
when messages arrive that are later than its end by more than any link may delay them. Samples and readings are given on
the host's time scale, in gap-free pieces. A piece ends where samples or a reading are missing, where the box restarted
or flagged a fault, and where the robot's controller restarted.

**Cubics** (``fit_locally()``) give values and rates of a moving signal at chosen instants. A polynomial of third degree
is fitted by least squares over the window t − w … t + w, and its value and slope at t are used. This interpolates and
averages in one step: with n samples of white noise σ the value has the variance (9/4) σ²/n.

**Truncation error.** Beyond a cubic, the signal's next term is of fourth degree, c·P₄(u), where P₄ is Legendre's
polynomial and u = −1 … 1 over the window. It causes an error of (3/8)·c at the middle and residuals with an RMS of c/3.
The error at the middle is therefore 9/8 of the RMS of the residuals, or less if these are partly noise. The same fit
has the same error in two signals that move together, such as a device's reading and the joints that drive it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from truearm.session.box_ident import Channel
from truearm.session.box_reader import Blocks
from truearm.session.device_clock import DeviceClock
from truearm.session.joint_format import UNNUMBERED, parse_lines
from truearm.session.joint_readings import JointStream
from truearm.session.line_legs import Leg
from truearm.session.message_columns import LATEST_NS, Ints, Messages
from truearm.session.sample_noise import mean_variance
from truearm.session.samples import ChannelBlocks, columns_in, extension, of_channels, railed
from truearm.types import Floats, rms_of_columns

# ----------------------------------------------------------------------------------------------------- data during legs

LATE_NS = 10_000_000_000  # a message is older than its arrival by less than this
EARLY_NS = 1_000_000_000  # and younger by less than this: possible disagreement of clocks
LOST = 1.6  # in robot periods: a larger step between readings means that one is missing


class Samples(NamedTuple):
    """Samples of one stream in order: host time [ns] (n,), counts (n, c) of the wanted channels, index of the piece
    (n,).
    """

    t_ns: Ints
    counts: NDArray[np.int32]
    piece: Ints
    channels: tuple[Channel, ...]
    period_ns: int
    bound_ns: float  # bound of the error of the times


class Readings(NamedTuple):
    """Readings of the robot in order: host time [ns] (n,), joints (n, j), index of the piece (n,)."""

    t_ns: Ints
    q: Floats
    piece: Ints


class _Piece(NamedTuple):
    """Blocks of a wanted stream; ``whole`` (b,): the block continues the previous one without a gap."""

    blocks: ChannelBlocks
    whole: NDArray[np.bool_]


@dataclass(eq=False)
class LegSamples:
    """Data received during one leg; ``index`` belongs to the caller."""

    index: int
    leg: Leg
    pieces: dict[int, list[_Piece]] = field(default_factory=dict)  # by wanted stream
    readings: list[tuple[Floats, Ints, Floats]] = field(default_factory=list)


class Listener:
    """Processes the box's blocks and the robot's lines in log order; each call returns the legs completed so far."""

    def __init__(self, legs: Sequence[tuple[int, Leg]], wanted: Sequence[tuple[str, ...]], joints: JointStream) -> None:
        """``legs``: index and leg, by ascending start. ``wanted``: names of channels, one tuple per stream."""
        self._waiting = deque(LegSamples(index, leg) for index, leg in legs)
        self._open: list[LegSamples] = []
        self._wanted, self._joints = wanted, joints
        self._segment_from = np.array([clock.host_ref_ns for clock in joints.clocks], dtype=np.int64)
        self._goes_on: dict[int, bool] = {}  # wanted stream → the last block is free of faults
        self._now_ns = -LATEST_NS

    def take(self, messages: Messages, blocks: Sequence[Blocks]) -> list[LegSamples]:
        """Process a batch of messages and the blocks released with it."""
        lines = messages.rows(lambda topic: topic == "/robot/joints")
        of = (lines, *(one.at for one in blocks))
        turn = _ranks(np.concatenate(of))
        arrival = np.concatenate([messages.t_host_ns[lines], *(one.t_host_ns for one in blocks)])
        now = np.empty_like(arrival)
        now[turn] = arrival
        now = np.maximum.accumulate(np.concatenate([[self._now_ns], now]))
        self._now_ns, now = int(now[-1]), now[1:]
        line_turn, *block_turns = np.split(turn, np.cumsum([len(part) for part in of])[:-1])
        pieces = [
            (k, piece, turns)
            for one, turns in zip(blocks, block_turns, strict=True)
            for k, piece in self._wanted_of(one)
        ]
        begins = dict.fromkeys(self._open, 0)
        while self._waiting and self._waiting[0].leg.start_host_ns < self._now_ns + EARLY_NS:
            heard = self._waiting.popleft()
            begins[heard] = int(np.searchsorted(now, heard.leg.start_host_ns - EARLY_NS, side="right"))
        over: list[LegSamples] = []
        self._open = []
        for heard, begin in begins.items():
            end = int(np.searchsorted(now, heard.leg.end_host_ns + LATE_NS, side="right"))
            self._parse(heard, messages, lines[(line_turn >= begin) & (line_turn < end)])
            for k, piece, turns in pieces:
                during = (turns >= begin) & (turns < end) & ~piece.blocks.fault
                if during.any():
                    heard.pieces.setdefault(k, []).append(_Piece(piece.blocks.some(during), piece.whole[during]))
            (over if end < len(now) else self._open).append(heard)
        return over

    def rest(self) -> list[LegSamples]:
        """Return the legs that are still open at the end of the session or have not begun."""
        over = [*self._open, *self._waiting]
        self._open, self._waiting = [], deque()
        return over

    def _wanted_of(self, blocks: Blocks) -> Iterator[tuple[int, _Piece]]:
        """Return the blocks for each wanted stream."""
        for k, names in enumerate(self._wanted):
            place = columns_in(blocks.ident, names)
            if place is None or place[0].id != blocks.stream.id or not len(blocks):
                continue
            piece = of_channels(blocks, place[1])
            well = ~piece.fault
            before = np.concatenate([[self._goes_on.get(k, False)], well[:-1]])
            self._goes_on[k] = bool(well[-1])
            yield k, _Piece(piece, before & ~piece.gap)

    def _parse(self, heard: LegSamples, messages: Messages, rows: NDArray[np.intp]) -> None:
        """Keep the readings within the leg's own segment and time."""
        said = parse_lines(messages.payloads(rows), messages.t_host_ns[rows], len(self._joints.step))
        if len(said):
            segment = np.searchsorted(self._segment_from, said.arrival_ns, side="right") - 1
            mine = (segment == heard.leg.segment) & (said.t >= heard.leg.start_s) & (said.t <= heard.leg.end_s)
            heard.readings.append((said.t[mine], said.seq[mine], said.q[mine]))


def samples_of(heard: LegSamples, k: int, clocks: Mapping[int, DeviceClock]) -> Samples | None:
    """Return the samples of a wanted stream during the leg; None if no clock places any of them in time."""
    pieces = [piece for piece in heard.pieces.get(k, []) if piece.blocks.segment in clocks]
    if not pieces:
        return None
    placed = [piece.blocks.times(clocks[piece.blocks.segment]) for piece in pieces]
    times = np.concatenate([t_ns for t_ns, _ in placed])
    bound_ns = max(float(np.max(bounds)) for _, bounds in placed)
    broken = np.cumsum(~np.concatenate([piece.whole for piece in pieces]))
    number = np.repeat(broken, np.concatenate([piece.blocks.n for piece in pieces]))
    counts = np.concatenate([piece.blocks.counts for piece in pieces])
    inside = (times >= heard.leg.start_host_ns) & (times <= heard.leg.end_host_ns)
    if not inside.any():
        return None
    # Two lives of the box have two clocks; their times may overlap by the clocks' errors.
    order = np.flatnonzero(inside)[np.argsort(times[inside], kind="stable")]
    last = pieces[-1].blocks
    period = int(last.period_ns[-1]) or last.stream.period_ns
    return Samples(times[order], counts[order], number[order], last.channels, period, bound_ns)


def readings_of(heard: LegSamples, joints: JointStream) -> Readings:
    """Return the robot's readings by time: late ones in their place, duplicates once."""
    if not heard.readings:
        return Readings(np.empty(0, np.int64), np.empty((0, len(joints.step))), np.empty(0, np.int64))
    t, seq, q = (np.concatenate(column) for column in zip(*heard.readings, strict=True))
    t, first = np.unique(t, return_index=True)
    seq, q = seq[first], q[first]
    apart = np.diff(t)
    broken = apart > LOST * float(np.median(apart)) if apart.size else np.zeros(0, dtype=bool)
    numbered = (seq[1:] != UNNUMBERED) & (seq[:-1] != UNNUMBERED)
    broken = broken | (numbered & (np.diff(seq) != 1))
    piece = np.concatenate([[0], np.cumsum(broken)]) if t.size else np.empty(0, np.int64)
    return Readings(joints.clocks[heard.leg.segment].to_host_ns(t), q, piece)


def _ranks(keys: Ints) -> NDArray[np.intp]:
    """Return the rank of each of several keys (n,); equal keys keep their order."""
    ranks = np.empty(len(keys), np.intp)
    ranks[np.argsort(keys, kind="stable")] = np.arange(len(keys))
    return ranks


# --------------------------------------------------------------------------------------------------------------- cubics

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
    """Fit cubics around ``centres`` (r,) [s] to samples ``values`` (n, c) at ascending ``t`` (n,) [s], with w =
    ``half_s``.

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
        left = values[window] - q @ of_samples
        out.rms[k] = np.sqrt(np.sum(left**2, axis=0) / (u.size - DEGREE - 1))
        out.leverage[k] = float(inverse[0] @ inverse[0])
    return out


Mask = NDArray[np.bool_]

ALONG, ACROSS = ("magnetostrictive",), ("transverse_a", "transverse_b")  # channels of the device's y; x and z
# --------------------------------------------------------------------------------------------------------------- passes

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
READINGS = 7.0  # width of a window in periods of the robot's readings
LEAST_WINDOW_S = 0.1
LONGEST_S = 300.0
LEAST_TRAVEL = 0.01  # least travel [m] of the magnet along the device in a pass
LEAST_ROWS = 5
STEADY = 0.9  # of the median speed
REACH = 1.2  # periods from a window's end to its first sample; one more would mean a missing sample
STOPPED = 0.8  # share of a window's interrogations that must have a stop pulse
NOISY = 5.0  # multiple of the median residual of the pass
MICRON = 1e-6
STRETCH = 8  # windows; over this length a polynomial of degree TREND is the motion, and its residual is noise
TREND = 8
FORGOTTEN = 2.0  # integrated correlation times after which noise is independent


@dataclass(frozen=True)
class LineRules:
    """Rules for passes.

    ``points``: maximum number of rows per pass; None: as many as the noise allows. ``pose_tolerance`` in rad (or m).
    ``reach`` [m]: range within which the transducers are valid.
    """

    points: int | None = None
    pose_tolerance: float = np.pi / 180.0
    reach: float = np.inf


@dataclass(frozen=True)
class Pass:
    """One motion along a line and its outcome; ``reason`` is "" if it gave rows, else one of REASONS.

    ``direction`` is +1 where y rises. The r rows hold instants on the host's clock, joints and their rates, the
    device's reading and the standard deviations of its own noise and of its time, excluding the uncertainty declared by
    the rig. ``noise`` (3,) [m] and ``q_noise`` (j,) are standard deviations of single readings about the motion.
    ``q_error`` [rad or m] bounds the error of the interpolated joints. ``dropped``: rows that could not be made, by
    reason.
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
        """The group that the rows of this direction belong to, for ``--hold-out shell=``."""
        return f"{self.mounted['line']}-{'up' if self.direction > 0 else 'down'}"


@dataclass(frozen=True)
class _Signals:
    """Signals during a leg, in seconds since its start: times, values and gap-free pieces."""

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
    """Return the pass with its rows or with the reason why it has none; None if nothing moved along the device.

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
    first, last = np.flatnonzero(steady)[[0, -1]]  # windows stay within these: the ramps are excluded
    span = float(grid[first]), float(grid[last])
    with np.errstate(invalid="ignore"):
        lost = (why != "") & (coarse.rate[:, 0] * direction >= STEADY * passing.speed)
    lost[first : last + 1] = False  # rows in between are counted one by one
    beyond = Counter(why[lost][::2].tolist())  # a row is as wide as two steps of the grid
    return _rows(passing, signals, span, beyond, along.period_ns, joints.step, rules)


def _time_sigma(bound_ns: float, leg: Leg, joints: JointStream) -> float:
    """Return the standard deviation [s] of a row's time, without the constant part, which the time offset τ absorbs.

    Within their bounds, nothing is known about the clock errors of box and robot, so they are taken as uniform.
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
    """Return why no row can be made at each instant (r,); "" where one can."""
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
    """Return where the window is filled from end to end by a single gap-free piece."""
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
    passing: Pass,
    s: _Signals,
    span: tuple[float, float],
    beyond: Counter[str],
    period_ns: int,
    step: Floats,
    rules: LineRules,
) -> Pass:
    """Return the rows between two times.

    ``beyond``: why some rows before and after could not be made. ``step`` (j,): quantisation of the joints.
    """
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
    noise = rms_of_columns(rms[kept])
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
        q_noise=np.maximum(rms_of_columns(joints.rms[kept]), step / np.sqrt(12.0)),
        q_error=float(np.max(MISSED * joints.rms[kept] + 0.5 * step)),  # a joint that hardly moves stays on one step
        n_samples=int(along.n[kept].sum()),
    )


def _beside(y: Floats, xz: Floats) -> Floats:
    """Return y (r, 1) between x and z (r, 2), in the order of the device's axes."""
    return np.stack([xz[:, 0], y[:, 0], xz[:, 1]], axis=1)


def _instants(y_t: Floats, first: float, last: float, width: float, forgotten: float, rules: LineRules) -> Floats:
    """Return the interrogations (r,) at which rows are made, evenly spaced and with windows that do not overlap."""
    most = max(1, int((last - first) / width) + 1)
    n = max(1, int((last - first) / max(width, forgotten)) + 1) if rules.points is None else min(rules.points, most)
    wanted = np.linspace(first, last, n) if n > 1 else np.array([0.5 * (first + last)])
    after = np.clip(np.searchsorted(y_t, wanted), 1, y_t.size - 1)
    nearer = wanted - y_t[after - 1] < y_t[after] - wanted
    return np.unique(y_t[after - nearer])


def _correlation(s: _Signals, first: float, last: float, period_s: float) -> tuple[Floats, float]:
    """Return how many samples of x, y, z (3,) it takes for the noise to be independent, and the longest of these times
    [s].
    """
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
    """Return the residuals of a polynomial through each stretch, concatenated, and the number of coefficients used."""
    cuts = np.searchsorted(t, starts)
    parts = []
    for a, b in pairwise(cuts.tolist()):
        if b - a > 4 * (TREND + 1):
            u = np.linspace(-1.0, 1.0, b - a)
            parts.append(values[a:b] - legendre.legval(u, legendre.legfit(u, values[a:b], TREND)))
    return np.concatenate([np.empty(0), *parts]), (TREND + 1) * len(parts)


def _without_rows(passing: Pass, why: Counter[str]) -> Pass:
    """Return the pass with the most frequent reason for its missing rows."""
    (reason, _), *_ = why.most_common(1) or [("too short", 0)]
    return replace(passing, reason=reason or "too short")
