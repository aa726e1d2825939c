"""Read external files within limits, and write files atomically: a reader sees either the old file or the new one."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from truearm.errors import InputError, WriteError
from truearm.file_kind import HEAD, KINDS
from truearm.file_names import DISK_FAILED, open_input, reading, system_reason
from truearm.schema import load_toml

SESSION_MAGIC = b"\x89MCAP"
COMPRESSED = ".xz"
MOST_DICTIONARY = 2**27  # bytes that decompression may use; xz -9 needs 65 MiB


def read_bytes(path: Path, max_bytes: int, error: type[InputError]) -> bytes:
    """Return the content of a regular file of at most ``max_bytes``, of an .xz file after it is decompressed.

    Raises ``error`` for anything else.
    """
    with open_input(path) as file, reading(path):
        data = file.read(max_bytes + 1)
    if path.suffix.lower() == COMPRESSED and len(data) <= max_bytes:
        data = _decompressed(data, path, max_bytes, error)
    if len(data) > max_bytes:
        raise error("too-large", place=path, most=f"{max_bytes / 2**20:.0f} MiB")
    return data


def _decompressed(data: bytes, path: Path, max_bytes: int, error: type[InputError]) -> bytes:
    """Return at most ``max_bytes`` + 1 bytes of xz data; what follows is not decompressed."""
    import lzma  # slow to import

    text = b""
    while data and len(text) <= max_bytes:  # a file may have several streams
        stream = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=MOST_DICTIONARY)
        try:
            text += stream.decompress(data, max_bytes + 1 - len(text))
        except (lzma.LZMAError, MemoryError) as exc:
            raise error(f"{path}: cannot be decompressed: {exc}; compress the file again, with xz") from exc
        if not stream.eof and len(text) <= max_bytes:
            raise error(f"{path}: is incomplete; copy it again")
        data = stream.unused_data.lstrip(b"\0")
    return text


def read_text(path: Path, max_bytes: int, error: type[InputError]) -> str:
    """Return the text of a UTF-8 file (with or without a byte order mark), with the limits of ``read_bytes``."""
    data = read_bytes(path, max_bytes, error)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as exc:
        if data.startswith(SESSION_MAGIC):
            named = path.suffix.lower() == ".mcap"
            raise error(
                f"{path}: is a session; {'' if named else 'where a session is wanted, its name must end in .mcap; otherwise '}"
                "give what truearm identify writes of it: a table (--table-out FILE) or a result (--out FILE)"
            ) from exc
        raise error("not-text", place=path, byte=exc.start) from exc
    if "\0" in text:
        raise error("not-text", place=path, byte=text.index("\0"))
    return text


def parse_toml(
    text: str, name: str, error: type[InputError], parse_float: Callable[[str], Any] = float
) -> dict[str, Any]:
    """Return TOML text as a dictionary. Raises ``error`` for text that is not TOML or is nested too deeply.

    ``parse_float`` converts TOML's floats to numbers, and may raise ValueError.
    """
    try:
        return load_toml(text, parse_float)
    except tomllib.TOMLDecodeError as exc:
        raise error(f"{name}: is not TOML: {exc}; correct this place") from exc
    except RecursionError as exc:
        raise error(f"{name}: is nested too deeply") from exc
    except ValueError as exc:  # tomllib passes on errors of int()'s limit of digits and of impossible dates
        raise error(f"{name}: is not usable TOML: {exc}; correct this place") from exc


def write_atomic(path: Path, text: str | bytes | Iterator[str]) -> None:
    """Write bytes, or text or its pieces as UTF-8, to a file in a temporary folder next to ``path`` and move it there.

    If ``path`` is a symbolic link, the link remains and its target is replaced. Raises InputError if the folder is
    missing or not writable, or if ``path`` is not a regular file; WriteError if the disk is full or fails; and what
    making a piece raises.
    """
    path = _real(path)
    _check_regular(path)
    with replacing(path) as new:
        _write(new, (text,) if isinstance(text, str | bytes) else text)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give the path of a new file or folder, which replaces ``path`` at the end and is removed after an error.

    Raises InputError, WriteError if the system refuses to write.
    """
    with _writing(path), working_folder(path.parent) as folder:
        yield folder / "new"
        os.replace(folder / "new", path)


@contextmanager
def _writing(path: Path, refusal: str = "cannot be written") -> Iterator[None]:
    """Turn what the system refuses into WriteError, if the disk is full or fails, or InputError for a wrong name."""
    try:
        yield
    except OSError as exc:
        text = f"{path}: {refusal}: {system_reason(exc)}"
        raise (WriteError(text, exc.strerror or "") if exc.errno in DISK_FAILED else InputError(text)) from exc


def _write(path: Path, pieces: Iterable[str | bytes]) -> None:
    with path.open("wb") as file:
        for piece in pieces:
            file.write(piece.encode() if isinstance(piece, str) else piece)
        file.flush()
        os.fsync(file.fileno())


