"""``truearm export-session``: a session as tables for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import say_parts
from truearm.text import one_line


def export_session(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Session file (.mcap) of truearm record.")],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="A new or empty folder for the tables.")],
    format: Annotated[
        str, typer.Option("--format", metavar="KIND", help="csv, npz or parquet (needs truearm[parquet]).")
    ] = "csv",
    rig: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Rig (.toml) in place of the one that was recorded.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(metavar="ROBOT", help="Says which joints turn and which slide; default: all turn.")
    ] = None,
    allow_damaged: Annotated[
        bool, typer.Option("--allow-damaged", help="Export what is whole of a damaged or unfinished file.")
    ] = False,
) -> None:
    """Write a session as tables: all samples, joint readings, clock exchanges, events, plan, dwells, passes and observations.

    A file a stream. Samples have the box's own time and the host's, synchronised, with its bound of error; counts, and what they
    mean in SI units, which stand in the headers. A gap is marked, not filled. session.json says what was lost and
    explains the rest (docs/session-format.md).

    \b
    Example:
      truearm export-session session.mcap --out tables --format parquet
    """
    from truearm.workflows.export_session import ExportSession, export_session_files

    tables = export_session_files(ExportSession(session, out, format, rig, robot, allow_damaged))
    for name, rows in tables.items():
        typer.echo(f"{one_line(str(out))}/{name}: {rows} rows")
    say_parts(session, "export each by itself, its clocks are its own")
