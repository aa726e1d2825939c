// What rp2040js 1.4.1's peripherals do otherwise than the chip, mended as far as the box uses them.
import { BasePeripheral } from './emulator.mjs';

const US = 1000; // ns
const FUNCTION_PWM = 4;
const LEVEL_LOW = 1; // of a pin's interrupt status, as the three below
const LEVEL_HIGH = 2;
const FALLEN = 4 | LEVEL_LOW;
const RISEN = 8 | LEVEL_HIGH;
const INVERTED = 1; // of a pin's input override
const FAST_PWM_NS = 10_000;
const RANDOMBIT = 0x1c;
const SSI_DR0 = 0x60;
const READ_UNIQUE_ID = 0x4b;
const DUMMY_BYTES = 4;
const PWM_WRAP_DREQ = 24;
const DMA_TIMER0 = 59;
const DMA_FORCE = 63;
const CHAN_ABORT = 0x444;

/**
 * Pins: an output reads back, an undriven input follows its pull, and the levels are kept in one word (`chip.inputs`)
 * instead of being asked of 30 pins. `pin.setInputValue(level)` drives a pin from outside, `pin.release()` lets go.
 */
export function mendPins(chip, onChange) {
  chip.inputs = 0;
  Object.defineProperty(chip, 'gpioValues', { get: () => chip.inputs });
  for (const pin of chip.gpio) {
    const bit = 1 << pin.index;
    const setInput = pin.setInputValue.bind(pin);
    let outside = null;
    const show = (level) => {
      const seen = Boolean(level && pin.inputEnable) !== (pin.inputOverride === INVERTED);
      if (seen === ((chip.inputs & bit) !== 0)) return;
      chip.inputs ^= bit;
      if (pin.irqEnableMask || pin.irqForceMask || pin.irqOverride || pin.functionSelect === FUNCTION_PWM) setInput(level);
      else {
        pin.rawInputValue = level;
        pin.irqStatus = (pin.irqStatus | (seen ? RISEN : FALLEN)) & ~(seen ? LEVEL_LOW : LEVEL_HIGH);
      }
      onChange(chip.inputs);
    };
    const update = () => show(pin.outputEnable ? pin.outputValue : (outside ?? pin.pullupEnabled));
    Object.defineProperty(pin, 'inputValue', { get: () => (chip.inputs & bit) !== 0 });
    pin.refreshInput = update;
    pin.setInputValue = (level) => {
      outside = level;
      update();
    };
    pin.release = () => {
      outside = null;
      update();
    };
    pin.checkForUpdates = () => {
      const driven = pin.outputEnable;
      const level = driven && pin.outputValue;
      const value = driven ? Number(level) : pin.value;
      const { lastValue } = pin;
      if (value !== lastValue) {
        pin.lastValue = value;
        for (const listener of pin.listeners) listener(value, lastValue);
      }
      show(driven ? level : (outside ?? pin.pullupEnabled)); // a listener may have changed what comes from outside
    };
  }
}

/** Round robin of the ADC (the setter takes a shift for a mask) and its data request (follows its enable bit). */
export function mendAdc(chip) {
  const { adc } = chip;
  Object.defineProperty(adc, 'activeChannel', {
    get: () => (adc.cs >> 12) & 7,
    set: (channel) => {
      adc.cs = (adc.cs & ~0x7000) | ((channel & 7) << 12);
    },
  });
  const updateDma = adc.updateDMA.bind(adc);
  const write = adc.writeUint32.bind(adc);
  adc.updateDMA = () => (adc.fcs & 8 ? updateDma() : chip.dma.clearDREQ(adc.dreq));
  adc.writeUint32 = (offset, value) => {
    write(offset, value);
    if (offset === 8) adc.updateDMA();
  };
}

/**
 * DMA pacing timers run at clk_sys · X / Y; their period (µs) is upside down, and the fourth shifts by 36. An abort is done at once, so
 * its register reads 0.
 */
export function mendDma(chip) {
  const { dma } = chip;
  const read = dma.readUint32.bind(dma);
  dma.readUint32 = (offset) => (offset === CHAN_ABORT ? 0 : read(offset));
  dma.getTimer = (request) => {
    if (request === DMA_FORCE) return 1e6 / chip.clkSys;
    const register = [dma.timer0, dma.timer1, dma.timer2, dma.timer3][request - DMA_TIMER0];
    const x = register >>> 16;
    return x ? ((register & 0xffff) / x) * (1e6 / chip.clkSys) : 0;
  };
}

/** Period of a PWM slice in ns; edge-aligned. */
function pwmPeriodNs(chip, slice) {
  return ((slice.top + 1) * slice.timer.prescaler * 1e9) / chip.clkSys;
}

