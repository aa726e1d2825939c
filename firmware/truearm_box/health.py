"""How the box is: counters for the heartbeat, and garbage collection at a moment of our choosing.

Automatic collection is off: it would come in the middle of a block. `tidy` collects after something was allocated, when no
frame waits; on the chip that takes some 5 ms, which the board's buffer and the ring bridge. On a link that is never idle
`make_room` collects before the heap runs out.
"""

import gc

from truearm_wire.fast import add, less
from truearm_wire.messages import HEARTBEAT

HEAP_LOW = 40000  # bytes: a command takes less than 10 000, a heartbeat none


class Health:
    def __init__(self, board):
        gc.disable()
        self._board = board
        self._now = bytearray(8)
        self._due = bytearray(8)
        self.loop_max_us = 0
        self.gc_max_us = 0
        self.untidy = True  # something was allocated since the last collection

    def loop(self, us):
        if us > self.loop_max_us:
            self.loop_max_us = us

    def due(self):
        """Whether a heartbeat is due; the next one is then due a second later."""
        self._board.now(self._now)
        if less(self._now, self._due, 8):
            return False
        while not less(self._now, self._due, 8):
            add(self._due, 0, 8, 1000000)
        return True

    def send(self, link, stream, events, bad_frames):
        heap_free = self._board.heap_free()
        link.begin(HEARTBEAT, 13)
        link.put_u32(self._board.boot_id)
        link.put_u64(self._now)
        link.put_int(link.sent)
        link.put_int(events.dropped)
        link.put_int(link.short_writes)
        link.put_int(stream.overruns)
        link.put_int(bad_frames)
        link.put_int(self.loop_max_us)
        link.put_int(self.gc_max_us)
        link.put_int(heap_free)
        link.put_int(self._board.temperature_mdegc())
        link.put_int(self._board.reset_cause)
        link.put_int(1 if stream.running else 0)
        link.send()
        self.loop_max_us = 0
        self.gc_max_us = 0

    def make_room(self):
        """Something will be allocated: collect now if little is left, else when no frame waits."""
        self.untidy = True
        if 0 < self._board.heap_free() < HEAP_LOW:
            self.tidy()

    def tidy(self):
        """Collect, if something was allocated. Called when no frame waits."""
        if not self.untidy:
            return
        start = self._board.ticks()
        gc.collect()
        us = self._board.ticks_diff(self._board.ticks(), start)
        if us > self.gc_max_us:
            self.gc_max_us = us
        self.untidy = False
