"""Samples of an ADS131M04, read and stamped by hardware alone: two PIO state machines and three DMA channels, no interrupt, no callback.

Both machines wait for DRDY to fall. The counter pushes the number of the conversion; the reader clocks the frame in: six words of 24 bits,
pushed one by one. DIN stays low (the command NULL). The DMA channels go round for ever, each started by the one before:

    number  counter's RX FIFO → survey word LATEST    1 transfer, paced by the FIFO   a conversion has ended
    stamp   TIMERAWL → ring of stamps                 1 transfer, at once             the time of that
    frame   reader's RX FIFO → ring of frames         6 transfers, paced by the FIFO  its data

so number, stamp and frame of a conversion cannot come apart, whatever is late; every start reloads the transfer count, so nothing
counts out. The rings are the DMA's own (write addresses that wrap at a power of two), the number is 32 bit and never stops.

Why it is right on the chip. Each request (DREQ) paces one channel, as the RP2040's datasheet wants it (2.5.3: channels should not share one).
Both machines are switched on in one write and look at the pin through the same synchroniser, so they see the same edges; neither is busy
when the next one comes. The edge is seen after 2 cycles of
synchroniser and at most 1 of the wait; mov and push take 2, the two transfers some 10 cycles each, more only while the CPU holds
the bus of the same peripheral: the stamp is within 0.3 µs of the edge. The first word of data comes 2.7 µs later, so the channel `frame` is
running by then; if it were not, four words fit the FIFO and the reader would wait with SCLK low. SCLK (8.9 MHz) is high for 64
ns and low for 48; DOUT is valid 20 ns after the rising edge and is read as it was 48 ns after it (64 less the two cycles of the
synchroniser), so pins and wires may take 28 ns. CS falls 64 ns before SCLK rises first and stays high for more than 40 ns. A frame takes
17 µs, more than half of the shortest period (30.72 µs) but never into the next conversion.

ads131m04_survey.py says what the CPU does with them.

Rings (32 KiB with what aligning takes): 16 KiB of frames hold 681 conversions, that is 669 ms at 1017 Hz, 167 ms at 4069 Hz and 21 ms at 32.55 kHz; 4 KiB of stamps.
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
BITS = 143  # of a frame, less one: what the state machine counts down
NAIVE_BLOCKS = 2  # a caller that does not ask `broken` waits at most so many blocks at a gap


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
        jmp(x_dec, "next")  # from 0 it falls through to the same place

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


# instructions that the CPU gives to the state machines; 0x0800 is CS high, SCLK low in the reader's side-set bits
_PULL = 0x80A0 | 0x0800  # pull(block)
_X_TO_1 = 0xE021  # set(x, 1)
_INVERT_X = 0xA029  # mov(x, invert(x)): the first number is 1


class Adc:
    """The source of stream 0 (box.py says what a source is). Pins: DOUT, CS, SCLK, DIN, DRDY, SYNC, CLKIN.

    Takes two state machines of one block, this one and the next, 12 instructions, three DMA channels, a PWM slice and 32 KiB. Raises ValueError if
    the pins do not suit the reader: CS and SCLK in a row, DRDY four above DOUT.
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
            baudrate=250000,  # two µs a half: one may be a few ns, the timer's next tick, and the converter needs 20
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
        """CLKIN: the system clock by an even number would be symmetrical; 15 gives 56 ns high and 64 ns low (49 are needed)."""
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
        """Two aligned rings in one buffer, and what the three channels do."""
        chip = self._chip
        self._memory = bytearray(2 * FRAMES)  # wherever it lies: one ring fits aligned, the other before or behind it
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
        """Give CS and SCLK to the CPU or to the state machine."""
        poke(self._selects[1], function)  # SCLK first: it is low with the CPU, so CS never rises while it is high
        poke(self._selects[0], function)

    # -- a source of samples

    def gains(self, gains):
        """Gains of the four channels from the next start on. Raises ValueError."""
        self.registers.gain_word = gain_word(gains)

    def start(self, osr):
        """Raises ValueError if the converter has no such oversampling."""
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
        """What was sampled stays to be taken."""
        self.running = False
        self._halt()

    def waiting(self):
        """Samples that wait and follow one another, as far as looked: at most 64."""
        return self._look(64)

    def broken(self):
        """Whether a gap follows the samples that wait: no more come before it."""
        return self._survey[BROKEN] != 0

    @micropython.native
    def take(self, n, dst, at, index, stamp):
        """Move n samples that follow one another, if they wait. Samples before a gap come if asked for with their number (`waiting`)."""
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
        """Frames dropped since boot: wrong CRC, data not new, DRDY out of turn. Wraps at 2^30."""
        return self._survey[CRC_ERRORS]

    @property
    def resets(self):
        """How often the converter was set up again while sampling, since boot. Wraps at 2^30."""
        return self._resets

    def _look(self, n):
        found = survey(self._survey, self._ring, self._stamps, self._timer, TABLE, n)
        if self._survey[LOST_CONVERTER] and self.running:
            self._recover()
        return found

    def _give_up(self, n):
        """Drop samples before a gap that nobody asks for; the index jumps over them."""
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
        """Set the converter up, and sample. Without a converter silence will bring the next attempt."""
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
        """DMA and the state machine are ready for the first conversion after this."""
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
