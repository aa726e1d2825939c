"""The trigger output, toggled at random times while the box streams.

Its edges relate a robot's clock to the box's (SPEC §5).

A robot controller samples its input once per cycle. Edges synchronous with its cycle would all fall at the same point
in it and carry no more information than one, so the intervals are random to the microsecond. The stamp of an edge is
the hardware's, as for any edge. Nothing here allocates.
"""

LATER = 1 << 29  # µs: nothing is due


class Toggle:
    def __init__(self, board):
        self._board = board
        self._random = board.boot_id[0] << 8 | board.boot_id[1]
        self._level = 0
        self._on = False
        self._since = 0  # ticks at the last edge
        self._interval = 0  # µs to the next one

    def step(self, running, limits):
        """Set the output if it is time; return whether it was set.

        limits: shortest and longest interval in ms, both 0: never.
        """
        if not running or not limits[1]:
            return self._on and self._end()
        ticks = self._board.ticks()
        if self._on and self._board.ticks_diff(ticks, self._since) < self._interval:
            return False
        if self._on:
            self._level ^= 1
            self._board.output(self._level)
        self._on = True
        self._since = ticks
        self._draw(limits[0], limits[1] - limits[0])
        return True

    def wait(self):
        """Return the microseconds until the next edge."""
        if not self._on:
            return LATER
        return max(0, self._interval - self._board.ticks_diff(self._board.ticks(), self._since))

    def _end(self):
        self._on = False
        self._level = 0
        self._board.output(0)
        return True

    def _draw(self, least_ms, span_ms):
        """Return the next interval, uniform over the span in steps of its 65536th part, using only small integers.

        x ← 75 x + 74 mod 65537 runs through 0 … 65535 (Lehmer's generator x + 1 ← 75 (x + 1), with 75 a primitive
        root).
        """
        self._random = (75 * self._random + 74) % 65537
        share = span_ms * self._random
        self._interval = 1000 * (least_ms + (share >> 16)) + ((share & 65535) * 1000 >> 16)
