"""The simulated board: hardware that lives in the parent process and moves on by grants, over standard input and output.

A grant says: it is now this device time; these bytes came over the link, these samples and edges were latched; the link
takes so many bytes. The firmware then runs until it has nothing to do; everything it sent goes back in one answer. Time
stands still in between, so a run is deterministic, and as fast as the two processes are. Real time is the same
thing with grants given by the wall clock. (The parent's half is truearm_sim/box.py.)

    grant   "G" flags  n_rx:u16  n_samples:u16  tx_room:u16  now:u64  index:u64  temperature:i32  n_edges:u8
            then rx bytes, samples (stamp:u32, 4 x i32 little endian), edges (line, rising, stamp:u32); 4096 bytes at most
    answer  "D" flags  osr:u16  rx_room:u16  n_tx:u16, then tx bytes

All big endian but the counts. Flags of a grant: 1 the firmware stalls (gets the samples, does not run), 2 the next block
raises an exception, 4 quit. Flags of an answer: 1 sampling, 2 reset. `rx_room` is flow control, as USB has: the parent keeps
what would not fit.
"""

import gc
import json
import sys

from truearm_wire.fast import add, copy

GRANT = 29
ANSWER = 8
MESSAGE_MAX = 4096  # what a pipe passes in one piece
TX_MAX = 16384
RX_MAX = 1024
FIFO = 512  # samples: half a second at 1 kHz
SAMPLE = 16
RECORD = 4 + SAMPLE
EDGE = 6
EDGES = 64  # that the board holds


class Stopped(SystemExit):
    """The parent has closed the pipe."""


if sys.implementation.name == "micropython":

    def _read(buf, n):
        return sys.stdin.buffer.readinto(buf, n)

    def _write(buf, n):
        sys.stdout.buffer.write(buf, n)

else:
    import os

    def _read(buf, n):
        return os.readv(0, [memoryview(buf)[:n]])

    def _write(buf, n):
        done = 0
        while done < n:
            done += os.write(1, memoryview(buf)[done:n])


def _u16(buf, at):
    return buf[at] << 8 | buf[at + 1]


