"""Magnetostrictive sensor with a start/stop interface: times of flight with 8 ns resolution, by PIO and DMA alone.

The sensor. A current pulse through a wire meets the field of the magnet that marks the position and twists the wire
there. The twist travels back to the head at 2.8 km/s. An interrogation pulse starts the head, which answers with a
start pulse at once and a stop pulse when the twist arrives. From the manufacturers' manuals:
- speed: stamped on every head, typically 9.05 us/inch (Allen-Bradley 1771-QB manual, ch. 4: transducer constant
  "typically 9.0500"), 8.94371 us/inch = 2839.98 m/s in the example of MTS's MK 292 manual (7.3), 2850 m/s in Balluff's
  BTL7-P511 (6.2.2). 8 ns are 22.5 µm.
- interrogation: 1 µs recommended, 0.2 µs at least (AMETEK 952 manual, 3.8); 1 to 5 µs, and 10 to 50 µs would switch to
  a data protocol (Balluff BTL7-P511, 6.2). Its leading edge starts the measurement.
- start pulse: begins within 50 ns of it, lasts 1 µs (AMETEK) or 3 to 5 µs, typically 4 (Balluff). Stop pulse: as long.
- blanking: 5 µs, or 21 µs for older heads with noisy signals (Delta RMC, MDT Fundamentals: Temposonics I and II with
  neuter output).
- signals: RS-422 or RS-485, differential, 500 m or more. The counter must detect a loss of signal (MTS Temposonics II,
  4.2.3).
- rate: between shots the flight over the entire rod must end and its echo decay; heads of 50 to 250 mm with their own
  timing make 780 measurements per second, 600 at 1.3 m (Balluff BTL7-V50T, 6.6). An external start/stop counter may run
  as fast as the rod's length allows: the time-out here is the longest flight, and the period is at least that plus 10
  µs.

What is timed. The reference is the start pulse, not the interrogation: delays of the head and its cable affect both
pulses equally. Which edges count depends on the head (Balluff BTL5 manual, table 4-2): the first edge of each pulse
(-M; Temposonics start/stop), the second of each (-P), or begin and end of one long pulse, a gate (-L). For the second
edges and for the gate the pin's input is inverted, so that the edge that ends a flight rises.

Three state machines of one PIO block, at 125 MHz (a cycle is a tick of 8 ns):

The *pacer* repeats a loop of exactly P cycles, P the period. Count its cycles from that of `push`, which is 0:

    0            push, pin up: the interrogation edge is on the pad at the end of this cycle, at time 1
    1, 2         irq 4, irq 5 (relative 0): look for the start
    3, 4         mov, set
    5 ...        16 (k + 1) cycles of the jump to itself: the pulse is A = 16 (k + 1) + 5 cycles long
    A            mov x, y; pin down
    A + 1 ...    y + 1 cycles of waiting
    B            irq 4, with y = B - A - 2: look for the stop
    B + 1        irq 5
    B + 2        mov x, osr
    B + 3 ...    osr + 1 cycles of waiting
    P - 3 ...    mov, jmp, mov: the number of the next shot. So osr = P - B - 7

Two *counters* run the same program, for the start and then for the stop. Counter i (0, 1) waits for flag 4 + i, which
the pacer sets in cycle C + i: C is 1 for the start, B for the stop. A flag set in one cycle is visible in the next, so
`wait` ends in cycle C + 1 + i, `mov x` is in C + 2 + i, and the first look at the pin in C + 3 + i. From then on it
looks every second cycle and subtracts one from x, which began at N (the start's or the stop's), between two looks.
Because they are one cycle apart, the two together look at the pin in every cycle. Each first waits for a look that
finds the pin low, then for one that finds it high: an edge, not a level. Therefore neither a start pulse longer than
the blanking nor a stuck line counts, and RS-422 receivers go high when their wires break. (A gate begins where the
inverted pin is first found low.)

A look in cycle t shows the pin as it was at t - 1 (two flip-flops of the synchroniser). If an edge comes at time s, the
first look that can find it is in cycle t = floor(s) + 2. Let m = t - (C + 3). Counter 0 looks at even m, after n0 =
ceil(m / 2) decrements; counter 1 at odd m, after n1 = floor(m / 2). So m = n0 + n1, whichever comes first, and n0 - n1
is 0 or 1. With the edge at s = 1 + F, F the time since the interrogation in ticks:

    floor(F) = t - 3 = C + m = C + 2 N - x0 - x1

The output is floor(F) of the stop less floor(F) of the start. The start falls anywhere in a tick, at the same place as
long as the head answers after the same time: the difference is correct on average over all such places, and wrong by up
to half a tick, 11 µm, for one head. Both synchroniser delays (2 cycles), pads (some ns) and receivers are the same for
both edges and cancel; the rest is part of the zero that `truearm box gauge` determines. The pin's synchroniser is
common to both counters, so they never see different pins. n0 - n1 is neither 0 nor 1 if only one saw a pulse: it was
shorter than 16 ns, a disturbance. With a resting magnet and a head without noise, every shot gives the same count, and
the mean has the same error as one shot; noise of some ns removes it.

Limits: both counters need one low look before the edge, so a start counts from 2 ticks after the first look on, F > 3
(24 ns), and a stop from F > B + 2: B is the blanking less 2. A stop edge in the very last tick of the blanking is seen
by counter 0 alone; the shot then counts as one without a stop. Without a start, x ends at -1, after 2 N + 11 cycles; N
is chosen so that the counters wait for the stop's flags by then.

Time-out: a stop's x is decremented at 0, too, and then -1 is pushed. A shot without a start or without a stop is 0,
counted in `missing`, and sets FLAG_MISSING_STOP.

DMA. Four channels run in an endless cycle, each started by the previous one; every start reloads the transfer count, so
the cycle never ends:

    number    pacer's RX FIFO → state word NUMBER      paced by the FIFO: a shot has begun
    stamp     TIMERAWL → ring of stamps                at once
    counts 0  counter 0's RX FIFO → ring, two words    paced by the FIFO
    counts 1  counter 1's RX FIFO → ring, two words    paced by the FIFO

The push is in the cycle of the interrogation edge; two transfers of about 10 cycles follow, so TIMERAWL is read within
0.3 µs of it even with a busy bus: the stamp is at most 1 µs early (it is the current microsecond) and 0.3 µs late.
Number, stamp and counts of a shot always stay together: each is at index (number of the shot) mod SHOTS of its ring.
The pacer counts shots down from 2^32 - 1, so laps of the ring are counted exactly, whatever Python does: begun =
-NUMBER, and the complete ones follow from counts 1's write address. No shot is lost in hardware: the FIFOs hold four
words, of two shots. Python must call once per SHOTS - SPARE shots; otherwise the waiting shots are lost, and counted.
"""

