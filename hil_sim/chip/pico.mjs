// A Raspberry Pi Pico: rp2040js with everything that is mended, a boot ROM, flash, a USB host. Deterministic: emulated
// time moves only in run(), the wall clock is never asked.
import { Clock } from './clock.mjs';
import { Cpu } from './cpu.mjs';
import { RP2040 } from './emulator.mjs';
import { PowerCut } from './flash.mjs';
import * as mends from './mends.mjs';
import { PioScheduler } from './pio_scheduler.mjs';
import { TEXT, makeRom } from './rom.mjs';
import { UsbHost } from './usb_host.mjs';

const FLASH_BOOT = 0x10000000; // second-stage boot loader: where the boot ROM goes
const ROM_END = 0x4000;
export const POWER = 1;
export const WATCHDOG = 2;
export const COMMAND = 3;

export class Pico {
  /**
   * `flash`: a Flash; `packetNs`: what a packet on USB takes; `cause`: of this boot; `uid`: eight bytes of the flash chip; `seed`: of the ring oscillator's bits;
   * `startNs`: what the clock shows at power-on, for tests of wrapping counters.
   */
  constructor({ flash, packetNs, cause = POWER, uid = [1, 2, 3, 4, 5, 6, 7, 8], seed = 1, startNs = 0 }) {
    this.clock = new Clock(startNs);
    this.chip = new RP2040(this.clock);
    this.flash = flash;
    this.injected = null; // symbols, while an exception waits to be raised
    this.ended = null; // what ended the run of this chip: {why, cause}
    this.warnings = new Map(); // what the firmware asked for and the emulator does not have → how often
    this.onData = () => {};
    const { chip, clock } = this;
    chip.logger = { debug() {}, info() {}, warn: this.#warn, error: this.#warn };
    this.pio = new PioScheduler(chip, clock);
    mends.mendPins(chip, (inputs) => this.pio.pinsChanged(inputs));
    mends.mendAdc(chip);
    mends.mendDma(chip);
    mends.mendPwm(chip);
    mends.mendUart(chip);
    mends.mendTimer(chip, clock);
    mends.mendWatchdog(chip, cause, (reason) => this.#end('reset', reason));
    mends.mendRosc(chip, seed);
    mends.mendFlashId(chip, uid);
    this.usb = new UsbHost(chip, clock, packetNs, (bytes) => this.onData(bytes));
    this.cpu = new Cpu(chip, clock, () => (this.ended ? 0 : Math.min(clock.dueNs, this.pio.nextNs)));
    this.#boot();
  }

  /** Whole nanoseconds since power-on (plus `startNs`). */
  get nowNs() {
    return this.clock.nanos;
  }

  /** Drive a pin from outside. */
  setPin(index, level) {
    this.chip.gpio[index].setInputValue(!!level);
  }

  /** Call `listener(level, timeNs)` when the box drives a pin to another level. */
  watchPin(index, listener) {
    const pin = this.chip.gpio[index];
    let last = pin.outputEnable && pin.outputValue;
    pin.addListener(() => {
      const level = pin.outputEnable && pin.outputValue;
      if (level !== last) listener(level, this.clock.nanos);
      last = level;
    });
  }

  /** The clock that the box's PWM puts on a pin, see mends.pwmClock. */
  pwmClock(pin) {
    return mends.pwmClock(this.chip, pin);
  }

  /** Let the chip run until the clock shows `untilNs`, or until something ended it. */
  run(untilNs) {
    try {
      this.#run(untilNs);
    } catch (error) {
      if (!(error instanceof PowerCut)) throw error;
      this.#end('power', POWER);
    }
  }

  /**
   * Let the firmware raise a RuntimeError where it looks up a method next: as if mp_load_method had called mp_raise_msg, which it does
   * when there is none, so whatever called it is ready for that. `symbols`: of the image, {name: [address, size]}.
   */
  raiseInFirmware(symbols) {
    this.injected = symbols;
  }

  #raise() {
    const { core } = this.chip;
    if (core.PC !== (this.injected.mp_load_method[0] & ~1) || core.IPSR || core.PM) return;
    core.registers[0] = this.injected.mp_type_RuntimeError[0];
    core.registers[1] = TEXT;
    core.PC = this.injected.mp_raise_msg[0] & ~1;
    this.injected = null;
  }

  /** As run(), but the processor stands still: only the hardware around it goes on. */
  stall(untilNs) {
    const { clock, pio } = this;
    while (clock.nanosCounter < untilNs && this.ended === null) {
      this.#passTo(Math.min(clock.dueNs, pio.nextNs, untilNs));
    }
  }

  #run(untilNs) {
    const { clock, cpu, pio } = this;
    const { core } = this.chip;
    while (clock.nanosCounter < untilNs && this.ended === null) {
      if (core.interruptsUpdated && core.checkForInterrupts()) core.waiting = false;
      if (core.waiting) this.#passTo(Math.min(clock.dueNs, pio.nextNs, untilNs));
      else {
        cpu.run(this.injected ? clock.nanosCounter + 1 : untilNs); // while one waits, instruction by instruction
        const after = clock.nanosCounter;
        clock.nanosCounter = Math.min(after, clock.dueNs, pio.nextNs); // what falls into the last instruction has its own time
        this.#passTo(after);
        if (this.injected) this.#raise();
      }
    }
  }

  /** Everything that is due by `untilNs`, in order. */
  #passTo(untilNs) {
    const { clock, pio } = this;
    for (;;) {
      const alarm = clock.dueNs;
      const step = pio.nextNs;
      if (Math.min(alarm, step) > untilNs) break;
      if (alarm <= step) {
        clock.callNext();
      } else {
        if (step > clock.nanosCounter) clock.nanosCounter = step;
        pio.step();
      }
    }
    if (untilNs > clock.nanosCounter) clock.nanosCounter = untilNs;
  }

  #boot() {
    const { chip } = this;
    const rom = makeRom(chip, this.flash, () => this.#end('bootloader', COMMAND));
    chip.loadBootrom(rom.image); // this empties the flash too
    this.flash.attach(chip.flash);
    chip.onBreak = (code) => {
      if (chip.core.PC >= ROM_END || !rom.call(code)) {
        throw new Error(`the firmware stopped at a breakpoint, PC ${chip.core.PC.toString(16)}`);
      }
    };
    chip.core.PC = FLASH_BOOT;
  }

  #end(why, cause) {
    this.ended ??= { why, cause };
  }

  #warn = (name, message) => {
    const text = `${name}: ${message}`;
    this.warnings.set(text, (this.warnings.get(text) ?? 0) + 1);
  };
}
