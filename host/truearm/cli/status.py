"""``truearm status``: show the files of a project and the next command."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from truearm.cli.command import Answer, command
from truearm.errors import InputError
from truearm.findings import Finding, entries, option, worded
from truearm.text import counted, one_line, outcome
from truearm.workflows.project_file import FILE, find_project

State = dict[str, Any]

SHOWN = 3  # sessions and results, so that at most 15 lines are printed


@command()
def status() -> Answer:
    """Show the files of this folder's project, and the command that comes next.

    \b
    Example:
      truearm status

    Options
    -------
    details
        Print all sessions and results.
    """
    from truearm.workflows.project import state_of

    file = find_project(Path.cwd())
    if file is None:
        raise InputError("no-project", file=FILE)
    state = state_of(file)
    following = next(_steps(state))
    why, step = (worded(template, following.values, option) for template in following.statement[1:])
    document = {**state, "next": step, "why": why, "findings": entries([following])}
    head = f"next      {step} ({why})"
    return Answer(document, [head, *_lines(state, SHOWN)], tables=[head, *_lines(state)])


def _lines(state: State, most: int = 0) -> Iterator[str]:
    """Describe a project, with the newest ``most`` of its sessions and results; 0: all."""
    project = state["project"]
    serial = f", serial {project['serial']}" * bool(project["serial"])
    missing = f"none ({project['rig']} is missing)"
    yield f"project   {project['name'] or Path(state['folder']).name}, {_shown(state['folder'], 'this folder')}"
    yield f"robot     {project['model']}{serial}, {project['address'] or 'no address'}"
    yield f"rig       {_shown(state['rig']) if state['rig'] else missing}"
    yield f"plan      {_shown(state['plan'])}, {counted(state['poses'], 'pose')}" if state["plan"] else "plan      none"
    if seats := state["seats"]:
        yield f"seats     {_shown(seats['file'])}, {seats['noted']} of {seats['rows']} with joints"
    for title, word in (("sessions", _session), ("results", _result)):
        shown = state[title][-most:]
        newest = ", the newest of them (all: --details)" * (len(shown) < len(state[title]))
        yield f"{title:<10}{len(state[title]) or 'none'}{newest}"
        yield from (f"          {word(row)}" for row in shown)


def _shown(file: str, current: str = os.curdir) -> str:
    """Return the name of a file or folder relative to this folder."""
    path = os.path.relpath(file)
    return current if path == os.curdir else path


def _session(row: State) -> str:
    cut = ", is being written" if row["written"] else ", not complete: truearm session recover"
    completeness = "" if row["complete"] else cut
    robot = f", recorded for another robot: {one_line(row['other_robot'])}" if row["other_robot"] else ""
    return f"{_shown(row['file'])}, {row['size_bytes'] / 2**20:.1f} MiB{completeness}{robot}"


def _result(row: State) -> str:
    held_out, unusable = row["held_out_rms_mm"], row["unusable_because"]
    why = f", not usable ({unusable})" if unusable is not None and row["status"] == "converged" else ""
    held = "" if held_out is None else f", {held_out:.4f} mm RMS held out"
    return f"{_shown(row['file'])}, {'simulated, ' * row['simulated']}{outcome(row['status'])}{why}{held}"


def _steps(state: State) -> Iterator[Finding]:
    """Yield what comes next, the first of these first."""
    sessions, results, project = state["sessions"], state["results"], state["project"]
    if state["rig"] is None:
        yield Finding("rig-next", {"rig": project["rig"]})
    if seats := state["seats"]:
        measured, hold_out = seats["file"], f"place={seats['last_place']}"
        if seats["noted"] < seats["rows"]:
            yield Finding("seats-next", {"seats": _shown(measured), "n": seats["rows"] - seats["noted"]})
    else:
        if not sessions and state["plan"] is None:
            yield Finding("plan-next")
        if not sessions:
            yield Finding("record-next")
        if any(row["written"] for row in sessions):
            yield Finding("recording-next")
        for row in sessions:
            if not row["complete"]:
                yield Finding("recover-next", {"session": _shown(row["file"])})
        for row in sessions:
            if row["other_robot"]:
                values = {"session": _shown(row["file"]), "robot": row["other_robot"], "folder": project["sessions"]}
                yield Finding("move-next", values)
        measured, hold_out = sessions[-1]["file"], "0.2"
    results = [result for result in results if not result["simulated"]] or results  # a rehearsal counts for nothing
    if not results or os.stat(results[-1]["file"]).st_mtime < os.stat(measured).st_mtime:
        yield Finding("identify-next", {"file": Path(measured).name, "hold_out": hold_out})
    result = results[-1]
    converged = result["status"] == "converged"
    if not converged or result["unusable_because"] is not None:
        yield Finding("cause-next", {"unusable": converged, "session": None if seats else _shown(measured)})
    if result["simulated"]:
        yield Finding("record-next", {"simulated": True})
    yield Finding("use-next", {"result": _shown(result["file"])})
