"""``truearm record``: record a box and, if there is one, a robot into a session file."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from truearm.cli.command import Answer, command
from truearm.cli.project import ProjectCommand, project_model, typed
from truearm.errors import IncompleteError, InputError
from truearm.exit_codes import ExitCode
from truearm.workflows.requests import RecordOptions


class RecordCommand(ProjectCommand):
    """Takes plan, rig and robot from the session that it resumes, not from the project."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        if ctx.params.get("resume") is not None:
            ctx.params.update({name: typed(ctx, name) for name in ("out", "plan", "rig", "address")})
        return super().invoke(ctx)


@command(cls=RecordCommand)
def record(request: RecordOptions) -> Answer:
    """Record a sensor box and a robot into a session file.

    Without --box, truearm uses the box that is plugged in. The recording ends with Ctrl-C, with q and Enter, after --duration-s, when the
    robot's program reports its end, or when a box or robot that was lost does not return within --patience-s. The file is complete in
    each case; the exit code is 4 if something that was asked for is missing. --force overwrites an earlier file only once the box has
    started. On a terminal you can type during the recording: Enter confirms what you are asked to mount,
    bar=NAME,chuck=NAME,sphere=NAME or line=NAME,target=NAME names another one, and note TEXT is stored.

    Example:
      truearm record --address tcp://127.0.0.1:7008 --rig rig.toml --plan plan.csv --out session.mcap
      truearm record --resume session.mcap

    Options
    -------
    out : FILE
        File to write: a session (.mcap); not with --resume.
    resume : FILE
        Continue this session in a further file beside it, with its plan, rig, rate and robot.
    address : URL
        Source of the robot's joint readings: {sources}. Without it, dwells are found from the sensor alone.
    rig : FILE
        Rig (.toml). It is stored in the session. Default with --resume: the rig of that session.
    mounted : LIST
        What is mounted at the start: bar=bar46,chuck=c1,sphere=s1 or line=l1,target=t1.
    rate : HZ
        Samples per second; the box's nearest rate is used. Default: 1000.

    Expert options
    --------------
    patience_s : S
        How long to wait for a box or robot whose link was lost; 0: do not wait.
    unchecked
        Record even if the box cannot measure what the plan or rig requires.
    """
    from truearm.workflows.record import record_request, recording_document

    if request.duration is not None and request.duration <= 0:
        raise InputError(f"--duration-s {request.duration:g} is not a duration; give seconds above 0")
    if request.patience < 0:
        raise InputError(f"--patience-s {request.patience:g} is not a duration; give seconds, or 0 not to wait")
    request = replace(request, project_model=project_model(Path.cwd()))
    recorded = record_request(request, sys.stderr, lambda text: click.echo(text, err=True))
    interrupted = recorded.summary.reason == "interrupted"
    end: ExitCode | IncompleteError = ExitCode.INTERRUPTED if interrupted else ExitCode.DONE
    if recorded.trouble:
        click.echo(recorded.trouble, err=True)
    if interrupted and not recorded.is_kept:
        click.echo("interrupted before the box had started; nothing was recorded", err=True)
    elif recorded.missing:
        data_place = f"; the received data are in {recorded.out}" if recorded.is_kept else "; nothing was recorded"
        named = recorded.is_kept and str(recorded.out) in recorded.missing
        end = IncompleteError(recorded.missing if named else f"{recorded.missing}{data_place}")
    return Answer(recording_document(recorded), end=end)
