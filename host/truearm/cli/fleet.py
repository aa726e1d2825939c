"""``truearm fleet``: identify the robots of many projects."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from truearm.cli.command import Answer, command
from truearm.exit_codes import ExitCode
from truearm.text import one_line
from truearm.workflows.requests import FleetOptions


@command()
def fleet(folders: tuple[Path, ...], *, options: FleetOptions) -> Answer:
    """Identify the robots of all projects in some folders, several at a time.

    Each project is identified as by truearm identify in its folder, and its result is written into its folder results.
    A project that has a result of the same files and options is not identified again. The exit code is that of
    the worst arm.

    Example:
      truearm fleet cells --hold-out 0.2 --out fleet.csv

    Arguments
    ---------
    folders : FOLDER...
        Folders of projects (truearm init), or folders that contain them.

    Options
    -------
    hold_out : GROUP|FRACTION
        Rows of each arm to hold out, as for truearm identify (repeatable).
    reports
        Write a report beside each result (.html), with a certificate.
    workers : N
        Number of arms at a time. Default: one per core.
    dask : ADDRESS|local
        Use the workers of a Dask scheduler, such as tcp://10.0.0.5:8786; they need the same folders. local: start them
        on this machine.
    out : FILE
        File to write: the table of all arms (.csv). It replaces an earlier table of arms.
    """
    from truearm.workflows.fleet import identify_fleet, worst

    rows = identify_fleet(folders, options)
    width = max(len(one_line(row.arm)) for row in rows)
    lines = [f"{'arm':<{width}}    nominal  identified"]
    for row in rows:
        errors = [f"{mm:.3f} mm" if mm is not None else "" for mm in (row.before_mm, row.after_mm)]
        remark = one_line(row.verdict) * (row.code != ExitCode.DONE)
        lines.append(f"{one_line(row.arm):<{width}}  {errors[0]:>9}  {errors[1]:>9}  {remark}".rstrip())
    if options.out is not None:
        lines.append(f"Written: {one_line(str(options.out))}")
    document = {"format": "truearm-fleet", "arms": [asdict(row) for row in rows]}
    return Answer(document, lines, end=worst(rows))
