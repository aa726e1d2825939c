"""The levels at which a simulated box runs. The hardware differs; tests that use these levels do not."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cbor2
import numpy as np
from mcap.reader import make_reader
from tests.end_to_end.conftest import interpreter, lab_with
from tests.wire_frames import data_frame

from truearm.record.recorder import RecordOptions, RecordSummary, record
from truearm.record.session_writer import SessionWriter
from truearm.session.frames import Ident
from truearm.session.session_file import open_session
from truearm.session.streams import BoxReader
from truearm_sim.chip import ChipBox
from truearm_sim.hardware import Edge, PowerOn
from truearm_sim.lab import Lab
from truearm_sim.simbox import Fault, SimulatedBox
from truearm_sim.vmbox import VmBox
from truearm_sim.world import Setup, World, standard_plan
from truearm_wire import messages as wire

MAG_PERIOD_NS = 983_040


def vm() -> PowerOn:
    """Return the firmware in a real MicroPython with a simulated board."""
    return partial(VmBox, interpreter())


def chip() -> PowerOn:
    """Return the image built by `make uf2`, in the emulator."""
    return ChipBox


LEVELS = {"vm": vm, "chip": chip}
READY_S = 4.0  # of lab time: at both levels the box has booted (the chip needs 3.3 s) and no fault has occurred yet


@dataclass
class Session:
    """The data that a box sent during a recording, and the world that it measured."""

    path: Path
    summary: RecordSummary
    world: World
    box: SimulatedBox

    def frames(self, topic: str) -> list[list]:
        """Return the frames of a topic, decoded, in order."""
        with self.path.open("rb") as f:
            return [cbor2.loads(m.data) for _, _, m in make_reader(f).iter_messages(topics=[topic])]

    def blocks(self, stream: int) -> list:
        """Return the data frames of a stream."""
        with self.path.open("rb") as f:
            topic = ("/box/adc", "/box/mag")[stream]
            return [data_frame(m.data) for _, _, m in make_reader(f).iter_messages(topics=[topic])]

    def heartbeats(self) -> list[dict[str, int]]:
        """Return the heartbeats' elements by name."""
        names = wire.names(wire.HEARTBEAT)
        return [dict(zip(names, frame[1:], strict=True)) for frame in self.frames("/box/heartbeat")]

    def counters(self) -> dict[str, int]:
        """Return the counters of the last heartbeat."""
        return self.heartbeats()[-1]

    def ident(self) -> Ident:
        """Return the box's ident, as read by the host."""
        reader = BoxReader()
        for messages in open_session(self.path).batches():
            reader.feed(messages)
        reader.finish()
        ident = reader.segment.ident
        assert ident is not None
        return ident


def samples(blocks: list, channels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return counts (n, channels), stamps (n,) [µs, times of the samples by their block's] and indices (n,)."""
    counts = [np.frombuffer(block.samples, "<i4").reshape(-1, channels) for block in blocks]
    index = [block.n0 + np.arange(len(c)) for block, c in zip(blocks, counts, strict=True)]
    within = [np.arange(len(c)) * block.period_ns / 1000 for block, c in zip(blocks, counts, strict=True)]
    stamps = [block.t0_us + w for block, w in zip(blocks, within, strict=True)]
    return np.concatenate(counts), np.concatenate(stamps), np.concatenate(index)


def lab_of(
    level: str,
    *,
    seed: int = 5,
    faults: Sequence[Fault] = (),
    edges: Sequence[Edge] = (),
    mag_period_ns: int = MAG_PERIOD_NS,
    lost_stops: float = 0.0,
    poses: int = 9,
    world: World | None = None,
) -> AbstractContextManager[Lab]:
    """Return a lab with a box of this level, both of whose sources are on.

    It has ``poses`` with each bar, about three seconds each, or a world.
    """
    if world is None:
        world = World(seed, standard_plan(poses, seed), setup=Setup(mag_period_ns=mag_period_ns, lost_stops=lost_stops))
    return lab_with(world, seed, faults=faults, edges=edges, power_on=LEVELS[level]())


def wait_until_ready(lab: Lab) -> None:
    """Wait until READY_S of the lab's time have passed: recordings then begin at the same time at all levels."""
    while lab.now_ns < READY_S * 1e9:
        lab.box_link.read(0.1)


def record_lab(lab: Lab, path: Path, duration_s: float) -> Session:
    """Record a lab for some seconds."""
    wait_until_ready(lab)
    writer = SessionWriter(path, lab.clock, overwrite=True)
    summary = record(
        lab.box_link, writer, lab.clock, robot=lab.robot_link, options=RecordOptions(duration_s=duration_s)
    )
    return Session(path, summary, lab.world, lab.box)
