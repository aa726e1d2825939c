"""Send requests to the box until they are answered; without any byte that would stop a booting box.

The box may still remember a command of an earlier session by its id (SPEC §6), so ids are drawn at random. For two
seconds after power-on, a Pico treats byte 3 as Ctrl-C, which leads to MicroPython's prompt, where the box would stay:
ids that would give such a byte anywhere in the frame are drawn again.

A request is repeated with the same id until it is answered; the box treats repetitions as one request.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from typing import Any

from truearm.errors import LinkError, ProtocolError, RefusedError
from truearm.record.links import Clock, Link
from truearm.session.frames import Ident, Pages, decode_ident
from truearm_wire import messages as wire
from truearm_wire.frame import frame
from truearm_wire.messages import encode_payload

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

    ``pump`` reads the link for a time [s] and passes what arrives to ``take``. ``ident`` is the box's latest description
    of itself.
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
