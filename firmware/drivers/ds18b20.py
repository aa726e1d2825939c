"""DS18B20 thermometers on one wire, timed by a PIO state machine.

Only `search` waits or allocates; no interrupt is blocked.

A pull-up holds the wire high; the state machine pulls it low through its pin's direction. One word makes one slot, at 1
MHz:

    bits 0-9    the wire is low for this many µs plus one
    bits 10-19  then this many µs plus two until it is sampled; the bit goes to the RX FIFO
    bits 20-31  then this many µs plus three until the next slot can begin

A slot starts only on request: between slots the wire stays high, for any time (DS18B20 datasheet, "1-Wire signaling").
A transfer therefore simply continues whenever `step` is called: it takes the bits that arrived and writes as many words
as fit the FIFO. With at most four slots in progress the RX FIFO never fills; a full one would delay the sampling of the
wire.

Times from the datasheet: a reset is low for at least 480 µs; 60 to 75 µs later every thermometer holds the wire low (15
to 60 µs until its presence pulse, which lasts at least 60 µs). A 1 is low for 1 to 15 µs and a 0 for 60 to 120. Data
are valid until 15 µs after the falling edge, so the wire is sampled at 14 µs, 12 after the release: enough for 5.2 kΩ
and 2.4 nF of cable and protection. A slot takes 70 µs.
"""

# ruff: noqa: F821  (the state machine's instructions are names that asm_pio brings)

from array import array

from truearm_wire.fast import const, copy, micropython, ptr8, ptr32

from .registers import peek, poke

BUSY = 0  # results of `step` (truearm_box/box.py)
DONE = 1
FAILED = 2
MOST = 8  # thermometers to search for
FAMILY = 0x28
RESET = 499 | 68 << 10 | 427 << 20  # low for 500 µs, sampled 70 later
ONE = 1 | 10 << 10 | 53 << 20  # and a read
ZERO = 64 | 0 << 10 | 1 << 20
SLOT_WAIT = 2000  # polls of the FIFO: some ms, compared with 0.07 for a slot and 1 for a reset

SEARCH = 0xF0
MATCH = 0x55
SKIP = 0xCC
CONVERT = 0x44
READ = 0xBE
SCRATCHPAD = 9  # bytes
ADDRESSED = 10  # bytes before them: MATCH, address, READ
POWER_ON = 85000  # m°C of a thermometer that has not converted since its power-on

# state words
GOT = const(0)  # bits received
FED = const(1)  # bits written
END = const(2)  # bits of the message


def program(rp2):
    """Slots from words. in_base and sideset_base are the wire."""

    @rp2.asm_pio(
        sideset_init=rp2.PIO.IN_LOW,
        side_pindir=True,
        out_shiftdir=rp2.PIO.SHIFT_RIGHT,
        autopull=True,
        autopush=True,
        push_thresh=1,
    )
    def slots():
        wrap_target()
        out(x, 10).side(0)
        label("low")
        jmp(x_dec, "low").side(1)
        out(x, 10).side(0)
        label("answer")
        jmp(x_dec, "answer").side(0)
        in_(pins, 1).side(0)
        out(x, 12).side(0)
        label("rest")
        jmp(x_dec, "rest").side(0)
        wrap()

    return slots


@micropython.viper
def exchange(s: ptr32, levels: ptr32, shift: int, fifos: ptr32, out: ptr8, back: ptr8) -> int:
    """Take the received bits to `back`, write those of `out` that fit. fifos: addresses of RX, TX.

    Returns 1 when all are received.
    """
    rx = ptr32(fifos[0])
    tx = ptr32(fifos[1])
    one = 1 | 10 << 10 | 53 << 20  # ONE, ZERO
    zero = 64 | 1 << 20
    got = s[GOT]
    fed = s[FED]
    while got < fed and (levels[0] >> shift) & 15:
        bit = 1 << (got & 7)
        if rx[0] == 0:
            back[got >> 3] = back[got >> 3] & (255 - bit)
        else:
            back[got >> 3] = back[got >> 3] | bit
        got += 1
    while fed < s[END] and fed - got < 4:
        tx[0] = one if (out[fed >> 3] >> (fed & 7)) & 1 else zero
        fed += 1
    s[GOT] = got
    s[FED] = fed
    return 1 if got == s[END] else 0


@micropython.viper
def crc8(data: ptr8, i: int, end: int) -> int:
    """Return the CRC of data[i:end], x^8 + x^5 + x^4 + 1 reflected: 0 if its last byte is the others' checksum."""
    crc = 0
    while i < end:
        crc = crc ^ data[i]
        for _ in range(8):
            crc = crc >> 1 ^ 0x8C if crc & 1 else crc >> 1
        i += 1
    return crc


