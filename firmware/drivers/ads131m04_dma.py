"""Samples of an ADS131M04, read and stamped by hardware alone: two PIO state machines, three DMA channels.

There are no interrupts.

Both machines wait for DRDY to fall. The counter pushes the number of the conversion; the reader clocks the frame in:
six words of 24 bits, pushed one by one. DIN stays low (the command NULL). The DMA channels run in an endless cycle,
each started by the previous one:

    number  counter's RX FIFO → survey word LATEST    1 transfer, paced by the FIFO   a conversion has ended
    stamp   TIMERAWL → ring of stamps                 1 transfer, at once             its time
    frame   reader's RX FIFO → ring of frames         6 transfers, paced by the FIFO  its data

so number, stamp and frame of a conversion always stay together, whatever is late. Every start reloads the transfer
count, so the cycle never ends. The rings are the DMA's own (write addresses that wrap at a power of two); the number
has 32 bits and never stops.

Why this is correct on the chip. Each request (DREQ) paces one channel, as the RP2040's datasheet requires (2.5.3:
channels should not share one). One write starts both machines, and they read the pin through the same synchroniser, so
they see the same edges; neither is busy when the next one arrives. The edge is seen after 2 cycles of synchroniser and
at most 1 of the wait. mov and push take 2, the two transfers about 10 cycles each, more only while the CPU holds the
bus of the same peripheral: the stamp is within 0.3 µs of the edge. The first word of data arrives 2.7 µs later, so the
channel `frame` is running by then; otherwise four words would fit the FIFO and the reader would wait with SCLK low.
SCLK (8.9 MHz) is high for 64 ns and low for 48. DOUT is valid 20 ns after the rising edge and is sampled 48 ns after it
(64 less the two cycles of the synchroniser), so 28 ns remain for pins and wires. CS falls 64 ns before the first rise
of SCLK and stays high for more than 40 ns. A frame takes 17 µs, more than half of the shortest period (30.72 µs), but
never extends into the next conversion.

ads131m04_survey.py describes what the CPU does with them.

Rings (32 KiB including alignment): 16 KiB of frames hold 681 conversions, which is 669 ms at 1017 Hz, 167 ms at 4069 Hz
and 21 ms at 32.55 kHz; 4 KiB of stamps.
"""

# ruff: noqa: F821  (the state machine's instructions are names that asm_pio brings)

from array import array

from truearm_wire.fast import add, copy, micropython, ptr32
from truearm_wire.messages import COUNTER, FLAG_CONVERTER

from .ads131m04 import CLOCK_WORD, SETTLING, TABLE, Registers, gain_word, osr_code
from .ads131m04_survey import (
    ALIVE,
    BROKEN,
    CRC_ERRORS,
    EVENTS,
    FIRST,
    FRAMES,
    JUMP,
    LATEST,
    LONGEST,
    LOST_CONVERTER,
    OSR6,
    READ,
    RECORD,
    SEEN,
    SHORTEST,
    SILENCE,
    STAMPS,
    SURVEY,
    number_now,
    survey,
    unload,
)
from .registers import address, aligned, arm, drain, halt, poke

CHANNELS = 4
BITS = 143  # of a frame, less one: the start value of the state machine's count
NAIVE_BLOCKS = 2  # a caller that does not check `broken` waits at most this many blocks at a gap


@micropython.viper
def _wait(timer: ptr32, us: int):
    start = timer[0]
    while timer[0] - start <= us:
        pass


@micropython.viper
def _time(timer: ptr32) -> int:
    return timer[0] & 0x3FFFFFFF


def counter_program(rp2):
    """The counter. in_base is DRDY; X: minus the number of the next conversion, less one."""

    @rp2.asm_pio()
    def numbers():
        label("next")
        wait(1, pin, 0)
        wait(0, pin, 0)
        mov(isr, invert(x))
        push()
        jmp(x_dec, "next")  # from 0 it falls through to the same instruction

    return numbers


