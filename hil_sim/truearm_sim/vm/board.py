"""The simulated board: its hardware is in the parent process and advances by grants, over standard input and output.

A grant contains the device time, bytes received over the link, latched samples and edges, and the number of bytes that
the link accepts. The firmware then runs until it has nothing to do; everything it sent goes back in one answer. Time
stands still in between, so a run is deterministic, and as fast as the two processes are. Real time is the same with
grants timed by the wall clock. (The parent's half is truearm_sim/box.py.)

    grant   "G" flags  n_rx:u16  tx_room:u16  now:u64  temperature:i32  n_edges:u8  fault:u8
            n_adc:u16  index_adc:u64  n_mag:u16  index_mag:u64  n_thermometers:u8
            then rx bytes, stamps:u32 of the converter's samples and the samples (4 x i32 little endian), the same
            of the magnetostrictive head (ticks:i32 little endian), edges (line, rising, stamp:u32), thermometers
            (uid:8, temperature:i32, 0x7fffffff: it does not answer), what each further sensor would read now (i32
            little endian for each channel); 4096 bytes at most
    answer  "D" flags  led:u8  osr:u16  mag_period:u32  watchdog_ms:u16  rx_room:u16  starts:u8  n_tx:u16
            wake:u32, then tx bytes

All big endian except the samples. Flags of a grant: 1 the firmware stalls (gets the samples, does not run), 2 the next
block raises an exception, 4 quit. `fault` is of the last converter sample: 1 its CRC was wrong, 2 the reset bit was
set. Flags of an answer: 1 the converter samples, 2 reset, 4 the magnetostrictive head samples, 8 the trigger output is
high, 16 the firmware fed its watchdog, 32 it left for the prompt, 64 for the boot loader. `rx_room` is flow control, as
in USB: the parent keeps what does not fit. `wake`: the firmware wants to run again after this many microseconds in any
case; a real one always runs.
"""

import gc
import json
import sys

from truearm_box.temperatures import DONE, FAILED
from truearm_wire.fast import add, copy
from truearm_wire.frame import close
from truearm_wire.messages import COUNTER, FLAG_CONVERTER, FLAG_MISSING_STOP

GRANT = 41
ANSWER = 20
MESSAGE_MAX = 4096  # what a pipe passes in one piece
TX_MAX = 16384
RX_MAX = 1024
FIFO = 512  # samples: half a second at 1 kHz
EDGE = 6
THERMOMETER = 12
EDGES = 64  # capacity of the board
STAMP = 4
TICK_NS = 8
LATER = 1 << 29  # µs: nothing is due

RESET, OUTPUT, ALIVE, PROMPT, BOOT_LOADER = 2, 8, 16, 32, 64


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


def _into_ring(ring, width, place, src, at, n):
    """Copy n records of this width into a ring, from a place on."""
    room = len(ring) // width - place
    if n <= room:
        copy(ring, place * width, src, at, n * width)
    else:
        copy(ring, place * width, src, at, room * width)
        copy(ring, 0, src, at + room * width, (n - room) * width)


def _out_of_ring(ring, width, place, dst, at, n):
    """Copy n records of this width out of a ring, from a place on."""
    room = len(ring) // width - place
    if n <= room:
        copy(dst, at, ring, place * width, n * width)
    else:
        copy(dst, at, ring, place * width, room * width)
        copy(dst, at + room * width, ring, 0, (n - room) * width)


