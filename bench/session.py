"""Measure the cost of reading a session, stage by stage, compared with unpacking alone.

    .venv/bin/python bench/session.py             # 73 and 292 minutes, two seeds, and one with faults
    .venv/bin/python bench/session.py --quick     # 10 minutes
    .venv/bin/python bench/session.py --long      # six hours at 4069 samples a second: peak memory and CPU; two minutes

The sessions are made here: a box at 1017 samples a second with four channels, a robot that says its joints 50 times a second, a dwell every 2.7 s.
Faulty ones have 1 % of the box's frames lost, doubled, flipped or swapped, and restarts. Seconds are of the processor, on one
thread; all ratios are of stages that ran in turn in one process. The peer of the joint readings is json.loads on each of
their lines.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import gc
import json
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import cbor2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "host"))
import session_stream
from zstandard import ZstdDecompressor

from truearm.record.links import HostClock
from truearm.record.session_writer import SessionWriter
from truearm.session.joint_format import JOINTS, format_reading
from truearm.session.joint_readings import SegmentedReadings
from truearm.session.observations import observations, survey
from truearm.session.session_file import Messages, Session, chunk_records, open_session
from truearm.session.streams import BoxReader
from truearm.types import Message
from truearm_wire import messages as wire
from truearm_wire.cbor import Tag

DWELL_S = 2.7
BOOT_US = 2_000_000  # from a restart to the first block
RUNS = 3
JOINT_BATCHES = 40  # what is kept in memory for the stages of joint readings
DATA_HEAD = struct.Struct(">BBBIBBQBQBIHBB")


def main(quick: bool) -> None:
    lengths = (10,) if quick else (73, 292)
    print(f"{'session':28}{'stage':28}{'CPU s':>9}{'of unpacking':>14}{'of its peer':>15}")
    with tempfile.TemporaryDirectory() as folder:
        for minutes in lengths:
            for seed in (1, 2):
                path = Path(folder) / f"{minutes}-{seed}.mcap"
                write(path, minutes, seed, faulty=False)
                show(f"{minutes} min, seed {seed}", path)
                path.unlink()
        path = Path(folder) / "faulty.mcap"
        write(path, lengths[0], 3, faulty=True)
        show(f"{lengths[0]} min, 1 % faulty", path)
        print(f"\n{'length':>12}{'peak memory MB':>18}")
        for minutes in (lengths[0] // 2, *lengths):
            path = Path(folder) / "memory.mcap"
            write(path, minutes, 1, faulty=False)
            print(f"{minutes:>8} min{observing(path)[0]:>18.0f}")
            path.unlink()


def write(path: Path, minutes: float, seed: int, faulty: bool) -> None:
    rng = np.random.default_rng(seed)
    messages, _ = session_stream.session(rng, dwells=round(60 * minutes / DWELL_S), robot_hz=50.0)
    with SessionWriter(path, HostClock()) as writer:
        for message in with_faults(rng, messages) if faulty else messages:
            writer.add(*message)


def write_long(path: Path, hours: float, faster: int = 4) -> None:
    """Write the session of a box that samples ``faster`` times as often as usual, second by second, because it does not fit into memory."""
    rng = np.random.default_rng(1)
    q = rng.uniform(-1.5, 1.5, (round(3600 * hours / DWELL_S), 6))
    length = 0.46 + rng.uniform(-0.03, 0.03, len(q))
    corners = 5.0 + DWELL_S * np.repeat(np.arange(len(q)), 2) + np.tile([0.0, 2.0], len(q))
    period_ns = session_stream.PERIOD_NS // faster
    place_ns = period_ns * np.arange(session_stream.BLOCK)
    block_ns = session_stream.BLOCK * period_ns
    box = session_stream.Box(ppm=31.0, boot_host_ns=-3_000_000_000)
    box.ident(1_000_000)
    seq, next_ns = 0, 2 * 10**9
    with SessionWriter(path, HostClock()) as writer:
        for pose, row in enumerate(q):
            fittings = {"bar": "b46", "chuck": "c1", "sphere": "s1", "shell": "s46"}
            writer.add_json("/plan", 0, {"pose": pose, "q": row.tolist(), **fittings})
        for second in range(2, int(corners[-1]) + 1):
            for t_ns in range(10**9 * second, 10**9 * (second + 1), 250_000_000):
                box.sync(t_ns, 90e3 + rng.exponential(1e5), 90e3 + rng.exponential(1e5))
            box.heartbeat(10**9 * second)
            begin_ns = np.arange(next_ns, 10**9 * (second + 1), block_ns)
            next_ns = int(begin_ns[-1]) + block_ns
            metres = np.interp(1e-9 * (begin_ns[:, None] + place_ns), corners, np.repeat(length - 0.46, 2))
            counts = np.zeros((*metres.shape, session_stream.CHANNELS), "<i4")
            counts[..., 0] = session_stream.counts_of(metres + 3e-6 * rng.standard_normal(metres.shape))
            for t_ns, block in zip(begin_ns.tolist(), counts, strict=True):
                data = data_frame(0, box.n0, box.device_us(t_ns), period_ns, block.tobytes())
                box.messages.append(Message("/box/adc", t_ns + block_ns + 300_000, data))
                box.n0 += session_stream.BLOCK
            times = second + np.arange(50) / 50
            readings = np.stack([np.interp(times, corners, np.repeat(column, 2)) for column in q.T], axis=1)
            for k, (t, row) in enumerate(zip(times.tolist(), (np.rint(readings / 1e-4) * 1e-4).tolist(), strict=True)):
                line = format_reading(1000.0 + t, 50 * second + k, row)
                box.messages.append(Message("/robot/joints", round(1e9 * t) + 500_000, line))
            for message in sorted(box.messages, key=lambda message: message.t_host_ns):
                counts_in = message.topic.startswith("/box/")
                writer.add(*(renumbered(message, seq) if counts_in else message))
                seq += counts_in
            box.messages = []


def data_frame(seq: int, n0: int, t0_us: int, period_ns: int, samples: bytes) -> bytes:
    """Return the payload of a data frame of 52 numbers, ten times as fast as the box encodes it."""
    head = 0x88, wire.DATA, 0x1A, seq, 0, 0x1B, n0, 0x1B, t0_us, 0x1A, period_ns, 0xD84E, 0x58, len(samples)
    return DATA_HEAD.pack(*head) + samples + b"\0"


@dataclass
class Life:
    """A box between two boots: the first values of its counters, in numbers of the first boot."""

    boot_id: int = session_stream.Box.boot_id
    us: int = 0
    n0: int | None = 0  # None: the first block of the life is still to come
    seq: int = 0

    def frame(self, message: Message) -> Message:
        """Return what the box sends instead after this boot."""
        kind, seq, *rest = cbor2.loads(message.data)
        if kind == wire.DATA:
            stream, n0, t0_us, period_ns, samples, flags = rest
            self.n0 = n0 if self.n0 is None else self.n0
            rest = [stream, n0 - self.n0, t0_us - self.us, period_ns, Tag(samples.tag, samples.value), flags]
        elif kind == wire.HEARTBEAT:
            rest[:2] = self.boot_id, rest[1] - self.us
        elif kind == wire.SYNC_REPLY:
            rest[1:] = [t_us - self.us for t_us in rest[1:]]
        return message._replace(data=bytes(wire.encode_payload([kind, seq - self.seq, *rest])))

    def exchange(self, message: Message) -> Message:
        """Do the same for the recorder's message about a clock exchange."""
        said = json.loads(message.data)
        said |= {key: said[key] - self.us for key in ("t1_us", "t2_us")}
        return message._replace(data=json.dumps(said).encode())


