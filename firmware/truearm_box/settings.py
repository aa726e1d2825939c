"""The current configuration, the rates of the streams, and the faults that the box knows of."""

import gc

from truearm_wire.cbor import decode
from truearm_wire.messages import PAGE_BYTES, STREAM_ADC, pages_of

from . import config, ident, selftest, storage, temperatures
from .stream import PERIOD_NS_PER_OSR

PAGES_MAX = 16  # of a configuration: 3200 bytes
ROOM = 60000  # bytes of heap that a configuration must leave for commands (health.py); many small parts take up to 40 times its size


class Settings:
    def __init__(self, board, temperatures):
        self._board = board
        self._temperatures = temperatures
        self._parts = []  # received pages of a new configuration
        self._pages = 0
        self.last_error = storage.last_error(board.error_path)
        self.test_fault = None
        self.config, self.fault = storage.load(board.config_path, self._try_out)
        self._use()
        self.self_test()

    def _use(self):
        self.osr = self.config["osr"]
        self.mag_period_ns = self.config["magnetostrictive"]["period_ns"]
        self.trigger_ms = self.config.get("trigger_ms", config.NO_TRIGGER)  # a host of 1.1 omits it
        self._board.configure(self.config)
        self._temperatures.configure(self.config)

    def _try_out(self, found):
        """Raise ValueError for a configuration that cannot be reported to the host.

        Such a configuration must not stop the box from booting.
        """
        gc.collect()
        count = len(pages_of(found))
        if count > PAGES_MAX:
            raise ValueError("it has %d pages, at most %d fit" % (count, PAGES_MAX))
        longest = ident.document(self._board, found, 1 << 30, 1 << 30, "x" * ident.FAULT_MAX, "x" * ident.ERROR_MAX)
        pages_of(longest)
        longest = None
        gc.collect()
        if 0 < self._board.heap_free() < ROOM:
            raise ValueError("it takes too much memory")

    def troubled(self):
        """Return whether the operator should check the box."""
        return bool(self.fault or self.test_fault or self.last_error)

    def document(self):
        """Return the ident document."""
        fault = "; ".join([text for text in (self.fault, self.test_fault) if text])
        return ident.document(self._board, self.config, self.osr, self.mag_period_ns, fault, self.last_error)

    def self_test(self):
        """Test the board; return the results."""
        measured = self._board.self_test(self.config)
        missing = temperatures.missing(self.config, self._board.thermometers.uids)
        if missing is not None:
            measured["thermometers_missing"] = missing
        results = selftest.judge(measured)
        self.test_fault = selftest.failure(results)
        return results

    def set_rate(self, stream, rate):
        """Set the rate of a stream until the next boot. Raises ValueError."""
        config.check_rate(self.config, stream, rate)
        if stream == STREAM_ADC:
            self.osr = rate
        else:
            self.mag_period_ns = rate

    def check_rates(self):
        """Raise ValueError if samples would be lost at these rates."""
        shortest_ns = self._board.shortest_period_ns
        for name, period_ns in (("adc", PERIOD_NS_PER_OSR * self.osr), ("mag", self.mag_period_ns)):
            if 0 < period_ns < shortest_ns:
                hz = (1000000000 // period_ns, 1000000000 // shortest_ns)
                raise ValueError("%s at %d Hz would lose samples; choose at most %d Hz" % (name, hz[0], hz[1]))

    def put(self, page, count, data):
        """Take a page of a new configuration; return whether it was the last, and the configuration is active.

        Raises ValueError if a page is out of order or the result is not a configuration, OSError if writing to flash
        fails.
        """
        if page == 0:
            self._parts = []
            self._pages = count
        if not 1 <= count <= PAGES_MAX or count != self._pages or page != len(self._parts) or page >= count:
            self._parts = []
            self._pages = 0
            raise ValueError("pages come in order from 0, at most %d" % PAGES_MAX)
        if not 1 <= len(data) <= PAGE_BYTES:
            raise ValueError("a page has 1 to %d bytes" % PAGE_BYTES)
        self._parts.append(data)
        if len(self._parts) < count:
            return False
        data = b"".join(self._parts)
        self._parts = []
        self._pages = 0
        gc.enable()  # much is allocated, and nothing streams
        try:
            self._take(decode(data))
        finally:
            gc.disable()
        return True

    def _take(self, found):
        found = config.check(config.completed(found))
        self._try_out(found)
        config.check_storable(found)
        storage.save(self._board.config_path, found, self._try_out)
        self.config = found
        self.fault = None
        self._use()

    def forget_error(self):
        storage.forget_error(self._board.error_path)
        self.last_error = ""
