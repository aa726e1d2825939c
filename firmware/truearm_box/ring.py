"""Data that wait to be sent, in preallocated buffers: frames of samples, and trigger edges.

A frame is built in a slot of the ring and sent from there, without copies.
"""

from array import array

from truearm_wire.fast import add, copy, extend, less, micropython
from truearm_wire.messages import COUNTER

SLOT = 252  # the longest data frame (13 samples of 4 x 32 bit) has 251 bytes


class Ring:
    def __init__(self, slots):
        """Create `slots` slots, and one for data discarded while the ring is full."""
        self.buf = bytearray((slots + 1) * SLOT)
        self._ends = array("H", bytearray(2 * (slots + 1)))  # end of the payload in each slot, relative to the slot
        self._slots = slots
        self._head = 0  # next slot to fill
        self.used = 0
        self.overruns = 0  # samples lost in the box

    def full(self):
        return self.used == self._slots

    def claim(self):
        """Return the offset of the slot to fill next; the spare one while the ring is full."""
        return (self._slots if self.used == self._slots else self._head) * SLOT

    def commit(self, end):
        """Keep the claimed slot's payload, which ends at offset `end` of the buffer. Only if the ring was not full."""
        self._ends[self._head] = end - self._head * SLOT
        self._head = (self._head + 1) % self._slots
        self.used += 1

    def oldest(self):
        """Return the offset of the oldest slot."""
        return ((self._head - self.used) % self._slots) * SLOT

    def oldest_end(self):
        """Return the offset after the oldest slot's payload."""
        slot = (self._head - self.used) % self._slots
        return slot * SLOT + self._ends[slot]

    def release(self):
        """Free the oldest slot, which has been sent."""
        self.used -= 1

    def lose(self, n):
        """Count n samples that are in no slot."""
        self.overruns = (self.overruns + n) & COUNTER


class Events:
    """Trigger edges that wait to be sent, with their stamps in full time. Fixed records in one buffer."""

    RECORD = 10  # line, edge, time (8)

    def __init__(self, size=32):
        self._buf = bytearray(size * self.RECORD)
        self._size = size
        self._first = 0
        # time until which edges of lines 0 and 1 are bounces of one that was kept
        self._quiet = (bytearray(8), bytearray(8))
        self.used = 0
        self.dropped = 0

    @micropython.native
    def put(self, edge, now, full, debounce_us):
        """Keep an edge of the board (line, rising, stamp of 4 bytes); `full` is scratch of 8 bytes.

        Drops it if there is no space.

        `debounce_us` of lines 0 and 1: an edge this soon after a kept one of its line is ignored.
        """
        extend(now, edge, 2, full, 0)
        if edge[0] < 2 and debounce_us[edge[0]] and self._bounces(self._quiet[edge[0]], full, debounce_us[edge[0]]):
            return
        if self.used == self._size:
            self.dropped = (self.dropped + 1) & COUNTER
            return
        at = (self._first + self.used) % self._size * self.RECORD
        self._buf[at] = edge[0]
        self._buf[at + 1] = edge[1]
        copy(self._buf, at + 2, full, 0, 8)
        self.used += 1

    def _bounces(self, quiet, full, us):
        if less(full, quiet, 8):
            return True
        copy(quiet, 0, full, 0, 8)
        add(quiet, 0, 8, us)
        return False

    def take(self, edge, full):
        """Take the oldest edge: line and edge to `edge`, its time to `full`."""
        at = self._first * self.RECORD
        copy(edge, 0, self._buf, at, 2)
        copy(full, 0, self._buf, at + 2, 8)
        self._first = (self._first + 1) % self._size
        self.used -= 1
