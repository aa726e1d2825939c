"""Read external files within limits, and write files atomically: a reader sees either the old file or the new one.

What to say of a file that does not exist or that the system refuses; the kinds of file by their first bytes; and the
lock of a file that is being written.
"""

from __future__ import annotations

import difflib
import errno
import hashlib
import os
import platform
import re
import shutil
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from truearm.errors import InputError, MissingFileError, WriteError
from truearm.schema import load_toml

# -------------------------------------------------------------------------------------------------------- kinds of file

HEAD = 4096  # bytes


class FileKind(NamedTuple):
    """A kind of file: its description, the suffixes of its name (none: any), and a pattern of its beginning."""

    description: str
    suffixes: tuple[str, ...]
    beginning: bytes

    def fits(self, head: bytes) -> bool:
        """Return whether a file with this beginning is of this kind."""
        return re.search(self.beginning, head, re.MULTILINE | re.IGNORECASE) is not None


RIG_KEYS = rb"^(\[\[?(bar|chuck|sphere|socket|target|tracker|line)\b|\w+_sigma_(m|mm|rad|deg)\s*=)"
PLAN_HEADER = rb'\A[\xef\xbb\xbf\s]*+(?!.*\bkind\b)([\w" ]*,)*[" ]*pose[" ]*[,\r\n]'  # its columns stand in any order
KINDS = {
    "session": FileKind("a session (.mcap)", (".mcap",), rb"\A\x89MCAP"),
    "result": FileKind("a result (result.json)", (".json",), rb'\A\s*\{\s*"format":\s*"truearm-result"'),
    "page": FileKind("a page (.html)", (".html",), rb'<meta name="generator" content="truearm">'),
    "picture": FileKind("a map (.svg)", (".svg",), rb"\A<svg[^\0]*Error of"),
    "robot": FileKind("a robot (.toml or .urdf)", (), rb"<robot\b|^convention\s*="),
    "exported": FileKind("a robot for another program", (), rb"written by truearm export"),
    "noise": FileKind("a noise file (.toml)", (".toml",), rb"\A# noise of a robot"),
    "plan": FileKind("a plan (plan.csv)", (".csv",), PLAN_HEADER),
    "program": FileKind("a program", (), rb"\A(pose,|def truearm_|MODULE truearm_)"),
    "map": FileKind("a map (.csv)", (".csv",), rb"\Au_mm,v_mm"),
    "fleet": FileKind("a table of arms (.csv)", (".csv",), rb"\Aarm,robot,serial"),
    "curves": FileKind("a table of error curves (.csv)", (".csv",), rb"\Ajoint,reading_deg,error_mrad"),
    "targets": FileKind("a table of targets (.csv)", (".csv",), rb"\A.*\bafter_mm\b"),
    "table": FileKind("a table of observations (.csv)", (".csv",), rb"\A(\w+,)*kind,"),
    "project": FileKind("a project's file (truearm.toml)", (".toml",), rb"^model\s*="),
    "rig": FileKind("a rig (rig.toml)", (".toml",), RIG_KEYS),
    "truth": FileKind("the truth of a simulation (.json)", (".json",), rb'"truearm-truth"'),
    "configuration": FileKind("a box's configuration (.toml)", (".toml",), rb"\A# The configuration of a truearm box"),
}


def kind_of(path: Path) -> str | None:
    """Return the kind of a file, a key of ``KINDS``; None if it is no file or its kind is not recognised."""
    try:
        if not path.is_file():  # a pipe would be waited for
            return None
        with path.open("rb") as file:
            head = file.read(HEAD)
    except (OSError, ValueError):
        return None
    return next((name for name, kind in KINDS.items() if kind.fits(head)), None)


# -------------------------------------------------------------------------------------------------------------- opening

MOST_NAMES = 10_000  # of a folder that are compared


def open_input(path: Path) -> BufferedReader:
    """Open a regular file for reading. Raises MissingFileError if there is none, InputError if it cannot be read."""
    if "\0" in str(path) or (os.path.exists(path) and not os.path.isfile(path)):
        raise InputError("unreadable-file", place=path)  # reading a pipe or a device would block or never end
    with reading(path):
        return path.open("rb")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what the system says about a file that it cannot read into InputError."""
    try:
        yield
    except FileNotFoundError as exc:
        raise missing_file(path) from exc
    except OSError as exc:
        raise InputError("unreadable-file", place=path, reason=system_reason(exc)) from exc


def missing_file(path: Path) -> MissingFileError:
    """Return the error for a file that does not exist, with the name that was probably meant."""
    folder = path.parent
    try:
        if not folder.is_dir():
            return MissingFileError("missing-file", place=path, folder=folder)
        names = [entry.name for entry in islice(folder.iterdir(), MOST_NAMES) if entry.name != path.name]
        if path.suffix:  # "results" is a folder, not what "result.json" should have been
            names = [name for name in names if not (folder / name).is_dir()]
    except OSError:  # a folder that may not be listed
        names = []
    close = difflib.get_close_matches(path.name, names, n=1, cutoff=0.75)
    meant = str(folder / close[0]) if close else ""
    return MissingFileError("missing-file", place=path, meant=meant)


DISK_FAILED = (errno.ENOSPC, errno.EDQUOT, errno.EIO)  # whatever the name of the file
_REMEDIES = {
    errno.EACCES: "change its permissions, or use another folder",
    errno.EPERM: "change its permissions, or use another folder",
    errno.EROFS: "use another folder",
    errno.ENAMETOOLONG: "use a shorter name",
    errno.ENOTDIR: "check the path: a file stands where a folder should be",
    errno.EISDIR: "give a file, not a folder",
    errno.ENOSPC: "free some space, or use another disk",
    errno.EDQUOT: "free some space, or use another disk",
    errno.EMFILE: "close other programs",
    errno.ENFILE: "close other programs",
    errno.EIO: "copy it to another disk: this one may fail",
}


def system_reason(exc: Exception) -> str:
    """Return the system's reason, and what to do about it."""
    reason, number = getattr(exc, "strerror", None) or str(exc), getattr(exc, "errno", None) or 0
    return f"{reason}; {_REMEDIES.get(number, 'check the path, the disk and its permissions')}"


# ---------------------------------------------------------------------------------------------------------------- locks
#
# The process that writes a session holds a lock on it, so that other programs can see whether a recording is still
# running. The lock is the operating system's (flock): it is released when the process ends, in whatever way. It
# prevents nobody from reading or deleting the file. If the system has no locks, or a network drive refuses them, a file
# that was written to recently counts as held.

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

A_MOMENT_S = 5.0  # a recorder writes every second


def hold(file: BinaryIO) -> bool:
    """Hold a file that is open for writing until it is closed; return False if another process holds it."""
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a drive without locks: the recording continues
            pass
    return True


def is_held(path: Path) -> bool:
    """Return whether some process is writing to a file."""
    if fcntl is not None:
        try:
            with path.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return False
        except BlockingIOError:
            return True
        except OSError:
            pass
    return time.time() - path.stat().st_mtime < A_MOMENT_S


# -------------------------------------------------------------------------------------------------- reading and writing

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
    """Make ``path`` a folder whose files truearm may replace.

    It is a new or empty one, or one that contains the file ``mark``.

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
