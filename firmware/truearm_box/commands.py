"""What the host may ask. A sync request is answered without allocation; commands may allocate, they are rare.

A command is executed once: one that comes again with the req_id of the last (its answer was lost) is only answered again.
"""

from truearm_wire import PROTOCOL
from truearm_wire.cbor import CborError, encode
from truearm_wire.messages import (
    CONFIGURE,
    ERROR,
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
    decode_payload,
    pages,
)

from . import VERSION, config

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
        self._deferred = False
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
        self._health.untidy = True

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
        if end - start >= 4 and buf[start] == 0x82 and buf[start + 1] == 0x18 and buf[start + 2] == SYNC_REQUEST:
            self._sync(buf, start + 3, end, t1)
            return
        self._health.untidy = True
        try:
            values = decode_payload(bytes(buf[start:end]))
        except CborError:
            self.bad += 1
            return
        if values[0] == SYNC_REQUEST or values[0] < IDENTIFY or len(values) < 2 or not 0 < _small(values[1]) < SMALL:
            self.bad += 1  # there is no one to answer
            return
        if values[1] != self._last:
            self._last = values[1]
            self._execute(values)
        if values[0] == STOP:
            self._deferred = True  # what was sampled goes first
        else:
            self._reply()

    def send_deferred(self):
        """Answer a stop, now that no block waits. Returns whether there was one to answer."""
        if not self._deferred:
            return False
        self._deferred = False
        self._reply()
        return True

    def _sync(self, buf, at, end, t1):
        n = buf[at]
        width = 0 if n < 24 else 1 if n == 24 else 2 if n == 25 else 4 if n == 26 else 9
        if at + 1 + width > end or (width == 4 and buf[at + 1] > 63):
            self.bad += 1
            return
        if width:
            n = 0
            for i in range(width):
                n = n << 8 | buf[at + 1 + i]
        link = self._link
        link.begin(SYNC_REPLY, 3)
        link.put_int(n)
        link.put_u64(t1)
        self._board.now(self._t2)
        link.put_u64(self._t2)
        link.send()

    def _execute(self, values):
        self._answer = REPLY
        kind = values[0]
        if kind == IDENTIFY:
            self._answer = IDENT
        elif kind == CONFIGURE:
            self._configure(values)
        elif kind == START:
            if self._stream.running:
                self._refuse(ERROR_STREAMING, b"streaming already")
            else:
                self._stream.start(self._osr)
        elif kind == STOP:
            if self._stream.running:
                self._stream.stop()
        else:
            self._refuse(ERROR_UNKNOWN, b"unknown command")

    def _configure(self, values):
        if self._stream.running:
            self._refuse(ERROR_STREAMING, b"not while streaming")
        elif values[2] != 0 or values[3] not in config.OSRS:
            self._refuse(ERROR_RANGE, b"stream 0, osr a power of two, 128 to 16384")
        else:
            self._osr = values[3]

    def _refuse(self, code, text):
        self._answer = ERROR
        self._code = code
        self._text = text

    def _reply(self):
        link = self._link
        if self._answer == IDENT:
            self.identify(self._last)
            return
        if self._answer == REPLY:
            link.begin(REPLY, 4)
            link.put_int(self._last)
            link.put_int(0)
            link.put_int(1)
            link.put_bytes(b"")
        else:
            link.begin(ERROR, 3)
            link.put_int(self._last)
            link.put_int(self._code)
            link.put_bytes(self._text, 3)
        link.send()


def _small(value):
    return value if isinstance(value, int) else 0
