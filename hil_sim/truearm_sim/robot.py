"""A robot controller that visits the poses of a plan: motion as a function of time, and what it reports.

Every move is straight in joint space along the quintic s(τ) = 10τ³ − 15τ⁴ + 6τ⁵, the shortest that keeps all joints within
their speeds and accelerations (its peaks are 15/8·Δq/T and 10/√3·Δq/T²). A dwell is counted from the end of the commanded
motion. The joints then stand where the servo holds them, an error of its own at each pose, and ring for some tenths of a
second about it. Where the ball-bar has to be taken off (between two pairings, or because it would run out of travel on
the way) the robot waits for the operator before the dwell is counted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from truearm.files.plan import Plan
from truearm.types import Floats
from truearm_sim.clocks import Clock

SPEED = np.deg2rad([82.0, 54.0, 122.0, 228.0, 241.0, 228.0])  # rad/s, a PUMA 560's
ACCELERATION = np.array([4.0, 4.0, 6.0, 15.0, 15.0, 15.0])  # rad/s²
STEP = 2.0 * np.pi / 2**17  # rad, what a joint reading is a multiple of: 4.8e-5
SERVO_SIGMA = 5e-5  # rad, where a joint comes to rest about its command
DWELL = 2.0  # s
PAUSE = 4.0  # s, for the operator to take the bar off and on
READY = 0.5  # s, of the pause: the bar is on, hands are off
RING_HZ = 9.0
RING_DECAY = 0.05  # s
RING_SHARE = 0.1  # of the deflection that the peak acceleration would cause: the quintic ends softly
SETTLED = 10.0 * RING_DECAY  # s; what is left then moves the endpoint by at most 30 nm


@dataclass(frozen=True)
class Controller:
    """The motion of a whole plan, as arrays over its n poses; all times are true time [s].

    Pose i is approached from ``move_start[i]`` to ``arrive[i]``; its dwell lasts from ``dwell_start[i]`` to
    ``dwell_end[i]``. Where ``remount[i]``, the bar is off from the end of the dwell before until READY before this one.
    """

    plan: Plan
    clock: Clock
    rate: float  # readings per controller second
    remount: NDArray[np.bool_]
    move_start: Floats
    arrive: Floats
    dwell_start: Floats
    dwell_end: Floats
    q_held: Floats  # (n, j) where the servo holds each pose
    ring: Floats  # (n, j) amplitude after arrival

    @classmethod
    def from_plan(
        cls,
        plan: Plan,
        clock: Clock | None = None,
        seed: int = 0,
        rate: float = 50.0,
        remount: NDArray[np.bool_] | None = None,
    ) -> Controller:
        """The motion of ``plan``; ``remount`` (n,) adds poses before which the bar is taken off to new pairings."""
        n, j = plan.q.shape
        rng = np.random.default_rng([seed, 0x5E120])
        off = new_pairing(plan) if remount is None else remount | new_pairing(plan)
        delta = np.diff(plan.q, axis=0, prepend=plan.q[:1])
        travel = move_durations(delta)
        stay = DWELL + PAUSE * off
        dwell_end = np.cumsum(travel + stay)
        return cls(
            plan=plan,
            clock=clock or Clock(),
            rate=rate,
            remount=off,
            move_start=dwell_end - stay - travel,
            arrive=dwell_end - stay,
            dwell_start=dwell_end - DWELL,
            dwell_end=dwell_end,
            q_held=plan.q + SERVO_SIGMA * rng.standard_normal((n, j)),
            ring=ring_amplitudes(delta, travel),
        )

    @property
    def duration(self) -> float:
        """End of the last dwell [s]."""
        return float(self.dwell_end[-1])

    @property
    def dwells(self) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Start and end (n,) [s] and pose index (n,) of the dwells, with the bar on and hands off."""
        return self.dwell_start, self.dwell_end, np.arange(len(self.plan))

    def pose_index(self, t: Floats) -> NDArray[np.int64]:
        """Index of the pose that the robot goes to or stands at, at each time t (m,)."""
        return np.clip(np.searchsorted(self.move_start, t, side="right") - 1, 0, len(self.plan) - 1)

    def bar_is_on(self, t: Floats) -> NDArray[np.bool_]:
        """Whether the bar connects chuck and sphere at each time t (m,)."""
        i = self.pose_index(t)
        return ~self.remount[i] | (t >= self.dwell_start[i] - READY)

    def is_settled(self, t: Floats) -> NDArray[np.bool_]:
        """Whether the joints stand at ``q_held`` of their pose, to 30 nm at the endpoint, at each time t (m,)."""
        return np.asarray(t >= self.arrive[self.pose_index(t)] + SETTLED)

    def q_commanded(self, t: Floats) -> Floats:
        """Commanded joints (m, j) at times t (m,)."""
        return self._between(self.plan.q, t)

    def q_true(self, t: Floats) -> Floats:
        """Joints as they are (m, j) at times t (m,): servo error and ringing included."""
        i = self.pose_index(t)
        since = np.maximum(t - self.arrive[i], 0.0)
        wave = np.exp(-since / RING_DECAY) * np.sin(2.0 * np.pi * RING_HZ * since)
        wave[since > SETTLED] = 0.0
        return np.asarray(self._between(self.q_held, t) + self.ring[i] * wave[:, None])

    def _between(self, q: Floats, t: Floats) -> Floats:
        """Where the quintics between the rows of q (n, j) are at times t (m,)."""
        i = self.pose_index(t)
        before = np.maximum(i - 1, 0)
        share = (t - self.move_start[i]) / np.maximum(self.arrive[i] - self.move_start[i], 1e-9)
        return np.asarray(q[before] + quintic(np.clip(share, 0.0, 1.0))[:, None] * (q[i] - q[before]))

    def ticks(self, t0: float, t1: float) -> tuple[Floats, NDArray[np.int64]]:
        """Controller times [s] of the readings with t0 ≤ true time < t1, and their numbers since true time 0."""
        numbers = [int(np.ceil(self.clock.reading(t) * self.rate)) for t in (0.0, t0, t1)]
        ticks = np.arange(numbers[1], numbers[2])
        return ticks / self.rate, ticks - numbers[0]

    def readings(self, t0: float, t1: float) -> tuple[Floats, Floats]:
        """Controller times (m,) [s] and joint readings (m, j) [rad] with t0 ≤ true time < t1, any chunks alike."""
        t_robot, _ = self.ticks(t0, t1)
        return t_robot, quantised(self.q_true(self.clock.true(t_robot)))

    def reading_lines(self, t0: float, t1: float) -> tuple[Floats, list[bytes]]:
        """True times (m,) [s] and JSON lines, each ending with a line feed, as the controller sends them.

        ``t`` is controller time [s], ``seq`` counts from the start, ``q`` is measured, ``q_cmd`` commanded [rad].
        """
        t_robot, numbers = self.ticks(t0, t1)
        t = self.clock.true(t_robot)
        measured, commanded = quantised(self.q_true(t)), self.q_commanded(t)
        vector = "[" + ",".join(["%.9f"] * measured.shape[1]) + "]"
        line = '{"t":%.6f,"seq":%d,"q":' + vector + ',"q_cmd":' + vector + "}\n"
        rows = zip(t_robot.tolist(), numbers.tolist(), measured.tolist(), commanded.tolist(), strict=True)
        return t, [(line % (when, number, *q, *q_cmd)).encode() for when, number, q, q_cmd in rows]


