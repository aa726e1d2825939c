"""``truearm status``: show the files of a project and the next command."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, assert_never

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
    others += [
        f"{_result(result)} (of {os.path.relpath(result.session)})" for result in state.other_results if result.session
    ]
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
    from truearm.workflows.project import NextStep

    match state.next:
        case NextStep.DESCRIBE:
            return f"write {state.project.rig}", f"the rig is not described yet; {page('Build and measure the rig')}"
        case NextStep.PLAN:
            return "truearm plan ballbar --minutes 30", "there is no plan yet"
        case NextStep.RECORD:
            if state.sessions:
                return "type q and Enter in truearm record", "the recording is under way"
            return "truearm record", "nothing is recorded yet; truearm simulate rehearses it without hardware"
        case NextStep.RECOVER:
            cut = next(one.path for one in state.sessions if not one.complete)
            return f"truearm session recover {os.path.relpath(cut)}", "its recording was cut off"
        case NextStep.IDENTIFY:
            return "truearm identify --hold-out 0.2", f"{state.sessions[-1].path.name} is not identified yet"
        case NextStep.INSPECT:
            return (
                f"truearm inspect {os.path.relpath(state.sessions[-1].path)}",
                f"the last fit {'is not usable' if state.results[-1].status == 'converged' else 'did not converge'}",
            )
        case NextStep.CORRECT:
            result = os.path.relpath(state.results[-1].path)
            return (
                f"truearm correct {result} PROGRAM --out CORRECTED",
                "the robot is identified; if no rows were held out, judge it first with truearm validate",
            )
        case _:
            assert_never(state.next)


def _document(state: ProjectState) -> dict[str, Any]:
    return {
        "format": "truearm-status",
        "project": vars(state.project),
        "folder": str(state.home),
        "rig": str(state.rig) if state.rig else None,
        "plan": str(state.plan) if state.plan else None,
        "poses": state.poses,
        "sessions": [_session_document(session) for session in state.sessions],
        "results": [_result_document(result) for result in state.results],
        "other_sessions": [_session_document(session) for session in state.other_sessions],
        "other_results": [
            {**_result_document(result), "session": str(result.session) if result.session else None}
            for result in state.other_results
        ],
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
