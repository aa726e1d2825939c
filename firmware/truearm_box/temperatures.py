"""Thermometers on the bar and at the sensor.

Each is read every two seconds, regardless of other work, and sent in a frame.

All convert together; then each is read in turn, some bits per call. No call of `step` waits or allocates. A missing
reading is counted, and requested again two seconds later: a thermometer may be missing from the start, or disconnect
and return.
"""

from truearm_wire.fast import copy
from truearm_wire.messages import COUNTER, TEMPERATURE

PERIOD_US = 2000000
CONVERSION_US = 800000  # 750 ms by the DS18B20's datasheet
MOST = 8  # maximum number read

# results of a bus
BUSY = 0
DONE = 1
FAILED = 2

_REST = 0
_ASK = 1  # all are made to convert
_CONVERT = 2
_READ = 3


def thermometers(config, found):
    """Return (name, uid) of each thermometer: those of the configuration by name, then others of `found`."""
    known = [(name, bytes.fromhex(uid)) for name, uid in sorted(config.get("thermometers", {}).items())]
    named = [uid for _, uid in known]
    known.extend([("".join(["%02x" % byte for byte in uid]), uid) for uid in found if uid not in named])
    return known[:MOST]


def missing(config, found):
    """Return how many thermometers of the configuration are missing; None if it names none."""
    named = config.get("thermometers")
    return len([uid for uid in named.values() if bytes.fromhex(uid) not in found]) if named else None


class Temperatures:
    """`configure` defines the thermometers; `ready` is True while a reading waits to be sent."""

    def __init__(self, board):
        self._board = board
        self._bus = board.thermometers
        self._uids = ()
        self._doing = _REST
        self._begun = board.ticks()
        self._which = 0
        self._time = bytearray(8)  # when the conversion began
        self._told = bytearray(8)  # time of the waiting reading
        self.ready = False
        self.errors = 0

    def configure(self, config):
        """Apply a configuration. Allocates."""
        self._uids = tuple([uid for _, uid in thermometers(config, self._bus.uids)])
        self._doing = _REST

    def step(self, ticks):
        """Do a part of what is due; `ticks` are the board's. Returns whether there may be more to do."""
        if not self._uids or self.ready:
            return False
        if self._doing == _REST:
            if self._board.ticks_diff(ticks, self._begun) < PERIOD_US:
                return False
            self._begun = ticks
            self._board.now(self._time)
            self._bus.begin(None)
            self._doing = _ASK
        elif self._doing == _CONVERT:
            if self._board.ticks_diff(ticks, self._begun) < CONVERSION_US:
                return False
            self._which = -1
            self._next()
        else:
            state = self._bus.step()
            if state == BUSY:
                return False
            self._came(state)
        return True

    def _came(self, state):
        if self._doing == _ASK:
            if state == DONE:
                self._doing = _CONVERT
            else:  # nobody answers
                self.errors = (self.errors + len(self._uids)) & COUNTER
                self._doing = _REST
            return
        if state == DONE:
            copy(self._told, 0, self._time, 0, 8)
            self.ready = True
        else:
            self.errors = (self.errors + 1) & COUNTER
            self._next()

    def _next(self):
        self._which += 1
        if self._which == len(self._uids):
            self._doing = _REST
        else:
            self._bus.begin(self._uids[self._which])
            self._doing = _READ

    def send(self, link):
        """Send the reading that waits."""
        link.begin(TEMPERATURE, 3)
        link.put_u64(self._told)
        link.put_int(self._which)
        link.put_int(self._bus.mdegc)
        link.send()
        self.ready = False
        self._next()
