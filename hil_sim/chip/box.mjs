// The sensor box at chip level as a child process: a Pico with its parts that lives by grants on standard input and
// output. The parent's half is truearm_sim/chip.py. One argument: JSON {uf2, store?, cause, uid, seed, startNs?}.
//
//   parent  "G" grant    flags:u8  n_rx:u16  n_edges:u16  tx_room:u32  until_ns:u64  temperature_mdegc:i32, then
//                        rx bytes (at until_ns), edges (line:u8, level:u8, t_ns:u64)
//           "C" control  n:u32, then JSON: {part, ...} for a part (its faults), {pico: "cut", operations: n} cuts the power in
//                        the n-th flash operation from now, {pico: "crash"} lets the firmware raise an exception,
//                        {pico: "profile", every_ns: n} begins to sample where the processor is, {pico: "profiled", file: path} writes
//                        what was found (profiler.mjs)
//           "Q" quit
//   box     "?" query    stream:u8  n:u16  index:u64  t_ns:u64  period_ns:u64; the parent answers at once with n
//                        values of signals.mjs
//           "T" sent     n:u32, then bytes that the box sent, at the end of a transfer; only if the grant asks for it
//           "D" answer   flags:u8  cause:u8  now_ns:u64  n_tx:u32  n_edges:u16, then tx bytes, edges of the box's own
//                        output (level:u8, t_ns:u64)
//
// All numbers little endian; times are the box's device time since power-on. Flags of a grant: 1 the host's port is
// closed, 2 the processor stands still, 4 what the box sends is handed over at once. Flags of an answer: 1 a source is sampling, 2 the chip was reset, 4 it went to the USB boot loader, 8 the power
// was cut: after 2, 4 and 8 the process answers nothing more but quit. `tx_room` is what the host reads in this grant, in whole
// packets. A grant ends at `until_ns` or, at most an instruction (some tens of ns) later.
import fs from 'node:fs';
import path from 'node:path';
import { Flash } from './flash.mjs';
import { attachParts } from './parts.mjs';
import { Pico } from './pico.mjs';
import { Profiler } from './profiler.mjs';
import { BYTES, Signals } from './signals.mjs';

const GRANT = 21;
const EDGE_IN = 10;
const ANSWER = 17;
const EDGE_OUT = 9;
const QUERY = 28;
const CLOSED = 1;
const STALLED = 2;
const PROMPT = 4;
const PACKET = 64; // a shorter one ends a transfer on USB
const SAMPLING = 1;
const ENDED = { reset: 2, bootloader: 4, power: 8 };
const LINES = [6, 7]; // pins of the trigger inputs
const OUTPUT = 8;
const RAIL_5V = Math.round((5.02 / 3 / 3.3) * 4096); // what the divider on GP27 gives of a healthy USB supply

function read(n) {
  const buffer = Buffer.alloc(n);
  for (let at = 0; at < n; ) {
    const got = fs.readSync(0, buffer, at, n - at, null);
    if (got === 0) process.exit(0); // the parent has gone
    at += got;
  }
  return buffer;
}

function write(buffer) {
  for (let at = 0; at < buffer.length; ) at += fs.writeSync(1, buffer, at);
}

/** Ask the parent for n values of a stream. */
function query(stream, index, tNs, periodNs, n) {
  const message = Buffer.alloc(QUERY);
  message.write('?');
  message.writeUInt8(stream, 1);
  message.writeUInt16LE(n, 2);
  message.writeBigUInt64LE(BigInt(index), 4);
  message.writeBigUInt64LE(BigInt(tNs), 12);
  message.writeBigUInt64LE(BigInt(periodNs), 20);
  write(message);
  return read(n * BYTES[stream]);
}

/** Give the parent what the box sent. */
function handOver(sent) {
  const tx = Buffer.concat(sent.splice(0));
  const head = Buffer.alloc(5);
  head.write('T');
  head.writeUInt32LE(tx.length, 1);
  write(Buffer.concat([head, tx]));
}

