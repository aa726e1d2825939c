"""The Raspberry Pi Pico as the box's board (truearm_box/box.py describes what a board provides).

The pins are those of docs/how-to/hardware.md. Sources and triggers belong to drivers: this file gives them pins, state
machines and DMA channels. Nothing that is called while sampling allocates.

Time is the 64-bit microsecond timer, read raw: high, low, high again, to detect a carry in between. `time.ticks_us`
wraps at 2^30.

The link is USB CDC through MicroPython's own standard input and output, so the REPL remains on the same cable.
`kbd_intr(-1)` makes a byte 3 ordinary data. Reading: byte by byte, after a poll that reports one. Writing:
`stdout` would wait up to 0.5 s for a host that does not read, and its FIFO would swallow a frame that nobody fetches. A
frame is therefore handed over only when the endpoint has sent everything: then 320 bytes fit (FIFO and packet), and the
call returns at once. When the host is gone the endpoint stays full, `send` takes nothing, and the box counts what it
must drop.

Both times of a clock exchange are taken in C, in the USB interrupt and just before the FIFO (image/usb_stamp), which
also reads in C: 60 µs a byte are saved.

For two seconds after power-on, Ctrl-C leads to the REPL; only after that is byte 3 data, and the watchdog runs. The box
therefore stays reachable whatever the firmware does; a command leads back too.
"""

import gc
import os
import select
import sys
import time

import machine
import micropython
import rp2
import usb_stamp
from machine import mem16, mem32

from chips import rp2040 as chip
from drivers import measure
from drivers.ads131m04_dma import Adc
from drivers.ds18b20 import Thermometers
from drivers.lvdt import Excitation
from drivers.magnetostrictive import FIRST, Magnetostrictive
from drivers.triggers import Triggers

BOOT_WINDOW_MS = 2000
CONVERTER_PINS = (16, 17, 18, 19, 20, 21, 22)  # DOUT, CS, SCLK, DIN, DRDY, SYNC/RESET, CLKIN
HEAD_PINS = (2, 3)  # interrogation, stop
TRIGGER_PINS = 6  # and 7, inputs; 8, output
THERMOMETER_PIN = 9
LVDT_PINS = (10, 12, 14)  # excitation, clocks of the secondary's and the primary's demodulator
LED_PIN = 25
CONVERTER_MACHINE = 0  # and 1, state machines of PIO 0, which also has that of the triggers
TRIGGER_MACHINE = 2
THERMOMETER_MACHINE = 3
HEAD_BLOCK = 1  # the head takes three machines of PIO 1, and all of its instructions
RAIL_5V_ADC = 1  # GP27, behind a divider by three
TEMPERATURE_ADC = 4
TX_MAX = 256  # bytes that fit MicroPython's FIFO; its packet buffer of 64 is also free when the endpoint is idle
IDLE_MS = 2  # a block of 13 samples takes 3.2 ms at 4 kHz
RING_SLOTS = 200  # blocks: 2 s of both streams at 1 kHz, 78 and 20 blocks a second

SHORTEST_PERIOD_NS = 245760  # 4069 Hz, both sources, of the image in the emulator (docs/how-to/hardware.md)

WRONG_CLOCK = "the system clock is %d Hz; the box counts times of flight and makes the converter's clock with %d Hz. Look for machine.freq() in boot.py"

POWER = 1
WATCHDOG = 2
COMMAND = 3
# LED pattern by health's code: on and off times, ms
BLINKS = ((50, 1950), (500, 500), (50, 450), (100, 100))


@micropython.viper
def _now(out: ptr8, at: int):
    high_register = ptr32(0x40054024)
    low_register = ptr32(0x40054028)
    high = int(high_register[0])
    while True:
        low = int(low_register[0])
        again = int(high_register[0])
        if again == high:
            break
        high = again
    i = 3
    while i >= 0:
        out[at + i] = high & 255
        out[at + 4 + i] = low & 255
        high >>= 8
        low >>= 8
        i -= 1


