"""Samples of the wanted channels, and those that fall into dwells (hop 5): no sample across a gap."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import SessionError
from truearm.session.box_ident import Channel, Ident, Stream, find_channel
from truearm.session.box_reader import Blocks
from truearm.session.device_clock import DeviceClock
from truearm.session.message_columns import Ints
from truearm_wire import messages as wire

MOST_KEPT_BYTES = 64 << 20  # an hour and a half at 2 kHz; of more a session is read again


@dataclass(frozen=True, eq=False)
class ChannelBlocks:
    """Blocks (b,) of samples of some channels of one stream, all of one segment and ident.

    ``counts`` (Σ n, c); ``fault``: the converter's; ``gap``: samples before the block are missing; ``within_ns`` (Σ n,): how long after its
    block's first sample each was taken, None where the periods say it.
    """

    segment: int
    stream: Stream
    columns: tuple[int, ...]
    period_ns: NDArray[np.uint32]
    n: NDArray[np.int32]
    t0_us: Ints
    gap: NDArray[np.bool_]
    fault: NDArray[np.bool_]
    counts: NDArray[np.int32]
    within_ns: Ints | None

    def __len__(self) -> int:
        return len(self.n)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What the columns of ``counts`` are."""
        return tuple(self.stream.channels[column] for column in self.columns)

    def times(self, clock: DeviceClock) -> tuple[Ints, NDArray[np.float64]]:
        """Host time [ns] at which the signal had each sample's value, and the bound of each block's."""
        host, bounds = clock.to_host_ns(self.t0_us)
        within = self.within_ns
        if within is None:
            within = (np.arange(len(self.counts)) - np.repeat(self.first, self.n)) * np.repeat(self.period_ns, self.n)
        return np.repeat(host, self.n) + within - self.stream.group_delay_ns, bounds

    @property
    def first(self) -> Ints:
        """Where in ``counts`` each block begins."""
        return np.asarray(np.cumsum(self.n, dtype=np.int64) - self.n)

    def some(self, blocks: NDArray[np.bool_]) -> ChannelBlocks:
        """Some (b,) of the blocks."""
        samples = np.repeat(blocks, self.n)
        return replace(
            self,
            period_ns=self.period_ns[blocks],
            n=self.n[blocks],
            t0_us=self.t0_us[blocks],
            gap=self.gap[blocks],
            fault=self.fault[blocks],
            counts=self.counts[samples],
            within_ns=None if self.within_ns is None else self.within_ns[samples],
        )


def columns_in(ident: Ident, names: Sequence[str]) -> tuple[Stream, tuple[int, ...]] | None:
    """The stream that has these channels, and their columns; None where no single stream has them all."""
    found = [find_channel(ident, name) for name in names]
    known = [place for place in found if place is not None]
    if len(known) < len(names) or len({stream.id for stream, _ in known}) != 1:
        return None
    return known[0][0], tuple(column for _, column in known)


def of_channels(blocks: Blocks, columns: tuple[int, ...]) -> ChannelBlocks:
    """The same blocks with some channels alone."""
    return ChannelBlocks(
        segment=blocks.segment,
        stream=blocks.stream,
        columns=columns,
        period_ns=blocks.period_ns.astype(np.uint32),
        n=blocks.n.astype(np.int32),
        t0_us=blocks.t0_us,
        gap=blocks.gap,
        fault=(blocks.flags & wire.FLAG_CONVERTER) != 0,
        counts=blocks.counts()[:, columns],
        within_ns=blocks.within_ns() if blocks.offsets_us else None,
    )


