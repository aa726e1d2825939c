// The RP2040's two PIO blocks, cycle-exact and driven by events (datasheet chapter 3; rp2040js's own PIO ignores clock
// dividers, delays, FIFO join and the input synchronisers).
//
// Time is counted in cycles of clk_sys; cycle c lasts from c to c + 1 cycles after the start. An instruction in cycle c sees
// the pins as they were just before c - 1 (two synchroniser flip-flops) and the IRQ flags as they were left by cycle c - 1; its outputs
// appear on the pins at c + 1. Only cycles in which something happens are done (`PioScheduler.step`). What need not be stepped
// costs nothing:
//
// - a machine that stalls sleeps until a pin, a flag or a FIFO it may wait for changes;
// - a machine that comes back to the same instruction in the same state, having touched nothing outside, will do so for ever:
//   it sleeps until a pin changes. If X or Y is one less, it is a counting loop: it sleeps until X or Y is used up. That
//   this is the same as stepping is what tests/chip/pio_equal.mjs shows with random programs.
//
// Not there, and said so in the log when used: OUT_STICKY, INLINE_OUT_EN and INPUT_SYNC_BYPASS.

import { CYCLE_NS } from './clock.mjs';

const FIRST_IRQ = [7, 9]; // PIO0_IRQ_0 and PIO1_IRQ_0
const CTRL = 0x00, FSTAT = 0x04, FDEBUG = 0x08, FLEVEL = 0x0c, TXF = 0x10, RXF = 0x20, IRQ = 0x30, IRQ_FORCE = 0x34;
const SYNC_BYPASS = 0x38, PADOUT = 0x3c, PADOE = 0x40, CFGINFO = 0x44, INSTR_MEM = 0x48, SM = 0xc8, INTR = 0x128;
const SM_STRIDE = 0x18;
const CLKDIV = 0, EXECCTRL = 4, SHIFTCTRL = 8, ADDR = 12, INSTR = 16, PINCTRL = 20;
const AUTOPUSH = 1 << 16, AUTOPULL = 1 << 17, IN_RIGHT = 1 << 18, OUT_RIGHT = 1 << 19, JOINS = 0xc0000000;
const SIDE_PINDIR = 1 << 29, SIDE_EN = 1 << 30, STICKY = 3 << 17; // of EXECCTRL
const NEVER = Infinity;
const DECREMENT_X = 2, DECREMENT_Y = 4, PIN = 6; // conditions of JMP
const PC = 5;
const NOP = 0x42; // mov y, y
const FOLLOWS = -1, STALLS = -2, AGAIN = -3; // what an instruction returns if not the next pc
const NONE = -1; // no forced instruction

const bitReverse = (x) => {
  let r = 0;
  for (let i = 0; i < 32; i++) r |= ((x >>> i) & 1) << (31 - i);
  return r >>> 0;
};
const rotateRight = (x, n) => (n ? ((x >>> n) | (x << (32 - n))) >>> 0 : x >>> 0);
const rotateLeft = (x, n) => rotateRight(x, (32 - n) & 31);
const lowBits = (n) => (n >= 32 ? 0xffffffff : (1 << n) - 1) >>> 0;

/** A FIFO whose depth is 4, or 8 or 0 when the two of a machine are joined. */
class Fifo {
  constructor() {
    this.words = [];
    this.depth = 4;
  }
  get full() {
    return this.words.length >= this.depth;
  }
  get empty() {
    return this.words.length === 0;
  }
}

class Machine {
  constructor(block, index) {
    this.block = block;
    this.index = index;
    this.enabled = false;
    this.x = this.y = this.pc = this.isr = this.osr = 0;
    this.isrCount = 0;
    this.osrCount = 32;
    this.tx = new Fifo();
    this.rx = new Fifo();
    this.divider = 256; // in 1/256 cycles
    this.phase = 0; // fraction of a cycle that the divider has in hand, in 1/256
    this.execctrl = 0x1f << 12;
    this.shiftctrl = 3 << 18;
    this.pinctrl = 5 << 26;
    this.forced = NONE; // an instruction to execute in place of the one at pc
    this.t = NEVER; // cycle of its next tick; NEVER while it sleeps or is disabled
    this.sleptAt = 0; // its last tick when it fell asleep
    this.asleep = false;
    this.irqWait = 0; // flag that an IRQ WAIT has set and waits to see cleared
    this.mark = null; // state at the last jump back, to recognise a loop
    this.cruise = null; // the loop it goes round in
    this.ticks = 0;
    this.sees = 0; // pins that its program can look at
  }

