"""Communicate with a box outside a recording: commands and their answers, paged documents, and frames sent meanwhile.

As in the recorder, time comes from the clock and passes only in ``Link.read``, so all of this also runs in the
simulator's virtual time. A command is repeated with the same id until it is answered; the box treats repetitions as one
command (SPEC §6).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import cbor2

from truearm.errors import LinkError, ProtocolError, RefusedError
from truearm.progress import step
from truearm.record.frame_splitter import FrameCount, FrameSplitter, frame_head
from truearm.record.links import Clock, Link
from truearm.record.requests import Requests
from truearm.session.box_ident import Ident, decode_ident, load_document
from truearm.session.frames import Data, Pages, data_frame, fields_of
from truearm_wire import messages as wire
from truearm_wire.cbor import CborError, encode

SECOND = 1_000_000_000
RETRY_NS = SECOND // 2
RETRIES = 10  # 5 s: a newly connected box waits 2 s before it runs
SELF_TEST_RETRY_NS = 4 * SECOND  # it takes measurements for about a second
CONFIG_PAGES_MAX = 16  # accepted by a box
MAX_WAITING = 20_000  # unread frames; the oldest are dropped
_READ_S = 0.05

NAMES = {
    wire.IDENTIFY: "identify",
    wire.CONFIGURE: "configure",
    wire.START: "start",
    wire.STOP: "stop",
    wire.GET_CONFIG: "get-config",
    wire.PUT_CONFIG: "put-config",
    wire.SELF_TEST: "self-test",
    wire.TO_REPL: "to-repl",
    wire.RESET: "reset",
    wire.PULSE: "pulse",
}


class Sent(NamedTuple):
    """A frame sent by the box and its arrival time on the host; ``data`` for samples, else the elements by name."""

    t_host_ns: int
    kind: int
    data: Data | None
    fields: dict[str, Any]


class NoAnswer(LinkError):
    """The box does not answer, though the link is intact."""


class BoxControl:
    """The host's side of the communication with a box.

    ``ident`` is the box's latest description of itself. ``console_bytes`` counts bytes outside frames, ``frame_count``
    the frames that are lost. ``heartbeat`` is the latest one, by name.
    """

    def __init__(self, link: Link, clock: Clock) -> None:
        self.ident: Ident | None = None
        self.console_bytes = 0
        self.frame_count = FrameCount()
        self.heartbeat: dict[str, Any] = {}
        self._link = link
        self._clock = clock
        self._requests = Requests(clock.now_ns())
        self._splitter = FrameSplitter()
        self._ident_pages, self._reply_pages = Pages(), Pages()
        self._waiting: deque[Sent] = deque(maxlen=MAX_WAITING)
        self._awaited = 0
        self._reply: bytes | None = None
        self._error: tuple[int, str] | None = None
        self._identified = 0  # the req_id of the last ident

    # --- requests

    def identify(self, retries: int = RETRIES) -> Ident:
        """Ask for the ident. Raises LinkError if the box does not answer, ProtocolError if it speaks another protocol."""
        self._send(wire.IDENTIFY, (), lambda: self._identified == self._awaited, RETRY_NS, retries)
        if self.ident is None:
            raise ProtocolError("old-firmware", place=self._link.name, reason="answers but does not identify itself")
        return self.ident

    def command(self, kind: int, *arguments: Any, retry_ns: int = RETRY_NS, retries: int = RETRIES) -> bytes:
        """Send a command and return the document in its answer, b"" for most commands.

        Raises LinkError if there is no answer, RefusedError if the box refuses.
        """
        self._send(kind, arguments, lambda: self._reply is not None, retry_ns, retries)
        return self._reply or b""

    def config(self) -> dict[str, Any]:
        """Return the box's configuration (SPEC §5)."""
        return self._document(self.command(wire.GET_CONFIG), "configuration")

    def put_config(self, config: dict[str, Any]) -> Ident:
        """Store a configuration in the box and return the ident that follows.

        Raises as ``command`` does, and ProtocolError if it is too long.
        """
        try:
            pages = wire.pages(encode(config))
        except CborError as exc:
            raise ProtocolError(f"the configuration cannot be sent: {exc}") from exc
        if len(pages) > CONFIG_PAGES_MAX:
            raise ProtocolError(
                f"the configuration is too long: {len(pages)} pages; a box accepts {CONFIG_PAGES_MAX}; shorten names and serial numbers"
            )
        for page, count, data in pages:
            self.command(wire.PUT_CONFIG, page, count, data)
        return self.identify()

    def self_test(self) -> dict[str, Any]:
        """Run the self-test and return the results (SPEC §5) by name."""
        return self._document(self.command(wire.SELF_TEST, retry_ns=SELF_TEST_RETRY_NS, retries=3), "self-test")

    def reset(self, mode: int) -> None:
        """Restart the box, or have it enter its boot loader. The link may be lost in the process; that is not an error."""
        try:
            self.command(wire.RESET, mode)
        except (RefusedError, NoAnswer):
            raise
        except LinkError:
            return

    @property
    def now_s(self) -> float:
        """Return the host's time [s]."""
        return self._clock.now_ns() / SECOND

    def probe(self) -> tuple[int, int]:
        """Send a clock request; return its id and the host time before it [ns]. The answer arrives as a frame."""
        number, data = self._requests.make(wire.SYNC_REQUEST)
        return number, self._link.write(data)

    def sent(self, timeout_s: float) -> Iterator[Sent]:
        """Return the frames that arrived, waiting up to ``timeout_s`` for the first bytes."""
        if not self._waiting:
            self._pump(timeout_s)
        while self._waiting:
            yield self._waiting.popleft()

    # --- transport

    def _document(self, data: bytes, title: str) -> dict[str, Any]:
        try:
            document = load_document(data)
        except cbor2.CBORError as exc:
            raise ProtocolError(
                "old-firmware", place=self._link.name, reason=f"sends a {title} that cannot be decoded ({exc})"
            ) from exc
        if not isinstance(document, dict) or not all(isinstance(key, str) for key in document):
            raise ProtocolError("old-firmware", place=self._link.name, reason=f"sends a {title} that is not a table")
        return document

    def _send(
        self, kind: int, arguments: tuple[Any, ...], answered: Callable[[], bool], retry_ns: int, retries: int
    ) -> None:
        self._awaited, data = self._requests.make(kind, *arguments)
        self._reply = self._error = None
        with step(f"waiting for the box to answer {NAMES[kind]!r}"):
            for _ in range(retries):
                self._link.write(data)
                left_ns = retry_ns
                deadline_ns = self._clock.now_ns() + retry_ns
                while left_ns > 0:
                    # on a busy machine the time may already be over although the answer has arrived
                    left_ns = deadline_ns - self._clock.now_ns()
                    self._pump(min(max(left_ns, 0) / SECOND, _READ_S))
                    self._check_refused(NAMES[kind])
                    if answered():
                        return
        raise NoAnswer("no-answer", place=self._link.name, request=NAMES[kind], seconds=retries * retry_ns / SECOND)

    def _check_refused(self, name: str) -> None:
        if self._error is not None:
            code, text = self._error
            raise RefusedError(code, f"{self._link.name}: the box refuses {name!r}: {text[:200]}")

    def _pump(self, timeout_s: float) -> None:
        for t_host_ns, data in self._link.read(timeout_s):
            for is_frame, item in self._splitter.push(data):
                if is_frame:
                    self._take(t_host_ns, item)
                else:
                    self.console_bytes += len(item)

    def _take(self, t_host_ns: int, payload: bytes) -> None:
        kind, seq = frame_head(payload)
        if seq is not None and not self.frame_count.take(seq):
            self.frame_count.clear()  # of a restarted box
        if kind == wire.DATA:
            data = data_frame(payload)
            if data is not None:
                self._waiting.append(Sent(t_host_ns, kind, data, {}))
            return
        fields = None if kind is None else fields_of(kind, payload)
        if kind is None or fields is None:
            return
        if kind == wire.IDENT:
            self._take_ident(fields)
        elif kind == wire.REPLY:
            document = self._reply_pages.push(fields["req_id"], fields["page"], fields["pages"], fields["data"])
            if document is not None and fields["req_id"] == self._awaited:
                self._reply = document
        elif kind == wire.ERROR:
            if fields["req_id"] == self._awaited:
                self._error = fields["code"], fields["text"]
        else:
            if kind == wire.HEARTBEAT:
                self.heartbeat = fields
            self._waiting.append(Sent(t_host_ns, kind, None, fields))

    def _take_ident(self, fields: dict[str, Any]) -> None:
        document = self._ident_pages.push(fields["req_id"], fields["page"], fields["pages"], fields["data"])
        if document is not None:
            self.ident = decode_ident(document)
            self._identified = fields["req_id"]
