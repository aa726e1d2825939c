"""Single registers and addresses, for drivers that work by DMA and PIO. Only `aligned` allocates."""

from truearm_wire.fast import const, micropython, ptr8, ptr32

# registers of a DMA channel; AL1_CTRL starts nothing
_READ_ADDR = const(0)
_WRITE_ADDR = const(1)
_TRANS_COUNT = const(2)
_AL1_CTRL = const(4)
_CONTROL = const(3)  # of a setup, whose first words are in the registers' order


@micropython.viper
def address(buffer: ptr8) -> int:
    """Return the address of a buffer."""
    return int(buffer)


def aligned(buffer, size):
    """Return the first multiple of size, a power of two, in a buffer: a DMA ring of size bytes must begin there."""
    return (address(buffer) + size - 1) & -size


@micropython.viper
def poke(register: ptr32, value: int):
    register[0] = value


@micropython.viper
def peek(register: ptr32, bits: int) -> int:
    """Return these bits of a register, at most 30."""
    return register[0] & bits


@micropython.viper
def arm(channel: ptr32, setup: ptr32):
    """Set read address, write address, count and control of a DMA channel, without starting it."""
    channel[_READ_ADDR] = setup[_READ_ADDR]
    channel[_WRITE_ADDR] = setup[_WRITE_ADDR]
    channel[_TRANS_COUNT] = setup[_TRANS_COUNT]
    channel[_AL1_CTRL] = setup[_CONTROL]


def halt(chip, bases, setups, channels):
    """Stop DMA channels that start one another.

    Each is disabled first, as none may be started meanwhile (RP2040 datasheet 2.5.5.3).

    bases: of their registers; setups: as of `arm`; channels: a bit for each.
    """
    for k in range(len(bases)):
        disable(bases[k], setups[k])
    poke(chip.DMA_CHAN_ABORT, channels)
    while peek(chip.DMA_CHAN_ABORT, channels):
        pass


@micropython.viper
def disable(channel: ptr32, setup: ptr32):
    channel[_AL1_CTRL] = setup[_CONTROL] & -2


def drain(fifo, levels, bits):
    """Empty an RX FIFO: its register, the block's FLEVEL and the FIFO's bits of that."""
    while peek(levels, bits):
        peek(fifo, 0)
