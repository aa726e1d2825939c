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
//   it sleeps until a pin that it looks at changes. If X or Y is one less, it is a counting loop: it sleeps until X or Y is used up. That
//   this is the same as stepping is what tests/chip/test_pio.py shows with random programs.
//
// Not there, and said so in the log when used: OUT_STICKY, INLINE_OUT_EN and INPUT_SYNC_BYPASS.

import { CYCLE_NS } from './clock.mjs';
import { AGAIN, AUTOPULL, FOLLOWS, NONE, STALLS } from './pio_instructions.mjs';
import { Machine, NEVER } from './pio_machine.mjs';

const CTRL = 0x00, FSTAT = 0x04, FDEBUG = 0x08, FLEVEL = 0x0c, TXF = 0x10, RXF = 0x20, IRQ = 0x30, IRQ_FORCE = 0x34;
const SYNC_BYPASS = 0x38, PADOUT = 0x3c, PADOE = 0x40, CFGINFO = 0x44, INSTR_MEM = 0x48, SM = 0xc8, INTR = 0x128;
const SM_STRIDE = 0x18;
const CLKDIV = 0, EXECCTRL = 4, SHIFTCTRL = 8, ADDR = 12, INSTR = 16, PINCTRL = 20;
const JOINS = 0xc0000000; // of SHIFTCTRL
const STICKY = 3 << 17; // of EXECCTRL

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
    let changed = (this.pinValues ^ this.nextValues) | (this.pinDirections ^ this.nextDirections);
    this.outputAt = NEVER;
    if (this.moved) for (const m of this.sm) if ((this.moved >>> m.index) & 1) this.fifoChanged(m);
    this.moved = 0;
    this.pinValues = this.nextValues;
    this.pinDirections = this.nextDirections;
    for (; changed; changed &= changed - 1) this.mcu.gpio[31 - Math.clz32(changed & -changed)]?.checkForUpdates();
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
    if (offset >= SM && offset < INTR) return this.readMachine(this.machineOf(offset), (offset - SM) % SM_STRIDE);
    switch (offset) {
      case CTRL: return bits((m) => (m.enabled ? 1 << m.index : 0));
      case FSTAT:
        return bits((m) => (m.tx.empty << 24 | m.tx.full << 16 | m.rx.empty << 8 | m.rx.full) << m.index);
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

  machineOf(offset) {
    return this.sm[Math.floor((offset - SM) / SM_STRIDE)];
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
    else if (offset >= SM && offset < INTR) this.writeMachine(this.machineOf(offset), (offset - SM) % SM_STRIDE, value);
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
