"""Export a session as tables for other programs, all of them or none (``truearm session export``)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from truearm.disk import check_new_folder, sha256, working_folder
from truearm.errors import InputError, WriteError
from truearm.file_names import system_reason
from truearm.findings import option
from truearm.kinds.rig_file import read_rig
from truearm.kinds.table_file import table_columns
from truearm.progress import step
from truearm.session.observations import Survey
from truearm.session.session_file import Session
from truearm.session.session_tables import dwell_columns, pass_columns, plan_columns, tabulate
from truearm.strict_json import strict_json
from truearm.text import one_line
from truearm.types import Rig
from truearm.workflows.column_writers import ArrowTable, Columns
from truearm.workflows.requests import ExportSession
from truearm.workflows.session_observations import paired, surveyed
from truearm.workflows.session_parts import open_finished

SAID = "session.json"


@step("exporting the session")
def export_session_files(request: ExportSession) -> dict[str, Any]:
    """Write all tables, or none; return the contents of session.json. Raises InputError, SessionError, WriteError."""
    units = () if request.robot.robot is None else request.robot.load().chain.joint_units
    rig = None if request.rig is None else read_rig(request.rig)
    out = request.out
    check_new_folder(out, request.session)
    opened = open_finished(request.session, request.allow_damaged)
    try:
        with working_folder(out.parent) as folder:
            tables_folder = folder / "tables"
            tables_folder.mkdir()
            document = _export(opened, tables_folder, request, rig, units)
            document["sha256"] = sha256(request.session)
            (tables_folder / SAID).write_text(strict_json(document) + "\n", encoding="utf-8")
            if out.exists():
                out.rmdir()
            os.replace(tables_folder, out)
    except OSError as exc:
        raise WriteError(f"{out}: cannot be written: {system_reason(exc)}; nothing was exported") from exc
    return document


def _export(
    session: Session, folder: Path, request: ExportSession, rig: Rig | None, units: Sequence[str]
) -> dict[str, Any]:
    """Write all tables; return the contents of session.json."""
    survey, not_paired = surveyed(session), ""
    tables, titles = dict[str, ArrowTable](), dict[str, list[str]]()
    try:
        for name, columns in _tables(session, survey, rig, units):
            file = f"{name}.{request.format}"
            if file not in tables:
                tables[file], titles[file] = ArrowTable(folder / file, columns), list(columns)
            tables[file].write(columns)
    except InputError as exc:  # no observations; the rest is useful without them
        not_paired = one_line(exc.text(option))
    for table in tables.values():
        table.close()
    return {
        "session": session.path.name,
        "truncated": session.truncated,
        "damage": [asdict(damage) for damage in session.damage],
        "metadata": {key: entries for key, entries in session.metadata.items() if key != "channels"},
        "losses": asdict(survey.losses),
        "clock": [asdict(report) for report in survey.clock_reports],
        "robot_clock": [asdict(report) for report in survey.joints.reports],
        "readings_malformed": survey.joints.malformed,
        "readings_lost": survey.joints.lost,
        "not_paired": not_paired,
        "tables": {file: {"rows": table.rows, "columns": titles[file]} for file, table in tables.items()},
    }


def _tables(session: Session, survey: Survey, rig: Rig | None, units: Sequence[str]) -> Iterator[tuple[str, Columns]]:
    """Yield the name and the columns of each part of a table; last dwells, passes along lines, and, with a rig, observations."""
    yield from tabulate(survey, units)
    plan = plan_columns(survey, units)
    if plan is not None:
        yield "plan", plan
    try:
        result = paired(session, survey, rig)
    except InputError:
        yield "dwells", dwell_columns(survey, survey.dwells, units)
        raise
    yield "dwells", dwell_columns(survey, result.dwells, units)
    if result.passes:
        yield "passes", pass_columns(result.passes)
    yield "observations", table_columns(result.table, units or ("rad",) * result.table.q.shape[1])
