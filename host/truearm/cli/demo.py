"""``truearm demo``: simulate a recording, identify the robot, and write the report, by what the commands do."""

from __future__ import annotations

import shlex
from dataclasses import replace
from functools import partial
from pathlib import Path

import typer

from truearm.cli.command import command
from truearm.cli.output import print_json, warn
from truearm.workflows.requests import FAST_RATE_HZ, SimulateOptions

DEMO = SimulateOptions(Path("out/demo"), poses=90, rate=FAST_RATE_HZ)
FULL_POSES = 800


@command()
def demo(
    context: typer.Context,
    request: SimulateOptions = DEMO,
    *,
    full: bool = False,
    open: bool = False,
    json: bool = False,
) -> None:
    """Calibrate a simulated robot (default: the PUMA 560) with a ball-bar or a line device, from the firmware to the report.

    Does what truearm simulate --fast and truearm identify do. The last bar and the last line are held out: their rows are
    not fitted, so they show how accurate the calibrated robot is.

    Example:
      truearm demo --out out/demo
      truearm demo --lines 5 --out out/line
      truearm demo --model ur5e --poses 200 --out out/ur5e

    Options
    -------
    out : FOLDER
        Folder to write: session, plan, rig, observations, result and report.
    poses : N
        Poses with each of the two bars.
    lines : N
        Number of lines along a line device, driven there and back. 0: use a ball-bar instead.
    full
        800 poses with each bar: 73 minutes of the robot's time.
    open
        Open the report in the browser.

    Expert options
    --------------
    plan : FILE
        Plan: what the robot visits (.csv).
    rig : FILE
        The rig of --plan (.toml). Default: the simulator's own.
    force
        Overwrite the file of --truth-out if truearm wrote it. Files of the same command in the folder of --out are
        overwritten in any case.
    rate : HZ
        Samples per second of each channel.
    """
    from truearm.cli.findings_text import show
    from truearm.finding_texts import Severity
    from truearm.report.result_findings import result_findings
    from truearm.workflows.demo import demonstrate

    request = replace(request, poses=FULL_POSES) if full else request
    command_line, say = shlex.join(["truearm", *(context.obj or [])]), partial(typer.echo, err=json)
    document = demonstrate(request, command_line, say, warn).document
    page = request.out / "report.html"
    if json:
        print_json({"report": str(page), "result": document})
    else:
        answers = [
            finding
            for finding in result_findings(document)
            if finding.code == "simulated" or (finding.severity is Severity.RESULT and finding.code != "identified")
        ]
        show(answers, written=[page], more="")
    if open:
        typer.launch(str(page))
