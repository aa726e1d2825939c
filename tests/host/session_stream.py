"""Session messages with known truth: a box with its own clock, a robot with another, a link with delays.

Frames are written by ``truearm_wire``. The truth is kept with them.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cbor2
import numpy as np

from truearm.kinds.rig_file import format_rig
from truearm.record.links import HostClock
from truearm.record.session_writer import SessionWriter
from truearm.session.session_file import Messages, Source, columns_of_records
from truearm.types import BallBar, Message, Point, Rig
from truearm_wire import messages as wire
from truearm_wire.cbor import Tag

PERIOD_NS = 983_040
BLOCK = 13
CHANNELS = 4
SCALE = [143, -9]  # V per count: ±1.2 V over 24 bit
POLY = [[1, -4], [35, -3], [2, -4]]  # m: 0.1 mm + 35 mm/V + 0.2 mm/V²
RIG = Rig(
    chucks={"c1": Point("c1", (0.0, 0.0, 0.0)), "c2": Point("c2", (1.0, 0.0, 0.0))},
    spheres={"s1": Point("s1", (0.0, 0.0, 0.1))},
    bars={"b46": BallBar("b46", 0.46, 1.0, 0.075, 84e-6)},
)


def ident_document(boot_id: int = 7) -> dict[str, object]:
    """Return the box's ident; channel 0 is the LVDT."""
    lvdt = {"name": "lvdt", "unit": "V", "scale": SCALE, "calibration": {"unit": "m", "poly": POLY}}
    others = [{"name": f"ch{i}", "unit": "V", "scale": SCALE} for i in range(1, CHANNELS)]
    stream = {"id": 0, "name": "adc", "period_ns": PERIOD_NS, "osr": 1024, "group_delay_ns": 1_500_000}
    return ident_of([{**stream, "channels": [lvdt, *others]}], boot_id)


def ident_of(streams: list[dict[str, object]], boot_id: int) -> dict[str, object]:
    """Return the ident of a box with these streams."""
    box = {"protocol": [1, 0], "firmware": "0.1.0", "uid": b"\x01\x02", "boot_id": boot_id, "clock_hz": 1_000_000}
    return {**box, "streams": streams}


def metres_of(counts: np.ndarray) -> np.ndarray:
    """Return metres by the same conversion, written independently."""
    v = counts * 143e-9
    return 1e-4 + 0.035 * v + 2e-4 * v * v


def counts_of(metres: np.ndarray) -> np.ndarray:
    """Return the counts nearest to these metres: the quadratic's root, solved directly."""
    v = (-0.035 + np.sqrt(0.035**2 - 4 * 2e-4 * (1e-4 - metres))) / (2 * 2e-4)
    return np.rint(v / 143e-9).astype(np.int64)


