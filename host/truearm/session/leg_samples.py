"""Collect the samples and joint readings of each leg of a session.

``LegListener`` works batch by batch, so only open legs are in memory. A leg is closed when messages arrive that are
later than its end by more than any link may delay them. Samples and readings are given on the host's time scale, in
gap-free pieces. A piece ends where samples or a reading are missing, where the box restarted or flagged a fault, and
where the robot's controller restarted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_ident import Channel
from truearm.session.device_clock import DeviceClock
from truearm.session.joint_format import UNNUMBERED, JointBatch
from truearm.session.joint_readings import JointStream, joint_batch
from truearm.session.line_legs import Leg
from truearm.session.message_columns import LATEST_NS, Messages
from truearm.session.samples import ChannelBlocks, columns_in, of_channels
from truearm.session.streams import Blocks
from truearm.types import Floats, Ints

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


class LegReadings(NamedTuple):
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


class LegListener:
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
        readings, _ = joint_batch(messages, len(self._joints.step))
        arrival_ns = readings.arrival_ns
        pieces = [wanted for some in blocks for wanted in self._wanted_of(some)]
        self._now_ns = max([self._now_ns, *arrival_ns[-1:].tolist(), *(int(ns[-1]) for _, _, ns in pieces)])
        while self._waiting and self._waiting[0].leg.start_host_ns < self._now_ns + EARLY_NS:
            self._open.append(self._waiting.popleft())
        for heard in self._open:
            begin_ns, end_ns = heard.leg.start_host_ns - EARLY_NS, heard.leg.end_host_ns + LATE_NS
            self._add(heard, readings[(arrival_ns > begin_ns) & (arrival_ns <= end_ns)])
            for k, piece, block_ns in pieces:
                during = (block_ns > begin_ns) & (block_ns <= end_ns) & ~piece.blocks.fault
                if during.any():
                    heard.pieces.setdefault(k, []).append(_Piece(piece.blocks.some(during), piece.whole[during]))
        over = [heard for heard in self._open if heard.leg.end_host_ns + LATE_NS < self._now_ns]
        self._open = [heard for heard in self._open if heard not in over]
        return over

    def rest(self) -> list[LegSamples]:
        """Return the legs that are still open at the end of the session or have not begun."""
        over = [*self._open, *self._waiting]
        self._open, self._waiting = [], deque()
        return over

    def _wanted_of(self, blocks: Blocks) -> Iterator[tuple[int, _Piece, Ints]]:
        """Return the blocks for each wanted stream, and their arrivals [ns]."""
        for k, names in enumerate(self._wanted):
            place = columns_in(blocks.ident, names)
            if place is None or place[0].id != blocks.stream.id or not len(blocks):
                continue
            piece = of_channels(blocks, place[1])
            well = ~piece.fault
            before = np.concatenate([[self._goes_on.get(k, False)], well[:-1]])
            self._goes_on[k] = bool(well[-1])
            yield k, _Piece(piece, before & ~piece.gap), blocks.frames["t_host_ns"]

    def _add(self, heard: LegSamples, said: JointBatch) -> None:
        """Keep the readings within the leg's own segment and time."""
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


def readings_of(heard: LegSamples, joints: JointStream) -> LegReadings:
    """Return the robot's readings by time: late ones in their place, duplicates once."""
    if not heard.readings:
        return LegReadings(np.empty(0, np.int64), np.empty((0, len(joints.step))), np.empty(0, np.int64))
    t, seq, q = (np.concatenate(column) for column in zip(*heard.readings, strict=True))
    t, first = np.unique(t, return_index=True)
    seq, q = seq[first], q[first]
    apart = np.diff(t)
    broken = apart > LOST * float(np.median(apart)) if apart.size else np.zeros(0, dtype=bool)
    numbered = (seq[1:] != UNNUMBERED) & (seq[:-1] != UNNUMBERED)
    broken = broken | (numbered & (np.diff(seq) != 1))
    piece = np.concatenate([[0], np.cumsum(broken)]) if t.size else np.empty(0, np.int64)
    return LegReadings(joints.clocks[heard.leg.segment].to_host_ns(t), q, piece)
