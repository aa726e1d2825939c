"""The sensor box in its world: power, a crystal, flash, its inputs, and requested faults.

``Hardware`` runs behind it: the firmware in a MicroPython, or whatever ``power_on`` creates at a boot.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

from .box import COMMAND, POWER, WATCHDOG, Answer, BoxSetup, write_flash
from .hardware import BAD_CRC, CONVERTER_RESET, CRASH, STALL, TEMPERATURE_MDEGC, Boot, Edge, Hardware, PowerOn, Signals
from .micropython import Interpreter
from .vmbox import VmBox
from .world import World

SHORT_WRITE = 100  # bytes that the link accepts of a data frame's 251
STALL_NS = 200_000_000
NO_STOP_S = 0.01
FAULTS = (
    "flip", "lose", "double", "text", "short-write", "stall", "crash", "reboot",
    "hang", "bad-crc", "converter-reset", "no-stop",
)  # fmt: skip
_FLAGS = {"crash": CRASH, "bad-crc": BAD_CRC, "converter-reset": CONVERTER_RESET}
_CAUSES = {"reset": COMMAND, "watchdog": WATCHDOG, "power cut": POWER}


@dataclass(frozen=True)
class Fault:
    """A fault at ``t_s`` of the lab's time.

    flip: one bit of a data frame; lose, double: a data frame; text: stray text between frames; short-write: the link
    accepts half a frame; stall: the firmware stops for 0.2 s; crash: it raises an exception, prints a traceback and
    restarts; reboot: power fails; hang: the firmware stops until its watchdog resets it; bad-crc: a frame of the
    converter is damaged; converter-reset: the converter resets itself; no-stop: for 10 ms no stop pulse of the
    magnetostrictive head arrives.
    """

    t_s: float
    kind: str

    def __post_init__(self) -> None:
        if not 0.0 <= self.t_s < 1e9:
            raise ValueError(f"a fault at {self.t_s} s is not within the lab's time")
        if self.kind not in FAULTS:
            raise ValueError(f"{self.kind!r} is not a fault; there are {', '.join(FAULTS)}")


class SimulatedBox:
    """A box that samples the world. ``advance`` is its only step; its flash persists from boot to boot."""

    def __init__(
        self,
        world: World,
        interpreter: Interpreter | None = None,
        *,
        faults: Sequence[Fault] = (),
        edges: Sequence[Edge] = (),
        seed: int = 0,
        setup: BoxSetup | None = None,
        power_on: PowerOn | None = None,
    ) -> None:
        """Create a box.

        ``edges``: of its trigger inputs, true time, in order. ``setup``: by default that of the world's box.

        ``power_on`` creates the hardware of a boot; by default a ``VmBox`` with ``interpreter`` (None: CPython).
        """
        self._world = world
        self._setup = setup or BoxSetup(config=world.box_config(), sensors=world.sensor_streams)
        self._power_on = power_on or partial(VmBox, interpreter)
        self._rng = np.random.default_rng((seed, 2))
        self._no_stop = tuple((fault.t_s, fault.t_s + NO_STOP_S) for fault in faults if fault.kind == "no-stop")
        self._faults = sorted((f for f in faults if f.kind != "no-stop"), key=lambda fault: fault.t_s)
        self._edges = list(edges)
        self._flash = tempfile.TemporaryDirectory(prefix="truearm-flash-")
        write_flash(Path(self._flash.name), self._setup.config)
        self._boots = 0
        self._cause = POWER
        self._hardware: Hardware | None = None
        self._boot_at_ns: int | None = 0  # when the power comes (back)
        self._boot_ns = 0  # duration of a reset
        self.boot_device_ns = 0  # device clock at the latest boot
        self._sampling = False
        self._stalled_until_ns = 0
        self._short_write = False
        self.output = False  # level of its trigger output
        self.output_edges: list[tuple[int, bool]] = []  # of the output so far: true time [ns], level
        self.wake_ns: int | None = None  # true time at which its firmware wants to run again in any case
        self.led = 0
        self.first_ns: tuple[int | None, int | None] = (None, None)  # lab's device clock at sample 0 of each stream

    @property
    def flash(self) -> Path:
        """The folder that is its file system."""
        return Path(self._flash.name)

    @property
    def link_ns(self) -> int:
        """Time that its link takes each way within a step."""
        return 0 if self._hardware is None else self._hardware.link_ns

    def device_us(self, t_ns: int) -> int:
        """Return the time on the box's hardware timer [µs since its boot] at true time ``t_ns``."""
        return self._device_ns(t_ns) // 1000

    def true_s(self, device_us: Floats) -> Floats:
        """Return true times [s] of times on the hardware timer since the latest boot, to judge a clock fit."""
        reading = 1e-6 * device_us + 1e-9 * self.boot_device_ns
        true: Floats = self._world.clocks.device.true(reading)
        return true

    def output_at(self, t: Floats) -> NDArray[np.bool_]:
        """Return the level (m,) of its trigger output at true times (m,) [s] up to now."""
        times = 1e-9 * np.array([t_ns for t_ns, _ in self.output_edges])
        levels = np.array([False, *(level for _, level in self.output_edges)])
        return np.asarray(levels[np.searchsorted(times, t, side="right")])

    def advance(self, t_ns: int, rx: bytes = b"", tx_room: int = 0xFFFF) -> Iterator[bytes]:
        """Run the box up to true time ``t_ns``; yields the bytes it sent, step by step."""
        if self._hardware is None:
            if self._boot_at_ns is None or t_ns < self._boot_at_ns:
                return
            self._boot(t_ns)
        fault = self._due_fault(t_ns)
        if fault == "reboot":
            self._power_off(t_ns, POWER)
            return
        flags = self._flags(t_ns, fault)
        self._short_write |= fault == "short-write"
        room = min(tx_room, SHORT_WRITE) if self._short_write else tx_room
        sent = 0
        device_us = self.device_us(t_ns)
        assert self._hardware is not None
        for answer in self._hardware.advance(
            device_us, rx, self._due_edges(t_ns), room, flags, self._temperature_mdegc(t_ns)
        ):
            self._note(answer, device_us)
            sent += len(answer.tx)
            yield self._damage(answer.tx, fault)
            fault = None
            if answer.end:
                self._end(t_ns, answer.end)
                return
        self._short_write = self._short_write and sent < SHORT_WRITE  # until a frame did not fit

    def power_cycle(self, t_ns: int) -> None:
        """Cut the power; it returns as after any reset."""
        self._power_off(t_ns, POWER)

    def close(self) -> None:
        """End the firmware's process and delete the flash."""
        self._switch_off()
        self._flash.cleanup()

    # -- power

    def _boot(self, t_ns: int) -> None:
        self._boots += 1
        boot_id = int(np.random.default_rng((self._world.seed, 3, self._boots)).integers(2**32))
        self.boot_device_ns = self._world.device_clock.from_true_ns(t_ns)
        signals = Signals(self._world, self.boot_device_ns, self._no_stop)
        self._hardware = self._power_on(Boot(self.flash, self._setup, boot_id, self._cause, signals))
        self._boot_ns = self._hardware.boot_ns

    def _end(self, t_ns: int, end: str) -> None:
        """Handle the end of the firmware; at the prompt and in the boot loader the box is silent."""
        if end in _CAUSES:
            self._power_off(t_ns, _CAUSES[end])
        else:
            self._switch_off()
            self._boot_at_ns = None

    def _power_off(self, t_ns: int, cause: int) -> None:
        self._switch_off()
        if self.output:
            self._toggled(t_ns, False)
        self._cause = cause
        self._boot_at_ns = t_ns + self._boot_ns

    def _switch_off(self) -> None:
        if self._hardware is not None:
            self._hardware.close()
            self._hardware = None
        self._sampling = False
        self.wake_ns = None
        self._stalled_until_ns = 0

    # -- inputs and outputs

    def _device_ns(self, t_ns: int) -> int:
        return self._world.device_clock.from_true_ns(t_ns) - self.boot_device_ns

    def _due_edges(self, t_ns: int) -> list[Edge]:
        """Return the edges up to ``t_ns``, in device time; those before the boot met a box without power."""
        due = [edge for edge in self._edges if edge.t_ns <= t_ns]
        self._edges = self._edges[len(due) :]
        timed = [Edge(self._device_ns(edge.t_ns), edge.line, edge.rising) for edge in due]
        return [edge for edge in timed if edge.t_ns >= 0]

    def _temperature_mdegc(self, t_ns: int) -> int:
        return TEMPERATURE_MDEGC + round(1e3 * self._world.box_warmer(1e-9 * t_ns))

    def _toggled(self, t_ns: int, level: bool) -> None:
        self.output = level
        self.output_edges.append((t_ns, level))

    def _note(self, answer: Answer, device_us: int) -> None:
        self._sampling, self.led = answer.sampling, answer.led
        for device_ns, level in answer.toggles:
            self._toggled(self._world.device_clock.to_true_ns(self.boot_device_ns + device_ns), level)
        wake_us = device_us + max(1, answer.wake_us)
        self.wake_ns = self._world.device_clock.to_true_ns(self.boot_device_ns + 1000 * wake_us) + 1
        if answer.sampling:
            adc, mag = (None if first is None else self.boot_device_ns + first for first in answer.first_ns)
            self.first_ns = adc, mag

    def _flags(self, t_ns: int, fault: str | None) -> int:
        if fault == "stall":
            self._stalled_until_ns = t_ns + STALL_NS
        if fault == "hang":
            self._stalled_until_ns = 1 << 62
        return _FLAGS.get(fault or "", 0) | (STALL if t_ns < self._stalled_until_ns else 0)

    # -- faults on the link

    def _due_fault(self, t_ns: int) -> str | None:
        if self._faults and self._sampling and t_ns >= self._faults[0].t_s * 1e9:
            return self._faults.pop(0).kind
        return None

    def _damage(self, tx: bytes, fault: str | None) -> bytes:
        """Apply a fault of the link to the first data frame of ``tx``; if there is none it waits for the next bytes."""
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