# ruff: noqa: F821  (the state machine's instructions are names that asm_pio brings)

from array import array

from truearm_wire.fast import add, const, copy, micropython, ptr8, ptr32
from truearm_wire.messages import COUNTER, FLAG_MISSING_STOP

from .registers import address, aligned, arm, drain, halt, poke

TICK_NS = 8
SHOTS = const(256)  # of the rings
STAMP_BITS = 10  # a ring of 2^10 bytes: one stamp per shot
COUNT_BITS = 11  # and two counts per shot
SPARE = 64  # shots of space for the DMA while Python copies
REARM_NS = 10000  # from the time-out to the next interrogation

# edges of the line that are timed
GATE = 0  # begin and end of one pulse
FIRST = 1  # first edges of the start pulse and of the stop pulse
SECOND = 2  # their second edges

_WRITE_ADDR = const(1)  # register of a DMA channel
_IN_RING = const(SHOTS - 1)
_MASK = const(0x3FFFFFFF)  # of the shots' numbers

# state words
NUMBER = const(0)  # of the last shot begun, negative: written by DMA
READ = const(1)  # shots handed out or lost, modulo 2^30


@micropython.viper
def whole(state: ptr32, channel: ptr32, ring: int) -> int:
    """Return the shots whose counts are in the ring and were not handed out. channel: registers of the last channel."""
    place = (channel[_WRITE_ADDR] - ring) >> 3  # read before NUMBER, which is then never older
    begun = 0 - state[NUMBER]
    return (begun - ((begun - place) & _IN_RING) - state[READ]) & _MASK