  // -- time

  /** Cycles from now to k ticks later, and the divider's phase then: first-order delta-sigma, as the hardware's. */
  cyclesOf(k) {
    return Math.floor((this.phase + k * this.divider) / 256);
  }
  pass(k) {
    const total = this.phase + k * this.divider;
    this.t += Math.floor(total / 256);
    this.phase = total % 256;
    this.ticks += k;
  }
  sleep() {
    this.asleep = true;
    this.sleptAt = this.t;
    this.t = NEVER;
    if (this.mark) this.mark.pure = false;
  }
  /** Something changed that shows in `cycle`: try again at the first tick from then. */
  wake(cycle) {
    if (!this.asleep) return;
    this.asleep = false;
    this.t = this.sleptAt;
    const k = Math.max(1, Math.ceil(((cycle - this.t) * 256 - this.phase) / this.divider));
    this.pass(k);
  }

  // -- loops

  /** After a jump back: is this the state of last time, but for X or Y one less? */
  noteLoop() {
    const { mark } = this;
    if (!this.block.fastForward || this.block.changes.length) return;
    if (mark && mark.pc === this.pc && mark.pure && (!mark.drives || mark.driven === this.block.driven) && mark.isr === this.isr && mark.isrCount === this.isrCount &&
        mark.osr === this.osr && mark.osrCount === this.osrCount && this.forced === NONE) {
      const dx = mark.x - this.x;
      const dy = mark.y - this.y;
      const counts = dx === mark.countedX && dy === mark.countedY && dx <= 1 && dy <= 1 && !mark.compared;
      if ((dx === 0 && dy === 0) || counts) {
        const rounds = Math.min(dx ? this.x : NEVER, dy ? this.y : NEVER);
        if (rounds > 1) {
          this.cruise = { length: this.ticks - mark.ticks, dx, dy, rounds, drives: mark.drives };
          if (rounds === NEVER) {
            this.cruise.from = this.t;
            this.t = NEVER;
          } else {
            this.cruise.from = this.t;
            this.t += this.cyclesOf(rounds * this.cruise.length);
          }
          return;
        }
      }
    }
    const { pc, x, y, isr, isrCount, osr, osrCount, ticks } = this;
    this.mark = {
      pc, x, y, isr, isrCount, osr, osrCount, ticks, pure: true, compared: false, countedX: 0, countedY: 0, drives: 0, driven: this.block.driven,
    };
  }

  /** Leave the loop at the last time it was at its head not after `cycle`. */
  settle(cycle) {
    const { cruise } = this;
    if (!cruise) return;
    this.cruise = null;
    this.mark = null;
    const gone = ((cycle - cruise.from + 1) * 256 - 1 - this.phase) / this.divider; // ticks that fit
    const rounds = Math.max(0, Math.min(cruise.rounds, Math.floor(gone / cruise.length)));
    this.t = cruise.from;
    this.pass(rounds * cruise.length);
    this.x -= rounds * cruise.dx;
    this.y -= rounds * cruise.dy;
  }

  /** The instruction shows outside, or depends on more than the registers and pins. */
  impure() {
    if (this.mark) this.mark.pure = false;
  }
  /** The way of the program, or what it drives, depends on the value of a register; or a register is set. */
  compared(value) {
    if (this.mark) this.mark.compared = true;
    return value;
  }

  // -- registers

  get inBase() { return (this.pinctrl >>> 15) & 31; }
  get pushAt() { return (this.shiftctrl >>> 20) & 31 || 32; }
  get pullAt() { return (this.shiftctrl >>> 25) & 31 || 32; }
  get pins() { return rotateRight(this.block.levels, this.inBase); }
  get status() {
    this.impure();
    const fifo = this.execctrl & 16 ? this.rx : this.tx;
    return fifo.words.length < (this.execctrl & 15) ? 0xffffffff : 0;
  }

  join() {
    const { shiftctrl } = this;
    this.tx.depth = shiftctrl & 0x40000000 ? 8 : shiftctrl & 0x80000000 ? 0 : 4;
    this.rx.depth = shiftctrl & 0x80000000 ? 8 : shiftctrl & 0x40000000 ? 0 : 4;
    this.tx.words.length = this.rx.words.length = 0;
    this.block.fifoChanged(this);
  }

