"""``truearm status``: show the files of a project and the next command."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from truearm.cli.command import command
from truearm.cli.output import print_result
from truearm.errors import InputError
from truearm.files.project_folder import FILE, find_project
from truearm.text import counted, one_line, outcome, page

if TYPE_CHECKING:
    from truearm.workflows.project import ProjectState, ResultState, SessionState


@command()
def status(*, json: bool = False) -> None:
    """Show the files of this folder's project, and the command that comes next.

    \b
    Example:
      truearm status
    """
    from truearm.workflows.project import state_of

    file = find_project(Path.cwd())
    if file is None:
        raise InputError("no-project", file=FILE)
    state = state_of(file)
    print_result(_document(state), _lines(state), json)


def _lines(state: ProjectState) -> Iterator[str]:
    project = state.project
    where = os.path.relpath(state.home)
    yield f"project   {project.name or state.home.name}, {'this folder' if where == os.curdir else where}"
    yield f"robot     {project.model}{f', serial {project.serial}' * bool(project.serial)}, {project.address or 'no address'}"
    yield f"rig       {os.path.relpath(state.rig) if state.rig else f'none ({project.rig} is missing)'}"
    plan = f"{os.path.relpath(state.plan)}, {counted(state.poses, 'pose')}" if state.plan else "none"
    yield f"plan      {plan}"
    yield f"sessions  {len(state.sessions) or 'none'}"
    for session in state.sessions:
        yield f"          {_session(session)}"
    yield f"results   {len(state.results) or 'none'}"
    for result in state.results:
        yield f"          {_result(result)}"
    others = [
        f"{_session(session)} (not in {project.sessions}: if it is no rehearsal, move it there)"
        for session in state.other_sessions
    ]
    others += [f"{_result(row)} (of {os.path.relpath(row.session)})" for row in state.other_results if row.session]
    for title, line in zip(("not used", *[""] * len(others)), others, strict=False):
        yield f"{title:<10}{line}"
    command, why = _next(state)
    yield f"next      {command} ({why})"


def _session(session: SessionState) -> str:
    whole = (
        ""
        if session.complete
        else ", is being written"
        if session.written
        else ", not complete: truearm session recover"
    )
    other = f", recorded for another robot: {one_line(session.model)}" if session.model else ""
    return f"{os.path.relpath(session.path)}, {session.size / 2**20:.1f} MiB{whole}{other}"


def _result(result: ResultState) -> str:
    held = "" if result.held_out_mm is None else f", {result.held_out_mm:.4f} mm RMS held out"
    return f"{os.path.relpath(result.path)}, {outcome(result.status)}{_unusable(result)}{held}"


def _unusable(result: ResultState) -> str:
    """Return why a fit that converged is not usable, "" if it is."""
    return "" if result.unusable is None or result.status != "converged" else f", not usable ({result.unusable})"


def _next(state: ProjectState) -> tuple[str, str]:
    """Return the command that comes next, and why."""
    if state.rig is None:
        return f"write {state.project.rig}", f"the rig is not described yet; {page('Build and measure the rig')}"
    if not state.sessions and state.plan is None:
        return "truearm plan ballbar --minutes 30", "there is no plan yet"
    if not state.sessions:
        return "truearm record", "nothing is recorded yet; truearm simulate rehearses it without hardware"
    if any(session.written for session in state.sessions):
        return "type q and Enter in truearm record", "the recording is under way"
    cut = next((session.path for session in state.sessions if not session.complete), None)
    if cut is not None:
        return f"truearm session recover {os.path.relpath(cut)}", "its recording was cut off"
    session, result = state.sessions[-1].path, state.results[-1] if state.results else None
    if result is None or result.path.stat().st_mtime < session.stat().st_mtime:
        return "truearm identify --hold-out 0.2", f"{session.name} is not identified yet"
    if result.status != "converged" or result.unusable is not None:
        why = "is not usable" if result.status == "converged" else "did not converge"
        return f"truearm inspect {os.path.relpath(session)}", f"the last fit {why}"
    return (
        f"truearm correct {os.path.relpath(result.path)} PROGRAM --out CORRECTED",
        "the robot is identified; if no rows were held out, judge it first with truearm validate",
    )


def _document(state: ProjectState) -> dict[str, Any]:
    return {
        "format": "truearm-status",
        "project": vars(state.project),
        "folder": str(state.home),
        "rig": str(state.rig) if state.rig else None,
        "plan": str(state.plan) if state.plan else None,
        "poses": state.poses,
        "sessions": list(map(_session_document, state.sessions)),
        "results": list(map(_result_document, state.results)),
        "other_sessions": list(map(_session_document, state.other_sessions)),
        "other_results": [{**_result_document(row), "session": str(row.session)} for row in state.other_results],
        "next": _next(state)[0],
        "why": _next(state)[1],
    }


def _session_document(session: SessionState) -> dict[str, Any]:
    return {
        "file": str(session.path),
        "size_bytes": session.size,
        "complete": session.complete,
        "written": session.written,
        "other_robot": session.model or None,
    }


def _result_document(result: ResultState) -> dict[str, Any]:
    return {
        "file": str(result.path),
        "held_out_rms_mm": result.held_out_mm,
        "status": result.status,
        "unusable_because": result.unusable,
    }
