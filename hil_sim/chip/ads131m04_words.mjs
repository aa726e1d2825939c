// Values of the ADS131M04: what filter and calibration make of counts, how a word stands in a frame, and the frame's CRC.
// ads131m04.mjs is the part at its pins.

const FULL_SCALE = 1 << 23;
const TEST_SIGNAL = Math.round((0.16 / 1.2) * FULL_SCALE); // 160 mV / gain, behind the amplifier

const clip = (value) => Math.max(-FULL_SCALE, Math.min(FULL_SCALE - 1, Math.round(value)));
const signed24 = (value) => (value << 8) >> 8;

/** CRC-16 of bytes, from FFFFh: CCITT (1021h) or ANSI (8005h), bit by bit. */
export function crc16(bytes, polynomial = 0x1021) {
  let crc = 0xffff;
  for (const byte of bytes) {
    for (let bit = 7; bit >= 0; bit--) {
      const carry = ((crc >> 15) ^ (byte >> bit)) & 1;
      crc = (crc << 1) & 0xffff;
      if (carry) crc ^= polynomial;
    }
  }
  return crc;
}

/** Registers stand in the upper 16 bits of a word; data lose their lower bits, or get more by zeros or, if extended, by sign. */
export function frameWord(value, size, data, extended = false) {
  const wide = data ? value & 0xffffff : (value & 0xffff) << 8;
  const bytes = [(wide >> 16) & 255, (wide >> 8) & 255, wide & 255];
  if (size === 2) return bytes.slice(0, 2);
  if (size === 3) return bytes;
  return data && extended ? [value & 0x800000 ? 255 : 0, ...bytes] : [...bytes, 0];
}

/** What of a step has come through the filter after `index` conversions: sinc3, above 1024 the mean of its outputs. */
export function settled(index, osr) {
  const r = osr / 1024;
  if (r <= 1) return [1 / 6, 5 / 6][index] ?? 1;
  return index === 0 ? (r - 1) / r : 1;
}

/** Multiplexer, saturation and calibration of a channel, by its five registers from CFG on. */
export function calibrated(amplified, [cfg, offsetHigh, offsetLow, gainHigh, gainLow], noise) {
  const input = [amplified, noise, TEST_SIGNAL, -TEST_SIGNAL][cfg & 3];
  const offset = signed24((offsetHigh << 8) | (offsetLow >> 8));
  const factor = ((gainHigh << 8) | (gainLow >> 8)) / FULL_SCALE;
  return clip((clip(input) - offset) * factor);
}
