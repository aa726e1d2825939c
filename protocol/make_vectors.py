"""Write the golden vectors of SPEC.md from an independent derivation: struct, cbor2, cobs and zlib, no truearm code.

python protocol/make_vectors.py        # rewrites protocol/vectors/; a changed file is a changed protocol

vectors/frames.json      name, values (the frame's array; bytes as {"hex"}, tags as {"tag", "hex"}), file
vectors/corrupted.json   name, why, file: what no receiver may accept as a frame
vectors/*.bin            the bytes on the wire, delimiters included (corrupted: as received)
"""

import json
import re
import struct
import zlib
from pathlib import Path

import cbor2
from cobs import cobs

FOLDER = Path(__file__).parent / "vectors"


def u32(n: int) -> bytes:
    return b"\x1a" + struct.pack(">I", n)


def u64(n: int) -> bytes:
    return b"\x1b" + struct.pack(">Q", n)


def array(*items: bytes | int) -> bytes:
    """Return a CBOR array of encoded items and of integers in their shortest form."""
    head = bytes([0x80 | len(items)])  # up to 23 elements
    return head + b"".join(i if isinstance(i, bytes) else cbor2.dumps(i) for i in items)


def on_wire(payload: bytes) -> bytes:
    return b"\0" + cobs.encode(payload + struct.pack("<I", zlib.crc32(payload))) + b"\0"


def counts(n: int, start: int) -> bytes:
    """Return n samples of 4 channels that include the extremes of 24 bits and runs of zero bytes."""
    rows = [(start + i, -(start + i), 2**23 - 1 - i, -(2**23) + i) for i in range(n)]
    return b"".join(struct.pack("<4i", *row) for row in rows)


def flights(n: int, start: int) -> bytes:
    """Return n samples of stream 1: 100 to 400 µs in ticks of 8 ns, every seventh without a stop."""
    return b"".join(struct.pack("<i", 0 if k % 7 == 3 else 12500 + 997 * k % 37500) for k in range(start, start + n))


def typed(tag: int, data: bytes) -> bytes:
    return cbor2.dumps(cbor2.CBORTag(tag, data))


IDENT_DOCUMENT = cbor2.dumps(
    {
        "protocol": [1, 4],
        "firmware": "0.1.0",
        "uid": bytes.fromhex("e6614103e7452b2f"),
        "boot_id": 0xDEADBEEF,
        "clock_hz": 1000000,
        "streams": [
            {
                "id": 0,
                "name": "adc",
                "period_ns": 983040,
                "osr": 4096,
                "group_delay_ns": 1474560,
                "shortest_period_ns": 245760,
                "channels": [],
            }
        ],
    }
)

FRAMES: dict[str, tuple[bytes, list[object]]] = {}


def golden(name: str, payload: bytes) -> None:
    FRAMES[name] = (payload, cbor2.loads(payload))


