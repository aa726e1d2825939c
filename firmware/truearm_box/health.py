"""The state of the box: counters for the heartbeat, and garbage collection at a chosen moment.

Automatic collection is off: it would occur in the middle of a block. `tidy` collects after an allocation, when no frame
waits. On the chip that takes about 10 ms, and `heap_free`, once a second for the heartbeat, 8: both walk through the
heap. The board's buffers and the ring bridge these pauses. On a link that is never idle `make_room` collects before the
heap is full.
"""

import gc

from truearm_wire.fast import add, copy, less
from truearm_wire.messages import HEARTBEAT, LAYOUT

# between collections: one uses up to 13 kB (the longest ident), a heartbeat none; a new configuration frees its own
# space
COMMANDS = 2
ELEMENTS = len(LAYOUT[HEARTBEAT]) - 1  # written by `send` after seq, in the layout's order
GONE_US = 2000000  # a link that takes nothing for this long has no host

IDLE = 0  # LED patterns
STREAMING = 1
HOST_GONE = 2
FAULT = 3


class Health:
    def __init__(self, board, temperatures):
        gc.collect()  # left over from booting: 160 kB on the chip
        gc.disable()
        self._board = board
        self.temperatures = temperatures
        self._now = bytearray(8)
        self._due = bytearray(8)
        self._time = bytearray(8)
        self._gone_at = bytearray(8)
        self._held = False
        self._shown = -1
        self.loop_max_us = 0
        self.gc_max_us = 0
        self._commands = 1  # that were handled since the last collection

    def loop(self, us):
        if us > self.loop_max_us:
            self.loop_max_us = us

    def due(self):
        """Return whether a heartbeat is due; the next one is then due a second later."""
        self._board.now(self._now)
        if less(self._now, self._due, 8):
            return False
        while not less(self._now, self._due, 8):
            add(self._due, 0, 8, 1000000)
        return True

    def show(self, running, troubled, held):
        """Set the LED; `held`: the link has not taken a complete frame yet."""
        if troubled:
            code = FAULT
        else:
            code = STREAMING if running else IDLE
        if self._host_gone(held):
            code = HOST_GONE
        if code != self._shown:
            self._board.led(code)
            self._shown = code

    def _host_gone(self, held):
        if held:
            self._board.now(self._time)
            if self._held:
                return not less(self._time, self._gone_at, 8)
            copy(self._gone_at, 0, self._time, 0, 8)
            add(self._gone_at, 0, 8, GONE_US)
        self._held = held
        return False

    def send(self, link, running, overruns, dropped, bad_frames):
        heap_free = self._board.heap_free()
        link.begin(HEARTBEAT, ELEMENTS)
        link.put_u32(self._board.boot_id)
        link.put_u64(self._now)
        link.put_int(link.sent)
        link.put_int(dropped)
        link.put_int(link.short_writes)
        link.put_int(overruns)
        link.put_int(bad_frames)
        link.put_int(self.loop_max_us)
        link.put_int(self.gc_max_us)
        link.put_int(heap_free)
        link.put_int(self._board.temperature_mdegc())
        link.put_int(self._board.reset_cause)
        link.put_int(1 if running else 0)
        link.put_int(self._board.adc.crc_errors)
        link.put_int(self._board.adc.resets)
        link.put_int(self._board.mag.missing)
        link.put_int(self.temperatures.errors)
        link.send()
        self.loop_max_us = 0
        self.gc_max_us = 0

    def make_room(self):
        """Prepare for a command that allocates: collect now after several, otherwise when no frame waits.

        (Asking how much is free takes equally long.)
        """
        if self._commands == COMMANDS:
            self.tidy()
        self._commands += 1

    def tidy(self):
        """Collect, if there was an allocation. Called when no frame waits."""
        if not self._commands:
            return
        start = self._board.ticks()
        gc.collect()
        us = self._board.ticks_diff(self._board.ticks(), start)
        if us > self.gc_max_us:
            self.gc_max_us = us
        self._commands = 0
