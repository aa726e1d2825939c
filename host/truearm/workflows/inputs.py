"""Inputs of an identification: files are named, checked, read as one table, and hashed.

A session contains the rig with which it was recorded, so several sessions of one robot may have several rigs. Each rig
then has unknowns of its own (``monday.sphere.s1.x``), and only the robot's parameters are shared. A session is named
after its file without the suffix: ``--rig monday=FILE`` replaces the rig inside monday.mcap.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from truearm.disk import check_outputs, same_file
from truearm.errors import Argument, InputError, RigError, SessionError, noting
from truearm.estimate.result_file import Input, input_of
from truearm.findings import Finding
from truearm.kinds.registry import check_kinds, kinds, with_every_name
from truearm.kinds.rig_file import check_against_rigs, read_noise, read_rig, with_noise
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import check_against_rig, concatenate, read_table
from truearm.model.chain import Chain
from truearm.model.robot import Robot
from truearm.model.robot_file import RobotChoice
from truearm.progress import step
from truearm.report.page import UNRECORDED, Facts, Recording, between
from truearm.session.frames import decimal
from truearm.session.plan_matching import labels_path, read_labels
from truearm.text import one_line
from truearm.types import DOUBTFUL, Rig, Rigs, SocketDistance, rigs_by_name
from truearm.units import NS, UM, US
from truearm.workflows import recorded_session
from truearm.workflows.recorded_session import SETUP, first_stem, is_part, open_finished

if TYPE_CHECKING:
    from truearm.session.observations import SyncResult
    from truearm.session.session_file import Session


@dataclass(frozen=True)
class Sources:
    """Sessions and tables of observations, and the rig files used for measuring them.

    ``rigs``: files, or rigs that were read, by the name in the rows' column rig, "" for the one rig of all rows; if
    empty, each session's own.
    ``noise``: a noise file that replaces the figures of the rigs. ``line_points``: maximum number per pass along a
    line.
    """

    inputs: tuple[Path, ...]
    rigs: Mapping[str, Path | Rig] = field(default_factory=dict)
    noise: Path | None = None
    allow_damaged: bool = False
    line_points: int | None = None

    @property
    def files(self) -> list[Path]:
        """All files."""
        return [*self.inputs, *self.rig_files, *filter(None, [self.noise])]

    @property
    def rig_files(self) -> list[Path]:
        """The rigs given as files."""
        return [rig for rig in self.rigs.values() if isinstance(rig, Path)]


def check_files(
    sources: Sources, robot: RobotChoice, outputs: Sequence[tuple[str, Path | None]] = (), force: bool = False
) -> None:
    """Check that no input is given twice, and the outputs as ``check_outputs`` does.

    A repeated input would make its sigmas too small. Raises InputError.
    """
    counted = [path for path in (*sources.inputs, sources.noise) if path is not None]
    for i, path in enumerate(counted):
        if any(same_file(path, earlier) for earlier in counted[:i]):
            raise InputError("given-twice", place=path)
    check_outputs(outputs, force, [*sources.files, *robot.files])


class Observed(NamedTuple):
    """The rig, or the rigs by name, and the observations; if they were read, also what is known about their files.

    These are the ``inputs`` themselves; of each session the account of its dwells (``sessions`` of result.json) and how
    it was recorded; and what was noticed while they were read, such as the losses of a damaged session.
    """

    rigs: Rigs
    table: ObservationTable
    counts: Sequence[Mapping[str, Any]] = ()
    recordings: Sequence[Recording] = ()
    findings: Sequence[Finding] = ()
    inputs: Sequence[Input] = ()


def read_sources(sources: Sources, chain: Chain | None, robot: Robot | None = None) -> Observed:
    """Return rigs and observations, checked against each other.

    ``chain`` is the robot's; None skips the check of its joints. With the nominal ``robot``, labels that the readings
    do not support are left out.
    """
    check_kinds()
    inputs = list(sources.inputs)
    noise = None if sources.noise is None else read_noise(sources.noise)
    rigs = {name: read_rig(rig) if isinstance(rig, Path) else rig for name, rig in sources.rigs.items()}
    named_rigs = {name: with_noise(rig, noise) for name, rig in rigs.items()}
    sessions = {
        path: open_finished(path, sources.allow_damaged) for path in inputs if recorded_session.is_session(path)
    }
    session_rig = {
        path: (name, with_noise(rig, noise)) for path, (name, rig) in session_rigs(sessions, named_rigs).items()
    }
    reads = list[_Read]()
    with noting(finding for read in reads for finding in read.findings):
        for path in inputs:
            if path in sessions:
                reads.append(_read_session(sessions[path], chain, session_rig[path], sources, robot))
            else:
                reads.append(_read_table(path, chain))
        counts, recordings, nothing = (
            [getattr(read, name) for read in reads if read.account] for name in _Read._fields[2:]
        )
        if sources.line_points is not None and not any(count["lines"] for count in counts):
            reason = "no input is a session with passes along a line"
            raise InputError("no-effect", place=Argument("line_points"), reason=reason)
        tables = [read.table for read in reads]
        table = concatenate([rows for rows in tables if len(rows)] or tables)
        if not len(table):
            first, *further = nothing
            with noting(error.finding for error in further):
                raise first
        rigs = named_rigs | dict(session_rig.values())
        if noise is not None:
            check_against_rigs(noise, rigs)
        for name, file in sources.rigs.items():
            if name and not (table.rig == name).any():
                reason = "no row has that name in its column rig, and no session has that name; correct the name"
                raise InputError(Argument("rig"), f" {name}={file}: {reason}")
        completed = completed_rigs(rigs.get("", with_noise(Rig(), noise)) if "" in rigs or not rigs else rigs, table)
    findings = [finding for read in reads for finding in read.findings]
    if chain is not None:
        for name, rig in rigs_by_name(completed).items():
            findings += _doubts(table.select(table.rig == name) if name else table, rig, chain)
    findings += _repeated_distances(rigs_by_name(completed))
    return Observed(completed, table, counts, recordings, findings)


def completed_rigs(rigs: Rigs, table: ObservationTable) -> Rigs:
    """Return the rig, or the rigs by name, with what a name "*" in it stands for, checked against the rows.

    Raises InputError, TableError.
    """
    if isinstance(rigs, Rig):
        return _completed(rigs, table)
    for name, source in zip(table.rig.tolist(), table.source, strict=True):
        if name not in rigs:
            names = ", ".join(sorted(rigs)) or "them"
            wrong = f"rig {name!r} in its column rig, which is none of {names}" if name else "no rig in its column rig"
            raise InputError(Argument("rig"), f": {source} names {wrong}")
    return {name: _completed(rig, table.select(table.rig == name)) for name, rig in rigs.items()}


def _completed(rig: Rig, table: ObservationTable) -> Rig:
    rig = with_every_name(rig, table)
    check_against_rig(table, rig)
    return rig


def _repeated_distances(rigs: Mapping[str, Rig]) -> Iterator[Finding]:
    """Return which measured distances of sockets are in several rigs, as if they had been measured several times."""
    names: dict[SocketDistance, list[str]] = {}
    for name, rig in rigs.items():
        for distance in rig.socket_distances:
            names.setdefault(distance, []).append(name)
    for distance, holders in names.items():
        if len(holders) > 1:
            yield Finding("repeated-distance", {"rigs": holders, "sockets": list(distance.sockets)})


def _doubts(table: ObservationTable, rig: Rig, chain: Chain) -> Iterator[Finding]:
    """Return which rows the devices of the rig cannot have measured."""
    for name, kind in kinds().items():
        if kind.doubts:
            yield from kind.doubts(table.select(table.kind == name), rig, chain)


class _Read(NamedTuple):
    """The observations of an input, and what was noticed while they were read.

    Of a session also the account of its dwells, how it was recorded, and why it gives nothing if it gives no row.
    """

    table: ObservationTable
    findings: Sequence[Finding] = ()
    account: Mapping[str, Any] = {}
    recording: Recording | None = None
    nothing: SessionError | None = None


def _read_table(path: Path, chain: Chain | None) -> _Read:
    table = read_table(path) if chain is None else read_table(path, chain.joint_units, chain.mimics)
    rows = [int(str(source).rpartition(" ")[2]) for source in table.source]
    reordered = rows != sorted(rows)  # than in the file
    return _Read(table, [Finding("rows-reordered", {"place": str(path)})] if reordered else ())


def _read_session(
    session: Session, chain: Chain | None, assigned: Assigned, sources: Sources, robot: Robot | None
) -> _Read:
    path, (name, rig) = session.path, assigned
    options: dict[str, Any] = {"may_be_empty": is_part(path, list(sources.inputs)), "line_points": sources.line_points}
    with noting(recorded_session.damage_findings(session)):
        result = recorded_session.observations_of_session(session, rig, **options)
    table, findings = result.table, recorded_session.reading_findings(session, result, rig)
    if chain is not None and len(table):
        expected = len(chain.joints)
        if table.q.shape[1] not in (expected, len(chain.motors)):
            raise InputError("other-robot", place=path, joints=table.q.shape[1], expected=expected)
        table = table.completed(chain.mimics, expected)
    labels = read_labels(path) is not None
    rejected = result.reasons
    if robot is not None and not labels:
        with step("comparing labels with the readings"):
            from truearm.workflows.relabel import borne_out_rows

            borne_out = borne_out_rows(robot, rig, result)
        table = table.select(borne_out)
        doubtful, model = int((~borne_out).sum()), session.metadata.get(SETUP, {}).get("model", "")
        rejected = rejected | ({DOUBTFUL: doubtful} if doubtful else {})
        if 2 * doubtful > len(borne_out) and model not in ("", robot.chain.name, Path(robot.file).name):
            raise InputError(
                f"{path}: was recorded for robot {one_line(model)}, and {doubtful} of its {len(borne_out)} observations "
                f"do not fit {robot.chain.name}; leave it out, or move it to the project of its robot"
            )
    reasons, line_reasons = (dict(sorted(counts.items())) for counts in (rejected, result.pass_reasons))
    count = {
        "session": path.name,
        "dwells": len(result.dwells) - result.n_mountings,  # stops for mounting are none
        "used": int(sum(table.kind == "ball_bar")),
        "rejected": reasons,
        "labels": labels,  # settled by truearm session relabel
        "mountings": result.n_mountings,
        "lines": len(result.passes),
        "lines_used": sum(not line_pass.reason for line_pass in result.passes),
        "lines_rejected": line_reasons,
        "with_bar": result.with_bar,  # otherwise the dwells are only stops between lines
    }
    nothing = recorded_session.nothing_observed(path, reasons, line_reasons, result.survey.marks.plan() is not None)
    return _Read(table.replace(rig=name), findings, count, recording_of(session, result, reasons), nothing)


def hashed_inputs(sources: Sources, robot: RobotChoice) -> list[Input]:
    """Return name and SHA-256 of every file read by an identification."""
    return [
        *(input_of("observations", path) for path in sources.inputs),
        *(input_of("labels", labels) for path in sources.inputs if (labels := labels_path(path)).exists()),
        *(input_of("rig", rig) for rig in sources.rig_files),
        *(input_of("noise", noise) for noise in [sources.noise] if noise),
        *(input_of("robot", file) for file in robot.files),
    ]


def recording_of(session: Session, result: SyncResult, reasons: Mapping[str, int]) -> Recording:
    """Return the facts of one session, of whose dwells some were rejected for ``reasons``."""
    idents, losses, reports = list(result.survey.idents.values()), result.survey.losses, result.survey.clock_reports
    uid = ", ".join(dict.fromkeys(one_line(str(ident.document.get("uid", ""))[:32]) for ident in idents))
    firmware = ", ".join(dict.fromkeys(one_line(ident.firmware[:32]) for ident in idents))
    stamp = session.metadata.get("session", {}).get("utc_ns", "")
    is_time = stamp.isdecimal() and len(stamp) <= 19
    begun = f"{datetime.fromtimestamp(NS.to_si(int(stamp)), UTC):%Y-%m-%d %H:%M UTC}" if is_time else ""
    lost = losses.samples_lost + losses.samples_overrun
    facts = [("begun", begun or "not known"), ("box", f"{uid or 'without a uid'}, firmware {firmware or 'not known'}")]
    n_mountings, n_passes = result.n_mountings, len(result.passes)
    if result.with_bar or not n_passes:  # otherwise the dwells are stops between lines
        rejected = ", ".join(f"{n} {reason}" for reason, n in reasons.items()) or "none"
        facts.append(("dwells", f"{len(result.dwells) - n_mountings}, of these rejected: {rejected}"))
        facts += [("stops for mounting", str(n_mountings))] if n_mountings else []
    facts += [("passes along lines", str(n_passes))] if n_passes else []
    facts.append(("samples", f"{losses.samples:,} received, {lost:,} lost; {losses.frames_lost:,} frames lost"))
    bound = US.text(max(NS.to_si(report.bound_ns) for report in reports), ".0f") if reports else "not known"
    facts.append(("error of the box's clock, at most", bound))
    thermometers = {"box": result.survey.temperature, **result.survey.thermometers}
    read = {one_line(name) or "unnamed": meter.extremes for name, meter in thermometers.items()}
    temperatures = tuple((name, *degc) for name, degc in read.items() if degc is not None)
    facts += [(f"temperature of the {name}", between(*degc)) for name, *degc in temperatures] or [UNRECORDED]
    sensors = tuple(dict.fromkeys(sensor for ident in idents for sensor in sensors_of(ident.document)))
    return Recording(one_line(session.path.name), begun, tuple(facts), sensors, lost, temperatures)


def sensors_of(document: Mapping[str, Any]) -> Facts:
    """Return the calibrated channels named by a box, each with its calibration."""
    streams = (stream for stream in document.get("streams") or [] if isinstance(stream, dict))
    channels = (channel for stream in streams for channel in stream.get("channels") or [])
    calibrated = (channel for channel in channels if isinstance(channel, dict) and channel.get("calibration"))
    return tuple(_sensor(channel) for channel in calibrated if isinstance(channel["calibration"], dict))


def _sensor(channel: Mapping[str, Any]) -> tuple[str, str]:
    calibration = channel["calibration"]
    serial, date, reference = (
        one_line(str(calibration.get(key) or "")[:80]) for key in ("serial", "date", "reference")
    )
    degc = calibration.get("temperature_mdegc")
    sigma, reference_sigma = (_sigma(calibration, key) for key in ("sigma", "reference_sigma"))
    words = (
        f"serial {serial}" * bool(serial),
        f"calibrated {date or 'on an unknown date'}",
        f"at {degc // 100 / 10:.1f} °C" if type(degc) is int else "",
        "" if sigma is None else f"residuals of {UM.text(sigma, '.1f')}",
        f"against {reference or 'a reference that is not named'}",
        "of unknown uncertainty" if reference_sigma is None else f"± {UM.text(2.0 * reference_sigma, '.1f')} (k = 2)",
    )
    return f"sensor {one_line(str(channel.get('name', ''))[:40])}", ", ".join(filter(None, words))


def _sigma(calibration: Mapping[str, Any], key: str) -> float | None:
    """Return a standard deviation [m] of a calibration; None if the box does not report it as a length."""
    try:
        return decimal(calibration.get(key), key) if calibration.get("unit") == "m" else None
    except ValueError:
        return None


LONGEST = 64  # letters in a name, as for a table's identifiers
Assigned = tuple[str, Rig]  # name, "" for the common rig, and the rig


def session_name(path: Path) -> str:
    """Return a session's name for rigs: its first file's name without the suffix, valid in a table's column."""
    return re.sub(r"[^\w-]", "_", first_stem(path), flags=re.ASCII)[:LONGEST]


