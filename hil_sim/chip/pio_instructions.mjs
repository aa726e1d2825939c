// What a state machine of the RP2040's PIO is made of, registers and FIFOs, and what each of its instructions does (datasheet 3.2 to
// 3.5). pio_machine.mjs says when they are executed.

export const AUTOPULL = 1 << 17; // of SHIFTCTRL
const AUTOPUSH = 1 << 16, IN_RIGHT = 1 << 18, OUT_RIGHT = 1 << 19;
const SIDE_PINDIR = 1 << 29, SIDE_EN = 1 << 30; // of EXECCTRL
const DECREMENT_X = 2, DECREMENT_Y = 4; // conditions of JMP
export const PIN = 6;
const PC = 5;
const NOP = 0x42; // mov y, y
export const FOLLOWS = -1, STALLS = -2, AGAIN = -3; // what an instruction returns if not the next pc
export const NONE = -1; // no forced instruction

const bitReverse = (x) => {
  let r = 0;
  for (let i = 0; i < 32; i++) r |= ((x >>> i) & 1) << (31 - i);
  return r >>> 0;
};
const rotateRight = (x, n) => (n ? ((x >>> n) | (x << (32 - n))) >>> 0 : x >>> 0);
export const rotateLeft = (x, n) => rotateRight(x, (32 - n) & 31);
export const lowBits = (n) => (n >= 32 ? 0xffffffff : (1 << n) - 1) >>> 0;

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

/** Registers and instructions. Of time it knows nothing but `mark`, on which it notes what a loop must not depend on. */
export class Instructions {
  constructor(block, index) {
    this.block = block;
    this.index = index;
    this.x = this.y = this.pc = this.isr = this.osr = 0;
    this.isrCount = 0;
    this.osrCount = 32;
    this.tx = new Fifo();
    this.rx = new Fifo();
    this.execctrl = 0x1f << 12;
    this.shiftctrl = 3 << 18;
    this.pinctrl = 5 << 26;
    this.forced = NONE; // an instruction to execute in place of the one at pc
    this.irqWait = 0; // flag that an IRQ WAIT has set and waits to see cleared
    this.mark = null; // state at the last jump back, to recognise a loop
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

  // -- instructions

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
