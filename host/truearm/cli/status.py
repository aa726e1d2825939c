"""``truearm status``: show the files of a project and the next command."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from truearm.cli.command import Answer, command
from truearm.errors import InputError
from truearm.text import counted, one_line, outcome, page
from truearm.workflows.project_file import FILE, find_project

State = dict[str, Any]


@command()
def status() -> Answer:
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
    following, why = next(_steps(state))
    return Answer({**state, "next": following, "why": why}, [f"next      {following} ({why})", *_lines(state)])


def _lines(state: State) -> Iterator[str]:
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
        yield f"{title:<10}{len(state[title]) or 'none'}"
        yield from (f"          {word(row)}" for row in state[title])


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


def _steps(state: State) -> Iterator[tuple[str, str]]:
    """Yield commands, the next one first, each with the reason."""
    sessions, results, project = state["sessions"], state["results"], state["project"]
    if state["rig"] is None:
        yield f"write {project['rig']}", f"the rig is not described yet; {page('Build and measure the rig')}"
    if seats := state["seats"]:
        measured, hold_out = seats["file"], f"place={seats['last_place']}"
        if seats["noted"] < seats["rows"]:
            why = f"{seats['rows'] - seats['noted']} rows have no joints yet; delete a row that you do not measure"
            yield f"write the joints of each seat of places.csv into {_shown(measured)}, or truearm seats LOG", why
    else:
        if not sessions and state["plan"] is None:
            yield "truearm plan ballbar --minutes 30", "there is no plan yet"
        if not sessions:
            yield "truearm record", "nothing is recorded yet; truearm simulate rehearses it without hardware"
        if any(row["written"] for row in sessions):
            yield "type q and Enter in truearm record", "the recording is under way"
        for row in sessions:
            if not row["complete"]:
                yield f"truearm session recover {_shown(row['file'])}", "its recording was cut off"
        for row in sessions:
            if robot := row["other_robot"]:
                why = f"it was recorded for {one_line(robot)}, and truearm identify reads all sessions there"
                yield f"move {_shown(row['file'])} out of {project['sessions']}", why
        measured, hold_out = sessions[-1]["file"], "0.2"
    results = [result for result in results if not result["simulated"]] or results  # a rehearsal counts for nothing
    if not results or os.stat(results[-1]["file"]).st_mtime < os.stat(measured).st_mtime:
        yield f"truearm identify --hold-out {hold_out}", f"{Path(measured).name} is not identified yet"
    result = results[-1]
    if result["status"] != "converged" or result["unusable_because"] is not None:
        why = "is not usable" if result["status"] == "converged" else "did not converge"
        command = f"inspect {_shown(measured)}" if seats is None else "identify --details"
        yield f"truearm {command}", f"the last fit {why}"
    if result["simulated"]:
        yield "truearm record", "the last result says nothing about a real robot: its session is simulated"
    corrected = f"truearm correct {_shown(result['file'])} PROGRAM --out CORRECTED"
    yield corrected, "the robot is identified; if no rows were held out, judge it first with truearm validate"
