"""``truearm demo``: simulate a recording, identify the robot, and write the report, by what the commands do."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import click

from truearm.cli.command import Answer, command
from truearm.cli.options import command_line, sources_of
from truearm.workflows.requests import FAST_RATE_HZ, SimulateOptions

DEMO = SimulateOptions(Path("out/demo"), poses=90, rate=FAST_RATE_HZ)
FULL_POSES = 800


@command()
def demo(
    context: click.Context,
    request: SimulateOptions = DEMO,
    *,
    full: bool = False,
    open: bool = False,
    json: bool = False,
) -> Answer:
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
    from truearm.finding_texts import Severity
    from truearm.plan.plan_file import read_plan
    from truearm.workflows.identify import DEFAULTS, IdentifyFiles, identify_files
    from truearm.workflows.selection import last_of_each
    from truearm.workflows.simulate import SESSION, simulate_fast

    request = replace(request, poses=FULL_POSES) if full else request
    simulate_fast(request, lambda text: print(text, file=sys.stderr if json else None, flush=True))
    folder = request.out
    table, page = folder / "observations.csv", folder / "report.html"
    sources = sources_of((folder / SESSION,))
    files = IdentifyFiles(
        request.robot, sources, (folder / "result.json",), table, page, command_line(context), force=True
    )
    identification = identify_files(files, last_of_each(read_plan(folder / "plan.csv")), DEFAULTS)
    answers = [
        finding
        for finding in identification.findings
        if finding.code == "simulated" or (finding.severity is Severity.RESULT and finding.code != "identified")
    ]
    if open:
        click.launch(str(page))
    return Answer(
        {"report": str(page), "result": identification.document}, findings=answers, written=[page], details_hint=""
    )
