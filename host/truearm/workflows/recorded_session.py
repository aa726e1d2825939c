"""A recorded session: its file and the parts that continue it, what it says about its recording, and its observations.

``session.mcap`` is continued by ``session.2.mcap`` and so on (docs/decisions/0014): a recorded file is never written
again. Each part is a session with its own clocks; results are computed from all parts together. This is the interface
between the file (``record``) and its evaluation (``session``). It also gives samples and joint readings as arrays, and
the possible effect of temperature on lengths.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from truearm.box.condition import FAR, LVDT, LVDT_DRIFT, STEEL
from truearm.disk import is_held, same_file
from truearm.errors import Argument, InputError, RigError, SessionError
from truearm.findings import Finding
from truearm.session.plan_matching import read_labels
from truearm.text import counted, one_line, page
from truearm.types import DOUBTFUL, Floats, Move
from truearm.units import MM, PPM_PER_K

if TYPE_CHECKING:
    from truearm.live.state import SessionProgress
    from truearm.session.observations import Survey, SyncResult
    from truearm.session.session_file import Session, Source
    from truearm.session.session_tables import Columns
    from truearm.types import BallBar, Plan, Rig

SUFFIX = ".mcap"
SETUP = "setup"  # metadata record with the session that a part belongs to, and how it was recorded
_PART = re.compile(r"(.+)\.([1-9][0-9]{0,5})")
RIG = "rig.toml"
MOST_PLACES = 3  # of damage that are reported; inspect lists all


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

    from truearm.disk import open_input
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


def recovered_name(session: Path) -> Path:
    """Return the default path of a recovered session: ``session-recovered.mcap``."""
    return session.parent / f"{session.stem}-recovered.mcap"


def with_parts(inputs: Sequence[Path]) -> list[Path]:
    """Return inputs with the further parts of each session after it; parts also given keep their place.

    Raises SessionError.
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
    """Open a session as ``open_session`` does, unless a recorder still writes it.

    It would be another one a moment later.

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


def reasons_text(rejected: Mapping[str, int]) -> str:
    """Return ``3 gap, 1 rail``."""
    return ", ".join(f"{n} {reason}" for reason, n in sorted(rejected.items()))


def nothing_observed(path: Path, dwells: Mapping[str, int], passes: Mapping[str, int], planned: bool) -> SessionError:
    """Return the error of a session that gave no observation: why not, and which command helps.

    ``dwells`` and ``passes`` along lines: the rejected ones by reason. ``planned``: the session has a plan.
    """
    from truearm.session.dwells import needs_decision

    kinds = (("dwell", "dwells", dwells), ("motion along a line", "motions along a line", passes))
    rejected = [
        f"{counted(sum(reasons.values()), *nouns)} ({reasons_text(reasons)})" for *nouns, reasons in kinds if reasons
    ]
    undecided = sum(n for reason, n in dwells.items() if needs_decision(reason, planned))
    others = sum(dwells.values()) + sum(passes.values()) - undecided
    # One wrong label is a slip of the operator. If no reading fits its label, the prediction is wrong.
    helps = {"none_fits": set(dwells) == {DOUBTFUL}, "others": undecided and others, "unexplained": not undecided}
    file = shlex.quote(one_line(str(path)))
    return SessionError(
        "no-observation", place=path, rejected=" and ".join(rejected), undecided=undecided, file=file, **helps
    )


def is_session(path: Path) -> bool:
    """Return whether a file's name is that of a session."""
    return path.suffix.lower() == SUFFIX


def attached_rig(session: Session, path: Path) -> Rig | None:
    """Return the rig given to the recorder, None if there was none. Raises RigError if it is not a valid rig."""
    from truearm.kinds.rig_file import parse_rig

    data = session.attachments.get(RIG)
    if data is None:
        return None
    try:
        return parse_rig(data.decode(), f"{path}: {RIG}")
    except UnicodeDecodeError as exc:
        raise RigError(f"{path}: {RIG} is not UTF-8 text; give the rig file with the argument rig") from exc


