// Thermometers DS18B20 on GP9, a wire that is pulled up: each sees the levels and their times as its datasheet says, and pulls the
// wire down itself. What they measure is what the last control message said.
//
// Control message: {thermometers: [{uid: hex, mdegc, fault}, …]}, all there are from then on. Faults: "silent" it does not answer at all,
// "noise" the seventh bit of its scratchpad is wrong, "power" it was without power and shows 85 °C. {short: true} the wire is held low;
// {slow: ns} the wire comes up so much later when it is let go, as by the cable's capacitance.
const WIRE = 9;
const RESET_NS = 480_000;
const PRESENCE_AFTER_NS = 30_000; // 15 to 60 µs
const PRESENCE_NS = 120_000; // 60 to 240 µs
const SAMPLE_NS = 30_000; // when a thermometer looks: 15 to 60 µs
const HOLD_NS = 15_000; // how long a 0 is held: 15 µs at least
const CONVERSION_NS = 750_000_000;
const SEARCH = 0xf0;
const MATCH = 0x55;
const SKIP = 0xcc;
const CONVERT = 0x44;
const READ = 0xbe;

const bitsOf = (bytes) => [...bytes].flatMap((byte) => [0, 1, 2, 3, 4, 5, 6, 7].map((k) => (byte >> k) & 1));

function crc8(bytes) {
  let crc = 0;
  for (const bit of bitsOf(bytes)) crc = (crc ^ bit) & 1 ? (crc >> 1) ^ 0x8c : crc >> 1;
  return crc;
}

class Thermometer {
  constructor(uid) {
    this.uid = bitsOf(Buffer.from(uid, 'hex'));
    this.raw = 85 * 16; // what it shows when its power came
    this.reset();
  }

  reset() {
    this.word = []; // bits of a command that is being received
    this.state = this.command;
    this.sending = [];
  }

  /** The bit that it sends in the next slot; 1 if it only listens. */
  get next() {
    return this.sending.length ? this.sending[0] : 1;
  }

  /** A slot has passed; `bit` is what the wire's master wrote. */
  slot(bit, nowNs) {
    if (this.sending.length) this.sending.shift();
    else this.state(bit, nowNs);
  }

  byte(bit) {
    this.word.push(bit);
    if (this.word.length < 8) return null;
    return this.word.splice(0).reduce((sum, b, k) => sum | (b << k), 0);
  }

  command(bit) {
    const byte = this.byte(bit);
    if (byte === null) return;
    this.state = this.idle;
    if (byte === SKIP) this.state = this.work;
    if (byte === MATCH) {
      this.at = 0;
      this.state = this.match;
    }
    if (byte === SEARCH) {
      this.at = 0;
      this.offer();
      this.state = this.search;
    }
  }

  idle() {}

  match(bit) {
    if (bit !== this.uid[this.at]) this.state = this.idle;
    else if (++this.at === 64) this.state = this.work;
  }

  offer() {
    this.sending = [this.uid[this.at], 1 - this.uid[this.at]];
  }

  search(bit) {
    if (bit !== this.uid[this.at]) this.state = this.idle;
    else if (++this.at === 64) this.state = this.idle;
    else this.offer();
  }

  work(bit, nowNs) {
    const byte = this.byte(bit);
    if (byte === CONVERT) {
      this.readyNs = nowNs + CONVERSION_NS;
      this.converted = Math.round((this.mdegc * 16) / 1000);
    }
    if (byte === READ) {
      if (this.readyNs <= nowNs) this.raw = this.converted;
      if (this.fault === 'power') this.raw = 85 * 16;
      const bytes = [this.raw & 255, (this.raw >> 8) & 255, 0x4b, 0x46, 0x7f, 0xff, 0x0c, 0x10];
      this.sending = bitsOf([...bytes, crc8(bytes)]);
      if (this.fault === 'noise') this.sending[6] ^= 1;
    }
  }
}

export function attach(pico) {
  const pin = pico.chip.gpio[WIRE];
  const { clock } = pico;
  let all = new Map();
  let short = false;
  let slowNs = 0;
  let holding = 0; // thermometers that pull the wire down
  let driven = false;
  let fellNs = 0;
  const present = () => [...all.values()].filter((one) => one.fault !== 'silent');
  const show = () => (short || holding > 0 ? pico.setPin(WIRE, false) : pin.release());
  const later = (ns, call) => clock.createAlarm(call).schedule(ns);
  const hold = (afterNs, ns) => {
    later(afterNs, () => { holding += 1; show(); });
    later(afterNs + ns + slowNs, () => { holding -= 1; show(); });
  };

  function fell(tNs) {
    fellNs = tNs;
    if (!short && present().some((one) => one.next === 0)) hold(0, HOLD_NS);
  }

  function rose(tNs) {
    if (short) return;
    const low = tNs - fellNs + slowNs;
    if (slowNs) hold(0, 0);
    const there = present();
    if (low >= RESET_NS) {
      for (const one of there) one.reset();
      if (there.length) hold(PRESENCE_AFTER_NS, PRESENCE_NS);
    } else {
      for (const one of there) one.slot(low < SAMPLE_NS ? 1 : 0, tNs);
    }
  }

  pin.addListener(() => {
    const now = pin.outputEnable && !pin.outputValue;
    if (now === driven) return;
    driven = now;
    (driven ? fell : rose)(pico.nowNs);
  });
  return {
    sampling: () => false,
    control: (message) => {
      slowNs = message.slow ?? 0;
      short = message.short ?? false;
      const before = all;
      all = new Map((message.thermometers ?? []).map(({ uid, mdegc, fault }) =>
        [uid, Object.assign(before.get(uid) ?? new Thermometer(uid), { mdegc, fault })]));
      show();
    },
  };
}
