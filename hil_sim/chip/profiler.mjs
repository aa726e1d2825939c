// Where the processor spends its time: every some microseconds of emulated time the program counter is looked up among the image's
// symbols, and the stack is searched for MicroPython's frames. Nothing of it takes emulated time.
//
// A frame of the interpreter (mp_code_state_t, py/bc.h) lies on the C stack and begins with the function object, whose type is
// mp_type_fun_bc or mp_type_fun_native, and a place in its code, which is the symbol fun_data_MODULE_FUNCTION. Functions of viper
// have no frame: their code is a symbol.
const BYTECODE = 'fun_data_';
const STACK_END = 0x20042000;
const RAM = 0x20000000;

/** Samples a Pico. `symbols`: {name: [address, size]}. */
export class Profiler {
  constructor(pico, symbols, everyNs) {
    this.pico = pico;
    this.everyNs = everyNs;
    this.rows = Object.entries(symbols)
      .map(([name, [address, size]]) => ({ name, from: address & ~1, to: (address & ~1) + size }))
      .sort((a, b) => a.from - b.from);
    this.types = [symbols.mp_type_fun_bc[0], symbols.mp_type_fun_native[0]];
    this.samples = 0;
    this.asleep = 0;
    this.paths = new Map(); // functions from the outermost to the innermost → samples awake
    this.inC = new Map(); // C function → samples
    this.since = []; // of the functions under way: name, when they were first seen
    this.longest = new Map(); // path → longest stay in it, ns
    this.alarm = pico.clock.createAlarm(() => this.#sample());
    this.alarm.schedule(everyNs);
  }

  /** What was found. */
  stop() {
    this.alarm.cancel();
    this.#leave(0);
    return {
      samples: this.samples,
      asleep: this.asleep,
      every_ns: this.everyNs,
      paths: Object.fromEntries(this.paths),
      c: Object.fromEntries(this.inC),
      longest_ns: Object.fromEntries(this.longest),
    };
  }

  #sample() {
    this.alarm.schedule(this.everyNs);
    this.samples++;
    const { core } = this.pico.chip;
    if (core.waiting) {
      this.asleep++;
      this.#leave(0);
      return;
    }
    const path = this.#frames(core);
    const name = this.#symbol(core.PC);
    if (!name.startsWith(BYTECODE)) this.inC.set(name, (this.inC.get(name) ?? 0) + 1);
    else if (name !== BYTECODE + path.at(-1)) path.push(name.slice(BYTECODE.length));
    const text = path.join('>');
    this.paths.set(text, (this.paths.get(text) ?? 0) + 1);
    this.#stay(path);
  }

  /** The Python functions under way, outermost first. */
  #frames(core) {
    const found = [];
    for (let at = core.SP & ~3; at < STACK_END - 4; at += 4) {
      const functionObject = this.#word(at);
      if (functionObject >>> 20 !== RAM >>> 20 || !this.types.includes(this.#word(functionObject))) continue;
      const code = this.#row(this.#word(functionObject + 12));
      const ip = this.#word(at + 4);
      if (code && ip >= code.from && ip < code.to) found.push(code.name.slice(BYTECODE.length));
    }
    return found.reverse();
  }

  #word(address) {
    if (address & 3 || address < RAM || address >= STACK_END) return 0;
    return this.pico.chip.sramView.getUint32(address - RAM, true);
  }

  #row(address) {
    let low = 0;
    let high = this.rows.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.rows[middle].from <= address) low = middle + 1;
      else high = middle;
    }
    const row = this.rows[low - 1];
    return row && address < row.to ? row : null;
  }

  #symbol(address) {
    const row = this.#row(address & ~1);
    return row ? row.name : 'rom';
  }

  #stay(path) {
    let k = 0;
    while (k < path.length && k < this.since.length && this.since[k].name === path[k]) k++;
    this.#leave(k);
    for (; k < path.length; k++) this.since.push({ name: path[k], ns: this.pico.nowNs });
  }

  #leave(depth) {
    while (this.since.length > depth) {
      const text = this.since.map((f) => f.name).join('>');
      const { ns } = this.since.pop();
      this.longest.set(text, Math.max(this.longest.get(text) ?? 0, this.pico.nowNs - ns));
    }
  }
}
