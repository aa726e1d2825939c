// A USB host with a CDC driver: enumerates the box, opens its port, moves bytes in both directions at full speed.
//
// rp2040js's device controller hands an IN buffer back at once, whoever reads. Here a buffer that the firmware arms stays
// armed until the host takes it: never while its port is closed or its reader is slow, else after a packet's time. An
// OUT buffer is filled when there is something to send and not polled with empty packets. Both are what a box sees of a
// host that stalls or goes away. Endpoint 0 is left to rp2040js.
import { extractEndpointNumbers, setup } from './emulator.mjs';

const PACKET = 64;
const FRAME_NS = 1_000_000;
const AVAILABLE = 1 << 10;
const FULL = 1 << 15;
const LENGTH = 0x3ff;
const DOUBLE_BUFFERED = 1 << 30;
const BUFFER_CONTROL = 0x80;
const BUFFER_CONTROL_END = 0x100;
const START_OF_FRAME = 1 << 17;
const SOF_RD = 0x48;
const CONFIGURATION = 2; // descriptor type
const CONFIGURATION_SIZE = 9;
const SET_CONTROL_LINE_STATE = 0x22;
const DTR_RTS = 3;

export class UsbHost {
  /** A packet takes `packetNs`. `onData(bytes)` is called with what the box sends; `room` says how many bytes may come (Infinity: any). */
  constructor(chip, clock, packetNs, onData) {
    this.packetNs = packetNs;
    this.usb = chip.usbCtrl;
    this.dpram = chip.usbDPRAM;
    this.view = chip.usbDPRAMView;
    this.onData = onData;
    this.room = Infinity;
    this.connected = false; // enumerated and the port opened
    this.open = true; // what the port will be
    this.descriptors = null; // while they are read
    this.descriptorsSize = null;
    this.inEndpoint = this.outEndpoint = -1;
    this.armed = false; // the IN buffer waits for us
    this.wanted = 0; // bytes that the box's OUT buffer takes
    this.toBox = [];
    this.packet = clock.createAlarm(() => this.#takePacket());
    this.#mendController(clock);
    this.usb.onUSBEnabled = () => this.usb.resetDevice();
    this.usb.onResetReceived = () => this.usb.sendSetupPacket(setup.setDeviceAddressPacket(1));
    this.usb.onEndpointWrite = (endpoint, bytes) => endpoint === 0 && this.#enumerate(bytes);
    this.usb.onEndpointRead = () => {};
  }

  /** Send bytes to the box. */
  send(bytes) {
    for (const byte of bytes) this.toBox.push(byte);
    this.#givePacket();
  }

  /** Bytes that the box has not taken yet. */
  get backlog() {
    return this.toBox.length;
  }

  /** Let `n` more bytes come (they come in packets: a packet begun is taken whole). */
  setRoom(n) {
    this.room = n;
    this.#poll();
  }

  /** Open or close the port: closed, DTR is low and nobody reads. */
  setOpen(open) {
    if (open === this.open) return;
    this.open = open;
    if (this.connected) this.#lineState();
    this.#poll();
  }

  #lineState() {
    this.usb.sendSetupPacket(
      setup.createSetupPacket({
        dataDirection: 0,
        type: 1,
        recipient: 1,
        bRequest: SET_CONTROL_LINE_STATE,
        wValue: this.open ? DTR_RTS : 0,
        wIndex: 0,
        wLength: 0,
      }),
    );
  }

  /** Endpoint 0 answered: ask for the descriptors, then set the configuration, then open the port. */
  #enumerate(bytes) {
    if (bytes.length === 0) {
      if (this.descriptorsSize === null && this.descriptors === null) this.#askDescriptors(CONFIGURATION_SIZE);
      else if (this.inEndpoint >= 0 && !this.connected) {
        this.connected = true;
        this.#lineState();
      }
      return;
    }
    if (this.inEndpoint >= 0 || bytes.length < 2) return;
    if (this.descriptorsSize === null) {
      this.descriptorsSize = bytes[2] | (bytes[3] << 8);
      this.#askDescriptors(this.descriptorsSize);
      return;
    }
    this.descriptors.push(...bytes);
    if (this.descriptors.length < this.descriptorsSize) return;
    const endpoints = extractEndpointNumbers(this.descriptors);
    this.inEndpoint = endpoints.in;
    this.outEndpoint = endpoints.out;
    this.usb.sendSetupPacket(setup.setDeviceConfigurationPacket(1));
  }

  #askDescriptors(size) {
    this.descriptors = [];
    this.usb.sendSetupPacket(setup.getDescriptorPacket(CONFIGURATION, size));
  }

  #mendController(clock) {
    const { usb } = this;
    const upstream = usb.DPRAMUpdated.bind(usb);
    usb.DPRAMUpdated = (offset, value) => {
      const endpoint = (offset - BUFFER_CONTROL) >> 3;
      if (offset < BUFFER_CONTROL + 8 || offset >= BUFFER_CONTROL_END) upstream(offset, value);
      else if (value & AVAILABLE) this.#armed(endpoint, (offset & 4) !== 0, value);
    };
    // rp2040js makes no start of frame in device mode; MicroPython waits for it after the port was opened
    const read = usb.readUint32.bind(usb);
    usb.readUint32 = (offset) => {
      if (offset === SOF_RD) {
        usb.intRaw &= ~START_OF_FRAME;
        usb.checkInterrupts();
      }
      return read(offset);
    };
    const frame = clock.createAlarm(() => {
      usb.sofFrameNumber = (usb.sofFrameNumber + 1) & 0x7ff;
      if (usb.intEnable & START_OF_FRAME) {
        usb.intRaw |= START_OF_FRAME;
        usb.checkInterrupts();
      }
      frame.schedule(FRAME_NS);
    });
    frame.schedule(FRAME_NS);
  }

  #armed(endpoint, out, value) {
    if (this.usb.readEndpointControlReg(endpoint, out) & DOUBLE_BUFFERED) {
      throw new Error('usb_host.mjs: double-buffered endpoints are not modelled');
    }
    if (out && endpoint === this.outEndpoint) {
      this.wanted = value & LENGTH;
      this.#givePacket();
    } else if (!out && endpoint === this.inEndpoint) {
      this.armed = true;
      this.#poll();
    }
  }

  #poll() {
    if (this.armed && this.open && this.room > 0 && !this.packet.scheduled) this.packet.schedule(this.packetNs);
  }

  #control(endpoint, out) {
    return BUFFER_CONTROL + endpoint * 8 + (out ? 4 : 0);
  }

  #takePacket() {
    if (!this.armed || !this.open || this.room <= 0) return;
    const register = this.#control(this.inEndpoint, false);
    const control = this.view.getUint32(register, true);
    const from = this.usb.getEndpointBufferOffset(this.inEndpoint, false);
    const bytes = this.dpram.slice(from, from + (control & LENGTH));
    this.view.setUint32(register, control & ~(AVAILABLE | FULL), true);
    this.armed = false;
    this.room -= bytes.length;
    if (bytes.length) this.onData(bytes);
    this.usb.indicateBufferReady(this.inEndpoint, false);
  }

  #givePacket() {
    if (!this.wanted || !this.toBox.length || !this.open) return;
    const bytes = Uint8Array.from(this.toBox.splice(0, Math.min(this.wanted, PACKET)));
    this.wanted = 0;
    const register = this.#control(this.outEndpoint, true);
    this.view.setUint32(register, this.view.getUint32(register, true) & ~AVAILABLE, true);
    this.usb.endpointReadDone(this.outEndpoint, bytes, this.packetNs / 1000);
  }
}