  restart() {
    this.isr = this.isrCount = this.irqWait = 0;
    this.osrCount = 32;
    this.forced = NONE;
    this.mark = null;
  }

  /** The pins that the program can look at from where it is. */
  look() {
    this.sees = 0;
    if (!this.enabled && this.forced === NONE) return 0;
    const reached = new Set();
    const ways = [this.pc];
    const { instructions } = this.block;
    if (this.forced !== NONE) this.sees |= this.pinsOf(this.forced);
    while (ways.length) {
      const pc = ways.pop();
      if (reached.has(pc)) continue;
      reached.add(pc);
      const opcode = instructions[pc];
      this.sees |= this.pinsOf(opcode);
      const jump = opcode >>> 13 === 0;
      if (jump) ways.push(opcode & 31);
      if (!jump || (opcode >>> 5) & 7) ways.push(this.after(pc));
    }
    return this.sees;
  }

  /** The pins that an instruction looks at; all, if it may go anywhere or do anything. */
  pinsOf(opcode) {
    const field = (opcode >>> 5) & 7;
    const low = opcode & 31;
    switch (opcode >>> 13) {
      case 0: return field === PIN ? 1 << ((this.execctrl >>> 24) & 31) : 0;
      case 1: return (field & 3) === 2 ? 0 : 1 << ((field & 3) === 1 ? (low + this.inBase) & 31 : low);
      case 2: return field === 0 ? rotateLeft(lowBits(low || 32), this.inBase) : 0;
      case 3: return field === 5 || field === 7 ? -1 : 0;
      case 5: return (opcode & 7) === 0 || field === 4 || field === 5 ? -1 : 0;
      default: return 0;
    }
  }

  after(pc) {
    return pc === ((this.execctrl >>> 12) & 31) ? (this.execctrl >>> 7) & 31 : (pc + 1) & 31;
  }

  // -- instructions

  /** The tick at this.t. */
  tick() {
    this.settle(this.t); // a counting loop whose count is used up
    const forced = this.forced !== NONE;
    const opcode = forced ? this.forced : this.block.instructions[this.pc];
    this.forced = NONE;
    const before = this.pc;
    const delay = this.sideset(opcode);
    const next = this.execute(opcode);
    if (next === STALLS || next === AGAIN) {
      if (forced) this.forced = opcode;
      if (next === STALLS) this.sleep();
      else this.pass(1);
      return;
    }
    if (next !== FOLLOWS) this.pc = next;
    else if (!forced) this.pc = this.after(this.pc);
    this.pass(1 + (this.forced === NONE ? delay : 0)); // the delay of an OUT or MOV EXEC does not count
    if (this.pc <= before && !forced) this.noteLoop();
  }

  /** Apply the side set of an instruction; returns its delay. */
  sideset(opcode) {
    const field = (opcode >>> 8) & 31;
    const count = this.pinctrl >>> 29;
    if (!count) return field;
    const delayBits = 5 - count;
    let value = field >>> delayBits;
    let width = count;
    if (this.execctrl & SIDE_EN) {
      width--;
      if (!(value >>> width)) return field & lowBits(delayBits);
      value &= lowBits(width);
    }
    this.drive(this.execctrl & SIDE_PINDIR, value, (this.pinctrl >>> 10) & 31, width);
    return field & lowBits(delayBits);
  }

  drive(directions, value, base, count) {
    const mask = rotateLeft(lowBits(count), base);
    if (this.mark) this.mark.drives |= mask;
    if (this.block.drive(this, directions, rotateLeft(value & lowBits(count), base), mask)) this.impure();
  }

  execute(opcode) {
    const arg = opcode & 31;
    const field = (opcode >>> 5) & 7;
    if (this.shiftctrl & AUTOPULL) this.refill(opcode >>> 13);
    switch (opcode >>> 13) {
      case 0: return this.condition(field) ? arg : FOLLOWS;
      case 1: return this.wait(opcode & 0x80 ? 1 : 0, field & 3, arg);
      case 2: return this.shiftIn(this.source(field), arg || 32);
      case 3: return this.shiftOut(field, arg || 32);
      case 4: return opcode & 0x80 ? this.pull(opcode & 0x40, opcode & 0x20) : this.push(opcode & 0x40, opcode & 0x20);
      case 5: return (opcode & 0xff) === NOP ? FOLLOWS : this.move(field, (opcode >>> 3) & 3, this.source(opcode & 7));
      case 6: return this.flag(opcode & 0x40, opcode & 0x20, this.flagOf(arg));
      default: return this.set(field, arg);
    }
  }

