"""Split bytes that arrive in arbitrary pieces into frames and everything else (SPEC §1). Nothing that arrives is lost.

The stream is split at the delimiters. A run between two delimiters is a frame if it decodes as COBS, its CRC matches
and it is an array that begins with a type and a frame count, as a reader of sessions demands (``session/frames.py``). Any other
run is console text, such as a traceback or a damaged frame. A frame of a type that only the host sends is also treated
as console text: a prompt or a terminal echoes its input.
Shared or repeated delimiters need no special handling, because empty runs are dropped.

Takes about 4 µs per frame of 200 bytes; a box at 4 kHz sends 310 per second.
"""

from __future__ import annotations

from typing import Any
from zlib import crc32

from cobs import cobs

from truearm.session.frames import decode, is_echo

MAX_RUN = 4096  # bytes; a longer run is not a frame and is returned in pieces
_ENCODED_MIN, _ENCODED_MAX = 8, 255  # payload 3 … 250, CRC 4, one byte of stuffing
_SEQ_END, _SEQ_HALF = 2**32, 2**31


class Runs:
    """The runs of bytes between delimiters in a stream that arrives in arbitrary pieces.

    A run beyond ``limit`` is returned in pieces, so memory stays below the limit and one piece of the stream.
    """

    def __init__(self, delimiter: bytes, limit: int) -> None:
        self._delimiter = delimiter
        self._limit = limit
        self._remainder = b""
        self._overlong = False  # part of the run in ``_remainder`` has been returned already

    def push(self, data: bytes) -> list[tuple[bool, bytes]]:
        """Return ``(whole, bytes)`` for every run finished by ``data``; pieces of a run beyond the limit are not whole."""
        *runs, self._remainder = (self._remainder + data).split(self._delimiter)
        items: list[tuple[bool, bytes]] = []
        for run in runs:
            if self._overlong or len(run) > self._limit:
                items += self._pieces(run)
                self._overlong = False
            elif run:
                items.append((True, run))
        if len(self._remainder) > self._limit:
            items += self._pieces(self._remainder)
            self._overlong, self._remainder = True, b""
        return items

    def flush(self) -> bytes:
        """Return what follows the last delimiter when the stream has ended."""
        remainder, self._remainder, self._overlong = self._remainder, b"", False
        return remainder

    def _pieces(self, run: bytes) -> list[tuple[bool, bytes]]:
        return [(False, run[k : k + self._limit]) for k in range(0, len(run), self._limit)]


class FrameCount:
    """Counts the frames that a link lost, and those behind the count, by the frames' own count (SPEC §4).

    A frame ahead of the count shows a loss, unless the next frame does not follow it: then its count was wrong (SPEC §1).
    """

    def __init__(self) -> None:
        self.lost = self.odd = 0
        self._next: int | None = None
        self._jump = 0  # of the last frame

    def clear(self) -> None:
        """Count from the next frame on."""
        self._next = None

    def take(self, seq: int) -> bool:
        """Count a frame; return whether it continues the count."""
        ahead = 0 if self._next is None else (seq - self._next + _SEQ_HALF) % _SEQ_END - _SEQ_HALF
        if ahead < 0:
            self.odd += 1
            skipped = ahead + self._jump + 1  # since the frame before the last one
            if skipped < 0 or ahead == -1:
                return False
            ahead, self.lost = skipped, self.lost - self._jump
        self.lost += ahead
        self._next, self._jump = seq + 1, ahead
        return True


class FrameSplitter:
    """Frames and console bytes of a stream, in order."""

    def __init__(self) -> None:
        self._runs = Runs(b"\0", MAX_RUN)

    def push(self, data: bytes) -> list[tuple[list[Any] | None, bytes]]:
        """Return the elements and the payload of each frame, and None and the bytes of any other run."""
        return [frame_of(run) if is_whole else (None, run) for is_whole, run in self._runs.push(data)]

    def flush(self) -> bytes:
        """Return the bytes after the last delimiter when the stream has ended or was cut."""
        return self._runs.flush()


def frame_of(run: bytes) -> tuple[list[Any] | None, bytes]:
    """Return the elements and the payload of the bytes between two delimiters; None and the bytes if they are no frame."""
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
