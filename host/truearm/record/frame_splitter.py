"""Split bytes that arrive in arbitrary pieces into frames and everything else (SPEC §1). Nothing that arrives is lost.

The stream is split at the delimiters. A run between two delimiters is a frame if it decodes as COBS, its CRC matches
and it is an array that begins with a frame type. Any other run is console text, such as a traceback or a damaged frame.
A frame of a type that only the host sends is also treated as console text: a prompt or a terminal echoes its input, and
the second element of a request is not a frame count.
Shared or repeated delimiters need no special handling, because empty runs are dropped.

Takes about 1.5 µs per frame of 200 bytes; a box at 4 kHz sends 310 per second.
"""

from __future__ import annotations

from zlib import crc32

from cobs import cobs

from truearm_wire.messages import SYNC_REQUEST

MAX_RUN = 4096  # bytes; a longer run is not a frame and is returned in pieces of this size
_ENCODED_MIN, _ENCODED_MAX = 8, 255  # payload 3 … 250, CRC 4, one byte of stuffing
_LARGEST_TYPE = 255
_SEQ_END, _SEQ_HALF = 2**32, 2**31
_FROM_HOST = frozenset({SYNC_REQUEST, *range(48, 64)})  # SPEC §6: requests, and commands of any minor version

_UINT_WIDTH = dict.fromkeys(range(0x18), 0) | {0x18: 1, 0x19: 2, 0x1A: 4, 0x1B: 8}  # bytes after the first


class Runs:
    """The runs of bytes between delimiters in a stream that arrives in arbitrary pieces; memory stays below ``limit``.

    The runs do not depend on how the stream was split.
    """

    def __init__(self, delimiter: bytes, limit: int) -> None:
        self._delimiter = delimiter
        self._limit = limit
        self._remainder = b""
        self._overlong = False  # part of the run in ``_remainder`` has been returned already

    def push(self, data: bytes) -> list[tuple[bool, bytes]]:
        """Return ``(whole, bytes)`` for every run finished by ``data``; pieces of a run beyond the limit are not whole."""
        runs = data.split(self._delimiter)
        runs[0] = self._remainder + runs[0]
        self._remainder = runs.pop()
        items: list[tuple[bool, bytes]] = []
        for run in runs:
            if self._overlong or len(run) > self._limit:
                items += [(False, piece) for piece in self._pieces(run)]
                self._overlong = False
            elif run:
                items.append((True, run))
        if len(self._remainder) > self._limit:
            *full, self._remainder = self._pieces(self._remainder)
            items += [(False, piece) for piece in full]
            self._overlong = True
        return items

    def flush(self) -> bytes:
        """Return what follows the last delimiter when the stream has ended."""
        remainder, self._remainder, self._overlong = self._remainder, b"", False
        return remainder

    def _pieces(self, run: bytes) -> list[bytes]:
        return [run[i : i + self._limit] for i in range(0, len(run), self._limit)]


class FrameCount:
    """Counts the frames that a link lost, and those out of place, by the frames' own count.

    A frame ahead of the count shows a loss, unless the next frame does not follow it: then it was damaged, and nothing is lost.
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

    def push(self, data: bytes) -> list[tuple[bool, bytes]]:
        """Return ``(True, payload)`` for each frame and ``(False, bytes)`` for any other run."""
        items: list[tuple[bool, bytes]] = []
        for is_whole, run in self._runs.push(data):
            payload = payload_of(run) if is_whole else None
            items.append((False, run) if payload is None else (True, payload))
        return items

    def flush(self) -> bytes:
        """Return the bytes after the last delimiter when the stream has ended or was cut."""
        return self._runs.flush()


def payload_of(run: bytes) -> bytes | None:
    """Return the payload of the bytes between two delimiters, None if they are not a frame."""
    if not _ENCODED_MIN <= len(run) <= _ENCODED_MAX:
        return None
    try:
        raw: bytes = cobs.decode(run)
    except cobs.DecodeError:
        return None
    payload = raw[:-4]
    if len(payload) < 3 or crc32(payload) != int.from_bytes(raw[-4:], "little"):
        return None
    kind, _ = frame_head(payload)
    return None if kind is None or kind in _FROM_HOST else payload


def frame_head(payload: bytes) -> tuple[int | None, int | None]:
    """Return the type of a payload and its second element, the frame count of its link.

    Both are None if it is not an array of definite length that begins with a small integer; the count is None if it is
    not an unsigned integer.
    """
    first = payload[0] if payload else 0
    offset = 1 if 0x81 <= first <= 0x97 else 2 if first == 0x98 and payload[1:2] > b"\0" else len(payload)
    numbers: list[int] = []
    while len(numbers) < 2 and offset < len(payload):
        width = _UINT_WIDTH.get(payload[offset])
        if width is None or offset + width >= len(payload):
            break
        numbers.append(int.from_bytes(payload[offset + (width > 0) : offset + width + 1], "big"))
        offset += width + 1
    kind, seq, *_ = [*numbers, None, None]
    return (kind, seq) if kind is not None and kind <= _LARGEST_TYPE else (None, None)
