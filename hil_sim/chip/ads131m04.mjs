// ADS131M04: a model of the converter at its pins, from its datasheets (SBAS890, SBASA13); it shares no code with the driver. What
// others saw of real parts is checked against it in tests/chip/ads131m04_model.mjs.
//
// SPI mode 1, frames of words of 16, 24 or 32 bits; the response to a command comes in the frame after it, then four channels and a
// CRC over all of them; RREG of several registers answers with them instead. SYNC/RESET by the length of the pulse. A conversion ends
// every 2 · OSR clocks; two wait in a FIFO; DRDY as a level or a pulse. PGA gain, multiplexer, calibration, saturation, REG_MAP.
// Nothing is held back while the filter settles: a step gives 1/6 and 5/6 of it in the first two conversions of sinc3.
//
// signals.counts(index, tNs, periodNs) are counts at gain 1 (2^23 is 1.2 V) of conversion `index` since conversions were last
// started again, with the filter's delay in them. Messages to `control`: {part: "adc", fault: ...}
//   "corrupt", frames     flips one bit of the data in so many of the next frames
//   "reset"               as if the supply had dipped
//   "silent", ns          no conversions for a time
//   "register", address, value   a register changes by itself
//
// What the datasheet's timing (tables 6.6 and 6.7, DVDD ≥ 2.7 V) forbids is kept in `violations`. Not modelled: current detection,
// phase calibration, the DC block filter, global chop, the TIMEOUT.

import { calibrated, crc16, frameWord, settled } from './ads131m04_words.mjs';

export const PINS = { dout: 16, cs: 17, sclk: 18, din: 19, drdy: 20, sync: 21, clkin: 22 };

const ID = 0, STATUS = 1, MODE = 2, CLOCK = 3, GAIN1 = 4, REGMAP_CRC = 0x3e;
const REGISTERS = 0x40;
const DEFAULTS = { [ID]: 0x2403, [STATUS]: 0x0500, [MODE]: 0x0510, [CLOCK]: 0x0f0e, 0x06: 0x0600 };
const CHANNEL = 9; // first register of channel 0: CFG, OCAL_MSB, OCAL_LSB, GCAL_MSB, GCAL_LSB
const GCAL_MSB = 0x8000;
const LOCK = 1 << 15, F_RESYNC = 1 << 14, REG_MAP = 1 << 13, CRC_ERR = 1 << 12, RESET = 1 << 10;
const REGCRC_EN = 1 << 13, RX_CRC_EN = 1 << 12, ANSI = 1 << 11, PULSE = 1;
const WORD_BITS = [16, 24, 32, 32];
const RESET_CLOCKS = 2048, DRDY_HIGH_CLOCKS = 4, READY_CLOCKS = 250;
const CHANNELS = 4;
const T = { period: 40, high: 20, low: 20, csToClock: 16, clockToCs: 10, csHigh: 15, propagation: 20 }; // ns
const CLKIN_NS = { min: 1e9 / 8.4e6, max: 1e9 / 0.3e6 }; // of the high-resolution mode

export class Ads131m04 {
  /** `pico`: setPin, watchPin, pwmClock, clock, chip; `signals`: counts. `pins`: as PINS. */
  constructor(pico, signals, pins = PINS) {
    this.noise = 1; // state of what shorted inputs give
    this.pico = pico;
    this.signals = signals;
    this.pins = pins;
    this.violations = [];
    this.frames = 0; // whole frames read
    this.conversions = []; // {index, tNs} of those not read, at most two
    this.corrupt = 0;
    this.silentUntilNs = 0;
    this.clock = null;
    this.end = pico.clock.createAlarm(() => this.conversionEnds());
    this.rise = pico.clock.createAlarm(() => this.setDrdy(true));
    this.dout = pico.clock.createAlarm(() => this.showBit());
    this.ready = pico.clock.createAlarm(() => this.begin());
    this.frame = null;
    this.din = 0;
    this.csHighSince = -Infinity;
    this.syncLowSince = null;
    this.lastReadNs = -Infinity;
    pico.chip.gpio[pins.dout].release();
    pico.watchPin(pins.cs, (level, tNs) => (level ? this.csRises(tNs) : this.csFalls(tNs)));
    pico.watchPin(pins.sclk, (level, tNs) => (level ? this.sclkRises(tNs) : this.sclkFalls(tNs)));
    pico.watchPin(pins.din, (level) => (this.din = level ? 1 : 0));
    pico.watchPin(pins.sync, (level, tNs) => (level ? this.syncRises(tNs) : (this.syncLowSince = tNs)));
    this.watchClock();
    this.powerOn();
  }