@dataclass
class Box:
    """The frames of a box in order. Tests may drop, double or reorder ``messages``."""

    ppm: float = 0.0
    boot_host_ns: int = 0
    boot_id: int = 7
    seq: int = 0
    n0: int = 0
    messages: list[Message] = field(default_factory=list)

    def device_us(self, t_host_ns: float) -> int:
        """Return the device time at a host time; whole microseconds, truncated as a counter does."""
        return int((t_host_ns - self.boot_host_ns) * (1.0 + 1e-6 * self.ppm) // 1000)

    def frame(self, topic: str, t_host_ns: int, kind: int, *elements: object) -> Message:
        """Append a frame with the next seq."""
        message = Message(f"/box/{topic}", t_host_ns, bytes(wire.encode_payload([kind, self.seq, *elements])))
        self.messages.append(message)
        self.seq = (self.seq + 1) % 2**32
        return message

    def document(self) -> dict[str, object]:
        """Return the box's ident."""
        return ident_document(self.boot_id)

    def ident(self, t_host_ns: int) -> None:
        """Add the ident document in its pages."""
        for page, pages, data in wire.pages(cbor2.dumps(self.document())):
            self.frame("ident", t_host_ns, wire.IDENT, 0, page, pages, data)

    def heartbeat(self, t_host_ns: int, **counters: int) -> None:
        """Add a heartbeat; counters that are not given are 0."""
        names = wire.names(wire.HEARTBEAT)[3:]
        values = [counters.get(name, 0) for name in names]
        self.frame("heartbeat", t_host_ns, wire.HEARTBEAT, self.boot_id, self.device_us(t_host_ns), *values)

    def data(self, t_host_ns: int, counts: np.ndarray, flags: int = 0, skip: int = 0) -> None:
        """Add a block of (n, C) counts with its first sample at this host time; ``skip`` samples are lost before it."""
        self.n0 += skip
        samples = Tag(78, np.ascontiguousarray(counts, "<i4").tobytes())
        t0 = self.device_us(t_host_ns)
        arrival = t_host_ns + len(counts) * PERIOD_NS + 300_000
        self.frame("adc", arrival, wire.DATA, 0, self.n0, t0, PERIOD_NS, samples, flags)
        self.n0 += len(counts)

    def reboot(self, t_host_ns: int) -> None:
        """Restart with another boot id; time, seq and n0 begin again."""
        self.boot_host_ns, self.boot_id, self.seq, self.n0 = t_host_ns, self.boot_id + 1, 0, 0

    def sync(self, t_host_ns: int, there_ns: float, back_ns: float, work_ns: float = 40e3) -> None:
        """Add a clock exchange that began at this host time."""
        ident = len(self.messages)
        t1, t2 = self.device_us(t_host_ns + there_ns), self.device_us(t_host_ns + there_ns + work_ns)
        t3 = int(np.ceil(t_host_ns + there_ns + work_ns + back_ns))
        self.frame("sync", t3, wire.SYNC_REPLY, ident, t1, t2)
        exchange = {"id": ident, "t0_ns": t_host_ns, "t1_us": t1, "t2_us": t2, "t3_ns": t3}
        self.messages.append(Message("/sync", t3, json.dumps(exchange).encode()))


def columns_of(messages: Iterable[Message]) -> Messages:
    """Return messages as the reader of a session does, from the records of a chunk."""
    numbers: dict[str, int] = {}
    records = []
    for sequence, (topic, t_host_ns, data) in enumerate(messages):
        if topic not in numbers:
            numbers[topic] = len(numbers)
            body = struct.pack("<HHI", numbers[topic], 0, len(topic.encode())) + topic.encode() + bytes(8)
            records.append(struct.pack("<BQ", 4, len(body)) + body)
        head = struct.pack("<HIQQ", numbers[topic], sequence, t_host_ns, t_host_ns)
        records.append(struct.pack("<BQ", 5, len(head) + len(data)) + head + data)
    return columns_of_records([b"".join(records)], {})


def stream_of(messages: list[Message], size: int = 1000) -> Source:
    """Return a list with the interface of a session file; ``size``: messages read together."""
    return lambda: (columns_of(messages[at : at + size]) for at in range(0, len(messages), size))


def write_session(
    path: Path, messages: Iterable[Message], rig: Rig | bytes | None = None, **metadata: dict[str, str]
) -> Path:
    """Write a session file of these messages, with a rig and metadata by name."""
    with SessionWriter(path, HostClock()) as writer:
        for name, entries in metadata.items():
            writer.metadata(name, entries)
        if rig is not None:
            writer.attach("rig.toml", rig if isinstance(rig, bytes) else format_rig(rig).encode())
        for message in messages:
            writer.add(*message)
    return path


@dataclass(frozen=True)
class Truth:
    """The truth of a session."""

    q: np.ndarray  # (d, j)
    length: np.ndarray  # (d,)
    start_ns: np.ndarray  # (d,) host time at which the robot came to rest
    end_ns: np.ndarray


def session(
    rng: np.random.Generator,
    dwells: int = 6,
    rest_s: float = 2.0,
    move_s: float = 0.7,
    noise: float = 3e-6,
    joint_noise: float = 0.0,
    step: float = 1e-4,
    robot_hz: float = 125.0,
    plan: bool = True,
    warming: float = 0.0,
) -> tuple[list[Message], Truth]:
    """Return a session of a robot that visits random poses, and its truth; readings have only noise and quantisation.

    The box starts at 24 °C and warms up by ``warming`` [m°C/s].
    """
    q = rng.uniform(-1.5, 1.5, (dwells, 6))
    length = 0.46 + rng.uniform(-0.03, 0.03, dwells)
    start = 1e9 * (5.0 + np.arange(dwells) * (rest_s + move_s))
    corners = np.stack([start, start + 1e9 * rest_s], axis=1).ravel()
    end_ns = int(corners[-1] + 5e8)
    box = Box(ppm=31.0, boot_host_ns=-3_000_000_000)
    box.ident(1_000_000)
    for t in np.arange(5e7, end_ns, 2.5e8):
        box.sync(int(t), 90e3 + rng.exponential(1e5), 90e3 + rng.exponential(1e5))
    for t in range(10**9, end_ns, 10**9):
        box.heartbeat(t, temperature_mdegc=round(24_000 + warming * 1e-9 * t))
    seq_less = sorted(box.messages[len(wire.pages(cbor2.dumps(ident_document()))) :], key=lambda m: m.t_host_ns)
    times = np.arange(2 * 10**9, end_ns, PERIOD_NS)
    readings = np.interp(times - 1_500_000, corners, np.repeat(length - 0.46, 2)) + noise * rng.standard_normal(
        times.size
    )
    counts = np.zeros((times.size, CHANNELS), np.int64)
    counts[:, 0] = counts_of(readings)
    ident_frames = [m for m in box.messages if m.topic == "/box/ident"]
    box.messages = []
    for k in range(0, times.size - BLOCK, BLOCK):
        box.data(int(times[k]), counts[k : k + BLOCK])
    frames = renumber(ident_frames + sorted(seq_less + box.messages, key=lambda m: m.t_host_ns))
    robot = robot_messages(rng, np.repeat(q, 2, axis=0), corners, end_ns, joint_noise, step, robot_hz)
    said = [_plan(i, row) for i, row in enumerate(q)] if plan else []
    everything = said + sorted(frames + robot, key=lambda m: m.t_host_ns)
    return everything, Truth(q, length, corners[::2], corners[1::2])


def _plan(pose: int, q: np.ndarray) -> Message:
    fittings = {"bar": "b46", "chuck": "c1", "sphere": "s1", "shell": "s46"}
    return Message("/plan", 0, json.dumps({"pose": pose, "q": q.tolist(), **fittings}).encode())


def robot_messages(
    rng: np.random.Generator, q: np.ndarray, corners: np.ndarray, end_ns: int, noise: float, step: float, hz: float
) -> list[Message]:
    """Return the lines of a robot that passes joints q (m, j) at host times (m,) [ns], moving straight in between."""
    times = np.arange(10**9, end_ns, 1e9 / hz)
    path = np.stack([np.interp(times, corners, column) for column in q.T], axis=1)
    path += noise * rng.standard_normal(path.shape)
    path = step * np.rint(path / step) if step else path
    return joint_messages(rng, times, path)


def joint_messages(rng: np.random.Generator, times: np.ndarray, q: np.ndarray) -> list[Message]:
    """Return the lines of readings q (n, j) at host times (n,) [ns]; the latency of the link is at least 0.4 ms."""
    arrival = np.maximum.accumulate(times + 400e3 + rng.exponential(200e3, times.size)).astype(np.int64)
    stamps = 1000.0 + 1e-9 * times * (1.0 - 20e-6)
    rows = zip(arrival.tolist(), stamps.tolist(), q.tolist(), strict=True)
    return [
        Message("/robot/joints", at, json.dumps({"t": t, "seq": i, "q": row}).encode())
        for i, (at, t, row) in enumerate(rows)
    ]


def renumber(frames: list[Message]) -> list[Message]:
    """Return the same frames with seq in the order of their arrival."""
    result, seq = [], 0
    for message in frames:
        if message.topic == "/sync":
            result.append(message)
            continue
        data = message.data
        at = data.index(0x1A, 1)  # seq is the second element and always five bytes
        result.append(message._replace(data=data[: at + 1] + seq.to_bytes(4, "big") + data[at + 5 :]))
        seq += 1
    return result
