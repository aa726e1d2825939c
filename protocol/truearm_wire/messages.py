"""Every frame by the layout of its elements (SPEC §4 and §6); the layout is generated from frames.cddl."""

from . import layout
from .cbor import U32, U64, CborError, Tag, decode, encode, encode_into
from .fast import copy

DATA = 16
EVENT = 17
HEARTBEAT = 18
IDENT = 19
TEMPERATURE = 20
SYNC_REQUEST = 32
SYNC_REPLY = 33
IDENTIFY = 48
CONFIGURE = 49
START = 50
STOP = 51
GET_CONFIG = 52
PUT_CONFIG = 53
SELF_TEST = 54
TO_REPL = 55
RESET = 56
PULSE = 57
REPLY = 64
ERROR = 65

ERROR_UNKNOWN = 1
ERROR_MALFORMED = 2
ERROR_RANGE = 3
ERROR_STREAMING = 4
ERROR_STORAGE = 5

COUNTER = (1 << 30) - 1  # counters wrap here: above, the chip would allocate an integer at every step

FLAG_OVERRUN = 1
FLAG_CONVERTER = 2
FLAG_MISSING_STOP = 4

STREAM_ADC = 0
STREAM_MAG = 1
STREAM_SENSOR = 2  # and above: further sensors

OUTPUT_LINE = 2  # events of the box's own trigger output

RESTART = 0  # modes of a reset
BOOT_LOADER = 1

PAGE_BYTES = 200
PAGES_MAX = 32

LAYOUT = layout.LAYOUT
APPENDED = layout.APPENDED


def names(frame_type):
    """Return the names of the elements after the type."""
    return [entry.split(":")[0] for entry in LAYOUT[frame_type]]


def needed(frame_type):
    """Return how many elements after the type every minor version sends."""
    return len(LAYOUT[frame_type]) - APPENDED.get(frame_type, 0)


def encode_payload(values):
    """Return the payload of [type, element …] with the widths of LAYOUT; extra elements are written shortest.

    Raises CborError if the type is unknown or elements are missing.
    """
    entries = LAYOUT.get(values[0])
    if entries is None:
        raise CborError("frame type %d is unknown" % values[0])
    if len(values) <= needed(values[0]):
        raise CborError(
            "frame type %d has %d elements, %d are needed" % (values[0], len(values) - 1, needed(values[0]))
        )
    sized = [values[0]]
    for entry, value in zip(entries, values[1:]):
        if isinstance(value, int):
            if entry.endswith(":u32"):
                value = U32(value)
            elif entry.endswith(":u64"):
                value = U64(value)
        sized.append(value)
    sized.extend(values[1 + len(entries) :])
    return encode(sized)


def decode_payload(payload):
    """Return [type, element …] of a payload. Raises CborError if it is not a frame of a known layout.

    Unknown frame types are returned unchanged (SPEC §7). Known ones must have the elements of their layout, except for
    those that a minor version added.
    """
    values = decode(payload)
    if not isinstance(values, list) or not values or not isinstance(values[0], int) or values[0] < 0:
        raise CborError("a frame is an array that begins with its type")
    entries = LAYOUT.get(values[0])
    if entries is None:
        return values
    if len(values) <= needed(values[0]):
        raise CborError(
            "frame type %d has %d elements, %d are needed" % (values[0], len(values) - 1, needed(values[0]))
        )
    for entry, value in zip(entries, values[1:]):
        if not isinstance(value, _accepted(entry)):
            raise CborError("element %s of frame type %d has the wrong type" % (entry.split(":")[0], values[0]))
    return values


def _accepted(entry):
    if entry == "samples":
        return Tag
    if entry == "data":
        return bytes
    if entry == "text":
        return str
    return int


def pages(document):
    """Return the pages of a document's CBOR bytes, as (page, pages, bytes). Raises CborError for more than 32."""
    count = (len(document) + PAGE_BYTES - 1) // PAGE_BYTES or 1
    if count > PAGES_MAX:
        raise CborError("a document of %d bytes does not fit %d pages" % (len(document), PAGES_MAX))
    return [(i, count, document[PAGE_BYTES * i : PAGE_BYTES * (i + 1)]) for i in range(count)]


def pages_of(value):
    """Return `pages` of a document that is not encoded yet, never in one piece: the chip's heap has no 4 kB block.

    Raises CborError.
    """
    cut = _Cut()
    encode_into(value, cut)
    found = cut.pages()
    if len(found) > PAGES_MAX:
        raise CborError("a document of %d pages does not fit %d" % (len(found), PAGES_MAX))
    return [(i, len(found), page) for i, page in enumerate(found)]


class _Cut:
    """The destination of an encoding: collects pages as they fill."""

    def __init__(self):
        self._full = []
        self._page = bytearray(PAGE_BYTES)
        self._n = 0

    def append(self, byte):
        self._page[self._n] = byte
        self._advance(1)

    def extend(self, data):
        at = 0
        while at < len(data):
            n = min(PAGE_BYTES - self._n, len(data) - at)
            copy(self._page, self._n, data, at, n)
            at += n
            self._advance(n)

    def _advance(self, n):
        self._n += n
        if self._n == PAGE_BYTES:
            self._full.append(bytes(self._page))
            self._n = 0

    def pages(self):
        if self._n or not self._full:
            self._full.append(bytes(self._page[: self._n]))
            self._n = 0
        return self._full