  violate(what, value, limit) {
    this.violations.push(`${this.pico.clock.nanos} ns: ${what} ${value} ns, ${limit} ns are needed`);
  }

  // -- clock, power, reset, conversions

  watchClock() {
    const { pico, pins } = this;
    const slice = pico.chip.pwm.channels[(pins.clkin >> 1) & 7];
    const write = slice.writeRegister.bind(slice);
    slice.writeRegister = (offset, value) => {
      write(offset, value);
      this.clockChanges();
    };
  }

  clockChanges() {
    const clock = this.pico.pwmClock(this.pins.clkin);
    const same = clock && this.clock && clock.periodNs === this.clock.periodNs;
    if (same || (!clock && !this.clock)) return;
    this.clock = clock;
    this.begin();
  }

  powerOn() {
    this.registers = new Uint16Array(REGISTERS);
    for (const [address, value] of Object.entries(DEFAULTS)) this.registers[address] = value;
    for (let c = 0; c < CHANNELS; c++) this.registers[CHANNEL + 5 * c + 3] = GCAL_MSB;
    this.status = RESET;
    this.response = 0xff24; // what RESET answers, and what a reset by pin or supply leaves
    this.standby = false;
    this.conversions = [];
    this.fast = true; // the first two conversions are sinc1
    this.setDrdy(true);
    this.end.cancel();
    const clockNs = this.clock ? this.clock.periodNs : 0;
    if (clockNs) this.ready.schedule(READY_CLOCKS * clockNs);
  }

  get osr() {
    const clock = this.registers[CLOCK];
    return clock & 0x20 ? 64 : 128 << ((clock >> 2) & 7);
  }

  get periodNs() {
    return 2 * this.osr * this.clock.periodNs;
  }

  /** Conversions start again at the next rising edge of CLKIN. */
  begin() {
    this.end.cancel();
    this.rise.cancel();
    this.conversions = [];
    this.setDrdy(true);
    if (!this.clock || this.standby) return;
    const { edgeNs, periodNs } = this.clock;
    const high = this.registers[CLOCK] & 2;
    if (high && (periodNs < CLKIN_NS.min || periodNs > CLKIN_NS.max)) this.violate('CLKIN period', periodNs, CLKIN_NS.min);
    const now = this.pico.clock.nanos;
    this.startNs = edgeNs + Math.ceil((now - edgeNs) / periodNs) * periodNs;
    this.index = 0;
    this.scheduleEnd();
  }

  scheduleEnd() {
    const tNs = this.startNs + (this.index + 1) * this.periodNs;
    this.end.schedule(tNs - this.pico.clock.nanos);
    // DRDY returns in time if nobody reads
    this.rise.schedule(tNs - DRDY_HIGH_CLOCKS * this.clock.periodNs - this.pico.clock.nanos);
  }

  conversionEnds() {
    const tNs = this.pico.clock.nanos;
    const conversion = { index: this.index, tNs, fast: this.fast && this.index < 2 };
    if (this.index >= 1) this.fast = false;
    this.index++;
    this.scheduleEnd();
    if (tNs < this.silentUntilNs) return;
    if (this.conversions.length === 2) this.conversions[1] = conversion; // who does not read loses the one before
    else this.conversions.push(conversion);
    this.setDrdy(false);
    if (this.registers[MODE] & PULSE) this.rise.schedule(DRDY_HIGH_CLOCKS * this.clock.periodNs);
  }

  setDrdy(level) {
    if (level && this.frame && this.frame.out && this.conversions.length) return; // blocked while data are read
    this.pico.setPin(this.pins.drdy, level);
  }

  syncRises(tNs) {
    if (this.syncLowSince === null) return;
    this.clockChanges();
    const clocks = this.clock ? Math.floor((tNs - this.syncLowSince) / this.clock.periodNs) : 0;
    this.syncLowSince = null;
    if (!this.clock) return;
    if (clocks >= RESET_CLOCKS) this.powerOn();
    else if (clocks >= 1) {
      this.status |= F_RESYNC;
      this.begin();
    } else this.violate('SYNC low', clocks * this.clock.periodNs, this.clock.periodNs);
  }

