"""A robot controller that visits the poses of a plan: motion as a function of time, and its readings.

Every move is straight in joint space along the quintic s(τ) = 10τ³ − 15τ⁴ + 6τ⁵, the shortest that keeps all joints
within their speeds and accelerations (its peaks are 15/8·Δq/T and 10/√3·Δq/T²). A dwell is counted from the end of the
commanded motion. The joints then rest where the servo holds them, with a new error at each stop, and ring about that
position for some tenths of a second. A command to the current position causes no motion. ``Arm`` can make the joints
slow, compliant and worn. Where the ball-bar must be removed (between two pairings, or because it would exceed its
travel on the way), the robot stops with its last joint turned back by MOUNTING, waits there for the operator, and
completes the move.

A plan may contain more than dwells. The robot stops at via points but does not wait there. Lines are driven along
``paths``, from rest to rest. Before the first drive along another line the robot waits for the operator to place the
device there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats, Plan
from truearm_sim.arm import Arm, last_direction
from truearm_sim.clocks import Clock
from truearm_sim.paths import Path

STEP = 2.0 * np.pi / 2**19  # rad, resolution of a joint reading: 1.2e-5, a 19-bit encoder
SERVO_SIGMA = 5e-5  # rad, deviation of a joint at rest from its command
DWELL = 2.0  # s
TURN = 0.5  # s of rest at a line's ends
MOUNTING = 0.05  # rad; moves a sphere by a few millimetres, yet the pause is not taken for a dwell of the plan
PAUSE = 4.0  # s, for the operator to mount the bar
READY = 0.5  # s, end of the pause: the bar is on, hands are off
VELOCITY_S = 1e-3  # interval over which a velocity is computed
RING_HZ = 9.0
RING_DECAY = 0.05  # s
RING_SHARE = 0.1  # of the deflection that the peak acceleration would cause: the quintic ends smoothly
SETTLED = 10.0 * RING_DECAY  # s; the remaining ringing moves the endpoint by at most 30 nm
BLOCK = 256  # lines made together


Inputs = Callable[[Floats], NDArray[np.int64]]


class States(NamedTuple):
    """k readings of a controller: true time and its own [s], numbers, joints [rad], digital inputs as bits."""

    t: Floats  # (k,)
    t_robot: Floats  # (k,)
    number: NDArray[np.int64]  # (k,)
    q: Floats  # (k, j) measured
    q_cmd: Floats  # (k, j) commanded
    qd: Floats  # (k, j) rad/s, measured
    qd_cmd: Floats  # (k, j) rad/s, commanded
    inputs: NDArray[np.int64]  # (k,)


@dataclass(frozen=True)
class Controller:
    """The motion of a complete plan, as arrays over its m stops; all times are true time [s].

    Stop i is approached from ``move_start[i]`` to ``arrive[i]`` and left at ``leave[i]``. It is the dwell at a pose of
    the plan or, where ``mounting[i]``, the wait before it, with the bar off from ``move_start[i]`` until READY before
    ``leave[i]``. The joints are reported as they were ``delay`` [s] earlier.
    """

    plan: Plan
    clock: Clock
    rate: float  # readings per controller second
    pose: NDArray[np.int64]  # (m,) index in the plan
    mounting: NDArray[np.bool_]  # (m,)
    move_start: Floats  # (m,)
    arrive: Floats  # (m,)
    leave: Floats  # (m,)
    q: Floats  # (m, j) commanded
    q_held: Floats  # (m, j) joints held by the servo
    ring: Floats  # (m, j) amplitude after arrival
    direction: Floats  # (m, j) in which each joint last moved: −1, 0 (never) or 1
    arm: Arm
    seed: int
    paths: Mapping[int, Path] = field(default_factory=dict)  # to the rows of the plan that are lines
    delay: float = 0.0
    # The latest block of lines by its number, as true times and lines: callers request the next few of them.
    _made: dict[int, tuple[Floats, list[bytes]]] = field(default_factory=dict, init=False, repr=False, compare=False)

    @classmethod
    def from_plan(
        cls,
        plan: Plan,
        clock: Clock | None = None,
        seed: int = 0,
        rate: float = 50.0,
        remount: NDArray[np.bool_] | None = None,
        arm: Arm | None = None,
        paths: Mapping[int, Path] | None = None,
        delay: float = 0.0,
    ) -> Controller:
        """Return the motion of ``plan``.

        ``remount`` (n,) adds poses before which the bar is removed to those of new pairings.

        ``paths``: of every row that is a line.
        """
        paths, arm = paths or {}, arm or Arm()
        off = new_pairing(plan) if remount is None else remount | new_pairing(plan)
        pose = np.repeat(np.arange(len(plan)), 1 + off)
        mounting = np.concatenate([pose[1:] == pose[:-1], [False]])
        q = plan.q[pose]
        q[mounting, -1] -= MOUNTING
        delta = np.diff(q, axis=0, prepend=q[:1])
        durations = arm.durations(delta)
        ring = ring_amplitudes(delta, durations)
        for stop in np.flatnonzero(plan.lines[pose]):
            durations[stop], ring[stop] = paths[int(pose[stop])].seconds, 0.0
        stay = np.where(mounting, PAUSE, stays(plan)[pose])
        leave = np.cumsum(durations + stay)
        servo = np.random.default_rng([seed, 0x5E120]).standard_normal(q.shape)
        went = np.maximum.accumulate(np.where(np.any(delta != 0.0, axis=1), np.arange(len(q)), 0))
        return cls(
            plan=plan,
            clock=clock or Clock(),
            rate=rate,
            pose=pose,
            mounting=mounting,
            move_start=leave - stay - durations,
            arrive=leave - stay,
            leave=leave,
            q=q,
            q_held=q + SERVO_SIGMA * servo[went],
            ring=ring,
            direction=last_direction(delta),
            arm=arm,
            seed=seed,
            paths=paths,
            delay=delay,
        )

    @property
    def duration(self) -> float:
        """Return the end of the last dwell [s]."""
        return float(self.leave[-1])

    @property
    def dwells(self) -> NDArray[np.int64]:
        """Return the stops (n,) that are the dwells at the plan's n poses."""
        return np.flatnonzero(~self.mounting & self.plan.dwells[self.pose])

    @property
    def is_line(self) -> NDArray[np.bool_]:
        """Return a mask (m,) of the stops to which a line is driven."""
        return np.asarray(self.plan.lines[self.pose])

    def stop_index(self, t: Floats) -> NDArray[np.int64]:
        """Return the index of the stop that the robot approaches or has reached, at each time t (k,)."""
        return np.clip(np.searchsorted(self.move_start, t, side="right") - 1, 0, len(self.pose) - 1)

    def bar_is_on(self, t: Floats) -> NDArray[np.bool_]:
        """Return whether the bar connects chuck and sphere at each time t (k,)."""
        i = self.stop_index(t)
        return np.asarray((~self.mounting[i] | (t >= self.leave[i] - READY)) & (self.plan.bar[self.pose[i]] != ""))

    @property
    def q_rest(self) -> Floats:
        """Return the joints (m, j) at rest: the links behind their encoders if the arm is worn."""
        return np.asarray(self.q_held + self.arm.behind(self.direction) + self.arm.apart(self.q_held))

    def is_settled(self, t: Floats) -> NDArray[np.bool_]:
        """Return whether the joints are at ``q_rest`` of their stop, to 30 nm at the endpoint, at each time t (k,)."""
        return np.asarray(t >= self.arrive[self.stop_index(t)] + self.arm.rest_s(SETTLED))

    def q_commanded(self, t: Floats) -> Floats:
        """Return the commanded joints (k, j) at times t (k,)."""
        return self._between(self.q, t)

    def q_true(self, t: Floats) -> Floats:
        """Return the true joints (k, j) at times t (k,): with servo error, ringing, backlash and other errors."""
        i = self.stop_index(t)
        swing = self.arm.swinging(t - self.arrive[i])[:, None] * self.direction[i]
        driven = self.q_driven(t)
        return np.asarray(driven + self.arm.behind(self.direction[i]) + swing + self.arm.apart(driven))

    def q_driven(self, t: Floats) -> Floats:
        """Return the joints at their encoders (k, j) at times t (k,): a reading without noise."""
        i = self.stop_index(t)
        since = np.maximum(t - self.arrive[i], 0.0)
        wave = np.exp(-since / RING_DECAY) * np.sin(2.0 * np.pi * RING_HZ * since)
        wave[since > SETTLED] = 0.0
        share = quintic(
            np.clip((t - self.move_start[i]) / np.maximum(self.arrive[i] - self.move_start[i], 1e-9), 0.0, 1.0)
        )
        short = self.arm.short(t - self.arrive[i], share)[:, None] * self.direction[i]
        return np.asarray(self._between(self.q_held, t) + self.ring[i] * wave[:, None] + short)

    def _read(self, t: Floats, numbers: NDArray[np.int64]) -> Floats:
        """Return the joint readings (k, j) with these numbers at times t (k,)."""
        q = self.q_driven(t)
        return quantised(q + self.arm.reading_noise(self.seed, numbers, q.shape[1]))

    def way(self, t: Floats) -> Floats:
        """Return the distance covered by the target along its line (k,) [m] at times t (k,); 0 without a line."""
        i, out = self.stop_index(t), np.zeros(len(t))
        for stop in self._line_stops(i):
            at = i == stop
            out[at] = self.paths[int(self.pose[stop])].along(t[at] - self.move_start[stop])
        return out

    def _line_stops(self, i: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return those of the stops i (k,) to which a line is driven, each once."""
        return np.unique(i[self.is_line[i]]) if self.paths else np.empty(0, np.int64)

    def _between(self, q: Floats, t: Floats) -> Floats:
        """Return the position of the moves between the rows of q (m, j) at times t (k,)."""
        i = self.stop_index(t)
        before = np.maximum(i - 1, 0)
        share = (t - self.move_start[i]) / np.maximum(self.arrive[i] - self.move_start[i], 1e-9)
        out = np.asarray(q[before] + quintic(np.clip(share, 0.0, 1.0))[:, None] * (q[i] - q[before]))
        for stop in self._line_stops(i):
            at, path = i == stop, self.paths[int(self.pose[stop])]
            way = path.along(t[at] - self.move_start[stop])
            off = q[[stop - 1, stop]] - self.q[[stop - 1, stop]]
            out[at] = path.joints(way) + off[0] + (way / path.length)[:, None] * (off[1] - off[0])
        return out

    def numbers(self, t0: float, t1: float) -> tuple[int, int]:
        """Return the numbers since true time 0 of the first reading with t0 ≤ true time < t1, and after the last."""
        start, first, last = (self._tick(t) for t in (0.0, t0, t1))
        return first - start, last - start

    def _tick(self, t: float) -> int:
        return int(np.ceil(self.clock.reading(t) * self.rate))

    def _t_robot(self, numbers: NDArray[np.int64]) -> Floats:
        """Return the controller times (k,) [s] of the readings of these numbers (k,)."""
        return np.asarray((self._tick(0.0) + numbers) / self.rate)

    def readings(self, t0: float, t1: float) -> tuple[Floats, Floats]:
        """Return controller times (k,) [s] and readings (k, j) [rad] with t0 ≤ true time < t1, same for any chunks."""
        numbers = np.arange(*self.numbers(t0, t1))
        t_robot = self._t_robot(numbers)
        return t_robot, self._read(self.clock.true(t_robot) - self.delay, numbers)

    def states(self, t0: float, t1: float, inputs: Inputs | None = None) -> States:
        """Return the controller's readings with t0 ≤ true time < t1, the same for any chunks.

        ``inputs``: its digital inputs as bits (k,) at true times (k,), by default all 0.
        """
        numbers = np.arange(*self.numbers(t0, t1))
        t_robot = self._t_robot(numbers)
        t = self.clock.true(t_robot)
        late = t - self.delay
        after, before = late + VELOCITY_S / 2, late - VELOCITY_S / 2
        return States(
            t=t,
            t_robot=t_robot,
            number=numbers,
            q=self._read(late, numbers),
            q_cmd=self.q_commanded(late),
            qd=(self.q_driven(after) - self.q_driven(before)) / VELOCITY_S,
            qd_cmd=(self.q_commanded(after) - self.q_commanded(before)) / VELOCITY_S,
            inputs=np.zeros(t.size, dtype=np.int64) if inputs is None else inputs(t),
        )

    def reading_lines(self, t0: float, t1: float, inputs: Inputs | None = None) -> tuple[Floats, list[bytes]]:
        """Return true times (k,) [s] and JSON lines, each ending with a line feed, as the controller sends them.

        ``t`` is controller time [s], ``seq`` counts from the start, ``q`` is measured, ``q_cmd`` commanded [rad]. With
        ``inputs`` (see ``states``) the lines contain them too.
        """
        first, last = self.numbers(t0, t1)
        if inputs is not None:
            return self._lines(first, last, inputs)
        times, lines = [np.empty(0)], list[bytes]()
        for block in range(first // BLOCK, (last - 1) // BLOCK + 1):
            begin = BLOCK * block
            if block not in self._made:
                self._made.clear()
                self._made[block] = self._lines(begin, begin + BLOCK)
            t, made = self._made[block]
            times.append(t[max(first - begin, 0) : last - begin])
            lines += made[max(first - begin, 0) : last - begin]
        return np.concatenate(times), lines

    def _lines(self, first: int, last: int, inputs: Inputs | None = None) -> tuple[Floats, list[bytes]]:
        """Return true times and lines of these numbers (see ``reading_lines``)."""
        numbers = np.arange(first, last)
        t_robot = self._t_robot(numbers)
        t = self.clock.true(t_robot)
        measured, commanded = self._read(t - self.delay, numbers), self.q_commanded(t - self.delay)
        j = measured.shape[1]
        # Enough digits to show the readings' step in second differences of the printed values.
        line = '{"t":%.6f,"seq":%d,"q":[' + ",".join(["%.12f"] * j) + '],"q_cmd":[' + ",".join(["%.9f"] * j) + "]%s}\n"
        more = [""] * t.size if inputs is None else [f',"inputs":{bits}' for bits in inputs(t).tolist()]
        rows = zip(t_robot.tolist(), numbers.tolist(), measured.tolist(), commanded.tolist(), more, strict=True)
        return t, [(line % (when, number, *q, *q_cmd, rest)).encode() for when, number, q, q_cmd, rest in rows]


def new_pairing(plan: Plan) -> NDArray[np.bool_]:
    """Return True (n,) where a bar connects other items than at the previous row, and at the first row with a bar."""
    ids = np.stack([plan.bar, plan.chuck, plan.sphere])
    return np.asarray(np.concatenate([[True], np.any(ids[:, 1:] != ids[:, :-1], axis=0)]) & (plan.bar != ""))


def stays(plan: Plan) -> Floats:
    """Return the duration of the robot's rest at each row (n,) [s].

    Before the first drive along another line it includes the operator's PAUSE.
    """
    begins = np.append(plan.lines[1:], False) & ~plan.lines
    drives = np.flatnonzero(plan.lines)
    new = drives[np.append(True, plan.line[drives[1:]] != plan.line[drives[:-1]])] if drives.size else drives
    out = np.select([plan.dwells, plan.lines | begins], [DWELL, TURN], 0.0)
    out[new - 1] += PAUSE
    return out


def quintic(share: Floats) -> Floats:
    """Return 10τ³ − 15τ⁴ + 6τ⁵ for the share τ of a move's duration, 0 to 1."""
    return np.asarray(share**3 * (10.0 + share * (6.0 * share - 15.0)))


def ring_amplitudes(delta: Floats, durations: Floats) -> Floats:
    """Return amplitudes (n, j) [rad] after moves of delta (n, j): RING_SHARE of peak acceleration over ω²."""
    peak = 10.0 / np.sqrt(3.0) * delta / np.maximum(durations, 1e-3)[:, None] ** 2
    amplitudes: Floats = RING_SHARE * peak / (2.0 * np.pi * RING_HZ) ** 2
    return amplitudes


def quantised(q: Floats) -> Floats:
    """Return joint readings: the nearest multiple of STEP."""
    return np.asarray(STEP * np.round(q / STEP))
