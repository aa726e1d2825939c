"""Find dwells of a robot without a joint stream, from manually noted joints and the sensor's rest.

Joints read off a pendant arrive every few seconds, so they cannot show when the robot stood still. The ball-bar can:
the stops of its length are found in the same way as those of joints (``find_stops()``). A reading noted while the bar
rested belongs to that rest. Two differing readings in one rest mean that the robot moved without the bar showing it. A
reading at any other time belongs to no rest. A motion that keeps the bar's length constant to within a few noise
standard deviations remains undetected.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_ident import Channel
from truearm.session.device_clock import DeviceClock
from truearm.session.dwells import Dwell, DwellRules, find_stops
from truearm.session.joint_readings import BIN_S, NOTED_S, Bins, JointStream
from truearm.session.samples import ChannelBlocks, extension, railed

NO_STEP = np.zeros(1)


def has_manual_joints(stream: JointStream) -> bool:
    """Return whether the readings are too far apart to show when the robot stood still."""
    return stream.bins is not None and (stream.readings == 1 or stream.rate_hz * NOTED_S < 1.0)


def manual_dwells(
    stream: JointStream,
    blocks: Iterable[ChannelBlocks],
    clocks: Mapping[int, DeviceClock],
    rules: DwellRules,
) -> list[Dwell]:
    """Return one dwell per reading, in order.

    Those in no rest of the sensor, or in one with another reading, carry their reason.
    """
    bins = stream.bins
    if bins is None:
        return []
    sensor = sensor_bins(blocks, clocks)
    rests = (
        [] if sensor is None else [stop for stop in find_stops(sensor, NO_STEP, rules) if stop.reason != "too short"]
    )
    begin = np.array([rest.stood_s for rest in rests])
    end = np.array([rest.end_s + rules.guard_s for rest in rests])
    noted = np.concatenate(
        [stream.clocks[s].to_host_ns(bins.t_first_s[bins.segment == s]) for s in np.unique(bins.segment)]
    )
    of = np.searchsorted(begin, 1e-9 * noted, side="right") - 1
    inside = np.array([i >= 0 and 1e-9 * t <= end[i] for i, t in zip(of, noted, strict=True)])
    dwells = []
    for k, (rest, t_ns) in enumerate(zip(of.tolist(), noted.tolist(), strict=True)):
        if not inside[k]:
            dwells.append(
                _noted(stream, bins, k, t_ns, "still moving", "the bar did not rest when the joints were noted")
            )
            continue
        others = np.flatnonzero((of == rest) & inside)
        apart = float(np.max(np.abs(bins.mean[others] - bins.mean[k])))
        if apart > rules.pose_tolerance:
            dwells.append(
                _noted(stream, bins, k, t_ns, "ambiguous", f"{len(others)} readings in one rest, {apart:.3f} rad apart")
            )
        elif k == others[0]:
            dwells.append(_resting(_noted(stream, bins, k, t_ns), rests[rest], t_ns))
    return dwells


def sensor_bins(blocks: Iterable[ChannelBlocks], clocks: Mapping[int, DeviceClock]) -> Bins | None:
    """Return the sensor's extension in bins of BIN_S [s of the host's clock], as a single joint; None if there is none.

    Samples at a rail are left out: an open coil is quiet but not at rest. Raises SessionError if the channel has no
    calibration.
    """
    rows: list[tuple[int, float, float, int, float, float, float, bool]] = []
    for placed in _chunks(blocks, clocks):
        counts = np.concatenate([block.counts for block in placed])
        if np.any(railed(counts)):
            continue
        metres = extension(counts, placed[0].channel)
        first, last = placed[0].host_s, placed[-1].host_s
        gap = placed[0].gap or not rows or first - rows[-1][2] > BIN_S
        last += 1e-9 * placed[-1].period_ns * (len(placed[-1].counts) - 1)
        rows.append((placed[0].segment, first, last, counts.size, metres.mean(), metres.min(), metres.max(), gap))
    if not rows:
        return None
    segment, first_s, last_s, n, mean, low, high, gaps = (np.array(column) for column in zip(*rows, strict=True))
    empty = np.zeros((len(rows), 1), np.float32)
    return Bins(segment, first_s, last_s, n, mean[:, None], low[:, None], high[:, None], empty, gaps)


class _Block(NamedTuple):
    """The samples of one block, and the time of the first."""

    segment: int
    host_s: float
    counts: NDArray[np.int32]
    period_ns: int  # as stated in the block
    sampled_ns: int  # time that the block covers
    gap: bool
    channel: Channel


def _chunks(blocks: Iterable[ChannelBlocks], clocks: Mapping[int, DeviceClock]) -> Iterator[list[_Block]]:
    """Yield blocks with their host time, grouped to BIN_S without gaps."""
    placed: list[_Block] = []
    for block in _singly(blocks, clocks):
        if placed and (block.gap or placed[0].segment != block.segment):
            placed = []  # less than a bin before a gap
        placed.append(block)
        if sum(one.sampled_ns for one in placed) >= 0.9e9 * BIN_S:
            yield placed
            placed = []


def _singly(blocks: Iterable[ChannelBlocks], clocks: Mapping[int, DeviceClock]) -> Iterator[_Block]:
    for some in blocks:
        clock = clocks.get(some.segment)
        if clock is None:
            continue
        host, _ = clock.to_host_ns(some.t0_us)
        host_s = 1e-9 * (host - some.stream.group_delay_ns)
        counts = np.split(some.counts[:, 0], some.first[1:])
        columns = host_s.tolist(), some.n.tolist(), some.period_ns.tolist(), some.gap.tolist(), counts
        for t_s, n, period_ns, gap, samples in zip(*columns, strict=True):
            sampled_ns = n * (period_ns or some.stream.period_ns)
            yield _Block(some.segment, t_s, samples, period_ns, sampled_ns, gap, some.channels[0])


def _noted(stream: JointStream, bins: Bins, k: int, t_host_ns: int, reason: str = "", detail: str = "") -> Dwell:
    """Return a dwell from reading k alone, at the time at which it was noted."""
    t = float(bins.t_first_s[k])
    return Dwell(
        segment=int(bins.segment[k]),
        start_s=t,
        end_s=t,
        q=bins.mean[k],
        q_cov=np.diag(stream.step**2) / 12.0,
        n_readings=int(bins.n[k]),
        stood_s=t,
        bins=(k, k + 1),
        reason=reason,
        detail=detail,
        start_host_ns=t_host_ns,
        end_host_ns=t_host_ns,
    )


def _resting(dwell: Dwell, rest: Dwell, t_host_ns: int) -> Dwell:
    """Return the dwell over the complete rest of the sensor, in host times."""
    begin, end, stood = (round(1e9 * t) for t in (rest.start_s, rest.end_s, rest.stood_s))
    at = dwell.start_s
    return replace(
        dwell,
        stood_s=at + 1e-9 * (stood - t_host_ns),
        start_s=at + 1e-9 * (begin - t_host_ns),
        end_s=at + 1e-9 * (end - t_host_ns),
        start_host_ns=begin,
        end_host_ns=end,
        reason=rest.reason,
        detail=rest.detail.replace("rad", "m").removeprefix("joint 1 "),
    )