@micropython.viper
def unload(state: ptr32, counts0: ptr32, counts1: ptr32, n: int, top: int, dst: ptr8, at: int) -> int:
    """Move the times of flight of n shots to dst[at:]. top: from `timing`. Returns how many had no start or no stop."""
    missing = 0
    i = state[READ]
    end = i + n
    while i < end:
        k = (i & _IN_RING) << 1
        x0 = counts0[k]
        x1 = counts1[k]
        ticks = top + x0 + x1
        whole = x0 >= 0 and x1 >= x0 and x1 <= x0 + 1
        x0 = counts0[k + 1]
        x1 = counts1[k + 1]
        ticks -= x0 + x1
        if not whole or x0 < 0 or x1 < x0 or x1 > x0 + 1:
            ticks = 0
            missing += 1
        dst[at] = ticks
        dst[at + 1] = ticks >> 8
        dst[at + 2] = ticks >> 16
        dst[at + 3] = ticks >> 24
        at += 4
        i += 1
    state[READ] = end & _MASK
    return missing


@micropython.viper
def read_stamp(state: ptr32, stamps: ptr32, stamp: ptr8):
    """The stamp of the oldest shot, big endian."""
    time = stamps[state[READ] & _IN_RING]
    stamp[0] = time >> 24
    stamp[1] = time >> 16
    stamp[2] = time >> 8
    stamp[3] = time


