"""Carry out ``truearm record`` according to its options, and count the dwells of what was recorded."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TextIO

from truearm.box.condition import Purpose
from truearm.box.configuration import MODULATOR_NS
from truearm.disk import check_writable, is_held, read_bytes
from truearm.errors import Argument, IncompleteError, InputError, RigError, TruearmError, WriteError
from truearm.findings import Finding, entries, option
from truearm.kinds.rig_file import MAX_BYTES, parse_rig, read_rig
from truearm.live.choose_box import choose_box
from truearm.live.state import LiveState, SessionProgress, check_mounted, parse_mounted
from truearm.live.view import showing
from truearm.plan.plan_file import check_against_rig, read_plan
from truearm.progress import asked_to_stop
from truearm.record import recorder
from truearm.record.links import BoxPort, HostClock, Reopening
from truearm.record.operator import Counters, RecordSummary
from truearm.record.robots.sources import open_source
from truearm.record.session_writer import SessionWriter
from truearm.session.dwells import POSE_TOLERANCE, needs_decision
from truearm.session.plan_matching import distances
from truearm.session.session_file import open_session
from truearm.text import counted
from truearm.types import Move, Plan, Rig
from truearm.units import NS
from truearm.workflows.controller_model import as_hex, controller_state
from truearm.workflows.recorded_session import (
    SETUP,
    SUFFIX,
    Earlier,
    attached_rig,
    earlier,
    gone_on,
    observations_of_session,
    open_finished,
    recovered_name,
)
from truearm.workflows.requests import RecordOptions
from truearm_wire.config import OSRS

# The converter's modulator runs at 125 MHz / 15 / 2; a sample takes osr of its periods.
MODULATOR_HZ = NS.factor / MODULATOR_NS
USUAL_OSR = 4096
# Python lets a busy thread run for 5 ms before another gets its turn; the thread that stamps arrivals cannot wait that
# long.
_SWITCH_INTERVAL_S = 2e-4


@dataclass(frozen=True)
class RecordingWork:
    """What to record, read from files and checked for consistency.

    ``setup`` is stored for the parts that continue it.
    """

    out: Path
    robot: str | None
    rig: Rig | None
    setup: dict[str, str]
    earlier_session: Earlier | None
    options: recorder.RecordOptions


@dataclass(frozen=True)
class Recorded:
    """A recording that ended: whether a file was kept, and problems of the live view."""

    out: Path
    summary: RecordSummary
    is_kept: bool
    trouble: str
    missing: tuple[Finding, ...]  # why the recording is incomplete
    dwells: RecordedDwells | None = None  # of a recording with a robot and a rig
    findings: Sequence[Finding] = ()  # about the robot's controller


def record_request(request: RecordOptions, output: TextIO, say: Callable[[str], None]) -> Recorded:
    """Record until the end; the operator's display goes to ``output``, and warnings before the start to ``say``.

    Raises InputError, LinkError, IncompleteError.
    """
    work = _work(request)
    for path in work.earlier_session.damaged if work.earlier_session else ():
        say(Finding("damaged-part", {"place": str(path), "copy": str(recovered_name(path))}).text(option))
    device = choose_box(request.box, output)
    checksums, findings = controller_state(work.robot, request.project_model)
    for finding in findings:
        say(finding.text(option))
    if checksums:
        work = replace(work, setup={**work.setup, "controller_checksums": " ".join(as_hex(checksums))})
    return replace(_record(device, work, request, output), findings=findings)


def unsettled(dwells: RecordedDwells | None, session: Path) -> list[Finding]:
    """Return how many dwells of a recording give no observation, and what to do; [] if every pose gave one."""
    if dwells is not None and dwells.need_decision:
        counts = {"n": dwells.need_decision, "dwells": dwells.dwells}
        return [Finding("doubtful-dwells", {"session": str(session), **counts, "path": [str(session)]})]
    if dwells is not None and dwells.lost:
        return [Finding("poses-lost", {"n": dwells.lost, "session": str(session)})]
    return []


def what_is_missing(summary: RecordSummary, with_robot: bool) -> Iterator[Finding]:
    """Return why a recording that ended is incomplete; nothing if it is complete."""
    counters, lost = summary.counters, summary.reason in ("link lost", "robot lost", "no readings")
    if lost or (summary.robot_gone and counters.robot_lines):
        yield Finding("link-lost", {"reason": summary.text if lost else summary.robot_gone})
    elif with_robot and not counters.robot_lines:
        closed = summary.reason == "robot closed"
        yield Finding("link-lost", {"closed": True}) if closed else Finding("no-joint-readings")
    if counters.robot_missing or counters.robot_unstored or counters.robot_dropped:
        yield Finding("robot-too-fast", {"n": counters.robot_missing})
    if summary.box_gone and summary.reason != "link lost":
        yield Finding("link-lost", {"gone": summary.box_gone})
    elif not counters.samples:
        yield Finding("no-box-data", {"problem": "sent no sample"})
    yield from (Finding("file-loss", {"loss": loss}) for loss in summary.file_losses)


def _record(device: str, work: RecordingWork, request: RecordOptions, output: TextIO) -> Recorded:
    """Record, and find out what is missing; a signal ends the recording, but not that question."""
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    clock = HostClock()
    options = replace(work.options, head=[(SETUP, work.setup)])
    progress = SessionProgress(list(options.plan), dict(options.mounted or {}))
    if work.earlier_session is not None and request.plan is None:
        gone_on(progress, work.earlier_session)
    state = LiveState(progress, work.rig, work.robot is not None, _purpose(work, device), request.unchecked)
    robot = nullcontext() if work.robot is None else closing(open_source(work.robot, clock))
    with closing(Reopening(BoxPort(device, clock))) as link, robot as robot_link, asked_to_stop() as interrupted:
        with (
            SessionWriter(work.out, clock, overwrite=request.force, hold=True) as writer,
            showing(state, request.plain, output),
        ):
            try:
                summary = recorder.record(
                    link, writer, clock, robot=robot_link, options=options, operator=state, interrupted=interrupted
                )
            except TruearmError as exc:
                if not writer.kept:
                    raise
                place = "" if isinstance(exc, WriteError) else f"; everything received until then is in {writer.path}"
                raise IncompleteError(exc, place) from exc
        dwells = None
        if writer.kept and work.robot is not None and work.rig is not None and (options.plan or options.mounted):
            dwells = recorded_dwells(writer.path)
        missing = (*what_is_missing(summary, work.robot is not None), *unsettled(dwells, writer.path))
        return Recorded(writer.path, summary, writer.kept, state.trouble, missing, dwells)


def nearest_osr(rate: float) -> int:
    """Return the oversampling ratio with the rate nearest to ``rate`` [Hz].

    Raises InputError outside the box's rates.
    """
    slowest, fastest = MODULATOR_HZ / OSRS[-1], MODULATOR_HZ / OSRS[0]
    if not 0.9 * slowest <= rate <= 1.1 * fastest:
        raise InputError(Argument("rate"), f" {rate:g} Hz is not within the box's {slowest:.0f} to {fastest:.0f} Hz")
    return min(OSRS, key=lambda osr: abs(MODULATOR_HZ / osr - rate))


def _work(request: RecordOptions) -> RecordingWork:
    """Return what to record, each part from its option or else from the session that is continued.

    Raises InputError for options and files that are invalid or inconsistent.
    """
    if (request.out is None) == (request.resume is None):
        raise InputError("exclusive", first=Argument("out"), second=Argument("resume"), neither=request.out is None)
    continued = Earlier(Path(), Path(), 0, "", {}) if request.resume is None else earlier(request.resume)
    out = request.out or continued.out
    read = [path for path in (request.rig, request.plan) if path is not None]
    if not out.suffix:
        raise InputError("wrong-suffix", place=out, suffixes=SUFFIX)
    check_writable(out, request.force and request.resume is None, inputs=read, kind="session")
    if out.exists() and is_held(out):
        raise InputError("in-use", place=out)
    osr_text = continued.setup.get("osr", "")
    osr_before = int(osr_text) if osr_text in map(str, OSRS) else USUAL_OSR
    typed = {} if request.mounted is None else parse_mounted(request.mounted)
    plan = None if request.plan is None else read_plan(request.plan)
    rig_name = f"{continued.first}: rig.toml" if request.rig is None else str(request.rig)
    rig_toml = continued.rig_toml if request.rig is None else read_bytes(request.rig, MAX_BYTES, RigError)
    rig = None if request.rig is None else read_rig(request.rig)
    if rig is None and rig_toml is not None:
        rig = parse_rig(rig_toml.decode(errors="replace"), rig_name)
    if rig is not None:
        check_mounted(typed, rig)
        if plan is not None:
            check_against_rig(plan, rig, str(request.plan))
    robot = request.address or continued.setup.get("robot") or None
    osr = osr_before if request.rate is None else nearest_osr(request.rate)
    setup = {"robot": robot or "", "osr": str(osr)}
    if request.project_model:
        setup["model"] = Path(request.project_model).name
    if request.resume is not None:
        setup |= {"of": continued.first.name, "part": str(continued.number), "begun": continued.begun}
    options = recorder.RecordOptions(
        plan=continued.rows if plan is None else plan_rows(plan),
        rig_toml=rig_toml,
        mounted=typed or continued.mounted,
        osr=osr,
        duration_s=request.duration,
        patience_s=request.patience,
    )
    return RecordingWork(out, robot, rig, setup, None if request.resume is None else continued, options)


def _purpose(work: RecordingWork, device: str) -> Purpose:
    """Return the purpose according to the plan, else to what is mounted, else to the rig."""
    options, rig = work.options, work.rig or Rig()
    moves = {row.get("move", Move.DWELL) for row in options.plan}
    mounted: Mapping[str, Any] = options.mounted or {"bar": rig.bars, "line": rig.lines}
    if moves:
        return Purpose(Move.DWELL in moves, Move.LINE in moves, options.osr, device)
    return Purpose(bool(mounted.get("bar")), bool(mounted.get("line")), options.osr, device)


def plan_rows(plan: Plan) -> list[dict[str, Any]]:
    """Return the messages of ``/plan``, one per row."""
    rows = []
    for pose in range(len(plan)):
        row = {"pose": pose, **{name: str(getattr(plan, name)[pose]) for name in plan.IDS}}
        if plan.move[pose] != Move.DWELL:
            row["move"] = str(plan.move[pose])
        if plan.lines[pose]:
            row |= {
                "line": str(plan.line[pose]),
                "target": str(plan.target[pose]),
                "speed_m_s": float(plan.speed[pose]),
            }
        rows.append(row | {"q": plan.q[pose].tolist()})
    return rows


@dataclass(frozen=True)
class RecordedDwells:
    """Account of the stops at poses of the plan, or, without a plan, of all sufficiently long stops.

    ``unusable``: rejected for other reasons, with the number for each. ``lost``: poses of the plan that were visited
    and gave no observation.
    """

    dwells: int
    usable: int
    need_decision: int
    unusable: dict[str, int]
    lost: int


def recorded_dwells(session: Path) -> RecordedDwells | None:
    """Return the account of a session; None if it has no rig with a ball-bar or cannot be read."""
    try:
        rig = attached_rig(open_session(session), session)
        if rig is None or not rig.bars:
            return None
        result = observations_of_session(open_finished(session), rig, may_be_empty=True)
    except TruearmError:  # identify reports what is wrong with it
        return None
    plan, reasons = result.survey.marks.plan(), Counter[str]()
    is_measured: dict[int, bool] = {}  # whether a pose of the plan gave an observation
    for dwell in result.dwells:
        if plan is not None:
            distance = distances(dwell.q, plan)
            if distance.min() > POSE_TOLERANCE:
                continue
            pose = int(distance.argmin())
            is_measured[pose] = is_measured.get(pose, False) or not dwell.reason
        elif dwell.reason == "too short":
            continue
        reasons[dwell.reason] += 1
    total, usable = reasons.total(), reasons.pop("", 0)
    undecided = sum(reasons.pop(reason) for reason in list(reasons) if needs_decision(reason, plan is not None))
    lost = list(is_measured.values()).count(False)
    return RecordedDwells(total, usable, undecided, dict(sorted(reasons.items())), lost)


FLOODED = "the robot sent more than could be stored"
DISTURBANCES = {  # counters of what a recording survives
    "restarts": ("restart of the box", "restarts of the box"),
    "link_losses": ("loss of the link to the box", "losses of the link to the box"),
    "robot_losses": ("loss of the robot", "losses of the robot"),
    "robot_other_joints": ("reading of another number of joints", "readings of another number of joints"),
    "robot_foreign": ("datagram from another address, not stored", "datagrams from other addresses, not stored"),
    "held_up": ("delay of the storing", "delays of the storing"),
}


def recording_document(recorded: Recorded) -> dict[str, Any]:
    """Return a recording as JSON; ``dwells`` is None where it has no robot or no rig with a ball-bar."""
    summary = recorded.summary
    return {
        "out": str(recorded.out) if recorded.is_kept else None,
        "duration_s": summary.duration_s,
        "ended": summary.reason,
        "why": summary.text,
        "counters": asdict(summary.counters),
        "faults": summary.faults,
        "dwells": None if recorded.dwells is None else asdict(recorded.dwells),
        "missing": "; ".join(finding.text(option).rstrip(".") for finding in recorded.missing),
        "findings": entries([*_findings(recorded), *recorded.missing] if recorded.is_kept else recorded.missing),
    }


def _findings(recorded: Recorded) -> Iterator[Finding]:
    """Return what is in the file and why the recording ended, then what it survived."""
    summary, dwells = recorded.summary, recorded.dwells
    values: dict[str, Any] = {
        "file": str(recorded.out),
        "duration": {"s": summary.duration_s},
        "samples": summary.counters.samples,
        "lost": summary.counters.lost_frames,
        "readings": summary.counters.robot_lines,
        "dwells": dwells.dwells if dwells else 0,
        "ended": summary.reason,
        "why": summary.text if summary.reason == "robot closed" else "",
    }
    if dwells:
        unusable = [f"{n} {reason}" for reason, n in dwells.unusable.items()]
        values |= {"usable": str(dwells.usable), "need_decision": dwells.need_decision, "unusable": unusable}
    yield Finding("recorded", values)
    events = [*_disturbances(summary.counters), *summary.faults]
    if events:
        counts = {name: getattr(summary.counters, name) for name in DISTURBANCES}
        yield Finding("recording-disturbed", {"events": events, **counts})
    yield from recorded.findings


def _disturbances(counters: Counters) -> Iterator[str]:
    for name, words in DISTURBANCES.items():
        if n := getattr(counters, name):
            yield counted(n, *words)
    if counters.robot_missing or counters.robot_dropped or counters.robot_unstored:
        yield FLOODED
    elif counters.robot_held_up:
        yield "the robot sent faster than could be stored for a time; no reading is missing"