class ChannelSamples:
    """The samples of one channel: kept while a session is read for the first time, if they are not too many, else read again."""

    def __init__(self, channel: str, again: Callable[[], Iterator[Blocks]], limit_bytes: int = MOST_KEPT_BYTES) -> None:
        """``again``: all blocks of the session once more."""
        self._channel, self._again, self._left = channel, again, limit_bytes
        self._kept: list[ChannelBlocks] = []
        self._lacking: Ident | None = None

    def keep(self, blocks: Iterable[Blocks]) -> None:
        """Take what is of the channel among blocks of the first reading."""
        for one in blocks:
            place = columns_in(one.ident, [self._channel])
            if place is None:
                self._lacking = self._lacking or one.ident
            elif self._left >= 0 and place[0].id == one.stream.id:
                self._kept.append(of_channels(one, place[1]))
                self._left -= 4 * int(one.n.sum()) + 18 * len(one)
        if self._left < 0:
            self._kept = []

    def check(self) -> None:
        """Raise SessionError where a box sent samples and has no such channel."""
        if self._lacking is not None:
            names = ", ".join(c.name for stream in self._lacking.streams.values() for c in stream.channels)
            raise SessionError(f"the box has no channel {self._channel!r}; it has {names}")

    def __iter__(self) -> Iterator[ChannelBlocks]:
        if self._left >= 0:
            yield from self._kept
            return
        for one in self._again():
            place = columns_in(one.ident, [self._channel])
            if place is not None and place[0].id == one.stream.id:
                yield of_channels(one, place[1])


@dataclass
class DwellSamples:
    """The samples of one dwell as they come in: runs of counts, each whole in itself."""

    dwell: int
    start_ns: int
    end_ns: int
    channel: Channel | None = None
    period_ns: int = 0
    pieces: list[list[NDArray[Any]]] = field(default_factory=list)
    begins_ns: list[int] = field(default_factory=list)  # host time of the first sample of each piece
    bound_ns: float = 0.0
    fault: bool = False

    @property
    def longest(self) -> NDArray[Any]:
        """Counts (n,) of the longest whole piece."""
        return self.longest_piece[1]

    @property
    def longest_piece(self) -> tuple[int, NDArray[Any]]:
        """Host time [ns] of the first sample of the longest whole piece, and its counts (n,)."""
        whole = [(t, np.concatenate(piece)) for t, piece in zip(self.begins_ns, self.pieces, strict=True) if piece]
        return max(whole, key=lambda piece: len(piece[1]), default=(self.start_ns, np.empty(0, np.int32)))


def collect_samples(
    blocks: Iterable[ChannelBlocks],
    clocks: Mapping[int, DeviceClock],
    intervals: Sequence[tuple[int, int, int]],
) -> Iterator[DwellSamples]:
    """The samples of each interval (dwell, start_host_ns, end_host_ns); the intervals ascend and do not overlap."""
    waiting = deque(DwellSamples(*interval) for interval in intervals)
    for some in blocks:
        clock = clocks.get(some.segment)
        if clock is None or not len(some):
            continue
        times, bounds = some.times(clock)
        ends = np.cumsum(some.n, dtype=np.int64)
        while waiting and waiting[0].end_ns < times[0]:
            yield waiting.popleft()
        for taken in waiting:
            if taken.start_ns > times[-1]:
                break
            _take(taken, some, times, bounds, ends)
    yield from waiting


def _take(taken: DwellSamples, some: ChannelBlocks, times: Ints, bounds: NDArray[np.float64], ends: Ints) -> None:
    """Add the samples of blocks that fall into the interval, cut where a gap is."""
    low, high = (int(i) for i in np.searchsorted(times, [taken.start_ns, taken.end_ns + 1]))
    if low == high:
        return
    k0, k1 = (int(k) for k in np.searchsorted(ends, [low, high - 1], side="right"))
    touched = slice(k0, k1 + 1)
    gaps = (ends[touched] - some.n[touched])[some.gap[touched]].tolist()
    cuts = [low, *(gap for gap in gaps if low < gap < high), high]
    pieces = [some.counts[a:b, 0] for a, b in pairwise(cuts)]
    begins = [int(times[a]) for a in cuts[:-1]]
    if taken.pieces and low not in gaps:
        taken.pieces[-1].append(pieces.pop(0))
        begins.pop(0)
    taken.pieces += [[piece] for piece in pieces]
    taken.begins_ns += begins
    taken.channel = some.channels[0]
    taken.period_ns = int(some.period_ns[k1]) or some.stream.period_ns
    taken.bound_ns = max(taken.bound_ns, float(np.max(bounds[touched])))
    taken.fault |= bool(np.any(some.fault[touched]))
