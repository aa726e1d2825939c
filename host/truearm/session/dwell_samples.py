"""Samples that fall into dwells, block by block (hop 5): no sample across a gap, no more than one dwell in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, groupby, islice, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import SessionError
from truearm.session.box_ident import Channel, Ident, Stream, find_channel
from truearm.session.device_clock import DeviceClock
from truearm.session.sample_blocks import Block
from truearm_wire import messages as wire

CHUNK = 256  # blocks looked at together


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


class Source(NamedTuple):
    """The stream of a box and the column in it that the wanted channel has."""

    stream: Stream
    column: int


def collect_samples(
    blocks: Iterator[tuple[Block, Ident]],
    clocks: Mapping[int, DeviceClock],
    intervals: Sequence[tuple[int, int, int]],
    channel: str,
) -> Iterator[DwellSamples]:
    """The samples of each interval (dwell, start_host_ns, end_host_ns); the intervals ascend and do not overlap.

    Raises SessionError where the box has no channel of that name.
    """
    waiting = deque(DwellSamples(*interval) for interval in intervals)
    for chunk, source in _chunks(blocks, channel):
        clock = clocks.get(chunk[0].segment)
        if clock is None:
            continue
        times, bounds = sample_times(chunk, clock, source.stream)
        while waiting and waiting[0].end_ns < times[0]:
            yield waiting.popleft()
        for taken in waiting:
            if taken.start_ns > times[-1]:
                break
            _take(taken, chunk, times, bounds, source)
    yield from waiting


def _chunks(blocks: Iterator[tuple[Block, Ident]], channel: str) -> Iterator[tuple[list[Block], Source]]:
    """Blocks of the channel's stream, up to CHUNK of one ident, segment and period."""
    for _, group in groupby(blocks, key=lambda pair: id(pair[1])):
        first, ident = next(group)
        source = _source(ident, channel)
        same = (block for block, _ in chain([(first, ident)], group) if block.data.stream == source.stream.id)
        for _, alike in groupby(same, key=lambda block: (block.segment, block.data.period_ns, block.channels)):
            while chunk := list(islice(alike, CHUNK)):
                yield chunk, source


def _source(ident: Ident, channel: str) -> Source:
    found = find_channel(ident, channel)
    if found is None:
        names = ", ".join(c.name for stream in ident.streams.values() for c in stream.channels)
        raise SessionError(f"the box has no channel {channel!r}; it has {names}")
    return Source(*found)


def sample_times(
    chunk: list[Block], clock: DeviceClock, stream: Stream
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Host time [ns] of the signal of each sample, and the bound of each block's; blocks of one segment and period."""
    host, bounds = clock.to_host_ns(np.array([block.data.t0_us for block in chunk], dtype=np.int64))
    n = np.array([block.n for block in chunk])
    return np.repeat(host, n) + within_ns(chunk) - stream.group_delay_ns, bounds


def within_ns(chunk: list[Block]) -> NDArray[np.int64]:
    """How long after its block's first sample each sample was taken [ns]; blocks of one period.

    Samples are placed by the period as it stands: 13 ms at 1000 ppm are 13 ns.
    """
    if chunk[0].data.period_ns == 0:
        return 1000 * np.frombuffer(b"".join(block.data.offsets_us for block in chunk), "<u2").astype(np.int64)
    n = np.array([block.n for block in chunk])
    starts = np.repeat(np.cumsum(n) - n, n)
    return np.asarray((np.arange(starts.size) - starts) * np.int64(chunk[0].data.period_ns))


def _take(
    taken: DwellSamples, chunk: list[Block], times: NDArray[np.int64], bounds: NDArray[np.float64], source: Source
) -> None:
    """Add the samples of a chunk that fall into the interval, cut where a gap is."""
    low, high = (int(i) for i in np.searchsorted(times, [taken.start_ns, taken.end_ns + 1]))
    if low == high:
        return
    ends = np.cumsum([block.n for block in chunk])
    k0, k1 = (int(k) for k in np.searchsorted(ends, [low, high - 1], side="right"))
    touched = chunk[k0 : k1 + 1]
    firsts = ends[k0 : k1 + 1] - [block.n for block in touched]
    counts = np.frombuffer(b"".join(block.data.samples for block in touched), "<i4").reshape(-1, chunk[0].channels)
    gaps = [int(begin) for begin, block in zip(firsts, touched, strict=True) if block.gap]
    cuts = [low, *(gap for gap in gaps if low < gap < high), high]
    pieces = [counts[a - firsts[0] : b - firsts[0], source.column] for a, b in pairwise(cuts)]
    begins = [int(times[a]) for a in cuts[:-1]]
    if taken.pieces and low not in gaps:
        taken.pieces[-1].append(pieces.pop(0))
        begins.pop(0)
    taken.pieces += [[piece] for piece in pieces]
    taken.begins_ns += begins
    taken.channel = source.stream.channels[source.column]
    taken.period_ns = chunk[0].data.period_ns or source.stream.period_ns
    taken.bound_ns = max(taken.bound_ns, float(np.max(bounds[k0 : k1 + 1])))
    taken.fault |= any(block.data.flags & wire.FLAG_CONVERTER for block in touched)
