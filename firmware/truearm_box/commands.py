"""What the host may ask. A sync request is answered without allocation; commands may allocate, they are rare.

A command is executed once: one that comes again with the req_id of the last (its answer was lost) is only answered again.
"""

from truearm_wire import PROTOCOL
from truearm_wire.cbor import CborError, decode, encode
from truearm_wire.messages import (
    CONFIGURE,
    ERROR,
    ERROR_MALFORMED,
    ERROR_RANGE,
    ERROR_STREAMING,
    ERROR_UNKNOWN,
    IDENT,
    IDENTIFY,
    REPLY,
    START,
    STOP,
    SYNC_REPLY,
    SYNC_REQUEST,
    pages,
)

from . import VERSION, config
from .ring import COUNTER

SMALL = 1 << 30


class Commands:
    def __init__(self, board, link, stream, health, settings, fault):
        self._board = board
        self._link = link
        self._stream = stream
        self._health = health
        self._settings = settings
        self._fault = fault
        self._osr = settings["osr"]
        self._last = 0  # req_id of the last command
        self._answer = REPLY
        self._code = 0
        self._text = b""
        self._req_id = 0
        self._pages = ()
        self._page = 0
        self._t2 = bytearray(8)
        self._stop_id = 0  # of a stop that is to be answered
        self.bad = 0  # frames that were whole but no command

    def pending(self):
        """Whether pages of an answer wait."""
        return self._page < len(self._pages)

    def identify(self, req_id):
        """Lay the ident document out in pages."""
        document = config.describe(self._settings, self._fault, self._osr, self._board, VERSION, PROTOCOL)
        self._req_id = req_id
        self._pages = pages(encode(document))
        self._page = 0

    def send_page(self):
        page, count, data = self._pages[self._page]
        self._page += 1
        self._link.begin(IDENT, 4)
        self._link.put_int(self._req_id)
        self._link.put_int(page)
        self._link.put_int(count)
        self._link.put_bytes(data)
        self._link.send()

    def handle(self, buf, start, end, t1):
        """Answer the frame whose payload is buf[start:end] and whose last byte was read at device time t1."""
        if self._usual_sync(buf, start, end, t1):
            return
        self._health.make_room()
        try:
            values = decode(bytes(buf[start:end]))
        except CborError:
            values = None
        if not isinstance(values, list) or len(values) < 2 or not _is_id(values[0]) or not _is_id(values[1]):
            self.bad = (self.bad + 1) & COUNTER  # there is no one to answer
        elif values[0] == SYNC_REQUEST:
            self._sync(values[1], t1)
        elif IDENTIFY <= values[0] < REPLY and values[1] > 0:
            self._command(values)
        else:
            self.bad = (self.bad + 1) & COUNTER

    def _usual_sync(self, buf, start, end, t1):
        """Answer [32, id] in its shortest form without allocating. Returns whether it was that."""
        if end - start < 4 or buf[start] != 0x82 or buf[start + 1] != 0x18 or buf[start + 2] != SYNC_REQUEST:
            return False
        n = buf[start + 3]
        width = 0 if n < 24 else 1 if n == 24 else 2 if n == 25 else 4 if n == 26 else 9
        at = start + 4
        if width == 9 or at + width != end or (width == 4 and buf[at] > 63):
            return False
        if width:
            n = 0
            for i in range(width):
                n = n << 8 | buf[at + i]
        self._sync(n, t1)
        return True

    def _sync(self, n, t1):
        link = self._link
        link.begin(SYNC_REPLY, 3)
        link.put_int(n)
        link.put_u64(t1)
        self._board.now(self._t2)
        link.put_u64(self._t2)
        link.send()

    def _command(self, values):
        if values[1] != self._last:
            self._last = values[1]
            self._execute(values)
        if values[0] == STOP and self._answer == REPLY:
            self._stop_id = values[1]  # answered when what was sampled has gone
        else:
            self._reply(self._last)

    def send_deferred(self):
        """Answer a stop, now that no block waits. Returns whether there was one to answer."""
        req_id = self._stop_id
        if not req_id:
            return False
        self._stop_id = 0
        self._done(req_id)
        return True

    def _execute(self, values):
        self._answer = REPLY
        kind = values[0]
        if kind == IDENTIFY:
            self._answer = IDENT
        elif kind == CONFIGURE:
            self._configure(values)
        elif kind == START:
            self._start()
        elif kind == STOP:
            if self._stream.running:
                self._stream.stop()
        else:
            self._refuse(ERROR_UNKNOWN, b"unknown command")

    def _start(self):
        if self._stream.running:
            self._refuse(ERROR_STREAMING, b"streaming already")
        elif self._stream.waiting():
            self._refuse(ERROR_STREAMING, b"samples of the last start still wait")
        else:
            self._stream.start(self._osr)

    def _configure(self, values):
        if len(values) < 4 or not _is_id(values[2]) or not _is_id(values[3]):
            self._refuse(ERROR_MALFORMED, b"configure takes stream and osr")
        elif self._stream.running:
            self._refuse(ERROR_STREAMING, b"not while streaming")
        elif values[2] != 0 or values[3] not in config.OSRS:
            self._refuse(ERROR_RANGE, b"stream 0, osr a power of two, 128 to 16384")
        else:
            self._osr = values[3]

    def _refuse(self, code, text):
        self._answer = ERROR
        self._code = code
        self._text = text

    def _reply(self, req_id):
        if self._answer == IDENT:
            self.identify(req_id)
        elif self._answer == REPLY:
            self._done(req_id)
        else:
            link = self._link
            link.begin(ERROR, 3)
            link.put_int(req_id)
            link.put_int(self._code)
            link.put_bytes(self._text, 3)
            link.send()

    def _done(self, req_id):
        link = self._link
        link.begin(REPLY, 4)
        link.put_int(req_id)
        link.put_int(0)
        link.put_int(1)
        link.put_bytes(b"")
        link.send()


def _is_id(value):
    """Whether a value is an integer of the range of identifiers (SPEC §6)."""
    return isinstance(value, int) and 0 <= value < SMALL
