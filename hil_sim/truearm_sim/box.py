"""The sensor box as a child process: the firmware's own files in a MicroPython, its hardware given by grants.

The parent's half of vm/board.py, which describes the messages. One grant is one step of the box: device time, received
bytes, latched samples and edges go in, sent bytes come out. Nothing happens in between, whatever the wall clock says.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import truearm_wire
from truearm.errors import LinkError

from .micropython import Interpreter

HEAP_KIB = 237  # free heap of MicroPython 1.25 on an RP2040, for the chip's 32-bit words
GRANT = struct.Struct(">cBHHHQQiB")
ANSWER = struct.Struct(">cBHHH")
RECORD = 20  # bytes a sample takes in a grant: stamp and four counts
SAMPLES_MAX = 128
RX_MAX = 512
EDGES_MAX = 32  # 29 + 512 + 128 * 20 + 32 * 6 bytes stay below the 4096 that a pipe passes in one piece

STALL, CRASH, QUIT = 1, 2, 4
POWER, WATCHDOG, COMMAND = 1, 2, 3


class BoxDied(LinkError):
    """The firmware's process ended; the text is what it wrote to standard error."""


@dataclass(frozen=True)
class Answer:
    """What the box did in one grant."""

    tx: bytes
    sampling: bool
    osr: int
    reset: bool
    rx_room: int  # bytes that the next grant may bring


@dataclass(frozen=True)
class BoxSetup:
    """What makes one box different from another; `ring_slots` blocks of 13 samples wait while the link is held back."""

    uid: bytes = bytes.fromhex("e6614103e7452b2f")
    ring_slots: int = 160  # 2 s at 1 kHz
    config: dict[str, Any] | None = field(default=None)


def firmware_folder() -> Path:
    """The firmware's files: of the checkout, or those that the wheel carries."""
    here = Path(__file__).resolve()
    packed = here.parent / "_firmware"
    return packed if packed.is_dir() else here.parents[2] / "firmware"


def write_flash(folder: Path, config: dict[str, Any] | None) -> None:
    """Lay out the box's file system: firmware, wire, board, configuration."""
    skip = shutil.ignore_patterns("__pycache__", "*.pyc")
    shutil.copytree(firmware_folder(), folder, ignore=skip, dirs_exist_ok=True)
    shutil.copytree(Path(truearm_wire.__file__).parent, folder / "truearm_wire", ignore=skip)
    shutil.copyfile(Path(__file__).parent / "vm" / "board.py", folder / "board.py")
    if config is not None:
        (folder / "config.json").write_text(json.dumps(config))


class BoxProcess:
    """A running box. `interpreter` None: the firmware runs in CPython (no heap limit, no native code)."""

    def __init__(
        self,
        interpreter: Interpreter | None,
        setup: BoxSetup,
        boot_id: int,
        reset_cause: int = POWER,
        main: str = "main.py",
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="truearm-box-")
        folder = Path(self._folder.name)
        write_flash(folder, setup.config)
        argument = {
            "uid": list(setup.uid),
            "boot_id": list(boot_id.to_bytes(4, "big")),
            "reset_cause": reset_cause,
            "ring_slots": setup.ring_slots,
            "config": "config.json",
        }
        self._stderr = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [*_command(interpreter), main, json.dumps(argument)],
            cwd=folder,
            env={**os.environ, "MICROPYPATH": str(folder), "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            bufsize=0,
            start_new_session=True,  # Ctrl-C is for the parent, which ends this process in order
        )

    def grant(
        self,
        now_us: int,
        *,
        rx: bytes = b"",
        samples: bytes = b"",
        index: int = 0,
        edges: bytes = b"",
        tx_room: int = 0xFFFF,
        flags: int = 0,
        temperature_mdegc: int = 25000,
    ) -> Answer:
        """One step. `samples` are records of 20 bytes, the first with index `index` since the start of sampling.

        Raises BoxDied if the process has ended.
        """
        assert self._process.stdin is not None
        n_samples = len(samples) // RECORD
        if n_samples > SAMPLES_MAX or len(rx) > RX_MAX or len(edges) > 6 * EDGES_MAX:
            raise ValueError("more than fits a grant")
        head = GRANT.pack(
            b"G", flags, len(rx), n_samples, min(tx_room, 0xFFFF), now_us, index, temperature_mdegc, len(edges) // 6
        )
        try:
            # two writes of at most 4096 bytes: each arrives in one piece
            os.write(self._process.stdin.fileno(), head)
            if rx or samples or edges:
                os.write(self._process.stdin.fileno(), rx + samples + edges)
        except BrokenPipeError:
            raise BoxDied(self._last_words()) from None
        return self._answer()

    def _answer(self) -> Answer:
        magic, flags, osr, rx_room, n = ANSWER.unpack(self._read(ANSWER.size))
        if magic != b"D":
            raise BoxDied("the firmware wrote to standard output: " + repr(magic))
        return Answer(self._read(n) if n else b"", bool(flags & 1), osr, bool(flags & 2), rx_room)

    def _read(self, n: int) -> bytes:
        assert self._process.stdout is not None
        fd = self._process.stdout.fileno()
        data = b""
        while len(data) < n:
            piece = os.read(fd, n - len(data))
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
        """End the process and drop its file system."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._stderr):
            if pipe is not None:
                pipe.close()
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
