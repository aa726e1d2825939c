"""What the box and the robot said during legs, message by message (hop 5): only the legs that are open are in memory.

A leg is closed when messages arrive that are later than its end by more than any link may delay. Samples and readings
come out on the host's time scale, as pieces that are whole in themselves: a piece ends where samples are missing, where the
box restarted or flagged a fault, where a reading is missing and where the robot's controller restarted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_ident import Channel, Ident, Stream, find_channel
from truearm.session.device_clock import DeviceClock
from truearm.session.joint_batch import parse_lines
from truearm.session.joint_line import UNNUMBERED
from truearm.session.joint_readings import CHUNK, JointStream
from truearm.session.legs import Leg
from truearm.session.sample_blocks import Block
from truearm.types import Floats, Message
from truearm_wire import messages as wire

Ints = NDArray[np.int64]
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
    """A block of a wanted stream; ``whole``: it goes on where the one before ended."""

    block: Block
    whole: bool
    stream: Stream
    columns: tuple[int, ...]


@dataclass(eq=False)
class LegSamples:
    """What is heard during one leg; ``index`` is the caller's."""

    index: int
    leg: Leg
    pieces: dict[int, list[_Piece]] = field(default_factory=dict)  # by wanted stream
    lines: list[bytes] = field(default_factory=list)
    arrival_ns: list[int] = field(default_factory=list)
    readings: list[tuple[Floats, Ints, Floats]] = field(default_factory=list)


class Listener:
    """Takes the box's blocks and the robot's lines in log order; each answer is the legs that are over by then."""

    def __init__(self, legs: Sequence[tuple[int, Leg]], wanted: Sequence[tuple[str, ...]], joints: JointStream) -> None:
        """``legs``: index and leg, by ascending start; ``wanted``: names of channels, a tuple for each stream."""
        self._waiting = deque(LegSamples(index, leg) for index, leg in legs)
        self._open: list[LegSamples] = []
        self._wanted, self._joints = wanted, joints
        self._segment_from = np.array([clock.host_ref_ns for clock in joints.clocks], dtype=np.int64)
        self._places: tuple[Ident | None, list[tuple[Stream, tuple[int, ...]] | None]] = (None, [])
        self._follows: dict[int, tuple[int, int]] = {}  # wanted stream → segment and run of its last block

    def line(self, message: Message) -> list[LegSamples]:
        """Take a line of the robot."""
        over = self._advance(message.t_host_ns)
        for heard in self._open:
            heard.lines.append(message.data)
            heard.arrival_ns.append(message.t_host_ns)
            if len(heard.lines) >= CHUNK:
                self._parse(heard)
        return over

    def block(self, block: Block, ident: Ident) -> list[LegSamples]:
        """Take a block of samples of any stream."""
        over = self._advance(block.t_host_ns)
        if self._places[0] is not ident:
            self._places = ident, [_places(ident, names) for names in self._wanted]
        for k, place in enumerate(self._places[1]):
            if place is not None and place[0].id == block.data.stream:
                self._keep(k, block, *place)
        return over

    def rest(self) -> list[LegSamples]:
        """The legs that were still open at the session's end, or had not begun."""
        over = [*self._open, *self._waiting]
        for heard in over:
            self._parse(heard)
        self._open, self._waiting = [], deque()
        return over

    def _advance(self, now_ns: int) -> list[LegSamples]:
        while self._waiting and self._waiting[0].leg.start_host_ns < now_ns + EARLY_NS:
            self._open.append(self._waiting.popleft())
        over = [heard for heard in self._open if heard.leg.end_host_ns + LATE_NS < now_ns]
        if over:
            self._open = [heard for heard in self._open if heard not in over]
        for heard in over:
            self._parse(heard)
        return over

    def _keep(self, k: int, block: Block, stream: Stream, columns: tuple[int, ...]) -> None:
        whole = not block.gap and self._follows.get(k) == (block.segment, block.run)
        if block.data.flags & wire.FLAG_CONVERTER:
            self._follows.pop(k, None)
            return
        self._follows[k] = block.segment, block.run
        for heard in self._open:
            heard.pieces.setdefault(k, []).append(_Piece(block, whole, stream, columns))

    def _parse(self, heard: LegSamples) -> None:
        """Keep the readings of the leg's own segment and time."""
        said = parse_lines(heard.lines, heard.arrival_ns, len(self._joints.step))
        heard.lines, heard.arrival_ns = [], []
        if len(said):
            segment = np.searchsorted(self._segment_from, said.arrival_ns, side="right") - 1
            mine = (segment == heard.leg.segment) & (said.t >= heard.leg.start_s) & (said.t <= heard.leg.end_s)
            heard.readings.append((said.t[mine], said.seq[mine], said.q[mine]))


def samples_of(heard: LegSamples, k: int, clocks: Mapping[int, DeviceClock]) -> Samples | None:
    """What a wanted stream showed during the leg; None if nothing that a clock places in time."""
    pieces = [piece for piece in heard.pieces.get(k, []) if piece.block.segment in clocks]
    if not pieces:
        return None
    times, bound_ns = _times(pieces, clocks)
    broken = np.cumsum([not piece.whole for piece in pieces])
    number = np.repeat(broken, [piece.block.n for piece in pieces])
    counts = np.concatenate([piece.block.counts[:, piece.columns] for piece in pieces])
    inside = (times >= heard.leg.start_host_ns) & (times <= heard.leg.end_host_ns)
    if not inside.any():
        return None
    # Two lives of the box have two clocks, whose times may overlap by their errors.
    order = np.flatnonzero(inside)[np.argsort(times[inside], kind="stable")]
    last = pieces[-1]
    channels = tuple(last.stream.channels[column] for column in last.columns)
    period = last.block.data.period_ns or last.stream.period_ns
    return Samples(times[order], counts[order], number[order], channels, period, bound_ns)


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


def _places(ident: Ident, names: tuple[str, ...]) -> tuple[Stream, tuple[int, ...]] | None:
    """The stream that has these channels, and their columns; None where no single stream has them all."""
    found = [find_channel(ident, name) for name in names]
    known = [place for place in found if place is not None]
    if len(known) < len(names) or len({stream.id for stream, _ in known}) != 1:
        return None
    return known[0][0], tuple(column for _, column in known)


def _times(pieces: list[_Piece], clocks: Mapping[int, DeviceClock]) -> tuple[Ints, float]:
    """Host times [ns] of what all samples show, and the largest bound of their error."""
    host, bounds = np.empty(len(pieces), np.int64), np.empty(len(pieces))
    segment = np.array([piece.block.segment for piece in pieces])
    t0_us = np.array([piece.block.data.t0_us for piece in pieces], dtype=np.int64)
    for index in np.unique(segment):
        host[segment == index], bounds[segment == index] = clocks[int(index)].to_host_ns(t0_us[segment == index])
    host -= [piece.stream.group_delay_ns for piece in pieces]
    within = [_within(piece.block) for piece in pieces]
    return np.repeat(host, [len(times) for times in within]) + np.concatenate(within), float(bounds.max())


def _within(block: Block) -> Ints:
    """Time [ns] of each sample since the block's first."""
    if block.data.period_ns:
        return np.arange(block.n) * np.int64(block.data.period_ns)
    return 1000 * np.frombuffer(block.data.offsets_us, "<u2").astype(np.int64)