/** The 12-bit reading of the chip's own temperature sensor: 27 °C at 0.706 V, −1.721 mV/°C, of 3.3 V. */
function temperatureReading(mdegc) {
  return Math.round(((0.706 - 0.001721 * (mdegc / 1000 - 27)) / 3.3) * 4096);
}

function scheduleEdges(pico, edges) {
  for (let at = 0; at < edges.length; at += EDGE_IN) {
    const pin = LINES[edges.readUInt8(at)];
    const level = edges.readUInt8(at + 1);
    const tNs = Number(edges.readBigUInt64LE(at + 2));
    pico.clock.createAlarm(() => pico.setPin(pin, level)).schedule(Math.max(0, tNs - pico.nowNs));
  }
}

function grant(box) {
  const { pico, signals, sent, outputs, parts } = box;
  const head = read(GRANT);
  const rx = read(head.readUInt16LE(1));
  const edges = read(head.readUInt16LE(3) * EDGE_IN);
  const untilNs = Number(head.readBigUInt64LE(9));
  pico.chip.adc.channelValues[1] = RAIL_5V;
  pico.chip.adc.channelValues[4] = temperatureReading(head.readInt32LE(17));
  signals.horizonNs = untilNs;
  scheduleEdges(pico, edges);
  box.prompt = (head.readUInt8(0) & PROMPT) !== 0;
  pico.usb.setOpen(!(head.readUInt8(0) & CLOSED));
  pico.usb.setRoom(head.readUInt32LE(5));
  if (head.readUInt8(0) & STALLED) pico.stall(untilNs);
  else pico.run(untilNs);
  if (rx.length) pico.usb.send(rx); // it arrives at the grant's end: the box sees it in the next one, never before it was sent
  const { ended } = pico;
  const tx = Buffer.concat(sent.splice(0));
  const edgesOut = outputs.splice(0);
  const answer = Buffer.alloc(ANSWER);
  answer.write('D');
  answer.writeUInt8((parts.sampling() ? SAMPLING : 0) | (ended ? ENDED[ended.why] : 0), 1);
  answer.writeUInt8(ended ? ended.cause : 0, 2);
  answer.writeBigUInt64LE(BigInt(Math.floor(pico.nowNs)), 3);
  answer.writeUInt32LE(tx.length, 11);
  answer.writeUInt16LE(edgesOut.length, 15);
  write(Buffer.concat([answer, tx, ...edgesOut]));
}

function control(box) {
  const { pico, parts, symbols } = box;
  const message = JSON.parse(read(read(4).readUInt32LE(0)).toString());
  if (message.pico === 'cut') pico.flash.cutIn(message.operations);
  else if (message.pico === 'crash') pico.raiseInFirmware(JSON.parse(fs.readFileSync(symbols)));
  else if (message.pico === 'profile') box.profiler = new Profiler(pico, JSON.parse(fs.readFileSync(symbols)), message.every_ns);
  else if (message.pico === 'profiled') fs.writeFileSync(message.file, JSON.stringify(box.profiler.stop()));
  else parts.control(message);
}

function main() {
  const { uf2, store, packetNs, cause, uid, seed, startNs } = JSON.parse(process.argv[2]);
  const signals = new Signals(query);
  const pico = new Pico({ flash: new Flash(uf2, store), packetNs, cause, uid, seed, startNs });
  const symbols = path.join(path.dirname(uf2), 'symbols.json');
  const box = { pico, signals, symbols, sent: [], outputs: [], parts: attachParts(pico, signals) };
  pico.onData = (bytes) => {
    box.sent.push(Buffer.from(bytes));
    if (box.prompt && bytes.length < PACKET) handOver(box.sent);
  };
  pico.watchPin(OUTPUT, (level, tNs) => {
    const edge = Buffer.alloc(EDGE_OUT);
    edge.writeUInt8(level ? 1 : 0);
    edge.writeBigUInt64LE(BigInt(Math.floor(tNs)), 1);
    box.outputs.push(edge);
  });
  for (;;) {
    const kind = read(1).toString();
    if (kind === 'G') grant(box);
    else if (kind === 'C') control(box);
    else return;
  }
}

main();