  condition(field) {
    if (field === 1 || field === 3 || field === 5 || field === 7) this.compared();
    switch (field) {
      case 0: return true;
      case 1: return this.x === 0;
      case DECREMENT_X: {
        const go = this.x !== 0;
        this.x = (this.x - 1) >>> 0;
        if (this.mark) this.mark.countedX++;
        return go;
      }
      case 3: return this.y === 0;
      case DECREMENT_Y: {
        const go = this.y !== 0;
        this.y = (this.y - 1) >>> 0;
        if (this.mark) this.mark.countedY++;
        return go;
      }
      case 5: return this.x !== this.y;
      case PIN: return ((this.block.levels >>> ((this.execctrl >>> 24) & 31)) & 1) === 1;
      default: return this.osrCount < this.pullAt;
    }
  }

  wait(polarity, kind, index) {
    if (kind === 2) {
      this.impure();
      const bit = 1 << this.flagOf(index);
      if (!!(this.block.irq & bit) !== !!polarity) return STALLS;
      if (polarity) this.block.irqClear |= bit;
      return FOLLOWS;
    }
    const pin = kind === 1 ? (index + this.inBase) & 31 : index;
    return ((this.block.levels >>> pin) & 1) === polarity ? FOLLOWS : STALLS;
  }

  flagOf(index) {
    return index & 16 ? (index & 4) | ((index + this.index) & 3) : index & 7;
  }

  source(field) {
    switch (field) {
      case 0: return this.pins;
      case 1: return this.x;
      case 2: return this.y;
      case 5: return this.status;
      case 6: return this.isr;
      case 7: return this.osr;
      default: return 0;
    }
  }

  shiftIn(value, bits) {
    if (this.shiftctrl & AUTOPUSH) {
      this.impure();
      if (this.isrCount + bits >= this.pushAt && this.rx.full) {
        this.block.fdebug |= 1 << this.index;
        return STALLS;
      }
    }
    const wanted = value & lowBits(bits);
    if (bits === 32) this.isr = value >>> 0;
    else if (this.shiftctrl & IN_RIGHT) this.isr = ((this.isr >>> bits) | (wanted << (32 - bits))) >>> 0;
    else this.isr = ((this.isr << bits) | wanted) >>> 0;
    this.isrCount = Math.min(32, this.isrCount + bits);
    if (this.shiftctrl & AUTOPUSH && this.isrCount >= this.pushAt) this.pushNow();
    return FOLLOWS;
  }

  /** Autopull in the background: not in the cycle of an OUT, PULL or MOV. */
  refill(op) {
    if (op === 3 || op === 4 || op === 5) return;
    if (this.osrCount >= this.pullAt && !this.tx.empty) this.pullNow();
  }

  shiftOut(destination, bits) {
    if (this.shiftctrl & AUTOPULL) {
      this.impure();
      if (this.osrCount >= this.pullAt) {
        if (this.tx.empty) {
          this.block.fdebug |= 1 << (24 + this.index);
          return STALLS;
        }
        this.pullNow();
        return AGAIN; // an OUT that finds the OSR empty takes one tick longer
      }
    }
    let value;
    if (bits === 32) {
      value = this.osr;
      this.osr = 0;
    } else if (this.shiftctrl & OUT_RIGHT) {
      value = this.osr & lowBits(bits);
      this.osr >>>= bits;
    } else {
      value = this.osr >>> (32 - bits);
      this.osr = (this.osr << bits) >>> 0;
    }
    this.osrCount = Math.min(32, this.osrCount + bits);
    const next = this.output(destination, value >>> 0, bits);
    if (this.shiftctrl & AUTOPULL && this.osrCount >= this.pullAt && !this.tx.empty) this.pullNow();
    return next;
  }

  output(destination, value, bits) {
    const base = this.pinctrl & 31;
    const count = (this.pinctrl >>> 20) & 63;
    switch (destination) {
      case 0: this.drive(0, this.compared(value), base, count); break;
      case 1: this.x = this.compared(value); break;
      case 2: this.y = this.compared(value); break;
      case 4: this.drive(1, this.compared(value), base, count); break;
      case PC: return this.compared(value & 31);
      case 6:
        this.isr = value;
        this.isrCount = bits;
        break;
      case 7: this.forced = this.compared(value & 0xffff); break;
      default: // null
    }
    return FOLLOWS;
  }

