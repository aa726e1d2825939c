"""Samples into data frames: blocks of up to 13 samples of 4 channels, built in the ring's slots. No call allocates.

Samples are lost in two places, and both are counted in `overruns` and show as a jump of n0: in the board (its buffer was
lapped) and here (the ring is full because the link does not take the frames).
"""

from truearm_wire.cbor import SINT32_LE, put_head
from truearm_wire.fast import copy, extend
from truearm_wire.frame import HEAD
from truearm_wire.messages import DATA, FLAG_CONVERTER, FLAG_OVERRUN

from .ring import COUNTER

CHANNELS = 4
SAMPLE = 4 * CHANNELS  # bytes
BLOCK = 13  # samples: the most that fit a frame
PERIOD_NS_PER_OSR = 240  # converter clock 125 MHz / 15, modulator at half of it

# offsets in the slot of a data frame: head, array head, type, then the elements of fixed width
_SEQ = HEAD + 2
_STREAM = _SEQ + 5
_N0 = _STREAM + 1
_T0 = _N0 + 9
_PERIOD = _T0 + 9
_SAMPLES = _PERIOD + 5


class Stream:
    def __init__(self, board, ring):
        self._board = board
        self._ring = ring
        self._template = bytearray(_SAMPLES)
        self._template[HEAD] = 0x88  # an array of eight
        self._template[HEAD + 1] = DATA
        self._template[_SEQ] = 0x1A
        self._template[_N0] = 0x1B
        self._template[_T0] = 0x1B
        self._template[_PERIOD] = 0x1A
        self._now = bytearray(8)
        self._stamp = bytearray(4)
        self._index = bytearray(8)
        self._lost_before = False
        self.overruns = 0
        self.running = False
        self.osr = 0

    def start(self, osr):
        """Start sampling. Only when no block waits: their indices would belong to another start."""
        period_ns = osr * PERIOD_NS_PER_OSR
        for i in range(4):
            self._template[_PERIOD + 4 - i] = (period_ns >> (8 * i)) & 255
        self._lost_before = False
        self.osr = osr
        self.running = True
        self._board.start(osr)

    def waiting(self):
        """Whether blocks wait to be sent."""
        return self._ring.used > 0

    def stop(self):
        """Stop sampling; what was sampled stays in the ring."""
        self._board.stop()
        self.pull()
        rest = self._board.waiting()
        if rest:
            self._pull_block(rest)
        self.running = False

    def pull(self):
        """Move every whole block that the board has into the ring. Returns whether there was one."""
        if not self.running or not self._pull_block(BLOCK):
            return False
        while self._pull_block(BLOCK):
            pass
        return True

    def _pull_block(self, n):
        ring = self._ring
        keep = not ring.full()
        at = ring.claim()
        samples = at + _SAMPLES + (4 if n * SAMPLE >= 24 else 3)
        if not self._board.take(n, ring.buf, samples, self._index, self._stamp):
            return False
        lost = self._board.lost()
        if lost:
            self._overrun(lost)
        if not keep:
            self._overrun(n)
            return True
        self._fill(ring.buf, at, n, samples)
        ring.commit(samples + n * SAMPLE + 1)
        return True

    def _overrun(self, n):
        self.overruns = (self.overruns + n) & COUNTER
        self._lost_before = True

    def _fill(self, buf, at, n, samples):
        copy(buf, at, self._template, 0, _SAMPLES)
        copy(buf, at + _N0 + 1, self._index, 0, 8)
        self._board.now(self._now)
        extend(self._now, self._stamp, 0, buf, at + _T0 + 1)
        put_head(buf, put_head(buf, at + _SAMPLES, 6, SINT32_LE), 2, n * SAMPLE)
        flags = FLAG_OVERRUN if self._lost_before else 0
        if self._board.converter_fault():
            flags |= FLAG_CONVERTER
        buf[samples + n * SAMPLE] = flags
        self._lost_before = False

    def send_oldest(self, link):
        """Send the oldest block of the ring."""
        ring = self._ring
        at = ring.oldest()
        link.put_seq(ring.buf, at + _SEQ)
        link.send_built(ring.buf, at, ring.oldest_end())