  // -- frames

  csFalls(tNs) {
    this.clockChanges();
    if (tNs - this.csHighSince < T.csHigh) this.violate('CS high', tNs - this.csHighSince, T.csHigh);
    const bits = WORD_BITS[(this.registers[MODE] >> 8) & 3];
    this.frame = { bits, out: this.outgoing(bits / 8), level: 0, n: 0, din: [], csNs: tNs, riseNs: null, fallNs: null };
    this.pico.setPin(this.pins.dout, 0);
  }

  csRises(tNs) {
    this.csHighSince = tNs;
    const { frame } = this;
    this.frame = null;
    this.dout.cancel();
    this.pico.chip.gpio[this.pins.dout].release();
    if (!frame) return;
    if (frame.fallNs !== null && tNs - frame.fallNs < T.clockToCs) this.violate('SCLK to CS', tNs - frame.fallNs, T.clockToCs);
    if (frame.n && frame.fallNs < frame.riseNs) this.violations.push('CS rose while SCLK was high');
    this.receive(frame);
  }

  sclkRises(tNs) {
    const { frame } = this;
    if (!frame) return;
    if (frame.riseNs === null) {
      if (tNs - frame.csNs < T.csToClock) this.violate('CS to SCLK', tNs - frame.csNs, T.csToClock);
    } else {
      if (tNs - frame.riseNs < T.period) this.violate('SCLK period', tNs - frame.riseNs, T.period);
      if (tNs - frame.fallNs < T.low) this.violate('SCLK low', tNs - frame.fallNs, T.low);
    }
    frame.riseNs = tNs;
    const level = ((frame.out[frame.n >> 3] ?? 0) >> (7 - (frame.n & 7))) & 1;
    if (level === frame.level) return;
    frame.level = level;
    this.dout.schedule(T.propagation);
  }

  showBit() {
    if (this.frame) this.pico.setPin(this.pins.dout, this.frame.level);
  }

  sclkFalls(tNs) {
    const { frame } = this;
    if (!frame || frame.riseNs === null) return;
    if (tNs - frame.riseNs < T.high) this.violate('SCLK high', tNs - frame.riseNs, T.high);
    frame.fallNs = tNs;
    frame.din.push(this.din);
    frame.n++;
    if (frame.n === frame.bits * (1 + CHANNELS)) this.dataWereRead(tNs);
  }

  dataWereRead(tNs) {
    this.frames++;
    this.lastReadNs = tNs;
    if (this.responseIsLong) return;
    this.conversions.shift();
    if (!this.conversions.length) this.setDrdy(true);
  }

  /** Bytes of the frame that begins now. */
  outgoing(size) {
    const words = this.responseIsLong ? [...this.longResponse] : [this.firstWord(), ...this.channels()];
    const bytes = [];
    const data = !this.responseIsLong;
    const extended = ((this.registers[MODE] >> 8) & 3) === 3; // 32 bits by sign, not by zeros
    words.forEach((value, i) => bytes.push(...frameWord(value, size, data && i > 0, extended)));
    const crc = crc16(bytes, this.registers[MODE] & ANSI ? 0x8005 : 0x1021);
    bytes.push(...frameWord(crc, size, false));
    if (this.corrupt > 0) {
      this.corrupt--;
      bytes[size + 1] ^= 0x10;
    }
    return bytes;
  }

  firstWord() {
    if (this.response !== null) return this.response;
    const fresh = this.conversions.length ? (this.registers[CLOCK] >> 8) & 15 : 0;
    const mode = this.registers[MODE];
    const value = this.status | (mode & 0x0f00 & ~RESET) | fresh;
    this.status &= ~(REG_MAP | CRC_ERR | F_RESYNC); // they are cleared by being told
    return value;
  }

  channels() {
    const conversion = this.conversions[0];
    if (!conversion) return this.last ?? [0, 0, 0, 0];
    const counts = this.signals.counts(conversion.index, conversion.tNs, this.periodNs);
    const part = conversion.fast ? 1 : settled(conversion.index, this.osr);
    this.last = counts.map((value, c) => this.convert(c, value * part));
    return this.last;
  }

