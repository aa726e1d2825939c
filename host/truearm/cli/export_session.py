"""``truearm session export``: write a session as tables for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from truearm.cli.command import command
from truearm.cli.output import print_result, warn_of_further_parts
from truearm.text import counted, one_line
from truearm.workflows.requests import ExportSession


@command()
def export_session(
    request: ExportSession,
    *,
    json: bool = False,
) -> None:
    """Write a session as tables: all samples, joint readings, clock exchanges, events, plan, dwells, passes and observations.

    Writes one file per stream; with --format mcap one file with one channel per stream, all on one time axis. A sample has the
    box's time, the synchronised host time with its error bound, the counts, and the value in the SI unit that its column names.
    Gaps are marked, not filled. session.json lists losses and describes the columns. --model determines which joints are prismatic;
    without it all are revolute.

    Example:
      truearm session export session.mcap --out tables --format parquet
      truearm session export session.mcap --out viewers --format mcap

    Options
    -------
    out : FOLDER
        Folder to write: the tables; it must be new or empty.
    format : KIND
        csv, npz, parquet (needs truearm[parquet]), or mcap: JSON for Foxglove and PlotJuggler.
    rate : HZ
        With --format mcap: largest number of samples per second of a stream; 0: all. Default: 100.
    """
    from truearm.workflows.export_session import export_session_files

    tables = export_session_files(request)
    lines = (f"{one_line(str(request.out))}/{name}: {_size(table)}" for name, table in tables.items())
    rows = {name: table["rows"] for name, table in tables.items()}
    print_result({"folder": str(request.out), "rows": rows}, lines, json)
    warn_of_further_parts(request.session, "export each part separately: each has clocks of its own")


def _size(table: Mapping[str, Any]) -> str:
    """Return the number of samples, which ``truearm inspect`` prints too, or of rows; and how many of them were written."""
    size = counted(table["session_rows"], "sample" if "gap" in table["columns"] else "row")
    thinned = table["rows"] < table["session_rows"]
    return f"{table['rows']} of {size} (--rate 0 writes all)" if thinned else size
