"""Legs: where the robot moved from one stop or turn to the next, from its joint readings alone (hop 5).

A straight line there and back is two legs, whether the robot rests at the turn or not. Between two bins of readings (50 ms)
the joints take a step; a leg ends where the step is slow, by itself or beside what comes before and after within half a
second, and where it turns by more than a right angle. Legs go on over readings that are missing: what is interpolated
inside a leg keeps clear of them (``passes``). Another life of the controller is another leg.

What the box and the robot said during legs, batch by batch (hop 5): only the legs that are open are in memory.

A leg is closed when messages arrive that are later than its end by more than any link may delay. Samples and readings
come out on the host's time scale, as pieces that are whole in themselves: a piece ends where samples are missing, where the
box restarted or flagged a fault, where a reading is missing and where the robot's controller restarted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_ident import Channel
from truearm.session.box_reader import Blocks
from truearm.session.device_clock import DeviceClock
from truearm.session.dwell_samples import ChannelBlocks, columns_in, of_channels
from truearm.session.joint_batch import parse_lines
from truearm.session.joint_line import UNNUMBERED
from truearm.session.joint_readings import Bins, JointStream
from truearm.session.mcap_records import LATEST_NS
from truearm.session.message_columns import Ints, Messages
from truearm.types import Floats

SLOW = 2e-3  # rad/s or m/s; no line is driven so slowly, and a robot at rest is slower
SLOW_SHARE = 0.2  # of the fastest step before and after
HORIZON_S = 0.5
LEAST_TRAVEL = 5e-3  # rad or m of any joint
LONGEST_SILENCE_S = 2.0  # a robot unheard of for longer may have been anywhere


@dataclass(frozen=True)
class Leg:
    """One motion: times of the controller [s] and of the host, mean readings (j,) of its first and its last bin.

    ``cut``: it begins or ends where readings do, not where the robot rested or turned.
    """

    segment: int
    start_s: float
    end_s: float
    q_start: Floats
    q_end: Floats
    cut: bool
    start_host_ns: int = 0
    end_host_ns: int = 0


def find_legs(stream: JointStream) -> list[Leg]:
    """All legs in order of time."""
    bins = stream.bins
    if bins is None or len(bins.n) < 2:
        return []
    step, seconds, joined = _steps(bins)
    speed = np.max(np.abs(step), axis=1) / seconds
    moving = joined & ~_slow(speed, seconds, stream.step)
    turns = np.einsum("ij,ij->i", step[1:], step[:-1]) < 0.0  # at bin k + 1
    ends = [_ends(run, moving, joined) for run in _runs(moving, turns)]
    legs = [_leg(bins, *end) for end in ends if _travel(bins, *end[:2]) >= LEAST_TRAVEL]
    return _on_host(legs, stream)


def _steps(bins: Bins) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """From each bin to the next: change of the mean (b − 1, j), time [s], and whether it is one motion."""
    middle = 0.5 * (bins.t_first_s + bins.t_last_s)
    seconds = np.diff(middle)
    joined = (np.diff(bins.segment) == 0) & (seconds > 0.0)
    joined &= bins.t_first_s[1:] - bins.t_last_s[:-1] < LONGEST_SILENCE_S
    return np.diff(bins.mean, axis=0), np.where(joined, seconds, 1.0), joined


def _slow(speed: Floats, seconds: Floats, quantum: Floats) -> NDArray[np.bool_]:
    """The steps (b − 1,) at which a leg ends."""
    reach = max(1, round(HORIZON_S / float(np.median(seconds))))
    before, after = _highest_before(speed, reach), _highest_before(speed[::-1], reach)[::-1]
    least = SLOW + np.max(quantum, initial=0.0) / seconds
    return np.asarray((speed <= least) | (speed <= SLOW_SHARE * np.minimum(before, after)))


def _highest_before(speed: Floats, reach: int) -> Floats:
    """The highest of each step and the ``reach`` before it."""
    highest = speed.copy()
    for k in range(1, min(reach, speed.size - 1) + 1):
        np.maximum(highest[k:], speed[:-k], out=highest[k:])
    return highest


def _runs(moving: NDArray[np.bool_], turns: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last step of each run of moving ones, cut at turns."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moving, [False]]).astype(np.int8)))
    runs = []
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        cuts = [first, *(np.flatnonzero(turns[first : end - 1]) + first + 1).tolist(), end]
        runs += [(a, b - 1) for a, b in pairwise(cuts)]
    return runs


def _ends(run: tuple[int, int], moving: NDArray[np.bool_], joined: NDArray[np.bool_]) -> tuple[int, int, bool]:
    """First and last bin of these steps, with the slow one before and after them: there the robot was at its ends.

    And whether the readings begin or end there.
    """
    first, last = run
    begins, ends = first > 0 and bool(joined[first - 1]), last + 1 < joined.size and bool(joined[last + 1])
    a = first - int(begins and not moving[first - 1])
    b = last + 1 + int(ends and not moving[last + 1])
    return a, b, not (begins and ends)


def _travel(bins: Bins, a: int, b: int) -> float:
    return float(np.max(np.abs(bins.mean[b] - bins.mean[a])))


def _leg(bins: Bins, a: int, b: int, cut: bool) -> Leg:
    start, end = float(bins.t_first_s[a]), float(bins.t_last_s[b])
    return Leg(int(bins.segment[a]), start, end, bins.mean[a], bins.mean[b], cut)


def _on_host(legs: list[Leg], stream: JointStream) -> list[Leg]:
    """The legs with the host's times."""
    times = np.array([(leg.start_s, leg.end_s) for leg in legs]).reshape(-1, 2)
    segment = np.array([leg.segment for leg in legs])
    host = np.empty(times.shape, np.int64)
    for k in np.unique(segment):
        mine = segment == k
        host[mine] = stream.clocks[int(k)].to_host_ns(times[mine].ravel()).reshape(-1, 2)
    return [
        replace(leg, start_host_ns=start, end_host_ns=end)
        for leg, (start, end) in zip(legs, host.tolist(), strict=True)
    ]


