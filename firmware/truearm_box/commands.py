"""The host's requests. A sync request is answered without allocation; commands may allocate, as they are rare.

A command is executed once: if it is repeated with the req_id of the last (its answer was lost), it is only answered
again.
"""

from truearm_wire.cbor import CborError, decode
from truearm_wire.fast import micropython
from truearm_wire.messages import (
    BOOT_LOADER,
    CONFIGURE,
    COUNTER,
    ERROR,
    ERROR_MALFORMED,
    ERROR_RANGE,
    ERROR_STORAGE,
    ERROR_STREAMING,
    ERROR_UNKNOWN,
    GET_CONFIG,
    IDENT,
    IDENTIFY,
    PULSE,
    PUT_CONFIG,
    REPLY,
    RESET,
    SELF_TEST,
    START,
    STOP,
    SYNC_REPLY,
    SYNC_REQUEST,
    TO_REPL,
    pages,
    pages_of,
)

from .ident import plain

SMALL = 1 << 30
TEXT_MAX = 160  # of an error
EMPTY = pages(b"")


class Refused(Exception):
    """A command that is answered with an error with this code and text."""

    def __init__(self, code, text):
        super().__init__(text)
        self.code = code
        self.text = text


class Commands:
    def __init__(self, board, link, streams, health, settings):
        self._board = board
        self._link = link
        self._streams = streams
        self._health = health
        self._settings = settings
        self._last = 0  # req_id of the last command
        self._error = None  # it was refused
        self._document = EMPTY  # its pages are in the answer; None: it has none
        self._with_ident = False  # the ident is the answer, or follows it
        self._pages = ()  # (frame type, req_id, page, pages, data) of the current answer
        self._page = 0
        self._stop_id = 0  # of a stop that waits for its answer
        self.leaving = 0  # the command by which the box leaves its loop when everything is answered
        self.mode = 0  # of a reset
        self.bad = 0  # complete frames that are not commands

    def pending(self):
        """Return whether pages of an answer wait."""
        return self._page < len(self._pages)

    def identify(self, req_id):
        """Split the ident document into pages."""
        self._lay_out(_paged(IDENT, req_id, pages_of(self._settings.document())))

    def _lay_out(self, answer):
        self._pages = answer
        self._page = 0

    def send_page(self):
        kind, req_id, page, count, data = self._pages[self._page]
        self._page += 1
        link = self._link
        link.begin(kind, 4 if kind != ERROR else 3)
        link.put_int(req_id)
        if kind == ERROR:
            link.put_int(page)  # the code is in its place
            link.put_bytes(data, 3)
        else:
            link.put_int(page)
            link.put_int(count)
            link.put_bytes(data)
        link.send()

    def handle(self, buf, start, end, t1):
        """Answer the frame whose payload is buf[start:end] and whose beginning had arrived at device time t1."""
        if not self._usual_sync(buf, start, end, t1):
            self._unusual(buf, start, end, t1)

    def _unusual(self, buf, start, end, t1):
        self._health.make_room()
        try:
            values = decode(bytes(buf[start:end]))
        except CborError:
            values = None
        if not isinstance(values, list) or len(values) < 2 or not _is_id(values[0]) or not _is_id(values[1]):
            self.bad = (self.bad + 1) & COUNTER  # there is nobody to answer
        elif values[0] == SYNC_REQUEST:
            self._sync(values[1], t1)
        elif IDENTIFY <= values[0] < REPLY and values[1] > 0:
            self._command(values)
        else:
            self.bad = (self.bad + 1) & COUNTER

    @micropython.native
    def _usual_sync(self, buf, start, end, t1):
        """Answer [32, id] in its shortest form without allocating. Returns whether it was in that form."""
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
        link.put_time()
        link.send_stamped()

    def _command(self, values):
        if values[1] != self._last:
            self._last = values[1]
            self._execute(values)
        if values[0] == STOP and not self._error:
            self._stop_id = values[1]  # answered when all samples have been sent
        else:
            self._answer(self._last)

    def send_deferred(self):
        """Answer a stop, when no sample waits. Returns whether there was one to answer."""
        req_id = self._stop_id
        if not req_id or self._streams.waiting():
            return False
        self._stop_id = 0
        self._lay_out(_paged(REPLY, req_id, EMPTY))
        self.send_page()
        return True

    def _answer(self, req_id):
        if self._error:
            text = plain(self._error.text, TEXT_MAX).encode()
            self._lay_out([(ERROR, req_id, self._error.code, 0, text)])
            return
        answer = [] if self._document is None else _paged(REPLY, req_id, self._document)
        if self._with_ident:
            answer += _paged(IDENT, req_id, pages_of(self._settings.document()))
        self._lay_out(answer)

    def _execute(self, values):
        """Execute a command, and keep its answer."""
        self._error = None
        self._with_ident = False
        self._document = EMPTY
        do = _DO.get(values[0])
        try:
            if do is None:
                raise Refused(ERROR_UNKNOWN, "unknown command")
            do(self, values)
        except Refused as e:
            self._error = e
        except ValueError as e:  # values out of range; for a configuration, its text says which
            self._error = Refused(ERROR_RANGE, str(e))
        except OSError as e:
            self._error = Refused(ERROR_STORAGE, "the flash does not take it: %s" % e)
        except MemoryError:  # a configuration with many parts; they are freed here
            self._error = Refused(ERROR_RANGE, "it takes too much memory")

    def _identify(self, values):
        self._document = None
        self._with_ident = True

    def _configure(self, values):
        _need(values, 2, "configure takes stream and rate")
        self._need_rest()
        self._settings.set_rate(values[2], values[3])

    def _start(self, values):
        self._need_rest()
        if self._streams.waiting():
            raise Refused(ERROR_STREAMING, "samples of the last start still wait")
        self._settings.check_rates()
        self._streams.start(self._settings.osr, self._settings.mag_period_ns)

    def _stop(self, values):
        if self._streams.running:
            self._streams.stop()

    def _get_config(self, values):
        self._need_rest()
        self._document = pages_of(self._settings.config)

    def _put_config(self, values):
        if len(values) < 5 or not _is_id(values[2]) or not _is_id(values[3]) or not isinstance(values[4], bytes):
            raise Refused(ERROR_MALFORMED, "put-config takes page, pages and bytes")
        self._need_rest()
        self._with_ident = self._settings.put(values[2], values[3], values[4])

    def _self_test(self, values):
        self._need_rest()
        self._document = pages_of(self._settings.self_test())

    def _leave(self, values):
        if values[0] == RESET:
            _need(values, 1, "reset takes a mode")
            if values[2] > BOOT_LOADER:
                raise Refused(ERROR_RANGE, "modes are 0, restart, and 1, boot loader")
            self.mode = values[2]
        self._need_rest()
        self.leaving = values[0]

    def _pulse(self, values):
        _need(values, 1, "pulse takes a level")
        if values[2] > 1:
            raise Refused(ERROR_RANGE, "a level is 0 or 1")
        self._board.output(values[2])

    def _need_rest(self):
        if self._streams.running or self._streams.ending():
            raise Refused(ERROR_STREAMING, "not while streaming")


_DO = {
    IDENTIFY: Commands._identify,
    CONFIGURE: Commands._configure,
    START: Commands._start,
    STOP: Commands._stop,
    GET_CONFIG: Commands._get_config,
    PUT_CONFIG: Commands._put_config,
    SELF_TEST: Commands._self_test,
    TO_REPL: Commands._leave,
    RESET: Commands._leave,
    PULSE: Commands._pulse,
}


def _paged(kind, req_id, pages):
    return [(kind, req_id, page, count, data) for page, count, data in pages]


def _need(values, n, text):
    """Raise Refused unless n unsigned integers follow type and req_id."""
    if len(values) < 2 + n or not all(_is_id(value) for value in values[2 : 2 + n]):
        raise Refused(ERROR_MALFORMED, text)


def _is_id(value):
    """Return whether a value is an integer in the range of identifiers (SPEC §6)."""
    return isinstance(value, int) and 0 <= value < SMALL
