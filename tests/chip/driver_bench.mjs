// The box's image without its main program: drivers alone, given to MicroPython's raw REPL as scripts, with the magnetostrictive
// head and the trigger lines on their pins. One boot, any number of steps. JSON on standard input:
//
//   {uf2, packetNs, startNs, steps: [{script, controls: [{afterMs, part, ...}], edges: [[line, level, afterNs], ...], flightsPs: [...]}]}
//
// Times count from the moment the script is sent. Flights are taken in turn, over and over; negative: no stop pulse.
// Prints a JSON list, a step each: {out, err, sentNs, shots: [[index, edge ns, flight ps, period ns]], outputs: [[level, ns]],
// ignored: interrogations that the head did not accept, conversions: [[index, ns]] that the converter was asked for, violations of its
// datasheet, wallMs}.
import fs from 'node:fs';
import { Flash } from '../../hil_sim/chip/flash.mjs';
import { attach as attachConverter } from '../../hil_sim/chip/ads131m04.mjs';
import { attach as attachHead } from '../../hil_sim/chip/magnetostrictive.mjs';
import { Pico } from '../../hil_sim/chip/pico.mjs';
import { attach as attachThermometers } from '../../hil_sim/chip/thermometers.mjs';
import { attach as attachTriggers } from '../../hil_sim/chip/triggers.mjs';

const MS = 1e6;
const LIMIT_MS = 30_000;
const OUTPUT = 8;

const { uf2, packetNs, startNs = 0, steps } = JSON.parse(fs.readFileSync(0, 'utf8'));
const pico = new Pico({ flash: new Flash(uf2), packetNs, startNs });
let received = '';
pico.onData = (bytes) => { received += Buffer.from(bytes).toString('latin1'); };
pico.usb.setOpen(true);
pico.usb.setRoom(1e9);

let shots = [];
let outputs = [];
let flightsPs = [-1];
let conversions = [];
// counts that tell index, channel and time: any mix-up is seen (test_ads131m04.py has the same formula)
const countsOf = (index, tNs) =>
  [0, 1, 2, 3].map((c) => (((index * 4 + c) * 2_654_435 + (Math.round(tNs) % 1_000_003) * 7) % 8_388_608) - 4_194_304);
const signals = {
  counts: (index, tNs) => {
    conversions.push([index, tNs]);
    return countsOf(index, tNs);
  },
  flightPs: (index, tNs, periodNs) => {
    const flightPs = flightsPs[shots.length % flightsPs.length];
    shots.push([index, tNs, flightPs, periodNs]);
    return flightPs;
  },
};
const parts = { adc: attachConverter(pico, signals), mag: attachHead(pico, signals), thermometers: attachThermometers(pico), triggers: attachTriggers(pico) };
pico.watchPin(OUTPUT, (level, tNs) => outputs.push([level ? 1 : 0, tNs]));

function expect(text) {
  const limitNs = pico.nowNs + LIMIT_MS * MS;
  let at = received.indexOf(text);
  while (at < 0) {
    if (pico.nowNs > limitNs || pico.ended) throw new Error(`no ${JSON.stringify(text)} in ${JSON.stringify(received.slice(-500))}`);
    pico.run(pico.nowNs + MS / 5);
    at = received.indexOf(text);
  }
  const head = received.slice(0, at);
  received = received.slice(at + text.length);
  return head;
}

const send = (text) => pico.usb.send(Buffer.from(text, 'latin1'));

/** Into the raw REPL: Ctrl-C ends the main program in its boot window. */
function enter() {
  for (let i = 0; i < 50 && !received.includes('>>> '); i++) {
    send('\x03');
    pico.run(pico.nowNs + 100 * MS);
  }
  send('\x01');
  expect('raw REPL; CTRL-B to exit\r\n>');
}

function run(step) {
  shots = [];
  outputs = [];
  conversions = [];
  parts.adc.violations.length = 0;
  flightsPs = step.flightsPs ?? [-1];
  const ignored = parts.mag.head.ignored;
  const sentNs = Math.ceil(pico.nowNs);
  const wall = Date.now();
  if (step.edges) parts.triggers.control({ edges: step.edges.map(([line, level, afterNs]) => [line, level, sentNs + afterNs]) });
  for (const { afterMs = 0, part, ...message } of step.controls ?? []) {
    pico.clock.createAlarm(() => parts[part].control(message)).schedule(afterMs * MS);
  }
  send(step.script + '\x04');
  expect('OK');
  const out = expect('\x04');
  const err = expect('\x04>');
  const violations = [...parts.adc.violations];
  return { out, err, sentNs, shots, outputs, conversions, violations, ignored: parts.mag.head.ignored - ignored, wallMs: Date.now() - wall };
}

enter();
console.log(JSON.stringify(steps.map(run)));
