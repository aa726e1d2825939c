"""Trigger edges: two inputs and the box's own output, stamped by PIO and DMA alone.

Every edge is handed out or counted.

One state machine reads three adjacent pins: the inputs (lines 0 and 1) and the output (line 2), read back from its own
pad, so all three are stamped in the same way. Its loop has four cycles (32 ns at 125 MHz):

    mov isr, null; in pins, 3; mov x, isr; jmp x != y     the levels differ from those in Y: a change

A change takes seven cycles more. It pushes one word, (number << 3 | levels); the number counts down from 0 at every
change, in OSR. Two DMA channels run in an endless cycle, each started by the previous one, one transfer at a time
(every start reloads the count of 1):

    word     RX FIFO → ring of words      paced by the FIFO
    stamp    TIMERAWL → ring of stamps    at once

so word and stamp have the same index in their rings. The change is seen 2 cycles (synchroniser) to 6 (the loop) after
the edge and pushed 6 later. TIMERAWL is read within 0.2 µs of that even with a busy bus: a stamp is at most 1 µs early
(it is the current microsecond) and 0.3 µs late. Both edges of a pulse of 100 ns are seen. A shorter pulse, or an edge
within 88 ns of another, may be missed: opto-couplers are slower.

Bursts: the FIFO is joined to 8 words. The ring holds EDGES, of which Python may leave 240 waiting. A change that finds
the FIFO full (a long series faster than two transfers) or is overwritten in the ring is lost, but counted: the number
of the next word gives the number of changes. Their lines are unknown, so the word after a gap only gives the levels
from which the next edges are formed, and counts as lost itself.

The first word, number 0, is pushed at the start: the levels from which edges are formed.

Two lines that change at the same look make one word and two edges with one stamp.

The box debounces (truearm_box/ring.py), by stamps: here every edge counts.
"""

# ruff: noqa: F821  (the state machine's instructions are names that asm_pio brings)

from array import array

from truearm_wire.fast import const, micropython, ptr8, ptr32

from .registers import aligned, arm, drain, halt, poke

OUTPUT = 2  # line of the box's own output
EDGES = const(256)  # capacity of the ring in changes
RING_BITS = 10  # 2^10 bytes

_WRITE_ADDR = const(1)  # register of a DMA channel
_NUMBERS = const(0x1FFFFFFF)  # mask of a change's number
_IN_RING = const(255)

# state words
READ = const(0)  # number of the last change read, modulo 2^29
PLACE = const(1)  # in the ring of the next one
LEVELS = const(2)  # after the last change read
PENDING = const(3)  # its lines whose edges are not yet handed out
TIME = const(4)  # its stamp
DROPPED = const(5)  # changes that were lost, modulo 2^30
STATE = const(6)


