// Programmable I/O in exact time. rp2040js 1.4.1 executes the instructions right but steps all machines alike, one
// instruction a turn, without dividers, delays or a relation to the clock. Here each state machine has the cycle of its
// next step, and nothing is done in between:
//
// - a machine that stalls (for a pin, a FIFO, an interrupt flag) costs nothing until what it waits for comes;
// - a loop that only counts down and looks at its jump pin is left alone until the count runs out or the pin changes; x
//   and y are then what stepping would have made of them (tests/chip/pio.test.mjs holds this against stepping).
//
// Inputs pass the synchroniser's two flip-flops: machines see a pin two cycles after it changed.
import { FIFO, StateMachine, WaitType } from './emulator.mjs';
import { CYCLE_NS } from './clock.mjs';

const SYNCHRONISER = 2;
const CTRL = 0x000;
const SM0_CLKDIV = 0x0c8;
const SM_SHIFTCTRL = 0x08;
const SM_STRIDE = 0x18;
const SM_END = SM0_CLKDIV + 4 * SM_STRIDE;
const JOIN_RX = 1 << 31;
const JOIN_TX = 1 << 30;

/** Whether an instruction does nothing but count x or y down, look at the jump pin, jump or idle. */
function onlyCounts(opcode) {
  const operation = opcode >>> 13;
  if (operation === 0) return [0b000, 0b010, 0b100, 0b110, 0b111].includes((opcode >> 5) & 7);
  return operation === 0b101 && [0x21, 0x42].includes(opcode & 0xff); // mov x, x and mov y, y: nop
}

const ONLY_COUNTS = Uint8Array.from({ length: 0x10000 }, (_, opcode) => (onlyCounts(opcode) ? 1 : 0));

// ---- mends of rp2040js's state machine: inputs come from the synchroniser, waking is told to the scheduler

const upstreamJump = StateMachine.prototype.jmpCondition;
const upstreamCheckWait = StateMachine.prototype.checkWait;

Object.defineProperty(StateMachine.prototype, 'inPins', {
  get() {
    const { inputs } = this.pio.scheduler;
    const base = this.inBase;
    return base ? (inputs << (32 - base)) | (inputs >>> base) : inputs;
  },
});

StateMachine.prototype.jmpCondition = function (condition) {
  if (condition === 0b110) return ((this.pio.scheduler.inputs >>> this.jmpPin) & 1) === 1;
  return upstreamJump.call(this, condition);
};

StateMachine.prototype.checkWait = function () {
  if (!this.waiting) return;
  if (this.waitType === WaitType.Pin) {
    if (((this.pio.scheduler.inputs >>> this.waitIndex) & 1) !== (this.waitPolarity ? 1 : 0)) return;
    this.waiting = false;
    this.nextPC();
    this.cycles += this.waitDelay;
  } else {
    upstreamCheckWait.call(this);
  }
  if (!this.waiting && this.stalled) this.pio.scheduler.wake(this);
};

StateMachine.prototype.clkDivRestart = function () {};

/** Both PIO blocks of a chip. `nextNs` is when something happens in them next. */
export class PioScheduler {
  constructor(chip, clock) {
    this.clock = clock;
    this.gpio = chip.gpio;
    this.blocks = chip.pio;
    this.machines = [];
    this.inputs = 0; // pins as the machines see them
    this.changes = []; // [cycle, inputs] on their way through the synchroniser
    this.next = Infinity; // cycle
    this.skipping = true;
    for (const block of chip.pio) {
      block.scheduler = this;
      block.run = () => {};
      this.#mendRegisters(block);
      for (const machine of block.machines) {
        Object.assign(machine, { at: Infinity, at256: 0, stalled: false, counting: null, impure: 0, loop: null });
        this.machines.push(machine);
      }
    }
  }

  get nextNs() {
    return this.next * CYCLE_NS;
  }

