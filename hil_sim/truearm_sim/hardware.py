"""The parts of a simulated box: a process that runs its firmware, and the signals that it samples.

:class:`Hardware` is the interface of both levels: the firmware in a MicroPython with a simulated board (``vmbox.py``),
and the chip's own image in an emulator. Time advances by grants. What the parts measure is a pure function of device
time and sample index, :class:`Signals`. The first level receives it, the second requests it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .box import Answer, BoxSetup
from .sensors import CALIBRATED_MDEGC
from .world import World

# Effects that a grant may have on the box other than letting it run.
STALL, CRASH, BAD_CRC, CONVERTER_RESET = 1, 2, 4, 8
TEMPERATURE_MDEGC = CALIBRATED_MDEGC  # of the box, unless the world warms up


@dataclass(frozen=True)
class Edge:
    """An edge of a trigger input at ``t_ns``: true time when reported to the lab, device time since boot in a grant."""

    t_ns: int
    line: int
    rising: bool


@dataclass(frozen=True)
class Signals:
    """The inputs of a box since its boot, by its own clock. ``no_stop``: true times [s] without stop pulses."""

    world: World
    boot_device_ns: int
    no_stop: tuple[tuple[float, float], ...] = ()

    def counts(self, k0: int, k1: int, start_ns: int, period_ns: int) -> NDArray[np.int32]:
        """Return the converter's samples k0 ≤ k < k1 as (n, 4); sample 0 is converted ``start_ns`` after boot."""
        return self.world.counts(k0, k1, self.boot_device_ns + start_ns, period_ns)

    def flight_times(self, k0: int, k1: int, start_ns: int, period_ns: int) -> NDArray[np.int64]:
        """Return times of flight (n,) [ps] of shots k0 ≤ k < k1, −1 without a stop; shot 0: ``start_ns`` after boot."""
        flights = self.world.flight_times(k0, k1, self.boot_device_ns + start_ns, period_ns)
        if self.no_stop:
            device_ns = self.boot_device_ns + start_ns + np.arange(k0, k1, dtype=np.int64) * period_ns
            t = self.world.clocks.device.true(1e-9 * device_ns)
            for begin, end in self.no_stop:
                flights = np.where((t >= begin) & (t < end), -1, flights)
        return flights

    def thermometers(self, device_us: int) -> tuple[tuple[bytes, int], ...]:
        """Return address and m°C of each thermometer on the wire at this time after boot."""
        if not self.world.has_thermometers:
            return ()
        t = self.world.clocks.device.true(np.array([1e-9 * self.boot_device_ns + 1e-6 * device_us]))
        return self.world.thermometers(float(t[0]))

    def readings(self, device_us: int) -> bytes:
        """Return what the further sensors read at this time after boot, as little-endian 32-bit integers by channel."""
        t = self.world.clocks.device.true(np.array([1e-9 * self.boot_device_ns + 1e-6 * device_us]))
        return self.world.readings(float(t[0]))


@dataclass(frozen=True)
class Boot:
    """A power-up or reset with its initial state. ``flash``: a folder that outlives it, created by ``write_flash``."""

    flash: Path
    setup: BoxSetup
    boot_id: int
    cause: int
    signals: Signals


class Hardware(Protocol):
    """A box from one boot to its end. ``boot_ns``: duration of a reset before it, if booting itself takes no time.

    ``link_ns``: time that its link takes each way within a grant.
    """

    boot_ns: int
    link_ns: int

    def advance(
        self, device_us: int, rx: bytes, edges: Sequence[Edge], tx_room: int, flags: int, temperature_mdegc: int
    ) -> Iterator[Answer]:
        """Run up to ``device_us`` after boot, in one or more steps.

        The last answer has an ``end`` if the firmware ended.

        ``rx``: bytes from the host; those that the box does not accept yet are kept for it. The link accepts
        ``tx_room`` bytes. Answers report whether the box samples, and since which times (``first_ns``).
        """

    def close(self) -> None:
        """End the running process."""


PowerOn = Callable[[Boot], Hardware]
