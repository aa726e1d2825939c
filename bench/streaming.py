"""Measure how fast frames are made, split and stored, compared with a lower bound and with the link.

    .venv/bin/python bench/streaming.py

Floor of splitting: the C libraries alone (cobs, zlib, cbor2) on frames that are already cut. The link is USB full speed, 64-byte
packets, 19 of them a millisecond at most; the box at 1017.25 Hz × 4 channels needs 1.6 % of it.
"""

from __future__ import annotations

import struct
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import cbor2
from cobs import cobs

from truearm.record.links import HostClock
from truearm.record.requests import FrameSplitter
from truearm.record.session_writer import SessionWriter
from truearm_sim import micropython
from truearm_sim.box import BoxProcess, BoxSetup, Grant
from truearm_wire.cbor import Tag
from truearm_wire.frame import frame
from truearm_wire.messages import encode_payload

FRAMES = 20_000
SAMPLES = 13  # a frame
RATE_HZ = 1017.25
USB_BYTES_S = 19 * 64 * 1000


def stream() -> bytes:
    """Return FRAMES data frames as the box sends them."""
    block = struct.pack("<52i", *range(0, 52_000, 1000))
    frames = (frame(encode_payload([16, i, 0, 13 * i, 12780 * i, 983040, Tag(78, block), 0])) for i in range(FRAMES))
    return b"".join(frames)


def best_of(runs: int, job: Callable[[], object]) -> float:
    """Return the shortest time of several runs in seconds, because other load only adds time."""
    times = []
    for _ in range(runs):
        started = time.perf_counter()
        job()
        times.append(time.perf_counter() - started)
    return min(times)


def split(data: bytes) -> None:
    splitter = FrameSplitter()
    for at in range(0, len(data), 4096):
        splitter.push(data[at : at + 4096])


def floor(runs: list[bytes]) -> None:
    for run in runs:
        payload = cobs.decode(run)
        zlib.crc32(payload[:-4])
        cbor2.loads(payload[:-4])


def store(payloads: list[bytes]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        writer = SessionWriter(Path(folder) / "bench.mcap", HostClock())
        for i, payload in enumerate(payloads):
            writer.add("/box/adc", i * 12_780_000, payload)
        writer.close({})


def firmware() -> float:
    """Return the samples per second that the firmware in the simulated box frames, in grants of 100 samples."""
    interpreter = micropython.find()
    with BoxProcess(interpreter, BoxSetup(), boot_id=1) as box:
        box.grant(Grant(0, rx=frame(encode_payload([50, 1]))))
        records = bytes(4 * 100) + struct.pack("<4i", 1, 2, 3, 4) * 100
        n = 300

        def run() -> None:
            for i in range(n):
                box.grant(Grant(1000 + 98304 * i, samples=records, index=100 * i))

        return 100 * n / best_of(3, run)


def main() -> None:
    data = stream()
    runs = [run for run in data.split(b"\0") if run]
    payloads = [cobs.decode(run)[:-4] for run in runs]
    seconds = {
        "floor: cobs, zlib, cbor2": best_of(3, lambda: floor(runs)),
        "split (FrameSplitter)": best_of(3, lambda: split(data)),
        "store (SessionWriter)": best_of(3, lambda: store(payloads)),
    }
    least = seconds["floor: cobs, zlib, cbor2"]
    print(f"{'step':28}{'µs a frame':>12}{'samples/s':>14}{'of the floor':>14}")
    for name, s in seconds.items():
        print(f"{name:28}{1e6 * s / FRAMES:12.2f}{SAMPLES * FRAMES / s:14,.0f}{s / least:14.2f}")
    rate = firmware()
    print(f"\nfirmware in MicroPython: {rate:,.0f} samples/s, {rate / RATE_HZ:.0f} times a box at {RATE_HZ} Hz")
    bytes_s = len(data) / FRAMES / SAMPLES * RATE_HZ
    print(f"link: {bytes_s:,.0f} B/s at {RATE_HZ} Hz × 4 channels, {bytes_s / RATE_HZ:.1f} B a sample, ", end="")
    print(f"{100 * bytes_s / USB_BYTES_S:.1f} % of USB full speed")


if __name__ == "__main__":
    main()
