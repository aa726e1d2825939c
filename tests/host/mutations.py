"""Random damage that respects the structure of its data, and resource limits for the code that must read it.

All functions take a ``random.Random``, from a seed or from hypothesis, which then finds the smallest damage that shows
a fault.
"""

import io
import re
import signal
import struct
import zlib
from contextlib import contextmanager

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk

MOST_BYTES = 512 << 20  # in addition to the process's current memory
MOST_CPU_S = 10.0
RECORD = struct.Struct("<BQ")
MAGIC_BYTES = 8
ODD_NUMBERS = (0, 1, 2, 0x7F, 0x80, 0xFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)


@contextmanager
def bounded():
    """Require that reading ends within MOST_CPU_S of processor time and uses at most MOST_BYTES more memory."""
    try:
        import resource
    except ImportError:  # no such limits on this platform
        yield
        return

    def late(*_):
        raise AssertionError(f"not done in {MOST_CPU_S} s of processor time")

    with open("/proc/self/statm") as file:
        has = int(file.read().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGVTALRM, late)
    resource.setrlimit(resource.RLIMIT_AS, (has + MOST_BYTES, hard))
    signal.setitimer(signal.ITIMER_VIRTUAL, MOST_CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGVTALRM, before)


def is_clear(error, begins=""):
    """Check that an error is one line that names the place."""
    assert "\n" not in str(error)
    assert str(error).startswith(begins)


def bytes_changed(rng, data):
    """Flip a few bits, set bytes to special values, or cut, repeat, move or wipe a range."""
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        if not data:
            break
        at = rng.randrange(len(data))
        a, b = sorted((at, min(len(data), at + rng.choice([1, 4, 60, 300]))))
        kind = rng.randrange(7)
        if kind <= 1:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 2:
            data[at] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)])
        elif kind == 3:
            del data[a:b]
        elif kind == 4:
            data[a:a] = data[a:b]
        elif kind == 5:
            to = rng.randrange(len(data))
            data[to : to + b - a] = data[a:b]
        else:
            data[a:b] = bytes(b - a)
    return bytes(data)


def parts_changed(rng, parts):
    """Drop, double, move or swap entire parts (frames, records, lines)."""
    parts = list(parts)
    for _ in range(rng.choice([1, 1, 2, 4])):
        if not parts:
            break
        a, b = rng.randrange(len(parts)), rng.randrange(len(parts))
        kind = rng.randrange(4)
        if kind == 0:
            del parts[a]
        elif kind == 1:
            parts.insert(b, parts[a])
        elif kind == 2:
            parts.insert(b, parts.pop(a))
        else:
            parts[a], parts[b] = parts[b], parts[a]
    return parts


def cbor_changed(rng, payload):
    """Return a payload with other heads of CBOR items, numbers or bytes."""
    data = bytearray(payload)
    kind = rng.randrange(4)
    at = rng.randrange(len(data))
    if kind == 0:
        data[at] = rng.choice([0x00, 0x18, 0x1B, 0x3B, 0x5F, 0x80, 0x9F, 0xBF, 0xC2, 0xD8, 0xF6, 0xF7, 0xFB, 0xFF])
    elif kind == 1:
        width = rng.choice([1, 2, 4, 8])
        data[at : at + width] = (rng.choice(ODD_NUMBERS) % 256**width).to_bytes(width, "big")
    elif kind == 2:
        del data[at:]
    else:
        return bytes_changed(rng, payload)
    return bytes(data)


def records_of(data):
    """Return the records of an MCAP file between its magics."""
    found, at = [], MAGIC_BYTES
    while at + RECORD.size <= len(data) - MAGIC_BYTES:
        end = at + RECORD.size + RECORD.unpack_from(data, at)[1]
        found.append(data[at:end])
        at = end
    return found


def length_changed(rng, parts):
    """Return a record that states another length; its bytes are unchanged."""
    parts = list(parts)
    at = rng.randrange(len(parts))
    opcode, length = RECORD.unpack_from(parts[at])
    wrong = rng.choice([*ODD_NUMBERS, length - 1, length + 1, length + rng.randrange(1, 5000), length // 2])
    parts[at] = RECORD.pack(opcode, max(0, wrong)) + parts[at][RECORD.size :]
    return parts


def chunk_changed(rng, parts):
    """Return a chunk with other content and correct CRC and lengths, and sometimes a correct CRC of the file."""
    parts = list(parts)
    chunks = [k for k, part in enumerate(parts) if part[0] == Opcode.CHUNK]
    at = rng.choice(chunks)
    chunk = Chunk.read(ReadDataStream(io.BytesIO(parts[at][RECORD.size :])))
    inner = zstandard.decompress(chunk.data, max_output_size=1 << 26)
    inner = bytes_changed(rng, inner)
    chunk.data, chunk.uncompressed_size, chunk.uncompressed_crc = (
        zstandard.compress(inner),
        len(inner),
        zlib.crc32(inner),
    )
    if rng.random() < 0.1:
        chunk.uncompressed_size = rng.choice(ODD_NUMBERS)
    builder = RecordBuilder()
    chunk.write(builder)
    parts[at] = builder.end()
    return with_crc(parts) if rng.random() < 0.5 else parts


def with_crc(parts):
    """Return the records with a corrected CRC over everything before DataEnd."""
    crc, done = zlib.crc32(b"\x89MCAP0\r\n"), []
    for part in parts:
        if part[0] == Opcode.DATA_END:
            part = part[: RECORD.size] + crc.to_bytes(4, "little") + part[RECORD.size + 4 :]
        crc = zlib.crc32(part, crc)
        done.append(part)
    return done


ODD_CELLS = (
    "", " ", "nan", "inf", "-inf", "1e400", "-1e308", "0x10", "1_000", "1,5", '"', "'", "\t", "=1+1", "٣", "−1", "1e-320", "9" * 400,
    "true", "[]", "[[]]", "{}", "{a=1}", "1979-05-27", '"""', "[" * 200, "a" * 5000, "\ufeff", "\u202e", "\x7f", "\udcff",
)  # fmt: skip


ODD_FACTORS = (0, -1, 1e-3, 1e3, 1e9, 1e-12, 1e305, 1.0000001)


def text_changed(rng, text):
    """Change bytes; move, drop or double lines; replace words by ones that are hard to parse, and numbers by others."""
    kind = rng.randrange(5)
    if kind == 0:
        return bytes_changed(rng, text.encode())
    if kind == 1:
        return "\n".join(parts_changed(rng, text.split("\n"))).encode()
    for _ in range(rng.choice([1, 1, 3])):
        words = list(re.finditer(r"[^,= \n\[\]]+" if kind == 2 else r"-?\d+\.?\d*(e-?\d+)?", text))
        word = rng.choice(words)
        instead = rng.choice(ODD_CELLS) if kind == 2 else repr(rng.choice(ODD_FACTORS) * float(word[0]))
        text = text[: word.start()] + instead + text[word.end() :]
    return text.encode("utf-8", "surrogateescape")
