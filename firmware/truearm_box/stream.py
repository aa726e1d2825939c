"""Samples into data frames: blocks of up to 208 bytes of samples, built in the ring's slots. No call allocates.

Every source of the board has a stream. All of them fill one ring, so frames are sent in the order in which blocks
became complete. Samples can be lost in two places; both are counted in `Ring.overruns` and appear as a jump of n0: in
the board (its buffer was lapped) and here (the ring is full because the link does not take the frames).
"""

from truearm_wire.cbor import SINT32_LE, put_head
from truearm_wire.fast import copy, extend, micropython
from truearm_wire.frame import HEAD
from truearm_wire.messages import DATA, FLAG_OVERRUN, STREAM_ADC, STREAM_MAG

from .toggle import LATER

BLOCK_BYTES = 208  # the most that fits in a frame: 13 samples of 4 channels, 52 of one
PERIOD_NS_PER_OSR = 240  # converter clock 125 MHz / 15, modulator at half of it

# offsets in the slot of a data frame: head, array head, type, then the elements of fixed width
_SEQ = HEAD + 2
_STREAM = _SEQ + 5
_N0 = _STREAM + 1
_T0 = _N0 + 9
_PERIOD = _T0 + 9
_SAMPLES = _PERIOD + 5


class Streams:
    """The streams of both sources, and of the board's further sensors."""

    def __init__(self, board, ring):
        self._ring = ring
        self._streams = [Stream(board, board.adc, STREAM_ADC, ring), Stream(board, board.mag, STREAM_MAG, ring)]
        self._polled = ()
        if board.sensors:
            from .polled import polled  # a simulated box's code takes its heap

            self._polled = polled(board, BLOCK_BYTES)
        for source in self._polled:
            self._streams.append(Stream(board, source, len(self._streams), ring, source.block))
        self.running = False

    def start(self, osr, mag_period_ns):
        """Start sampling; a period of 0 leaves its stream off.

        Only when no block waits: its indices would belong to another start.
        """
        self.running = True
        self._streams[0].start(osr, osr * PERIOD_NS_PER_OSR)
        if mag_period_ns:
            self._streams[1].start(mag_period_ns, mag_period_ns)
        for i in range(2, len(self._streams)):
            self._streams[i].start(0, self._polled[i - 2].period_ns)

    def stop(self):
        """Stop sampling. Existing samples move on into the ring, as it takes them."""
        for stream in self._streams:
            stream.stop()
        self.running = False

    def pull(self):
        """Move at most one block from each source into the ring. Returns whether there was one."""
        busy = False
        for stream in self._streams:
            if stream.pull():
                busy = True
        return busy

    def wait(self):
        """Return the microseconds until a sensor is to be read."""
        wait = LATER
        for source in self._polled:
            wait = min(wait, source.wait())
        return wait

    def waiting(self):
        """Return whether samples wait to be sent: blocks in the ring, or what a stop left in the sources."""
        return self._ring.used > 0 or self.ending()

    def ending(self):
        """Return whether sources that were stopped may still hold samples."""
        for stream in self._streams:
            if stream.ending:
                return True
        return False

    def send_oldest(self, link):
        """Send the oldest block of the ring."""
        ring = self._ring
        at = ring.oldest()
        link.put_seq(ring.buf, at + _SEQ)
        link.send_built(ring.buf, at, ring.oldest_end())


class Stream:
    """The stream of one source."""

    def __init__(self, board, source, number, ring, block=BLOCK_BYTES):
        self._board = board
        self._source = source
        self._ring = ring
        self._sample = 4 * source.channels  # bytes
        self._block = min(block, BLOCK_BYTES // self._sample)  # samples
        self._template = bytearray(_SAMPLES + 4)
        put_head(self._template, put_head(self._template, _SAMPLES, 6, SINT32_LE), 2, BLOCK_BYTES)
        self._template[HEAD] = 0x88  # an array of eight
        self._template[HEAD + 1] = DATA
        self._template[_SEQ] = 0x1A
        self._template[_STREAM] = number
        self._template[_N0] = 0x1B
        self._template[_T0] = 0x1B
        self._template[_PERIOD] = 0x1A
        self._now = bytearray(8)
        self._stamp = bytearray(4)
        self._index = bytearray(8)
        self._lost_before = False
        self._on = False
        self.ending = False  # stopped, and samples may wait in the source

    def start(self, rate, period_ns):
        for i in range(4):
            self._template[_PERIOD + 4 - i] = (period_ns >> (8 * i)) & 255
        self._lost_before = False
        self._on = True
        self._source.start(rate)

    def stop(self):
        if self._on:
            self._source.stop()
            self.ending = True

    def pull(self):
        if not self._on or (self.ending and self._ring.full()):
            return False
        if self._pull_block(self._block):
            return True
        if self.ending or self._source.broken():
            return self._pull_rest()
        return False

    def _pull_rest(self):
        """Move the samples that wait before a gap or the end: no more will follow them."""
        rest = min(self._source.waiting(), self._block)
        if rest == 0:  # nor does a sensor answer
            lost = self._source.lost()
            if lost:
                self._overrun(lost)
            if self.ending:
                self._on = self.ending = False
        return rest > 0 and self._pull_block(rest)

    @micropython.native
    def _pull_block(self, n):
        ring = self._ring
        at = ring.claim()
        size = n * self._sample
        samples = at + _SAMPLES + (4 if size >= 24 else 3)
        if not self._source.take(n, ring.buf, samples, self._index, self._stamp):
            return False
        lost = self._source.lost()
        if lost:
            self._overrun(lost)
        flags = self._source.fault()
        if ring.full():
            self._overrun(n)
            return True
        self._fill(ring.buf, at, size, samples, flags)
        ring.commit(samples + size + 1)
        return True

    def _overrun(self, n):
        self._ring.lose(n)
        self._lost_before = True

    @micropython.native
    def _fill(self, buf, at, size, samples, flags):
        copy(buf, at, self._template, 0, samples - at)  # with the heads of a full block
        copy(buf, at + _N0 + 1, self._index, 0, 8)
        self._board.now(self._now)
        extend(self._now, self._stamp, 0, buf, at + _T0 + 1)
        if size != BLOCK_BYTES:
            put_head(buf, at + _SAMPLES + 2, 2, size)
        buf[samples + size] = flags | FLAG_OVERRUN if self._lost_before else flags
        self._lost_before = False
