// The two PIO blocks of the chip in time: which has something to do next, and what changes on the pins. pio.mjs is a block.

import { CYCLE_NS } from './clock.mjs';
import { Pio } from './pio.mjs';
import { NEVER } from './pio_machine.mjs';

const FIRST_IRQ = [7, 9]; // PIO0_IRQ_0 and PIO1_IRQ_0

/** Both blocks, in the place of rp2040js's. `nextNs`: when step() is to be called next. */
export class PioScheduler {
  constructor(chip, clock) {
    this.clock = clock;
    this.chip = chip;
    this.nextNs = NEVER;
    this.inputs = chip.gpioValues;
    this.blocks = [];
    for (const [index, irq] of FIRST_IRQ.entries()) this.blocks.push(new Pio(chip, index, irq, this));
    chip.pio = this.blocks;
    chip.peripherals[0x50200] = this.blocks[0];
    chip.peripherals[0x50300] = this.blocks[1];
  }

  update() {
    const [first, second] = this.blocks;
    this.nextNs = CYCLE_NS * (first.due < second.due ? first.due : second.due);
  }

  step() {
    const cycle = Math.floor(this.nextNs / CYCLE_NS);
    for (const block of this.blocks) {
      if (block.due > cycle) continue;
      block.advance(cycle);
    }
    this.update();
  }

  /** The levels of all pins, in one word, are others from now on. An edge of the clock samples what was before it. */
  pinsChanged(inputs) {
    const changed = inputs ^ this.inputs;
    this.inputs = inputs;
    const shows = Math.floor(this.clock.nanos / CYCLE_NS) + 2;
    for (const block of this.blocks) {
      block.pads = inputs;
      if (changed & block.seen) block.pinsChange(changed & block.seen, inputs, shows);
    }
  }
}
