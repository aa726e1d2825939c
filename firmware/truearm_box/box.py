"""The box's main loop. A board provides:

    name                      "rp2040", "vm"
    uid, boot_id (4 bytes), reset_cause, ring_slots, config_path, error_path
    shortest_period_ns        of the sources' samples, both at once, at which no sample is lost
    now(buf)                  8 bytes, big endian: microseconds since boot. Never steps, never wraps.
    ticks(), ticks_diff(a, b) microseconds for durations, small integers
    receive(buf, stamp) → n   bytes received over the link, at most len(buf). If any: stamp (8 bytes) is a time, as
                              now's, at which the first of them had already arrived
    send(buf, at, n) → taken  of buf[at:at + n], 0 … n
    send_stamped(buf, at, end, place) → taken
                              finishes the frame whose payload is buf[at + HEAD:end], as frame.close does, with the
                              current time in the 8 bytes at place, and sends it, with the shortest possible delay. 0:
                              the link takes nothing, nothing was changed
    adc, mag                  the sources of samples, see below
    sensors                   further sensors, () if there are none: each a stream from number 2 on, see polled.py
    thermometers              the thermometers' bus, see below
    configure(settings)       apply the configuration (config.DEFAULT shows one): gains, blanking and time-out, the
                              watchdog. At boot and after every change, never while sampling
    edge(edge) → bool         if a trigger edge waits: line, rising, stamp (1, 1, 4 bytes) to edge. Lines 0 and 1 are
                              the inputs, 2 is the box's own output
    edges_lost                counter since boot that wraps at 2^30: edges that the board had no room for
    output(level)             sets the trigger output
    alive()                   feeds the watchdog; called once per step, so it may blink the LED too
    led(code)                 sets the LED pattern: health.IDLE, STREAMING, HOST_GONE or FAULT
    self_test(settings) → dict  measurements by name, integers in the units of selftest.LIMITS; what cannot be measured
                              is omitted. Never while sampling. May take a second, during which it feeds the watchdog
                              itself
    idle(us)                  nothing to do: wait for an interrupt, at most some milliseconds and at most this many
                              microseconds
    console(text), reset()    exit after an exception; reset() lets the link take what was sent, as boot_loader() does
    to_repl(), boot_loader()  exits by command; to_repl() returns, and then main ends
    heap_free(), temperature_mdegc()

A source samples independently, in hardware, into its own buffer:

    channels                  4 and 1: a sample is 4 * channels bytes, little-endian 32-bit integers
    start(rate), stop()       rate: oversampling (adc), period in ns (mag). A start discards old samples, counts from 0
    waiting() → n             samples that wait
    take(n, dst, at, index, stamp) → bool
                              if n contiguous samples wait: move them to dst[at:], the first one's index since start to
                              index (8 bytes) and the lower half of its hardware stamp to stamp (4 bytes, big endian)
    broken() → bool           a gap follows the waiting samples: no more will arrive before it
    lost() → n                samples lost in the board before those just taken, or since if none wait; counts from zero
                              again
    fault() → flags           of those just taken, FLAG_CONVERTER and FLAG_MISSING_STOP of the wire
    crc_errors, resets        counters since boot that wrap at 2^30 (adc: frames with a wrong CRC, spontaneous resets of
                              the converter)
    missing                   the same (mag: samples without a stop, which are 0)

The main loop never waits for the thermometers' bus:

    uids                      tuple of addresses (8 bytes each) of the thermometers found at boot
    begin(uid)                begin to read the one with this address; None: make all convert
    step() → state            do a part of it: 0 there is more to do, 1 it is done, 2 it failed: no or a wrong answer
    mdegc                     what was read, thousandths of a degree Celsius

None of them may allocate except configure, self_test, output, console, reset, to_repl and boot_loader.

Functions in the path of the samples that need many words are native code (`micropython.native`): MicroPython allocates
the frame of a bytecode function on the heap if locals and operands exceed 11 words. It frees it again, so nothing
grows, but the search for space took 2 to 3 ms per block; a native function's frame is on the stack.
tests/chip/test_speed.py checks it; docs/explanation/benchmarks.md has the figures.
"""

import gc
import io
import sys

from truearm_wire.fast import copy, skip_zeros
from truearm_wire.frame import Splitter
from truearm_wire.messages import BOOT_LOADER, COUNTER, EVENT, RESET

from .commands import Commands
from .health import Health
from .link import Link
from .ring import Events, Ring
from .settings import Settings
from .storage import keep_error
from .stream import Streams
from .temperatures import Temperatures
from .toggle import Toggle

EDGES_A_STEP = 8  # a line without termination may have edges faster than they can be handled
OWN_FRAMES = 8  # at most, of those that wait, go after an answer and after 64 bytes of input, before more input is read


