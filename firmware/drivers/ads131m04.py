"""ADS131M04: 24-bit delta-sigma converter with 4 simultaneous channels.

Registers, frames and CRC; ads131m04_dma.py samples.

From the datasheets SBAS890 (ADS131M04) and SBASA13 (-Q1), sections 6.6, 6.7 and 8:
- SPI mode 1 (data change on the rising edge of SCLK, are read on the falling one), SCLK period ≥ 40 ns at DVDD ≥ 2.7 V,
  high and low ≥ 20 ns; CS low ≥ 16 ns before the first SCLK, DOUT driven ≤ 50 ns after it and valid ≤ 20 ns after a
  rising edge; CS high ≥ 15 ns. Words of 24 bits, most significant bit first; commands, registers, CRC are in a word's
  upper 16 bits.
- A frame has 6 words. In: command, then zeros (WREG: the register). Out: response to the frame before, channels 0 to 3
  in two's complement, CRC-16 of the five words (CCITT, x^16 + x^12 + x^5 + 1, from 0xFFFF, nothing reflected or
  inverted).
- Commands: NULL 0000 (its response is STATUS), RESET 0011 (a whole frame; FF24), STANDBY 0022, WAKEUP 0033, LOCK 0555,
  UNLOCK 0655 (these answer themselves), RREG 101a aaaa annn nnnn (the register), WREG 011a aaaa annn nnnn (010a aaaa
  ammm mmmm).
- STATUS: LOCK 15, F_RESYNC 14, REG_MAP 13 (with REGCRC_EN: the registers changed), CRC_ERR 12, CRC_TYPE 11, RESET 10,
  WLENGTH 9:8 (1: 24 bits), DRDY3..0 3:0 (new data of that channel in this frame). After a reset 0500.
- MODE: REGCRC_EN 13, RX_CRC_EN 12, CRC_TYPE 11, RESET 10 (0 written clears it), WLENGTH 9:8, TIMEOUT 4 (a frame longer
  than 2^15 clocks is given up), DRDY_SEL 3:2, DRDY_HiZ 1, DRDY_FMT 0 (0: level, 1: pulse). After a reset 0510.
- CLOCK: CHn_EN 11:8, TBM 5, OSR 4:2 (128 · 2^code), PWR 1:0 (2: high resolution, 0.3 to 8.4 MHz). After a reset 0F0E.
  The modulator runs at CLKIN / 2, a conversion lasts 2 · OSR clocks.
- GAIN1: PGAGAINn at 4n, gain 2^code. Full scale is ±1.2 V / gain; results stop at 7FFFFF and 800000. Calibration: OCALn
  is subtracted, then GCALn / 2^23 multiplies (CHn_OCAL 0A + 5n …, CHn_GCAL 0C + 5n …; 0 and 800000 after a reset, and
  left so: the host calibrates).
- SYNC/RESET low for 1 to 2047 clocks: conversions start again and the buffers are empty; ≥ 2048 clocks: reset.
  Registers may be used 5 µs (t_REGACQ) after a reset.
- DRDY (level) falls when a conversion ends and rises when its data are read, or 4 clocks before the next one ends if
  they are not. Two conversions are buffered: a reader that starts late lags by one permanently, unless it gives a SYNC
  pulse or reads twice. Therefore ads131m04_dma.py is ready before the SYNC pulse and reads every conversion from then
  on.
- Filter: sinc3 up to OSR 1024, above that sinc3 at 1024 and the mean of its last OSR / 1024 results. Results are output
  while it settles: three conversions after SYNC; after a reset the first two are sinc1.

RX_CRC_EN stays off: while sampling, DIN is low, so every frame is the command NULL. Any change of the registers by
interference is detected by REG_MAP. Its check takes 448 clocks.
"""

from array import array

from truearm_wire.fast import micropython, ptr8, ptr16

NULL = 0x0000
RREG = 0xA000  # + address << 7
WREG = 0x6000

ID = 0x00
MODE = 0x02
CLOCK = 0x03
GAIN1 = 0x04
CH0_CFG = 0x09  # and every fifth after it; the inputs' multiplexer is in the lowest two bits
SHORTED = 1