def session_rigs(sessions: Mapping[Path, Session], named_rigs: Mapping[str, Rig]) -> dict[Path, Assigned]:
    """Return name and rig of every session; ``named_rigs`` holds those that the user named, by name.

    If no name is given and all sessions were recorded with one rig, that rig is used for everything, like a rig without
    a name. Sessions recorded with the same rig share the name of the first one. Raises RigError for a session without a
    rig, InputError for names that do not distinguish rigs.
    """
    if "" in named_rigs:
        return dict.fromkeys(sessions, ("", named_rigs[""]))
    assigned, recorded = dict[Path, Assigned](), dict[str, Rig]()
    for path, session in sessions.items():
        name = session_name(path)
        if name in named_rigs:
            assigned[path] = name, named_rigs[name]
            continue
        rig = recorded_session.attached_rig(session, path)
        if rig is None:
            raise RigError(
                f"{path}: was recorded without a rig; give one as ", Argument("rig"), f" {name}=FILE" * bool(named_rigs)
            )
        name = next((label for label, earlier_rig in recorded.items() if earlier_rig == rig), name)
        if recorded.setdefault(name, rig) != rig:
            raise InputError(f"{path}: another session is also named {name} but has another rig; rename one of them")
        assigned[path] = name, rig
    if not named_rigs and len(recorded) == 1:
        return {path: ("", rig) for path, (_, rig) in assigned.items()}
    return assigned
