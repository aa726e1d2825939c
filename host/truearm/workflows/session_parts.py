"""Sessions in several files: ``session.mcap``, ``session.2.mcap`` …, one for each continuation (docs/decisions/0014).

A recorded file is never written again. Each part is a session with its own clocks; results are computed from all parts
together.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from truearm.disk import same_file
from truearm.errors import Argument, InputError, SessionError
from truearm.findings import Finding
from truearm.record.write_lock import is_held
from truearm.types import Move

if TYPE_CHECKING:
    from truearm.live.state import SessionProgress
    from truearm.session.session_file import Session

SUFFIX = ".mcap"
SETUP = "setup"  # metadata record with the session that a part belongs to, and how it was recorded
_PART = re.compile(r"(.+)\.([1-9][0-9]{0,5})")


@dataclass(frozen=True)
class Earlier:
    """Data from the previous parts: how to continue, and the progress so far. ``out``: file of the next part."""

    first: Path
    out: Path
    number: int
    begun: str  # when, according to the first part
    setup: Mapping[str, str]
    rows: list[dict[str, Any]] = field(default_factory=list)
    rig_toml: bytes | None = None
    mounted: dict[str, str] = field(default_factory=dict)
    stops: tuple[tuple[str, int | None], ...] = ()  # dwells and lines, with their rows of the plan, None if not in it
    damaged: tuple[Path, ...] = ()  # parts that other commands refuse


def session_parts(path: Path) -> list[Path]:
    """Return a session's file and its continuations in order; for a later part, only that part. Raises SessionError."""
    paths = [path.with_name(f"{path.stem}.{number}{SUFFIX}") for number in _numbers(path)]
    first = _opened(path) if paths else None
    return [path, *(path for path in paths if first is not None and _goes_on(_opened(path), first))]


def further_parts(session: Path, out: Path | None = None) -> list[Finding]:
    """Return which parts a command did not read that wrote ``out`` from the first. Raises SessionError."""
    names = [path.name for path in session_parts(session)[1:]]
    values = {"session": session.name, "parts": names, "out": None if out is None else out.name}
    return [Finding("further-parts", values)] if names else []


def _numbers(path: Path) -> list[int]:
    """Return the numbers of the files that are further parts by name, in order."""
    numbers = [
        int(m[2]) for p in path.parent.glob(f"*{SUFFIX}") if (m := _PART.fullmatch(p.stem)) and m[1] == path.stem
    ]
    return sorted(number for number in numbers if number > 1)


def _goes_on(session: Session, first: Session) -> bool:
    """Return whether a part belongs to this session and not to an overwritten one of the same name."""
    setup = session.metadata.get(SETUP, {})
    return setup.get("of") == first.path.name and setup.get("begun") in (None, _begun(first))


def _begun(first: Session) -> str:
    return first.metadata.get("session", {}).get("utc_ns", "")


def recorded_model(path: Path) -> str:
    """Return the robot, or its file, for which a session was recorded; "" if the session does not name one."""
    from mcap.opcode import Opcode

    from truearm.file_names import open_input
    from truearm.session.session_file import MAX_METADATA_BYTES, Unreadable, parse_metadata, records

    with suppress(InputError, Unreadable), open_input(path) as file:
        for opcode, _, length in records(file, path.stat().st_size):
            if opcode == Opcode.METADATA and length <= MAX_METADATA_BYTES:
                name, entries, _ = parse_metadata(file.read(length))
                if name == SETUP:
                    return entries.get("model", "")
    return ""


def first_stem(path: Path) -> str:
    """Return the name of a session's first file without its suffix."""
    match = _PART.fullmatch(path.stem)
    return match[1] if match and path.with_name(match[1] + SUFFIX).exists() else path.stem


def with_parts(inputs: Sequence[Path]) -> list[Path]:
    """Return inputs with the further parts of each session after it; parts also given keep their place. Raises
    SessionError.
    """
    paths: list[Path] = []
    for path in inputs:
        files = session_parts(path)[1:] if path.suffix.lower() == SUFFIX else []
        paths += [path, *(file for file in files if not any(same_file(file, named) for named in inputs))]
    return paths


