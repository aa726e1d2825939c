"""A box at VM level: the firmware in a MicroPython, supplied with what the hardware would have latched."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from . import box
from .box import RX_MAX, Answer, BoxProcess
from .hardware import BAD_CRC, CONVERTER_RESET, CRASH, STALL, Boot, Edge
from .micropython import Interpreter
from .sensors import TICK_PS, period_ns

BATCH = 100  # samples of a stream per grant, at most
_STAMPS = 4096  # made at once


@dataclass
class Feed:
    """One source's samples since its start: when the first is due (device time), how many were delivered."""

    first_ns: int
    period_ns: int
    given: int = 0
    _stamped: int = 0  # samples that have stamps
    _stamps: bytes = b""  # the latest of them

    def take(self, device_ns: int) -> tuple[int, int]:
        """Return samples k0 ≤ k < k1 that were latched up to ``device_ns`` and not delivered yet, at most BATCH."""
        due = max(0, (device_ns - self.first_ns) // self.period_ns + 1)
        k0 = self.given
        self.given = max(k0, min(due, k0 + BATCH))
        return k0, self.given

    def stamps(self, k0: int, k1: int) -> bytes:
        """Return the lower 32 bits of the hardware timer, in whole µs since boot, at the latest samples taken."""
        if k1 > self._stamped:
            self._stamped = k0 + _STAMPS
            stamps = (self.first_ns + np.arange(k0, self._stamped, dtype=np.int64) * self.period_ns) // 1000
            self._stamps = (stamps & 0xFFFFFFFF).astype(">u4").tobytes()
        end = len(self._stamps) - 4 * (self._stamped - k1)
        return self._stamps[end - 4 * (k1 - k0) : end]


class VmBox:
    """A running box (``Hardware``). ``interpreter`` None: CPython instead of MicroPython."""

    boot_ns = 1_500_000_000
    link_ns = 0

    def __init__(self, interpreter: Interpreter | None, boot: Boot) -> None:
        self._process = BoxProcess(interpreter, boot.setup, boot.boot_id, boot.cause, flash=boot.flash)
        self._signals = boot.signals
        self._adc: Feed | None = None
        self._mag: Feed | None = None
        self._starts = 0
        self._rx = b""
        self._rx_room = RX_MAX
        self._fed_us = 0  # when the firmware last fed its watchdog
        self._output = False

    def advance(
        self, device_us: int, rx: bytes, edges: Sequence[Edge], tx_room: int, flags: int, temperature_mdegc: int
    ) -> Iterator[Answer]:
        """See ``Hardware``."""
        self._rx += rx
        pending = list(edges)
        thermometers = b"".join(box.THERMOMETER.pack(*one) for one in self._signals.thermometers(device_us))
        flying = (box.FAULT_CRC if flags & BAD_CRC else 0) | (box.FAULT_RESET if flags & CONVERTER_RESET else 0)
        while True:
            adc, adc_index = _taken(self._adc, device_us, self._adc_records)
            mag, mag_index = _taken(self._mag, device_us, self._mag_records)
            now, pending = pending[: box.EDGES_MAX], pending[box.EDGES_MAX :]
            sent, self._rx = _split(self._rx, min(RX_MAX, self._rx_room))
            given = box.Grant(
                device_us,
                rx=sent,
                samples=adc,
                index=adc_index,
                mag=mag,
                mag_index=mag_index,
                edges=b"".join(_edge_record(edge) for edge in now),
                tx_room=tx_room,
                flags=(box.STALL if flags & STALL else 0) | (box.CRASH if flags & CRASH else 0),
                fault=flying if adc else 0,
                temperature_mdegc=temperature_mdegc,
                thermometers=thermometers,
                readings=self._signals.readings(device_us),
            )
            answer = self._process.grant(given)
            flags &= STALL
            flying = 0 if adc else flying
            tx_room -= len(answer.tx)
            answer = self._judged(answer, device_us)
            yield answer
            if answer.end or not (pending or self._more(device_us)):
                return

    def close(self) -> None:
        """End the firmware's process."""
        self._process.close()

    def _adc_records(self, feed: Feed, k0: int, k1: int) -> bytes:
        counts = self._signals.counts(k0, k1, feed.first_ns, feed.period_ns)
        return feed.stamps(k0, k1) + counts.astype("<i4", copy=False).tobytes()

    def _mag_records(self, feed: Feed, k0: int, k1: int) -> bytes:
        flights = self._signals.flight_times(k0, k1, feed.first_ns, feed.period_ns)
        # The start pulse begins in the middle of a tick, here as in the chip's model. 0 is below any blanking time.
        ticks = (np.maximum(flights, 0) + TICK_PS // 2) // TICK_PS
        return feed.stamps(k0, k1) + ticks.astype("<i4").tobytes()

    def _judged(self, answer: Answer, device_us: int) -> Answer:
        """Apply the answer's state of the hardware; a watchdog that was not fed ends the box."""
        self._rx_room = answer.rx_room
        if answer.starts != self._starts:
            self._starts = answer.starts
            period = period_ns(answer.osr)
            self._adc = Feed(device_us * 1000 + period, period)
            self._mag = None
            if answer.mag_sampling:
                self._mag = Feed(device_us * 1000 + answer.mag_period_ns, answer.mag_period_ns)
        toggles = ((1000 * device_us, answer.output),) if answer.output != self._output else ()
        self._output = answer.output
        answer = answer._replace(first_ns=(_first_ns(self._adc), _first_ns(self._mag)), toggles=toggles)
        if not answer.sampling:
            self._adc = self._mag = None
        if answer.alive:
            self._fed_us = device_us
        elif answer.watchdog_ms and device_us - self._fed_us > 1000 * answer.watchdog_ms:
            return answer._replace(end="watchdog")
        return answer

    def _more(self, device_us: int) -> bool:
        feeds = (feed for feed in (self._adc, self._mag) if feed is not None)
        return any(feed.first_ns + feed.given * feed.period_ns <= 1000 * device_us for feed in feeds)


def _taken(feed: Feed | None, device_us: int, records: Callable[[Feed, int, int], bytes]) -> tuple[bytes, int]:
    """Return records of the samples that are due, and the index of the first."""
    if feed is None:
        return b"", 0
    k0, k1 = feed.take(1000 * device_us)
    return (records(feed, k0, k1) if k1 > k0 else b""), k0


def _first_ns(feed: Feed | None) -> int | None:
    return None if feed is None else feed.first_ns


def _split(data: bytes, n: int) -> tuple[bytes, bytes]:
    return data[:n], data[n:]


def _edge_record(edge: Edge) -> bytes:
    return bytes([edge.line, edge.rising]) + (edge.t_ns // 1000 & 0xFFFFFFFF).to_bytes(4, "big")
