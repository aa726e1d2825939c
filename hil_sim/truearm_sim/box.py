"""The sensor box as a child process: the firmware's files in a MicroPython; grants provide its hardware.

This is the parent's half of vm/board.py, which describes the messages. One grant is one step of the box: device time,
received bytes, latched samples and edges go in, sent bytes come out. Nothing happens in between, independent of the
wall clock.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

import truearm_wire
from truearm.errors import LinkError

from .micropython import Interpreter

HEAP_KIB = 237  # free heap of MicroPython 1.25 on an RP2040, for the chip's 32-bit words
GRANT = struct.Struct(">cBHHQiBBHQHQB")
ANSWER = struct.Struct(">cBBHIHHBHI")
RECORD = 20  # bytes per converter sample in a grant: stamp and four counts
MAG_RECORD = 8  # per sample of the magnetostrictive head: stamp and ticks
SAMPLES_MAX = 112  # of each
RX_MAX = 512
EDGE = 6
EDGES_MAX = 32
THERMOMETER = struct.Struct(">8si")
THERMOMETERS_MAX = 8  # 41 + 512 + 112 * 28 + 32 * 6 + 8 * 12 bytes fit in the 4096 that a pipe passes in one piece
NO_ANSWER = 0x7FFFFFFF  # of a thermometer

STALL, CRASH = 1, 2
POWER, WATCHDOG, COMMAND = 1, 2, 3
FAULT_CRC, FAULT_RESET = 1, 2  # faults of a converter sample
_PIPE_BYTES = 65536  # capacity of a pipe
_ENDS = {2: "reset", 32: "prompt", 64: "boot loader"}
HEALTHY: Mapping[str, int] = {
    "converter_id": 0x2402,
    "excitation": 750_100,
    "noise_0": 2_900,
    "noise_1": 3_010,
    "noise_2": 2_880,
    "noise_3": 2_950,
    "stops": 16,
    "rail_5v": 5_020,
}


class BoxDied(LinkError):
    """The firmware's process ended; the text is its standard error output."""


LATER_US = 1 << 29  # nothing is due


@dataclass(frozen=True, slots=True)
class Grant:
    """The input of the box for one step, which lasts until ``now_us``.

    ``samples`` (``mag``) are n stamps of 4 bytes and n samples of 16 (4), the first with index ``index`` since the
    start of sampling. ``fault`` refers to the last converter sample. ``thermometers`` are records of THERMOMETER, all
    of them in each grant, ``readings`` what the further sensors would read now.
    """

    now_us: int
    rx: bytes = b""
    samples: bytes = b""
    index: int = 0
    mag: bytes = b""
    mag_index: int = 0
    edges: bytes = b""
    tx_room: int = 0xFFFF
    flags: int = 0
    fault: int = 0
    temperature_mdegc: int = 25000
    thermometers: bytes = b""
    readings: bytes = b""


class Answer(NamedTuple):
    """The result of one grant.

    ``end`` tells how the firmware ended: "reset", "watchdog", "prompt", "boot loader", "power cut"; "" while it runs.
    """

    tx: bytes
    sampling: bool
    osr: int
    end: str
    rx_room: int  # maximum number of bytes in the next grant
    mag_sampling: bool = False
    mag_period_ns: int = 0
    starts: int = 0  # of sampling since boot, modulo 256
    output: bool = False
    led: int = 0
    alive: bool = True  # the firmware fed its watchdog
    watchdog_ms: int = 0
    # device time of sample 0 of each stream since the latest start
    first_ns: tuple[int | None, int | None] = (None, None)
    wake_us: int = LATER_US  # from now: the firmware wants to run then in any case
    toggles: tuple[tuple[int, bool], ...] = ()  # edges of its trigger output: device time [ns], level

    @property
    def reset(self) -> bool:
        """Return whether the firmware reset the box."""
        return self.end == "reset"


@dataclass(frozen=True)
class BoxSetup:
    """The properties of one box; `ring_slots` blocks of samples wait while the link is blocked.

    ``self_test``: what the board measures in its self-test. ``sensors``: the streams of further sensors in its ident.
    """

    uid: bytes = bytes.fromhex("e6614103e7452b2f")
    ring_slots: int = 200  # 2 s of both streams at 1 kHz: 78 and 20 blocks a second
    config: dict[str, Any] | None = field(default=None)
    self_test: Mapping[str, int] = field(default_factory=lambda: HEALTHY)
    sensors: Sequence[Mapping[str, Any]] = ()


def firmware_folder() -> Path:
    """Return the folder of the firmware's files: in the checkout, or in the installed wheel."""
    here = Path(__file__).resolve()
    packed = here.parent / "_firmware"
    return packed if packed.is_dir() else here.parents[2] / "firmware"


def write_flash(folder: Path, config: dict[str, Any] | None) -> None:
    """Create the box's file system: firmware, wire, board, configuration."""
    skip = shutil.ignore_patterns("__pycache__", "*.pyc")
    shutil.copytree(firmware_folder() / "truearm_box", folder / "truearm_box", ignore=skip)
    shutil.copyfile(firmware_folder() / "main.py", folder / "main.py")
    shutil.copytree(Path(truearm_wire.__file__).parent, folder / "truearm_wire", ignore=skip)
    for name in ("board.py", "sensors.py"):
        shutil.copyfile(Path(__file__).parent / "vm" / name, folder / name)
    if config is not None:
        (folder / "config.json").write_text(json.dumps(config))