def with_faults(rng: np.random.Generator, messages: list[Message]) -> list[Message]:
    """Lose, double, flip (its CRC fails, so it is stored as console bytes) or swap one frame in a hundred, with ten restarts.

    A box that restarts has another boot id, tells what it is, and counts frames, samples and time from 0.
    """
    received: list[Message] = []
    restarts = set(rng.integers(len(messages), size=10).tolist())
    fates = rng.integers(4, size=len(messages))
    hit = rng.random(len(messages)) < 0.01
    life = Life()
    restarting = False
    for k, message in enumerate(messages):
        restarting |= k in restarts
        if message.topic == "/sync":
            received.append(life.exchange(message))
        if not message.topic.startswith("/box/"):
            received += [message] if message.topic != "/sync" else []
            continue
        if restarting and message.topic == "/box/adc":
            box = session_stream.Box(boot_id=life.boot_id + 1)
            box.ident(message.t_host_ns)
            us = cbor2.loads(message.data)[4] - BOOT_US
            life = Life(box.boot_id, us, None, sequence(message) - len(box.messages))
            received += box.messages
            restarting = False
        message = life.frame(message)
        fate = int(fates[k]) if hit[k] else -1
        if fate == 0:
            continue
        if fate == 2:
            data = bytearray(message.data)
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
            message = message._replace(topic="/box/console", data=bytes(data))
        received.append(message)
        if fate == 1:
            received.append(message)
        if fate == 3 and len(received) > 1:
            received[-2:] = received[:-3:-1]
    return received