/**
 * PWM: a wrap's data request is a pulse. A slice faster than 10 µs moves no pin and calls nobody, or a converter's clock of 8 MHz
 * would be all that the emulator does; who needs its edges computes them (`pwmClock`).
 */
export function mendPwm(chip) {
  const { pwm } = chip;
  const interrupt = pwm.channelInterrupt.bind(pwm);
  pwm.channelInterrupt = (index) => {
    interrupt(index);
    chip.dma.clearDREQ(PWM_WRAP_DREQ + index);
  };
  const kind = Object.getPrototypeOf(pwm.channels[0]);
  const enabled = Object.getOwnPropertyDescriptor(kind, "en"); // it can be written, but reads as undefined
  Object.defineProperty(kind, "en", { ...enabled, get() { return this.csr & 1; }, configurable: true });
  for (const slice of pwm.channels) {
    const silent = () => pwmPeriodNs(chip, slice) < FAST_PWM_NS;
    for (const alarm of [slice.alarmA, slice.alarmB, slice.alarmBottom]) {
      const schedule = alarm.schedule.bind(alarm);
      alarm.schedule = () => {
        if (!silent()) schedule();
      };
    }
    const write = slice.writeRegister.bind(slice);
    slice.writeRegister = (offset, value) => {
      write(offset, value);
      if (slice.csr & 1 && silent()) slice.updateDoubleBuffered(); // no wrap will come to do it
    };
  }
}

/** The clock that a PWM slice puts on a pin: null while it is off, else the time of one rising edge and the period, ns. */
export function pwmClock(chip, pin) {
  const slice = chip.pwm.channels[(pin >> 1) & 7];
  if (!(slice.csr & 1) || chip.gpio[pin].functionSelect !== 4) return null;
  const { baseNanos, baseValue, prescaler } = slice.timer;
  const tickNs = (prescaler * 1e9) / chip.clkSys;
  return { edgeNs: baseNanos - baseValue * tickNs, periodNs: pwmPeriodNs(chip, slice) };
}

/** UART: the transmit interrupt that is forced at every check hangs MicroPython's UART.write. */
export function mendUart(chip) {
  for (const uart of chip.uart) {
    uart.checkInterrupts = () => chip.setInterrupt(uart.irq, !!(uart.interruptStatus & uart.interruptMask));
  }
}

/** Timer alarms go off when the microsecond begins, not up to one early. */
export function mendTimer(chip, clock) {
  const timer = chip.peripherals[0x40054];
  const write = timer.writeUint32.bind(timer);
  timer.writeUint32 = (offset, value) => {
    write(offset, value);
    if (offset < 0x10 || offset > 0x1c) return;
    const nowUs = Math.floor(clock.nanos / US);
    const delayUs = (value - nowUs) >>> 0;
    timer.alarms[(offset - 0x10) / 4].clockAlarm.schedule(Math.max(0, (nowUs + delayUs) * US - clock.nanos));
  };
}

/** Watchdog: the cause of this boot (1 power, 2 timer, 3 software) in REASON; `onReset(cause)` when it bites. */
export function mendWatchdog(chip, cause, onReset) {
  const watchdog = chip.peripherals[0x40058];
  watchdog.reason = { 1: 0, 2: 1, 3: 2 }[cause];
  watchdog.onWatchdogTrigger = () => {
    watchdog.timer.enable = false; // else its alarm of no period goes off for ever
    watchdog.alarm.enable = false;
    onReset(watchdog.reason & 2 ? 3 : 2);
  };
}

/** Ring oscillator: random bits from a seed (xorshift32, never zero). */
export function mendRosc(chip, seed) {
  let state = seed >>> 0 || 1;
  class Rosc extends BasePeripheral {
    readUint32(offset) {
      if (offset !== RANDOMBIT) return 0xffffffff;
      state ^= state << 13;
      state ^= state >>> 17;
      state ^= state << 5;
      return state >>> 31;
    }
    writeUint32() {}
  }
  chip.peripherals[0x40060] = new Rosc(chip, 'ROSC');
}

/** The flash chip's answer to "read unique id" (4Bh, four dummy bytes, eight bytes) on the SSI. */
export function mendFlashId(chip, uid) {
  const ssi = chip.peripherals[0x18000];
  const write = ssi.writeUint32.bind(ssi);
  const read = ssi.readUint32.bind(ssi);
  const answer = [0, ...new Array(DUMMY_BYTES).fill(0), ...uid];
  let at = answer.length; // of the transfer under way
  const fifo = [];
  ssi.writeUint32 = (offset, value) => {
    if (offset !== SSI_DR0) return write(offset, value);
    if (at >= answer.length && value === READ_UNIQUE_ID) at = 0;
    if (at < answer.length) fifo.push(answer[at++]);
    else write(offset, value);
  };
  ssi.readUint32 = (offset) => (offset === SSI_DR0 && fifo.length ? fifo.shift() : read(offset));
}