def program(rp2):
    """The reader. in_base is DOUT, DRDY four pins above; side-set CS, SCLK; OSR holds 143."""

    @rp2.asm_pio(
        sideset_init=(rp2.PIO.OUT_HIGH, rp2.PIO.OUT_LOW),
        in_shiftdir=rp2.PIO.SHIFT_LEFT,
        autopush=True,
        push_thresh=24,
    )
    def frames():
        wrap_target()
        wait(1, pin, 4).side(1)
        wait(0, pin, 4).side(1)[2]  # the counter's push comes first
        mov(y, osr).side(0)[7]
        label("bit")
        nop().side(2)[7]
        in_(pins, 1).side(0)[4]
        jmp(y_dec, "bit").side(0)
        nop().side(1)[3]
        wrap()

    return frames


# instructions that the CPU executes on the state machines; 0x0800 is CS high, SCLK low in the reader's side-set bits
_PULL = 0x80A0 | 0x0800  # pull(block)
_X_TO_1 = 0xE021  # set(x, 1)
_INVERT_X = 0xA029  # mov(x, invert(x)): the first number is 1


class Adc:
    """The source of stream 0 (box.py describes a source). Pins: DOUT, CS, SCLK, DIN, DRDY, SYNC, CLKIN.

    Uses two state machines of one block, this one and the next, 12 instructions, three DMA channels, a PWM slice and 32
    KiB. Raises ValueError if the pins do not suit the reader: CS and SCLK adjacent, DRDY four above DOUT.
    """

    channels = CHANNELS

    def __init__(self, machine, rp2, chip, pins, state_machine=0):
        dout, cs, sclk, din, drdy, sync, clkin = pins
        if sclk != cs + 1 or drdy != dout + 4:
            raise ValueError("SCLK must follow CS, and DRDY be four pins above DOUT")
        self._chip = chip
        self._machine = machine
        self._clock(clkin)
        machine.Pin(drdy, machine.Pin.IN, machine.Pin.PULL_UP)
        select = machine.Pin(cs, machine.Pin.OUT, value=1)
        self._sync = machine.Pin(sync, machine.Pin.OUT, value=1)
        bus = machine.SoftSPI(
            baudrate=250000,  # two µs per half: one may be a few ns, the timer's next tick, and the converter needs 20
            polarity=0,
            phase=1,
            sck=machine.Pin(sclk),
            mosi=machine.Pin(din),
            miso=machine.Pin(dout, machine.Pin.IN, machine.Pin.PULL_UP),
        )
        self.registers = Registers(bus, select, self._sync, self._wait)
        self._din = machine.Pin(din)
        self._selects = (chip.IO_BANK0 + 8 * cs + 4, chip.IO_BANK0 + 8 * sclk + 4)
        self._state_machines(rp2, state_machine, dout, cs, drdy)
        self._rings(rp2, state_machine)
        self._index = bytearray(8)
        self._lost = 0
        self._resets = 0
        self._flags_at = 0
        self._osr = 0
        self.running = False

    def _clock(self, pin):
        """CLKIN: an even divider of the system clock is symmetrical; 15 gives 56 ns high, 64 ns low (49 are needed)."""
        machine, chip = self._machine, self._chip
        machine.PWM(machine.Pin(pin), freq=chip.CLOCK_HZ // chip.CONVERTER_DIVIDER, duty_u16=32768)
        registers = chip.PWM + chip.PWM_STRIDE * (pin >> 1 & 7)
        poke(registers + chip.PWM_DIV, 1 << 4)
        poke(registers + chip.PWM_TOP, chip.CONVERTER_DIVIDER - 1)
        poke(registers + chip.PWM_CC, chip.CONVERTER_DIVIDER // 2 << (16 if pin & 1 else 0))

    def _state_machines(self, rp2, number, dout, cs, drdy):
        chip, block, index = self._chip, number // 4, number % 4
        Pin, clock = self._machine.Pin, self._chip.CLOCK_HZ
        self._reader = rp2.StateMachine(number, program(rp2), freq=clock, in_base=Pin(dout), sideset_base=Pin(cs))
        self._counter = rp2.StateMachine(number + 1, counter_program(rp2), freq=clock, in_base=Pin(drdy))
        self._mux(chip.FUNCTION_SIO)
        self._pio_function = chip.FUNCTION_PIO[block]
        base = chip.PIO[block]
        self._switch_on = base + chip.PIO_CTRL + chip.SET
        self._switch_off = base + chip.PIO_CTRL + chip.CLEAR
        self._enable = 3 << index
        self._rx = (base + chip.PIO_RXF + 4 * index, base + chip.PIO_RXF + 4 * (index + 1))
        self._tx = base + chip.PIO_TXF + 4 * index
        instruction = base + chip.PIO_SM_INSTR + chip.PIO_SM_STRIDE * index
        self._instructions = (instruction, instruction + chip.PIO_SM_STRIDE)
        self._levels = base + chip.PIO_FLEVEL
        self._level_bits = (0xF << 4 << 8 * index, 0xF << 4 << 8 * (index + 1))

    def _rings(self, rp2, number):
        """Two aligned rings in one buffer, and the tasks of the three channels."""
        chip = self._chip
        self._memory = bytearray(2 * FRAMES)  # wherever it lies: one ring fits aligned, the other before or after it
        self._ring = aligned(self._memory, FRAMES)
        before = aligned(self._memory, 4 * STAMPS)
        self._stamps = before if before + 4 * STAMPS <= self._ring else self._ring + FRAMES
        self._survey = array("I", bytes(4 * SURVEY))
        self._timer = chip.TIMERAWL
        self._dma = [rp2.DMA() for _ in range(3)]
        number_dma, stamp_dma, frame_dma = self._dma
        request = chip.DREQ_PIO_RX + chip.DREQ_PIO_STRIDE * (number // 4) + number % 4
        paced = {"size": 2, "inc_read": False, "treq_sel": request + 1, "irq_quiet": True}
        ring = {"ring_sel": True, "irq_quiet": True, "size": 2, "inc_read": False}
        controls = (
            number_dma.pack_ctrl(inc_write=False, chain_to=stamp_dma.channel, **paced),
            stamp_dma.pack_ctrl(treq_sel=chip.DREQ_FORCE, ring_size=12, chain_to=frame_dma.channel, **ring),
            frame_dma.pack_ctrl(treq_sel=request, ring_size=14, chain_to=number_dma.channel, **ring),
        )
        self._setups = (
            array("I", (self._rx[1], address(self._survey), 1, controls[0])),
            array("I", (self._timer, self._stamps + 4, 1, controls[1])),
            array("I", (self._rx[0], self._ring + RECORD, 6, controls[2])),
        )
        self._bases = tuple([chip.DMA + chip.DMA_STRIDE * dma.channel for dma in self._dma])
        self._all = 0
        for dma in self._dma:
            self._all |= 1 << dma.channel
        self._first = 1 << number_dma.channel

    def _wait(self, us):
        _wait(self._timer, us)

    def _mux(self, function):
        """Connect CS and SCLK to the CPU or to the state machine."""
        poke(self._selects[1], function)  # SCLK first: the CPU holds it low, so CS never rises while it is high
        poke(self._selects[0], function)

    # -- a source of samples

    def gains(self, gains):
        """Set the gains of the four channels from the next start on. Raises ValueError."""
        self.registers.gain_word = gain_word(gains)

    def start(self, osr):
        """Start sampling. Raises ValueError if the converter has no such oversampling."""
        self.registers.clock_word = CLOCK_WORD | osr_code(osr) << 2
        self.stop()
        s = self._survey
        s[OSR6] = 6 * osr
        s[SHORTEST] = osr * 6 // 25 - 1
        s[LONGEST] = osr * 6 // 25 + 2
        s[SILENCE] = max(50000, 8 * osr)
        s[FIRST] = 1
        for i in range(8):
            self._index[i] = 0
        self._lost = 0
        s[EVENTS] = 0
        self._flags_at = 0
        self.running = True
        self._run()

    def stop(self):
        """Stop sampling; samples already taken remain available."""
        self.running = False
        self._halt()

    def waiting(self):
        """Return the number of consecutive waiting samples found so far: at most 64."""
        return self._look(64)

    def broken(self):
        """Return whether a gap follows the waiting samples: no more arrive before it."""
        return self._survey[BROKEN] != 0

    @micropython.native
    def take(self, n, dst, at, index, stamp):
        """Move n consecutive samples, if they wait. Before a gap, ask for exactly the number that waits (`waiting`)."""
        if self._look(n) < n:
            self._give_up(n)
            return False
        s = self._survey
        jump = s[JUMP]
        if not unload(s, self._ring, self._stamps, n, dst, at, stamp):
            return False
        if s[SEEN] == 0:
            s[BROKEN] = 0
        if jump:
            self._lost += jump
            add(self._index, 0, 8, jump)
        copy(index, 0, self._index, 0, 8)
        add(self._index, 0, 8, n)
        return True

    def lost(self):
        n = self._lost
        self._lost = 0
        return n

    def fault(self):
        events = self._survey[EVENTS]
        flags = FLAG_CONVERTER if events != self._flags_at else 0
        self._flags_at = events
        return flags

    @property
    def crc_errors(self):
        """Return frames dropped since boot: wrong CRC, data not new, DRDY at a wrong time. Wraps at 2^30."""
        return self._survey[CRC_ERRORS]

    @property
    def resets(self):
        """Return how often the converter was configured again while sampling, since boot. Wraps at 2^30."""
        return self._resets

    def _look(self, n):
        found = survey(self._survey, self._ring, self._stamps, self._timer, TABLE, n)
        if self._survey[LOST_CONVERTER] and self.running:
            self._recover()
        return found

    def _give_up(self, n):
        """Drop samples before a gap that nobody requests; the index skips them."""
        s = self._survey
        if s[BROKEN] and (number_now(s) - s[READ]) & COUNTER > NAIVE_BLOCKS * n:
            s[READ] = (s[READ] + s[SEEN]) & COUNTER
            s[SEEN] = 0
            s[BROKEN] = 0

    # -- the hardware; no call allocates

    def _recover(self):
        self._resets = (self._resets + 1) & COUNTER
        self._halt()
        self._run()

    def _run(self):
        """Configure the converter, and sample. Without a converter, silence triggers the next attempt."""
        s = self._survey
        s[LATEST] = 0
        s[READ] = 1
        s[SEEN] = s[BROKEN] = s[JUMP] = s[LOST_CONVERTER] = 0
        if self.registers.setup():
            self._listen()
            state = self._machine.disable_irq()  # a longer pulse would be a reset
            self._sync.off()
            self._wait(2)
            self._sync.on()
            before = number_now(s)
            self._machine.enable_irq(state)
            s[READ] = (before + 1 + SETTLING) & COUNTER
        s[ALIVE] = _time(self._timer)

    def _listen(self):
        """Prepare DMA and the state machine for the first conversion after this."""
        chip = self._chip
        for k in range(3):
            arm(self._bases[k], self._setups[k])
        poke(chip.DMA_MULTI_CHAN_TRIGGER, self._first)
        self._reader.restart()
        self._counter.restart()
        poke(self._tx, BITS)
        poke(self._instructions[0], _PULL)
        poke(self._instructions[1], _X_TO_1)
        poke(self._instructions[1], _INVERT_X)
        self._din.off()
        self._mux(self._pio_function)
        poke(self._switch_on, self._enable)

    def _halt(self):
        chip = self._chip
        poke(self._switch_off, self._enable)
        self._mux(chip.FUNCTION_SIO)
        halt(chip, self._bases, self._setups, self._all)
        for k in range(2):
            drain(self._rx[k], self._levels, self._level_bits[k])
