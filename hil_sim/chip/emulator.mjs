// rp2040js 1.4.1, from where `make chip` put it (build/chip/node_modules of the checkout, or $TRUEARM_NODE_MODULES).
// The pieces below are mended in mends.mjs, pio.mjs, usb_host.mjs and cpu.mjs, which know their inner workings: hence
// the exact version in package.json.
import { pathToFileURL } from 'node:url';

const folder = process.env.TRUEARM_NODE_MODULES
  ? pathToFileURL(process.env.TRUEARM_NODE_MODULES + '/')
  : new URL('../../build/chip/node_modules/', import.meta.url);
const root = new URL('rp2040js/dist/esm/', folder);

export const { RP2040 } = await import(new URL('rp2040.js', root));
export const { SimulationClock } = await import(new URL('clock/simulation-clock.js', root));
export const { FIFO } = await import(new URL('utils/fifo.js', root));
export const { StateMachine, WaitType } = await import(new URL('peripherals/pio.js', root));
export const { BasePeripheral } = await import(new URL('peripherals/peripheral.js', root));
export const setup = await import(new URL('usb/setup.js', root));
export const { extractEndpointNumbers } = await import(new URL('usb/cdc.js', root));