class Source:
    """Samples of one kind that the parent latched, in a ring. `crash` makes the next take raise an exception."""

    def __init__(self, channels):
        self.channels = channels
        self.sample = 4 * channels  # bytes
        self.crc_errors = 0
        self.resets = 0
        self.missing = 0
        self.rate = 0
        self.sampling = False
        self.starts = 0
        self.crash = False
        self.shortest = 0  # ticks that count as a stop, of the magnetostrictive head
        self.longest = 0
        self._stamps = bytearray(FIFO * STAMP)  # rings, as the next two
        self._samples = bytearray(FIFO * self.sample)
        self._flags = bytearray(FIFO)
        self._flagged = 0  # samples whose flags are not 0
        self._first = 0  # position of the oldest sample
        self._count = 0
        self._index = bytearray(8)  # of the oldest sample
        self._lost = 0
        self._fault = 0

    def start(self, rate):
        self.rate = rate
        self.sampling = True
        self.starts = (self.starts + 1) & 255
        self._forget()
        self._lost = 0
        self._fault = 0

    def stop(self):
        self.sampling = False

    def waiting(self):
        return self._count

    def broken(self):
        return False

    def take(self, n, dst, at, index, stamp):
        if self._count < n:
            return False
        if self.crash:
            self.crash = False
            raise RuntimeError("injected by the simulator")
        first = self._first
        copy(stamp, 0, self._stamps, first * STAMP, STAMP)
        copy(index, 0, self._index, 0, 8)
        _out_of_ring(self._samples, self.sample, first, dst, at, n)
        if self._flagged:
            self._fault |= self._taken_flags(n)
        self._first = (first + n) % FIFO
        self._count -= n
        add(self._index, 0, 8, n)
        return True

    def _taken_flags(self, n):
        """Return all flags of the oldest n samples and clear them."""
        flags = 0
        for i in range(n):
            place = (self._first + i) % FIFO
            if self._flags[place]:
                flags |= self._flags[place]
                self._flags[place] = 0
                self._flagged -= 1
        return flags

    def _forget(self):
        if self._flagged:
            self._taken_flags(self._count)
        self._count = 0
        self._first = 0

    def lost(self):
        n = self._lost
        self._lost = 0
        return n

    def fault(self):
        flags = self._fault
        self._fault = 0
        return flags

    def latch(self, body, at, n, head, index_at, fault):
        """Put samples into the hardware buffer; if it is lapped it loses all its content, as a DMA ring does."""
        if self._count + n > FIFO:
            self._lost += self._count
            self._forget()
        if self._count == 0 and n:
            copy(self._index, 0, head, index_at, 8)
        place = (self._first + self._count) % FIFO
        _into_ring(self._stamps, STAMP, place, body, at, n)
        _into_ring(self._samples, self.sample, place, body, at + n * STAMP, n)
        self._count += n
        if self.longest:
            self._judge_stops(place, n)
        if n and fault:
            self._flag((place + n - 1) % FIFO, FLAG_CONVERTER)
        self.crc_errors = (self.crc_errors + (fault & 1)) & COUNTER
        self.resets = (self.resets + (fault >> 1)) & COUNTER

    def _flag(self, place, flag):
        if not self._flags[place]:
            self._flagged += 1
        self._flags[place] |= flag

    def _judge_stops(self, place, n):
        """Set times of flight outside of blanking and time-out to 0."""
        ticks = self._samples
        for i in range(n):
            at = (place + i) % FIFO * 4
            if (
                ticks[at + 3] == 0
                and self.shortest <= ticks[at] | ticks[at + 1] << 8 | ticks[at + 2] << 16 <= self.longest
            ):
                continue
            for k in range(at, at + 4):
                ticks[k] = 0
            self.missing = (self.missing + 1) & COUNTER
            self._flag(at // 4, FLAG_MISSING_STOP)


class Thermometers:
    """The bus of thermometers: each answers at once with the parent's last value."""

    def __init__(self):
        self._records = bytearray()
        self._uid = None
        self.uids = ()
        self.mdegc = 0

    def latch(self, body, at, n):
        """Store the parent's values of n thermometers; allocates only at the first grant."""
        if len(self._records) != n * THERMOMETER:
            self._found(body, at, n)
        copy(self._records, 0, body, at, n * THERMOMETER)

    def _found(self, body, at, n):
        self._records = bytearray(n * THERMOMETER)
        self.uids = tuple([bytes(body[at + i * THERMOMETER :][:8]) for i in range(n)])

    def begin(self, uid):
        self._uid = uid

    def step(self):
        answered = FAILED
        for i in range(len(self.uids)):
            at = i * THERMOMETER
            if self._records[at + 8] == 127:
                continue
            if self._uid is None:
                answered = DONE
            elif self.uids[i] == self._uid:
                high = self._records[at + 8]
                self.mdegc = (high - 256 if high & 128 else high) * 16777216 + (
                    self._records[at + 9] << 16 | self._records[at + 10] << 8 | self._records[at + 11]
                )
                answered = DONE
        return answered


class Board:
    name = "vm"
    shortest_period_ns = 245760  # of a Pico
    sensors = ()

    def __init__(self):
        with open("board.json") as f:
            setup = json.load(f)
        self.uid = bytes(setup["uid"])
        self.boot_id = bytes(setup["boot_id"])
        self.reset_cause = setup["reset_cause"]
        self.ring_slots = setup["ring_slots"]
        self.config_path = setup["config"]
        self.error_path = setup["error"]
        self._measured = setup["self_test"]
        self.adc = Source(4)
        self.mag = Source(1)
        self.thermometers = Thermometers()
        self._readings = b""
        if setup["sensors"]:
            from sensors import sensors  # this code takes heap, which that of a Pico does not

            self._readings, self.sensors = sensors(setup["sensors"])
        self._head = bytearray(GRANT)
        self._body = bytearray(MESSAGE_MAX)
        self._rx = bytearray(RX_MAX)  # a ring, like the next
        self._rx_first = 0
        self._rx_n = 0
        self._edge_fifo = bytearray(EDGES * EDGE)
        self._edge_first = 0
        self._edge_n = 0
        self.edges_lost = 0
        self._own_edge = bytearray(EDGE)
        self._temperature = 0
        self._tx = bytearray(ANSWER + TX_MAX)
        self._tx_n = 0
        self._tx_room = 0
        self._flags = 0
        self._led = 0
        self._watchdog_ms = 0
        self._wake = LATER
        self._wait()

    # -- grants

    def idle(self, us):
        """Answer, and wait for the next grant."""
        self._wake = us
        self._answer()
        self._wake = LATER  # a firmware that stands still requests nothing
        self._wait()

    def _wait(self):
        while self._grant():  # a stall: the hardware continues, the firmware does not
            self._answer()

    def _answer(self):
        tx = self._tx
        tx[0] = 68  # "D"
        tx[1] = self._flags | (1 if self.adc.sampling else 0) | (4 if self.mag.sampling else 0)
        tx[2] = self._led
        tx[3] = self.adc.rate >> 8
        tx[4] = self.adc.rate & 255
        period = self.mag.rate
        tx[5] = period >> 24
        tx[6] = (period >> 16) & 255
        tx[7] = (period >> 8) & 255
        tx[8] = period & 255
        tx[9] = self._watchdog_ms >> 8
        tx[10] = self._watchdog_ms & 255
        tx[11] = (RX_MAX - self._rx_n) >> 8
        tx[12] = (RX_MAX - self._rx_n) & 255
        tx[13] = self.adc.starts
        tx[14] = self._tx_n >> 8
        tx[15] = self._tx_n & 255
        for i in range(4):
            tx[16 + i] = self._wake >> (24 - 8 * i) & 255
        _write(tx, ANSWER + self._tx_n)
        self._tx_n = 0
        self._flags &= OUTPUT

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
        n_adc = _u16(head, 20)
        n_mag = _u16(head, 30)
        adc_at = n_rx
        mag_at = adc_at + n_adc * (STAMP + self.adc.sample)
        edges_at = mag_at + n_mag * (STAMP + self.mag.sample)
        thermometers_at = edges_at + head[18] * EDGE
        readings_at = thermometers_at + head[40] * THERMOMETER
        size = readings_at + len(self._readings)
        if size:
            self._read_exactly(self._body, size)
        self._take_rx(n_rx)
        for i in range(head[18]):
            self._keep_edge(self._body, edges_at + i * EDGE)
        self._tx_room = _u16(head, 4)
        high = head[14] - 256 if head[14] & 128 else head[14]
        self._temperature = high * 16777216 + (head[15] << 16 | head[16] << 8 | head[17])
        if head[1] & 2:
            self.adc.crash = True
        self.adc.latch(self._body, adc_at, n_adc, head, 22, head[19])
        self.mag.latch(self._body, mag_at, n_mag, head, 32, 0)
        if head[40]:
            self.thermometers.latch(self._body, thermometers_at, head[40])
        if self._readings:
            copy(self._readings, 0, self._body, readings_at, len(self._readings))
        return head[1] & 1

    def _take_rx(self, n):
        if self._rx_n + n > RX_MAX:
            raise OSError("more bytes than rx_room")
        _into_ring(self._rx, 1, (self._rx_first + self._rx_n) % RX_MAX, self._body, 0, n)
        self._rx_n += n

    def _keep_edge(self, buf, at):
        if self._edge_n == EDGES:
            self.edges_lost = (self.edges_lost + 1) & COUNTER
            return
        place = (self._edge_first + self._edge_n) % EDGES
        copy(self._edge_fifo, place * EDGE, buf, at, EDGE)
        self._edge_n += 1

    # -- called by the firmware

    def now(self, buf):
        copy(buf, 0, self._head, 6, 8)

    def ticks(self):
        head = self._head
        return (head[10] & 63) << 24 | head[11] << 16 | head[12] << 8 | head[13]

    def ticks_diff(self, a, b):
        return (a - b) & 0x3FFFFFFF

    def receive(self, buf, stamp):
        n = min(self._rx_n, len(buf))
        if n:
            self.now(stamp)
        _out_of_ring(self._rx, 1, self._rx_first, buf, 0, n)
        self._rx_first = (self._rx_first + n) % RX_MAX
        self._rx_n -= n
        return n

    def send(self, buf, at, n):
        n = min(n, self._tx_room, TX_MAX - self._tx_n)
        copy(self._tx, ANSWER + self._tx_n, buf, at, n)
        self._tx_n += n
        self._tx_room -= n
        return n

    def send_stamped(self, buf, at, end, place):
        if min(self._tx_room, TX_MAX - self._tx_n) <= 0:
            return 0
        copy(buf, place, self._head, 6, 8)
        return self.send(buf, at, close(buf, at, end) - at)

    def configure(self, settings):
        self._watchdog_ms = settings["watchdog_ms"]
        self.mag.shortest = settings["magnetostrictive"]["blanking_ns"] // TICK_NS
        self.mag.longest = settings["magnetostrictive"]["timeout_ns"] // TICK_NS

    def self_test(self, settings):
        measured = dict(self._measured)
        if settings["magnetostrictive"]["period_ns"] == 0:
            measured.pop("stops", 0)
        measured["temperature"] = self._temperature
        return measured

    def alive(self):
        self._flags |= ALIVE

    def led(self, code):
        self._led = code

    def output(self, level):
        if level == (1 if self._flags & OUTPUT else 0):
            return
        self._flags ^= OUTPUT
        self._own_edge[0] = 2
        self._own_edge[1] = level
        copy(self._own_edge, 2, self._head, 10, 4)
        self._keep_edge(self._own_edge, 0)

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
        self._leave(RESET)

    def to_repl(self):
        self._leave(PROMPT)

    def boot_loader(self):
        self._leave(BOOT_LOADER)

    def _leave(self, flag):
        self._flags |= flag
        self.adc.stop()
        self.mag.stop()
        self._answer()
        sys.exit(0)
