"""Convert counts to metres, and keep a channel's samples until it is known which are needed.

The box provides the conversion from counts to volts and from volts to an extension (scale and calibration polynomial of
the channel). The rig provides the rest: length = zero + gain · extension, centre to centre.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import SessionError
from truearm.session.box_ident import RATIO_STEP, Channel, Ident, Stream, find_channel
from truearm.session.device_clock import DeviceClock
from truearm.session.streams import Blocks
from truearm.text import box_command, one_line
from truearm.types import BallBar, Floats, Ints
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
    found = counts.copy()
    for k in divided:
        over = counts[:, channels[k].over]
        usable = ~railed(counts[:, k]) & ~railed(over) & (np.abs(over) >= LEAST_DIVISOR)
        ratio = counts[:, k] / np.where(usable, over, 1) * (channels[k].per_count / RATIO_STEP)
        found[:, k] = np.where(usable, np.clip(np.rint(ratio), RAIL_LOW, RAIL_HIGH), RAIL_HIGH)
    return found


def volts(counts: NDArray[Any], channel: Channel) -> Floats:
    """Return counts · scale in the channel's ``unit``; any shape."""
    return counts * np.float64(channel.scale)


def extension(counts: NDArray[Any], channel: Channel) -> Floats:
    """Return the extension [m] from the counts of a calibrated channel; any shape.

    Raises SessionError if the channel has no calibration to a length, or the box describes it incorrectly.
    """
    if channel.fault:
        raise SessionError(
            f"channel {channel.name!r} of the box cannot be used: {channel.fault}; correct it with "
            f"{box_command(f'config set channel.{one_line(channel.name)}.KEY=VALUE', 'DEVICE')}, then record again"
        )
    unit = channel.length_unit
    if unit is None:
        raise SessionError(
            f"channel {channel.name!r} of the box has no calibration to metres; calibrate it with "
            f"{box_command(f'gauge {one_line(channel.name)}', 'DEVICE')}, then record again"
        )
    return np.asarray(unit.to_si(np.polynomial.polynomial.polyval(volts(counts, channel), channel.poly)))


def shown(channel: Channel, count: int) -> tuple[str, float]:
    """Return a usable channel's sample for display, and its name with the unit: metres if it is calibrated to a length."""
    seen, unit = count * channel.scale, channel.length_unit
    if unit is None:
        return f"{channel.name}_{channel.unit or 'raw'}", seen
    return f"{channel.name}_m", unit.to_si(reduce(lambda sum, factor: sum * seen + factor, reversed(channel.poly), 0.0))


def bar_length(extension: Floats, bar: BallBar) -> Floats:
    """Return the length [m], centre to centre, of a bar at these extensions [m]."""
    return bar.zero + bar.gain * extension


def out_of_travel(extension: Floats, bar: BallBar) -> NDArray[np.bool_]:
    """Return a mask of the extensions [m] beyond the bar's stroke.

    There the bar is at a mechanical stop or its LVDT has left its linear range.
    """
    return np.asarray(np.abs(extension) > 0.5 * bar.travel)


# ------------------------------------------------------------------------------------------------- samples of channels

MOST_KEPT_BYTES = 64 << 20  # three to four hours at 2 kHz; a longer session is read again


@dataclass(frozen=True, eq=False)
class ChannelBlocks:
    """Blocks (b,) of samples of some channels of one stream, all of one segment and ident.

    ``counts`` (Σ n, c). ``fault``: the converter's. ``gap``: samples before the block are missing. ``within_ns`` (Σ
    n,): time from the block's first sample to each sample, None if the periods give it.
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
        """The channels in the columns of ``counts``."""
        return tuple(self.stream.channels[column] for column in self.columns)

    def times(self, clock: DeviceClock) -> tuple[Ints, NDArray[np.float64]]:
        """Return the host time [ns] at which the signal had each sample's value, and the bound for each block."""
        host, bounds = clock.to_host_ns(self.t0_us)
        within = self.within_ns
        if within is None:
            within = (np.arange(len(self.counts)) - np.repeat(self.first, self.n)) * np.repeat(self.period_ns, self.n)
        return np.repeat(host, self.n) + within - self.stream.group_delay_ns, bounds

    @property
    def first(self) -> Ints:
        """Offset of each block in ``counts``."""
        return np.asarray(np.cumsum(self.n, dtype=np.int64) - self.n)

    def some(self, blocks: NDArray[np.bool_]) -> ChannelBlocks:
        """Return a selection (b,) of the blocks."""
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
    """Return the stream that has these channels, and their columns; None if no single stream has them all."""
    found = [find_channel(ident, name) for name in names]
    known = [place for place in found if place is not None]
    if len(known) < len(names) or len({stream.id for stream, _ in known}) != 1:
        return None
    return known[0][0], tuple(column for _, column in known)