  push(ifFull, block) {
    this.impure();
    if (ifFull && this.isrCount < this.pushAt) return FOLLOWS;
    if (this.rx.full) {
      this.block.fdebug |= 1 << this.index;
      if (block) return STALLS;
      this.isr = this.isrCount = 0;
      return FOLLOWS;
    }
    this.pushNow();
    return FOLLOWS;
  }

  pull(ifEmpty, block) {
    this.impure();
    if (ifEmpty && this.osrCount < this.pullAt) return FOLLOWS;
    if (this.shiftctrl & AUTOPULL && this.osrCount === 0) return FOLLOWS; // full already: PULL is a barrier
    if (this.tx.empty) {
      this.block.fdebug |= 1 << (24 + this.index);
      if (block) return STALLS;
      this.osr = this.x;
      this.osrCount = 0;
      return FOLLOWS;
    }
    this.pullNow();
    return FOLLOWS;
  }

  pushNow() {
    this.rx.words.push(this.isr);
    this.isr = this.isrCount = 0;
    this.block.fifoMoved(this);
  }

  pullNow() {
    this.osr = this.tx.words.shift();
    this.osrCount = 0;
    this.block.fifoMoved(this);
  }

  move(destination, operation, source) {
    const value = (operation === 1 ? ~source : operation === 2 ? bitReverse(source) : source) >>> 0;
    switch (destination) {
      case 0: this.drive(0, this.compared(value), this.pinctrl & 31, (this.pinctrl >>> 20) & 63); break;
      case 1: this.x = this.compared(value); break;
      case 2: this.y = this.compared(value); break;
      case 4: this.forced = this.compared(value & 0xffff); break;
      case PC: return this.compared(value & 31);
      case 6:
        this.isr = value;
        this.isrCount = 0;
        break;
      case 7:
        this.osr = value;
        this.osrCount = 0;
        break;
      default: // reserved
    }
    return FOLLOWS;
  }

  flag(clear, wait, index) {
    this.impure();
    if (clear) {
      this.block.irqClear |= 1 << index;
      return FOLLOWS;
    }
    if (wait && this.irqWait) {
      if (this.block.irq & this.irqWait) return STALLS;
      this.irqWait = 0;
      return FOLLOWS;
    }
    this.block.irqSet |= 1 << index;
    if (!wait) return FOLLOWS;
    this.irqWait = 1 << index;
    return STALLS;
  }

  set(destination, value) {
    const base = (this.pinctrl >>> 5) & 31;
    const count = (this.pinctrl >>> 26) & 7;
    switch (destination) {
      case 0: this.drive(0, value, base, count); break;
      case 1: this.x = this.compared(value); break;
      case 2: this.y = this.compared(value); break;
      case 4: this.drive(1, value, base, count); break;
      default: // reserved
    }
    return FOLLOWS;
  }
}

export class Pio {
  /** In place of rp2040js's RPPIO: the same registers at the same place. `irq`: number of its first interrupt. */
  constructor(mcu, index, irq, scheduler) {
    this.mcu = mcu;
    this.index = index;
    this.firstIrq = irq;
    this.fastForward = true;
    this.instructions = new Uint16Array(32);
    this.machines = []; // rp2040js looks here for machines that wait for a pin; these look for themselves
    this.sm = [0, 1, 2, 3].map((i) => new Machine(this, i));
    this.levels = mcu.gpioValues; // the pins as the machines see them, of those in `seen`
    this.pads = mcu.gpioValues; // the pins as they are
    this.seen = 0; // pins that a machine may look at
    this.changes = []; // cycle, mask, levels, cycle, ... of pins on their way through the synchronisers
    this.pinValues = this.pinDirections = 0; // on the pads, read by rp2040js's GPIOPin
    this.nextValues = this.nextDirections = 0; // on the pads from `outputAt`
    this.moved = 0; // machines whose FIFOs request other than now from `outputAt`
    this.outputAt = NEVER;
    this.driven = 0; // how often a machine changed what is driven
    this.irq = this.irqSet = this.irqClear = 0;
    this.fdebug = 0;
    this.inte = [0, 0];
    this.intf = [0, 0];
    this.cycle = 0; // the last one that was done
    this.running = false;
    this.due = NEVER; // cycle of the next event
    this.scheduler = scheduler;
    for (const m of this.sm) this.fifoChanged(m);
  }

