"""A ring of frame slots in one preallocated buffer. A slot is where a frame is built and whence it is sent: no copies."""

from array import array

SLOT = 252  # the longest data frame (13 samples of 4 x 32 bit) has 251 bytes


class Ring:
    def __init__(self, slots):
        """`slots` frames fit; one slot more takes what is thrown away while the ring is full."""
        self.buf = bytearray((slots + 1) * SLOT)
        self._ends = array("H", bytearray(2 * (slots + 1)))  # end of the payload in each slot, relative to it
        self._slots = slots
        self._head = 0  # slot that is filled next
        self.used = 0

    def full(self):
        return self.used == self._slots

    def claim(self):
        """Offset of the slot to fill next; the spare one while the ring is full."""
        return (self._slots if self.full() else self._head) * SLOT

    def commit(self, end):
        """The claimed slot holds a payload that ends at offset `end` of the buffer. Only when the ring was not full."""
        self._ends[self._head] = end - self._head * SLOT
        self._head = (self._head + 1) % self._slots
        self.used += 1

    def oldest(self):
        """Offset of the oldest slot."""
        return ((self._head - self.used) % self._slots) * SLOT

    def oldest_end(self):
        """Offset behind the oldest slot's payload."""
        slot = (self._head - self.used) % self._slots
        return slot * SLOT + self._ends[slot]

    def release(self):
        """The oldest slot has been sent."""
        self.used -= 1

    def clear(self):
        self.used = 0
