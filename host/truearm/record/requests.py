"""A box behind a link: split its bytes into frames (SPEC §1), and send it requests until they are answered.

Nothing that arrives is lost. The stream is split at the delimiters. A run between two delimiters is a frame if it
decodes as COBS, its CRC matches and it is an array that begins with a type and a frame count, as a reader of sessions
demands (``session/frames.py``). Any other run is console text, such as a traceback or a damaged frame. A frame of a
type that only the host sends is also treated as console text: a prompt or a terminal echoes its input. Empty runs are
dropped.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from typing import Any
from zlib import crc32

from cobs import cobs

from truearm.errors import LinkError, ProtocolError, RefusedError
from truearm.record.links import Clock, Link, Runs
from truearm.session.frames import Ident, Pages, decode, decode_ident, is_echo
from truearm_wire import messages as wire
from truearm_wire.frame import frame
from truearm_wire.messages import encode_payload

MAX_RUN = 4096  # bytes; a longer run is not a frame and is returned in pieces
_ENCODED_MIN, _ENCODED_MAX = 8, 255  # payload 3 … 250, CRC 4, one byte of stuffing
_SEQ_END, _SEQ_HALF = 2**32, 2**31


class FrameCount:
    """Counts the frames that a link lost, and those behind the count, by the frames' own count (SPEC §4).

    A frame ahead of the count shows a loss, unless the next frame does not follow it: then its count was wrong (SPEC
    §1).
    """

    def __init__(self) -> None:
        self.lost = self.odd = 0
        self._next: int | None = None
        self._last_skipped = 0  # by the last frame

    def clear(self) -> None:
        """Count from the next frame on."""
        self._next = None

    def take(self, seq: int) -> bool:
        """Count a frame; return whether it continues the count, and is neither behind it nor the last one again."""
        skipped = 0 if self._next is None else (seq - self._next + _SEQ_HALF) % _SEQ_END - _SEQ_HALF
        if skipped < 0:
            self.odd += 1
            is_repeated = skipped == -1
            skipped += self._last_skipped + 1  # since the frame before the last one, whose own count was wrong
            if skipped < 0 or is_repeated:
                return False
            self.lost -= self._last_skipped
        self.lost += skipped
        self._next, self._last_skipped = seq + 1, skipped
        return True


class FrameSplitter:
    """Frames and console bytes of a stream, in order. Takes about 4 µs per frame of 200 bytes."""

    def __init__(self) -> None:
        self._runs = Runs(b"\0", MAX_RUN)

    def push(self, data: bytes) -> list[tuple[list[Any] | None, bytes]]:
        """Return the elements and the payload of each frame, and None and the bytes of any other run."""
        return [frame_of(run) if is_whole else (None, run) for is_whole, run in self._runs.push(data)]

    def flush(self) -> bytes:
        """Return the bytes after the last delimiter when the stream has ended or was cut."""
        return self._runs.flush()


def frame_of(run: bytes) -> tuple[list[Any] | None, bytes]:
    """Return the elements and the payload of the bytes between two delimiters.

    None and the bytes if they are no frame.
    """
    if _ENCODED_MIN <= len(run) <= _ENCODED_MAX:
        try:
            raw: bytes = cobs.decode(run)
        except cobs.DecodeError:
            return None, run
        payload = raw[:-4]
        frame = decode(payload) if crc32(payload) == int.from_bytes(raw[-4:], "little") else None
        if frame is not None and not is_echo(frame):
            return frame, payload
    return None, run


# ------------------------------------------------------------------------------------------------------------- requests

SECOND = 1_000_000_000
RETRY_NS = SECOND // 2
RETRIES = 10  # 5 s: a newly connected box waits 2 s before it runs
COMMANDS = range(48, 64)  # SPEC §6
NAMES = {number: name.lower().replace("_", "-") for name, number in vars(wire).items() if number in COMMANDS}

CTRL_C = 3
_ID_END = 2**29  # SPEC §6 allows 2^30
# one in 20 has it by chance; a configuration page may contain it whatever the id is, but it follows an answer
_TRIES = 64


class NoAnswerError(LinkError):
    """The box does not answer, though the link is intact."""


class Requests:
    """Makes requests, each with its own id, and takes the answers.

    The box may still remember a command of an earlier session by its id (SPEC §6), so ids are drawn at random. For two
    seconds after power-on, a Pico treats byte 3 as Ctrl-C, which leads to MicroPython's prompt, where the box would
    stay: ids that would give such a byte anywhere in the frame are drawn again. A request is repeated with the same id
    until it is answered; the box treats repetitions as one request.

    ``pump`` reads the link for a time [s] and passes what arrives to ``take``. ``ident`` is the box's latest
    description of itself.
    """

    def __init__(self, link: Link, clock: Clock, pump: Callable[[float], None]) -> None:
        self.ident: Ident | None = None
        self._link = link
        self._clock = clock
        self._pump = pump
        self._ids = random.Random(clock.now_ns())
        self._awaited: int | None = None
        self._answers: dict[int, bytes | RefusedError] = {}  # the document of a reply
        self._pages = {kind: Pages() for kind in (wire.IDENT, wire.REPLY)}

    def ask(self, kind: int, *arguments: Any, retries: int = RETRIES, retry_ns: int = RETRY_NS) -> bytes:
        """Send a request until it is answered; return the document in the answer, b"" in most.

        Raises NoAnswerError, RefusedError.
        """
        self._awaited, data = self.make(kind, *arguments)
        self._answers.clear()
        for _ in range(retries):
            self._link.write(data)
            left_ns, deadline_ns = retry_ns, self._clock.now_ns() + retry_ns
            while left_ns > 0:
                # on a busy machine the time may already be over although the answer has arrived
                left_ns = deadline_ns - self._clock.now_ns()
                self._pump(max(left_ns, 0) / SECOND)
                answer = self._answers.get(self._awaited)
                if isinstance(answer, RefusedError):
                    request = " ".join([NAMES[kind], *(str(number) for number in arguments if isinstance(number, int))])
                    raise RefusedError(answer.code, f"{self._link.name}: the box refuses {request!r}: {answer}")
                if answer is not None:
                    return answer
        seconds = retries * retry_ns / SECOND
        raise NoAnswerError("no-answer", place=self._link.name, request=NAMES[kind], seconds=seconds)

    def identified(self) -> Ident:
        """Return the box's description of itself after an answer. Raises ProtocolError if it gave none."""
        if self.ident is None:
            raise ProtocolError("old-firmware", place=self._link.name, reason="answers but does not identify itself")
        return self.ident

    def take(self, kind: int, fields: Mapping[str, Any]) -> None:
        """Take an ident, a reply or an error of the box. Raises ProtocolError for an ident that cannot be used."""
        document: bytes | RefusedError | None
        if kind == wire.ERROR:
            document = RefusedError(fields["code"], fields["text"][:200])
        else:
            document = self._pages[kind].push(fields["req_id"], fields["page"], fields["pages"], fields["data"])
        if kind == wire.IDENT and isinstance(document, bytes):
            self.ident = decode_ident(document)
        if fields["req_id"] == self._awaited and document is not None:
            self._answers[fields["req_id"]] = document

    def make(self, kind: int, *arguments: Any) -> tuple[int, bytes]:
        """Return the id and the frame of the next request."""
        for _ in range(_TRIES):
            number = self._ids.randrange(1, _ID_END)
            data = frame(encode_payload([kind, number, *arguments]))
            if CTRL_C not in data:
                break
        return number, data
