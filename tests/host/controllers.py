"""A robot's controller for tests: moves, outputs, waits and messages of a program with their times.

``urscript_machine`` and ``rapid_machine`` execute programs on it. On a driven line, the joints on the way come from its
own inverse kinematics.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation, Slerp
from tests.host.puma_bench import damped

from truearm.model.chain import forward, joint_jacobian

SAMPLES = 55  # of a line: both ends, and all of 18 equal parts and of their thirds


class ProgramFault(Exception):
    """An error that stops a controller."""


@dataclass(frozen=True)
class Move:
    """A move from t0 to t1 [s]: ``joints`` straight in joint space, ``line`` straight in space.

    A move with unknown duration and speed, such as the first one from any position of the arm, takes no time.
    """

    kind: str
    t0: float
    t1: float
    q: np.ndarray  # (j,) at its end
    pose: np.ndarray  # (4, 4) of the TCP at its end
    speed: float  # m/s requested, nan for a time
    path: np.ndarray  # (SAMPLES, j) of a line, evenly spaced in time; otherwise (0, j)
    configuration: tuple[float, ...] = ()  # RAPID's, of its target


@dataclass
class Controller:
    """An arm's controller with one output and one input to the box, which answers after ``answer_s`` (None: never)."""

    chain: object
    params: np.ndarray
    q: np.ndarray | None = None  # the arm's position before the first move is unknown
    answer_s: float | None = 0.015
    t: float = 0.0
    tcp: np.ndarray = field(default_factory=lambda: np.eye(4))
    moves: list[Move] = field(default_factory=list)
    outputs: list[tuple[float, bool]] = field(default_factory=list)
    configuration: tuple[float, ...] = ()  # of the next moves
    said: list[tuple[int, str]] = field(default_factory=list)  # what the operator confirms, after this many moves

    def pose_of(self, q):
        return forward(self.chain, self.params, q[None])[0] @ self.tcp

    def solved(self, pose, q):
        """Return joints near q at which the TCP has a pose."""
        flange = pose @ np.linalg.inv(self.tcp)
        for _ in range(60):
            here = forward(self.chain, self.params, q[None])[0]
            spin = 0.5 * np.cross(here[:3, :3], flange[:3, :3], axis=0).sum(axis=1)
            error = np.concatenate([flange[:3, 3] - here[:3, 3], spin])
            if np.abs(error).max() < 1e-10:
                return q
            jacobian = joint_jacobian(self.chain, self.params, q[None])
            near = np.abs(error).max() < 0.05
            q = q + (np.linalg.solve(jacobian[0], error) if near else damped(jacobian, error[None])[0])
        raise ProgramFault("a target out of reach")

    def move_joints(self, q, seconds=0.0):
        q = np.asarray(q, dtype=float)
        nothing = np.zeros((0, q.size))
        self.moves.append(
            Move("joints", self.t, self.t + seconds, q, self.pose_of(q), float("nan"), nothing, self.configuration)
        )
        self.t, self.q = self.t + seconds, q

    def move_line(self, pose, speed):
        """Move at constant speed; the orientation turns evenly."""
        if self.q is None:
            raise ProgramFault("a straight line from nowhere")
        start = self.pose_of(self.q)
        seconds = float(np.linalg.norm(pose[:3, 3] - start[:3, 3])) / speed
        share = np.linspace(0.0, 1.0, SAMPLES)
        turn = Slerp([0.0, 1.0], Rotation.from_matrix([start[:3, :3], pose[:3, :3]]))(share).as_matrix()
        path = [self.q]
        for k in range(1, SAMPLES):
            here = np.eye(4)
            here[:3, :3], here[:3, 3] = turn[k], start[:3, 3] + share[k] * (pose - start)[:3, 3]
            path.append(self.solved(here, path[-1]))
        self.moves.append(
            Move("line", self.t, self.t + seconds, path[-1], pose, speed, np.array(path), self.configuration)
        )
        self.t, self.q = self.t + seconds, path[-1]

    def put_out(self, level):
        if not self.outputs or self.outputs[-1][1] != level:
            self.outputs.append((self.t, level))

    def answered(self):
        """Return the input: the box repeats the output after a delay, starting low."""
        if self.answer_s is None:
            return False
        seen = [level for t, level in self.outputs if t + self.answer_s <= self.t + 1e-9]
        return bool(seen and seen[-1])

    def wait_for(self, level, longest):
        """Wait until the input has a level."""
        end = self.t + longest
        while self.answered() != level and self.t < end:
            self.t += 0.001

    def held(self):
        """Return (t0, t1) of every period with the output high."""
        after = [t for t, _ in self.outputs[1:]] + [self.t]
        return [(t0, t1) for (t0, level), t1 in zip(self.outputs, after, strict=True) if level]

    def moves_within(self, t0, t1):
        """Return moves that take place between two times."""
        return [move for move in self.moves if move.t0 < t1 - 1e-9 and move.t1 > t0 + 1e-9]


def pose_from(place, turn):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), place
    return pose