def new_pairing(plan: Plan) -> NDArray[np.bool_]:
    """True (n,) where the bar connects something else than at the pose before; the first pose is one of them."""
    ids = np.stack([plan.bar, plan.chuck, plan.sphere])
    return np.concatenate([[True], np.any(ids[:, 1:] != ids[:, :-1], axis=0)])


def move_durations(delta: Floats) -> Floats:
    """Shortest durations (n,) [s] of quintics over delta (n, j) [rad]."""
    size, j = np.abs(delta), delta.shape[1]
    by_speed = 15.0 / 8.0 * size / SPEED[:j]
    by_acceleration = np.sqrt(10.0 / np.sqrt(3.0) * size / ACCELERATION[:j])
    return np.asarray(np.maximum(by_speed, by_acceleration).max(axis=1))


def quintic(share: Floats) -> Floats:
    """10τ³ − 15τ⁴ + 6τ⁵ for the share τ of a move's duration, 0 to 1."""
    return np.asarray(share**3 * (10.0 + share * (6.0 * share - 15.0)))


def ring_amplitudes(delta: Floats, durations: Floats) -> Floats:
    """Amplitudes (n, j) [rad] after moves of delta (n, j): RING_SHARE of peak acceleration over ω²."""
    peak = 10.0 / np.sqrt(3.0) * delta / np.maximum(durations, 1e-3)[:, None] ** 2
    amplitudes: Floats = RING_SHARE * peak / (2.0 * np.pi * RING_HZ) ** 2
    return amplitudes


def quantised(q: Floats) -> Floats:
    """Joint readings: the nearest multiple of STEP."""
    return np.asarray(STEP * np.round(q / STEP))
