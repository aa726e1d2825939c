// A state machine of the RP2040's PIO in time: its ticks, sleep, and how it recognises a loop that need not be stepped.
// pio_instructions.mjs says what an instruction does, pio.mjs what a block of four machines does, and when.

import { AGAIN, FOLLOWS, Instructions, lowBits, NONE, PIN, rotateLeft, STALLS } from './pio_instructions.mjs';

export const NEVER = Infinity;

export class Machine extends Instructions {
  constructor(block, index) {
    super(block, index);
    this.enabled = false;
    this.divider = 256; // in 1/256 cycles
    this.phase = 0; // fraction of a cycle that the divider has in hand, in 1/256
    this.t = NEVER; // cycle of its next tick; NEVER while it sleeps or is disabled
    this.sleptAt = 0; // its last tick when it fell asleep
    this.asleep = false;
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

  // -- loops

  /** After a jump back: is this the state of last time, but for X or Y one less? */
  noteLoop() {
    const { mark } = this;
    if (!this.block.fastForward || this.block.changes.length) return;
    if (mark && mark.pure && this.isAt(mark)) {
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
      pc, x, y, isr, isrCount, osr, osrCount, ticks,
      pure: true, // so far nothing shows outside, or depends on more than registers and pins
      compared: false, // what happens depends on the value of X or Y
      countedX: 0, // how often X was counted down
      countedY: 0,
      drives: 0, // pins that were driven
      driven: this.block.driven,
    };
  }

  /** Whether pc, shift registers and what is driven are those of a mark. */
  isAt(mark) {
    return mark.pc === this.pc && mark.isr === this.isr && mark.isrCount === this.isrCount && mark.osr === this.osr &&
      mark.osrCount === this.osrCount && this.forced === NONE && (!mark.drives || mark.driven === this.block.driven);
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

  // -- what it looks at

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
}
