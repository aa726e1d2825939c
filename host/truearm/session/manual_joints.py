"""Find dwells of a robot without a joint stream, from manually noted joints and the sensor's rest.

Joints read off a pendant arrive every few seconds, so they cannot show when the robot stood still. The ball-bar can:
the stops of its length are found in the same way as those of joints (``find_stops()``). A reading noted while the bar
rested belongs to that rest. Two differing readings in one rest mean that the robot moved without the bar showing it. A
reading at any other time belongs to no rest. A motion that keeps the bar's length constant to within a few noise
standard deviations remains undetected.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from truearm.session.dwells import GUARD_S, POSE_TOLERANCE, Dwell, find_stops, of_bins
from truearm.session.joint_readings import BIN_S, NOTED_S, Bins, JointStream, binned
from truearm.session.samples import ChannelSamples, extension, railed

NO_STEP = np.zeros(1)


def has_manual_joints(stream: JointStream) -> bool:
    """Return whether the readings are too far apart to show when the robot stood still."""
    return stream.readings == 1 or stream.rate_hz * NOTED_S < 1.0


def manual_dwells(stream: JointStream, samples: ChannelSamples) -> list[Dwell]:
    """Return one dwell per reading, in order.

    Those in no rest of the sensor, or in one with another reading, carry their reason.
    """
    bins, sensor = stream.bins, sensor_bins(samples)
    stops = [] if sensor is None else find_stops(sensor, NO_STEP)
    rests = [stop for stop in stops if stop.reason != "too short"]
    end_s = np.array([*(stop.end_s + GUARD_S for stop in rests), -np.inf])
    noted_ns = stream.to_host_ns(bins.segment, bins.t_first_s)
    rest_of = np.searchsorted([stop.stood_s for stop in rests], 1e-9 * noted_ns, side="right") - 1
    rest_of[1e-9 * noted_ns > end_s[rest_of]] = -1
    dwells = []
    for k, (number, t_ns) in enumerate(zip(rest_of.tolist(), noted_ns.tolist(), strict=True)):
        alike = np.flatnonzero(rest_of == number)
        span = float(np.max(np.abs(bins.mean[alike] - bins.mean[k])))
        dwell = of_bins(bins, slice(k, k + 1), stream.step, float(bins.t_first_s[k]))
        dwell = replace(dwell, end_s=dwell.start_s, start_host_ns=t_ns, end_host_ns=t_ns)
        if number < 0:
            detail = "the bar did not rest when the joints were noted"
            dwells.append(replace(dwell, reason="still moving", detail=detail))
        elif span > POSE_TOLERANCE:
            detail = f"{len(alike)} readings in one rest, {span:.3f} rad apart"
            dwells.append(replace(dwell, reason="ambiguous", detail=detail))
        elif k == alike[0]:
            dwells.append(_resting(dwell, rests[number], t_ns))
    return dwells


def sensor_bins(samples: ChannelSamples) -> Bins | None:
    """Return the sensor's extension in bins of BIN_S [s of the host's clock], as a single joint; None if there is none.

    Samples at a rail are left out: an open coil is quiet but not at rest. Raises SessionError if the channel has no
    calibration.
    """
    pieces = []
    for block, host_ns in samples:
        t_s = np.asarray(1e-9 * (np.repeat(host_ns, block.table["n"]) + block.within_ns()), np.float64)
        rails = railed(block.counts[:, 0])
        gaps = rails.astype(np.int64)
        gaps[block.first[:-1]] += block.table["gap"]
        piece = np.cumsum(gaps)
        key = 1e9 * piece + np.floor((t_s - t_s[0]) / BIN_S)
        metres = extension(block.counts[:, :1], block.channels[0])
        silent = np.diff(piece[~rails], prepend=0) > 0
        bins = binned(block.segment, t_s[~rails], metres[~rails], key[~rails], silent)
        filled = bins.n * int(block.table["period_ns"][-1]) >= 0.5e9 * BIN_S
        pieces.append([column[filled] for column in vars(bins).values()])
    if not pieces:
        return None
    bins = Bins(*map(np.concatenate, zip(*pieces, strict=True)))
    silence_s = bins.t_first_s - np.append(-np.inf, bins.t_last_s[:-1])
    return replace(bins, gap=bins.gap | (silence_s > 2.0 * BIN_S))


def _resting(dwell: Dwell, stop: Dwell, t_host_ns: int) -> Dwell:
    """Return the dwell over the complete rest of the sensor, in host times."""
    begin, end, stood = (round(1e9 * t) for t in (stop.start_s, stop.end_s, stop.stood_s))
    noted_s = dwell.start_s
    return replace(
        dwell,
        stood_s=noted_s + 1e-9 * (stood - t_host_ns),
        start_s=noted_s + 1e-9 * (begin - t_host_ns),
        end_s=noted_s + 1e-9 * (end - t_host_ns),
        start_host_ns=begin,
        end_host_ns=end,
        reason=stop.reason,
        detail=stop.detail.replace("rad", "m").removeprefix("joint 1 "),
    )