ID_MSB = 0x24  # two reserved bits, four channels; the lower byte is reserved
MODE_WORD = 0x2110  # REGCRC_EN, RESET cleared, 24 bits, TIMEOUT, DRDY as a level
CLOCK_WORD = 0x0F02  # four channels, high resolution; + OSR code << 2

OSRS = (128, 256, 512, 1024, 2048, 4096, 8192, 16384)
GAINS = (1, 2, 4, 8, 16, 32, 64, 128)

WORDS = 6
FRAME = 3 * WORDS  # bytes on the wire
SETTLING = 6  # conversions after a SYNC pulse that are not used: three for sinc3 with a margin, two of sinc1

RESET_CLOCKS = 2048
REGACQ_US = 5
REGISTER_CHECK_CLOCKS = 448


def _crc_table():
    # of the polynomial 0x1021
    table = array("H", bytes(512))
    for i in range(256):
        c = i << 8
        for _ in range(8):
            c = (c << 1 ^ 0x1021 if c & 0x8000 else c << 1) & 0xFFFF
        table[i] = c
    return table


TABLE = _crc_table()


@micropython.viper
def _crc16(table: ptr16, buf: ptr8, start: int, end: int) -> int:
    crc = 0xFFFF
    i = start
    while i < end:
        crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ buf[i]]
        i += 1
    return crc


def crc16(buf, start, end):
    """Return the CRC-16 of buf[start:end] as the converter computes it."""
    return _crc16(TABLE, buf, start, end)


def osr_code(osr):
    """Return the OSR field of CLOCK. Raises ValueError."""
    if osr not in OSRS:
        raise ValueError("an oversampling of %s; the converter has %s" % (osr, OSRS))
    return OSRS.index(osr)


def gain_word(gains):
    """Return GAIN1 for the gains of four channels. Raises ValueError."""
    if len(gains) != 4 or not all(gain in GAINS for gain in gains):
        raise ValueError("gains are four of %s, not %s" % (GAINS, gains))
    word = 0
    for channel, gain in enumerate(gains):
        word |= GAINS.index(gain) << 4 * channel
    return word


class Registers:
    """The converter's registers, over a bus with write_readinto(out, into) in SPI mode 1. No call allocates.

    select and sync are pins with on() and off(), both low active; wait(us) waits.
    """

    def __init__(self, bus, select, sync, wait):
        self._bus = bus
        self._select = select
        self._sync = sync
        self._wait = wait
        self._out = bytearray(FRAME)
        self._in = bytearray(FRAME)
        self.clock_word = CLOCK_WORD
        self.gain_word = 0
        self.shorted = False  # inputs shorted inside the converter, to measure its noise

    def _frame(self, command, register):
        """Exchange a frame. Returns the response to the previous frame, or -1 if the CRC is wrong."""
        out = self._out
        out[0] = command >> 8
        out[1] = command & 255
        out[3] = register >> 8
        out[4] = register & 255
        self._select.off()
        self._bus.write_readinto(out, self._in)
        self._select.on()
        got = self._in
        if crc16(got, 0, FRAME - 3) != got[FRAME - 3] << 8 | got[FRAME - 2]:
            return -1
        return got[0] << 8 | got[1]

    def read(self, address):
        """Return a register, or -1 if the answer's CRC is wrong."""
        self._frame(RREG | address << 7, 0)
        return self._frame(NULL, 0)

    def write(self, address, value):
        """Write a register and read it back. Returns whether it holds the value."""
        self._frame(WREG | address << 7, value)
        return self.read(address) == value

    def identified(self):
        """Return whether an ADS131M04 answers."""
        return self.read(ID) >> 8 == ID_MSB

    def setup(self):
        """Reset, identify, configure. Returns whether the converter is in the expected state."""
        self._sync.off()
        self._wait(RESET_CLOCKS // 8 + 50)  # at 8.3 MHz, with a margin
        self._sync.on()
        self._wait(20 * REGACQ_US)
        if not (self.identified() and self.write(MODE, MODE_WORD)):
            return False
        if self.shorted:
            for channel in range(4):
                self.write(CH0_CFG + 5 * channel, SHORTED)
        if not (self.write(GAIN1, self.gain_word) and self.write(CLOCK, self.clock_word)):
            return False
        self._wait(2 * REGISTER_CHECK_CLOCKS // 8 + 20)
        self._frame(NULL, 0)  # its answer, and the next ones, clear REG_MAP
        return True
