"""Send requests to the box until they are answered; without any byte that would stop a booting box.

The box may still remember a command of an earlier session by its id (SPEC §6), so ids are taken from the host's
milliseconds. For two seconds after power-on, a Pico treats byte 3 as Ctrl-C, which leads to MicroPython's prompt, where
the box would stay. An id therefore contains no byte 3 (its bytes are base-255 digits that leave out 3), and ids that
would give a byte 3 in the checksum are skipped. Otherwise every id during some hours of the day would contain it, and a
box connected then would not start.

A request is repeated with the same id until it is answered; the box treats repetitions as one request.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from truearm.errors import LinkError, ProtocolError, RefusedError
from truearm.record.links import Clock, Link
from truearm.session.box_ident import Ident, decode_ident
from truearm.session.frames import Pages
from truearm_wire import messages as wire
from truearm_wire.frame import frame
from truearm_wire.messages import encode_payload

SECOND = 1_000_000_000
RETRY_NS = SECOND // 2
RETRIES = 10  # 5 s: a newly connected box waits 2 s before it runs
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

CTRL_C = 3
_DIGITS = 255
_TOP = 31  # number of values of the fourth byte: ids stay below 2^29, SPEC §6 allows 2^30
_COUNTS = _DIGITS**3 * _TOP - 1
# one in 40 has it by chance; a configuration page may contain it whatever the id is, but it follows an answer
_TRIES = 64


class NoAnswerError(LinkError):
    """The box does not answer, though the link is intact."""


class Requests:
    """Makes requests, each with its own id, and takes the answers.

    ``pump`` reads the link for a time [s] and passes what arrives to ``take``. ``ident`` is the box's latest description
    of itself.
    """

    def __init__(self, link: Link, clock: Clock, pump: Callable[[float], None]) -> None:
        self.ident: Ident | None = None
        self._link = link
        self._clock = clock
        self._pump = pump
        self._count = clock.now_ns() // 1_000_000 % _COUNTS
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
            self._count = (self._count + 1) % _COUNTS
            number = id_of(self._count)
            data = frame(encode_payload([kind, number, *arguments]))
            if CTRL_C not in data:
                break
        return number, data


def id_of(count: int) -> int:
    """Return an id, 1 … 2^29 − 1, without a byte of 3; it differs for every count from 0 to 255³ · 31 − 2."""
    count += 1
    number = 0
    for place in range(4):
        count, digit = divmod(count, _DIGITS)
        number |= (digit + (digit >= CTRL_C)) << 8 * place
    return number
