"""Convert counts to metres, keep a channel's samples until it is known which are needed, and the statistics of samples.

The box provides the conversion from counts to volts and from volts to an extension (scale and calibration polynomial of
the channel). The rig provides the rest: length = zero + gain · extension, centre to centre.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from math import prod
from statistics import NormalDist
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
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
    """Return a usable channel's sample for display, and its name with the unit: metres if it is calibrated to a length."""
    if channel.length_unit is None:
        return f"{channel.name}_{channel.unit or 'raw'}", count * channel.scale
    return f"{channel.name}_m", float(extension(np.array(count), channel))


IN_MEMORY_BYTES = 1 << 20


class Spool:
    """Arrays that belong together, by number, in the order in which they were added, in a temporary file.

    A session may hold more than fits in memory. The file lies in the folder for temporary files (``TMPDIR``), has no name, and
    takes about as much space as the session.
    ``spans``: the segment of each number, and its first and last time.
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

    ``piece`` (n,) is another number behind a gap. ``fault`` (n,): the converter's. ``bounds_ns`` (n,): largest errors of
    the times. ``periods_ns`` (n,): of the converter.
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
        """Return the host time [ns] of the first sample of the longest gap-free piece, and the counts of its first channel."""
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


# ------------------------------------------------------------------------------------------------------- noise and rest

SOKAL = 5.0
LEAST_LAGS = 8  # alternating noise (of a high-passed converter) has a small τ after one lag


class MeanOfSamples(NamedTuple):
    """Statistics of a mean.

    ``value_var``: variance of the mean; ``noise``: standard deviation of one sample; ``n_eff``: number of independent samples;
    ``drift``: end-to-end change of the least-squares line; ``drift_sigma``: its standard deviation.
    """

    value: float
    value_var: Annotated[float, Meta(ge=0.0)]
    noise: float
    n_samples: int
    n_eff: float
    drift: float
    drift_sigma: float


def mean_of(samples: Floats) -> MeanOfSamples:
    """Return the mean of n ≥ 8 evenly spaced samples (n,) in any unit."""
    n = samples.size
    # Noise about the line: a drift is neither noise nor correlation and is judged separately.
    mean, drift, about_line = _line(samples)
    variance, noise = mean_variance(about_line, fitted=2)
    n_eff = noise**2 / variance if variance > 0.0 else float(n)
    drift_sigma = float(np.sqrt(12.0 * variance))  # a slope's variance is σ²/Σx², Σx² = n/12
    return MeanOfSamples(mean, variance, noise, n, n_eff, drift, drift_sigma)


def _line(samples: Floats) -> tuple[float, float, Floats]:
    """Return the mean of samples (n,), the end-to-end change of their least-squares line, and the residuals (n,) of it."""
    mean, place = float(np.mean(samples)), np.linspace(-0.5, 0.5, samples.size)
    drift = float(place @ (samples - mean) / (place @ place))
    return mean, drift, samples - mean - drift * place


def mean_variance(deviation: Floats, fitted: int = 1) -> tuple[float, float]:
    """Return the variance of the mean of n samples and the standard deviation of one, from their deviations (n,).

    The mean of correlated samples has the variance C / n, with the sum C of the autocovariances. The sum ends at the first
    lag that is five times the integrated correlation time (Sokal, "Monte Carlo methods in statistical mechanics", 1997,
    §3), and is corrected for the estimated mean (Wolff, Comput. Phys. Commun. 156, 2004, eq. 49).

    ``fitted``: 1 for deviations from the mean, 2 from the least-squares line, which lowers each Γ(k) by the same amount
    again.
    """
    n = deviation.size
    padded = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(deviation, padded)
    gamma = np.fft.irfft(spectrum * spectrum.conj(), padded)[: n // 2] / (n - np.arange(n // 2))
    if gamma[0] <= 0.0:
        return 0.0, 0.0
    tau = np.cumsum(gamma) / gamma[0] - 0.5  # τ(W), 1/2 for white noise
    lags = np.arange(tau.size)
    enough = np.flatnonzero(lags >= np.maximum(LEAST_LAGS, SOKAL * tau))
    window = int(enough[0]) if enough.size else tau.size - 1
    total = 2.0 * gamma[0] * max(float(tau[window]), 0.0)
    bias = fitted * total / n
    gamma0 = float(gamma[0]) + bias
    total = max(total + (2 * window + 1) * bias, gamma0 / n)
    return total / n, float(np.sqrt(gamma0))


FALSE_ALARM = 1e-4  # five dwells, for seven channels in 7200 dwells
LEAST_BLOCKS = 4


class Settled(NamedTuple):
    """Where one or several signals come to rest.

    ``first`` (…): index of the first block at rest, or the number of blocks if none is. ``level`` (…): mean of the
    second half. ``deviation`` (…, b): block means minus the level. ``bound`` (…): allowed deviation of one block.
    """

    first: NDArray[np.intp]
    level: Floats
    deviation: Floats
    bound: Floats


def settled_from(means: Floats, block_var: Floats | float, floor: Floats | float) -> Settled:
    """Return where the means (…, b) of consecutive blocks come to rest; each has the variance ``block_var`` (…) by noise.

    Rest is defined by a stop's second half. Stretches of 1, 2, 4 … blocks are compared with its level: short ones show
    ringing, long ones creep. Rest begins after the last stretch that deviates by more than noise or ``floor`` explains.
    Noise alone truncates a fraction FALSE_ALARM of stops.
    """
    b = means.shape[-1]
    half = b // 2
    level, deviation = _from_level(means)
    level_var = np.asarray(block_var) / (b - half)
    sums = np.concatenate([np.zeros((*means.shape[:-1], 1)), np.cumsum(deviation, axis=-1)], axis=-1)
    widths = [1 << k for k in range(max(1, half).bit_length())]
    sigmas = _sigmas(b * len(widths))
    first = np.zeros(means.shape[:-1], dtype=np.intp)
    for width in widths:
        stretch = (sums[..., width:] - sums[..., :-width]) / width
        bound = np.maximum(floor, sigmas * np.sqrt(block_var / width + level_var))
        off = np.abs(stretch) > bound[..., None]
        last = off.shape[-1] - np.argmax(off[..., ::-1], axis=-1)
        first = np.maximum(first, np.where(np.any(off, axis=-1), last, 0))
    return Settled(first, level, deviation, np.maximum(floor, sigmas * np.sqrt(block_var + level_var)))


def rests_within(means: Floats, floor: Floats | float) -> bool:
    """Return whether ``settled_from()`` finds all signals at rest from their first block, whatever their noise.

    A stretch deviates by no more than the largest deviation of its blocks, and every bound is at least ``floor`` (…).
    """
    _, deviation = _from_level(means)
    # Sums of blocks are rounded: that adds far less than one part in a million to the deviation of a stretch.
    return bool(np.all(np.abs(deviation).max(axis=-1) <= np.asarray(floor) * (1.0 - 1e-6)))


def _from_level(means: Floats) -> tuple[Floats, Floats]:
    """Return the mean (…) of the second half of the blocks (…, b), and the deviations (…, b) from it."""
    level = np.mean(means[..., means.shape[-1] // 2 :], axis=-1)
    return level, means - level[..., None]


@cache
def _sigmas(stretches: int) -> float:
    """Return the deviation, in standard deviations, that one of so many stretches exceeds with probability FALSE_ALARM."""
    return -NormalDist().inv_cdf(FALSE_ALARM / (2.0 * stretches))


def block_means(samples: Floats, length: int) -> Floats:
    """Return the means (n // length,) of consecutive blocks of samples (n,); the first n % length samples are not used."""
    count = samples.size // length
    return np.asarray(samples[samples.size - count * length :].reshape(count, length).mean(axis=1))


def block_variance(samples: Floats, length: int) -> float:
    """Return the variance of the mean of a block of this length, from the second half of the samples (n,) about its
    line.

    This is the larger of two values, derived from the correlation for a mean of many blocks and from the spread of the
    blocks. If neighbouring noise cancels, long means are far quieter than short ones.
    """
    _, _, about_line = _line(samples[samples.size // 2 :])
    of_mean, _ = mean_variance(about_line, fitted=2)
    means = block_means(about_line, length)
    spread = float(np.var(means, ddof=1)) if means.size > 1 else 0.0
    return max(of_mean * about_line.size / length, spread)


def quick_noise(samples: Floats) -> float:
    """Return the standard deviation of white samples (n,), n > 2, from their second differences.

    A swing of an arm hardly changes these.
    """
    return float(np.sqrt(np.mean(np.square(np.diff(samples, n=2))) / 6.0))


def rings(settled: Settled) -> bool:
    """Return whether deviations from the level change sides, as in a swing.

    If they stay on one side, it is a creep or a drift.
    """
    side = np.sign(settled.deviation[np.abs(settled.deviation) > settled.bound])
    return int(np.count_nonzero(np.diff(side))) >= 2
