"""What the drivers must know about the RP2040: clock, register addresses, data request numbers. From its datasheet.

Sections: 2.5.3 (DREQ numbers), 2.5.7 (DMA registers), 3.7 (PIO), 4.5.3 (PWM), 4.6.5 (timer), 4.7.6 (watchdog). Only
the numbers that the drivers use: nothing here accesses the chip.
"""

NAME = "rp2040"
CLOCK_HZ = 125000000  # set by MicroPython; every divider below refers to it
CONVERTER_DIVIDER = 15  # of the converter's clock: 8.33 MHz, of at most 8.4 MHz

# the microsecond timer, 64 bit: the raw lower half, which can be read without side effects
TIMERAWL = 0x40054028

# DMA: channel registers from DMA + DMA_STRIDE * channel, in the first alias CTRL comes first, and the last register
# starts the channel
DMA = 0x50000000
DMA_STRIDE = 0x40
DMA_AL1_CTRL = 0x10
DMA_MULTI_CHAN_TRIGGER = 0x50000430
DMA_CHAN_ABORT = 0x50000444
DMA_BUSY = 1 << 24  # of CTRL

# data requests: DREQ_PIO_TX + 8 * pio + state machine of that block, and so on
DREQ_PIO_TX = 0
DREQ_PIO_RX = 4
DREQ_PIO_STRIDE = 8
DREQ_FORCE = 63  # always: as fast as possible

# PIO blocks, four state machines and 32 instructions each
PIO = (0x50200000, 0x50300000)
PIO_CTRL = 0x00
PIO_FLEVEL = 0x0C
PIO_TXF = 0x10  # + 4 * state machine
PIO_RXF = 0x20
PIO_IRQ = 0x30
PIO_SM_INSTR = 0xD8
PIO_SM_STRIDE = 0x18

# PWM: slice of a pin is (pin >> 1) & 7, its channel A or B by the pin's lowest bit
PWM = 0x40050000
PWM_STRIDE = 0x14
PWM_CSR = 0x00
PWM_DIV = 0x04
PWM_CTR = 0x08
PWM_CC = 0x0C
PWM_TOP = 0x10
PWM_EN = 0x400500A0

# pins: function select of IO_BANK0's GPIO control registers (8 bytes a pin, CTRL at + 4), pads (4 bytes a pin from + 4)
IO_BANK0 = 0x40014000
FUNCTION_PWM = 4
FUNCTION_SIO = 5
FUNCTION_PIO = (6, 7)
INPUT_INVERTED = 1 << 16  # of CTRL

# a register's address plus this: writing there sets or clears bits
SET = 0x2000
CLEAR = 0x3000

# USB: buffer control of the endpoint on which MicroPython's CDC sends (2 IN); the bit means that a packet waits for the
# host
USB_CDC_IN = 0x50100090
USB_AVAILABLE = 1 << 10

# watchdog, reset causes and random bits
WATCHDOG_CTRL = 0x40058000
WATCHDOG_ENABLE = 1 << 30
WATCHDOG_REASON = 0x40058008  # bit 0 the watchdog's timer, bit 1 forced by software; 0 any other reset