def sequence(message: Message) -> int:
    at = message.data.index(0x1A, 1) + 1
    return int.from_bytes(message.data[at : at + 4], "big")


def renumbered(message: Message, seq: int) -> Message:
    at = message.data.index(0x1A, 1) + 1
    return message._replace(data=message.data[:at] + seq.to_bytes(4, "big") + message.data[at + 4 :])


def show(name: str, path: Path) -> None:
    session = open_session(path)
    batches = list(islice(session.batches(), JOINT_BATCHES))
    lines = [m.data for messages in batches for m in messages.one_by_one(messages.rows(lambda topic: topic == JOINTS))]
    stages: dict[str, Callable[[], Any]] = {
        "unpacking alone": lambda: unpacked(session),
        "open and check the file": lambda: open_session(path),
        "columns of messages": lambda: sum(map(len, session.batches())),
        "samples": lambda: samples(session),
        "joints": lambda: joints(batches),
        "joints: the library's json": lambda: sum(len(json.loads(line)) for line in lines),
        "observations": lambda: observations(survey(open_session(path).batches), session_stream.RIG),
    }
    seconds = {stage: [] for stage in stages}
    for _ in range(RUNS):
        for stage, job in stages.items():
            gc.collect()
            begin = time.process_time()
            job()
            seconds[stage].append(time.process_time() - begin)
    least = {stage: min(times) for stage, times in seconds.items()}
    floor, peer = least["unpacking alone"], least["joints: the library's json"]
    for stage, value in least.items():
        of_peer = f"{value / peer:15.2f}" if stage == "joints" else ""
        print(f"{name:28}{stage:28}{value:9.3f}{value / floor:14.1f}{of_peer}", flush=True)


def unpacked(session: Session) -> int:
    with session.path.open("rb") as file:
        return sum(
            len(chunk_records(os.pread(file.fileno(), length, offset), ZstdDecompressor()))
            for offset, length in session.chunks
        )


def joints(batches: Sequence[Messages]) -> int:
    order = SegmentedReadings()
    due = [*chain.from_iterable(map(order.take, batches)), *order.finish()]
    return sum(len(batch) for _, batch in due)


def samples(session: Session) -> int:
    reader, total = BoxReader(), 0
    for messages in session.batches():
        total += sum(len(some.counts) for some in reader.feed(messages))
    return total + sum(len(some.counts) for some in reader.finish())


def observing(path: Path) -> tuple[float, float]:
    """Return the peak memory [MB] and the CPU seconds of a process that makes observations from a session."""
    done = subprocess.run([sys.executable, __file__, "--memory", str(path)], check=True, capture_output=True, text=True)
    memory, seconds = done.stdout.split()
    return float(memory), float(seconds)


if __name__ == "__main__":
    if "--memory" in sys.argv:
        observations(survey(open_session(Path(sys.argv[-1])).batches), session_stream.RIG)
        status = Path("/proc/self/status").read_text()  # getrusage's is no less than the parent's
        print(int(status.split("VmHWM:")[1].split()[0]) / 1024, time.process_time())
    elif "--long" in sys.argv:
        with tempfile.TemporaryDirectory() as folder:
            write_long(Path(folder) / "long.mcap", hours=6.0)
            memory, seconds = observing(Path(folder) / "long.mcap")
            print(f"6 h at 4 kHz: peak memory {memory:.0f} MB, {seconds:.0f} s of CPU")
    else:
        main("--quick" in sys.argv)
