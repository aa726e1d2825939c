"""Counts of the wanted channels → metres, those that fall into dwells, and what a mean of them is worth (hops 4 and 5).

The box says how counts become volts and volts an extension (scale and calibration polynomial of the channel), the rig says the rest:
length = zero + gain · extension, centre to centre. No dwell takes a sample from across a gap.

**The mean of correlated samples.** The variance of the mean of n samples with autocovariance Γ(k) is σ²/n_eff with n_eff = n σ² / C and
C = Γ(0) + 2 Σ Γ(k). An estimate of Γ is noise beyond the correlation, so the sum stops at the first lag W that is at least
five times the integrated correlation time τ(W) = C(W) / (2 Γ(0)) (Sokal, "Monte Carlo methods in statistical mechanics", 1997, §3). Taking
deviations from the estimated mean lowers each Γ(k) by C/n; that is put back (Wolff, "Monte Carlo errors with less errors",
Comput. Phys. Commun. 156, 2004, eq. 49).

**Where a stop begins to be at rest.** The second half of a stop says what rest is: its level, and how far the mean of k blocks strays from that by noise alone.
Stretches of 1, 2, 4 … blocks, short ones for ringing and long ones for a creep, are held against that level; rest begins
after the last stretch that is off it. The bounds are such that noise alone cuts FALSE_ALARM of all stops that rest from
their beginning, whatever their number of stretches (Bonferroni), if a block's mean is Gaussian. They are never below
``floor``, which is what the user of the signal does not care about.

Nothing here knows what the signal is: the sensor's samples and the joints' readings are treated alike.

**The Allan deviation.** How far the mean of samples wanders as it is taken over longer times: the overlapping Allan deviation.

σ²(τ) is half the mean square of the difference of two neighbouring means over τ. White noise falls as 1/√τ; where it stops
falling is the floor below which no longer rest brings a mean. Degrees of freedom are those of white noise (Riley,
Handbook of Frequency Stability Analysis, NIST SP 1065, 2008, §5.4.1), so the intervals hold down to the floor and are too
narrow beyond it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, reduce
from itertools import pairwise
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import SessionError
from truearm.session.box_ident import RATIO_STEP, Channel, Ident, Stream, find_channel
from truearm.session.box_reader import Blocks
from truearm.session.device_clock import DeviceClock
from truearm.session.message_columns import Ints
from truearm.types import BallBar, Floats
from truearm_wire import messages as wire

# Two's complement ends of a 24-bit converter: at either the input was at least that large, and the reading says no more.
RAIL_HIGH = 2**23 - 1
RAIL_LOW = -(2**23)
LEAST_DIVISOR = 2**23 // 100  # 12 mV at gain 1


def railed(counts: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask of the counts that stand at a rail of the 24-bit converter."""
    return np.asarray((counts >= RAIL_HIGH) | (counts <= RAIL_LOW))


def with_ratios(counts: NDArray[np.int32], channels: Sequence[Channel]) -> NDArray[np.int32]:
    """Counts (n, c) with the columns of channels that are divided by another as counts of ``RATIO_STEP``.

    An LVDT's secondary over its primary: what drives it cancels. Where either stands at a rail, or the divisor is below
    ``LEAST_DIVISOR`` counts because nothing drives the sensor, the result stands at a rail.
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
    """counts · scale, in the channel's ``unit``; any shape."""
    return counts * np.float64(channel.scale)


def extension(counts: NDArray[Any], channel: Channel) -> Floats:
    """Extension [m] of the counts of a calibrated channel; any shape.

    Raises SessionError if the channel has no calibration to a length, or the box describes it wrongly.
    """
    if channel.fault:
        raise SessionError(
            f"channel {channel.name!r} of the box cannot be used: {channel.fault}; correct the box's configuration and "
            "record anew"
        )
    unit = channel.length_unit
    if unit is None:
        raise SessionError(
            f"channel {channel.name!r} of the box has no calibration to metres; record with a calibrated box"
        )
    return np.asarray(unit.to_si(np.polynomial.polynomial.polyval(volts(counts, channel), channel.poly)))


def shown(channel: Channel, count: int) -> tuple[str, float]:
    """A usable channel's sample for a person to look at, and its name with the unit: metres where it is calibrated to a length."""
    seen, unit = count * channel.scale, channel.length_unit
    if unit is None:
        return f"{channel.name}_{channel.unit or 'raw'}", seen
    return f"{channel.name}_m", unit.to_si(reduce(lambda sum, factor: sum * seen + factor, reversed(channel.poly), 0.0))


