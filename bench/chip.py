"""Measure the load of the firmware on the chip: MicroPython's RP2040 image in the emulator (hil_sim/chip), both sources, at rising rates.

    .venv/bin/python bench/chip.py [--seconds 10]

The processor's load is the emulated time in which it does not sleep, sampled every 20 µs (hil_sim/chip/profiler.mjs); a block's
costs are the samples within the functions of PARTS, divided by the blocks that came. Cycles are counted as the
Cortex-M0+ counts them, but code in flash costs what code in RAM does: a real Pico waits where its cache of 16 KiB misses. So these are
lower bounds of the load; a rate with a load of 80 % here leaves little there.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from truearm_sim import node
from truearm_sim.box import POWER, BoxSetup
from truearm_sim.chip import ANY_ROOM, ChipBox
from truearm_sim.hardware import Boot, Edge
from truearm_wire import frame, messages
from truearm_wire.messages import CONFIGURE, DATA, EVENT, HEARTBEAT, IDENTIFY, START, SYNC_REQUEST

ROOT = Path(__file__).resolve().parents[1]
RATES = (4096, 2048, 1024)  # oversampling: 1017, 2035, 4069 Hz; a start above is refused
MAG_PERIOD_NS = 983_040
BOOT_S = 3.2
GRANT_US = 10_000
PROFILE = {"pico": "profile", "every_ns": 19_997}  # no multiple of anything
STEP = "truearm_box_box_Box_step"
# of a block, in the order in which a stack of functions is searched
PARTS = {
    "take, look at CRC": ("drivers_ads131m04_dma_Adc_take", "drivers_magnetostrictive_Magnetostrictive_take"),
    "CRC-32, COBS": ("truearm_wire_frame_close",),
    "USB": ("board_Board_send",),
    "fill the frame": ("truearm_box_stream_Stream__fill",),
    "bookkeeping": ("truearm_box_stream_Stream__pull_block", "truearm_box_stream_Streams_send_oldest"),
}


class Level:
    """Inputs with arbitrary signals."""

    def counts(self, k0: int, k1: int, start_ns: int, period_ns: int) -> np.ndarray[Any, Any]:
        return np.arange(4 * k0, 4 * k1, dtype=np.int64).reshape(-1, 4).astype(np.int32) & 0x3FFFFF

    def flight_times(self, k0: int, k1: int, start_ns: int, period_ns: int) -> np.ndarray[Any, Any]:
        return np.full(k1 - k0, 100_000_000, dtype=np.int64)

    def thermometers(self, device_us: int) -> tuple[tuple[bytes, int], ...]:
        return ()


@dataclass(frozen=True)
class Run:
    """The results at one rate: what was received, and how long each part took."""

    osr: int
    start: dict[str, Any]  # profile of configuring and starting
    profile: dict[str, Any]
    blocks: int
    samples: int
    lost: int  # by the indices of both streams
    beats: list[dict[str, int]]
    events: int

    @property
    def load(self) -> float:
        return 1 - self.profile["asleep"] / self.profile["samples"]

    def us_a_block(self, samples: int) -> float:
        return samples * self.profile["every_ns"] / 1000 / self.blocks

    def parts(self) -> dict[str, float]:
        """Return the µs per block of each part; the rest of the load is the loop."""
        of = dict.fromkeys([*PARTS, "the loop and everything else"], 0)
        for path, n in self.profile["paths"].items():
            of[part_of(path.split(">"))] += n
        return {part: self.us_a_block(n) for part, n in of.items()}


def part_of(path: list[str]) -> str:
    return next(
        (part for part, names in PARTS.items() if any(n in path for n in names)), "the loop and everything else"
    )


def run(osr: int, seconds: float) -> Run:
    with tempfile.TemporaryDirectory() as folder:
        boot = Boot(Path(folder), BoxSetup(), 1, POWER, Level())
        hardware = ChipBox(boot)
        try:
            return _stream(hardware, Path(folder), osr, seconds)
        finally:
            hardware.close()


def _stream(hardware: ChipBox, folder: Path, osr: int, seconds: float) -> Run:
    now_us = int(BOOT_S * 1e6)
    _give(hardware, now_us)
    hardware.control(PROFILE)
    begun = b""
    for ask in ([CONFIGURE, 1, 0, osr], [CONFIGURE, 2, 1, MAG_PERIOD_NS], [START, 3], [SYNC_REQUEST, 4]):
        now_us += 600_000
        begun += _give(hardware, now_us, command(*ask))
    start = _profile(hardware, folder, now_us)
    hardware.control(PROFILE)
    sent = [begun]
    for k in range(int(seconds * 1e6) // GRANT_US):
        edges = [Edge(1000 * now_us + 1_234_567, k % 2, bool(k & 2))] if k % 10 == 0 else []
        ask = command(IDENTIFY, 5) if k == 50 else command(SYNC_REQUEST, k) if k % 25 == 0 else b""
        now_us += GRANT_US
        sent.append(_give(hardware, now_us, ask, edges))
    return _judge(osr, start, _profile(hardware, folder, now_us), frames(b"".join(sent)), len(frames(begun)))


def _profile(hardware: ChipBox, folder: Path, now_us: int) -> dict[str, Any]:
    """Stop the profiler and return what it measured since its start."""
    file = folder / "profile.json"
    hardware.control({"pico": "profiled", "file": str(file)})
    _give(hardware, now_us)  # answered when the file is written
    found: dict[str, Any] = json.loads(file.read_text())
    return found


def _give(hardware: ChipBox, until_us: int, rx: bytes = b"", edges: list[Edge] | None = None) -> bytes:
    (answer,) = hardware.advance(until_us, rx, edges or [], ANY_ROOM, 0, 25_000)
    return answer.tx


def command(*values: int) -> bytes:
    return frame.frame(messages.encode_payload(list(values)))


def frames(sent: bytes) -> list[list[Any]]:
    payloads = (frame.unframe(run) for run in sent.split(b"\0") if run)
    return [messages.decode_payload(payload) for payload in payloads if payload]


def _judge(osr: int, start: dict[str, Any], profile: dict[str, Any], found: list[list[Any]], before: int) -> Run:
    names = messages.names(HEARTBEAT)
    beats = [dict(zip(names, f[1:], strict=True)) for f in found[before:] if f[0] == HEARTBEAT]
    lost = samples = 0
    for stream, width in ((0, 16), (1, 4)):
        blocks = [(f[3], len(f[6].data) // width) for f in found if f[0] == DATA and f[2] == stream]
        samples += sum(n for _, n in blocks)
        lost += blocks[-1][0] + blocks[-1][1] - sum(n for _, n in blocks) - blocks[0][0]
    data = [f for f in found[before:] if f[0] == DATA]
    events = sum(1 for f in found if f[0] == EVENT)
    return Run(osr, start, profile, len(data), samples, lost, beats, events)


def longest(profile: dict[str, Any], n: int) -> list[tuple[float, str]]:
    """Return the longest calls of functions in the loop's step: ms and name. Callers that take hardly longer are left out."""
    stays = {p: ns for p, ns in profile["longest_ns"].items() if STEP + ">" in p}
    leaves = {p: ns for p, ns in stays.items() if not any(q.startswith(p + ">") and stays[q] > 0.6 * ns for q in stays)}
    found = sorted(((ns / 1e6, path.rpartition(">")[2]) for path, ns in leaves.items()), reverse=True)
    return found[:n]


