// Emulated time in nanoseconds: whole numbers below 2^53, so exact. One cycle of the 125 MHz system clock is 8 ns.
import { SimulationClock } from './emulator.mjs';

export const CYCLE_NS = 8;

/** rp2040js's clock, with alarms of one instant called in the order in which they were set (it reverses them). */
export class Clock extends SimulationClock {
  constructor(startNs = 0) {
    super();
    this.nanosCounter = startNs;
  }

  linkAlarm(delayNs, alarm) {
    alarm.nanos = this.nanosCounter + delayNs;
    let before = null;
    let after = this.nextAlarm;
    while (after && after.nanos <= alarm.nanos) {
      before = after;
      after = after.next;
    }
    alarm.next = after;
    if (before) before.next = alarm;
    else this.nextAlarm = alarm;
    alarm.scheduled = true;
    return alarm;
  }

  /** Time of the next alarm, or Infinity. */
  get dueNs() {
    return this.nextAlarm ? this.nextAlarm.nanos : Infinity;
  }

  /** Call the next alarm, at its time. */
  callNext() {
    const alarm = this.nextAlarm;
    this.nextAlarm = alarm.next;
    alarm.scheduled = false;
    if (alarm.nanos > this.nanosCounter) this.nanosCounter = alarm.nanos;
    alarm.callback();
  }
}
