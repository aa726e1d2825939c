"""Dwells of a robot that says nothing: joints noted by hand, one reading a pose, and rest as the sensor sees it (hop 5).

Joints that somebody read off a pendant come once in several seconds. They cannot say when the robot stood still; the ball-bar can: the
stops of its length are found as those of joints are (``find_stops()``). A reading noted while the bar rested is that rest's.
Two readings in one rest that differ are a move that the bar did not show, and a reading at another time is of no rest.
What remains unseen is a move along which the bar's length stays the same to a few noises.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from truearm.session.box_ident import Channel, Ident, find_channel
from truearm.session.device_clock import DeviceClock
from truearm.session.dwells import Dwell, DwellRules, find_stops
from truearm.session.joint_readings import BIN_S, NOTED_S, Bins, JointStream
from truearm.session.lvdt import extension, railed
from truearm.session.sample_blocks import Block

NO_STEP = np.zeros(1)


def has_manual_joints(stream: JointStream) -> bool:
    """Whether the readings are too far apart to say when the robot stood still."""
    return stream.bins is not None and (stream.readings == 1 or stream.rate_hz * NOTED_S < 1.0)


def manual_dwells(
    stream: JointStream,
    blocks: Iterable[tuple[Block, Ident]],
    clocks: Mapping[int, DeviceClock],
    rules: DwellRules,
    channel: str = "lvdt",
) -> list[Dwell]:
    """One dwell a reading, in order; those in no rest of the sensor, or in one with another reading, carry their reason."""
    bins = stream.bins
    if bins is None:
        return []
    sensor = sensor_bins(blocks, clocks, channel)
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


def sensor_bins(blocks: Iterable[tuple[Block, Ident]], clocks: Mapping[int, DeviceClock], channel: str) -> Bins | None:
    """The sensor's extension in bins of BIN_S [s of the host's clock], as of a single joint; None where there is none.

    What stands at a rail is left out: an empty coil is quiet, but no rest. Raises SessionError where the channel has no calibration.
    """
    rows: list[tuple[int, float, float, int, float, float, float, bool]] = []
    for placed, described, column in _chunks(blocks, clocks, channel):
        counts = np.concatenate([block.counts[:, column] for block, _ in placed])
        if np.any(railed(counts)):
            continue
        metres = extension(counts, described)
        (first_block, first), (last_block, last) = placed[0], placed[-1]
        gap = first_block.gap or not rows or first - rows[-1][2] > BIN_S
        last += 1e-9 * last_block.data.period_ns * (last_block.n - 1)
        rows.append((first_block.segment, first, last, counts.size, metres.mean(), metres.min(), metres.max(), gap))
    if not rows:
        return None
    segment, first_s, last_s, n, mean, low, high, gaps = (np.array(column) for column in zip(*rows, strict=True))
    empty, nothing = np.zeros((len(rows), 1, 1), np.float32), np.full((len(rows), 1), np.nan)
    return Bins(segment, first_s, last_s, n, mean[:, None], low[:, None], high[:, None], empty, gaps, nothing)


def _chunks(
    blocks: Iterable[tuple[Block, Ident]], clocks: Mapping[int, DeviceClock], channel: str
) -> Iterator[tuple[list[tuple[Block, float]], Channel, int]]:
    """Blocks of the channel with their host time [s], BIN_S of them together and none missing between; channel and its column."""
    placed: list[tuple[Block, float]] = []
    for block, ident in blocks:
        found, clock = find_channel(ident, channel), clocks.get(block.segment)
        if found is None or clock is None or found[0].id != block.data.stream:
            continue
        if placed and (block.gap or placed[0][0].segment != block.segment):
            placed = []  # less than a bin before a gap
        host, _ = clock.to_host_ns(np.array([block.data.t0_us], dtype=np.int64))
        placed.append((block, 1e-9 * (int(host[0]) - found[0].group_delay_ns)))
        if sum(one.n for one, _ in placed) * (block.data.period_ns or found[0].period_ns) >= 0.9e9 * BIN_S:
            yield placed, found[0].channels[found[1]], found[1]
            placed = []


def _noted(stream: JointStream, bins: Bins, k: int, t_host_ns: int, reason: str = "", detail: str = "") -> Dwell:
    """The dwell of reading k alone, at the time at which it was noted."""
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
        q_cmd=bins.commanded[k],
    )


def _resting(dwell: Dwell, rest: Dwell, t_host_ns: int) -> Dwell:
    """The dwell over the whole rest of the sensor, whose times are the host's."""
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
