"""Samples of an ADS131M04, read and stamped by hardware alone: a PIO state machine and three DMA channels, no interrupt, no callback.

The state machine waits for DRDY to fall, pushes the number of the conversion, and clocks the frame in: six words of 24 bits, pushed
one by one. DIN stays low (the command NULL). The DMA channels go round for ever, each started by the one before:

    number  RX FIFO → survey word LATEST    1 transfer, paced by the FIFO   a conversion has ended
    stamp   TIMERAWL → ring of stamps       1 transfer, at once             the time of that
    frame   RX FIFO → ring of frames        6 transfers, paced by the FIFO  its data

so number, stamp and frame of a conversion cannot come apart, whatever is late; every start reloads the transfer count, so nothing
counts out. The rings are the DMA's own (write addresses that wrap at a power of two), the number is 32 bit and never stops.

Why it is right on the chip. A FIFO's request goes to one running channel at a time; a channel that is started makes its own
handshake for it (RP2040 datasheet 2.5.3), as in every pair of channels that take turns. The edge is seen after 2 cycles of
synchroniser and at most 1 of the wait; mov and push take 2, the two transfers some 10 cycles each, more only while the CPU holds
the bus of the same peripheral: the stamp is within 0.3 µs of the edge. The first word of data comes 2.7 µs later, so the channel `frame` is
running by then; if it were not, four words fit the FIFO and the state machine would wait with SCLK low. SCLK (8.9 MHz) is high for 64
ns and low for 48; DOUT is valid 20 ns after the rising edge and is read as it was 48 ns after it (64 less the two cycles of the
synchroniser), so pins and wires may take 28 ns. CS falls 64 ns before SCLK rises first and stays high for more than 40 ns. A frame takes
17 µs, more than half of the shortest period (30.72 µs) but never into the next conversion.

What the CPU does: `survey` looks at frames in the order of the ring, `unload` hands them out. A frame is handed out only if its CRC is
right, STATUS says that the converter is configured and the data are new, and DRDY came a period after the one before.
**A frame that is not is dropped**: the index jumps (the wire shows the gap), FLAG_CONVERTER is set in the next block. A wrong value is never
handed out. Indices come from the stamps: a sample's index is that of the last one and the number of periods between, so they tell the
time whatever was lost and why. A converter that was reset (RESET in STATUS, other registers) or has fallen silent is set up anew: 5 to 30 ms
are lost, and conversions are then at other times, so t0 jumps by a part of a period more than n0 tells. Should the loop stand
still for longer than the rings hold, that is seen by the number and half a ring is skipped; more than 17 minutes would confuse it.

Rings (32 KiB with what aligning takes): 16 KiB of frames hold 681 conversions, that is 669 ms at 1017 Hz, 167 ms at 4069 Hz and 21 ms at 32.55 kHz; 4 KiB of stamps.
"""

# ruff: noqa: F821  (the state machine's instructions are names that asm_pio brings)

from array import array

from truearm_wire.fast import add, copy, micropython, ptr8, ptr16, ptr32
from truearm_wire.messages import COUNTER, FLAG_CONVERTER

from .ads131m04 import CLOCK_WORD, SETTLING, TABLE, Registers, gain_word, osr_code
from .registers import address, aligned, arm, drain, halt, poke

CHANNELS = 4
SAMPLE = 4 * CHANNELS
RECORD = 24  # bytes of a frame in the ring: six words, the 24 bits in the lower three bytes
FRAMES = 1 << 14  # bytes of the ring
STAMPS = 1 << 10  # stamps, more than frames fit
HOLDS = FRAMES // RECORD - 1  # conversions behind LATEST that are whole
FAR = HOLDS - 41  # so far behind, half a ring is skipped: 32.55 kHz goes on for 1.2 ms while `survey` looks
BITS = 143  # of a frame, less one: what the state machine counts down
NAIVE_BLOCKS = 2  # a caller that does not ask `broken` waits at most so many blocks at a gap

# words of the survey; counts and times modulo 2^30, so that they are small integers on the chip
LATEST = 0  # number of the newest conversion, from 1 on, written by DMA: those before it are whole in the ring
READ = 1  # number of the oldest frame not handed out
SEEN = 2  # frames from READ on that are good and follow one another
BROKEN = 3  # 1: a frame that does not follow comes after them
STAMP = 4  # time of the last sample handed out
FIRST = 5  # 1: none was yet
JUMP = 6  # periods without a sample before the one at READ
LOST_CONVERTER = 7  # 1: it must be set up anew
EVENTS = 8  # frames dropped and resets since FLAG_CONVERTER was last asked
CRC_ERRORS = 9
OSR6 = 10  # 25 periods in µs: a period is 0.24 µs · oversampling
SHORTEST = 11  # interval of stamps, µs: a period less the fraction and 1 µs of lateness of the one before
LONGEST = 12
SILENCE = 13  # µs without a sample after which the converter is set up anew
ALIVE = 14  # time of the last good conversion, or of the last attempt to get one
SURVEY = 15


