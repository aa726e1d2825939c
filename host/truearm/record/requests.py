"""Make frames for the box, with ids taken from the clock and without any byte that would stop a booting box.

The box may still remember a command of an earlier session by its id (SPEC §6), so ids are taken from the host's
milliseconds. For two seconds after power-on, a Pico treats byte 3 as Ctrl-C, which leads to MicroPython's prompt, where
the box would stay. An id therefore contains no byte 3 (its bytes are base-255 digits that leave out 3), and ids that
would give a byte 3 in the checksum are skipped. Otherwise every id during some hours of the day would contain it, and a
box connected then would not start.
"""

from __future__ import annotations

from typing import Any

from truearm_wire.frame import frame
from truearm_wire.messages import encode_payload

CTRL_C = 3
_DIGITS = 255
_TOP = 31  # number of values of the fourth byte: ids stay below 2^29, SPEC §6 allows 2^30
_COUNTS = _DIGITS**3 * _TOP - 1
# one in 40 has it by chance; a configuration page may contain it whatever the id is, but it follows an answer
_TRIES = 64


class Requests:
    """Makes requests, each with its own id."""

    def __init__(self, now_ns: int) -> None:
        self._count = now_ns // 1_000_000 % _COUNTS

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
