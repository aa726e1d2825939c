"""The operator's display for a made-up session, second by second."""

from datetime import date

import cbor2
import numpy as np
from record_box import ident

from truearm.live.state import LiveState, SessionProgress
from truearm.record.operator import Counters, Status
from truearm.session.frames import Data, decode_ident
from truearm.session.joint_format import JointLine
from truearm.types import BallBar, Point, Rig

S = 1_000_000_000
BLOCK_NS = 12_779_520
NOISE = 2e-6  # m
MM = 1e-6  # m per count in the box below: scale 1e-3 of a volt, 1e-3 m per volt
TODAY = date(2026, 11, 22)

RIG = Rig(
    bars={
        "b46": BallBar("b46", zero=0.46, gain=1.0, travel=0.075, sigma=8.4e-5),
        "b61": BallBar("b61", zero=0.61, gain=1.0, travel=0.075, sigma=8.4e-5),
    },
    chucks={name: Point(name, (0.0, 0.0, 0.0)) for name in ("c1", "c2")},
    spheres={"s1": Point("s1", (0.0, 0.0, 0.0))},
)


def box(**lvdt):
    said = ident(1)
    channel = {
        "name": "lvdt",
        "calibration": {"unit": "m", "poly": [[0, 0], [1, -3]], "serial": "7", "date": "2026-05-01"},
    }
    said["streams"][0]["channels"][0].update({"scale": [1, -3]} | channel | lvdt)
    return decode_ident(cbor2.dumps(said))


def plan(*pairings, joints=2):
    """Return one row per pairing (bar, chuck), at joints 0.5 rad apart."""
    return [
        {"pose": k, "shell": "", "bar": bar, "chuck": chuck, "sphere": "s1", "q": [0.5 * k] * joints}
        for k, (bar, chuck) in enumerate(pairings)
    ]


class Session:
    """Updates a state: the bar at ``position`` [m], the robot at ``q``, second by second."""

    def __init__(self, rows=(), mounted=None, robot=True, rig=RIG):
        self.state = LiveState(SessionProgress(list(rows), dict(mounted or {})), rig, robot)
        self.state.approve(box())
        self.state.messages.clear()
        self.t = 1000 * S
        self.robot = robot
        self.burst = 1  # ns; arrivals are at multiples of it
        self.n0 = 0
        self.rng = np.random.default_rng(3)
        self.said, self.wishes = [], []
        self.position, self.q = 0.0, np.zeros(2)

    def run(self, seconds, speed=0.0, q_speed=0.0):
        """Run for some seconds. ``speed`` [m/s] of the bar, ``q_speed`` [rad/s] of every joint."""
        for k in range(round(seconds * S / BLOCK_NS)):
            if k % 20 == 0:
                self.look()
            within = np.arange(13) * BLOCK_NS * 1e-9 / 13
            extension = self.position + speed * within + NOISE * self.rng.standard_normal(13)
            counts = np.zeros((13, 4), "<i4")
            counts[:, 0] = np.rint(extension / MM)
            data = Data(0, 0, self.n0, self.t // 1000, BLOCK_NS // 13, counts.tobytes(), 0)
            self.n0 += 13
            self.t += BLOCK_NS
            self.position += speed * BLOCK_NS * 1e-9
            self.q = self.q + q_speed * BLOCK_NS * 1e-9
            arrival = -(-self.t // self.burst) * self.burst
            self.state.block(arrival, data)
            if self.robot:
                q = self.q + 1e-5 * self.rng.standard_normal(self.q.size)
                self.state.reading(arrival, JointLine(t=1e-9 * self.t, q=q.tolist()))
        self.look()

    def look(self, **more):
        """Show the view; alarms become messages."""
        self.state.status(self.status(**more))
        assert not self.state.trouble
        self.said += self.state.messages
        self.state.messages.clear()

    def type(self, text):
        self.state.typed.append(text)
        self.wishes += self.state.wishes()

    def dwell(self, seconds=2.5):
        """Move to the next pose for half a second, half a radian and 5 mm away, and stop."""
        self.run(0.5, speed=0.01, q_speed=1.0)
        self.run(seconds)

    def events(self, kind):
        self.wishes += self.state.wishes()
        return [wish.fields for wish in self.wishes if wish.kind == kind]

    def status(self, **more):
        usual = {"robot_ok": True if self.robot else None, "counters": Counters(), "robot_age_s": 0.02}
        return Status(1e-9 * self.t - 1000.0, "recording", 312.0, **(usual | more))

    def row(self, name):
        self.look()
        return next(row for row in self.state.rows if row.name == name)


PAIRS = [("b46", "c1"), ("b46", "c1"), ("b61", "c1"), ("b61", "c2")]