def recorded_rig(session: Session, path: Path) -> Rig:
    """Return the rig given to the recorder. Raises RigError if there was none, or if it is not a valid rig."""
    rig = attached_rig(session, path)
    if rig is None:
        raise RigError("no-rig", place=path)
    return rig


def paired(session: Session, survey: Survey, rig: Rig | None = None) -> SyncResult:
    """Return the observations of a survey, by the recorded rig if none is given.

    Raises InputError if there are none.
    """
    from truearm.session.observations import observations

    rig = rig or attached_rig(session, session.path)
    if rig is None:
        raise InputError(
            "the session was recorded without a rig; truearm identify and truearm session export take one with --rig"
        )
    return observations(survey, rig, session.path.name, labels=read_labels(session.path))


def surveyed(session: Session, messages: Source | None = None) -> Survey:
    """Return the survey of a session, or of other ``messages`` with what it recorded of box and host clock.

    Raises SessionError.
    """
    from truearm.session.clock import recorded_wander
    from truearm.session.frames import recorded_ident
    from truearm.session.observations import survey

    return survey(messages or session.batches, recorded_ident(session), wander=recorded_wander(session))


def observations_of_session(
    session: Session,
    rig: Rig | None = None,
    *,
    may_be_empty: bool = False,
    line_points: int | None = None,
    plan: Plan | None = None,
) -> SyncResult:
    """Make observations from a session. ``rig`` and ``plan`` replace the recorded ones.

    ``may_be_empty``: it need not give an observation, as a part of a session. ``line_points``: maximum number per pass
    along a line. Raises SessionError if it gives no observation, RigError if there is no rig.
    """
    from truearm.session.observations import observations

    path = session.path
    rig = rig or recorded_rig(session, path)
    labels = read_labels(path)
    try:
        read = surveyed(session)
        if plan is not None:
            read = replace(read, marks=read.marks.with_plan(plan))
        result = observations(read, rig, path.name, line_points, labels)
    except (RigError, SessionError) as exc:
        if str(exc).startswith(str(path)):
            raise
        raise exc.within(path) from exc
    if not len(result.table) and not may_be_empty:
        planned = result.survey.marks.plan() is not None
        raise nothing_observed(path, result.reasons, result.pass_reasons, planned)
    return result


def damage_findings(session: Session) -> list[Finding]:
    """Return the first damaged places of a session of which the intact parts are used."""
    from truearm.report.session_findings import damage_finding

    values = {"place": str(session.path), "more": max(len(session.damage) - MOST_PLACES, 0)}
    return [damage_finding({**vars(damage), **values}) for damage in session.damage[:MOST_PLACES]]


def reading_findings(session: Session, result: SyncResult, rig: Rig) -> list[Finding]:
    """Return what is noticed while the observations of a session are made."""
    named, n = {"place": str(session.path)}, result.survey.losses.plan_events_malformed
    malformed = [Finding("malformed-plan", {**named, "plan_events_malformed": n})] if n else []
    return [*damage_findings(session), *malformed, *_other_temperature(result, rig, str(session.path))]


COUNTS = "_counts"


def channel_samples(paths: Sequence[Path], channel: str, allow_damaged: bool = False) -> tuple[Floats, Floats]:
    """Return the host times (n,) [s] and the values (n,) of a channel of the box.

    A value is a length [m] or in the channel's calibrated unit, or without a calibration what the converter measured,
    usually [V]. Raises InputError, naming the channels of the session, if it does not have this one.
    """
    channels: dict[str, None] = {}
    times, values = [np.zeros(0)], [np.zeros(0)]
    for t, columns in _tables("box_", paths, allow_damaged):
        channels |= dict.fromkeys(title.removesuffix(COUNTS) for title in columns if title.endswith(COUNTS))
        if channel + COUNTS in columns:
            titles = [title for title in columns if title.startswith(f"{channel}_") and title != channel + COUNTS]
            ranks = {title: (not title.endswith("_m"), not title.endswith("_calibrated")) for title in titles}
            times.append(t)
            values.append(columns[min(titles, key=ranks.__getitem__, default=channel + COUNTS)].astype(float))
    if channel not in channels:
        names = ", ".join(sorted(channels)) or "none"
        raise InputError(Argument("channel"), f": the session has no samples of {channel!r}; its channels are {names}")
    return np.concatenate(times), np.concatenate(values)


