"""A box and a robot in memory for the recorder's tests: SPEC over the link interface, in virtual time.

The encoder is an independent derivation of SPEC §1 and §2 with cbor2, cobs and zlib; it uses no code of truearm_wire.
"""

from __future__ import annotations

import heapq
import itertools
import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

import cbor2
import numpy as np
from cobs import cobs

MS = 1_000_000
SECOND = 1000 * MS
HOST_0 = 5_000 * SECOND
LATENCY = 300_000  # ns in each direction
PERIOD_NS = 983_040
N = 10
CHANNELS = 4


def u32(value: int) -> bytes:
    return b"\x1a" + value.to_bytes(4, "big")


def u64(value: int) -> bytes:
    return b"\x1b" + value.to_bytes(8, "big")


def array(*items: bytes | int | str) -> bytes:
    """Return a CBOR array; integers in their shortest form, bytes are already encoded."""
    return bytes([0x80 + len(items)]) + b"".join(i if isinstance(i, bytes) else cbor2.dumps(i) for i in items)


def run_of(payload: bytes) -> bytes:
    """Return the bytes between the delimiters of a payload's frame."""
    return cobs.encode(payload + zlib.crc32(payload).to_bytes(4, "little"))


def frame(payload: bytes) -> bytes:
    return b"\0" + run_of(payload) + b"\0"


def data(seq: int, n0: int, t0_us: int, n: int = N, stream: int = 0) -> bytes:
    counts = np.arange(n0 * CHANNELS, (n0 + n) * CHANNELS, dtype="<i4")
    samples = cbor2.dumps(cbor2.CBORTag(78, counts.tobytes()))
    return array(16, u32(seq), stream, u64(n0), u64(t0_us), u32(PERIOD_NS), samples, 0)


def heartbeat(seq: int, boot_id: int, t_us: int, streaming: int, overruns: int = 0) -> bytes:
    return array(
        18, u32(seq), u32(boot_id), u64(t_us), seq, 0, 0, u32(overruns), 0, 900, 1200, 100_000, 25_000, 1, streaming
    )


def ident(boot_id: int, osr: int = 4096, protocol: tuple[int, ...] = (1, 0), **more: object) -> dict[str, object]:
    channels = [{"name": f"c{i}", "unit": "V", "scale": [1, -6]} for i in range(CHANNELS)]
    stream = {"id": 0, "name": "adc", "period_ns": 240 * osr, "osr": osr, "group_delay_ns": 360 * osr}
    return {
        "protocol": list(protocol),
        "firmware": "test 1.0",
        "uid": b"\x01\x02\x03\x04",
        "boot_id": boot_id,
        "clock_hz": 1_000_000,
        "streams": [{**stream, "channels": channels}],
        **more,
    }


class Lab:
    """Virtual time and its events. Reading a link makes time pass."""

    kind = "virtual"

    def __init__(self) -> None:
        self.now = HOST_0
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()

    def now_ns(self) -> int:
        return self.now

    def utc_anchor(self) -> tuple[int, int]:
        return 1_700_000_000 * SECOND + self.now - HOST_0, self.now

    def at(self, t_ns: int, action: Callable[[], None]) -> None:
        heapq.heappush(self._events, (max(t_ns, self.now), next(self._order), action))

    def step(self, deadline: int) -> None:
        """Advance to the next event, or to the deadline if that comes first."""
        if not self._events or self._events[0][0] > deadline:
            self.now = deadline
            return
        self.now, _, action = heapq.heappop(self._events)
        action()


@dataclass
class Wire:
    """One end of a link: the received data; an exception instead of bytes ends it."""

    lab: Lab
    name: str
    arrived: list[tuple[int, bytes]] = field(default_factory=list)
    error: Exception | None = None
    on_write: Callable[[bytes], None] | None = None

    def read(self, timeout_s: float) -> list[tuple[int, bytes]]:
        deadline = self.lab.now + int(timeout_s * 1e9)
        while not self.arrived and self.error is None and self.lab.now < deadline:
            self.lab.step(deadline)
        if not self.arrived and self.error is not None:
            raise self.error
        taken, self.arrived = self.arrived, []
        return taken

    def write(self, data: bytes) -> int:
        if self.error is not None:
            raise self.error
        if self.on_write is not None:
            self.on_write(data)
        return self.lab.now

    def close(self) -> None:
        return

    def deliver(self, data: bytes) -> None:
        self.arrived.append((self.lab.now, data))


class ComingBack(Wire):
    """A link that is plugged in again automatically; data that arrived meanwhile are lost."""

    def reopen(self, timeout_s):
        deadline = self.lab.now + int(timeout_s * 1e9)
        while self.error is not None and self.lab.now < deadline:
            self.lab.step(deadline)
        self.arrived = []
        return self.error is None

    def deliver(self, data):
        if self.error is None:
            super().deliver(data)


