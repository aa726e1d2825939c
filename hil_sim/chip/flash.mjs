// The flash chip: an image from a UF2 file, a file that outlives the process for its file system, and power cuts.
//
// Every erase and program operation goes to the file at once, so the file is what the flash would hold if the power
// failed at any moment. A cut can be asked for: the n-th operation from now is left half done, then the power is gone.
import fs from 'node:fs';

const XIP = 0x10000000;
const UF2 = { magic: 0x0a324655, magic2: 0x9e5d5157, block: 512, notFlash: 1, hasFamily: 0x2000, rp2040: 0xe48bff56 };
export const FS_START = 0xa0000; // where MicroPython's file system begins on a Pico
export const FS_SIZE = 352 * 4096;

/** Write the blocks of a UF2 file into `memory`. Throws an Error in words if it is none for the RP2040. */
export function loadUf2(path, memory) {
  const file = fs.readFileSync(path);
  let blocks = 0;
  for (let at = 0; at + UF2.block <= file.length; at += UF2.block) {
    if (file.readUInt32LE(at) !== UF2.magic || file.readUInt32LE(at + 4) !== UF2.magic2) {
      throw new Error(`${path} is not a UF2 file: block ${at / UF2.block} lacks the magic numbers`);
    }
    const flags = file.readUInt32LE(at + 8);
    if (flags & UF2.notFlash || (flags & UF2.hasFamily && file.readUInt32LE(at + 28) !== UF2.rp2040)) continue;
    const size = file.readUInt32LE(at + 16);
    memory.set(file.subarray(at + 32, at + 32 + size), file.readUInt32LE(at + 12) - XIP);
    blocks++;
  }
  if (!blocks) throw new Error(`${path} holds nothing for the RP2040's flash`);
}

/** Thrown out of the emulation at the moment of a power cut. */
export class PowerCut extends Error {}

export class Flash {
  /** `uf2`: image file; `store`: file of the file system's area, made if it does not exist (optional). */
  constructor(uf2, store) {
    this.memory = null; // the chip's, by `attach`
    this.operations = 0; // erase and program operations so far
    this.cutAt = Infinity;
    this.uf2 = uf2;
    this.fd = store ? fs.openSync(store, fs.constants.O_RDWR | fs.constants.O_CREAT, 0o644) : null;
  }

  /** Lay the image and the kept file system into a chip's flash memory. */
  attach(memory) {
    this.memory = memory;
    loadUf2(this.uf2, memory);
    if (this.fd === null) return;
    const kept = Buffer.alloc(FS_SIZE);
    if (fs.readSync(this.fd, kept, 0, FS_SIZE, 0) === FS_SIZE) memory.set(kept, FS_START);
    else fs.writeSync(this.fd, memory.subarray(FS_START, FS_START + FS_SIZE), 0, FS_SIZE, 0);
  }

  /** Cut the power in the n-th operation from now (1 is the next). */
  cutIn(n) {
    this.cutAt = this.operations + n;
  }

  erase(at, n) {
    const done = this.#begin(n);
    this.memory.fill(0xff, at, at + done);
    this.#end(at, n, done);
  }

  /** Program n bytes, `read(i)` each: programming only clears bits. */
  program(at, n, read) {
    const done = this.#begin(n);
    for (let i = 0; i < done; i++) this.memory[at + i] &= read(i);
    this.#end(at, n, done);
  }

  #begin(n) {
    this.operations++;
    return this.operations >= this.cutAt ? n >> 1 : n;
  }

  #end(at, n, done) {
    if (this.fd !== null && at >= FS_START) {
      fs.writeSync(this.fd, this.memory.subarray(at, at + done), 0, done, at - FS_START);
    }
    if (done < n) throw new PowerCut('the power was cut in a flash operation');
  }
}
