"""``truearm export-session``: a session as tables for other programs."""

from __future__ import annotations

import os
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from truearm.errors import InputError, WriteError
from truearm.text import one_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from truearm.files.column_writers import Columns, Table
    from truearm.session.pipeline import Survey
    from truearm.session.session_file import Session
    from truearm.types import Rig

SAID = "session.json"


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
    from truearm.files.column_writers import check_format
    from truearm.files.disk import sha256
    from truearm.files.strict_json import strict_json
    from truearm.session.session_file import open_session
    from truearm.workflows.session_parts import say_parts

    check_format(format)
    units = _joint_units(robot)
    given = None if rig is None else _read_rig(rig)
    _check_folder(out)
    opened = open_session(session, allow_damaged)
    try:
        with tempfile.TemporaryDirectory(prefix=".truearm-", dir=out.parent) as folder:
            whole = Path(folder) / "tables"
            whole.mkdir()
            document = _export(opened, whole, format, given, units)
            document["sha256"] = sha256(session)
            (whole / SAID).write_text(strict_json(document, indent=2) + "\n", encoding="utf-8")
            if out.exists():
                out.rmdir()
            os.replace(whole, out)
    except OSError as exc:
        raise WriteError(f"{out}: cannot be written: {exc.strerror or exc}; nothing was exported") from exc
    for name, table in document["tables"].items():
        typer.echo(f"{one_line(str(out))}/{name}: {table['rows']} rows")
    say_parts(session, "export each by itself, its clocks are its own")


def _joint_units(robot: str | None) -> tuple[str, ...]:
    from truearm.files.robot_file import load_robot

    return () if robot is None else load_robot(robot).chain.joint_units


def _read_rig(path: Path) -> Rig:
    from truearm.files.rig_file import read_rig

    return read_rig(path)


def _check_folder(out: Path) -> None:
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"{out}: exists and is no empty folder; choose another name")
        if not out.parent.is_dir():
            raise InputError(f"{out}: the folder {out.parent} does not exist; create it first")
    except OSError as exc:
        raise InputError(f"{out}: cannot be used as a folder: {exc.strerror}") from exc


def _export(session: Session, folder: Path, format: str, rig: Rig | None, units: Sequence[str]) -> dict[str, Any]:
    """Write all tables; returns what session.json says."""
    from truearm.session.pipeline import survey
    from truearm.session.result_columns import plan_columns
    from truearm.session.session_columns import tabulate
    from truearm.workflows.inspect import ident_of
    from truearm.workflows.session_observations import messages_of

    ident, messages = ident_of(session), messages_of(session)
    found = survey(messages, ident)
    tables = _Tables(folder, format)
    for name, batch in tabulate(messages, found, ident, units):
        tables.write(name, batch)
    plan = plan_columns(found, units)
    if plan is not None:
        tables.write("plan", plan)
    not_paired = ""
    try:
        for name, columns in _observations(session, found, rig, units):
            tables.write(name, columns)
    except InputError as exc:  # the rest is of use without it
        not_paired = one_line(str(exc))
    return {
        "session": session.path.name,
        "truncated": session.truncated,
        "damage": [asdict(damage) for damage in session.damage],
        "metadata": {key: entries for key, entries in session.metadata.items() if key != "channels"},
        "losses": asdict(found.losses),
        "clock": [asdict(report) for report in found.clock_reports],
        "robot_clock": [asdict(report) for report in found.joints.reports],
        "readings_malformed": found.joints.malformed,
        "readings_lost": found.joints.lost,
        "not_paired": not_paired,
        "tables": tables.close(),
    }


def _observations(
    session: Session, found: Survey, rig: Rig | None, units: Sequence[str]
) -> Iterator[tuple[str, Columns]]:
    """Dwells, passes along lines, and observations where there is a rig to pair them with."""
    from truearm.files.observation_table import table_columns
    from truearm.session.pipeline import observations
    from truearm.session.result_columns import dwell_columns, pass_columns
    from truearm.workflows.inspect import ident_of
    from truearm.workflows.session_observations import attached_rig, messages_of

    rig = rig or attached_rig(session, session.path)
    if rig is None:
        yield "dwells", dwell_columns(found, found.dwells, units)
        raise InputError("was recorded without a rig; give one with --rig to have observations")
    result = observations(messages_of(session), rig, ident_of(session), name=session.path.name, found=found)
    yield "dwells", dwell_columns(found, result.dwells, units)
    if result.passes:
        yield "passes", pass_columns(result.passes)
    yield "observations", table_columns(result.table, units or ("rad",) * result.table.q.shape[1])


class _Tables:
    """The tables of an export by name."""

    def __init__(self, folder: Path, format: str) -> None:
        self._folder, self._format = folder, format
        self._tables: dict[str, tuple[Table, list[str]]] = {}

    def write(self, name: str, columns: Columns) -> None:
        from truearm.files.column_writers import FORMATS

        name = f"{name}.{self._format}"
        if name not in self._tables:
            self._tables[name] = FORMATS[self._format](self._folder / name, columns), list(columns)
        self._tables[name][0].write(columns)

    def close(self) -> dict[str, Any]:
        """Complete all; rows and titles of each."""
        for table, _ in self._tables.values():
            table.close()
        return {name: {"rows": table.rows, "columns": titles} for name, (table, titles) in self._tables.items()}
