"""Communicate with a box outside a recording: open a conversation, commands and answers, and frames sent meanwhile.

As in the recorder, time comes from the clock and passes only in ``Link.read``, so all of this also runs in the
simulator's virtual time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

import cbor2
import numpy as np
from numpy.typing import NDArray

from truearm.errors import Argument, LinkError, ProtocolError, RefusedError
from truearm.progress import step
from truearm.record.links import Clock, HostClock, Link, SerialLink
from truearm.record.requests import NAMES, RETRIES, SECOND, FrameCount, FrameSplitter, NoAnswerError, Requests
from truearm.session.frames import Data, Ident, Stream, data_of, load_document, named_elements
from truearm.session.samples import counts_of
from truearm.units import NS
from truearm_wire import messages as wire
from truearm_wire.cbor import CborError, encode
from truearm_wire.messages import START, STOP

SELF_TEST_RETRY_NS = 4 * SECOND  # it takes measurements for about a second
CONFIG_PAGES_MAX = 16  # accepted by a box
MAX_WAITING = 20_000  # unread frames; the oldest are dropped
_READ_S = 0.05
SETTLE_S = 0.2  # for the converter's filter to fill and the operator's hand to leave the stage
PATIENCE_S = 5.0
FEWEST = 16  # fewest samples for a mean and its error
STREAMING = 4  # error code, protocol/SPEC.md §4


class Sent(NamedTuple):
    """A frame sent by the box and its arrival time on the host.

    ``data``: of samples; ``fields``: the elements by name.
    """

    t_host_ns: int
    kind: int
    data: Data | None
    fields: dict[str, Any]


class BoxControl:
    """The host's side of the communication with a box.

    ``console_bytes`` counts bytes outside frames, ``frame_count`` the frames that are lost. ``heartbeat`` is the latest
    one, by name.
    """

    def __init__(self, link: Link, clock: Clock) -> None:
        self.console_bytes = 0
        self.frame_count = FrameCount()
        self.heartbeat: dict[str, Any] = {}
        self._link = link
        self._clock = clock
        self._requests = Requests(link, clock, self._pump)
        self._splitter = FrameSplitter()
        self._waiting: deque[Sent] = deque(maxlen=MAX_WAITING)

    @property
    def ident(self) -> Ident:
        """The box's latest description of itself. Raises as ``identify`` does if it has given none."""
        return self._requests.ident or self.identify()

    # --- requests

    def identify(self, retries: int = RETRIES) -> Ident:
        """Ask for the ident.

        Raises LinkError if the box does not answer, ProtocolError if it speaks another protocol.
        """
        self.command(wire.IDENTIFY, retries=retries)
        return self._requests.identified()

    def command(self, kind: int, *arguments: Any, **repetition: int) -> bytes:
        """Send a command and return the document in its answer, b"" for most commands; ``repetition`` as of ``ask``.

        Raises LinkError if there is no answer, RefusedError if the box refuses.
        """
        with step(f"waiting for the box to answer {NAMES[kind]!r}"):
            return self._requests.ask(kind, *arguments, **repetition)

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
        """Restart the box, or have it enter its boot loader.

        The link may be lost in the process; that is not an error.
        """
        try:
            self.command(wire.RESET, mode)
        except (RefusedError, NoAnswerError):
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

    def _pump(self, timeout_s: float) -> None:
        for t_host_ns, data in self._link.read(min(timeout_s, _READ_S)):
            for frame, item in self._splitter.push(data):
                if frame is None:
                    self.console_bytes += len(item)
                else:
                    self._take(t_host_ns, frame)

    def _take(self, t_host_ns: int, frame: list[Any]) -> None:
        kind, seq = frame[:2]
        if not self.frame_count.take(seq):
            self.frame_count.clear()  # of a restarted box
        fields = named_elements(frame)
        if fields is None:
            return
        if kind in (wire.IDENT, wire.REPLY, wire.ERROR):
            self._requests.take(kind, fields)
            return
        if kind == wire.HEARTBEAT:
            self.heartbeat = fields
        self._waiting.append(Sent(t_host_ns, kind, data_of(frame) if kind == wire.DATA else None, fields))


@contextmanager
def conversation(device: str, stop: bool = False, retries: int = RETRIES) -> Iterator[BoxControl]:
    """Open a conversation with the box at ``device``, identify it, and with ``stop`` end its streaming.

    Raises LinkError, ProtocolError. If the box refuses because it is streaming, the error tells the user what to do.
    """
    clock = HostClock()
    link = SerialLink(device, clock)
    try:
        box = BoxControl(link, clock)
        box.identify(retries)
        if stop:
            box.command(STOP)
        yield box
    except RefusedError as exc:
        if exc.code == STREAMING:
            advice = (Argument("stop"), " if nothing records it")
            raise RefusedError(
                STREAMING, f"{device}: the box is streaming; end the recording first, or give ", *advice
            ) from exc
        raise
    finally:
        link.close()


@contextmanager
def streaming(box: BoxControl) -> Iterator[None]:
    """Start the box, and stop it at the end, also after Ctrl-C while it starts; not if it refuses to start.

    A box that refuses streams for a recording already.
    """
    with ExitStack() as stack:
        stack.callback(box.command, STOP)
        try:
            box.command(START)
        except RefusedError:
            stack.pop_all()
            raise
        yield


def sample(box: BoxControl, stream: Stream, seconds: float) -> NDArray[np.int32]:
    """Return counts (n, channels) of a stream over the given number of seconds. The box is started and stopped.

    Raises LinkError if too few samples arrive.
    """
    skip, n_needed = (max(1, round(NS.of(duration) / stream.period_ns)) for duration in (SETTLE_S, seconds))
    n_needed, patience_s = max(n_needed, FEWEST), SETTLE_S + seconds + PATIENCE_S
    blocks: list[NDArray[np.int32]] = []
    n_samples, end_s = 0, box.now_s + patience_s
    with streaming(box), step(f"sampling {stream.name} for {seconds:g} s") as advance:
        while n_samples < n_needed and box.now_s < end_s:
            for data in (sent.data for sent in box.sent(0.05)):
                counts = counts_of(data, stream) if data and data.stream == stream.id and data.n0 >= skip else None
                blocks += [] if counts is None else [counts]
            n_samples = sum(map(len, blocks))
            advance(min(n_samples / n_needed, 1.0))
    for _ in box.sent(0.0):  # data in transit
        continue
    if n_samples < n_needed:
        raise LinkError("link-lost", n=n_samples, needed=n_needed, stream=stream.name, seconds=patience_s)
    return np.concatenate(blocks)[:n_needed]


def one_line_of(ident: Ident) -> str:
    """Describe a box in a few words."""
    document = ident.document
    board = f" on {document['board']}" if isinstance(document.get("board"), str) else ""
    return f"truearm box {document.get('uid', '')!s:.32}, firmware {ident.firmware:.32}{board[:40]}"
