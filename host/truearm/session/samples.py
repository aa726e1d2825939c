"""Convert counts to metres, and keep a channel's samples until it is known which are needed.

The box provides the conversion from counts to volts and from volts to an extension (scale and calibration polynomial of
the channel). The rig provides the rest: length = zero + gain · extension, centre to centre.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm import units
from truearm.disk import system_reason
from truearm.errors import SessionError
from truearm.session.clock import DeviceClock, host_times
from truearm.session.frames import FRAME, RATIO_STEP, Channel, Data, Ident, Stream, find_channels
from truearm.session.streams import Blocks
from truearm.text import box_command, one_line
from truearm.types import Floats, Indices, Ints, Mask
from truearm_wire import messages as wire

# Two's complement limits of a 24-bit converter. At a limit the true input is at least that large but otherwise unknown.
RAIL_HIGH = 2**23 - 1
RAIL_LOW = -(2**23)
LEAST_DIVISOR = 2**23 // 100  # 12 mV at gain 1


def railed(counts: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the counts at a rail of the 24-bit converter."""
    return np.asarray((counts >= RAIL_HIGH) | (counts <= RAIL_LOW))


def with_ratios(counts: NDArray[np.int32], channels: Sequence[Channel]) -> NDArray[np.int32]:
    """Replace the columns of channels (n, c) that are divided by another with their ratio in counts of ``RATIO_STEP``.

    For an LVDT this is the secondary over the primary, so the excitation cancels. The result is set to a rail if either
    count is at a rail, or if the divisor is below ``LEAST_DIVISOR`` counts because nothing excites the sensor.
    """
    divided = [k for k, channel in enumerate(channels) if channel.over is not None and not channel.fault]
    if not divided:
        return counts
    ratios = counts.copy()
    for k in divided:
        over = counts[:, channels[k].over]
        usable = ~railed(counts[:, k]) & ~railed(over) & (np.abs(over) >= LEAST_DIVISOR)
        ratio = counts[:, k] / np.where(usable, over, 1) * (channels[k].per_count / RATIO_STEP)
        ratios[:, k] = np.where(usable, np.clip(np.rint(ratio), RAIL_LOW, RAIL_HIGH), RAIL_HIGH)
    return ratios


def counts_of(data: Data, stream: Stream) -> NDArray[np.int32] | None:
    """Return the counts (n, c) of a frame, with ratios; None if it does not hold whole samples of the stream."""
    n_channels = len(stream.channels)
    if not data.samples or len(data.samples) % (4 * n_channels):
        return None
    return with_ratios(np.frombuffer(data.samples, "<i4").reshape(-1, n_channels), stream.channels)


def volts(counts: NDArray[Any], channel: Channel) -> Floats:
    """Return counts · scale in the channel's ``unit``; any shape."""
    return counts * np.float64(channel.scale)


def extension(counts: NDArray[Any], channel: Channel) -> Floats:
    """Return the extension [m or rad] from the counts of a calibrated channel; any shape.

    Raises SessionError if the channel has no calibration to a length or an angle, or the box describes it incorrectly.
    """
    if channel.fault:
        raise SessionError(
            f"channel {channel.name!r} of the box cannot be used: {channel.fault}; correct it with "
            f"{box_command(f'config set channel.{one_line(channel.name)}.KEY=VALUE', 'DEVICE')}, then record again"
        )
    unit = units.length(channel.calibrated_unit, ("m", "rad")) if channel.poly else None
    if unit is None:
        raise SessionError(
            f"channel {channel.name!r} of the box has no calibration to metres; calibrate it with "
            f"{box_command(f'gauge {one_line(channel.name)}', 'DEVICE')}, then record again"
        )
    return np.asarray(unit.to_si(np.polynomial.polynomial.polyval(volts(counts, channel), channel.poly)))


def shown(channel: Channel, count: int) -> tuple[str, float]:
    """Return a usable channel's name with the unit, and its sample for display: metres if calibrated to a length."""
    if channel.length_unit is None:
        return f"{channel.name}_{channel.unit or 'raw'}", count * channel.scale
    return f"{channel.name}_m", float(extension(np.array(count), channel))


IN_MEMORY_BYTES = 1 << 20


class Spool:
    """Arrays that belong together, by number, in the order in which they were added, in a temporary file.

    A session may hold more than fits in memory. The file lies in the folder for temporary files (``TMPDIR``), has no
    name, and takes about as much space as the session. ``spans``: the segment of each number, and its first and last
    time.
    """

    def __init__(self) -> None:
        self.spans: list[tuple[int, float, float]] = []
        self._file = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY_BYTES)
        self._layouts: list[tuple[int, list[tuple[np.dtype[Any], tuple[int, ...]]]]] = []

    def append(self, arrays: Sequence[NDArray[Any]], span: tuple[int, float, float]) -> None:
        """Add arrays. Raises SessionError if the disk is full."""
        try:
            self._layouts.append((self._file.seek(0, 2), [(array.dtype, array.shape) for array in arrays]))
            self._file.write(b"".join(array.tobytes() for array in arrays))
        except OSError as exc:
            raise SessionError(
                f"{tempfile.gettempdir()}: the samples cannot be kept here while the session is read: "
                f"{system_reason(exc)}; set TMPDIR to a folder with more space"
            ) from exc
        self.spans.append(span)

    def load(self, number: int) -> list[NDArray[Any]]:
        """Return the arrays with a number."""
        begin, layout = self._layouts[number]
        self._file.seek(begin)
        return [np.frombuffer(self._file.read(d.itemsize * prod(shape)), d).reshape(shape) for d, shape in layout]


# ------------------------------------------------------------------------------------------------- samples of channels

