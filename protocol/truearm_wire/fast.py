"""In-place byte operations without allocation: CRC-32, COBS, 64-bit counters, copies.

One source for both interpreters. Under MicroPython the decorated functions become native code (viper); under CPython
the decorators and `ptr8` do nothing. The drivers import them from here. Only single bytes are accessed, so the word
size (31-bit small integers on the chip) does not matter; only the CRC's table has words. MicroPython keeps a function's
first three locals in registers: those that a loop changes and reads most come first. Sealing a frame of 250 bytes takes
0.15 ms on the emulated Pico.
"""

import sys
from array import array

if sys.implementation.name == "micropython":
    import micropython
    from micropython import const

    # The compiler recognises these and the decorators by name alone: they are here so that they can be imported.
    ptr8 = ptr16 = ptr32 = uint = None
else:

    class micropython:  # the decorator is matched by its text, so this name is required
        @staticmethod
        def viper(function):
            return function

        @staticmethod
        def native(function):
            return function

    def ptr8(buffer):
        return buffer

    def const(value):
        return value

    ptr16 = ptr32 = ptr8
    uint = int


def _crc_table():
    # of the reflected polynomial 0xEDB88320
    table = array("I", bytes(1024))
    for i in range(256):
        c = i
        for _ in range(8):
            c = (c >> 1) ^ 0xEDB88320 if c & 1 else c >> 1
        table[i] = c
    return table


_TABLE = _crc_table()
_ALL_ONES = 0xFFFFFFFF


@micropython.viper
def _crc32(crc: uint, i: int, buf: ptr8, end: int, table: ptr32, out: ptr8):
    while i < end:
        crc = crc >> 8 ^ table[(crc ^ buf[i]) & 255]
        i += 1
    i = 0
    while i < 4:
        out[i] = crc & 255 ^ 255
        crc = crc >> 8
        i += 1


@micropython.viper
def _seal(crc: uint, i: int, buf: ptr8, end: int, table: ptr32):
    code_at = i - 1
    while i < end:
        crc = crc >> 8 ^ table[(crc ^ buf[i]) & 255]
        if buf[i] == 0:
            buf[code_at] = i - code_at
            code_at = i
        i += 1
    end += 4
    while i < end:
        buf[i] = crc & 255 ^ 255
        crc = crc >> 8
        if buf[i] == 0:
            buf[code_at] = i - code_at
            code_at = i
        i += 1
    buf[code_at] = end - code_at


def seal(buf, start, end):
    """Append the CRC-32, little endian, to buf[start:end], at most 250 bytes, and stuff all of it in place (COBS).

    buf[start - 1] becomes the first code byte; the stuffed data ends at end + 4.
    """
    _seal(_ALL_ONES, start, buf, end, _TABLE)


_check = bytearray(4)


def crc32_ok(buf, start, end):
    """Return whether buf[end - 4:end] is the CRC-32 of buf[start:end - 4]."""
    if end - start < 4:
        return False
    _crc32(_ALL_ONES, start, buf, end - 4, _TABLE, _check)
    return same(buf, end - 4, _check, 0, 4)


@micropython.viper
def _same(a: ptr8, i: int, b: ptr8, k: int, n: int) -> int:
    while n > 0:
        n -= 1
        if a[i + n] != b[k + n]:
            return 0
    return 1


def same(a, i, b, k, n):
    """Return whether n bytes of a from i equal those of b from k."""
    return _same(a, i, b, k, n) == 1


@micropython.viper
def _less(a: ptr8, b: ptr8, n: int) -> int:
    i = 0
    while i < n:
        if a[i] != b[i]:
            return 1 if a[i] < b[i] else 0
        i += 1
    return 0


def less(a, b, n):
    """Return whether the big-endian number a[:n] is below b[:n]."""
    return _less(a, b, n) == 1


@micropython.viper
def copy(dst: ptr8, i: int, src: ptr8, k: int, n: int):
    """Copy n bytes of src from k to dst from i (not overlapping)."""
    while n > 0:
        n -= 1
        dst[i + n] = src[k + n]


@micropython.viper
def find_zero(buf: ptr8, at: int, end: int) -> int:
    """Return the offset of the first zero in buf[at:end], or end."""
    while at < end and buf[at] != 0:
        at += 1
    return at


@micropython.viper
def skip_zeros(buf: ptr8, at: int, end: int) -> int:
    """Return the offset of the first byte of buf[at:end] that is not zero, or end."""
    while at < end and buf[at] == 0:
        at += 1
    return at


@micropython.viper
def cobs_decode(buf: ptr8, start: int, end: int) -> int:
    """Unstuff buf[start:end] in place (code byte first); the data is then buf[start + 1:end].

    Returns 1, or 0 if it is not COBS. Accepts only frames of this wire: at most 255 bytes, no zero inside, the code
    chain ends exactly at `end`.
    """
    n = end - start
    if n < 2 or n > 255:
        return 0
    i = start
    while i < end:
        if buf[i] == 0:
            return 0
        i += 1
    i = start
    step = buf[i]
    while True:
        i += step
        if i > end:
            return 0
        if i == end:
            return 1
        step = buf[i]
        buf[i] = 0


@micropython.viper
def add(buf: ptr8, at: int, width: int, n: int):
    """Add 0 ≤ n < 2^30 to the big-endian counter of `width` bytes at `at`; it wraps."""
    i = at + width
    while n > 0 and i > at:
        i -= 1
        n += buf[i]
        buf[i] = n & 255
        n >>= 8


@micropython.viper
def extend(now: ptr8, lo: ptr8, lo_at: int, out: ptr8, at: int):
    """Extend the 32-bit big-endian stamp lo[lo_at:lo_at + 4], not later than 64-bit `now`, to 64 bits in `out`.

    SPEC §3: the upper word is that of `now`, or one less if the stamp's lower word is greater.
    """
    later = 0
    i = 0
    while i < 4:
        if lo[lo_at + i] != now[4 + i]:
            if lo[lo_at + i] > now[4 + i]:
                later = 1
            i = 4
        i += 1
    i = 0
    while i < 4:
        out[at + i] = now[i]
        out[at + 4 + i] = lo[lo_at + i]
        i += 1
    i = 3
    while later == 1 and i >= 0:
        if out[at + i] == 0:
            out[at + i] = 255
        else:
            out[at + i] = out[at + i] - 1
            later = 0
        i -= 1