def bar_length(extension: Floats, bar: BallBar) -> Floats:
    """Length [m], centre to centre, of a bar at these extensions [m]."""
    return bar.zero + bar.gain * extension


def out_of_travel(extension: Floats, bar: BallBar) -> NDArray[np.bool_]:
    """Mask of the extensions [m] that lie beyond the bar's stroke, where it stands at a stop or its LVDT has left its
    linear range."""
    return np.asarray(np.abs(extension) > 0.5 * bar.travel)


# --------------------------------------------------------------------------------------- samples of channels and dwells

MOST_KEPT_BYTES = 64 << 20  # three to four hours at 2 kHz; of more a session is read again


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
        counts=with_ratios(blocks.counts(), blocks.stream.channels)[:, columns],
        within_ns=blocks.within_ns() if blocks.offsets_us else None,
    )


class _Kept(NamedTuple):
    """Blocks as they wait to be asked for, in half the memory: counts (n, c) as differences where 16 bits hold them, columns of a single value once."""

    blocks: ChannelBlocks  # without their counts
    first: NDArray[np.int32]  # (c,) counts
    rest: NDArray[Any]  # (n, c): int16 differences of one sample to the next, 0 for the first; else int32 counts

    @classmethod
    def of(cls, blocks: ChannelBlocks) -> _Kept:
        """Pack blocks; at least one."""
        counts = blocks.counts
        columns: dict[str, Any] = {name: _once(getattr(blocks, name)) for name in ("period_ns", "n", "gap", "fault")}
        without = replace(blocks, counts=counts[:0].copy(), **columns)
        steps = np.diff(counts, axis=0, prepend=counts[:1])
        small = steps.min() >= -(2**15) and steps.max() < 2**15
        return cls(without, counts[0].copy(), steps.astype(np.int16) if small else counts)

    def unpacked(self) -> ChannelBlocks:
        """The blocks as they were."""
        counts = self.rest
        if counts.dtype == np.int16:
            counts = np.cumsum(counts, axis=0, dtype=np.int32) + self.first
        return replace(self.blocks, counts=counts)


def _once(column: NDArray[Any]) -> NDArray[Any]:
    """The column, in the memory of a single value where all are the same."""
    return np.broadcast_to(column[0], column.shape) if np.all(column == column[0]) else column


class ChannelSamples:
    """The samples of one channel: kept while a session is read for the first time, if they are not too many, else read again."""

    def __init__(self, channel: str, again: Callable[[], Iterator[Blocks]], limit_bytes: int = MOST_KEPT_BYTES) -> None:
        """``again``: all blocks of the session once more."""
        self._channel, self._again, self._left = channel, again, limit_bytes
        self._kept: list[_Kept] = []
        self._lacking: Ident | None = None

    def keep(self, blocks: Iterable[Blocks]) -> None:
        """Take what is of the channel among blocks of the first reading."""
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
        """Raise SessionError where a box sent samples and has no such channel."""
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


# ------------------------------------------------------------------------------------------ means, rest, and slow noise

SOKAL = 5.0
LEAST_LAGS = 8  # noise that alternates (a high-passed converter's) has a small τ after one lag


class MeanOfSamples(NamedTuple):
    """``variance``: of the mean; ``noise``: standard deviation of one sample; ``n_eff``: independent samples;
    ``drift``: of the least-squares line from end to end, ``drift_sigma`` its standard deviation."""

    mean: float
    variance: float
    noise: float
    n: int
    n_eff: float
    drift: float
    drift_sigma: float


def mean_of(samples: Floats) -> MeanOfSamples:
    """Mean of n ≥ 8 evenly spaced samples (n,) in any unit."""
    n = samples.size
    mean = float(np.mean(samples))
    deviation = samples - mean
    place = np.linspace(-0.5, 0.5, n)
    drift = float(place @ deviation / (place @ place))
    # Noise about the line: a drift is neither noise nor correlation, it is judged apart.
    about_line = deviation - drift * place
    variance, noise = mean_variance(about_line, fitted=2)
    n_eff = noise**2 / variance if variance > 0.0 else float(n)
    drift_sigma = float(np.sqrt(12.0 * variance))  # a slope's variance is σ²/Σx², Σx² = n/12
    return MeanOfSamples(mean, variance, noise, n, n_eff, drift, drift_sigma)