_KEPT = ["t_us", "period_ns", "n", "flags", "gap"]  # of a block
_PACKED = np.dtype([(name, FRAME[name]) for name in _KEPT])
SLACK_US = 10_000  # of the time between which samples lie


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples (n,) of c channels of one stream: host time [ns] at which the signal had the value, and counts (n, c).

    ``piece`` (n,) is another number behind a gap. ``fault`` (n,): the converter's. ``bounds_ns`` (n,): largest errors
    of the times. ``periods_ns`` (n,): of the converter.
    """

    t_ns: Ints
    counts: NDArray[np.int32]
    piece: Ints
    fault: NDArray[np.bool_]
    bounds_ns: Floats
    periods_ns: NDArray[np.uint32]
    channels: tuple[Channel, ...]

    @property
    def bound_ns(self) -> float:
        """The largest error of the times."""
        return float(self.bounds_ns.max())

    @property
    def period_ns(self) -> int:
        """The converter's period at the last sample."""
        return int(self.periods_ns[-1])

    def take(self, rows: slice | Mask | Indices) -> Samples:
        """Return a selection of the samples."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _COLUMNS})

    def longest(self) -> tuple[int, NDArray[np.int32]]:
        """Return the host time [ns] of the first sample of the longest gap-free piece, and its first channel."""
        begins = np.flatnonzero(np.diff(self.piece, prepend=-1))
        n = np.diff(begins, append=len(self.piece))
        first = int(begins[np.argmax(n)])
        return int(self.t_ns[first]), self.counts[first : first + int(n.max()), 0]


_COLUMNS = ("t_ns", "counts", "piece", "fault", "bounds_ns", "periods_ns")


class ChannelSamples:
    """All samples of some channels of one stream, kept on the disk."""

    def __init__(self, channels: Sequence[str]) -> None:
        self._names = channels
        self._arrays = Spool()
        self._kept: list[tuple[int, Callable[..., Blocks]]] = []  # the pieces before, and the blocks of their arrays
        self._pieces = 0
        self._samples = lru_cache(1)(self._load)  # the last batch: dwells come in order
        self._host_ns: NDArray[np.float64] = np.empty((0, 2))  # between which each lies; NaN without a clock
        self._clocks: Mapping[int, DeviceClock] = {}
        self._lacking: Ident | None = None

    def keep(self, blocks: Iterable[Blocks]) -> None:
        """Keep the channels' samples among all blocks of a box."""
        for block in blocks:
            place = find_channels(block.ident, *self._names)
            if place is None:
                self._lacking = self._lacking or block.ident
            elif place[0].id == block.stream.id and len(block):
                counts = with_ratios(block.counts, block.channels)[:, place[1]]
                channels = tuple(block.channels[column] for column in place[1])
                begin_us = int(block.table["t_us"].min()) - block.stream.group_delay_ns // 1000 - SLACK_US
                end_us = int(block.table["t_us"].max()) + block.reach_ns // 1000 + SLACK_US
                self._arrays.append((block.table[_KEPT].astype(_PACKED), counts), (block.segment, begin_us, end_us))
                self._kept.append((self._pieces, partial(Blocks, block.segment, block.ident, block.stream, channels)))
                self._pieces += int(np.count_nonzero(block.table["gap"]))

    def _load(self, number: int) -> Samples:
        """Return the samples that were kept together."""
        pieces_before, blocks_of = self._kept[number]
        blocks = blocks_of(*self._arrays.load(number))
        table = blocks.table
        host, bound = self._clocks[blocks.segment].to_host_ns(table["t_us"])
        of_blocks = host - blocks.stream.group_delay_ns, table["flags"], bound, table["period_ns"]
        t_ns, flags, bounds_ns, periods_ns = (np.repeat(column, table["n"]) for column in of_blocks)
        piece = pieces_before + np.cumsum(blocks.gaps(), dtype=np.int64)
        fault = (flags & wire.FLAG_CONVERTER) != 0
        return Samples(t_ns + blocks.within_ns(), blocks.counts, piece, fault, bounds_ns, periods_ns, blocks.channels)

    def place(self, clocks: Mapping[int, DeviceClock]) -> None:
        """Set the clock of each segment of the box."""
        self._clocks, spans = clocks, np.array(self._arrays.spans, np.int64).reshape(-1, 3)
        host_ns, bound = host_times(clocks, spans[:, 0], spans[:, 1:])
        self._host_ns = np.where(np.isfinite(bound), host_ns, np.nan)

    def check(self) -> None:
        """Raise SessionError if a box sent samples but does not have the channels."""
        if self._lacking is not None:
            have = ", ".join(c.name for stream in self._lacking.streams.values() for c in stream.channels)
            raise SessionError(f"the box has no channel {self._names[0]!r}; it has {have}")

    def __iter__(self) -> Iterator[Samples]:
        """Yield all samples that a clock places in time."""
        for number, (segment, _, _) in enumerate(self._arrays.spans):
            if segment in self._clocks:
                yield self._samples(number)

    def during(self, start_ns: int, end_ns: int) -> Samples | None:
        """Return the samples between two host times; None if there are none, or no clock places them in time."""
        batches = []
        for number in np.flatnonzero((self._host_ns[:, 0] <= end_ns) & (self._host_ns[:, 1] >= start_ns)).tolist():
            samples = self._samples(number)
            batch = samples.take(slice(*np.searchsorted(samples.t_ns, [start_ns, end_ns + 1])))
            batches += [batch] if len(batch.t_ns) else []
        if len(batches) < 2:
            return batches[0] if batches else None
        columns: dict[str, Any] = {name: np.concatenate([vars(batch)[name] for batch in batches]) for name in _COLUMNS}
        # Two lives of the box have two clocks; their times may overlap by the clocks' errors.
        return replace(batches[-1], **columns).take(np.argsort(columns["t_ns"], kind="stable"))