  // -- time

  now() {
    return Math.floor(this.mcu.clock.nanos / CYCLE_NS);
  }

  next() {
    let first = Math.min(this.outputAt, this.changes.length ? this.changes[0] : NEVER);
    for (const m of this.sm) if (m.t < first) first = m.t;
    return first;
  }

  schedule() {
    this.due = this.next();
    this.scheduler.update();
  }

  /** Do every cycle up to and with `cycle` in which something happens. */
  advance(cycle) {
    if (this.running) return; // a part's answer to an edge reads or writes while a cycle is done
    this.running = true;
    let next = this.next();
    for (; next <= cycle; next = this.next()) this.step(next);
    this.due = next;
    this.cycle = Math.max(this.cycle, cycle);
    this.running = false;
  }

  step(cycle) {
    this.cycle = cycle;
    if (this.outputAt <= cycle) this.showOutputs();
    if (this.changes.length && this.changes[0] <= cycle) this.takePins(cycle);
    for (const m of this.sm) if (m.t <= cycle) m.tick();
    if (this.irqSet | this.irqClear) this.takeFlags(cycle);
  }

  takePins(cycle) {
    const { changes } = this;
    let mask = 0;
    let n = 0;
    for (; n < changes.length && changes[n] <= cycle; n += 3) {
      mask |= changes[n + 1];
      this.levels = ((this.levels & ~changes[n + 1]) | (changes[n + 2] & changes[n + 1])) >>> 0;
    }
    changes.splice(0, n);
    for (const m of this.sm) {
      if (!(m.sees & mask)) continue;
      m.impure(); // a loop that began before may have looked already
      m.wake(cycle);
    }
  }

  takeFlags(cycle) {
    this.irq = (this.irq & ~this.irqClear) | this.irqSet;
    this.irqSet = this.irqClear = 0;
    this.wakeAll(cycle + 1);
    this.checkInterrupts();
  }

  wakeAll(cycle) {
    for (const m of this.sm) m.wake(cycle);
  }

  // -- pins

  /** Drive the pins of a mask, from the end of this cycle; of two machines that drive one, the later in number wins. */
  drive(machine, directions, value, mask) {
    const old = directions ? this.nextDirections : this.nextValues;
    const fresh = ((old & ~mask) | (value & mask)) >>> 0;
    if (fresh === old) return false;
    this.driven++;
    for (const other of this.sm) if (other.cruise && other.cruise.drives & (fresh ^ old)) this.bringBefore(other, machine);
    if (directions) this.nextDirections = fresh;
    else this.nextValues = fresh;
    if (this.outputAt === NEVER) this.outputAt = this.cycle + 1;
    return true;
  }

  /** A machine that goes round in a loop, in which it drives a pin, must be stepped from the moment that another drives it. */
  bringBefore(other, machine) {
    const { cycle, fastForward } = this;
    this.fastForward = false;
    other.settle(cycle);
    while (other.t < cycle || (other.t === cycle && other.index < machine.index)) other.tick();
    this.fastForward = fastForward;
  }

  showOutputs() {
    const changed = (this.pinValues ^ this.nextValues) | (this.pinDirections ^ this.nextDirections);
    this.outputAt = NEVER;
    for (const m of this.sm) if ((this.moved >>> m.index) & 1) this.fifoChanged(m);
    this.moved = 0;
    this.pinValues = this.nextValues;
    this.pinDirections = this.nextDirections;
    for (let i = 0; i < this.mcu.gpio.length; i++) if ((changed >>> i) & 1) this.mcu.gpio[i].checkForUpdates();
  }

  /** Pins of a mask, which a machine looks at, have new levels from now on; they show in `cycle`. */
  pinsChange(mask, levels, cycle) {
    for (const m of this.sm) if (m.sees & mask) m.settle(this.now());
    this.changes.push(cycle, mask, levels);
    if (!this.running) this.schedule();
  }

  /** A machine runs another program from now on, or looks at other pins. What nobody looked at shows at once. */
  lookAgain() {
    this.levels = ((this.levels & this.seen) | (this.pads & ~this.seen)) >>> 0;
    this.seen = 0;
    for (const m of this.sm) this.seen |= m.look();
  }