class Board:
    name = chip.NAME
    ring_slots = RING_SLOTS
    shortest_period_ns = SHORTEST_PERIOD_NS
    config_path = "config.json"
    error_path = "last_error.txt"
    sensors = ()  # further ones: docs/how-to/extending.md

    def __init__(self):
        if machine.freq() != chip.CLOCK_HZ:
            raise RuntimeError(WRONG_CLOCK % (machine.freq(), chip.CLOCK_HZ))
        self._led = machine.Pin(LED_PIN, machine.Pin.OUT)
        self.uid = machine.unique_id()
        self.boot_id = os.urandom(4)
        self.reset_cause = self._cause()
        self._boot_window()
        self._triggers = Triggers(machine, rp2, chip, TRIGGER_PINS, TRIGGER_MACHINE)
        self.adc = Adc(machine, rp2, chip, CONVERTER_PINS, CONVERTER_MACHINE)
        self.mag = Magnetostrictive(machine, rp2, chip, HEAD_PINS, HEAD_BLOCK)
        self.thermometers = Thermometers(machine, rp2, chip, THERMOMETER_PIN, THERMOMETER_MACHINE)
        Excitation(machine, chip, LVDT_PINS)
        self.edge = self._triggers.edge
        self.output = self._triggers.output
        self._temperature = machine.ADC(TEMPERATURE_ADC)
        self._rail = machine.ADC(RAIL_5V_ADC)
        self._poll = select.poll()
        self._poll.register(sys.stdin, select.POLLIN)
        self._stdout = sys.stdout.buffer
        self.receive = usb_stamp.receive
        self.send_stamped = usb_stamp.send
        self._watchdog = None
        self._blink = BLINKS[0]
        self._lit_at = time.ticks_ms()
        micropython.kbd_intr(-1)

    def _cause(self):
        reason = mem32[chip.WATCHDOG_REASON]
        if reason & 2:
            return COMMAND
        return WATCHDOG if reason & 1 else POWER

    def _boot_window(self):
        """Blink for two seconds, during which Ctrl-C raises KeyboardInterrupt and so leads to the REPL."""
        end = time.ticks_add(time.ticks_ms(), BOOT_WINDOW_MS)
        while time.ticks_diff(end, time.ticks_ms()) > 0:
            self._led.toggle()
            time.sleep_ms(100)

    # -- time

    def now(self, buf):
        _now(buf, 0)

    def ticks(self):
        return time.ticks_us()

    def ticks_diff(self, a, b):
        return time.ticks_diff(a, b)

    # -- the link

    def send(self, buf, at, n):
        if not self._link_rests():
            return 0
        return self._stdout.write(buf, at, min(n, TX_MAX)) or 0

    def _link_rests(self):
        """Return whether the host has fetched everything that was handed over.

        A packet may have left just before the register is read, with more in the FIFO. Polling lets MicroPython move
        that into the endpoint, so a second look is reliable.
        """
        for _ in range(2):
            self._poll.ipoll(0)
            if mem16[chip.USB_CDC_IN] & chip.USB_AVAILABLE:
                return False
        return True

    def console(self, text):
        sys.stdout.buffer.write(b"\0")
        sys.stdout.write(text)
        sys.stdout.buffer.write(b"\0")
        time.sleep_ms(100)  # time for the host to fetch it: a reset follows

    def idle(self, us):
        """Sleep until a byte arrives, at most IDLE_MS.

        machine.idle() would not sleep after a step longer than its 1 ms.
        """
        for _ in self._poll.ipoll(min(IDLE_MS, us // 1000)):
            break

    # -- sensors and signals

    @property
    def edges_lost(self):
        return self._triggers.dropped

    def configure(self, settings):
        self.adc.gains([channel.get("gain", 1) for channel in settings["channels"]])
        head = settings["magnetostrictive"]
        self.mag.configure(head["blanking_ns"], head["timeout_ns"], head.get("pulse_edge", FIRST))
        self._start_watchdog(settings["watchdog_ms"])

    def self_test(self, settings):
        found = measure.converter(self.adc, settings["channels"], time.sleep_ms, self.alive)
        if settings["magnetostrictive"]["period_ns"]:
            found["stops"] = measure.stops(self.mag, time.sleep_ms, self.alive)
        found["rail_5v"] = self.rail_5v_mv()
        found["temperature"] = self.temperature_mdegc()
        return found

    def rail_5v_mv(self):
        return self._rail.read_u16() * 9900 // 65535

    def temperature_mdegc(self):
        """Return the temperature: 27 °C at 0.706 V, −1.721 mV/K (RP2040 datasheet 4.9.5), without allocated floats."""
        microvolts = self._temperature.read_u16() * 3300 // 65535 * 1000
        return 27000 - (microvolts - 706000) * 1000 // 1721

    def heap_free(self):
        return gc.mem_free()

    def led(self, code):
        self._blink = BLINKS[code]

    # -- watchdog, and the ways out

    def alive(self):
        if self._watchdog:
            self._watchdog.feed()
        now = time.ticks_ms()
        on, off = self._blink
        since = time.ticks_diff(now, self._lit_at)
        if since >= on + off:
            self._lit_at = now
            since = 0
        self._led.value(since < on)

    def _start_watchdog(self, timeout_ms):
        if timeout_ms:
            self._watchdog = machine.WDT(timeout=timeout_ms)
        else:
            self._stop_watchdog()

    def _stop_watchdog(self):
        mem32[chip.WATCHDOG_CTRL + chip.CLEAR] = chip.WATCHDOG_ENABLE
        self._watchdog = None

    def reset(self):
        machine.reset()

    def boot_loader(self):
        machine.bootloader()

    def to_repl(self):
        self._stop_watchdog()
        self.adc.stop()  # a user at the prompt may free the buffers that DMA writes into
        self.mag.halt()
        self._triggers.stop()
        self.thermometers.stop()
        self._led.off()
        micropython.kbd_intr(3)
