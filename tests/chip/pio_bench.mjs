// Runs PIO scenarios on hil_sim/chip/pio.mjs alone, without a chip around it: JSON on standard input and output, see test_pio.py.
import fs from 'node:fs';
import { CYCLE_NS } from '../../hil_sim/chip/clock.mjs';
import { PioScheduler } from '../../hil_sim/chip/pio_scheduler.mjs';

/** As much of a chip as a PIO block asks for. */
function bareChip() {
  const quiet = () => {};
  return {
    clock: { nanos: 0 },
    gpioValues: 0,
    gpio: Array.from({ length: 30 }, () => ({ checkForUpdates: quiet })),
    dma: { setDREQ: quiet, clearDREQ: quiet },
    setInterrupt: quiet,
    logger: { error: quiet },
    peripherals: {},
  };
}

function shiftctrl(p) {
  const joins = [0, 1, 2][p.join];
  return ((joins << 30) | ((p.pull_at & 31) << 25) | ((p.push_at & 31) << 20) | (p.out_right << 19) | (p.in_right << 18) |
    (p.autopull << 17) | (p.autopush << 16)) >>> 0;
}

function load(block, i, { program: p, x, y, divider, tx }, c) {
  const offset = 8 * i;
  p.words.forEach((word, at) => block.writeUint32(0x48 + 4 * (offset + at), word >> 13 ? word : word + offset));
  const base = 0xc8 + 0x18 * i;
  block.writeUint32(base, divider << 8);
  block.writeUint32(base + 4, (p.side_optional << 30) | (c.jmp_pin << 24) | ((offset + p.wrap) << 12) | ((offset + p.wrap_target) << 7));
  block.writeUint32(base + 8, shiftctrl(p));
  block.writeUint32(base + 0x14, ((p.side_count << 29) | (c.set_count << 26) | (c.out_count << 20) | (c.in_base << 15) |
    (c.side_base << 10) | (c.set_base << 5) | c.out_base) >>> 0);
  block.writeUint32(base + 0x10, offset); // jmp
  const machine = block.sm[i];
  machine.x = x;
  machine.y = y;
  for (const word of tx.slice(0, machine.tx.depth)) block.writeUint32(0x10 + 4 * i, word);
}

function run({ machines, events }, cycles, fast, config) {
  const chip = bareChip();
  const pio = new PioScheduler(chip, chip.clock);
  const [block] = pio.blocks;
  block.fastForward = fast;
  machines.forEach((machine, i) => load(block, i, machine, config));
  const pins = [];
  let done = 0;
  const tick = block.sm[0].constructor.prototype.tick;
  for (const m of block.sm) m.tick = function count() { done++; tick.call(this); };
  const show = block.showOutputs.bind(block);
  let last = [0, 0];
  block.showOutputs = () => {
    show();
    if (block.pinValues !== last[0] || block.pinDirections !== last[1]) {
      last = [block.pinValues, block.pinDirections];
      pins.push([block.cycle, ...last]);
    }
  };
  chip.clock.nanos = -CYCLE_NS; // enabled by an instruction in the cycle before the first
  block.writeUint32(0, 15);
  const to = (cycle) => {
    while (pio.nextNs <= cycle * CYCLE_NS) {
      chip.clock.nanos = pio.nextNs;
      pio.step();
    }
    chip.clock.nanos = cycle * CYCLE_NS;
  };
  const reads = [];
  let inputs = 0;
  for (const [cycle, what, index, word] of events) {
    to(cycle);
    if (what === 'toggle') pio.pinsChanged(inputs ^= 1 << index);
    else if (what === 'write') block.writeUint32(0x10 + 4 * index, word);
    else if (block.sm[index].rx.words.length) reads.push(block.readUint32(0x20 + 4 * index));
  }
  to(cycles - 1);
  for (const m of block.sm) block.catchUp(m);
  const state = block.sm.map((m) => [m.x, m.y, m.pc, m.isr, m.osr, m.isrCount, m.osrCount, m.rx.words, m.tx.words]);
  if (block.outputAt === cycles && (block.nextValues !== last[0] || block.nextDirections !== last[1])) {
    pins.push([cycles, block.nextValues, block.nextDirections]);
  }
  return { pins, reads, state, flags: block.irq, done };
}

const { cycles, fast, config, scenarios } = JSON.parse(fs.readFileSync(0, 'utf8'));
console.log(JSON.stringify(scenarios.map((scenario) => run(scenario, cycles, fast, config))));
