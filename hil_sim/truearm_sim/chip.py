"""The sensor box at chip level: MicroPython's own RP2040 image with the firmware in it, in an emulator (hil_sim/chip).

This is the parent's half of hil_sim/chip/box.mjs, which describes the messages; it is a ``Hardware`` like ``VmBox``.
Drivers, PIO and DMA really run. While a grant runs, the parts request what they measure, and ``Signals`` answers. The
box's flash is one file, ``flash.bin`` in the boot's folder: an image of its littlefs, written at every erase and
program operation, so that it holds what a real flash would hold after a power failure.
"""

from __future__ import annotations

import json
import struct
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from . import node
from .box import COMMAND, LATER_US, POWER, RX_MAX, WATCHDOG, Answer, BoxDied, end_process
from .hardware import BAD_CRC, CONVERTER_RESET, CRASH, STALL, Boot, Edge
from .latency import USB_PACKET_NS

SCRIPT = node.SOURCES / "box.mjs"
STORE = "flash.bin"
# littlefs as created by MicroPython 1.25 on a Pico: 1408 KiB in erase blocks of 4 KiB
BLOCK, BLOCKS = 4096, 352
FILE_SYSTEM: dict[str, Any] = {
    "block_size": BLOCK,
    "block_count": BLOCKS,
    "prog_size": 256,
    "read_size": 128,
    "lookahead_size": 128,
    "cache_size": 1024,
}
FIRST_VERSION = 0x00020000  # of littlefs on disk; MicroPython upgrades it to 2.1 on its first write

GRANT = struct.Struct("<cBHHIQi")
EDGE_IN = struct.Struct("<BBQ")
ANSWER = struct.Struct("<BBQIH")
EDGE_OUT = struct.Struct("<BQ")
QUERY = struct.Struct("<BHQQQ")
CLOSED, STALLED, PROMPT = 1, 2, 4  # flags of a grant
SAMPLING, RESET, BOOT_LOADER, POWER_CUT = 1, 2, 4, 8  # flags of an answer
ANY_ROOM = 0xFFFF  # free space reported by a link that is never full; USB then accepts everything
# After a request whoever grants time looks often for its answer, which comes at the end of a grant.
LOOK_US = 100
ANSWERED_US = 10_000  # a clock request has its answer by then
SETTLING = 6  # conversions after a start that the driver discards (firmware/drivers/ads131m04.py)
_FAULTS: dict[int, dict[str, Any]] = {
    CRASH: {"pico": "crash"},
    BAD_CRC: {"part": "adc", "fault": "corrupt", "frames": 1},
    CONVERTER_RESET: {"part": "adc", "fault": "reset"},
}
_ENDS = {COMMAND: "reset", WATCHDOG: "watchdog", POWER: "power cut"}


def make_flash(path: Path, files: dict[str, bytes]) -> None:
    """Create a file system image that contains ``files``."""
    from littlefs import LittleFS

    fs = LittleFS(disk_version=FIRST_VERSION, **FILE_SYSTEM)
    for name, data in files.items():
        if "/" in name:
            fs.makedirs(name.rpartition("/")[0], exist_ok=True)
        with fs.open(name, "wb") as file:
            file.write(data)
    path.write_bytes(bytes(fs.context.buffer))


def read_flash(path: Path) -> dict[str, bytes]:
    """Return the files of a file system image, by path from its root. Raises littlefs's error if it is damaged."""
    from littlefs import LittleFS

    fs = LittleFS(mount=False, **FILE_SYSTEM)
    fs.context.buffer[:] = path.read_bytes()
    fs.mount()
    found = {}
    for folder, _, names in fs.walk("/"):
        for full in (f"{folder}/{name}".lstrip("/") for name in names):
            with fs.open(full, "rb") as file:
                found[full] = file.read()
    return found


