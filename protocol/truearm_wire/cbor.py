"""The subset of CBOR (RFC 8949) used on the wire, for CPython and MicroPython.

Values: int (64 bit), bytes, str, list, dict with str keys, `U32`/`U64` (integers of fixed width, see below) and `Tag`.
No floats, no indefinite lengths, no simple values. The `put_*` functions write into a preallocated buffer without
allocating, as long as integers are small (below 2^30 on the chip). `encode` and `decode` are for documents and tests.
"""


class CborError(ValueError):
    """Not CBOR, or not in the subset."""


class U32(int):
    """An integer that is always written in five bytes (SPEC §2)."""


class U64(int):
    """An integer that is always written in nine bytes (SPEC §2)."""


class Tag:
    """A tagged byte string (RFC 8746 typed arrays)."""

    def __init__(self, number, data):
        self.number = number
        self.data = data

    def __eq__(self, other):
        return isinstance(other, Tag) and self.number == other.number and self.data == other.data

    def __hash__(self):
        return hash((self.number, self.data))

    def __repr__(self):
        return "Tag(%d, %r)" % (self.number, self.data)


DEPTH_MAX = 12
SINT32_LE = 78


def put_head(buf, at, major, n):
    """Write a head with argument 0 ≤ n < 2^30 in its shortest form; return the offset after it."""
    major <<= 5
    if n < 24:
        buf[at] = major | n
        return at + 1
    if n < 256:
        buf[at] = major | 24
        buf[at + 1] = n
        return at + 2
    if n < 65536:
        buf[at] = major | 25
        at += 1
    else:
        buf[at] = major | 26
        buf[at + 1] = n >> 24
        buf[at + 2] = (n >> 16) & 255
        at += 3
    buf[at] = (n >> 8) & 255
    buf[at + 1] = n & 255
    return at + 2


def put_int(buf, at, n):
    """Write an integer of magnitude below 2^30; return the offset after it."""
    if n < 0:
        return put_head(buf, at, 1, -1 - n)
    return put_head(buf, at, 0, n)


def encode(value):
    """Return the CBOR bytes of a value. Raises CborError."""
    out = bytearray()
    encode_into(value, out)
    return bytes(out)


def encode_into(value, out):
    """Append a value's CBOR bytes to `out`, which has `append` and `extend`. Raises CborError."""
    _encode(value, out, DEPTH_MAX)


def _head(out, major, n):
    if n < 24:
        out.append(major << 5 | n)
        return
    for width, info in ((1, 24), (2, 25), (4, 26), (8, 27)):
        if n < 1 << (8 * width):
            _fixed(out, major << 5 | info, n, width)
            return
    raise CborError("integer beyond 64 bits")


def _fixed(out, first, n, width):
    out.append(first)
    for i in range(width - 1, -1, -1):
        out.append((n >> (8 * i)) & 255)


def _encode(value, out, depth):
    if depth == 0:
        raise CborError("nested too deeply")
    if isinstance(value, str):  # first: the keys of an ident, most of what a box encodes
        text = value.encode()
        _head(out, 3, len(text))
        out.extend(text)
    elif isinstance(value, U32):
        _fixed(out, 0x1A, value, 4)
    elif isinstance(value, U64):
        _fixed(out, 0x1B, value, 8)
    elif isinstance(value, bool):
        raise CborError("booleans are not on this wire")
    elif isinstance(value, int):
        if value < 0:
            _head(out, 1, -1 - value)
        else:
            _head(out, 0, value)
    elif isinstance(value, (bytes, bytearray)):
        _head(out, 2, len(value))
        out.extend(value)
    elif isinstance(value, (list, tuple)):
        _head(out, 4, len(value))
        for item in value:
            _encode(item, out, depth - 1)
    elif isinstance(value, dict):
        _head(out, 5, len(value))
        for key in value:
            _encode(key, out, depth - 1)
            _encode(value[key], out, depth - 1)
    elif isinstance(value, Tag):
        _head(out, 6, value.number)
        _encode(value.data, out, depth - 1)
    else:
        raise CborError("%s is not on this wire" % type(value).__name__)


def decode(data):
    """Return the value of CBOR bytes, all of them. Raises CborError."""
    value, end = _decode(data, 0, DEPTH_MAX)
    if end != len(data):
        raise CborError("%d bytes behind the value" % (len(data) - end))
    return value


def _argument(data, at):
    if at >= len(data):
        raise CborError("ends in the middle")
    info = data[at] & 31
    at += 1
    if info < 24:
        return info, at
    if info > 27:
        raise CborError("indefinite or reserved length")
    width = 1 << (info - 24)
    if at + width > len(data):
        raise CborError("ends in the middle")
    n = 0
    for i in range(at, at + width):
        n = n << 8 | data[i]
    return n, at + width


def _decode(data, at, depth):
    if depth == 0:
        raise CborError("nested too deeply")
    n, behind = _argument(data, at)
    major = data[at] >> 5
    if major == 0:
        return n, behind
    if major == 1:
        return -1 - n, behind
    if major == 2 or major == 3:
        end = behind + n
        if end > len(data):
            raise CborError("ends in the middle")
        raw = bytes(data[behind:end])
        if major == 2:
            return raw, end
        try:
            return raw.decode(), end
        except UnicodeError:
            raise CborError("text is not UTF-8")
    if major == 4 or major == 5:
        if n > len(data) - behind:  # every item has at least one byte: rejects absurd lengths before looping
            raise CborError("ends in the middle")
        items = []
        for _ in range(n * (major - 3)):
            item, behind = _decode(data, behind, depth - 1)
            items.append(item)
        if major == 4:
            return items, behind
        pairs = {}
        for i in range(0, len(items), 2):
            if not isinstance(items[i], str):
                raise CborError("map keys must be text")
            pairs[items[i]] = items[i + 1]
        return pairs, behind
    if major == 6:
        item, behind = _decode(data, behind, depth - 1)
        if not isinstance(item, bytes):
            raise CborError("only typed arrays are tagged")
        return Tag(n, item), behind
    raise CborError("floats and simple values are not on this wire")
