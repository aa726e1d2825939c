"""The firmware as files onto a stock MicroPython, by MicroPython's own tool mpremote, which is not a dependency of truearm's.

Some 60 kB of sources; the image of ``make uf2`` starts faster and leaves more memory. ``main.py`` goes last, so a copy that
breaks off leaves a board that starts nothing.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from truearm.errors import InputError, LinkError

LOWEST = (1, 25)
FOLDERS = ("chips", "drivers", "truearm_box", "truearm_wire")
_ASK = "import sys; i = sys.implementation; print('is', i[0], i[1][0], i[1][1], i[2])"
_PATIENCE_S = 120.0


def mpremote() -> list[str]:
    """The command that runs mpremote. Raises InputError if there is none."""
    found = shutil.which("mpremote")
    if found:
        return [found]
    if importlib.util.find_spec("mpremote") is not None:
        return [sys.executable, "-m", "mpremote"]
    raise InputError("copying files to a stock MicroPython takes mpremote; install it: pip install 'truearm[stock]' or mpremote")


def lay_out(folder: Path, firmware: Path, wire: Path) -> list[Path]:
    """Copy what a Pico needs to ``folder``; returns what is to be copied on, in order. Raises InputError."""
    try:
        for name in FOLDERS:
            source = wire if name == wire.name else firmware / name
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "py.typed"))
        shutil.copyfile(firmware / "board_pico.py", folder / "board.py")
        shutil.copyfile(firmware / "main.py", folder / "main.py")
    except (OSError, shutil.Error) as exc:
        raise InputError(f"{firmware}: is not the folder of the box's firmware ({exc})") from exc
    return [folder / name for name in (*FOLDERS, "board.py", "main.py")]


def check_version(device: str, tool: Sequence[str]) -> str:
    """What runs on the board, "MicroPython 1.25 on …". Raises LinkError if it does not answer, InputError if it cannot serve."""
    answer = run([*tool, "connect", device, "exec", _ASK])
    found = re.search(r"^is (\w+) (\d+) (\d+) (.*)$", answer, re.MULTILINE)
    if found is None:
        raise LinkError(f"{device}: no MicroPython answers there")
    name, major, minor, machine = found.groups()
    if name != "micropython" or (int(major), int(minor)) < LOWEST:
        raise InputError(
            f"{device}: runs {name[:20]} {major}.{minor}; MicroPython {LOWEST[0]}.{LOWEST[1]} or newer is needed"
        )
    if "RP2040" not in machine:
        raise InputError(f"{device}: is a {machine.strip()[:60]!r}; the box is a Raspberry Pi Pico (RP2040)")
    return f"MicroPython {major}.{minor} on {machine.strip()[:60]}"


def copy_firmware(device: str, firmware: Path, wire: Path, tool: Sequence[str]) -> None:
    """Copy the firmware and restart the board. Raises LinkError, InputError."""
    with tempfile.TemporaryDirectory(prefix="truearm-stock-") as folder:
        *parts, main = lay_out(Path(folder), firmware, wire)
        run([*tool, "connect", device, "fs", "cp", "-r", *map(str, parts), ":"])
        run([*tool, "connect", device, "fs", "cp", str(main), ":main.py", "+", "reset"])


def run(command: Sequence[str]) -> str:
    """What mpremote printed. Raises LinkError with its last line if it failed."""
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=_PATIENCE_S
        )
    except subprocess.TimeoutExpired as exc:
        raise LinkError(
            f"mpremote did not end in {_PATIENCE_S:g} s; is the board stuck? unplug it and try again"
        ) from exc
    except OSError as exc:
        raise InputError(f"{command[0]}: cannot be run: {exc.strerror}") from exc
    if done.returncode:
        lines = (done.stderr.strip() or done.stdout.strip() or f"exit code {done.returncode}").splitlines()
        raise LinkError(f"mpremote: {lines[-1][:200]}")
    return done.stdout
