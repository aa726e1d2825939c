"""The sensor box in its world: hardware that samples, a crystal, a firmware that runs, and the faults that are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from truearm.types import Floats

from .box import CRASH, RECORD, RX_MAX, STALL, Answer, BoxProcess, BoxSetup
from .micropython import Interpreter
from .sensors import period_ns
from .world import World

BATCH = 100  # samples a grant, at most
SHORT_WRITE = 100  # bytes that the link takes of a data frame's 251
BOOT_NS = 1_500_000_000
FAULTS = ("flip", "lose", "double", "text", "short-write", "stall", "crash", "reboot")


@dataclass(frozen=True)
class Fault:
    """What goes wrong at ``t_s`` of the lab's time.

    flip: one bit of a data frame; lose, double: a data frame; text: stray text between frames; short-write: the link takes half a
    frame; stall: the firmware stands still for 0.2 s; crash: it raises, prints a traceback and restarts; reboot: power fails.
    """

    t_s: float
    kind: str

    def __post_init__(self) -> None:
        if not 0.0 <= self.t_s < 1e9:
            raise ValueError(f"a fault at {self.t_s} s is not within the lab's time")
        if self.kind not in FAULTS:
            raise ValueError(f"{self.kind!r} is no fault; there are {', '.join(FAULTS)}")


class SimulatedBox:
    """A box process that is fed with the world's samples. ``advance`` is its only step."""

    def __init__(
        self, world: World, interpreter: Interpreter | None, *, faults: Sequence[Fault] = (), seed: int = 0
    ) -> None:
        self._world = world
        self._interpreter = interpreter
        self._setup = BoxSetup(config=world.box_config())
        self._rng = np.random.default_rng((seed, 2))
        self._faults = sorted(faults, key=lambda fault: fault.t_s)
        self._boots = 0
        self._process: BoxProcess | None = None
        self._boot_at_ns: int | None = 0  # when the power comes (back)
        self._boot_device_ns = 0
        self._sampling_since_ns: int | None = None  # device time
        self._period_ns = 0
        self._sent = 0  # samples given since the start of sampling
        self._stalled_until_ns = 0
        self._short_write = False
        self._rx = b""  # what the host wrote and the box has not taken yet
        self._rx_room = RX_MAX

    def device_us(self, t_ns: int) -> int:
        """Time on the box's hardware timer [µs since its boot] at true time ``t_ns``."""
        return (self._world.device_clock.from_true_ns(t_ns) - self._boot_device_ns) // 1000

    def true_s(self, device_us: Floats) -> Floats:
        """True time [s] of times on the hardware timer since the latest boot: what a clock fit is judged by."""
        reading = 1e-6 * device_us + 1e-9 * self._boot_device_ns
        true: Floats = self._world.clocks.device.true(reading)
        return true

    def advance(self, t_ns: int, rx: bytes = b"", tx_room: int = 0xFFFF) -> Iterator[bytes]:
        """Let the box run up to true time ``t_ns``; yields the bytes it sent, grant by grant."""
        if self._process is None:
            if self._boot_at_ns is None or t_ns < self._boot_at_ns:
                return
            self._boot(t_ns)
        self._rx += rx
        fault = self._due_fault(t_ns)
        if fault == "reboot":
            self._power_off(t_ns)
            return
        flags = CRASH if fault == "crash" else 0
        if fault == "stall":
            self._stalled_until_ns = t_ns + 200_000_000
        if t_ns < self._stalled_until_ns:
            flags |= STALL
        if fault == "short-write":
            self._short_write = True
        device_us = self.device_us(t_ns)
        for samples, index in self._due_samples(device_us * 1000):
            room = min(tx_room, SHORT_WRITE) if self._short_write else tx_room
            answer = self._grant(device_us, samples, index, room, flags)
            self._short_write = self._short_write and len(answer.tx) < SHORT_WRITE  # until a frame did not fit
            flags, tx_room = flags & STALL, 0xFFFF
            yield self._damage(answer.tx, fault)
            fault = None
            if answer.reset:
                self._power_off(t_ns)
                return

    def close(self) -> None:
        """End the firmware's process."""
        if self._process is not None:
            self._process.close()
            self._process = None

    # -- power

    def _boot(self, t_ns: int) -> None:
        self._boots += 1
        boot_id = int(np.random.default_rng((self._world.seed, 3, self._boots)).integers(2**32))
        self._process = BoxProcess(self._interpreter, self._setup, boot_id, reset_cause=1 if self._boots == 1 else 3)
        self._boot_device_ns = self._world.device_clock.from_true_ns(t_ns)
        self._sampling_since_ns = None
        self._rx, self._rx_room = b"", RX_MAX

    def _power_off(self, t_ns: int) -> None:
        self.close()
        self._boot_at_ns = t_ns + BOOT_NS

    # -- hardware

    def _due_samples(self, device_ns: int) -> Iterator[tuple[bytes, int]]:
        """Batches of the samples that were latched up to ``device_ns``, at least one (maybe empty) batch."""
        if self._sampling_since_ns is None:
            yield b"", 0
            return
        first_ns = self._sampling_since_ns + self._period_ns
        due = max(0, (device_ns - first_ns) // self._period_ns + 1)
        while True:
            n = min(BATCH, due - self._sent)
            index = self._sent
            self._sent += n
            yield self._records(index, n, first_ns), index
            if self._sent >= due:
                return

    def _records(self, index: int, n: int, first_ns: int) -> bytes:
        if n <= 0:
            return b""
        counts, _ = self._world.samples(index, index + n, self._boot_device_ns + first_ns, self._period_ns)
        # the hardware timer counts whole microseconds since boot, and a stamp holds its lower 32 bits
        stamps = (first_ns + np.arange(index, index + n, dtype=np.int64) * self._period_ns) // 1000
        records = np.empty((n, RECORD), np.uint8)
        records[:, :4] = (stamps & 0xFFFFFFFF).astype(">u4").view(np.uint8).reshape(n, 4)
        records[:, 4:] = np.ascontiguousarray(counts, "<i4").view(np.uint8).reshape(n, 16)
        return records.tobytes()

    def _grant(self, device_us: int, samples: bytes, index: int, tx_room: int, flags: int) -> Answer:
        assert self._process is not None
        rx = self._rx[: min(RX_MAX, self._rx_room)]
        self._rx = self._rx[len(rx) :]
        answer = self._process.grant(
            device_us, rx=rx, samples=samples, index=index, tx_room=tx_room, flags=flags, temperature_mdegc=24_500
        )
        self._rx_room = answer.rx_room
        if answer.sampling and self._sampling_since_ns is None:
            self._sampling_since_ns = device_us * 1000
            self._period_ns = period_ns(answer.osr)
            self._sent = 0
        elif not answer.sampling:
            self._sampling_since_ns = None
        return answer

    # -- faults on the link

    def _due_fault(self, t_ns: int) -> str | None:
        if self._faults and self._sampling_since_ns is not None and t_ns >= self._faults[0].t_s * 1e9:
            return self._faults.pop(0).kind
        return None

    def _damage(self, tx: bytes, fault: str | None) -> bytes:
        """Apply a fault of the link to the first data frame of ``tx``; without one it waits for the next bytes."""
        if fault not in ("flip", "lose", "double", "text"):
            return tx
        start = next(
            (i for i in range(len(tx) - 250) if tx[i] == 0 and tx[i + 1] and tx.find(b"\0", i + 1) == i + 250), None
        )
        if start is None:
            self._faults.insert(0, Fault(0.0, fault))
            return tx
        before, frame, after = tx[:start], tx[start : start + 251], tx[start + 251 :]
        if fault == "text":
            return before + b"\0stray text\r\n\0" + frame + after
        if fault == "double":
            return before + frame + frame + after
        if fault == "lose":
            return before + after
        at = int(self._rng.integers(1, 250))
        bit = 1 << int(self._rng.integers(8))
        if frame[at] == bit:  # would become a delimiter: two runs instead of one
            bit = bit << 1 if bit < 128 else 64
        return before + frame[:at] + bytes([frame[at] ^ bit]) + frame[at + 1 :] + after