golden("data-full", array(16, u32(7), 0, u64(13), u64(1234567), u32(983040), typed(78, counts(13, 0)), 0))
golden("data-one-sample", array(16, u32(0), 0, u64(0), u64(0), u32(245760), typed(78, counts(1, 5)), 0))
golden(
    "data-wraps", array(16, u32(2**32 - 1), 0, u64(2**32), u64(2**32 + 5), u32(983040), typed(78, counts(13, 99)), 1)
)
golden("data-far-time", array(16, u32(2**30), 0, u64(2**53), u64(2**63), u32(983040), typed(78, counts(2, 1)), 3))
golden("data-mag-full", array(16, u32(5), 1, u64(52), u64(2**33), u32(983040), typed(78, flights(52, 0)), 4))
golden("data-mag-one-sample", array(16, u32(6), 1, u64(104), u64(2**33), u32(200000), typed(78, flights(1, 0)), 0))
golden("event-rising", array(17, u32(9), 1, u64(5_000_000_123), 1))
golden("event-output-falling", array(17, u32(10), 2, u64(4_294_967_295), 0))
GRAMMAR = (Path(__file__).parent / "frames.cddl").read_text(encoding="utf-8")
GROUP = re.search(r"^heartbeat = [^?]*\? \(([^)]*)\)", GRAMMAR, re.MULTILINE)
assert GROUP is not None
APPENDED = GROUP[1].count(":")  # elements that minor versions appended
BEAT = (70000, 0, 3, 26, 1, 900, 4500, 151000, 31250, 1, 1)
golden("heartbeat", array(18, u32(10), u32(0xDEADBEEF), u64(10**9), *BEAT, 1, 2, 2**30 - 1, *range(3, APPENDED)))
golden("heartbeat-1.0", array(18, u32(10), u32(0xDEADBEEF), u64(10**9), *BEAT))
golden(
    "heartbeat-cold", array(18, u32(10), u32(1), u64(10**6), 1, 0, 0, 0, 0, 0, 0, 70000, -5250, 2, 0, *[0] * APPENDED)
)
golden("temperature", array(20, u32(14), u64(5_000_000_123), 0, 20_062))
golden("temperature-cold", array(20, u32(15), u64(2**32 - 1), 3, -40_000))
golden("ident-page", array(19, u32(0), 0, 0, 1, cbor2.dumps(IDENT_DOCUMENT[:200])))
golden("ident-full-page", array(19, u32(1), 2**30 - 1, 31, 32, cbor2.dumps(bytes(range(200)))))
golden("sync-request", array(32, 5))
golden("sync-request-widths", array(32, 2**30 - 1))
golden("sync-reply", array(33, u32(11), 5, u64(2**32 - 1), u64(2**32)))
golden("identify", array(48, 1))
golden("configure", array(49, 23, 0, 4096))
golden("start", array(50, 24))
golden("configure-mag", array(49, 25, 1, 983040))
golden("stop", array(51, 256))
golden("get-config", array(52, 27))
golden("put-config", array(53, 28, 1, 3, cbor2.dumps(bytes(range(200)))))
golden("self-test", array(54, 29))
golden("to-repl", array(55, 30))
golden("reset", array(56, 31, 1))
golden("pulse", array(57, 2**30 - 1, 1))
golden("reply", array(64, u32(12), 65535, 0, 1, cbor2.dumps(b"")))
golden("error", array(65, u32(13), 65536, 4, cbor2.dumps("not while streaming")))


def corrupted() -> dict[str, tuple[bytes, str]]:
    good = on_wire(FRAMES["data-full"][0])
    short = on_wire(FRAMES["start"][0])
    bad: dict[str, tuple[bytes, str]] = {}
    for at in (1, 2, 30, len(good) - 2):
        bad[f"bit-{at}"] = (good[:at] + bytes([good[at] ^ 0x10]) + good[at + 1 :], f"one bit of byte {at} flipped")
    bad["truncated"] = (good[:100] + b"\0", "the second half is missing")
    bad["joined"] = (good[:100] + good[101:], "one byte is missing")
    bad["crc-zero"] = (
        b"\0" + cobs.encode(FRAMES["start"][0] + b"\0\0\0\0") + b"\0",
        "the checksum is zero",
    )
    bad["crc-big-endian"] = (
        b"\0" + cobs.encode(FRAMES["start"][0] + struct.pack(">I", zlib.crc32(FRAMES["start"][0]))) + b"\0",
        "the checksum is big endian",
    )
    bad["too-short"] = (b"\0" + cobs.encode(b"\x81\x10") + b"\0", "shorter than a checksum and a type")
    bad["code-past-end"] = (b"\0\x20" + short[2:], "a COBS code points past the end")
    bad["text"] = (b"\0Traceback (most recent call last):\r\n\0", "text")
    return bad


def jsonable(value: object) -> object:
    if isinstance(value, bytes):
        return {"hex": value.hex()}
    if isinstance(value, cbor2.CBORTag):
        return {"tag": value.tag, "hex": value.value.hex()}
    if isinstance(value, (list, tuple)):
        return [jsonable(v) for v in value]
    return value


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for old in FOLDER.glob("*.bin"):
        old.unlink()
    good = []
    for name, (payload, values) in FRAMES.items():
        (FOLDER / f"{name}.bin").write_bytes(on_wire(payload))
        good.append({"name": name, "values": jsonable(values), "file": f"{name}.bin"})
    bad = []
    for name, (data, why) in corrupted().items():
        (FOLDER / f"bad-{name}.bin").write_bytes(data)
        bad.append({"name": name, "why": why, "file": f"bad-{name}.bin"})
    (FOLDER / "frames.json").write_text(json.dumps(good, indent=1) + "\n")
    (FOLDER / "corrupted.json").write_text(json.dumps(bad, indent=1) + "\n")
    print(f"{len(good)} golden and {len(bad)} corrupted frames written to {FOLDER}")


if __name__ == "__main__":
    main()
