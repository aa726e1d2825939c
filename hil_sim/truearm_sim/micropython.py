"""Find a MicroPython to run the firmware in, and download one if there is none.

The simulated box needs a real MicroPython: the *unix port*, ≥ 1.25, preferably for 32 bit, which has the chip's word,
heap and object sizes. :func:`find` checks, in this order, ``$TRUEARM_MICROPYTHON``, a ``micropython`` on PATH and the
one downloaded by :func:`get`.

Many systems have no MicroPython package, or one that is too old. Debian 13's packages are suitable, and they run on any
Debian if each brings its own loader and C library. So :func:`get` downloads them (debian.py: nothing is installed, no
root is needed) and unpacks the interpreter, its loader and its libraries into one folder per word size::

    python3 -m truearm_sim.micropython --get
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import struct
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from . import debian
from .debian import DebianError

VARIABLE = "TRUEARM_MICROPYTHON"
MINIMUM = (1, 25)
# Debian 13, the first release with MicroPython ≥ 1.25. The next replaces it for an architecture whose lists are
# missing.
SUITES = ("trixie", "forky")
# 32 bit first. Debian's name of the computer's architecture → architectures whose programs it can usually run.
ARCHITECTURES = {"amd64": ("i386", "amd64"), "arm64": ("armhf", "arm64")}
BY_HAND = f"install MicroPython (unix port, {MINIMUM[0]}.{MINIMUM[1]} or newer) and set ${VARIABLE} to it"
PROBE = "import sys; v = sys.implementation; print(v.name, v.version[0], v.version[1], v.version[2], sys.maxsize)"


class InterpreterError(Exception):
    """No usable MicroPython; the text is one line that states why and what to do."""

    exit_code = 2


@dataclass(frozen=True)
class Interpreter:
    """A MicroPython that was run once: its path, its version and its word size in bits."""

    path: Path
    version: tuple[int, int, int]
    bits: int

    def __str__(self) -> str:
        return f"MicroPython {'.'.join(map(str, self.version))}, {self.bits} bit: {self.path}"


# ---- finding


def probe(path: Path) -> Interpreter:
    """Run ``path`` once and read version and word size.

    Raises:
        InterpreterError: it does not run, is not MicroPython or is older than ``MINIMUM``.
    """
    try:
        done = subprocess.run([path, "-c", PROBE], capture_output=True, text=True, timeout=30, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InterpreterError(f"{path} does not run ({error}); {BY_HAND}") from error
    words = done.stdout.split()
    if done.returncode or len(words) != 5 or words[0] != "micropython":
        why = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}, printed {done.stdout[:60]!r}"])[-1]
        raise InterpreterError(f"{path} is not a MicroPython that runs here ({why}); {BY_HAND}")
    major, minor, patch, maxsize = map(int, words[1:])
    if (major, minor) < MINIMUM:
        raise InterpreterError(f"{path} is MicroPython {major}.{minor}, too old; {BY_HAND}")
    return Interpreter(path, (major, minor, patch), 64 if maxsize > 2**32 else 32)


def find(environ: Mapping[str, str] = os.environ, fetched: Path | None = None) -> Interpreter | None:
    """Return the MicroPython to use, or None.

    ``fetched`` is the folder of :func:`get`, by default :func:`default_destination`. An unusable interpreter on PATH or
    in that folder is skipped. If the one in ``$TRUEARM_MICROPYTHON`` is unusable, that is an error.

    Raises:
        InterpreterError: ``$TRUEARM_MICROPYTHON`` names something that is not a usable MicroPython.
    """
    search_path = environ.get("PATH", os.defpath)
    if named := environ.get(VARIABLE):
        found = shutil.which(named, path=search_path)
        if found is None:
            raise InterpreterError(f"${VARIABLE} is {named!r}, which is not a program; {BY_HAND}, or unset it")
        return probe(Path(found))
    on_path = shutil.which("micropython", path=search_path)
    fetched = fetched or default_destination()
    for path in ([Path(on_path)] if on_path else []) + [fetched / "micropython32", fetched / "micropython64"]:
        if path.exists():
            try:
                return probe(path)
            except InterpreterError:
                continue
    return None


def default_destination() -> Path:
    """Return build/micropython of the checkout that contains this file, otherwise a folder of the user's cache."""
    checkout = Path(__file__).resolve().parents[2]
    if (checkout / "pyproject.toml").exists():
        return checkout / "build" / "micropython"
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(cache).expanduser() / "truearm" / "micropython"


# ---- getting


def get(destination: Path, say: Callable[[str], None] = print) -> Interpreter:
    """Download MicroPython with its loader and libraries into ``destination`` and return the one that runs here.

    Every word size that the computer may run is downloaded. The folder appears complete or not at all.

    Raises:
        InterpreterError: this computer has no apt or no Debian source, a download or its verification failed, or
            none of the downloaded interpreters runs here.
    """
    if missing := debian.missing_program():
        raise InterpreterError(f"cannot get MicroPython here: no {missing}, which Debian has; {BY_HAND}")
    try:
        destination.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{destination.name}-", dir=destination.parent) as work:
            tree = Path(work) / "tree"
            _unpack(_download(Path(work) / "apt", say), tree)
            working = _first_that_runs(tree)
            _replace(tree, destination, Path(work) / "old")
    except DebianError as error:
        raise InterpreterError(f"cannot get MicroPython here: {error}; {BY_HAND}") from error
    except OSError as error:
        raise InterpreterError(f"cannot write {destination} ({error}); {BY_HAND}") from error
    return probe(destination / working.path.name)