LATE_NS = 10_000_000_000  # a message is older than its arrival by less
EARLY_NS = 1_000_000_000  # and younger by less: what clocks may disagree
LOST = 1.6  # periods of the robot from one reading to the next: one is missing


class Samples(NamedTuple):
    """Of one stream, in order: host time [ns] (n,), counts (n, c) of the wanted channels, number of the whole piece (n,)."""

    t_ns: Ints
    counts: NDArray[np.int32]
    piece: Ints
    channels: tuple[Channel, ...]
    period_ns: int
    bound_ns: float  # of the times' errors


class Readings(NamedTuple):
    """Of the robot, in order: host time [ns] (n,), joints (n, j), number of the whole piece (n,)."""

    t_ns: Ints
    q: Floats
    piece: Ints


class _Piece(NamedTuple):
    """Blocks of a wanted stream; ``whole`` (b,): a block goes on where the one before ended."""

    blocks: ChannelBlocks
    whole: NDArray[np.bool_]


@dataclass(eq=False)
class LegSamples:
    """What is heard during one leg; ``index`` is the caller's."""

    index: int
    leg: Leg
    pieces: dict[int, list[_Piece]] = field(default_factory=dict)  # by wanted stream
    readings: list[tuple[Floats, Ints, Floats]] = field(default_factory=list)


class Listener:
    """Takes the box's blocks and the robot's lines in log order; each answer is the legs that are over by then."""

    def __init__(self, legs: Sequence[tuple[int, Leg]], wanted: Sequence[tuple[str, ...]], joints: JointStream) -> None:
        """``legs``: index and leg, by ascending start; ``wanted``: names of channels, a tuple for each stream."""
        self._waiting = deque(LegSamples(index, leg) for index, leg in legs)
        self._open: list[LegSamples] = []
        self._wanted, self._joints = wanted, joints
        self._segment_from = np.array([clock.host_ref_ns for clock in joints.clocks], dtype=np.int64)
        self._goes_on: dict[int, bool] = {}  # wanted stream → nothing is wrong with its last block
        self._now_ns = -LATEST_NS

    def take(self, messages: Messages, blocks: Sequence[Blocks]) -> list[LegSamples]:
        """Take a batch of messages and the blocks that came out with them."""
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
        """The legs that were still open at the session's end, or had not begun."""
        over = [*self._open, *self._waiting]
        self._open, self._waiting = [], deque()
        return over

    def _wanted_of(self, blocks: Blocks) -> Iterator[tuple[int, _Piece]]:
        """The blocks for each wanted stream that they are of."""
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
        """Keep the readings of the leg's own segment and time."""
        said = parse_lines(messages.payloads(rows), messages.t_host_ns[rows], len(self._joints.step))
        if len(said):
            segment = np.searchsorted(self._segment_from, said.arrival_ns, side="right") - 1
            mine = (segment == heard.leg.segment) & (said.t >= heard.leg.start_s) & (said.t <= heard.leg.end_s)
            heard.readings.append((said.t[mine], said.seq[mine], said.q[mine]))


def samples_of(heard: LegSamples, k: int, clocks: Mapping[int, DeviceClock]) -> Samples | None:
    """What a wanted stream showed during the leg; None if nothing that a clock places in time."""
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
    # Two lives of the box have two clocks, whose times may overlap by their errors.
    order = np.flatnonzero(inside)[np.argsort(times[inside], kind="stable")]
    last = pieces[-1].blocks
    period = int(last.period_ns[-1]) or last.stream.period_ns
    return Samples(times[order], counts[order], number[order], last.channels, period, bound_ns)


def readings_of(heard: LegSamples, joints: JointStream) -> Readings:
    """The robot's readings by their time; one that came late stands where it belongs, one that came twice once."""
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
    """Which place each of several keys (n,) has in order; equal ones keep theirs."""
    ranks = np.empty(len(keys), np.intp)
    ranks[np.argsort(keys, kind="stable")] = np.arange(len(keys))
    return ranks
