"""A source of samples that the main loop reads when they are due.

It is a sensor on SPI, I2C or UART, at up to some hundred hertz.

A sensor has a `stream`, its entry in the ident without id, and `read(out)`, which puts a little-endian 32-bit integer
for each channel into `out` and returns whether the sensor answered; an OSError, of I2C without an acknowledge, says no
too. It takes at most a millisecond and does not allocate.

A sample is late by up to a pass of the main loop, some milliseconds. One that was not read, or that the sensor did not
answer, is lost and counted.
"""

import gc

from truearm_wire.fast import add, copy, micropython
from truearm_wire.messages import COUNTER

from .toggle import LATER

BLOCK_US = 500000  # a slow sensor's block is not longer
ERRORS = 50  # a collection, 10 ms, frees the memory of so many exceptions, some kB


TAKEN = ("adc", "mag", "event", "heartbeat", "ident", "temperature", "sync", "reply", "other", "console")


def polled(board, block_bytes):
    """Return a source for each further sensor of the board."""
    names = list(TAKEN)  # of topics of the host
    for sensor in board.sensors:
        name, period_ns = sensor.stream["name"], sensor.stream["period_ns"]
        if name in names:
            raise ValueError("stream %s: the name is taken" % name)
        if not 1 <= len(sensor.stream["channels"]) <= block_bytes // 4:
            raise ValueError("stream %s: it needs 1 to %d channels" % (name, block_bytes // 4))
        if not 1000000 <= period_ns <= 4000000000 or period_ns % 1000:
            raise ValueError("stream %s: its period is not in whole microseconds, 1 ms to 4 s" % name)
        names.append(name)
    return [Polled(board, sensor, block_bytes) for sensor in board.sensors]


class Polled:
    def __init__(self, board, sensor, block_bytes):
        self.channels = len(sensor.stream["channels"])
        self._board = board
        self._sensor = sensor
        self._size = 4 * self.channels
        self.period_ns = sensor.stream["period_ns"]
        self._period_us = self.period_ns // 1000
        self.block = max(1, min(block_bytes // self._size, BLOCK_US // self._period_us))  # samples
        self._samples = bytearray(self.block * self._size)  # contiguous ones
        self._sample = bytearray(self._size)
        self._first = bytearray(8)  # index of the oldest
        self._next = bytearray(8)  # index of the next
        self._stamp = bytearray(8)  # time of the oldest
        self._running = False
        self._n = 0  # contiguous samples that wait
        self._errors = 0  # since the last collection

    def start(self, rate):
        self._n = 0
        self._lost = 0  # before the waiting samples
        self._missed = 0  # after them
        self._gap = False  # no sample follows the waiting ones without a gap
        for i in range(8):
            self._next[i] = 0
        self._due = self._board.ticks()  # time of the newest period's begin
        self._running = True

    def stop(self):
        self._running = False

    def wait(self):
        """Return the microseconds until the next sample is due."""
        if not self._running:
            return LATER
        return max(0, self._period_us - self._board.ticks_diff(self._board.ticks(), self._due))

    def waiting(self):
        return self._n

    @micropython.native
    def take(self, n, dst, at, index, stamp):
        self._poll()
        if self._n < n:
            return False
        copy(dst, at, self._samples, 0, n * self._size)
        copy(index, 0, self._first, 0, 8)
        copy(stamp, 0, self._stamp, 4, 4)
        self._n = 0  # the stream takes all: a block, or the rest before a gap
        self._gap = False
        return True

    def broken(self):
        return self._gap or (self._n == 0 and self._lost > 0)

    def lost(self):
        n = self._lost
        self._lost = self._missed
        self._missed = 0
        return n

    def fault(self):
        return 0

    def _poll(self):
        """Read a sample if it is due. After a gap, none is read until the samples before it were taken."""
        if not self._running:
            return
        periods = self._board.ticks_diff(self._board.ticks(), self._due) // self._period_us
        if periods == 0:
            return
        self._due = (self._due + periods * self._period_us) & COUNTER
        add(self._next, 0, 8, periods - 1)
        if self._n == 0:
            copy(self._first, 0, self._next, 0, 8)
            self._board.now(self._stamp)
            self._lost += periods - 1
            if not self._read():
                self._lost += 1
        elif self._gap or periods > 1 or not self._read():
            self._gap = True
            self._missed += periods
        add(self._next, 0, 8, 1)

    def _read(self):
        if not self._answered():
            return False
        copy(self._samples, self._n * self._size, self._sample, 0, self._size)
        self._n += 1
        return True

    @micropython.native
    def _answered(self):
        try:
            return self._sensor.read(self._sample)
        except OSError:
            self._errors += 1
        if self._errors >= ERRORS:
            gc.collect()
            self._errors = 0
        return False
