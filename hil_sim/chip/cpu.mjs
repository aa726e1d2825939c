// The Cortex-M0+ in batches. rp2040js decides for every instruction again which of 80 it is, and its clock is asked after
// each. Here the common instructions are decoded by a table and work on local variables until the next event is due; peripherals see
// the exact time, because the clock is put right before each access to them. What is rare (ROM calls, exceptions,
// special registers) is left to rp2040js's own executeInstruction. Cycle counts are rp2040js's. It is one long function because its speed
// comes from those local variables; no closure may use them, or they would live in memory.
//
// Other than rp2040js, and as the architecture has it: shifts by 0 and by more than 32 leave the right carry, SBCS the right
// overflow, STM writes its base back even if it is in the list. tests/chip/cpu_check.mjs holds both against each other.
import { CYCLE_NS } from './clock.mjs';

const FLASH_SIZE = 0x1000000;
const RAM = 0x20000000;
const RAM_SIZE = 0x42000;
const SP = 13;
const LR = 14;
const PC = 15;
const APB = 0x40000000;
const APB_END = 0x50000000;
const SIO = 0xd0000000;
const SIO_END = 0xe0000000;

function accessCycles(address, write) {
  if (address >= SIO && address < SIO_END) return 0;
  if (address >= APB && address < APB_END) return write ? 4 : 3;
  return 1;
}

/** Executes a chip's instructions. `horizon()` tells the time of the next event that is not an instruction's own doing. */
export class Cpu {
  constructor(chip, clock, horizon) {
    this.chip = chip;
    this.core = chip.core;
    this.clock = clock;
    this.horizon = horizon;
    this.registers = new Int32Array(chip.core.registers.buffer);
    this.flash8 = chip.flash;
    this.flash16 = new Uint16Array(chip.flash.buffer);
    this.flash32 = new Int32Array(chip.flash.buffer);
    this.ram8 = chip.sram;
    this.ram16 = new Uint16Array(chip.sram.buffer);
    this.ram32 = new Int32Array(chip.sram.buffer);
    this.startNs = this.untilNs = 0; // of run()
    this.extra = 0; // cycles of accesses to peripherals beyond those that an instruction counts
    this.left = 0; // run() goes on while its instructions' cycles are fewer
  }