class ChipBox:
    """A running box (``Hardware``). ``host_gone`` closes the host's port until it is set to False."""

    boot_ns = 0
    link_ns = USB_PACKET_NS

    def __init__(self, boot: Boot, *, prompt: bool = False, image: Path | None = None, start_us: int = 0) -> None:
        """``prompt``: each of its transfers is an answer, during the grant.

        ``start_us``: hardware timer value at power-on, for tests of its wrap-around; device times count from there.

        Raises NodeError if the emulator or the image is missing.
        """
        store = boot.flash / STORE
        if not store.exists():
            config = boot.setup.config
            make_flash(store, {"config.json": json.dumps(config).encode()} if config is not None else {})
        argument = {
            "uf2": str(image or node.image()),
            "store": str(store),
            "packetNs": self.link_ns,
            "cause": boot.cause,
            "uid": list(boot.setup.uid),
            "seed": boot.boot_id,
            "startNs": 1000 * start_us,
        }
        self._signals = boot.signals
        self.host_gone = False
        self._told: tuple[tuple[bytes, int], ...] = ()
        self._prompt = prompt
        self._latest = Answer(b"", False, 0, "", RX_MAX)
        self._output = False
        self._answered_us = 0  # when the latest request has its answer
        self._first_ns: list[int | None] = [None, None]
        self._stderr = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [node.ready().path, SCRIPT, json.dumps(argument)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            start_new_session=True,  # Ctrl-C is for the parent, which ends this process cleanly
        )

    def advance(
        self, device_us: int, rx: bytes, edges: Sequence[Edge], tx_room: int, flags: int, temperature_mdegc: int
    ) -> Iterator[Answer]:
        """Run one grant; see ``Hardware``."""
        for flag, message in _FAULTS.items():
            if flags & flag:
                self.control(message)
        self._warm(device_us)
        head = GRANT.pack(
            b"G",
            (CLOSED if self.host_gone else 0) | (STALLED if flags & STALL else 0) | (PROMPT if self._prompt else 0),
            len(rx),
            len(edges),
            0xFFFFFFFF if tx_room == ANY_ROOM else tx_room,
            1000 * device_us,
            temperature_mdegc,
        )
        self._write(head + rx + b"".join(EDGE_IN.pack(edge.line, edge.rising, edge.t_ns) for edge in edges))
        while (kind := self._read(1)) != b"D":
            if kind == b"?":
                self._answer_query()
            elif kind == b"T":
                yield self._latest._replace(tx=self._read(int.from_bytes(self._read(4), "little")), toggles=())
            else:
                raise BoxDied(f"the chip emulator wrote {kind!r}")
        if rx:
            self._answered_us = device_us + ANSWERED_US
        self._latest = self._answer(LOOK_US if device_us < self._answered_us else LATER_US)
        yield self._latest

    def control(self, message: dict[str, Any]) -> None:
        """Send a message to the emulator or one of its parts (box.mjs), mostly to cause faults."""
        text = json.dumps(message).encode()
        self._write(b"C" + struct.pack("<I", len(text)) + text)

    def close(self) -> None:
        """End the emulator: the power is cut."""
        end_process(self._process, self._stderr)

    def _warm(self, device_us: int) -> None:
        """Send the thermometers their temperatures, if these have changed."""
        now = self._signals.thermometers(device_us)
        if now != self._told:
            self._told = now
            each = [{"uid": uid.hex(), "mdegc": mdegc} for uid, mdegc in now]
            self.control({"part": "thermometers", "thermometers": each})

    def _answer_query(self) -> None:
        stream, n, index, t_ns, period_ns = QUERY.unpack(self._read(QUERY.size))
        if index == 0:
            self._first_ns[stream] = t_ns + (SETTLING * period_ns if stream == 0 else 0)
        self._write((self._shots if stream else self._conversions)(index, n, t_ns - index * period_ns, period_ns))

    def _conversions(self, index: int, n: int, start_ns: int, period_ns: int) -> bytes:
        """Return conversions from ``index`` on; those that the driver discards are 0, and samples count after them."""
        settling = min(n, max(0, SETTLING - index))
        k = index + settling - SETTLING
        counts = self._signals.counts(k, k + n - settling, start_ns + SETTLING * period_ns, period_ns)
        return bytes(16 * settling) + counts.astype("<i4").tobytes()

    def _shots(self, index: int, n: int, start_ns: int, period_ns: int) -> bytes:
        return self._signals.flight_times(index, index + n, start_ns, period_ns).astype("<i8").tobytes()

    def _answer(self, wake_us: int) -> Answer:
        flags, cause, _now_ns, n_tx, n_edges = ANSWER.unpack(self._read(ANSWER.size))
        tx = self._read(n_tx)
        edges = [EDGE_OUT.unpack(self._read(EDGE_OUT.size)) for _ in range(n_edges)]
        toggles = tuple((t_ns, bool(level)) for level, t_ns in edges)
        self._output = toggles[-1][1] if toggles else self._output
        end = "boot loader" if flags & BOOT_LOADER else _ENDS[cause] if flags & (RESET | POWER_CUT) else ""
        first_ns = (self._first_ns[0], self._first_ns[1])
        return Answer(
            tx,
            bool(flags & SAMPLING),
            0,
            end,
            RX_MAX,
            output=self._output,
            first_ns=first_ns,
            wake_us=wake_us,
            toggles=toggles,
        )

    def _write(self, data: bytes) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(data)
            self._process.stdin.flush()
        except BrokenPipeError:
            raise BoxDied(self._last_words()) from None

    def _read(self, n: int) -> bytes:
        assert self._process.stdout is not None
        data = self._process.stdout.read(n)
        if len(data) < n:
            raise BoxDied(self._last_words())
        return data

    def _last_words(self) -> str:
        self._process.wait(timeout=5)
        self._stderr.seek(0)
        lines = self._stderr.read().decode(errors="replace").strip().splitlines()
        told = [line for line in lines if "Error" in line] or lines[-1:]
        return "the chip emulator ended: " + (told[0].strip() if told else "no message")
