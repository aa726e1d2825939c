"""Measure how fast recorded samples are read, from the wire's bytes and from a session file, compared with the C libraries alone.

    .venv/bin/python bench/decoding.py

A sample is four channels of 32 bits. Floor: cobs, zlib and numpy's frombuffer on frames that are already cut; nothing is checked, counted
or timed. Seconds are of the processor, on one core.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from zlib import crc32

import cbor2
import numpy as np
from cobs import cobs

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "host"))
from session_stream import columns_of

from truearm.record.links import HostClock
from truearm.record.requests import FrameSplitter
from truearm.record.session_writer import SessionWriter
from truearm.session.frames import Ident, parse_ident
from truearm.session.session_file import Messages, Session, open_session
from truearm.session.streams import BoxReader
from truearm.types import Message
from truearm_wire.cbor import Tag
from truearm_wire.frame import frame
from truearm_wire.messages import encode_payload

FRAMES, SAMPLES, CHANNELS, PERIOD_NS = 20_000, 13, 4, 983_040
HEAD = 35  # bytes of a payload before its samples
CHANNEL = {"unit": "V", "scale": [143, -9]}
IDENT = {
    "protocol": [1, 0],
    "firmware": "bench",
    "boot_id": 1,
    "streams": [
        {
            "id": 0,
            "name": "adc",
            "period_ns": PERIOD_NS,
            "osr": 4096,
            "group_delay_ns": 0,
            "channels": [{**CHANNEL, "name": f"c{k}"} for k in range(CHANNELS)],
        }
    ],
}


def payloads() -> list[bytes]:
    """Return data frames as the box sends them, with noise in 16 of the 24 bits."""
    counts = np.random.default_rng(1).integers(-(2**15), 2**15, (FRAMES, SAMPLES, CHANNELS), dtype="<i4")
    return [
        bytes(encode_payload([16, k, 0, SAMPLES * k, 12780 * k, PERIOD_NS, Tag(78, block.tobytes()), 0]))
        for k, block in enumerate(counts)
    ]


def floor(runs: list[bytes]) -> int:
    total = 0
    for run in runs:
        raw = cobs.decode(run)
        if crc32(raw[:-4]) == int.from_bytes(raw[-4:], "little"):
            total += len(np.frombuffer(raw, "<i4", SAMPLES * CHANNELS, HEAD))
    return total // CHANNELS


def from_the_wire(data: bytes, ident: Ident) -> int:
    splitter, found = FrameSplitter(), []
    for at in range(0, len(data), 4096):
        frames = splitter.push(data[at : at + 4096])
        found += [Message("/box/adc", at, payload) for elements, payload in frames if elements]
    return n_samples(BoxReader(ident), [columns_of(found)])


def from_a_file(session: Session, ident: Ident) -> int:
    return n_samples(BoxReader(ident), session.batches())


def n_samples(reader: BoxReader, batches: Iterable[Messages]) -> int:
    blocks = [some for messages in batches for some in reader.feed(messages)] + reader.finish()
    return sum(len(some.counts) for some in blocks)


def best_of(runs: int, job: Callable[[], int]) -> float:
    """Return the shortest time of several runs in seconds, because other load only adds time."""
    seconds = []
    for _ in range(runs):
        started = time.process_time()
        found = job()
        seconds.append(time.process_time() - started)
        assert found == FRAMES * SAMPLES, found
    return min(seconds)


def main() -> None:
    made = payloads()
    data = b"".join(bytes(frame(payload)) for payload in made)
    runs = [run for run in data.split(b"\0") if run]
    ident = parse_ident(cbor2.loads(cbor2.dumps(IDENT)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        with SessionWriter(path, HostClock()) as writer:
            for k, payload in enumerate(made):
                writer.add("/box/adc", k * 12_780_000, payload)
        session = open_session(path)
        steps = {
            "floor: cobs, crc32, frombuffer": best_of(5, lambda: floor(runs)),
            "wire → checked samples": best_of(5, lambda: from_the_wire(data, ident)),
            "session file → checked samples": best_of(5, lambda: from_a_file(session, ident)),
        }
    least = next(iter(steps.values()))
    print(f"{'step':34}{'µs a frame':>12}{'samples/s':>14}{'of the floor':>14}")
    for name, s in steps.items():
        print(f"{name:34}{1e6 * s / FRAMES:12.2f}{SAMPLES * FRAMES / s:14,.0f}{s / least:14.2f}")


if __name__ == "__main__":
    main()
