"""What a faulty or hostile host may send to a box: patterns by name, functions of a random generator and a number of bytes."""

import itertools
import random
from collections.abc import Callable, Iterator

from tests.wire_frames import command
from truearm_wire import frame
from truearm_wire.messages import SYNC_REQUEST


def _joined(pieces: Iterator[bytes], n: int) -> bytes:
    data = bytearray()
    while len(data) < n:
        data += next(pieces)
    return bytes(data)


def _wrong_crc(rng: random.Random) -> bytes:
    """Return valid COBS with a wrong checksum."""
    data = bytearray(frame.frame(rng.randbytes(rng.randrange(4, 240))))
    data[-2] ^= 1 if data[-2] != 1 else 2
    return bytes(data)


def _requests(rng: random.Random) -> Iterator[bytes]:
    """Yield clock requests, and between them commands of full length that no box has."""
    for number in itertools.count(1000):
        yield command(SYNC_REQUEST, number)
        if number % 5 == 0:
            yield frame.frame(b"\x83\x18\x3c\x1a" + number.to_bytes(4, "big") + b"\x58\xee" + rng.randbytes(238))


PATTERNS: dict[str, Callable[[random.Random, int], bytes]] = {
    "zeros": lambda rng, n: bytes(n),
    "ones": lambda rng, n: b"\xff" * n,
    "random": lambda rng, n: rng.randbytes(n),
    "wrong checksums": lambda rng, n: _joined(iter(lambda: _wrong_crc(rng), b""), n),
    "no delimiter": lambda rng, n: bytes(1 + byte % 255 for byte in rng.randbytes(n)),
    "requests": lambda rng, n: _joined(_requests(rng), n),
}