  /** What shorted inputs give: uniform within ±35 counts, 20 RMS, 2.9 µV. */
  ownNoise() {
    this.noise = (Math.imul(this.noise, 1664525) + 1013904223) >>> 0;
    return Math.floor(this.noise / 2 ** 32 * 71) - 35;
  }

  convert(c, counts) {
    if (!((this.registers[CLOCK] >> (8 + c)) & 1)) return 0;
    const gain = 1 << ((this.registers[GAIN1] >> (4 * c)) & 7);
    return calibrated(counts * gain, this.registers.subarray(CHANNEL + 5 * c, CHANNEL + 5 * c + 5), this.ownNoise());
  }

  // -- commands

  receive({ bits, din, n }) {
    const size = bits / 8;
    const words = [];
    for (let at = 0; at + bits <= din.length; at += bits) words.push(parseInt(din.slice(at, at + 16).join(''), 2));
    this.longResponse = null;
    this.response = null;
    if (!words.length) return;
    const command = words[0];
    if (this.registers[MODE] & RX_CRC_EN && !this.crcRight(command, words, din, bits)) {
      this.status |= CRC_ERR;
      if (command >> 13 !== 3) return; // a WREG is done anyway
    }
    if (this.status & LOCK && command !== 0x0655 && command >> 13 !== 5) return;
    this.execute(command, words, n >= bits * (2 + CHANNELS), size);
  }

  crcRight(command, words, din, bits) {
    const covered = 1 + (command >> 13 === 3 ? (command & 0x7f) + 1 : 0);
    const bytes = [];
    for (let at = 0; at < covered * bits; at += 8) bytes.push(parseInt(din.slice(at, at + 8).join(''), 2));
    return words[covered] === crc16(bytes, this.registers[MODE] & ANSI ? 0x8005 : 0x1021);
  }

  execute(command, words, whole) {
    const address = (command >> 7) & 0x3f;
    const count = command & 0x7f;
    if (command >> 13 === 5) this.read(command, address, count);
    else if (command >> 13 === 3) this.write(address, words.slice(1, 2 + count));
    else if (command === 0x0011) {
      if (whole) this.powerOn();
      else this.response = 0x0011;
    } else if (command === 0x0022) {
      this.standby = true;
      this.response = command;
      this.begin();
    } else if (command === 0x0033) {
      this.standby = false;
      this.response = command;
      this.begin();
    } else if (command === 0x0555) {
      this.status |= LOCK;
      this.response = command;
    } else if (command === 0x0655) {
      this.status &= ~LOCK;
      this.response = command;
    }
  }

  get responseIsLong() {
    return !!this.longResponse;
  }

  peek(address) {
    if (address === STATUS) return this.status | (this.registers[MODE] & 0x0f00 & ~RESET) | (this.conversions.length ? 15 : 0);
    if (address === REGMAP_CRC) return 0;
    return this.registers[address];
  }

  read(command, address, count) {
    if (count === 0) this.response = this.peek(address);
    else this.longResponse = [0xe000 | (command & 0x1fff), ...Array.from({ length: count + 1 }, (_, i) => this.peek((address + i) & 0x3f))];
  }

  write(address, values) {
    this.response = 0x4000 | (address << 7) | Math.max(0, values.length - 1);
    values.forEach((value, i) => this.set((address + i) & 0x3f, value));
  }

  set(address, value) {
    if (address <= STATUS || address > 0x1d) return; // read-only
    const changed = this.registers[address] !== value;
    this.registers[address] = value;
    if (address === MODE) this.status = (this.status & ~RESET) | (this.status & value & RESET);
    if (changed && this.registers[MODE] & REGCRC_EN) this.status |= REG_MAP;
    if (address === CLOCK) this.begin();
  }

  // -- as a part

  /** Whether the box reads: the last two conversions did not go by unread. */
  sampling() {
    return this.clock !== null && this.pico.clock.nanos - this.lastReadNs < 2 * this.periodNs && this.conversions.length < 2;
  }

  control({ fault, frames = 1, ns = 0, address, value }) {
    if (fault === 'corrupt') this.corrupt += frames;
    else if (fault === 'reset') this.powerOn();
    else if (fault === 'silent') this.silentUntilNs = this.pico.clock.nanos + ns;
    else if (fault === 'register') this.set(address, value);
    else throw new Error(`ads131m04: there is no fault ${fault}`);
  }
}

export function attach(pico, signals) {
  return new Ads131m04(pico, signals);
}
