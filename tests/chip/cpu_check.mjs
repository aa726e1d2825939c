// Random programs on rp2040js's processor and on cpu.mjs: registers, flags, memory, time after every instruction must be the same.
// What rp2040js has wrong (additions with carry) is checked against big integers. Arguments: seed, number of instructions. Prints JSON:
// {instructions, difference: null or what differs first}.
import { Clock } from '../../hil_sim/chip/clock.mjs';
import { Cpu } from '../../hil_sim/chip/cpu.mjs';
import { RP2040 } from '../../hil_sim/chip/emulator.mjs';

const CODE = 0x10000000;
const DATA = 0x20010000; // all that is loaded and stored lies within 4 KiB from here
const [seed, count] = process.argv.slice(2).map(Number);

let state = seed >>> 0 || 1;
function random(n) {
  state ^= state << 13;
  state ^= state >>> 17;
  state ^= state << 5;
  return (state >>> 0) % n;
}

function chip() {
  const clock = new Clock();
  const mcu = new RP2040(clock);
  mcu.logger = { debug() {}, info() {}, warn() {}, error() {} };
  return { mcu, clock, core: mcu.core, cpu: new Cpu(mcu, clock, () => Infinity) };
}

const VALUES = [0, 1, 2, 31, 32, 33, 0x7f, 0x80, 0xff, 0x7fffffff, 0x80000000, 0x80000001, 0xfffffffe, 0xffffffff];
const value = () => (random(3) ? VALUES[random(VALUES.length)] : (random(65536) * 65536 + random(65536)) >>> 0);

/** An instruction that stays in the code and in the data, and the registers that make it so. */
function instruction(registers) {
  const [d, n, m] = [random(8), random(8), random(8)];
  const address = (size) => DATA + 256 + random(512) * size;
  switch (random(9)) {
    case 0: // shifts, additions, immediates
      return random(0x4000);
    case 1: { // data processing; ADCS and SBCS, whose flags rp2040js has wrong, are below
      const operation = [0, 1, 8, 9, 10, 11, 12, 13, 14, 15][random(10)];
      return 0x4000 | (operation << 6) | (m << 3) | d;
    }
    case 2: { // shifts by a register, 1 to 31
      registers[m] = 1 + random(31);
      return 0x4000 | ([2, 3, 4, 7][random(4)] << 6) | (m << 3) | (d === m ? (d + 1) & 7 : d);
    }
    case 3: // high registers: MOV, CMP with r8 to r12
      return [0x4600, 0x4500][random(2)] | ((8 + random(4)) << 3) | d;
    case 4: { // loads and stores with an offset
      const size = [4, 1, 2][random(3)];
      registers[n] = address(4);
      const base = { 4: 0x6000, 1: 0x7000, 2: 0x8000 }[size];
      return base | (random(2) << 11) | (random(32) << 6) | (n << 3) | d;
    }
    case 5: { // by a register
      const operation = random(8);
      const size = [4, 2, 1, 1, 4, 2, 1, 2][operation];
      const i = m === n ? (n + 1) & 7 : m;
      registers[n] = address(size);
      registers[i] = random(64) * size;
      return 0x5000 | (operation << 9) | (i << 6) | (n << 3) | d;
    }
    case 6: // stack
      return [0x9000 | (random(2) << 11) | (d << 8) | random(64), 0xb400 | random(512), 0xbc00 | random(256), 0xb000 | (random(2) << 7) | random(8), 0xa800 | (d << 8) | random(256)][random(5)];
    case 7: { // multiple; the base not in the list
      registers[n] = address(4);
      return (random(2) ? 0xc000 : 0xc800) | (n << 8) | ((random(255) + 1) & ~(1 << n) & 255 || 1 << ((n + 1) & 7));
    }
    default: // extensions, reversals, conditional branches to the next instruction or over it
      return [0xb200 | (random(4) << 6) | (m << 3) | d, 0xba00 | ([0, 1, 3][random(3)] << 6) | (m << 3) | d, 0xd000 | (random(14) << 8), 0xe000][random(4)];
  }
}

function snapshot({ core, clock }) {
  return [...core.registers, core.N, core.Z, core.C, core.V, clock.nanosCounter].map(Number);
}

const theirs = chip();
const ours = chip();
let difference = null;
let done = 0;
for (; done < count && !difference; done++) {
  const registers = Array.from({ length: 13 }, value);
  const opcode = instruction(registers);
  const flags = [random(2), random(2), random(2)].map(Boolean);
  for (const side of [theirs, ours]) {
    side.mcu.flash16[0] = opcode;
    side.core.registers.set(registers);
    side.core.SP = DATA + 2048;
    side.core.LR = CODE | 1;
    side.core.PC = CODE;
    side.core.N = flags[0];
    side.core.Z = !flags[0] && flags[1];
    [side.core.C, side.core.V] = [flags[1], flags[2]];
  }
  const before = theirs.clock.nanosCounter;
  theirs.clock.nanosCounter += theirs.core.executeInstruction() * 8;
  ours.cpu.run(before + 1);
  const [a, b] = [snapshot(theirs), snapshot(ours)];
  const at = a.findIndex((x, i) => x !== b[i]);
  if (at >= 0) difference = { opcode: opcode.toString(16), at, theirs: a[at], ours: b[at], registers };
}

/** ADCS and SBCS by the architecture's AddWithCarry(). */
function addWithCarry(a, b, carry) {
  const sum = BigInt(a) + BigInt(b) + BigInt(carry);
  const signed = BigInt.asIntN(32, BigInt(a)) + BigInt.asIntN(32, BigInt(b)) + BigInt(carry);
  const result = Number(BigInt.asUintN(32, sum));
  return [result, result >= 2 ** 31, result === 0, sum > 0xffffffffn, signed !== BigInt.asIntN(32, sum)].map(Number);
}

for (let i = 0; i < count && !difference; i++) {
  const [a, b, carry, subtract] = [value(), value(), random(2), random(2)];
  const { core, cpu, mcu, clock } = ours;
  mcu.flash16[0] = subtract ? 0x4188 : 0x4148; // r0, r1
  [core.registers[0], core.registers[1], core.PC, core.C] = [a, b, CODE, carry === 1];
  cpu.run(clock.nanosCounter + 1);
  const found = [core.registers[0], core.N, core.Z, core.C, core.V].map(Number);
  const wanted = addWithCarry(a, subtract ? ~b >>> 0 : b, carry);
  if (found.some((x, k) => x !== wanted[k])) difference = { a, b, carry, subtract, found, wanted };
}
if (!difference && Buffer.compare(theirs.mcu.sram, ours.mcu.sram)) difference = 'memory';
console.log(JSON.stringify({ instructions: done, difference }));