@micropython.viper
def next_change(s: ptr32, channel: ptr32, words: ptr32, stamps: ptr32) -> int:
    """Read the next change: its lines to PENDING. Returns 0 if there is none. channel: registers of the stamps."""
    place = (channel[_WRITE_ADDR] - int(stamps)) >> 2 & _IN_RING
    newest = (0 - (words[(place - 1) & _IN_RING] >> 3)) & _NUMBERS
    behind = (newest - s[READ]) & _NUMBERS
    if behind == 0:
        return 0
    if behind > EDGES - 16:  # the next ones are, or soon will be, overwritten: continue in the newer half
        s[PLACE] = (place + EDGES // 2) & _IN_RING
    i = s[PLACE]
    s[PLACE] = (i + 1) & _IN_RING
    number = (0 - (words[i] >> 3)) & _NUMBERS
    gap = (number - s[READ] - 1) & _NUMBERS
    if gap & 0x10000000:  # older than what was read: the ring was not full
        return 1
    levels = words[i] & 7
    if gap:
        s[DROPPED] = (s[DROPPED] + gap + 1) & 0x3FFFFFFF
    else:
        s[PENDING] = levels ^ s[LEVELS]
    s[READ] = number
    s[LEVELS] = levels
    s[TIME] = stamps[i]
    return 1


@micropython.viper
def hand_out(s: ptr32, edge: ptr8):
    """Copy one of the PENDING edges to `edge`."""
    line = 0
    while s[PENDING] & (1 << line) == 0:
        line += 1
    bit = 1 << line
    s[PENDING] = s[PENDING] & (7 - bit)
    time = s[TIME]
    edge[0] = line
    edge[1] = s[LEVELS] >> line & 1
    edge[2] = time >> 24
    edge[3] = time >> 16
    edge[4] = time >> 8
    edge[5] = time


@micropython.viper
def first_levels(words: ptr32) -> int:
    return words[0] & 7


def program(rp2):
    """The watcher. in_base is line 0. OSR: minus the number of the next change; X and Y: levels."""

    @rp2.asm_pio(in_shiftdir=rp2.PIO.SHIFT_LEFT, fifo_join=rp2.PIO.JOIN_RX)
    def watcher():
        label("changed")
        mov(y, x)
        mov(isr, osr)
        in_(y, 3)
        push(noblock)
        mov(x, osr)
        jmp(x_dec, "next")
        label("next")
        mov(osr, x)
        wrap_target()
        mov(isr, null)
        in_(pins, 3)
        mov(x, isr)
        jmp(x_not_y, "changed")
        wrap()

    return watcher


# instructions that the CPU executes on the state machine
_IN_PINS_3 = 0x4003
_X_ISR = 0xA026
_OSR_0 = 0xA0E3


class Triggers:
    """Trigger lines 0 and 1 on the first two of three adjacent pins; the box's output, line 2, on the third.

    Runs at once.

    Uses one state machine, eleven instructions, two DMA channels and 4 KiB.
    """

    def __init__(self, machine, rp2, chip, first_pin, state_machine=2):
        Pin = machine.Pin
        for pin in (first_pin, first_pin + 1):
            Pin(pin, Pin.IN, Pin.PULL_DOWN)  # a line that is not driven is low
        self._output = Pin(first_pin + OUTPUT, Pin.OUT, value=0)
        self._chip = chip
        self._sm = rp2.StateMachine(state_machine, program(rp2), in_base=Pin(first_pin))
        block, index = state_machine // 4, state_machine % 4
        base = chip.PIO[block]
        self._fifo = base + chip.PIO_RXF + 4 * index
        self._levels = base + chip.PIO_FLEVEL
        self._level_bits = 0xF << 4 << 8 * index
        self._rings(rp2, chip.DREQ_PIO_RX + chip.DREQ_PIO_STRIDE * block + index)
        self._state = array("I", bytes(4 * STATE))
        self._start()

    def _rings(self, rp2, request):
        """Two aligned rings in one buffer, and the tasks of the two channels."""
        chip = self._chip
        size = 4 * EDGES
        self._memory = bytearray(3 * size)
        self._words = aligned(self._memory, size)
        self._stamps = self._words + size
        self._dma = word, stamp = rp2.DMA(), rp2.DMA()
        ring = {"size": 2, "inc_read": False, "irq_quiet": True, "ring_sel": True, "ring_size": RING_BITS}
        controls = (
            word.pack_ctrl(treq_sel=request, chain_to=stamp.channel, **ring),
            stamp.pack_ctrl(treq_sel=chip.DREQ_FORCE, chain_to=word.channel, **ring),
        )
        self._setups = (
            array("I", (self._fifo, self._words, 1, controls[0])),
            array("I", (chip.TIMERAWL, self._stamps, 1, controls[1])),
        )
        self._bases = tuple([chip.DMA + chip.DMA_STRIDE * dma.channel for dma in self._dma])
        self._all = 1 << word.channel | 1 << stamp.channel
        self._first = 1 << word.channel

    def _start(self):
        state = self._state
        halt(self._chip, self._bases, self._setups, self._all)
        drain(self._fifo, self._levels, self._level_bits)
        for k in range(2):
            arm(self._bases[k], self._setups[k])
        poke(self._chip.DMA_MULTI_CHAN_TRIGGER, self._first)
        self._sm.restart()
        self._sm.exec(_IN_PINS_3)
        self._sm.exec(_X_ISR)
        self._sm.exec(_OSR_0)
        self._sm.active(1)
        # its first word is in the ring long before this
        state[LEVELS] = first_levels(self._words)
        state[PLACE] = 1

    def stop(self):
        """Stop: the buffers may be freed."""
        self._sm.active(0)
        halt(self._chip, self._bases, self._setups, self._all)

    # -- no call below allocates

    def output(self, level):
        self._output.value(level)

    def edge(self, edge):
        """If an edge waits, copy line, rising, stamp (1, 1, 4 bytes, big endian) to edge."""
        state = self._state
        while not state[PENDING]:  # the change after a gap has none
            if not next_change(state, self._bases[1], self._words, self._stamps):
                return False
        hand_out(state, edge)
        return True

    @property
    def dropped(self):
        """Return the changes lost since boot. Wraps at 2^30."""
        return self._state[DROPPED]