def joint_readings(paths: Sequence[Path], allow_damaged: bool = False) -> tuple[Floats, Floats]:
    """Return the host times (n,) [s] and the joint readings (n, j) [rad, m] of a session."""
    times, readings = [], []
    for t, columns in _tables("joints", paths, allow_damaged):
        times.append(t)
        joints = [column for title, column in columns.items() if title[:1] == "q" and title[1:2].isdigit()]
        readings.append(np.column_stack(joints))
    if not times:
        raise InputError("no-joint-readings", place=paths[0])
    return np.concatenate(times), np.concatenate(readings)


def _tables(kind: str, paths: Sequence[Path], allow_damaged: bool) -> Iterator[tuple[Floats, Columns]]:
    """Yield parts of a kind of table: host times [s], as in an ObservationTable, NaN where unknown, and all columns."""
    from truearm.session.clock import UNKNOWN
    from truearm.session.session_tables import tabulate

    for path in paths:
        for name, columns in tabulate(surveyed(open_finished(path, allow_damaged))):
            if name.startswith(kind):
                time = columns["host_time_ns"]
                yield np.where(time == UNKNOWN, np.nan, 1e-9 * time), columns


def _other_temperature(result: SyncResult, rig: Rig, place: str) -> Iterator[Finding]:
    """Return the possible error of the lengths by temperature.

    There is one if the session was measured FAR from the box's temperature at which the ball-bar's channel was
    calibrated, and rows lack the bar's temperature.
    """
    table = result.table.select(result.table.kind == "ball_bar")
    streams = (stream for ident in result.survey.idents.values() for stream in ident.streams.values())
    channels = (channel for stream in streams for channel in stream.channels if channel.name == LVDT)
    noted = (channel.calibrated_degc for channel in channels if math.isfinite(channel.calibrated_degc))
    unread = ~np.isfinite(table.bar_temperature)
    warmer = table.temperature[unread] - next(noted, np.nan)
    largest = float(warmer[np.nanargmax(np.abs(warmer))]) if np.isfinite(warmer).any() else 0.0
    if abs(largest) < FAR:
        return
    bars = [rig.bars[name] for name in np.unique(table.bar[unread]).tolist() if name in rig.bars]
    bar = max(bars, key=lambda bar: possible_error(bar, largest))
    expansion, drift = coefficients(bar)
    lengths = {"error": possible_error(bar, largest), "length": bar.zero, "travel": 0.5 * bar.travel}
    values = {
        **{name: {"mm": MM.of(length)} for name, length in lengths.items()},
        **{"expansion": PPM_PER_K.of(expansion), "drift": PPM_PER_K.of(drift)},
        **{"place": place, "channel": LVDT, "difference": {"degc": abs(largest)}, "warmer": largest > 0.0},
    }
    yield Finding("other-temperature", {**values, "page": page("Build and measure the rig")})


def coefficients(bar: BallBar) -> tuple[float, float]:
    """Return the expansion of a bar and the drift of its sensor's gain [1/K] from the rig, or usual values."""
    return bar.expansion or STEEL, bar.gain_drift or LVDT_DRIFT


def possible_error(bar: BallBar, warmer: float) -> float:
    """Return the possible error [m] of a length at the end of the stroke if bar and sensor are ``warmer`` [K]."""
    expansion, drift = coefficients(bar)
    return abs(warmer) * (abs(expansion) * bar.zero + abs(drift) * 0.5 * bar.travel)