def pulse_rounds(pulse_ns):
    """Return k of the interrogation pulse, 16 (k + 1) + 5 ticks. Raises ValueError."""
    if not 1000 <= pulse_ns <= 4000:
        raise ValueError("an interrogation pulse of %d ns; 1000 to 4000 are possible" % pulse_ns)
    return (pulse_ns // TICK_NS - 5 + 8) // 16 - 1


def pulse_ticks(rounds):
    return 16 * (rounds + 1) + 5


def pacer_program(rp2, rounds):
    """The pacer. Y, OSR: cycles to wait, see above; X and ISR: minus the number of the shot."""

    @rp2.asm_pio(sideset_init=rp2.PIO.OUT_LOW)
    def pacer():
        wrap_target()
        push(noblock).side(1)
        irq(4).side(1)
        irq(5).side(1)
        mov(isr, x).side(1)
        set(x, rounds).side(1)
        label("pulse")
        jmp(x_dec, "pulse").side(1)[15]
        mov(x, y).side(0)
        label("blanking")
        jmp(x_dec, "blanking").side(0)
        irq(4).side(0)
        irq(5).side(0)
        mov(x, osr).side(0)
        label("rest")
        jmp(x_dec, "rest").side(0)
        mov(x, isr).side(0)
        jmp(x_dec, "next").side(0)
        label("next")
        mov(isr, x).side(0)
        wrap()

    return pacer


def counter_program(rp2):
    """A counter of pulses. Y and OSR: N of the start, N of the stop; they are exchanged after each."""

    @rp2.asm_pio(autopush=True)
    def counter():
        wrap_target()
        wait(1, irq, rel(4))
        mov(x, y)
        label("high")
        jmp(pin, "still")
        jmp(x_dec, "low")
        jmp("done")
        label("still")
        jmp(x_dec, "high")
        jmp("done")
        label("low")
        jmp(pin, "done")
        jmp(x_dec, "low")
        label("done")
        in_(x, 32)
        mov(isr, y)
        mov(y, osr)
        mov(osr, isr)
        wrap()

    return counter


def gate_program(rp2):
    """A counter of a gate, with the pin inverted. Y and OSR: N of its begin, N of its end."""

    @rp2.asm_pio(autopush=True)
    def counter():
        wrap_target()
        wait(1, irq, rel(4))
        mov(x, y)
        label("before")
        jmp(pin, "waiting")
        jmp("begun")
        label("waiting")
        jmp(x_dec, "before")
        label("begun")
        in_(x, 32)
        wait(1, irq, rel(4))
        mov(x, osr)
        label("high")
        jmp(pin, "still")
        jmp(x_dec, "low")
        jmp("done")
        label("still")
        jmp(x_dec, "high")
        jmp("done")
        label("low")
        jmp(pin, "done")
        jmp(x_dec, "low")
        label("done")
        in_(x, 32)
        wrap()

    return counter


def timing(blanking_ns, timeout_ns, rounds):
    """Return B + 7, the pacer's Y, N of the start, N of the stop, and the constant that combines both counts.

    The counts of the start are added to it, those of the stop subtracted.

    The pacer's OSR is the period in ticks less the first.
    """
    b = blanking_ns // TICK_NS - 2
    first = (b - 12) // 2
    n = (timeout_ns // TICK_NS - b) // 2
    return b + 7, b - pulse_ticks(rounds) - 2, first, n, b + 2 * n - (1 + 2 * first)


# instructions that the CPU executes on the state machines; side set is 0 in all
_PULL = 0x80A0
_Y_OSR = 0xA047
_X_MINUS_1 = 0xA02B
_ISR_X = 0xA0C1
_NOP = 0xA042


class Magnetostrictive:
    """The source of stream 1 (box.py describes a source). Pins: interrogation, stop.

    Uses three state machines of one block (counters 0 and 1, pacer 2), all of its instructions, flags 4 and 5, four DMA
    channels and 7 KiB.
    """

    channels = 1

    def __init__(self, machine, rp2, chip, pins, block=1, pulse_ns=2000):
        interrogation, stop = pins
        Pin = machine.Pin
        self._chip = chip
        self._rounds = pulse_rounds(pulse_ns)
        Pin(stop, Pin.IN, Pin.PULL_DOWN)
        self._stop_control = chip.IO_BANK0 + 8 * stop + 4
        self._rp2 = rp2
        self._block = block
        self._stop = Pin(stop)
        # The counters' program comes last: the free memory after it in the block is for the longer one.
        self._pacer = rp2.StateMachine(4 * block + 2, pacer_program(rp2, self._rounds), sideset_base=Pin(interrogation))
        self._program = None
        self._edge = None
        base = chip.PIO[block]
        self._flags = base + chip.PIO_IRQ
        self._levels = base + chip.PIO_FLEVEL
        self._fifos = tuple([base + chip.PIO_RXF + 4 * i for i in range(3)])
        self._rings(rp2, chip.DREQ_PIO_RX + chip.DREQ_PIO_STRIDE * block)
        self._index = bytearray(8)
        self._lost = 0
        self._fault = 0
        self.missing = 0
        self.configure(10000, 500000)

    def _rings(self, rp2, request):
        """Three aligned rings in one buffer, and the tasks of the four channels."""
        chip = self._chip
        size = 1 << COUNT_BITS
        self._memory = bytearray(3 * size + (1 << STAMP_BITS))
        counts = aligned(self._memory, size)
        self._counts = (counts, counts + size)
        self._stamps = counts + 2 * size
        self._state = array("I", (0, 0))
        self._dma = [rp2.DMA() for _ in range(4)]
        each = {"size": 2, "inc_read": False, "irq_quiet": True}
        pacings = ((request + 2, 0), (chip.DREQ_FORCE, STAMP_BITS), (request, COUNT_BITS), (request + 1, COUNT_BITS))
        reads = (self._fifos[2], chip.TIMERAWL, self._fifos[0], self._fifos[1])
        writes = (address(self._state), self._stamps, self._counts[0], self._counts[1])
        setups = []
        for k, (pacing, bits) in enumerate(pacings):
            options = dict(each)
            if bits:
                options.update({"ring_sel": True, "ring_size": bits})
            control = self._dma[k].pack_ctrl(
                treq_sel=pacing, inc_write=bits > 0, chain_to=self._dma[(k + 1) % 4].channel, **options
            )
            setups.append(array("I", (reads[k], writes[k], 2 if bits == COUNT_BITS else 1, control)))
        self._setups = tuple(setups)
        self._bases = tuple([chip.DMA + chip.DMA_STRIDE * dma.channel for dma in self._dma])
        self._all = 0
        for dma in self._dma:
            self._all |= 1 << dma.channel
        self._first = 1 << self._dma[0].channel

    def configure(self, blanking_ns, timeout_ns, edge=FIRST):
        """Take effect from the next start on; nothing may be running.

        Times count from the interrogation edge. Raises ValueError.

        edge: FIRST, SECOND or GATE.
        """
        if blanking_ns % TICK_NS or not 5000 <= blanking_ns <= 21000:
            raise ValueError("the blanking is a multiple of 8 ns, 5000 to 21000, not %d" % blanking_ns)
        if timeout_ns <= blanking_ns:
            raise ValueError("the time-out of %d ns is within the blanking" % timeout_ns)
        if edge != self._edge:
            self._load(edge)
        self._timeout_ns = timeout_ns
        self._busy, self._blanking, self._first_n, self._n, self._top = timing(blanking_ns, timeout_ns, self._rounds)

    def _load(self, edge):
        """Load the counters for these edges."""
        rp2 = self._rp2
        if self._program:
            for counter in self._counters:
                counter.active(0)
            rp2.PIO(self._block).remove_program(self._program)
        self._program = gate_program(rp2) if edge == GATE else counter_program(rp2)
        self._counters = [rp2.StateMachine(4 * self._block + i, self._program, jmp_pin=self._stop) for i in range(2)]
        poke(self._stop_control, self._chip.FUNCTION_SIO | (0 if edge == FIRST else self._chip.INPUT_INVERTED))
        self._edge = edge

    # -- a source of samples

    def start(self, period_ns):
        """Start. Raises ValueError if the period is not a multiple of 8 ns or too short for the time-out."""
        if period_ns % TICK_NS or period_ns < self._timeout_ns + REARM_NS:
            raise ValueError(
                "the period is a multiple of 8 ns, at least %d, not %d" % (self._timeout_ns + REARM_NS, period_ns)
            )
        self.halt()
        self._state[NUMBER] = self._state[READ] = 0
        for i in range(8):
            self._index[i] = 0
        self._lost = 0
        self._fault = 0
        for k in range(4):
            arm(self._bases[k], self._setups[k])
        poke(self._chip.DMA_MULTI_CHAN_TRIGGER, self._first)
        for counter in self._counters:
            self._restart(counter, self._first_n)
            counter.exec(_Y_OSR)
            counter.put(self._n)
            counter.exec(_PULL)
            counter.active(1)
        self._restart(self._pacer, self._blanking)
        self._pacer.exec(_Y_OSR)
        self._pacer.put(period_ns // TICK_NS - self._busy)
        self._pacer.exec(_PULL)
        self._pacer.exec(_X_MINUS_1)
        self._pacer.exec(_ISR_X)
        self._pacer.active(1)

    def stop(self):
        """Stop without waiting for a shot in progress; samples already taken remain available."""
        self._pacer.active(0)
        self._pacer.exec(_NOP)  # its side set takes the pin down

    def waiting(self):
        n = whole(self._state, self._bases[3], self._counts[1])
        if n <= SHOTS - SPARE:
            return n
        self._lost += n
        self._state[READ] = (self._state[READ] + n) & COUNTER
        add(self._index, 0, 8, n)
        return 0

    @micropython.native
    def take(self, n, dst, at, index, stamp):
        if self.waiting() < n:
            return False
        copy(index, 0, self._index, 0, 8)
        read_stamp(self._state, self._stamps, stamp)
        missing = unload(self._state, self._counts[0], self._counts[1], n, self._top, dst, at)
        self.missing = (self.missing + missing) & COUNTER
        self._fault = FLAG_MISSING_STOP if missing else 0
        add(self._index, 0, 8, n)
        return True

    def broken(self):
        return False

    def lost(self):
        n = self._lost
        self._lost = 0
        return n

    def fault(self):
        return self._fault

    # -- the hardware; no call allocates

    @staticmethod
    def _restart(state_machine, word):
        """Restart at the first instruction, with a word in OSR."""
        state_machine.restart()
        state_machine.put(word)
        state_machine.exec(_PULL)

    def halt(self):
        """Stop immediately: samples are discarded, and the buffers may be freed."""
        self.stop()
        for counter in self._counters:
            counter.active(0)
        halt(self._chip, self._bases, self._setups, self._all)
        for i in range(3):
            drain(self._fifos[i], self._levels, 0xF << 4 << 8 * i)
        poke(self._flags, 3 << 4)