def is_part(path: Path, inputs: list[Path]) -> bool:
    """Return whether a file continues another of the inputs, or another of them continues it."""
    firsts = {file: file.with_name(f"{m[1]}{SUFFIX}") for file in inputs if (m := _PART.fullmatch(file.stem))}
    return firsts.get(path) in inputs or path in firsts.values()


def earlier(path: Path) -> Earlier:
    """Return the data of the session to which ``path`` belongs, one of its parts.

    A part without its end (the recorder was killed) is read as far as possible. Raises InputError, SessionError; also
    for a session that is still being written, because two recorders would take box and robot from each other.
    """
    import msgspec

    from truearm.session.joint_format import are_joints

    first = _first(path)
    sessions = [open_finished(session_path, allow_damaged=True) for session_path in session_parts(first)]
    setup = dict(sessions[0].metadata.get(SETUP, {}))
    rows: list[dict[str, Any]] = []
    mounted: dict[str, str] = {}
    stops: list[tuple[str, int | None]] = []
    for number, session in enumerate(sessions):
        setup |= session.metadata.get(SETUP, {})
        for message in sorted(session.messages(["/plan", "/events"]), key=attrgetter("t_host_ns")):
            try:
                row = msgspec.json.decode(message.data, type=dict[str, Any])
            except (msgspec.MsgspecError, RecursionError) as exc:
                raise _damaged(session.path) from exc
            if message.topic == "/plan":
                if not are_joints(row.get("q")) or len(row["q"]) != len((rows or [row])[0]["q"]):
                    raise _damaged(session.path)
                rows += [row] * (number == 0)
            elif row.get("kind") == "mounted":
                mounted = {k: v for k, v in row.items() if k != "kind" and isinstance(v, str)}
            elif (kind := row.get("kind")) in (Move.DWELL, Move.LINE):
                stops.append((kind, row.get("pose")))
    number = max([1, *_numbers(first)]) + 1
    out = first.with_name(f"{first.stem}.{number}{SUFFIX}")
    return Earlier(
        first,
        out,
        number,
        _begun(sessions[0]),
        setup,
        rows,
        sessions[0].attachments.get("rig.toml"),
        mounted,
        tuple(stops),
        tuple(session.path for session in sessions if session.truncated or session.damage),
    )


def gone_on(progress: SessionProgress, earlier_parts: Earlier) -> None:
    """Count what was taken before."""
    for move, pose in earlier_parts.stops:
        progress.note(move, pose if type(pose) is int and 0 <= pose < len(progress.rows) else None)


def open_finished(path: Path, allow_damaged: bool = False) -> Session:
    """Open a session as ``open_session`` does, unless a recorder still writes it: it would be another one a moment later.

    Raises SessionError.
    """
    from truearm.session.session_file import open_session

    try:
        session = open_session(path, allow_damaged)
        unfinished = session.truncated and is_held(path)
    except SessionError:
        if not (path.is_file() and is_held(path)):
            raise
        unfinished = True
    if unfinished:
        raise SessionError("in-use", place=path)
    return session


def _first(path: Path) -> Path:
    if not path.is_file():
        raise InputError(Argument("resume"), f" {path}: no such file; record a new session with ", Argument("out"))
    session = _opened(path)
    first_name = Path(session.metadata.get(SETUP, {}).get("of", "")).name
    first = path.with_name(first_name) if first_name else path
    return first if first.is_file() and _goes_on(session, _opened(first)) else path


def _opened(path: Path) -> Session:
    from truearm.session.session_file import open_session

    return open_session(path, allow_damaged=True)


def _damaged(path: Path) -> SessionError:
    plan = "; give the plan again with ", Argument("plan"), ", or record a new session"
    return SessionError(Argument("resume"), f" {path}: its plan or its events are damaged", *plan)