@micropython.viper
def survey(s: ptr32, ring: ptr32, stamps: ptr32, timer: ptr32, table: ptr16, want: int) -> int:
    """Look at frames until `want` good ones in a row are known. Returns how many are.

    Stops at LOST_CONVERTER. 31 µs and 10 µs a frame on the emulated chip; `take` of 13 needs 0.4 ms in all.
    """
    latest = s[0] & 0x3FFFFFFF
    if (latest - s[1]) & 0x3FFFFFFF > 640 and (latest - s[1]) & 0x20000000 == 0:
        s[1] = (latest - 340) & 0x3FFFFFFF
        s[2] = 0
        s[3] = 0
    while s[2] < want and s[3] == 0 and s[7] == 0:
        number = (s[1] + s[2]) & 0x3FFFFFFF
        ahead = (latest - number) & 0x3FFFFFFF
        if ahead == 0 or ahead & 0x20000000:
            break
        at = number * 6 & 4095
        crc = 0xFFFF
        i = 0
        while i < 5:
            word = ring[at]
            crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ (word >> 16 & 255)]
            crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ (word >> 8 & 255)]
            crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ (word & 255)]
            at = (at + 1) & 4095
            i += 1
        status = ring[number * 6 & 4095] >> 8 & 0xFFFF
        worth = 0
        if crc != ring[at] >> 8 & 0xFFFF:
            worth = 1
        elif status & 0xBF00 != 0x0100:
            worth = 2
        elif status & 15 != 15:
            worth = 3
        stamp = stamps[number & 1023] & 0x3FFFFFFF
        jump = 0
        if worth == 0 and s[2]:
            interval = (stamp - stamps[(number - 1) & 1023]) & 0x3FFFFFFF
            if interval < s[11] or interval > s[12]:
                jump = 1
        elif worth == 0 and s[5] == 0:
            interval = (stamp - s[4]) & 0x3FFFFFFF
            jump = interval // s[10] * 25 + (interval % s[10] * 25 + s[10] // 2) // s[10] - 1
            if jump < 0:
                worth = 3
        if s[2]:
            if worth or jump:
                s[3] = 1
            else:
                s[2] = s[2] + 1
        elif worth:
            s[1] = (number + 1) & 0x3FFFFFFF
            s[8] = (s[8] + 1) & 0x3FFFFFFF
            if worth == 2:
                s[7] = 1
            else:
                s[9] = (s[9] + 1) & 0x3FFFFFFF
        else:
            s[6] = jump
            s[2] = 1
        if worth == 0:
            s[14] = stamp
    if s[2] < want and (timer[0] - s[14]) & 0x3FFFFFFF > s[13]:
        if s[2]:
            s[3] = 1
        else:
            s[7] = 1
    return s[2]


@micropython.viper
def unload(s: ptr32, ring: ptr32, stamps: ptr32, n: int, dst: ptr8, at: int, stamp: ptr8) -> int:
    """Move n frames from READ on to dst[at:], the first one's time to stamp. Returns 0 if the ring was lapped meanwhile."""
    first = stamps[s[1] & 1023]
    last = stamps[(s[1] + n - 1) & 1023]
    i = 0
    while i < n:
        k = (s[1] + i) * 6 + 1
        end = k + 4
        while k < end:
            word = ring[k & 4095]
            dst[at] = word & 255
            dst[at + 1] = word >> 8 & 255
            dst[at + 2] = word >> 16 & 255
            dst[at + 3] = 255 if word & 0x800000 else 0
            at += 4
            k += 1
        i += 1
    if (s[0] - s[1]) & 0x3FFFFFFF > 681:
        return 0
    stamp[0] = first >> 24 & 255
    stamp[1] = first >> 16 & 255
    stamp[2] = first >> 8 & 255
    stamp[3] = first & 255
    s[1] = (s[1] + n) & 0x3FFFFFFF
    s[2] = s[2] - n
    s[4] = last & 0x3FFFFFFF
    s[5] = 0
    s[6] = 0
    return 1


@micropython.viper
def _number_now(s: ptr32) -> int:
    return s[0] & 0x3FFFFFFF


@micropython.viper
def _wait(timer: ptr32, us: int):
    start = timer[0]
    while timer[0] - start <= us:
        pass


@micropython.viper
def _time(timer: ptr32) -> int:
    return timer[0] & 0x3FFFFFFF


