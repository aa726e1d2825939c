// A stand-in for the RP2040's boot ROM, written from scratch: not a byte of the real one is needed.
//
// The real ROM offers functions by two-letter codes (datasheet 2.8.3). Here each is the two instructions BKPT n; BX LR,
// and what it does happens in JavaScript when the core reports the breakpoint. There is what pico-sdk 2 and
// MicroPython look up: bit operations, memory copy and fill, flash, single-precision floats, float ↔ double.
const ENTRIES = 0x400;
const BKPT = 0xbe00;
const BX_LR = 0x4770;
const RAM = 0x20000000;
const RAM_END = 0x20042000;
const XIP = 0x10000000;
const TABLE = 0x80; // bytes of a float table
export const TEXT = 0x3f00; // where the text of an injected exception stands
const INJECTED = 'injected by the simulator';

const float = new Float32Array(1);
const floatBits = new Uint32Array(float.buffer);
const double = new Float64Array(1);
const doubleBits = new Uint32Array(double.buffer);

// The real ROM's floats flush denormals to zero on the way in and out.
function flushed(bits) {
  return bits & 0x7f800000 ? bits : bits & 0x80000000;
}

function toFloat(bits) {
  floatBits[0] = flushed(bits);
  return float[0];
}

function fromFloat(value) {
  float[0] = value;
  return flushed(floatBits[0]);
}

function saturated(value, low, high) {
  if (Number.isNaN(value)) return 0;
  return value < low ? low : value > high ? high : Math.trunc(value);
}

function int64(registers, signed) {
  const bits = (BigInt(registers[1]) << 32n) | BigInt(registers[0]);
  return signed ? BigInt.asIntN(64, bits) : bits;
}

function setInt64(registers, value) {
  registers[0] = Number(BigInt.asUintN(32, value));
  registers[1] = Number(BigInt.asUintN(32, value >> 32n));
}

const binary = (f) => (r) => { r[0] = fromFloat(f(toFloat(r[0]), toFloat(r[1]))); };
const unary = (f) => (r) => { r[0] = fromFloat(f(toFloat(r[0]))); };
const toInt64 = (low, high) => (r) => setInt64(r, BigInt(saturated(toFloat(r[0]), low, high)));

// offset in the table of soft-float functions (datasheet 2.8.3.2.1, 2.8.3.2.2) → what it does with the registers
const FLOATS = {
  0x00: binary((a, b) => a + b),
  0x04: binary((a, b) => a - b),
  0x08: binary((a, b) => a * b),
  0x0c: binary((a, b) => a / b),
  0x18: unary(Math.sqrt),
  0x1c: (r) => { r[0] = saturated(toFloat(r[0]), -2147483648, 2147483647); },
  0x24: (r) => { r[0] = saturated(toFloat(r[0]), 0, 4294967295); },
  0x2c: (r) => { r[0] = fromFloat(r[0] | 0); },
  0x34: (r) => { r[0] = fromFloat(r[0]); },
  0x3c: unary(Math.cos),
  0x40: unary(Math.sin),
  0x44: unary(Math.tan),
  0x4c: unary(Math.exp),
  0x50: unary(Math.log),
  0x58: binary(Math.atan2),
  0x5c: (r) => { r[0] = fromFloat(Number(int64(r, true))); },
  0x64: (r) => { r[0] = fromFloat(Number(int64(r, false))); },
  0x6c: toInt64(-9223372036854775808, 9223372036854774784),
  0x74: toInt64(0, 18446744073709549568),
  0x7c: (r) => { double[0] = toFloat(r[0]); r[0] = doubleBits[0]; r[1] = doubleBits[1]; },
};
const DOUBLES = {
  0x7c: (r) => { doubleBits[0] = r[0]; doubleBits[1] = r[1]; r[0] = fromFloat(double[0]); },
};

function reversed(bits) {
  let result = 0;
  for (let i = 0; i < 32; i++) {
    result = (result << 1) | (bits & 1);
    bits >>>= 1;
  }
  return result;
}

function ones(bits) {
  let count = 0;
  for (; bits; bits &= bits - 1) count++;
  return count;
}