  // -- FIFOs and interrupts

  /** A machine pushed or pulled: the requests of its FIFOs follow at the end of the cycle. */
  fifoMoved(machine) {
    this.moved |= 1 << machine.index;
    if (this.outputAt === NEVER) this.outputAt = this.cycle + 1;
  }

  fifoChanged(machine) {
    const { dma } = this.mcu;
    const dreq = 8 * this.index + machine.index;
    if (machine.tx.full) dma.clearDREQ(dreq);
    else dma.setDREQ(dreq);
    if (machine.rx.empty) dma.clearDREQ(dreq + 4);
    else dma.setDREQ(dreq + 4);
    this.checkInterrupts();
  }

  get intr() {
    let raw = (this.irq & 15) << 8;
    for (const m of this.sm) raw |= (m.rx.empty ? 0 : 1 << m.index) | (m.tx.full ? 0 : 16 << m.index);
    return raw;
  }

  checkInterrupts() {
    for (const i of [0, 1]) this.mcu.setInterrupt(this.firstIrq + i, !!((this.intr & this.inte[i]) | this.intf[i]));
  }

  // -- registers

  sync() {
    if (!this.running) this.advance(this.now());
  }

  readUint32(offset) {
    this.sync();
    const value = this.read(offset);
    if (!this.running) this.schedule();
    return value >>> 0;
  }

  read(offset) {
    const bits = (f) => this.sm.reduce((sum, m) => sum | f(m), 0);
    if (offset >= TXF && offset < RXF) return 0;
    if (offset >= RXF && offset < IRQ) return this.readFifo(this.sm[(offset - RXF) >> 2]);
    if (offset >= SM && offset < INTR) return this.readMachine(this.sm[Math.floor((offset - SM) / SM_STRIDE)], (offset - SM) % SM_STRIDE);
    switch (offset) {
      case CTRL: return bits((m) => (m.enabled ? 1 << m.index : 0));
      case FSTAT:
        return bits((m) => ((m.tx.empty ? 1 << 24 : 0) | (m.tx.full ? 1 << 16 : 0) | (m.rx.empty ? 256 : 0) | (m.rx.full ? 1 : 0)) << m.index);
      case FDEBUG: return this.fdebug;
      case FLEVEL: return bits((m) => (m.tx.words.length | (m.rx.words.length << 4)) << (8 * m.index));
      case IRQ: return this.irq;
      case IRQ_FORCE: case SYNC_BYPASS: return 0;
      case PADOUT: return this.pinValues;
      case PADOE: return this.pinDirections;
      case CFGINFO: return 0x200404;
      case INTR: return this.intr;
    }
    const [register, i] = [(offset - INTR - 4) % 12, Math.floor((offset - INTR - 4) / 12)];
    if (i < 0 || i > 1) return 0;
    return register === 0 ? this.inte[i] : register === 4 ? this.intf[i] : (this.intr & this.inte[i]) | this.intf[i];
  }

  readFifo(machine) {
    if (machine.rx.empty) {
      this.fdebug |= 1 << (8 + machine.index);
      return 0;
    }
    const word = machine.rx.words.shift();
    this.fifoChanged(machine);
    machine.impure();
    machine.wake(this.now() + 1);
    return word;
  }

  readMachine(machine, register) {
    switch (register) {
      case CLKDIV: return ((machine.divider >> 8) << 16) | ((machine.divider & 255) << 8);
      case EXECCTRL: return machine.execctrl | (machine.forced !== NONE && machine.asleep ? 1 << 31 : 0);
      case SHIFTCTRL: return machine.shiftctrl;
      case ADDR: case INSTR:
        this.catchUp(machine);
        return register === ADDR ? machine.pc : this.instructions[machine.pc];
      default: return machine.pinctrl;
    }
  }

  /** What a machine in a loop has done by now. */
  catchUp(machine) {
    machine.settle(this.now());
    this.advance(this.now());
  }

  writeUint32Atomic(offset, value, kind) {
    const raw = value >>> 0;
    const old = kind ? this.readUint32(offset) : 0;
    const fresh = kind === 1 ? old ^ value : kind === 2 ? old | value : kind === 3 ? old & ~value : value;
    this.writeUint32(offset, fresh >>> 0, raw);
  }