def program(rp2):
    """The state machine's program. in_base is DOUT, DRDY four pins above; side-set CS, SCLK; OSR holds 143, X counts down."""

    @rp2.asm_pio(
        sideset_init=(rp2.PIO.OUT_HIGH, rp2.PIO.OUT_LOW),
        in_shiftdir=rp2.PIO.SHIFT_LEFT,
        autopush=True,
        push_thresh=24,
    )
    def frames():
        label("next")
        wait(1, pin, 4).side(1)
        wait(0, pin, 4).side(1)
        mov(isr, invert(x)).side(1)
        push().side(1)
        mov(y, osr).side(0)[7]
        label("bit")
        nop().side(2)[7]
        in_(pins, 1).side(0)[4]
        jmp(y_dec, "bit").side(0)
        jmp(x_dec, "next").side(1)[3]  # from 0 it falls through to the same place

    return frames


# instructions that the CPU gives to the state machine; 0x0800 is CS high, SCLK low in its side-set bits
_PULL = 0x80A0 | 0x0800  # pull(block)
_X_TO_1 = 0xE021 | 0x0800  # set(x, 1)
_INVERT_X = 0xA029 | 0x0800  # mov(x, invert(x)): the first number is 1


class Adc:
    """The source of stream 0 (box.py says what a source is). Pins: DOUT, CS, SCLK, DIN, DRDY, SYNC, CLKIN.

    Takes one state machine, eleven instructions, three DMA channels, a PWM slice and 32 KiB. Raises ValueError if the pins do not
    suit the state machine: CS and SCLK in a row, DRDY four above DOUT.
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
        self._state_machine(rp2, state_machine, dout, cs)
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

    def _state_machine(self, rp2, number, dout, cs):
        chip, block = self._chip, number // 4
        Pin = self._machine.Pin
        self._sm = rp2.StateMachine(number, program(rp2), freq=chip.CLOCK_HZ, in_base=Pin(dout), sideset_base=Pin(cs))
        self._mux(chip.FUNCTION_SIO)
        self._pio_function = chip.FUNCTION_PIO[block]
        base = chip.PIO[block]
        self._rx = base + chip.PIO_RXF + 4 * (number % 4)
        self._tx = base + chip.PIO_TXF + 4 * (number % 4)
        self._instruction = base + chip.PIO_SM_INSTR + chip.PIO_SM_STRIDE * (number % 4)
        self._levels = base + chip.PIO_FLEVEL
        self._level_bits = 0xF << 4 << 8 * (number % 4)

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
        paced = {"size": 2, "inc_read": False, "treq_sel": request, "irq_quiet": True}
        ring = {"ring_sel": True, "irq_quiet": True, "size": 2, "inc_read": False}
        controls = (
            number_dma.pack_ctrl(inc_write=False, chain_to=stamp_dma.channel, **paced),
            stamp_dma.pack_ctrl(treq_sel=chip.DREQ_FORCE, ring_size=12, chain_to=frame_dma.channel, **ring),
            frame_dma.pack_ctrl(treq_sel=request, ring_size=14, chain_to=number_dma.channel, **ring),
        )
        self._setups = (
            array("I", (self._rx, address(self._survey), 1, controls[0])),
            array("I", (self._timer, self._stamps + 4, 1, controls[1])),
            array("I", (self._rx, self._ring + RECORD, 6, controls[2])),
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
        """How often the converter was set up anew while sampling, since boot. Wraps at 2^30."""
        return self._resets

    def _look(self, n):
        found = survey(self._survey, self._ring, self._stamps, self._timer, TABLE, n)
        if self._survey[LOST_CONVERTER] and self.running:
            self._recover()
        return found

    def _give_up(self, n):
        """Drop samples before a gap that nobody asks for; the index jumps over them."""
        s = self._survey
        if s[BROKEN] and (_number_now(s) - s[READ]) & COUNTER > NAIVE_BLOCKS * n:
            s[READ] = (s[READ] + s[SEEN]) & COUNTER
            s[SEEN] = 0
            s[BROKEN] = 0

    # -- the hardware; no call allocates

    def _recover(self):
        self._resets = (self._resets + 1) & COUNTER
        self._survey[EVENTS] = (self._survey[EVENTS] + 1) & COUNTER
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
            before = _number_now(s)
            self._machine.enable_irq(state)
            s[READ] = (before + 1 + SETTLING) & COUNTER
        s[ALIVE] = _time(self._timer)

    def _listen(self):
        """DMA and the state machine are ready for the first conversion after this."""
        chip = self._chip
        for k in range(3):
            arm(self._bases[k], self._setups[k])
        poke(chip.DMA_MULTI_CHAN_TRIGGER, self._first)
        self._sm.restart()
        poke(self._tx, BITS)
        poke(self._instruction, _PULL)
        poke(self._instruction, _X_TO_1)
        poke(self._instruction, _INVERT_X)
        self._din.off()
        self._mux(self._pio_function)
        self._sm.active(1)

    def _halt(self):
        chip = self._chip
        self._sm.active(0)
        self._mux(chip.FUNCTION_SIO)
        halt(chip, self._bases, self._setups, self._all)
        drain(self._rx, self._levels, self._level_bits)