def of_channels(blocks: Blocks, columns: tuple[int, ...]) -> ChannelBlocks:
    """Return the same blocks with a selection of channels."""
    return ChannelBlocks(
        segment=blocks.segment,
        stream=blocks.stream,
        columns=columns,
        period_ns=blocks.frames["period_ns"].astype(np.uint32),
        n=blocks.n.astype(np.int32),
        t0_us=blocks.frames["t_us"].copy(),
        gap=blocks.gap,
        fault=(blocks.frames["flags"] & wire.FLAG_CONVERTER) != 0,
        counts=with_ratios(blocks.counts(), blocks.stream.channels)[:, columns],
        within_ns=blocks.within_ns() if blocks.offsets_us else None,
    )


class _Kept(NamedTuple):
    """Blocks packed into half the memory until needed.

    Counts (n, c) are stored as differences where these fit 16 bits, columns of a single value only once.
    """

    blocks: ChannelBlocks  # without their counts
    first: NDArray[np.int32]  # (c,) counts
    rest: NDArray[Any]  # (n, c): int16 differences of one sample to the next, 0 for the first; else int32 counts

    @classmethod
    def of(cls, blocks: ChannelBlocks) -> _Kept:
        """Pack at least one block."""
        counts = blocks.counts
        columns: dict[str, Any] = {name: _once(getattr(blocks, name)) for name in ("period_ns", "n", "gap", "fault")}
        without = replace(blocks, counts=counts[:0].copy(), **columns)
        steps = np.diff(counts, axis=0, prepend=counts[:1])
        small = steps.min() >= -(2**15) and steps.max() < 2**15
        return cls(without, counts[0].copy(), steps.astype(np.int16) if small else counts)

    def unpacked(self) -> ChannelBlocks:
        """Return the original blocks."""
        counts = self.rest
        if counts.dtype == np.int16:
            counts = np.cumsum(counts, axis=0, dtype=np.int32) + self.first
        return replace(self.blocks, counts=counts)


def _once(column: NDArray[Any]) -> NDArray[Any]:
    """Return the column, stored as a single value if all values are the same."""
    return np.broadcast_to(column[0], column.shape) if np.all(column == column[0]) else column


class ChannelSamples:
    """The samples of one channel: kept during the first pass through a session unless there are too many, else read
    again.
    """

    def __init__(self, channel: str, again: Callable[[], Iterator[Blocks]], limit_bytes: int = MOST_KEPT_BYTES) -> None:
        """``again``: reads all blocks of the session once more."""
        self._channel, self._again, self._left = channel, again, limit_bytes
        self._kept: list[_Kept] = []
        self._lacking: Ident | None = None

    def keep(self, blocks: Iterable[Blocks]) -> None:
        """Keep the channel's samples among blocks of the first pass."""
        for one in blocks:
            place = columns_in(one.ident, [self._channel])
            if place is None:
                self._lacking = self._lacking or one.ident
            elif self._left >= 0 and place[0].id == one.stream.id and len(one):
                kept = _Kept.of(of_channels(one, place[1]))
                self._kept.append(kept)
                self._left -= kept.rest.nbytes + kept.blocks.t0_us.nbytes
        if self._left < 0:
            self._kept = []

    def check(self) -> None:
        """Raise SessionError if a box sent samples but does not have the channel."""
        if self._lacking is not None:
            names = ", ".join(c.name for stream in self._lacking.streams.values() for c in stream.channels)
            raise SessionError(f"the box has no channel {self._channel!r}; it has {names}")

    def __iter__(self) -> Iterator[ChannelBlocks]:
        if self._left >= 0:
            yield from (kept.unpacked() for kept in self._kept)
            return
        for one in self._again():
            place = columns_in(one.ident, [self._channel])
            if place is not None and place[0].id == one.stream.id:
                yield of_channels(one, place[1])
