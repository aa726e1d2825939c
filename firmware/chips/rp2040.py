"""What the drivers must know about the RP2040: clock, register addresses, data request numbers. From its datasheet.

Sections: 2.5.3 (DREQ numbers), 2.5.7 (DMA registers), 3.7 (PIO), 4.4.4 (SPI), 4.5.3 (PWM), 4.6.5 (timer), 4.7.6
(watchdog), 2.12.7 (chip reset), 2.17.8 (ROSC). Only numbers: nothing here accesses the chip.
"""

NAME = "rp2040"
CLOCK_HZ = 125000000  # set by MicroPython; every divider below refers to it
CONVERTER_DIVIDER = 15  # of the converter's clock: 8.33 MHz, of at most 8.4 MHz

# the microsecond timer, 64 bit: the raw halves, which can be read without side effects
TIMERAWH = 0x40054024
TIMERAWL = 0x40054028

# DMA: channel registers from DMA + DMA_STRIDE * channel, offsets below; in an alias the last register starts the
# channel
DMA = 0x50000000
DMA_STRIDE = 0x40
DMA_CHANNELS = 12
DMA_READ_ADDR = 0x00
DMA_WRITE_ADDR = 0x04
DMA_TRANS_COUNT = 0x08
DMA_CTRL_TRIG = 0x0C
DMA_AL1_CTRL = 0x10
DMA_AL1_READ_ADDR = 0x14
DMA_AL1_WRITE_ADDR = 0x18
DMA_AL1_TRANS_COUNT_TRIG = 0x1C
DMA_AL2_CTRL = 0x20
DMA_AL2_TRANS_COUNT = 0x24
DMA_AL2_READ_ADDR = 0x28
DMA_AL2_WRITE_ADDR_TRIG = 0x2C
DMA_AL3_CTRL = 0x30
DMA_AL3_WRITE_ADDR = 0x34
DMA_AL3_TRANS_COUNT = 0x38
DMA_AL3_READ_ADDR_TRIG = 0x3C
DMA_MULTI_CHAN_TRIGGER = 0x50000430
DMA_CHAN_ABORT = 0x50000444
DMA_BUSY = 1 << 24  # of CTRL

# data requests: DREQ_PIO_TX + 8 * pio + state machine of that block, and so on
DREQ_PIO_TX = 0
DREQ_PIO_RX = 4
DREQ_PIO_STRIDE = 8
DREQ_SPI_TX = 16
DREQ_SPI_RX = 17
DREQ_SPI_STRIDE = 2
DREQ_PWM_WRAP = 24
DREQ_ADC = 36
DREQ_FORCE = 63  # always: as fast as possible

# PIO blocks, four state machines and 32 instructions each
PIO = (0x50200000, 0x50300000)
PIO_CTRL = 0x00
PIO_FSTAT = 0x04
PIO_FDEBUG = 0x08
PIO_FLEVEL = 0x0C
PIO_TXF = 0x10  # + 4 * state machine
PIO_RXF = 0x20
PIO_IRQ = 0x30
PIO_SM_CLKDIV = 0xC8  # + PIO_SM_STRIDE * state machine
PIO_SM_EXECCTRL = 0xCC
PIO_SM_SHIFTCTRL = 0xD0
PIO_SM_ADDR = 0xD4
PIO_SM_INSTR = 0xD8
PIO_SM_PINCTRL = 0xDC
PIO_SM_STRIDE = 0x18

# SPI (PL022)
SPI = (0x4003C000, 0x40040000)
SPI_CR0 = 0x00
SPI_CR1 = 0x04
SPI_DR = 0x08
SPI_SR = 0x0C
SPI_CPSR = 0x10
SPI_IMSC = 0x14
SPI_RIS = 0x18
SPI_ICR = 0x20
SPI_DMACR = 0x24

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
PADS_BANK0 = 0x4001C000
FUNCTION_SPI = 1
FUNCTION_PWM = 4
FUNCTION_SIO = 5
FUNCTION_PIO = (6, 7)
INPUT_INVERTED = 1 << 16  # of CTRL

# single-cycle I/O
SIO_GPIO_IN = 0xD0000004
SIO_GPIO_OUT_SET = 0xD0000014
SIO_GPIO_OUT_CLR = 0xD0000018

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
WATCHDOG_SCRATCH0 = 0x4005800C  # eight words that survive all but a power-on reset; the boot ROM uses 4 to 7
CHIP_RESET = 0x40064008  # bit 8 power-on or brown-out, 16 the RUN pin, 20 the debugger
ROSC_RANDOMBIT = 0x4006001C
