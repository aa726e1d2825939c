"""Frames to the box: ids that go on from the clock, and no byte that would stop a box which is just booting.

The box may still remember, by its id, a command of an earlier session (SPEC §6), so ids are taken from the host's milliseconds. For
two seconds after power-on a Pico's byte 3 is Ctrl-C, the way to MicroPython's prompt, where the box would stay. So an id
has no byte 3 (its bytes are digits to the base 255, which leave 3 out), and one by which the checksum has is passed over.
Without this every id of some hours a day had it, and a box that was plugged in meanwhile did not come up.
"""

from __future__ import annotations

from typing import Any

from truearm_wire.frame import frame
from truearm_wire.messages import encode_payload

CTRL_C = 3
_DIGITS = 255
_TOP = 31  # of the fourth byte: ids stay below 2^29, SPEC §6 allows 2^30
_COUNTS = _DIGITS**3 * _TOP - 1
# one in 40 has it by chance; a page of a configuration may hold it whatever the id is, but follows an answer
_TRIES = 64


class Requests:
    """Requests, each with an id of its own."""

    def __init__(self, now_ns: int) -> None:
        self._count = now_ns // 1_000_000 % _COUNTS

    def make(self, kind: int, *arguments: Any) -> tuple[int, bytes]:
        """The id and the frame of the next request."""
        for _ in range(_TRIES):
            self._count = (self._count + 1) % _COUNTS
            number = id_of(self._count)
            data = frame(encode_payload([kind, number, *arguments]))
            if CTRL_C not in data:
                break
        return number, data


def id_of(count: int) -> int:
    """An id, 1 … 2^29 − 1, none of whose bytes is 3; another for every count from 0 to 255³ · 31 − 2."""
    count += 1
    number = 0
    for place in range(4):
        count, digit = divmod(count, _DIGITS)
        number |= (digit + (digit >= CTRL_C)) << 8 * place
    return number
