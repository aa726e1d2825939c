"""Write a session to a new file: the intact data of a damaged one, or one with joint readings recorded elsewhere
(``truearm session recover``, ``add-joints``).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from truearm.disk import check_writable, replacing, sha256
from truearm.errors import Argument, InputError, SessionError, WriteError
from truearm.file_names import system_reason
from truearm.findings import Finding, stated
from truearm.model.robot_file import RobotChoice
from truearm.progress import step
from truearm.record.recover import Recovered
from truearm.record.recover import recover as recover_session
from truearm.record.robots.add_readings import add_readings
from truearm.record.robots.sources import FileOptions, readings_of_file
from truearm.report.session_findings import damage_finding
from truearm.workflows.session_parts import open_finished


def recovered_name(session: Path) -> Path:
    """Return the default path of a recovered session: ``session-recovered.mcap``."""
    return session.parent / f"{session.stem}-recovered.mcap"


@step("recovering the session")
def recover_file(session: Path, out: Path, force: bool = False) -> Recovered | None:
    """Write the intact parts of a session to ``out``; None if the session is intact, and then nothing is written.

    Raises InputError, SessionError if nothing can be saved or the session is still being written, WriteError.
    """
    opened = open_finished(session, allow_damaged=True)
    if not (opened.truncated or opened.damage):
        return None
    check_writable(out, force, inputs=[session], kind="session")
    provenance = {"source": session.name, "sha256": sha256(session)}
    try:
        with replacing(out) as partial:
            recovered = recover_session(opened, partial, provenance)
            if not recovered.topics and "box" not in opened.metadata:  # it ended before the start
                raise SessionError(f"{session}: contains nothing that can be recovered; record again")
    except (OSError, WriteError) as exc:
        reason = f"{out}: cannot be written: {system_reason(exc)}; {session} is unchanged"
        raise WriteError(reason, exc.strerror or "") from exc
    return recovered


def recovery_findings(recovered: Recovered) -> list[Finding]:
    """Return what was saved of a session and what was lost."""
    accounts = recovered.topics.values()
    values = {
        **vars(recovered),
        "duration": {"s": recovered.seconds},
        "lost": sum(account.lost for account in accounts),
    }
    saved = stated("recovered", values, messages=sum(account.saved for account in accounts))
    return [saved, *(damage_finding(vars(damage)) for damage in recovered.damage)]


@dataclass(frozen=True)
class AddJoints:
    """What to add to a session, and how.

    ``zero`` [s]: when the controller's time was 0, after the session's begin; None: its time is UTC. ``replace``: leave
    out the session's own readings.
    """

    session: Path
    source: Path
    out: Path
    options: FileOptions
    zero: float | None = None
    replace: bool = False


@step("adding the readings")
def add_joints_file(request: AddJoints, force: bool = False) -> int:
    """Write the session with the readings, completely or not at all; return their number. Raises InputError,
    SessionError.
    """
    inputs = [request.session, request.source]
    check_writable(request.out, force, inputs=inputs, kind="session")
    zero = request.zero
    if zero is not None and not abs(zero) < 1e9:
        raise InputError(Argument("zero"), f" {zero:g} is not a time; give seconds")
    opened = open_finished(request.session, request.options.allow_damaged)
    readings = readings_of_file(request.source, request.options)
    provenance = {
        "source": request.source.name,
        "session": request.session.name,
        "session_sha256": sha256(request.session),
        "time": "utc" if zero is None else f"0 at {zero!r} s of the session",
    }
    if opened.damage or opened.truncated:
        provenance["damaged"] = "the damaged part of the session is left out"
    with replacing(request.out) as new:
        return add_readings(opened, readings, new, zero, provenance, request.replace)


def joint_names(joints: str | None, robot: RobotChoice) -> list[str]:
    """Return the joints' names from the base on, without mimic joints; [] if none were given. Raises InputError."""
    if joints is not None and robot.robot is not None:
        raise InputError("exclusive", first=Argument("joints"), second=Argument("robot"))
    if robot.robot is not None:
        return [joint.name for joint in robot.load().chain.joints if joint.mimic is None]
    names = [] if joints is None else [name.strip() for name in joints.split(",")]
    if "" in names or len(set(names)) < len(names):
        raise InputError(Argument("joints"), f" {joints!r} must be a list of different names: a,b,c")
    return names