  writeUint32(offset, value, raw = value) {
    this.sync();
    this.write(offset, value, raw);
    if (!this.running) this.schedule();
  }

  write(offset, value, raw) {
    if (offset >= INSTR_MEM && offset < SM) {
      for (const m of this.sm) this.catchUp(m);
      this.instructions[(offset - INSTR_MEM) >> 2] = value;
      this.lookAgain();
    } else if (offset >= TXF && offset < RXF) this.writeFifo(this.sm[(offset - TXF) >> 2], value);
    else if (offset >= SM && offset < INTR) this.writeMachine(this.sm[Math.floor((offset - SM) / SM_STRIDE)], (offset - SM) % SM_STRIDE, value);
    else if (offset === CTRL) this.control(value, raw);
    else if (offset === FDEBUG) this.fdebug &= ~raw;
    else if (offset === IRQ) this.force(0, raw);
    else if (offset === IRQ_FORCE) this.force(raw, 0);
    else if (offset === SYNC_BYPASS && value) this.mcu.logger.error('PIO', 'INPUT_SYNC_BYPASS is not emulated');
    else if (offset > INTR && offset < INTR + 28) {
      const [register, i] = [(offset - INTR - 4) % 12, Math.floor((offset - INTR - 4) / 12)];
      if (register === 0) this.inte[i] = value & 0xfff;
      else if (register === 4) this.intf[i] = value & 0xfff;
      this.checkInterrupts();
    }
  }

  force(set, clear) {
    this.irqSet |= set & 255;
    this.irqClear |= clear & 255;
    this.takeFlags(this.now());
  }

  writeFifo(machine, value) {
    if (machine.tx.full) {
      this.fdebug |= 1 << (16 + machine.index);
      return;
    }
    if (machine.shiftctrl & AUTOPULL) this.catchUp(machine); // it may pull from now on, whatever it is about
    machine.tx.words.push(value);
    this.fifoChanged(machine);
    machine.impure();
    machine.wake(this.now() + 1);
  }

  control(value) {
    const start = this.now() + 1;
    for (const m of this.sm) {
      const enable = !!((value >>> m.index) & 1);
      if (m.enabled && (!enable || (value >>> (4 + m.index)) & 17)) this.catchUp(m);
      if ((value >>> (4 + m.index)) & 1) m.restart();
      if ((value >>> (8 + m.index)) & 1) m.phase = 0;
      if (enable && (!m.enabled || (value >>> (4 + m.index)) & 17)) {
        m.asleep = false;
        m.mark = null;
        m.t = start;
      }
      if (!enable && m.enabled) {
        m.cruise = m.mark = null;
        m.asleep = false;
        m.t = NEVER;
      }
      m.enabled = enable;
    }
    this.lookAgain();
  }

  writeMachine(machine, register, value) {
    this.catchUp(machine);
    machine.mark = null;
    switch (register) {
      case CLKDIV: machine.divider = (value >>> 16 || 65536) * 256 + ((value >>> 8) & 255); break;
      case EXECCTRL:
        machine.execctrl = value & 0x7fffffff;
        if (value & STICKY) this.mcu.logger.error('PIO', 'OUT_STICKY and INLINE_OUT_EN are not emulated');
        break;
      case SHIFTCTRL: {
        const joins = (machine.shiftctrl ^ value) & JOINS;
        machine.shiftctrl = value >>> 0;
        if (joins) machine.join();
        break;
      }
      case INSTR: this.executeNow(machine, value & 0xffff); break;
      case PINCTRL: machine.pinctrl = value >>> 0; break;
      default: // ADDR is read-only
    }
    this.lookAgain();
  }

  /** An instruction that the processor has written: done in the next cycle, also by a machine that is off. */
  executeNow(machine, opcode) {
    const t = machine.asleep || machine.t === NEVER ? this.now() + 1 : machine.t;
    machine.irqWait = 0;
    machine.asleep = false;
    machine.sideset(opcode);
    const next = machine.execute(opcode);
    machine.t = machine.enabled ? t : NEVER;
    if (next === STALLS || next === AGAIN) {
      machine.forced = opcode;
      machine.t = t;
      if (next === STALLS) machine.sleep();
    } else if (next !== FOLLOWS) machine.pc = next;
    if (this.irqSet | this.irqClear) this.takeFlags(this.now());
    if (this.outputAt !== NEVER) this.outputAt = this.now() + 1;
  }
}

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
