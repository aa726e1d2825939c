// The parts on the Pico's pins. A part is a module with
//
//   attach(pico, signals) → {sampling(), control(message)}
//
// that listens to pins and buses (pico.watchPin, pico.chip.spi[0].onTransmit), answers on them (pico.setPin, completeTransmit),
// keeps time with pico.clock alarms and takes what it measures from signals (signals.mjs).

import { attach as adc } from './ads131m04.mjs';
import { attach as mag } from './magnetostrictive.mjs';
import { attach as thermometers } from './thermometers.mjs';
import { attach as triggers } from './triggers.mjs';

const PARTS = { adc, mag, thermometers, triggers }; // names in control messages

/** All parts as one. */
export function attachParts(pico, signals) {
  const attached = Object.fromEntries(Object.entries(PARTS).map(([name, attach]) => [name, attach(pico, signals)]));
  return {
    sampling: () => Object.values(attached).some((part) => part.sampling()),
    control: (message) => {
      const part = attached[message.part];
      if (!part) throw new Error(`there is no part ${message.part}`);
      part.control(message);
    },
  };
}