class Box:
    """A box without faults. ``sent`` is every byte it sent, ``commands`` what it executed."""

    def __init__(self, lab: Lab, link: type[Wire] = Wire) -> None:
        self.lab = lab
        self.link = link(lab, "box in memory")
        self.link.on_write = lambda data: lab.at(lab.now + LATENCY, lambda: self._hear(data))
        self._sent: list[bytes] = []
        self.frames = 0
        self.blocks = 0
        self.commands: list[list[object]] = []
        self.answer_probes = True
        self.overruns = 0  # samples since the boot, as reported in its heartbeats
        self.mangle: Callable[[int, bytes], bytes] = lambda index, raw: raw  # how the link changes frame ``index``
        self.deaf_to = 0  # number of commands that are not answered
        self.protocol: tuple[int, ...] = (1, 0)
        self.refuse: dict[int, tuple[int, str]] = {}
        self.lvdt: dict[str, object] = {}  # differences of the first channel's ident
        self.uid = b"\x01\x02\x03\x04"
        self.boot(0x1111)

    @property
    def sent(self) -> bytes:
        return b"".join(self._sent)

    def boot(self, boot_id: int, seq: int = 0) -> None:
        self.boot_id = boot_id
        self.seq = seq
        self.born = self.lab.now
        self.streaming = False
        self.osr = 4096
        self.last: tuple[int, list[bytes]] | None = None
        self._heart(boot_id)

    def t_us(self) -> int:
        return (self.lab.now - self.born) // 1000

    def send(self, payload_of_seq: Callable[[int], bytes]) -> None:
        raw = frame(payload_of_seq(self.seq))
        self.seq += 1
        self.frames += 1
        self.send_raw(self.mangle(self.frames, raw))

    def send_raw(self, raw: bytes) -> None:
        self._sent.append(raw)
        if raw:
            self.lab.at(self.lab.now + LATENCY, lambda: self.link.deliver(raw))

    def send_ident(self, req_id: int) -> None:
        said = ident(self.boot_id, self.osr, self.protocol)
        said["uid"] = self.uid
        said["streams"][0]["channels"][0].update(self.lvdt)
        document = cbor2.dumps(said)
        parts = [document[i : i + 200] for i in range(0, len(document), 200)]
        for page, part in enumerate(parts):
            self.send(lambda seq, p=page, d=part: array(19, u32(seq), req_id, p, len(parts), cbor2.dumps(d)))

    def _heart(self, boot_id: int) -> None:
        if boot_id != self.boot_id:
            return
        self.send(lambda seq: heartbeat(seq, boot_id, self.t_us(), int(self.streaming), self.overruns))
        self.lab.at(self.lab.now + SECOND, lambda: self._heart(boot_id))

    def _hear(self, raw: bytes) -> None:
        for run in filter(None, raw.split(b"\0")):
            body = cobs.decode(run)
            assert zlib.crc32(body[:-4]).to_bytes(4, "little") == body[-4:]
            self._obey(cbor2.loads(body[:-4]))

    def _obey(self, command: list[int]) -> None:
        if command[0] == 32:
            if self.answer_probes:
                t_us = self.t_us()
                self.send(lambda seq: array(33, u32(seq), command[1], u64(t_us), u64(t_us)))
            return
        if self.last is None or self.last[0] != command[1]:
            self.last = (command[1], [])
            self._execute(command)
        if self.deaf_to:
            self.deaf_to -= 1
        elif command[0] in self.refuse:
            code, text = self.refuse[command[0]]
            self.send(lambda seq: array(65, u32(seq), command[1], code, text))
        elif command[0] == 48:
            self.send_ident(command[1])
        else:
            self.send(lambda seq: array(64, u32(seq), command[1], 0, 1, b"\x40"))

    def _execute(self, command: list[int]) -> None:
        self.commands.append(list(command))
        if command[0] == 49:
            self.osr = command[3]
        elif command[0] == 50:
            self.streaming = True
            self._block(self.boot_id, 0)
        elif command[0] == 51:
            self.streaming = False

    def _block(self, boot_id: int, n0: int) -> None:
        if not self.streaming or boot_id != self.boot_id:
            return
        t_us = self.t_us()
        self.blocks += 1
        self.send(lambda seq: data(seq, n0, t_us))
        self.lab.at(self.lab.now + N * PERIOD_NS, lambda: self._block(boot_id, n0 + N))


class Robot:
    """A robot that sends a line every 8 ms; its link ends with an error, or it reports that it has ended."""

    def __init__(
        self, lab: Lab, seconds: float, end: Exception | None = None, counts: bool = True, link: type[Wire] = Wire
    ) -> None:
        self.lab = lab
        self.link = link(lab, "robot in memory")
        self.sent: list[bytes] = []
        for k in range(int(seconds / 0.008)):
            number = {"seq": k} if counts else {}
            row = {"t": 100 + 0.008 * k, **number, "q": [0.1 * j + 1e-4 * k for j in range(6)]}
            lab.at(HOST_0 + 8 * MS * k, lambda r=row: self.say(json.dumps(r).encode()))

        def close() -> None:
            self.link.error = end
            if end is None:
                self.link.deliver(b'{"end": true}\n')

        lab.at(HOST_0 + int(seconds * SECOND), close)

    def say(self, line: bytes) -> None:
        self.sent.append(line)
        self.link.deliver(line + b"\n")