class Box:
    def __init__(self, board):
        self._board = board
        self._ring = Ring(board.ring_slots)
        self.link = Link(board)
        self.streams = Streams(board, self._ring)
        self.temperatures = Temperatures(board)
        self.settings = Settings(board, self.temperatures)
        self.health = Health(board, self.temperatures)  # from here on memory is collected only by explicit calls
        self.commands = Commands(board, self.link, self.streams, self.health, self.settings)
        self._splitter = Splitter()
        self._rx = bytearray(64)
        self._rx_at = 0
        self._rx_end = 0
        self._rx_begun = 0  # a frame that begins before this position began with the first byte
        self._t_first = bytearray(8)  # a time at which that had arrived
        self._t_read = bytearray(8)  # a time at which all of them had
        self._t1 = bytearray(8)  # a time at which the current frame had begun
        self._edge = bytearray(6)
        self._t_edge = bytearray(8)
        self._events = Events()
        self.toggle = Toggle(board)
        self._now = bytearray(8)
        self._sending_block = False
        self._own_first = 0  # own frames that go before more input is read
        self.ended = False  # the host requested MicroPython's prompt
        self.commands.identify(0)  # the ident that every boot sends

    def step(self):
        """Make one pass: samples into the ring, at most one frame onto the link. Returns whether it did anything."""
        start = self._board.ticks()
        self._board.alive()
        busy = self.streams.pull()
        if self.toggle.step(self.streams.running, self.settings.trigger_ms):
            busy = True
        if self._keep_edges():
            busy = True
        if self.temperatures.step(start):
            busy = True
        if self.link.pump():
            busy = True
        free = self.link.free()
        self.health.show(self.streams.running, self.settings.troubled(), not free)
        if free:
            if self._sending_block:
                self._ring.release()
                self._sending_block = False
            if self._next_frame():
                busy = True
            else:
                self.health.tidy()
        self.health.loop(self._board.ticks_diff(self._board.ticks(), start))
        return busy

    def _next_frame(self):
        """Begin the most urgent frame, or read input.

        Answers first: they carry times, while blocks can wait in the ring. But the own frames that wait follow each
        answer and each reading, so no input stops the streams, and only some of them, so no stream stops the answers.
        A command of full length that no box has takes 30 ms, in which 10 blocks of 4 kHz become full.
        """
        if self._own_first:
            self._own_first -= 1
            if self._send_own():
                return True
        if self.commands.pending():
            self.commands.send_page()
            self._own_first = OWN_FRAMES
            return True
        if self.commands.leaving:
            self._leave()
            return True
        if self._receive():
            self._own_first = OWN_FRAMES
            return True
        return self._send_own() or self.commands.send_deferred()

    def _send_own(self):
        """Begin the most urgent frame that nobody asked for. Returns whether there was one."""
        if self._events.used:
            self._send_event()
        elif self.temperatures.ready:
            self.temperatures.send(self.link)
        elif self.health.due():
            bad = self._splitter.bad_frames + self.commands.bad
            dropped = (self._events.dropped + self._board.edges_lost) & COUNTER
            self.health.send(self.link, self.streams.running, self._ring.overruns, dropped, bad)
        elif self._ring.used:
            self._sending_block = True
            self.streams.send_oldest(self.link)
        else:
            return False
        return True

    def _receive(self):
        """Read input until a frame is complete, and handle it; at most 64 bytes. Returns whether there was any.

        A request left its host before its first byte arrived. Of bytes read together only the first byte's time is
        known. A frame that begins with it, or after a delimiter that ends nothing, has that time as its t1; one that
        begins later may have been sent later.
        """
        if self._rx_at == self._rx_end:
            self._rx_end = self._board.receive(self._rx, self._t_first)
            self._rx_at = 0
            if self._rx_end == 0:
                return False
            self._board.now(self._t_read)
            self._rx_begun = 2 if self._rx[0] == 0 and self._splitter.n == 0 else 1
        while self._rx_at < self._rx_end:
            if self._splitter.n == 0:
                self._rx_at = skip_zeros(self._rx, self._rx_at, self._rx_end)
                copy(self._t1, 0, self._t_first if self._rx_at < self._rx_begun else self._t_read, 0, 8)
            self._rx_at = self._splitter.push(self._rx, self._rx_at, self._rx_end)
            if self._splitter.end:
                self.commands.handle(self._splitter.buf, 1, self._splitter.end, self._t1)
                break
        return True

    def _keep_edges(self):
        """Give edges their full time at once: later their stamps could have wrapped. Returns whether more may wait."""
        for _ in range(EDGES_A_STEP):
            if not self._board.edge(self._edge):
                return False
            self._board.now(self._now)
            self._events.put(self._edge, self._now, self._t_edge, self.settings.config["debounce_us"])
        return True

    def _send_event(self):
        self._events.take(self._edge, self._t_edge)
        self.link.begin(EVENT, 3)
        self.link.put_int(self._edge[0])
        self.link.put_u64(self._t_edge)
        self.link.put_int(self._edge[1])
        self.link.send()

    def _leave(self):
        """Leave the loop, as the host requested; it has its answer."""
        if self.commands.leaving != RESET:
            self.ended = True
            return
        self.settings.forget_error()
        if self.commands.mode == BOOT_LOADER:
            self._board.boot_loader()
        self._board.reset()


def run(board):
    """Run until the host requests the prompt.

    An exception is stored, sent on the link between delimiters, and the box restarts.
    """
    try:
        box = Box(board)
        while not box.ended:
            if not box.step():
                board.idle(min(box.toggle.wait(), box.streams.wait()))
    except Exception as e:
        box = None
        gc.collect()  # reporting it takes memory, which may be short
        text = io.StringIO()
        if sys.implementation.name == "micropython":
            sys.print_exception(e, text)
        else:
            text.write("%s: %s\n" % (type(e).__name__, e))
        keep_error(board.error_path, text.getvalue())
        board.console(text.getvalue())
        board.reset()
    gc.enable()
    board.to_repl()
