// The converter's model against what others saw of real parts (TI E2E forum, by thread) and what TI's own example code says.
import assert from 'node:assert/strict';
import { Ads131m04 } from '../../hil_sim/chip/ads131m04.mjs';

const pins = Array.from({ length: 30 }, () => ({ release() {} }));
const slices = Array.from({ length: 8 }, () => ({ writeRegister() {} }));
const pico = {
  setPin() {},
  watchPin() {},
  pwmClock: () => null, // no clock: no conversions, so data words are zero
  clock: { nanos: 0, createAlarm: () => ({ schedule() {}, cancel() {} }) },
  chip: { gpio: pins, pwm: { channels: slices } },
};

const bitsOf = (bytes) => bytes.flatMap((byte) => [7, 6, 5, 4, 3, 2, 1, 0].map((i) => (byte >> i) & 1));

/** Bytes that a frame of `command` words (16 bits each) brings out, after which the command is done. */
function exchange(part, words, count = 6) {
  const out = part.outgoing(3);
  const din = words.flatMap((word) => [word >> 8, word & 255, 0]);
  while (din.length < 3 * count) din.push(0);
  part.receive({ bits: 24, din: bitsOf(din), n: 24 * count });
  return out;
}
const first = (bytes) => (bytes[0] << 8) | bytes[1];
const answer = (part, ...words) => {
  exchange(part, words);
  return first(exchange(part, [0]));
};

// 1011774: a frame of an ADS131M04 evaluation board, locked, with nothing converted
let part = new Ads131m04(pico, null);
exchange(part, [0x6100, 0x0110]); // MODE: RESET cleared
exchange(part, [0x0555]);
exchange(part, [0]);
assert.deepEqual(exchange(part, [0]), [0x81, ...new Array(14).fill(0), 0xb4, 0x2d, 0]);

// 1075315 (ADS131M02): CLOCK written with 61 80, answered 4180, read with A1 80
part = new Ads131m04(pico, null);
assert.equal(answer(part, 0xa180), 0x0f0e); // 030E with two channels
assert.equal(answer(part, 0x6180, 0x030a), 0x4180);
assert.equal(answer(part, 0xa180), 0x030a);

// 1333317 (ADS131M03): three registers from 0 read with A002, acknowledged E002, then the registers
exchange(part, [0xa002]);
const several = exchange(part, [0]);
assert.equal(first(several), 0xe002);
assert.equal(several[3], 0x24);
assert.deepEqual(several.slice(9, 11), [0x05, 0x10]); // MODE after a reset

// 1323149 (ADS131M02-Q1): NULL answered 0503, a reset not yet acknowledged and new data of both channels
part = new Ads131m04(pico, { counts: () => [0, 0, 0, 0] });
part.clock = { edgeNs: 0, periodNs: 120 };
exchange(part, [0]);
part.conversions = [{ index: 9, tNs: 0, fast: false }];
assert.equal(first(exchange(part, [0])), 0x050f);

// TI's precision-adc-examples, devices/ads131m08: RESET answers FF2n after a whole frame, 0011 if the frame was short
part = new Ads131m04(pico, null);
exchange(part, [0x0011], 2);
assert.equal(first(exchange(part, [0])), 0x0011);
assert.equal(answer(part, 0x0011), 0xff24);

// SBASA13 table 8-11: STANDBY, WAKEUP, LOCK and UNLOCK answer themselves; locked, a WREG does nothing
for (const command of [0x0022, 0x0033, 0x0555]) assert.equal(answer(part, command), command);
exchange(part, [0x6200, 0x1111]);
assert.equal(answer(part, 0xa200), 0);
assert.equal(answer(part, 0x0655), 0x0655);
console.log('the model answers as the parts did');