def reading(data, at):
    """Return thousandths of a degree from a scratchpad at data[at:], or None if invalid.

    (A wire held low gives zeros with a valid checksum.)
    """
    if crc8(data, at, at + SCRATCHPAD) or data[at + 4] & 0x9F != 0x1F:
        return None
    sixteenths = data[at] | data[at + 1] << 8
    if sixteenths & 0x8000:
        sixteenths -= 0x10000
    mdegc = sixteenths * 125 // 2
    return None if mdegc == POWER_ON else mdegc


class Thermometers:
    """The bus of thermometers on a pin (truearm_box/box.py describes a bus).

    Uses a state machine and seven instructions of its block.
    """

    def __init__(self, machine, rp2, chip, pin, state_machine):
        wire = machine.Pin(pin, machine.Pin.IN, machine.Pin.PULL_UP)
        block, index = state_machine // 4, state_machine % 4
        base = chip.PIO[block]
        self._sm = rp2.StateMachine(state_machine, program(rp2), freq=1000000, in_base=wire, sideset_base=wire)
        self._levels = base + chip.PIO_FLEVEL
        self._shift = 8 * index + 4
        self._rx = base + chip.PIO_RXF + 4 * index
        self._tx = base + chip.PIO_TXF + 4 * index
        self._fifos = array("I", (self._rx, self._tx))
        self._state = array("I", (0, 0, 0))
        self._resetting = False
        self._reading = False
        self._message = bytearray(ADDRESSED + SCRATCHPAD)
        self._back = bytearray(ADDRESSED + SCRATCHPAD)
        self.uids = ()
        self.mdegc = 0
        self._sm.active(1)
        self.search()

    def stop(self):
        self._sm.active(0)

    # -- finding them; waits about 20 ms per thermometer

    def search(self):
        """Find the thermometers on the wire (Maxim's application note 187), at most MOST."""
        found = []
        uid = bytearray(8)
        last = 64  # the last bit at which addresses differed
        for _ in range(MOST):  # on a wire that is held low, they differ at every bit
            if self._slot(RESET):
                break
            last = self._walk(uid, last)
            if last is None:
                break
            if uid[0] == FAMILY and crc8(uid, 0, 8) == 0:
                found.append(bytes(uid))
            if last < 0:
                break
        self.uids = tuple(found)

    def _walk(self, uid, last):
        """Go to the next address.

        Returns the last bit at which a 0 was taken although there is a 1, -1 if none; None if there is no answer.
        """
        for i in range(8):
            self._slot(ONE if SEARCH >> i & 1 else ZERO)
        parted = -1
        for i in range(64):
            mask = 1 << (i & 7)
            bit = self._slot(ONE)
            complement = self._slot(ONE)
            if bit and complement:
                return None
            if bit == complement:
                bit = (1 if uid[i >> 3] & mask else 0) if i < last else 1 if i == last else 0
                if not bit:
                    parted = i
            uid[i >> 3] = uid[i >> 3] | mask if bit else uid[i >> 3] & (255 - mask)
            self._slot(ONE if bit else ZERO)
        return parted

    def _slot(self, word):
        """Return the wire in a slot: 1 or 0. Waits for it."""
        poke(self._tx, word)
        for _ in range(SLOT_WAIT):
            if self._sm.rx_fifo():
                return peek(self._rx, 1)
        return 1

    # -- reading them; no call allocates

    def begin(self, uid):
        message = self._message
        if uid is None:
            message[0] = SKIP
            message[1] = CONVERT
            self._state[END] = 16
        else:
            message[0] = MATCH
            copy(message, 1, uid, 0, 8)
            message[9] = READ
            for i in range(ADDRESSED, ADDRESSED + SCRATCHPAD):
                message[i] = 0xFF
            self._state[END] = 8 * (ADDRESSED + SCRATCHPAD)
        self._state[GOT] = self._state[FED] = 0
        self._reading = uid is not None
        self._resetting = True
        poke(self._tx, RESET)

    def step(self):
        if self._resetting:
            if not self._sm.rx_fifo():
                return BUSY
            self._resetting = False
            if peek(self._rx, 1):
                return FAILED
        if not exchange(self._state, self._levels, self._shift, self._fifos, self._message, self._back):
            return BUSY
        if not self._reading:
            return DONE
        mdegc = reading(self._back, ADDRESSED)
        if mdegc is None:
            return FAILED
        self.mdegc = mdegc
        return DONE
