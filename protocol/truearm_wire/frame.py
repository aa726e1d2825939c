"""Payload ↔ frame, and a splitter for a byte stream; for the box and for tests. The host has its own, faster one."""

from .cbor import CborError
from .fast import cobs_decode, copy, crc32_ok, find_zero, micropython, seal

PAYLOAD_MAX = 250
FRAME_MAX = PAYLOAD_MAX + 4 + 1 + 2
HEAD = 2  # delimiter and first code byte precede the payload
TAIL = 5  # CRC and delimiter follow it


def close(buf, at, end):
    """Finish a frame in place: buf[at + 2:end] holds its payload, followed by six free bytes. Return the end.

    Allocates nothing.
    """
    seal(buf, at + HEAD, end)
    buf[at] = 0
    buf[end + 4] = 0
    return end + TAIL


def frame(payload):
    """Return the frame of a payload. Raises CborError if it is too long."""
    if len(payload) > PAYLOAD_MAX:
        raise CborError("a payload of %d bytes; %d fit a frame" % (len(payload), PAYLOAD_MAX))
    buf = bytearray(len(payload) + 7)
    buf[HEAD : HEAD + len(payload)] = payload
    close(buf, 0, HEAD + len(payload))
    return bytes(buf)


def unframe(run):
    """Return the payload of the bytes between two delimiters, or None if they are not a frame."""
    buf = bytearray(run)
    n = len(buf)
    if n < 6 or not cobs_decode(buf, 0, n) or not crc32_ok(buf, 1, n):
        return None
    return bytes(buf[1 : n - 4])


class Splitter:
    """Find frames in the bytes that the box receives, in a fixed buffer; longer runs are counted as bad.

    Allocates nothing.
    """

    def __init__(self):
        self.buf = bytearray(256)
        self.n = 0  # bytes since the last delimiter, at most 256
        self.end = 0
        self.bad_frames = 0

    @micropython.native
    def push(self, src, at, end):
        """Take src[at:end] up to its first delimiter; return the offset after what was taken.

        If that completed a frame, its payload is self.buf[1:self.end] until the next push; otherwise self.end is 0.
        """
        self.end = 0
        zero = find_zero(src, at, end)
        n = self.n + zero - at
        if n < 256:
            copy(self.buf, self.n, src, at, zero - at)
        else:
            n = 256
        if zero == end:
            self.n = n
            return end
        self.n = 0
        if 6 <= n < 256 and cobs_decode(self.buf, 0, n) and crc32_ok(self.buf, 1, n):
            self.end = n - 4
        elif n:
            self.bad_frames += 1
        return zero + 1
