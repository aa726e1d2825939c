"""A client written from protocol/SPEC.md alone, with Python's standard library: it finds a box among noise, reads its ident, and streams."""

import struct
import zlib

from tests.firmware import conftest
from tests.firmware.conftest import records


def cbor(data, at=0):
    """(value, offset behind it) of the items that the specification allows."""
    major, n = data[at] >> 5, data[at] & 31
    at += 1
    if n > 23:
        size = 1 << (n - 24)
        n, at = int.from_bytes(data[at : at + size], "big"), at + size
    if major in (0, 1):
        return (n if major == 0 else -1 - n), at
    if major in (2, 3):
        raw = data[at : at + n]
        return (raw if major == 2 else raw.decode()), at + n
    if major == 6:
        return cbor(data, at)  # a typed array: its bytes
    items = []
    for _ in range(n * (major - 3)):
        item, at = cbor(data, at)
        items.append(item)
    return (items if major == 4 else dict(zip(items[::2], items[1::2], strict=True))), at


def payloads(stream):
    """§1: what lies between delimiters, unstuffed, if its checksum is right."""
    for run in stream.split(b"\0"):
        found, at = bytearray(), 0
        while at < len(run):
            code = run[at]
            found += run[at + 1 : at + code] + b"\0"
            at += code
        if len(found) > 5 and at == len(run):
            payload, crc = bytes(found[:-5]), bytes(found[-5:-1])
            if struct.pack("<I", zlib.crc32(payload)) == crc:
                yield cbor(payload)[0]


def frame(*elements):
    """§1, §2: a frame of small unsigned integers."""
    payload = bytes([0x80 | len(elements)])
    for n in elements:
        payload += bytes([n]) if n < 24 else b"\x18" + bytes([n]) if n < 256 else b"\x19" + struct.pack(">H", n)
    stuffed = b"".join(
        bytes([len(part) + 1]) + part for part in (payload + struct.pack("<I", zlib.crc32(payload))).split(b"\0")
    )
    return b"\0" + stuffed + b"\0"


bench = conftest.bench  # the fixture


def heard(bench, **grant):
    bench.give(**grant)
    return list(payloads(bench.answer.tx))


def test_a_client_of_the_specification_alone(bench):
    heard(bench, rx=b"AT\r\n")  # what ModemManager leaves behind
    found = heard(bench, rx=b"\0" + frame(48, 7))
    pages = [f for f in found if f[0] == 19 and f[2] == 7]
    assert [f[3] for f in pages] == list(range(pages[0][4]))
    ident, _ = cbor(b"".join(f[5] for f in pages))
    assert ident["protocol"][0] == 1
    stream = next(one for one in ident["streams"] if one["name"] == "adc")
    assert [f[:1] + f[2:3] for f in heard(bench, rx=frame(49, 8, stream["id"], 4096)) if f[0] == 64] == [[64, 8]]
    assert [f[:1] + f[2:3] for f in heard(bench, rx=frame(50, 9)) if f[0] == 64] == [[64, 9]]
    begin_us = bench.now_us
    found = []
    for k in range(4):
        found += heard(bench, us=12_780, samples=records(13 * k, 13, begin_us), index=13 * k)
    blocks = [f for f in found if f[0] == 16]
    counts = [struct.unpack("<4i", f[6][i : i + 16]) for f in blocks for i in range(0, len(f[6]), 16)]
    assert counts == [struct.unpack("<4i", records(k, 1)[4:]) for k in range(52)]
    assert [f[3] for f in blocks] == [0, 13, 26, 39]
    assert [f[1] for f in found] == list(range(found[0][1], found[0][1] + len(found))), "§4: seq counts every frame"
    (reply,) = (f for f in heard(bench, rx=frame(32, 100)) if f[0] == 33)
    assert reply[2] == 100
    assert reply[3] <= reply[4] <= bench.now_us
    assert [f[:1] + f[2:3] for f in heard(bench, rx=frame(51, 10)) if f[0] == 64] == [[64, 10]]