class Board:
    def __init__(self):
        setup = json.loads(sys.argv[1])
        self.uid = bytes(setup["uid"])
        self.boot_id = bytes(setup["boot_id"])
        self.reset_cause = setup["reset_cause"]
        self.ring_slots = setup["ring_slots"]
        self.config_path = setup["config"]
        self._head = bytearray(GRANT)
        self._body = bytearray(MESSAGE_MAX)
        self._rx = bytearray(RX_MAX)  # a ring, as the next two
        self._rx_first = 0
        self._rx_n = 0
        self._edge_fifo = bytearray(EDGES * EDGE)
        self._edge_first = 0
        self._edge_n = 0
        self._fifo = bytearray(FIFO * RECORD)
        self._first = 0  # place of the oldest sample
        self._count = 0
        self._index = bytearray(8)  # of the oldest sample
        self._lost = 0
        self._crash = False
        self._temperature = 0
        self._tx = bytearray(ANSWER + TX_MAX)
        self._tx_n = 0
        self._tx_room = 0
        self._sampling = 0
        self._osr = 0
        self._flags = 0
        self._wait()

    # -- grants

    def idle(self):
        """Answer, and wait for the next grant."""
        self._answer()
        self._wait()

    def _wait(self):
        while self._grant():  # a stall: the hardware goes on, the firmware does not
            self._answer()

    def _answer(self):
        tx = self._tx
        tx[0] = 68  # "D"
        tx[1] = self._sampling | self._flags
        tx[2] = self._osr >> 8
        tx[3] = self._osr & 255
        tx[4] = (RX_MAX - self._rx_n) >> 8
        tx[5] = (RX_MAX - self._rx_n) & 255
        tx[6] = self._tx_n >> 8
        tx[7] = self._tx_n & 255
        _write(tx, ANSWER + self._tx_n)
        self._tx_n = 0

    def _read_exactly(self, buf, n):
        got = _read(buf, n)
        if got == 0 and n:
            raise Stopped
        if got != n:
            raise OSError("a grant came in pieces")

    def _grant(self):
        head = self._head
        self._read_exactly(head, GRANT)
        if head[0] != 71:  # "G"
            raise OSError("not a grant")
        if head[1] & 4:
            raise Stopped
        n_rx = _u16(head, 2)
        n_samples = _u16(head, 4)
        size = n_rx + n_samples * RECORD + head[28] * EDGE
        if size:
            self._read_exactly(self._body, size)
        self._take_rx(n_rx)
        self._take_edges(n_rx + n_samples * RECORD, head[28])
        self._tx_room = _u16(head, 6)
        self._temperature = (head[24] - 256 if head[24] & 128 else head[24]) * 16777216 + (
            head[25] << 16 | head[26] << 8 | head[27]
        )
        if head[1] & 2:
            self._crash = True
        self._latch(n_rx, n_samples)
        return head[1] & 1

    def _take_rx(self, n):
        if self._rx_n + n > RX_MAX:
            raise OSError("more bytes than rx_room")
        for i in range(n):
            self._rx[(self._rx_first + self._rx_n) % RX_MAX] = self._body[i]
            self._rx_n += 1

    def _take_edges(self, at, n):
        for i in range(n):
            if self._edge_n < EDGES:  # what a real latch has no room for is gone
                place = (self._edge_first + self._edge_n) % EDGES
                copy(self._edge_fifo, place * EDGE, self._body, at + i * EDGE, EDGE)
                self._edge_n += 1

    def _latch(self, at, n):
        """Samples into the hardware buffer; one that is lapped loses everything it held, as a DMA ring does."""
        if self._count + n > FIFO:
            self._lost += self._count
            self._count = 0
            self._first = 0
        if self._count == 0 and n:
            copy(self._index, 0, self._head, 16, 8)
        for i in range(n):
            place = (self._first + self._count) % FIFO
            copy(self._fifo, place * RECORD, self._body, at + i * RECORD, RECORD)
            self._count += 1

    # -- what the firmware calls

    def now(self, buf):
        copy(buf, 0, self._head, 8, 8)

    def ticks(self):
        head = self._head
        return (head[12] & 63) << 24 | head[13] << 16 | head[14] << 8 | head[15]

    def ticks_diff(self, a, b):
        return (a - b) & 0x3FFFFFFF

    def receive(self, buf):
        n = min(self._rx_n, len(buf))
        for i in range(n):
            buf[i] = self._rx[self._rx_first]
            self._rx_first = (self._rx_first + 1) % RX_MAX
        self._rx_n -= n
        return n

    def send(self, buf, at, n):
        n = min(n, self._tx_room, TX_MAX - self._tx_n)
        copy(self._tx, ANSWER + self._tx_n, buf, at, n)
        self._tx_n += n
        self._tx_room -= n
        return n

    def start(self, osr):
        self._osr = osr
        self._sampling = 1
        self._count = 0
        self._first = 0
        self._lost = 0

    def stop(self):
        self._sampling = 0

    def waiting(self):
        return self._count

    def take(self, n, dst, at, index, stamp):
        if self._count < n:
            return False
        if self._crash:
            self._crash = False
            raise RuntimeError("injected by the simulator")
        copy(stamp, 0, self._fifo, self._first * RECORD, 4)
        copy(index, 0, self._index, 0, 8)
        for i in range(n):
            copy(dst, at + i * SAMPLE, self._fifo, self._first * RECORD + 4, SAMPLE)
            self._first = (self._first + 1) % FIFO
        self._count -= n
        add(self._index, 0, 8, n)
        return True

    def lost(self):
        n = self._lost
        self._lost = 0
        return n

    def converter_fault(self):
        return False

    def edge(self, edge):
        if self._edge_n == 0:
            return False
        copy(edge, 0, self._edge_fifo, self._edge_first * EDGE, EDGE)
        self._edge_first = (self._edge_first + 1) % EDGES
        self._edge_n -= 1
        return True

    def heap_free(self):
        return gc.mem_free() if hasattr(gc, "mem_free") else 0

    def temperature_mdegc(self):
        return self._temperature

    def console(self, text):
        data = b"\0" + text.encode() + b"\0"
        n = min(len(data), TX_MAX - self._tx_n)
        self._tx[ANSWER + self._tx_n : ANSWER + self._tx_n + n] = data[:n]
        self._tx_n += n

    def reset(self):
        self._flags = 2
        self._sampling = 0
        self._answer()
        sys.exit(0)
