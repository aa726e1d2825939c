"""Thermometers on the bar and at the sensor: each is read every two seconds, whatever else the box does, and a frame tells it.

All convert together; then one after the other is read, some bits a call. No call of `step` waits or allocates. A reading that does not
come is counted, and asked for again two seconds later: a thermometer may be missing from the start, or come and go.
"""

from truearm_wire.fast import copy
from truearm_wire.messages import COUNTER, TEMPERATURE

PERIOD_US = 2000000
CONVERSION_US = 800000  # 750 ms by the DS18B20's datasheet
MOST = 8  # that are read

# what a bus answers
BUSY = 0
DONE = 1
FAILED = 2

_REST = 0
_ASK = 1  # all are told to convert
_CONVERT = 2
_READ = 3


def thermometers(config, found):
    """(name, uid) of each thermometer: those of the configuration by name, then others of `found`."""
    known = [(name, bytes.fromhex(uid)) for name, uid in sorted(config.get("thermometers", {}).items())]
    named = [uid for _, uid in known]
    known.extend([("".join(["%02x" % byte for byte in uid]), uid) for uid in found if uid not in named])
    return known[:MOST]


def missing(config, found):
    """How many thermometers of the configuration are not there; None if it names none."""
    named = config.get("thermometers")
    return len([uid for uid in named.values() if bytes.fromhex(uid) not in found]) if named else None


class Temperatures:
    """`configure` says which thermometers there are; `ready` is True while a reading waits to be sent."""

    def __init__(self, board):
        self._board = board
        self._bus = board.thermometers
        self._uids = ()
        self._doing = _REST
        self._begun = board.ticks()
        self._which = 0
        self._time = bytearray(8)  # when the conversion began
        self._told = bytearray(8)  # of the reading that waits
        self.ready = False
        self.errors = 0

    def configure(self, config):
        """A configuration is in force. Allocates."""
        self._uids = tuple([uid for _, uid in thermometers(config, self._bus.uids)])
        self._doing = _REST

    def step(self, ticks):
        """Do a little of what is due; `ticks` are the board's. Returns whether there may be more to do."""
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
            else:  # nobody is there
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