def end_process(process: subprocess.Popen[bytes], stderr: IO[bytes]) -> None:
    """Kill a process, and close its pipes and the file of its standard error."""
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout, stderr):
        if pipe is not None:
            pipe.close()


class BoxProcess:
    """A running box. `interpreter` None: the firmware runs in CPython (no heap limit, no native code).

    ``flash``: a folder created by `write_flash`; files that the firmware stores there outlive the process. By default
    the box has its own, which is deleted with the box.
    """

    def __init__(
        self,
        interpreter: Interpreter | None,
        setup: BoxSetup,
        boot_id: int,
        reset_cause: int = POWER,
        main: str = "main.py",
        flash: Path | None = None,
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="truearm-box-") if flash is None else None
        folder = flash or Path(self._folder.name if self._folder else "")
        if flash is None:
            write_flash(folder, setup.config)
        board = {
            "uid": list(setup.uid),
            "boot_id": list(boot_id.to_bytes(4, "big")),
            "reset_cause": reset_cause,
            "ring_slots": setup.ring_slots,
            "config": "config.json",
            "error": "last_error.txt",
            "self_test": dict(setup.self_test),
            "sensors": list(setup.sensors),
        }
        (folder / "board.json").write_text(json.dumps(board))  # an argument of MicroPython has at most 255 bytes
        self._readings_bytes = 4 * sum(len(stream["channels"]) for stream in setup.sensors)
        self._stderr = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [*_command(interpreter), main],
            cwd=folder,
            env={**os.environ, "MICROPYPATH": str(folder), "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            bufsize=0,
            start_new_session=True,  # Ctrl-C is for the parent, which ends this process cleanly
        )

    def grant(self, given: Grant) -> Answer:
        """Make one step. Raises BoxDied if the process has ended, ValueError if the content exceeds a grant."""
        assert self._process.stdin is not None
        n_samples, n_mag, n_edges = len(given.samples) // RECORD, len(given.mag) // MAG_RECORD, len(given.edges) // EDGE
        n_thermometers = len(given.thermometers) // THERMOMETER.size
        if (
            max(n_samples, n_mag) > SAMPLES_MAX
            or len(given.rx) > RX_MAX
            or n_edges > EDGES_MAX
            or n_thermometers > THERMOMETERS_MAX
        ):
            raise ValueError("more than fits a grant")
        room = max(0, min(given.tx_room, 0xFFFF))
        counts = (n_samples, given.index, n_mag, given.mag_index, n_thermometers)
        where = (given.now_us, given.temperature_mdegc, n_edges, given.fault, *counts)
        head = GRANT.pack(b"G", given.flags, len(given.rx), room, *where)
        body = given.rx + given.samples + given.mag + given.edges + given.thermometers
        body += given.readings.ljust(self._readings_bytes, b"\0")
        try:
            os.write(self._process.stdin.fileno(), head + body)  # at most 4096 bytes: they arrive in one piece
        except BrokenPipeError:
            raise BoxDied(self._last_words()) from None
        return self._answer()

    def _answer(self) -> Answer:
        data = self._read_to(b"", ANSWER.size)
        head = ANSWER.unpack_from(data)
        magic, flags, led, osr, mag_period_ns, watchdog_ms, rx_room, starts, n, wake_us = head
        if magic == b"D":
            data = self._read_to(data, ANSWER.size + n)
        if magic != b"D" or len(data) > ANSWER.size + n:
            raise BoxDied(f"the firmware wrote to standard output: {data[:80]!r}")
        return Answer(
            tx=data[ANSWER.size :],
            sampling=bool(flags & 1),
            osr=osr,
            end="".join(end for bit, end in _ENDS.items() if flags & bit),
            rx_room=rx_room,
            mag_sampling=bool(flags & 4),
            mag_period_ns=mag_period_ns,
            starts=starts,
            output=bool(flags & 8),
            led=led,
            alive=bool(flags & 16),
            watchdog_ms=watchdog_ms,
            wake_us=wake_us,
        )

    def _read_to(self, data: bytes, n: int) -> bytes:
        """Return ``data`` and what follows, at least n bytes; an answer usually arrives in one piece."""
        assert self._process.stdout is not None
        fd = self._process.stdout.fileno()
        while len(data) < n:
            piece = os.read(fd, _PIPE_BYTES)
            if not piece:
                raise BoxDied(self._last_words())
            data += piece
        return data

    def _last_words(self) -> str:
        self._process.wait(timeout=5)
        self._stderr.seek(0)
        text = self._stderr.read().decode(errors="replace").strip()
        return "the simulated box's firmware ended: " + (text or "no message")

    def close(self) -> None:
        """End the process and delete its file system."""
        end_process(self._process, self._stderr)
        if self._folder is not None:
            self._folder.cleanup()

    def __enter__(self) -> BoxProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _command(interpreter: Interpreter | None) -> list[str]:
    if interpreter is None:
        return [sys.executable, "-s"]
    heap = HEAP_KIB * interpreter.bits // 32
    return [str(interpreter.path), "-X", f"heapsize={heap}k"]