def check_new_folder(path: Path, source: Path) -> None:
    """Raise InputError if ``path`` cannot become a new folder, or would be within the folder ``source``."""
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise InputError("file-exists", place=path, folder=True)
    _check_parent(path)
    if _real(path).is_relative_to(_real(source)):
        raise InputError(f"{path}: is within {source}, whose files it would join; give a folder elsewhere")


def write_folder(path: Path, contents: Mapping[str, bytes]) -> None:
    """Write files by their paths within a new folder, all of them or none.

    Raises InputError if the folder cannot be written, WriteError if the disk is full or fails.
    """
    with replacing(path) as new:
        new.mkdir()
        for name, data in contents.items():
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            _write(new / name, (data,))


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal text, read in blocks. Raises InputError if it cannot be read."""
    with open_input(path) as file, reading(path):
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_writable(
    path: Path,
    force: bool = True,
    *,
    inputs: Iterable[Path] = (),
    kind: str | None = None,
    suffixes: Sequence[str] = (),
) -> None:
    """Raise InputError if ``path`` cannot become a file, or should not.

    Called before long computations, in addition to handling errors when writing. ``inputs`` are files that must not be
    overwritten. ``kind``: a key of ``KINDS``; an existing file may be replaced with ``force`` if it is of this kind or
    empty. A name may have one of the ``suffixes``, by default those of the kind, or none, since other programs, and
    truearm when it reads the file again, go by the suffix.
    """
    suffixes = suffixes or (KINDS[kind].suffixes if kind else ())
    with _writing(path):  # a name may be too long, or a folder closed
        if path.is_dir():
            raise InputError("unreadable-file", place=path)
        _check_regular(path)
        if any(same_file(path, given_file) for given_file in inputs):
            raise InputError("given-twice", place=path)
        _check_parent(path)
        if kind and path.exists():
            with path.open("rb") as file:
                head = file.read(HEAD)
            if head.strip() and not KINDS[kind].fits(head):
                raise InputError("file-exists", place=path, foreign=True)
        if path.exists() and not force:
            raise InputError("file-exists", place=path, may_force=True)
    if suffixes and path.suffix and path.suffix.lower() not in suffixes:
        raise InputError("wrong-suffix", place=path, suffixes=" or ".join(suffixes))


def check_outputs(outputs: Iterable[tuple[str, Path | None]], force: bool, inputs: Iterable[Path]) -> None:
    """Raise InputError if a file to write, of a kind, cannot be written or would replace an input or another output.

    None stands for a file that is not wanted.
    """
    earlier = list(inputs)
    for kind, path in outputs:
        if path is not None:
            check_writable(path, force, inputs=earlier, kind=kind)
            earlier.append(path)


def _check_parent(path: Path) -> None:
    if not path.parent.is_dir():
        raise InputError("missing-file", place=path, folder=path.parent)
    if not os.access(path.parent, os.W_OK):
        text = f"{path}: the folder {path.parent} cannot be written; choose another folder, or change its permissions"
        raise InputError(text)


def same_file(a: Path, b: Path) -> bool:
    """Return whether two names refer to one file, or would, also through links."""
    try:
        return a.samefile(b)
    except OSError:
        return _real(a) == _real(b)


def _real(path: Path) -> Path:
    """Return the target of a path; unlike ``Path.resolve`` this accepts circular links."""
    return Path(os.path.realpath(path))


@contextmanager
def working_folder(parent: Path) -> Iterator[Path]:
    """Create a temporary folder in ``parent`` and remove it afterwards.

    Folders left there by killed processes of this computer are removed too. Raises OSError if the folder cannot be
    created.
    """
    ours = f".truearm-{re.sub(r'[^A-Za-z0-9]', '', platform.node())[:40]}-"
    for old_folder in parent.glob(f"{ours}*"):
        process = old_folder.name.removeprefix(ours).partition("-")[0]
        if process.isdecimal() and not _is_running(int(process)):
            shutil.rmtree(old_folder, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=f"{ours}{os.getpid()}-", dir=parent) as folder:
        yield Path(folder)


def _is_running(process: int) -> bool:
    if os.name != "posix":
        return True  # a signal of 0 would end the process
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def own_folder(path: Path, mark: str) -> None:
    """Make ``path`` a folder whose files truearm may replace: a new or empty one, or one that contains the file
    ``mark``.

    Raises InputError for any other folder, WriteError if the disk is full or fails.
    """
    with _writing(path, "cannot be used as a folder"):
        path.mkdir(parents=True, exist_ok=True)
        if not (path / mark).exists() and any(path.iterdir()):
            raise InputError("file-exists", place=path, folder=True)
        (path / mark).touch()


def _check_regular(path: Path) -> None:
    if path.is_symlink() and not path.exists() and _real(path).is_symlink():
        raise InputError(f"{path}: is a symbolic link loop; give another name")
    if path.exists() and not path.is_file():
        raise InputError("unreadable-file", place=path)
