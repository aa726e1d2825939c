"""Find legs, the motions of the robot from one stop or turn to the next, from its joint readings alone.

A straight line there and back is two legs, whether or not the robot rests at the turn. Between two bins of readings (50
ms) the joints take a step. A leg ends where the step is slow, either in absolute terms or relative to the steps within
half a second before and after, and where it turns by more than a right angle. Legs continue across missing readings:
interpolation inside a leg avoids these. A restart of the controller begins a new leg.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from truearm.session.joint_readings import Bins, JointStream
from truearm.types import Floats

SLOW = 2e-3  # rad/s or m/s; every line is driven faster, and a robot at rest is slower
SLOW_SHARE = 0.2  # of the fastest step before and after
HORIZON_S = 0.5
LEAST_MOVE = 5e-3  # rad or m of any joint
LONGEST_SILENCE_S = 2.0  # after a longer silence the robot may have been anywhere


@dataclass(frozen=True)
class Leg:
    """One motion: controller times [s], host times, and mean readings (j,) of the first and last bin.

    ``cut``: the leg begins or ends at the limits of the readings, not where the robot rested or turned.
    """

    segment: int
    start_s: float
    end_s: float
    q_start: Floats
    q_end: Floats
    cut: bool
    start_host_ns: int = 0
    end_host_ns: int = 0


def find_legs(stream: JointStream) -> list[Leg]:
    """Return all legs in order of time."""
    bins = stream.bins
    if bins is None or len(bins.n) < 2:
        return []
    step, seconds, joined = _steps(bins)
    speed = np.max(np.abs(step), axis=1) / seconds
    moving = joined & ~_slow(speed, seconds, stream.step)
    turns = np.einsum("ij,ij->i", step[1:], step[:-1]) < 0.0  # at bin k + 1
    ends = [_ends(run, moving, joined) for run in _runs(moving, turns)]
    legs = [_leg(bins, *end) for end in ends if _travel(bins, *end[:2]) >= LEAST_MOVE]
    segment = np.array([leg.segment for leg in legs], np.int64)
    times = np.array([(leg.start_s, leg.end_s) for leg in legs]).reshape(-1, 2)
    host = zip(legs, stream.to_host_ns(segment, times).tolist(), strict=True)
    return [replace(leg, start_host_ns=start, end_host_ns=end) for leg, (start, end) in host]


def _steps(bins: Bins) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return the change of the mean (b − 1, j) from each bin to the next, its time [s], and whether it is one motion."""
    middle = 0.5 * (bins.t_first_s + bins.t_last_s)
    seconds = np.diff(middle)
    joined = (np.diff(bins.segment) == 0) & (seconds > 0.0)
    joined &= bins.t_first_s[1:] - bins.t_last_s[:-1] < LONGEST_SILENCE_S
    return np.diff(bins.mean, axis=0), np.where(joined, seconds, 1.0), joined


def _slow(speed: Floats, seconds: Floats, quantum: Floats) -> NDArray[np.bool_]:
    """Return the steps (b − 1,) at which a leg ends."""
    reach = max(1, round(HORIZON_S / float(np.median(seconds))))
    before, after = _highest_before(speed, reach), _highest_before(speed[::-1], reach)[::-1]
    least = SLOW + np.max(quantum, initial=0.0) / seconds
    return np.asarray((speed <= least) | (speed <= SLOW_SHARE * np.minimum(before, after)))


def _highest_before(speed: Floats, reach: int) -> Floats:
    """Return the maximum of each step and the ``reach`` steps before it."""
    highest = speed.copy()
    for k in range(1, min(reach, speed.size - 1) + 1):
        np.maximum(highest[k:], speed[:-k], out=highest[k:])
    return highest


def _runs(moving: NDArray[np.bool_], turns: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last step of each run of moving steps, split at turns."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moving, [False]]).astype(np.int8)))
    runs = []
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        cuts = [first, *(np.flatnonzero(turns[first : end - 1]) + first + 1).tolist(), end]
        runs += [(a, b - 1) for a, b in pairwise(cuts)]
    return runs


def _ends(run: tuple[int, int], moving: NDArray[np.bool_], joined: NDArray[np.bool_]) -> tuple[int, int, bool]:
    """Return the first and last bin of these steps, including the slow step on each side, and whether the readings end
    there.

    In the slow steps the robot was at the ends of its motion.
    """
    first, last = run
    begins, ends = first > 0 and bool(joined[first - 1]), last + 1 < joined.size and bool(joined[last + 1])
    a = first - int(begins and not moving[first - 1])
    b = last + 1 + int(ends and not moving[last + 1])
    return a, b, not (begins and ends)


def _travel(bins: Bins, a: int, b: int) -> float:
    return float(np.max(np.abs(bins.mean[b] - bins.mean[a])))


def _leg(bins: Bins, a: int, b: int, cut: bool) -> Leg:
    start, end = float(bins.t_first_s[a]), float(bins.t_last_s[b])
    return Leg(int(bins.segment[a]), start, end, bins.mean[a], bins.mean[b], cut)