def mean_variance(deviation: Floats, fitted: int = 1) -> tuple[float, float]:
    """Variance of the mean of n samples and standard deviation of one, from their deviations (n,).

    ``fitted``: 1 for deviations from the mean, 2 from the least-squares line, which takes as much from each Γ(k) again.
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


FALSE_ALARM = 1e-4  # of seven channels in 7200 dwells, five dwells
LEAST_BLOCKS = 4


class Settled(NamedTuple):
    """Where signals come to rest, one or several.

    ``first`` (…): index of the first block at rest, the number of blocks if none is; ``level`` (…): mean of the second half;
    ``deviation`` (…, b): block means less the level; ``bound`` (…): how far one block may stray.
    """

    first: NDArray[np.intp]
    level: Floats
    deviation: Floats
    bound: Floats


def settled_from(means: Floats, block_var: Floats | float, floor: Floats | float) -> Settled:
    """Where the means (…, b) of consecutive blocks, each of variance ``block_var`` (…) by noise, come to rest."""
    b = means.shape[-1]
    half = b // 2
    level = np.mean(means[..., half:], axis=-1)
    deviation = means - level[..., None]
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


@cache
def _sigmas(stretches: int) -> float:
    """How many standard deviations one of so many stretches strays in FALSE_ALARM of all cases."""
    return -NormalDist().inv_cdf(FALSE_ALARM / (2.0 * stretches))


def block_means(samples: Floats, length: int) -> Floats:
    """Means (n // length,) of consecutive blocks of samples (n,); the first n % length samples are in none."""
    count = samples.size // length
    return np.asarray(samples[samples.size - count * length :].reshape(count, length).mean(axis=1))


def block_variance(samples: Floats, length: int) -> float:
    """How far the mean of a block of this length strays, by the second half of the samples (n,) about its own line.

    The larger of what its correlation says of a mean of many blocks and of the blocks' own spread: noise of which
    neighbours cancel has far quieter long means than short ones.
    """
    tail = samples[samples.size // 2 :]
    place = np.linspace(-0.5, 0.5, tail.size)
    about_line = tail - np.mean(tail) - float(place @ tail / (place @ place)) * place
    of_mean, _ = mean_variance(about_line, fitted=2)
    means = block_means(about_line, length)
    spread = float(np.var(means, ddof=1)) if means.size > 1 else 0.0
    return max(of_mean * tail.size / length, spread)


def quick_noise(samples: Floats) -> float:
    """Standard deviation of white samples (n,), n > 2, by their second differences, which a swing of an arm hardly alters."""
    return float(np.sqrt(np.mean(np.square(np.diff(samples, n=2))) / 6.0))


def rings(found: Settled) -> bool:
    """Whether what is off the level changes sides: a swing; else it comes from one side: a creep or a drift."""
    side = np.sign(found.deviation[np.abs(found.deviation) > found.bound])
    return int(np.count_nonzero(np.diff(side))) >= 2


LEAST_FREEDOM = 5.0


class Allan(NamedTuple):
    """Averaging times (k,) [s], deviations (k,) [unit of the samples], and degrees of freedom (k,)."""

    tau_s: Floats
    deviation: Floats
    freedom: Floats


def allan(pieces: Sequence[Floats], period_s: float) -> Allan:
    """Of several whole pieces of evenly spaced samples (n,), at averaging times of 1, 2, 4 … samples; at most a third of a piece."""
    longest = max((piece.size for piece in pieces), default=0)
    rows = []
    for k in range(longest.bit_length()):
        m = 1 << k
        found = [_variance(piece, m) for piece in pieces if piece.size >= 3 * m]
        freedom = sum(f for _, f in found)
        if freedom >= LEAST_FREEDOM:
            rows.append((m * period_s, np.sqrt(sum(v * f for v, f in found) / freedom), freedom))
    return Allan(*np.array(rows).reshape(-1, 3).T)


def _variance(samples: Floats, m: int) -> tuple[float, float]:
    """Variance of means of m samples, and its degrees of freedom if the noise is white."""
    n = samples.size
    sums = np.concatenate([[0.0], np.cumsum(samples - np.mean(samples))])
    means = (sums[m:] - sums[:-m]) / m
    variance = 0.5 * float(np.mean(np.square(means[m:] - means[:-m])))
    points = n + 1  # of the phase, whose differences the samples are
    freedom = (1.5 * (points - 1) / m - 2.0 * (points - 2) / points) * 4.0 * m**2 / (4.0 * m**2 + 5.0)
    return variance, max(float(freedom), 1.0)
