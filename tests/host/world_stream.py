"""A simulated world's session as messages, without a box and a recorder: for many runs.

Frames are written by ``truearm_wire``, as in ``session_stream.py``. The box's samples and the robot's lines are the
world's.
"""

from __future__ import annotations

import json

import numpy as np
from session_stream import Box, ident_of

from truearm.types import Message
from truearm.workflows.record import plan_rows
from truearm_sim import sensors
from truearm_sim.world import World
from truearm_wire import messages as wire
from truearm_wire.cbor import Tag

PERIOD_NS = sensors.period_ns(16384)
BLOCK = 13
HOST_NS = 5_000_000_000_000  # the host's clock when the world begins


class WorldBox(Box):
    """A box with the world's clock."""

    world: World

    def document(self) -> dict[str, object]:
        channels = self.world.box_config(16384)["channels"]
        stream = {"id": 0, "name": "adc", "period_ns": PERIOD_NS, "osr": 16384, "channels": channels}
        return ident_of([{**stream, "group_delay_ns": sensors.group_delay_ns(16384)}], self.boot_id)

    def device_us(self, t_host_ns: float) -> int:
        return int(1e6 * self.world.clocks.device.reading(1e-9 * (t_host_ns - HOST_NS)))


def messages_of(world: World, seed: int = 0) -> list[Message]:
    """Return all messages from box and robot, and the plan."""
    rng = np.random.default_rng([seed, 0x5EED])
    box = WorldBox()
    box.world = world
    box.ident(HOST_NS)
    device_begin_ns = round(1e9 * world.clocks.device.reading(0.0))
    blocks = int(1e9 * world.duration / PERIOD_NS) // BLOCK
    counts, stamps = world.samples(0, blocks * BLOCK, device_begin_ns, PERIOD_NS)
    times = world.clocks.device.true(1e-6 * stamps[::BLOCK].astype(float))
    next_exchange_s = 0.0
    for k, t in enumerate(times.tolist()):
        arrival = HOST_NS + round(1e9 * t) + BLOCK * PERIOD_NS + 400_000
        samples = Tag(78, np.ascontiguousarray(counts[BLOCK * k : BLOCK * (k + 1)], "<i4").tobytes())
        box.frame("adc", arrival, wire.DATA, 0, BLOCK * k, int(stamps[BLOCK * k]), PERIOD_NS, samples, 0)
        if t >= next_exchange_s:
            there, back = (120e3 + rng.exponential(1e5) for _ in range(2))
            box.sync(arrival, there, back)
            next_exchange_s = t + 0.25
    sent_ns, lines = world.robot_lines(0, world.robot_end_ns)
    late = 300e3 + rng.exponential(200e3, len(lines))
    robot_ns = np.maximum.accumulate(HOST_NS + sent_ns + late.astype(np.int64))
    robot = [Message("/robot/joints", int(t), line) for t, line in zip(robot_ns, lines, strict=True)]
    plan = [Message("/plan", 0, json.dumps(row).encode()) for row in plan_rows(world.controller.plan)]
    return plan + sorted(box.messages + robot, key=lambda message: message.t_host_ns)
