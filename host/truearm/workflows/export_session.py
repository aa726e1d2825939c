"""Export a session as tables for other programs, all of them or none (``truearm session export``)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from truearm.errors import Argument, InputError, WriteError
from truearm.file_names import system_reason
from truearm.files.column_tables import Columns, ColumnTable, Placement
from truearm.files.column_writers import FORMATS, check_format
from truearm.files.disk import sha256, working_folder
from truearm.files.labels_file import read_labels
from truearm.files.observation_table import table_columns
from truearm.files.rig_file import read_rig
from truearm.files.strict_json import strict_json
from truearm.progress import step
from truearm.record.session_writer import read_anchor
from truearm.session.observations import Survey, observations
from truearm.session.session_file import Session
from truearm.session.session_tables import dwell_columns, pass_columns, plan_columns, tabulate
from truearm.text import one_line
from truearm.types import Rig
from truearm.workflows.requests import ExportSession
from truearm.workflows.session_observations import attached_rig, surveyed
from truearm.workflows.session_parts import open_finished

SAID = "session.json"
USUAL_RATE_HZ = 100.0


@step("exporting the session")
def export_session_files(wanted: ExportSession) -> dict[str, dict[str, Any]]:
    """Write all tables, or none; return the rows and titles of each by name. Raises InputError, SessionError, WriteError."""
    check_format(wanted.format)
    if wanted.rate is not None and wanted.format != "mcap":
        text = f" has no effect with format {wanted.format}, which holds all samples; leave it out, or use format mcap"
        raise InputError(Argument("rate"), text)
    units = () if wanted.robot.robot is None else wanted.robot.load().chain.joint_units
    given = None if wanted.rig is None else read_rig(wanted.rig)
    out = wanted.out
    _check_folder(out)
    opened = open_finished(wanted.session, wanted.allow_damaged)
    try:
        with working_folder(out.parent) as folder:
            whole = folder / "tables"
            whole.mkdir()
            document = _export(opened, whole, wanted, given, units)
            document["sha256"] = sha256(wanted.session)
            (whole / SAID).write_text(strict_json(document) + "\n", encoding="utf-8")
            if out.exists():
                out.rmdir()
            os.replace(whole, out)
    except OSError as exc:
        raise WriteError(f"{out}: cannot be written: {system_reason(exc)}; nothing was exported") from exc
    tables: dict[str, dict[str, Any]] = document["tables"]
    return tables


def _check_folder(out: Path) -> None:
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError("file-exists", place=out, folder=True)
        if not out.parent.is_dir():
            raise InputError("missing-file", place=out, folder=out.parent)
    except OSError as exc:
        raise InputError(f"{out}: cannot be used as a folder: {exc.strerror}") from exc


def _export(
    session: Session, folder: Path, wanted: ExportSession, rig: Rig | None, units: Sequence[str]
) -> dict[str, Any]:
    """Write all tables; return the contents of session.json."""
    found = surveyed(session)
    utc_ns, host_ns = read_anchor(session.metadata.get("session", {})) or (0, 0)
    rate_hz = USUAL_RATE_HZ if wanted.rate is None else wanted.rate
    tables = _Tables(folder, wanted.format, Placement(utc_ns - host_ns, host_ns, rate_hz))
    for name, batch in tabulate(found, units):
        tables.write(name, batch)
    plan = plan_columns(found, units)
    if plan is not None:
        tables.write("plan", plan)
    not_paired = ""
    try:
        for name, columns in _observations(session, found, rig, units):
            tables.write(name, columns)
    except InputError as exc:  # the rest is useful without it
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
    """Add dwells, passes along lines, and, if there is a rig to assign them, observations."""
    rig = rig or attached_rig(session, session.path)
    if rig is None:
        yield "dwells", dwell_columns(found, found.dwells, units)
        raise InputError("was recorded without a rig; give a rig to get observations")
    result = observations(session.batches, rig, name=session.path.name, found=found, labels=read_labels(session.path))
    yield "dwells", dwell_columns(found, result.dwells, units)
    if result.passes:
        yield "passes", pass_columns(result.passes)
    yield "observations", table_columns(result.table, units or ("rad",) * result.table.q.shape[1])


class _Tables:
    """The tables of an export by name."""

    def __init__(self, folder: Path, format: str, placement: Placement) -> None:
        self._all = FORMATS[format](folder, placement)
        self._tables: dict[str, tuple[str, ColumnTable, list[str]]] = {}

    def write(self, name: str, columns: Columns) -> None:
        if name not in self._tables:
            self._tables[name] = *self._all.begin(name, columns), list(columns)
        self._tables[name][1].write(columns)

    def close(self) -> dict[str, Any]:
        """Complete all tables; return the written rows, all rows of the session, and the titles of each."""
        for _, table, _ in self._tables.values():
            table.close()
        self._all.close()
        return {
            name: {"rows": table.rows, "session_rows": table.session_rows, "columns": titles}
            for name, table, titles in self._tables.values()
        }
