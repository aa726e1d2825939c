// The head of a magnetostrictive sensor: interrogated on GP2, it answers on GP3 with a start pulse at once and a stop pulse
// the time of flight after that, which the world gives (signals.flightPs; negative: no stop pulse). Both pulses are equally long. A head with a
// gate answers with one pulse, from what is the start to what is the stop.
//
// The numbers are those of makers' manuals, see firmware/drivers/magnetostrictive.py. A head that is not asked properly does not
// answer: a pulse shorter than 200 ns is not seen, one of 10 µs or more asks for something else, and an interrogation while the
// wire still rings is not answered and counted.
//
// Control messages: {lose: n} the next n stop pulses do not come; {ringing: [[afterNs, lengthNs], …]} pulses after every
// interrogation edge, as of a noisy neuter output; {startPulse: {afterNs, lengthNs}}; {start: false} it does not come; {gate: true}; {stuck: true} the line is broken and
// the receiver's output high; {stuck: false}.
const INTERROGATION = 2;
const STOP = 3;
const SHORTEST_NS = 200;
const LONGEST_NS = 10_000;
const LONGEST_PERIOD_NS = 1e9; // a longer pause is none
const RECOVERY_NS = 10_000; // after the stop pulse's begin

class Head {
  constructor(pico, signals) {
    this.pico = pico;
    this.signals = signals;
    this.startPulse = { afterNs: 44, lengthNs: 1000 }; // in the middle of one of the counter's ticks of 8 ns
    this.start = true;
    this.gate = false;
    this.ringing = [];
    this.lose = 0;
    this.stuck = false;
    this.high = 0; // pulses that are high now
    this.edgeNs = null; // of the last interrogation
    this.periodNs = 0; // between the last two
    this.index = 0; // of the shot since interrogation began at this period
    this.readyNs = 0;
    this.ignored = 0;
    this.pending = [];
  }

  pulse(afterNs, lengthNs) {
    const { clock } = this.pico;
    const up = clock.createAlarm(() => this.level(1));
    const down = clock.createAlarm(() => this.level(-1));
    up.schedule(afterNs);
    down.schedule(afterNs + lengthNs);
    return [up, down];
  }

  level(step) {
    this.high += step;
    this.show();
  }

  show() {
    this.pico.setPin(STOP, this.stuck || this.high > 0);
  }

  /** Interrogations a period apart are one run; any other interval begins a new one. */
  count(tNs) {
    const interval = this.edgeNs === null ? 0 : tNs - this.edgeNs;
    const known = this.index > 0 ? interval === this.periodNs : interval <= LONGEST_PERIOD_NS;
    const first = this.edgeNs === null || !known;
    this.index = first ? 0 : this.index + 1;
    this.periodNs = first ? 0 : interval;
    this.edgeNs = tNs;
  }

  interrogate(tNs) {
    this.count(tNs);
    this.pending = [];
    if (tNs < this.readyNs) {
      this.ignored++;
      return;
    }
    const flightPs = this.signals.flightPs(this.index, tNs, this.periodNs || 1e9);
    const { afterNs, lengthNs } = this.startPulse;
    if (this.start && !this.gate) this.pulse(afterNs, lengthNs);
    for (const [ringsNs, ringNs] of this.ringing) this.pulse(ringsNs, ringNs);
    if (flightPs < 0) return;
    if (this.lose > 0) {
      this.lose--;
      return;
    }
    const flightNs = Math.floor(flightPs / 1000); // sampled every 8 ns: less than a ns does not show
    this.pending = this.gate ? this.pulse(afterNs, flightNs) : this.pulse(afterNs + flightNs, lengthNs);
    this.readyNs = tNs + afterNs + flightNs + RECOVERY_NS;
  }

  /** The interrogation pulse ends: was it one? */
  judge(tNs) {
    const length = tNs - this.edgeNs;
    if (this.edgeNs === null || (length >= SHORTEST_NS && length < LONGEST_NS)) return;
    for (const alarm of this.pending) alarm.cancel();
    this.pending = [];
    this.ignored++;
  }
}

export function attach(pico, signals) {
  const head = new Head(pico, signals);
  pico.watchPin(INTERROGATION, (level, tNs) => (level ? head.interrogate(tNs) : head.judge(tNs)));
  return {
    head,
    sampling: () => head.edgeNs !== null && pico.nowNs - head.edgeNs < 2 * (head.periodNs || 1e6),
    control: ({ lose, ringing, startPulse, start, gate, stuck }) => {
      head.lose = lose ?? head.lose;
      head.ringing = ringing ?? head.ringing;
      head.startPulse = startPulse ?? head.startPulse;
      head.start = start ?? head.start;
      head.gate = gate ?? head.gate;
      head.stuck = stuck ?? head.stuck;
      head.show();
    },
  };
}