def viper_names() -> dict[str, str]:
    """Name frozen native code by its function; the image names it by its file and a number."""
    names = {}
    for folder in ("firmware/truearm_box", "firmware/drivers", "protocol/truearm_wire"):
        for path in (ROOT / folder).glob("*.py"):
            functions = re.findall(r"@micropython\.viper\s+def (\w+)", path.read_text())
            place = f"{path.parent.name}_{path.stem}_{path.parent.name}_slash_{path.stem}_dot_py"
            names.update({place + (str(k + 1) if k else ""): f"{path.stem}.{f}" for k, f in enumerate(functions)})
    return names


def detail(of: Run) -> None:
    """Print the time in each function, alone and with the functions that it calls."""
    own: dict[str, int] = {}
    whole: dict[str, int] = {}
    viper = viper_names()
    for path, n in of.profile["paths"].items():
        names = [viper.get(name, name) for name in path.split(">")]
        own[names[-1]] = own.get(names[-1], 0) + n
        for name in set(names):
            whole[name] = whole.get(name, 0) + n
    for name in sorted(whole, key=lambda name: -whole[name])[:60]:
        print(f"   {name:60}{of.us_a_block(own.get(name, 0)):10.1f}{of.us_a_block(whole[name]):10.1f}")
    print("   in C:")
    for name, n in sorted(of.profile["c"].items(), key=lambda item: -item[1])[:30]:
        print(f"   {name:60}{of.us_a_block(n):10.1f}")
    for ms, path in longest(of.profile, 25):
        print(f"   {ms:8.2f} ms {path}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--osr", type=int, nargs="+", default=RATES)
    parser.add_argument("--detail", action="store_true", help="function by function")
    options = parser.parse_args()
    try:
        node.image()
    except node.NodeError as error:
        print(f"bench: going on without the chip: {error}")
        return 0
    for osr in options.osr:
        found = run(osr, options.seconds)
        loops = max(b["loop_max_us"] for b in found.beats)
        print(
            f"osr {osr}: {1e9 / (240 * osr):.0f} Hz, load {100 * found.load:.0f} %, {found.blocks} blocks, {found.samples} samples, "
            f"{found.lost} lost, {found.events} edges, longest loop {loops / 1000:.1f} ms, "
            f"heap {found.beats[0]['heap_free']} to {found.beats[-1]['heap_free']}"
        )
        print("  µs a block: " + ", ".join(f"{part} {us:.0f}" for part, us in found.parts().items()))
        for name, profile in (("starting", found.start), ("streaming", found.profile)):
            print(f"  longest, {name}: " + "; ".join(f"{ms:.1f} ms {path}" for ms, path in longest(profile, 3)))
        if options.detail:
            detail(found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