  /** Set `left` to the cycles until the next event. */
  #aim() {
    const { core } = this;
    this.left = Math.ceil((Math.min(this.untilNs, this.horizon()) - this.startNs) / CYCLE_NS) - this.extra;
    if (core.interruptsUpdated || core.waiting) this.left = -1; // the caller must look
  }

  #setClock(cycles) {
    this.clock.nanosCounter = this.startNs + (cycles + this.extra) * CYCLE_NS;
  }

  #load(address, size, cycles) {
    const { chip } = this;
    address >>>= 0;
    if (size === 4 && address >= SIO && address < SIO_END) {
      this.extra--;
      this.left++;
      return chip.sio.readUint32(address - SIO) | 0; // divider, spin locks, pins: nothing happens by itself
    }
    this.#setClock(cycles);
    const value = size === 4 ? chip.readUint32(address) : size === 2 ? chip.readUint16(address) : chip.readUint8(address);
    this.extra += accessCycles(address, false) - 1;
    this.#aim();
    return value | 0;
  }

  #store(address, value, size, cycles) {
    const { chip } = this;
    address >>>= 0;
    this.#setClock(cycles);
    if (size === 4 && address >= SIO && address < SIO_END) chip.sio.writeUint32(address - SIO, value >>> 0);
    else if (size === 4) chip.writeUint32(address, value >>> 0);
    else if (size === 2) chip.writeUint16(address, value & 0xffff);
    else chip.writeUint8(address, value & 0xff);
    this.extra += accessCycles(address, true) - 1;
    this.#aim();
  }

  #load32(a, cycles) {
    const at = (a - RAM) >>> 0;
    if (at < RAM_SIZE && (a & 3) === 0) return this.ram32[at >>> 2];
    if (a >>> 24 === 0x10 && (a & 3) === 0) return this.flash32[(a & 0xffffff) >>> 2];
    return this.#load(a, 4, cycles);
  }

  #load16(a, cycles) {
    const at = (a - RAM) >>> 0;
    if (at < RAM_SIZE && (a & 1) === 0) return this.ram16[at >>> 1];
    if (a >>> 24 === 0x10 && (a & 1) === 0) return this.flash16[(a & 0xffffff) >>> 1];
    return this.#load(a, 2, cycles);
  }

  #load8(a, cycles) {
    const at = (a - RAM) >>> 0;
    if (at < RAM_SIZE) return this.ram8[at];
    if (a >>> 24 === 0x10) return this.flash8[a & 0xffffff];
    return this.#load(a, 1, cycles);
  }

  #store32(a, value, cycles) {
    const at = (a - RAM) >>> 0;
    if (at < RAM_SIZE && (a & 3) === 0) this.ram32[at >>> 2] = value;
    else this.#store(a, value, 4, cycles);
  }

  #store16(a, value, cycles) {
    const at = (a - RAM) >>> 0;
    if (at < RAM_SIZE && (a & 1) === 0) this.ram16[at >>> 1] = value;
    else this.#store(a, value, 2, cycles);
  }

  #store8(a, value, cycles) {
    const at = (a - RAM) >>> 0;
    if (at < RAM_SIZE) this.ram8[at] = value;
    else this.#store(a, value, 1, cycles);
  }

  /** Execute until `untilNs`, the horizon, an interrupt or sleep; the clock ends at the first instruction's end at or after. */
  run(untilNs) {
    const { core, clock, registers: r, flash16, ram16, ram32 } = this;
    this.startNs = clock.nanosCounter;
    this.untilNs = untilNs;
    this.extra = 0;
    this.#aim();
    let cycles = 0; // since the start, without `extra`
    let pc = r[PC];
    let n = core.N ? -1 : 0; // its sign is the flag
    let z = core.Z ? 0 : 1; // zero is the flag
    let c = core.C ? 1 : 0;
    let v = core.V ? 1 : 0;

    while (cycles < this.left) {
      let op;
      if (pc >>> 24 === 0x10) op = flash16[(pc & 0xffffff) >>> 1];
      else if (pc >>> 20 === 0x200) op = ram16[(pc & 0xfffff) >>> 1];
      else op = -1; // in ROM
      const at = pc;
      pc += 2;
      let rare = false;
      switch (op >>> 11) {
        case 0b00000: { // LSLS immediate; MOVS register
          const shift = (op >>> 6) & 31;
          const a = r[(op >>> 3) & 7];
          if (shift) c = (a >>> (32 - shift)) & 1;
          n = z = r[op & 7] = a << shift;
          cycles++;
          break;
        }
        case 0b00001: { // LSRS immediate
          const shift = (op >>> 6) & 31;
          const a = r[(op >>> 3) & 7];
          c = (a >>> (shift ? shift - 1 : 31)) & 1;
          n = z = r[op & 7] = shift ? a >>> shift : 0;
          cycles++;
          break;
        }
        case 0b00010: { // ASRS immediate
          const shift = (op >>> 6) & 31;
          const a = r[(op >>> 3) & 7];
          c = (a >> (shift ? shift - 1 : 31)) & 1;
          n = z = r[op & 7] = a >> (shift || 31);
          cycles++;
          break;
        }
        case 0b00011: { // ADDS, SUBS: register or 3 bits
          const a = r[(op >>> 3) & 7];
          const b = op & 0x400 ? (op >>> 6) & 7 : r[(op >>> 6) & 7];
          let result;
          if (op & 0x200) {
            result = (a - b) | 0;
            c = a >>> 0 >= b >>> 0 ? 1 : 0;
            v = ((a ^ b) & (a ^ result)) >>> 31;
          } else {
            result = (a + b) | 0;
            c = result >>> 0 < a >>> 0 ? 1 : 0;
            v = ((a ^ result) & (b ^ result)) >>> 31;
          }
          n = z = r[op & 7] = result;
          cycles++;
          break;
        }
        case 0b00100: // MOVS
          n = z = r[(op >>> 8) & 7] = op & 255;
          cycles++;
          break;
        case 0b00101: { // CMP
          const a = r[(op >>> 8) & 7];
          const b = op & 255;
          n = z = (a - b) | 0;
          c = a >>> 0 >= b ? 1 : 0;
          v = ((a ^ b) & (a ^ n)) >>> 31;
          cycles++;
          break;
        }
        case 0b00110: { // ADDS
          const a = r[(op >>> 8) & 7];
          const b = op & 255;
          n = z = r[(op >>> 8) & 7] = (a + b) | 0;
          c = n >>> 0 < a >>> 0 ? 1 : 0;
          v = ((a ^ n) & (b ^ n)) >>> 31;
          cycles++;
          break;
        }
        case 0b00111: { // SUBS
          const a = r[(op >>> 8) & 7];
          const b = op & 255;
          n = z = r[(op >>> 8) & 7] = (a - b) | 0;
          c = a >>> 0 >= b ? 1 : 0;
          v = ((a ^ b) & (a ^ n)) >>> 31;
          cycles++;
          break;
        }
        case 0b01000: {
          if (op & 0x400) { // high registers
            const m = (op >>> 3) & 15;
            const d = ((op >>> 4) & 8) | (op & 7);
            const b = m === PC ? pc + 2 : r[m];
            if ((op & 0x300) === 0x200) { // MOV
              if (d === PC) pc = b & ~1;
              else r[d] = d === SP ? b & ~3 : b;
              cycles += d === PC ? 2 : 1;
            } else if ((op & 0x300) === 0) { // ADD
              const result = ((d === PC ? pc + 2 : r[d]) + b) | 0;
              if (d === PC) pc = result & ~1;
              else r[d] = d === SP ? result & ~3 : result;
              cycles += d === PC ? 2 : 1;
            } else if ((op & 0x300) === 0x100) { // CMP
              const a = r[d];
              n = z = (a - b) | 0;
              c = a >>> 0 >= b >>> 0 ? 1 : 0;
              v = ((a ^ b) & (a ^ n)) >>> 31;
              cycles++;
            } else if (m === PC || (b >>> 28 === 15 && core.IPSR)) { // BX to an exception's return
              rare = true;
            } else { // BX, BLX
              if (op & 0x80) r[LR] = pc | 1;
              pc = b & ~1;
              cycles += 2;
            }
            break;
          }
          const d = op & 7;
          const a = r[d];
          const b = r[(op >>> 3) & 7];
          cycles++;
          switch ((op >>> 6) & 15) {
            case 0: n = z = r[d] = a & b; break;
            case 1: n = z = r[d] = a ^ b; break;
            case 2: { // LSLS
              const shift = b & 255;
              if (shift) c = shift > 32 ? 0 : shift === 32 ? a & 1 : (a >>> (32 - shift)) & 1;
              n = z = r[d] = shift > 31 ? 0 : a << shift;
              break;
            }
            case 3: { // LSRS
              const shift = b & 255;
              if (shift) c = shift > 32 ? 0 : (a >>> (shift - 1)) & 1;
              n = z = r[d] = shift > 31 ? 0 : (a >>> shift) | 0;
              break;
            }
            case 4: { // ASRS
              const shift = Math.min(b & 255, 32);
              if (shift) c = (a >> (shift - 1)) & 1;
              n = z = r[d] = a >> Math.min(shift, 31);
              break;
            }
            case 5: { // ADCS
              const sum = (a >>> 0) + (b >>> 0) + c;
              n = z = r[d] = sum | 0;
              c = sum > 0xffffffff ? 1 : 0;
              v = ((a ^ n) & (b ^ n)) >>> 31;
              break;
            }
            case 6: { // SBCS
              const difference = (a >>> 0) - (b >>> 0) - 1 + c;
              n = z = r[d] = difference | 0;
              c = difference >= 0 ? 1 : 0;
              v = ((a ^ b) & (a ^ n)) >>> 31;
              break;
            }
            case 7: { // RORS
              const shift = b & 31;
              n = z = r[d] = shift ? (a >>> shift) | (a << (32 - shift)) : a;
              if (b & 255) c = n >>> 31;
              break;
            }
            case 8: n = z = a & b; break; // TST
            case 9: // RSBS
              n = z = r[d] = (0 - b) | 0;
              c = b === 0 ? 1 : 0;
              v = (b & n) >>> 31;
              break;
            case 10: // CMP
              n = z = (a - b) | 0;
              c = a >>> 0 >= b >>> 0 ? 1 : 0;
              v = ((a ^ b) & (a ^ n)) >>> 31;
              break;
            case 11: // CMN
              n = z = (a + b) | 0;
              c = n >>> 0 < a >>> 0 ? 1 : 0;
              v = ((a ^ n) & (b ^ n)) >>> 31;
              break;
            case 12: n = z = r[d] = a | b; break;
            case 13: n = z = r[d] = Math.imul(a, b); break;
            case 14: n = z = r[d] = a & ~b; break;
            case 15: n = z = r[d] = ~b; break;
          }
          break;
        }
        case 0b01001: // LDR literal
          cycles += 2;
          r[(op >>> 8) & 7] = this.#load32(((pc + 2) & ~3) + ((op & 255) << 2), cycles);
          break;
        case 0b01010: // STR, STRH, STRB, LDRSB by register
        case 0b01011: { // LDR, LDRH, LDRB, LDRSH by register
          const a = (r[(op >>> 3) & 7] + r[(op >>> 6) & 7]) | 0;
          const d = op & 7;
          cycles += 2;
          switch ((op >>> 9) & 7) {
            case 0: this.#store32(a, r[d], cycles); break;
            case 1: this.#store16(a, r[d], cycles); break;
            case 2: this.#store8(a, r[d], cycles); break;
            case 3: r[d] = (this.#load8(a, cycles) << 24) >> 24; break;
            case 4: r[d] = this.#load32(a, cycles); break;
            case 5: r[d] = this.#load16(a, cycles); break;
            case 6: r[d] = this.#load8(a, cycles); break;
            case 7: r[d] = (this.#load16(a, cycles) << 16) >> 16; break;
          }
          break;
        }
        case 0b01100: // STR
          cycles += 2;
          this.#store32((r[(op >>> 3) & 7] + ((op >>> 4) & 0x7c)) | 0, r[op & 7], cycles);
          break;
        case 0b01101: // LDR
          cycles += 2;
          {
            const a = (r[(op >>> 3) & 7] + ((op >>> 4) & 0x7c)) | 0;
            const i = (a - RAM) >>> 0;
            r[op & 7] = i < RAM_SIZE && (a & 3) === 0 ? ram32[i >>> 2] : this.#load32(a, cycles);
          }
          break;
        case 0b01110: // STRB
          cycles += 2;
          this.#store8((r[(op >>> 3) & 7] + ((op >>> 6) & 31)) | 0, r[op & 7], cycles);
          break;
        case 0b01111: // LDRB
          cycles += 2;
          r[op & 7] = this.#load8((r[(op >>> 3) & 7] + ((op >>> 6) & 31)) | 0, cycles);
          break;
        case 0b10000: // STRH
          cycles += 2;
          this.#store16((r[(op >>> 3) & 7] + ((op >>> 5) & 62)) | 0, r[op & 7], cycles);
          break;
        case 0b10001: // LDRH
          cycles += 2;
          r[op & 7] = this.#load16((r[(op >>> 3) & 7] + ((op >>> 5) & 62)) | 0, cycles);
          break;
        case 0b10010: // STR to the stack
          cycles += 2;
          this.#store32((r[SP] + ((op & 255) << 2)) | 0, r[(op >>> 8) & 7], cycles);
          break;
        case 0b10011: // LDR from the stack
          cycles += 2;
          {
            const a = (r[SP] + ((op & 255) << 2)) | 0;
            const i = (a - RAM) >>> 0;
            r[(op >>> 8) & 7] = i < RAM_SIZE && (a & 3) === 0 ? ram32[i >>> 2] : this.#load32(a, cycles);
          }
          break;
        case 0b10100: // ADR
          r[(op >>> 8) & 7] = (at & ~3) + 4 + ((op & 255) << 2);
          cycles++;
          break;
        case 0b10101: // ADD to the stack pointer
          r[(op >>> 8) & 7] = r[SP] + ((op & 255) << 2);
          cycles++;
          break;
        case 0b10110:
          if ((op & 0x600) === 0x400) { // PUSH
            let count = 0;
            for (let bits = op & 0x1ff; bits; bits &= bits - 1) count++;
            const bottom = (r[SP] - 4 * count) | 0;
            let a = bottom;
            cycles += 1 + count - ((op >>> 8) & 1); // rp2040js does not count LR
            for (let i = 0; i < 8; i++) {
              if (op & (1 << i)) {
                const at = (a - RAM) >>> 0;
                if (at < RAM_SIZE && (a & 3) === 0) ram32[at >>> 2] = r[i];
                else this.#store32(a, r[i], cycles);
                a += 4;
              }
            }
            if (op & 0x100) this.#store32(a, r[LR], cycles);
            r[SP] = bottom;
          } else if ((op & 0xff00) === 0xb000) { // ADD, SUB of the stack pointer
            const offset = (op & 0x7f) << 2;
            r[SP] = (r[SP] + (op & 0x80 ? -offset : offset)) & ~3;
            cycles++;
          } else if ((op & 0xff00) === 0xb200) { // SXTH, SXTB, UXTH, UXTB
            const b = r[(op >>> 3) & 7];
            const kind = (op >>> 6) & 3;
            r[op & 7] = kind === 0 ? (b << 16) >> 16 : kind === 1 ? (b << 24) >> 24 : kind === 2 ? b & 0xffff : b & 0xff;
            cycles++;
          } else {
            rare = true;
          }
          break;
        case 0b10111:
          if ((op & 0xff00) === 0xbc00 || ((op & 0xff00) === 0xbd00 && !core.IPSR)) { // POP
            let a = r[SP];
            cycles++;
            for (let i = 0; i < 8; i++) {
              if (op & (1 << i)) {
                const at = (a - RAM) >>> 0;
                r[i] = at < RAM_SIZE && (a & 3) === 0 ? ram32[at >>> 2] : this.#load32(a, cycles);
                a += 4;
                cycles++;
              }
            }
            if (op & 0x100) {
              pc = this.#load32(a, cycles) & ~1;
              a += 4;
              cycles += 2;
            }
            r[SP] = a;
          } else {
            rare = true;
          }
          break;
        case 0b11000: { // STMIA
          const d = (op >>> 8) & 7;
          let a = r[d];
          cycles++;
          for (let i = 0; i < 8; i++) {
            if (op & (1 << i)) {
              this.#store32(a, r[i], cycles);
              a = (a + 4) | 0;
              cycles++;
            }
          }
          r[d] = a;
          break;
        }
        case 0b11001: { // LDMIA
          const d = (op >>> 8) & 7;
          let a = r[d];
          cycles++;
          for (let i = 0; i < 8; i++) {
            if (op & (1 << i)) {
              r[i] = this.#load32(a, cycles);
              a = (a + 4) | 0;
              cycles++;
            }
          }
          if (!(op & (1 << d))) r[d] = a;
          break;
        }
        case 0b11010: // B conditional
        case 0b11011: {
          const condition = (op >>> 8) & 15;
          let holds = false;
          switch (condition) {
            case 0: holds = z === 0; break;
            case 1: holds = z !== 0; break;
            case 2: holds = c === 1; break;
            case 3: holds = c === 0; break;
            case 4: holds = n < 0; break;
            case 5: holds = n >= 0; break;
            case 6: holds = v === 1; break;
            case 7: holds = v === 0; break;
            case 8: holds = c === 1 && z !== 0; break;
            case 9: holds = c === 0 || z === 0; break;
            case 10: holds = n < 0 === (v === 1); break;
            case 11: holds = n < 0 !== (v === 1); break;
            case 12: holds = z !== 0 && n < 0 === (v === 1); break;
            case 13: holds = z === 0 || n < 0 !== (v === 1); break;
            default: rare = true; // UDF, SVC
          }
          if (rare) break;
          cycles++;
          if (holds) {
            pc = (pc + 2 + ((op << 24) >> 23)) | 0;
            cycles++;
          }
          break;
        }
        case 0b11100: // B
          pc = (pc + 2 + ((op << 21) >> 20)) | 0;
          cycles += 2;
          break;
        case 0b11110: { // BL
          const second = pc >>> 24 === 0x10 ? flash16[(pc & 0xffffff) >>> 1] : pc >>> 20 === 0x200 ? ram16[(pc & 0xfffff) >>> 1] : 0;
          if ((second & 0xd000) !== 0xd000) {
            rare = true;
            break;
          }
          const s = (op >>> 10) & 1;
          const i1 = ((second >>> 13) & 1) ^ s ^ 1;
          const i2 = ((second >>> 11) & 1) ^ s ^ 1;
          const offset = (((s ? -1 : 0) << 24) | (i1 << 23) | (i2 << 22) | ((op & 0x3ff) << 12) | ((second & 0x7ff) << 1)) | 0;
          r[LR] = (pc + 2) | 1;
          pc = (pc + 2 + offset) | 0;
          cycles += 3;
          break;
        }
        default:
          rare = true;
      }
      if (rare) {
        pc = at;
        r[PC] = pc;
        core.N = n < 0;
        core.Z = z === 0;
        core.C = c === 1;
        core.V = v === 1;
        this.#setClock(cycles);
        cycles += core.executeInstruction();
        pc = r[PC];
        n = core.N ? -1 : 0;
        z = core.Z ? 0 : 1;
        c = core.C ? 1 : 0;
        v = core.V ? 1 : 0;
        this.#aim();
      }
    }
    r[PC] = pc;
    core.N = n < 0;
    core.Z = z === 0;
    core.C = c === 1;
    core.V = v === 1;
    core.cycles += cycles + this.extra;
    this.#setClock(cycles);
  }
}