/** The memory behind an address range, or null: it is copied in one go where it is memory. */
function memory(chip, address, n) {
  if (address >= RAM && address + n <= RAM_END) return chip.sram.subarray(address - RAM, address - RAM + n);
  if (address >= XIP && address + n <= XIP + 0x1000000) return chip.flash.subarray(address - XIP, address - XIP + n);
  return null;
}

function copy(chip, [to, from, n]) {
  const target = to >= RAM && memory(chip, to, n);
  const source = memory(chip, from, n);
  if (target && source) target.set(source);
  else for (let i = 0; i < n; i++) chip.writeUint8(to + i, chip.readUint8(from + i));
}

function fill(chip, [to, value, n]) {
  const target = to >= RAM && memory(chip, to, n);
  if (target) target.fill(value & 255);
  else for (let i = 0; i < n; i++) chip.writeUint8(to + i, value & 255);
}

/**
 * Lay the ROM out. `flash` is a Flash; `onBootloader` is called by the function that starts the USB boot loader.
 * Returns the image (32-bit words) and `call(n)`: what BKPT n stands for, true if the ROM has it.
 */
export function makeRom(chip, flash, onBootloader) {
  const image = new Uint32Array(4096);
  const halves = new Uint16Array(image.buffer);
  const hooks = [];
  let at = ENTRIES;
  const stub = (does) => {
    const address = at;
    halves[at >> 1] = BKPT | (hooks.push(does) - 1);
    halves[(at >> 1) + 1] = BX_LR;
    at += 4;
    return address | 1;
  };
  const missing = stub(() => {
    throw new Error(`the firmware called a ROM function that rom.mjs lacks, from ${chip.core.LR.toString(16)}`);
  });
  const nothing = () => {};
  const functions = {
    P3: (r) => { r[0] = ones(r[0]); },
    R3: (r) => { r[0] = reversed(r[0]); },
    L3: (r) => { r[0] = Math.clz32(r[0]); },
    T3: (r) => { r[0] = r[0] ? 31 - Math.clz32(r[0] & -r[0]) : 32; },
    MS: (r) => fill(chip, r),
    S4: (r) => fill(chip, r),
    MC: (r) => copy(chip, r),
    C4: (r) => copy(chip, r),
    IF: nothing,
    EX: nothing,
    FC: nothing,
    CX: nothing,
    RE: (r) => flash.erase(r[0], r[1]),
    RP: (r) => flash.program(r[0], r[2], (i) => chip.readUint8(r[1] + i)),
    UB: onBootloader,
  };
  const codes = Object.entries(functions).map(([code, does]) => [code, stub(does)]);
  const table = (entries) => {
    const address = at;
    at += TABLE;
    for (let i = 0; i < TABLE; i += 4) image[(address + i) >> 2] = missing;
    for (const [offset, does] of Object.entries(entries)) image[(address + Number(offset)) >> 2] = stub(does);
    return address;
  };
  const data = [['SF', table(FLOATS)], ['SD', table(DOUBLES)]];
  const list = (address, entries) => {
    for (const [code, value] of entries) {
      halves[address >> 1] = code.charCodeAt(0) | (code.charCodeAt(1) << 8);
      halves[(address >> 1) + 1] = value;
      address += 4;
    }
    halves[address >> 1] = 0;
    return address + 4;
  };
  const functionList = 0x100;
  const dataList = list(functionList, codes) & ~3;
  list(dataList, data);
  const lookup = stub((r) => {
    const code = r[1] & 0xffff;
    for (let entry = r[0]; halves[entry >> 1]; entry += 4) {
      if (halves[entry >> 1] === code) {
        r[0] = halves[(entry >> 1) + 1];
        return;
      }
    }
    r[0] = 0;
  });
  new Uint8Array(image.buffer).set(Buffer.from(`${INJECTED}\0`), TEXT);
  image[0] = 0x20041f00; // initial stack
  image[1] = image[2] = image[3] = missing;
  halves[0x10 >> 1] = 0x754d; // "Mu", then version 2
  halves[0x12 >> 1] = 0x0201;
  halves[0x14 >> 1] = functionList;
  halves[0x16 >> 1] = dataList;
  halves[0x18 >> 1] = lookup;
  const call = (n) => {
    if (n >= hooks.length) return false;
    hooks[n](chip.core.registers);
    return true;
  };
  return { image, call };
}