  get #cycle() {
    return Math.ceil(this.clock.nanosCounter / CYCLE_NS);
  }

  /** The pins are now at these levels. */
  pinsChanged(levels) {
    const at = this.#cycle + SYNCHRONISER;
    this.changes.push([at, levels]);
    if (at < this.next) this.next = at;
  }

  /** Do what is due at `next`; the clock stands there. */
  step() {
    const now = this.next;
    while (this.changes.length && this.changes[0][0] <= now) this.#see(this.changes.shift()[1], now);
    for (const machine of this.machines) {
      if (machine.at === now) this.#stepMachine(machine, now);
    }
    for (const block of this.blocks) this.#driveOutputs(block);
    this.#findNext();
  }

  /** A stalled machine has got what it waited for. */
  wake(machine) {
    machine.stalled = false;
    const period = period256(machine);
    const since = this.#cycle * 256 - machine.at256;
    const stalledFor = Math.max(0, Math.ceil(since / period)) * period; // it looks at each of its clock's ticks
    machine.at256 += stalledFor + (machine.cycles - machine.cyclesBefore) * period;
    machine.at = Math.floor(machine.at256 / 256);
    if (machine.at < this.next) this.next = machine.at;
  }

  #stepMachine(machine, now) {
    if (machine.counting) this.#settle(machine, now);
    const { pio, pc } = machine;
    const opcode = pio.instructions[pc];
    const values = pio.pinValues;
    const directions = pio.pinDirections;
    machine.cyclesBefore = machine.cycles;
    machine.step();
    if (!ONLY_COUNTS[opcode] || values !== pio.pinValues || directions !== pio.pinDirections) machine.impure++;
    if (machine.waiting) {
      machine.stalled = true;
      machine.at = Infinity;
      return;
    }
    machine.at256 += (machine.cycles - machine.cyclesBefore) * period256(machine);
    machine.at = Math.floor(machine.at256 / 256);
    if (this.skipping && machine.pc <= pc && opcode >>> 13 === 0) this.#lookForLoop(machine);
  }

  /** After a jump back: if a turn of the loop changed nothing but counts, the next turns need no stepping. */
  #lookForLoop(machine) {
    const { loop, pc, x, y, at256, impure } = machine;
    if (loop && loop.pc === pc && loop.impure === impure) {
      const dx = loop.x - x;
      const dy = loop.y - y;
      const turns = Math.min(turnsLeft(x, dx), turnsLeft(y, dy));
      const turn256 = at256 - loop.at256;
      if (turns > 1) {
        machine.counting = { at256, turn256, dx, dy };
        machine.at256 = at256 + turns * turn256;
        machine.at = Math.floor(machine.at256 / 256);
      }
    }
    machine.loop = { pc, x, y, at256, impure };
  }

  /** Make up for the turns of a counting loop that have ended by the cycle `now`. */
  #settle(machine, now) {
    const { at256, turn256, dx, dy } = machine.counting;
    const turns = Math.max(0, Math.floor((now * 256 + 255 - at256) / turn256));
    machine.x -= turns * dx;
    machine.y -= turns * dy;
    machine.at256 = at256 + turns * turn256;
    machine.at = Math.floor(machine.at256 / 256);
    machine.counting = null;
    machine.loop = null;
  }

  #see(inputs, now) {
    const changed = inputs ^ this.inputs;
    this.inputs = inputs;
    for (const machine of this.machines) {
      if (machine.stalled && machine.waitType === WaitType.Pin && (changed >>> machine.waitIndex) & 1) machine.checkWait();
      if ((changed >>> machine.jmpPin) & 1) {
        machine.impure++;
        if (machine.counting) this.#settle(machine, now - 1); // the turn that this cycle is in sees the change
      }
    }
  }

  #driveOutputs(block) {
    let changed = (block.oldPinValues ^ block.pinValues) | (block.oldPinDirections ^ block.pinDirections);
    if (!changed) return;
    block.oldPinValues = block.pinValues;
    block.oldPinDirections = block.pinDirections;
    for (; changed; changed &= changed - 1) this.gpio[31 - Math.clz32(changed & -changed)]?.checkForUpdates();
  }

  #findNext() {
    let next = this.changes.length ? this.changes[0][0] : Infinity;
    for (const machine of this.machines) if (machine.at < next) next = machine.at;
    this.next = next;
  }

  #mendRegisters(block) {
    const write = block.writeUint32.bind(block);
    block.writeUint32 = (offset, value) => {
      const isMachine = offset === CTRL || (offset >= SM0_CLKDIV && offset < SM_END);
      if (isMachine) this.#settleAll(block);
      const ran = block.machines.map((machine) => machine.enabled);
      write(offset, value);
      if (offset === CTRL) block.machines.forEach((machine, i) => this.#enable(machine, ran[i]));
      if (isMachine && (offset - SM0_CLKDIV) % SM_STRIDE === SM_SHIFTCTRL) joinFifos(block, offset);
      if (isMachine) {
        this.#driveOutputs(block); // an instruction may have been forced on a machine
        this.#findNext();
      }
    };
  }

  #settleAll(block) {
    for (const machine of block.machines) if (machine.counting) this.#settle(machine, this.#cycle - 1);
  }

  #enable(machine, ran) {
    if (!machine.enabled) {
      machine.at = Infinity;
      machine.stalled = false;
    } else if (!ran || (machine.stalled && !machine.waiting)) {
      machine.stalled = machine.waiting;
      machine.cyclesBefore = machine.cycles;
      machine.at256 = (this.#cycle + 1) * 256;
      machine.at = machine.stalled ? Infinity : this.#cycle + 1;
      machine.loop = null;
    }
  }
}

function period256(machine) {
  return (machine.clockDivInt || 65536) * 256 + machine.clockDivFrac;
}

/** Turns that a count can take, each down by `step`, before a turn in which it might reach zero. */
function turnsLeft(count, step) {
  if (step === 0) return Infinity;
  return step < 0 ? 0 : Math.floor(count / step) - 1;
}

/** A FIFO that has the other's four places too; its contents are lost, as on the chip. */
function joinFifos(block, offset) {
  const machine = block.machines[Math.floor((offset - SM0_CLKDIV) / SM_STRIDE)];
  const rx = machine.shiftCtrl & JOIN_RX ? 8 : machine.shiftCtrl & JOIN_TX ? 0 : 4;
  const tx = machine.shiftCtrl & JOIN_TX ? 8 : machine.shiftCtrl & JOIN_RX ? 0 : 4;
  if (machine.rxFIFO.size === rx && machine.txFIFO.size === tx) return;
  machine.rxFIFO = new FIFO(rx);
  machine.txFIFO = new FIFO(tx);
  machine.updateDMARx();
  machine.updateDMATx();
}