def _download(apt: Path, say: Callable[[str], None]) -> list[Path]:
    """Download the packages of MicroPython and its dependencies, for each architecture, below ``apt``."""
    native = debian.native_architecture()
    packages = []
    for architecture in ARCHITECTURES.get(native, (native,)):
        try:
            packages += _packages_for(architecture, SUITES, apt, say)
        except DebianError as error:
            if architecture == native:
                raise
            say(f"MicroPython: not for {architecture}: {error}")  # a mirror may have only the native architecture
    return packages


def _packages_for(architecture: str, suites: Sequence[str], apt: Path, say: Callable[[str], None]) -> list[Path]:
    """Return the packages for one architecture from the first of ``suites`` that has them.

    Mirrors are updated in steps.

    Raises:
        DebianError: none has them; the text is that of the last one.
    """
    suite, *later = suites
    folder = apt / f"{architecture}-{suite}"
    say(f"MicroPython: downloading it for {architecture} from Debian {suite}")
    try:
        environ = debian.private_apt(folder, suite, (architecture,), pauses=() if later else debian.PAUSES)
        debian.run(["apt-get", "-qq", "-y", "--download-only", "install", f"micropython:{architecture}"], environ)
    except DebianError as error:
        if not later:
            raise
        say(f"MicroPython: not from {suite}: {error}")
        return _packages_for(architecture, later, apt, say)
    return sorted((folder / "cache" / "archives").glob("*.deb"))


def _unpack(packages: list[Path], tree: Path) -> None:
    """Create one flat folder per architecture with interpreter, loader and libraries, and a launcher next to it."""
    for architecture in (path.stem.rpartition("_")[2] for path in packages if path.name.startswith("micropython_")):
        folder = tree / architecture
        folder.mkdir(parents=True)
        for package in packages:
            if package.name.endswith(f"_{architecture}.deb"):
                _unpack_package(package, folder)
        elf = (folder / "micropython").read_bytes()
        launcher = tree / f"micropython{elf_bits(elf)}"
        launcher.write_text(
            f'#!/bin/sh\nroot=$(dirname "$(readlink -f "$0")")/{architecture}\n'
            f'exec "$root/{Path(elf_interpreter(elf)).name}" --library-path "$root" "$root/micropython" "$@"\n'
        )
        launcher.chmod(0o755)


def _unpack_package(package: Path, folder: Path) -> None:
    """Unpack a package's interpreter and shared libraries, without their folders; links only within the folder."""
    wanted = re.compile(r"\./(?:usr/)?(?:bin/micropython|lib\d*/(?:[\w-]+/)?[^/]+\.so[^/]*)")
    with (
        subprocess.Popen(["dpkg-deb", "--fsys-tarfile", package], stdout=subprocess.PIPE) as dpkg,
        tarfile.open(fileobj=dpkg.stdout, mode="r|") as tar,
    ):
        for member in tar:
            path = folder / Path(member.name).name
            if not wanted.fullmatch(member.name):
                continue
            if member.issym() and Path(member.linkname).name != path.name and not path.exists():
                path.symlink_to(Path(member.linkname).name)
            elif member.isfile():
                stream = tar.extractfile(member)
                path.unlink(missing_ok=True)
                path.write_bytes(stream.read() if stream else b"")
                path.chmod(0o755)
    if dpkg.returncode:
        raise InterpreterError(f"{package.name} cannot be unpacked (dpkg-deb: {dpkg.returncode}); try again")


def elf_bits(elf: bytes) -> int:
    """Return the word size of an ELF program."""
    return {1: 32, 2: 64}[elf[4]]


def elf_interpreter(elf: bytes) -> str:
    """Return the loader that an ELF program requests (its PT_INTERP segment), as a path."""
    wide, order = elf_bits(elf) == 64, {1: "<", 2: ">"}[elf[5]]
    (table,) = struct.unpack_from(order + ("Q" if wide else "I"), elf, 32 if wide else 28)
    size, count = struct.unpack_from(order + "HH", elf, 54 if wide else 42)
    for header in range(table, table + size * count, size):
        if struct.unpack_from(order + "I", elf, header) == (3,):  # PT_INTERP
            (start,) = struct.unpack_from(order + ("Q" if wide else "I"), elf, header + (8 if wide else 4))
            return elf[start : elf.index(b"\0", start)].decode()
    raise InterpreterError(f"Debian's micropython names no loader; {BY_HAND}")


def _first_that_runs(tree: Path) -> Interpreter:
    reasons = []
    for name in ("micropython32", "micropython64"):
        if (tree / name).exists():
            try:
                return probe(tree / name)
            except InterpreterError as error:
                reasons.append(str(error))
    raise InterpreterError("; ".join(reasons) or f"Debian has no micropython for this machine; {BY_HAND}")


def _replace(new: Path, destination: Path, old: Path) -> None:
    """Move ``new`` to ``destination``; its previous content goes to ``old``."""
    if destination.exists():
        destination.rename(old)
    new.rename(destination)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="micropython.py", description="Find the MicroPython that the simulator uses.")
    parser.add_argument("--get", action="store_true", help="download one where none is found")
    parser.add_argument("--force", action="store_true", help="with --get: download in any case")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help=f"where to (default: {default_destination()})")
    options = parser.parse_args(arguments)
    destination = (options.to or default_destination()).absolute()
    try:
        interpreter = None if options.force else find(fetched=destination)
        if interpreter is None and (options.get or options.force):
            interpreter = get(destination, lambda text: print(text, flush=True))
    except InterpreterError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    if interpreter is None:
        print(f"error: no MicroPython found; run this with --get, or {BY_HAND}", file=sys.stderr)
        return 2
    print(interpreter)
    return 0


if __name__ == "__main__":
    sys.exit(main())
