"""Write a session to other files: recovered, with joint readings from elsewhere, or as tables.

Tables are written in batches: CSV, NumPy's .npz, Parquet. Numbers are stored bit for bit. All are written as Parquet
first, and converted when the table ends. Memory holds one batch.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.disk import check_new_folder, check_writable, replacing, sha256, system_reason, working_folder
from truearm.errors import Argument, InputError, SessionError, WriteError
from truearm.findings import Finding, option, stated
from truearm.kinds.rig_file import read_rig
from truearm.kinds.table_file import table_columns
from truearm.model.robot_file import RobotChoice
from truearm.progress import step
from truearm.record.robots.sources import FileOptions, readings_of_file
from truearm.record.session_copies import Recovered, add_readings
from truearm.record.session_copies import recover as recover_session
from truearm.report.session_findings import damage_finding
from truearm.session.observations import Survey
from truearm.session.session_file import Session
from truearm.session.session_tables import dwell_columns, pass_columns, plan_columns, tabulate
from truearm.text import one_line, strict_json
from truearm.types import Rig
from truearm.workflows.recorded_session import open_finished, paired, surveyed
from truearm.workflows.requests import ExportSession

SAID = "session.json"
Columns = Mapping[str, NDArray[Any]]  # titles and columns of equal length


@step("recovering the session")
def recover_file(session: Path, out: Path, force: bool = False) -> Recovered | None:
    """Write the intact parts of a session to ``out``; None if the session is intact, and then nothing is written.

    Raises InputError, SessionError if nothing can be saved or the session is still being written, WriteError.
    """
    opened = open_finished(session, allow_damaged=True)
    if not (opened.truncated or opened.damage):
        return None
    check_writable(out, force, inputs=[session], kind="session")
    provenance = {"source": session.name, "sha256": sha256(session)}
    try:
        with replacing(out) as partial:
            recovered = recover_session(opened, partial, provenance)
            if not recovered.topics and "box" not in opened.metadata:  # it ended before the start
                raise SessionError(f"{session}: contains nothing that can be recovered; record again")
    except (OSError, WriteError) as exc:
        reason = f"{out}: cannot be written: {system_reason(exc)}; {session} is unchanged"
        raise WriteError(reason, exc.strerror or "") from exc
    return recovered


def recovery_findings(recovered: Recovered) -> list[Finding]:
    """Return what was saved of a session and what was lost."""
    accounts = recovered.topics.values()
    values = {
        **vars(recovered),
        "duration": {"s": recovered.seconds},
        "lost": sum(account.lost for account in accounts),
    }
    saved = stated("recovered", values, messages=sum(account.saved for account in accounts))
    return [saved, *(damage_finding(vars(damage)) for damage in recovered.damage)]


@step("adding the readings")
def add_joints_file(
    session: Path,
    source: Path,
    out: Path,
    options: FileOptions,
    *,
    zero: float | None = None,
    replace: bool = False,
    force: bool = False,
) -> int:
    """Write a session with the readings of a file, completely or not at all; return their number.

    ``zero`` [s]: when the controller's time was 0, after the session's begin; None: its time is UTC. ``replace``: leave
    out the session's own readings. Raises InputError, SessionError.
    """
    check_writable(out, force, inputs=[session, source], kind="session")
    if zero is not None and not abs(zero) < 1e9:
        raise InputError(Argument("zero"), f" {zero:g} is not a time; give seconds")
    opened = open_finished(session, options.allow_damaged)
    readings = readings_of_file(source, options)
    provenance = {
        "source": source.name,
        "session": session.name,
        "session_sha256": sha256(session),
        "time": "utc" if zero is None else f"0 at {zero!r} s of the session",
    }
    if opened.damage or opened.truncated:
        provenance["damaged"] = "the damaged part of the session is left out"
    with replacing(out) as new:
        return add_readings(opened, readings, new, zero, provenance, replace)


def joint_names(joints: str | None, robot: RobotChoice) -> list[str]:
    """Return the joints' names from the base on, without mimic joints; [] if none were given. Raises InputError."""
    if joints is not None and robot.robot is not None:
        raise InputError("exclusive", first=Argument("joints"), second=Argument("robot"))
    if robot.robot is not None:
        return [joint.name for joint in robot.load().chain.joints if joint.mimic is None]
    names = [] if joints is None else [name.strip() for name in joints.split(",")]
    if "" in names or len(set(names)) < len(names):
        raise InputError(Argument("joints"), f" {joints!r} must be a list of different names: a,b,c")
    return names


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
    """Yield the name and the columns of each part of a table.

    The last are dwells, passes along lines, and, with a rig, observations.
    """
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


class ArrowTable:
    """A table that is being written to a file named .parquet, .csv or .npz; ``rows`` is the number of rows so far.

    The first batch defines titles and types, and is not written yet. CSV: UTF-8 with a header; floats in the fewest
    digits that give the same number again; an empty cell for NaN. .npz: one array per title, readable by ``numpy.load``
    without pickling. Raises OSError if the disk refuses a write.
    """

    def __init__(self, path: Path, columns: Columns) -> None:
        from pyarrow import parquet

        self.rows = 0
        self._path, self._parquet = path, path.with_suffix(".parquet")
        self._schema = _arrow(columns).schema
        # Measured numbers hardly repeat: looking for repetitions makes files larger and takes a third of the time.
        texts = [title for title, column in columns.items() if column.dtype.kind == "U"]
        self._writer = parquet.ParquetWriter(self._parquet, self._schema, compression="zstd", use_dictionary=texts)

    def write(self, columns: Columns) -> None:
        """Append a batch with the titles and types of the first."""
        table = _arrow(columns).cast(self._schema)
        self._writer.write_table(table)
        self.rows += int(table.num_rows)

    def close(self) -> None:
        """Complete the file."""
        self._writer.close()
        if self._path != self._parquet:
            (_write_csv if self._path.suffix == ".csv" else _write_npz)(self._parquet, self._path)
            self._parquet.unlink()


def _arrow(columns: Columns) -> Any:
    import pyarrow

    def array(column: NDArray[Any]) -> Any:
        if column.dtype.kind == "U":
            return pyarrow.array(column.tolist(), pyarrow.string())
        return pyarrow.array(np.ascontiguousarray(column))

    return pyarrow.table({title: array(column) for title, column in columns.items()})


def _write_csv(source: Path, path: Path) -> None:
    import pyarrow
    from pyarrow import csv, parquet

    with parquet.ParquetFile(source) as file, csv.CSVWriter(path, file.schema_arrow) as writer:
        for batch in file.iter_batches():
            arrays = [
                pyarrow.array(column.to_numpy(zero_copy_only=False), from_pandas=True) for column in batch.columns
            ]
            writer.write_batch(pyarrow.record_batch(arrays, names=batch.schema.names))  # NaN as an empty cell


def _write_npz(source: Path, path: Path) -> None:
    import pyarrow
    from pyarrow import compute, parquet, types

    with zipfile.ZipFile(path, "w") as archive, parquet.ParquetFile(source) as file:
        for field in file.schema_arrow:
            if types.is_string(field.type):
                lengths = (compute.max(compute.utf8_length(piece)).as_py() or 0 for piece in _pieces(file, field.name))
                dtype = np.dtype(f"U{max([1, *lengths])}")
            else:
                dtype = pyarrow.array([], field.type).to_numpy(zero_copy_only=False).dtype
            header = {"descr": dtype.str, "fortran_order": False, "shape": (file.metadata.num_rows,)}
            with archive.open(f"{field.name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, header)
                for piece in _pieces(file, field.name):
                    member.write(piece.to_numpy(zero_copy_only=False).astype(dtype).tobytes())


def _pieces(file: Any, title: str) -> Iterator[Any]:
    """Yield a column of a Parquet file batch by batch."""
    return (batch.column(0) for batch in file.iter_batches(columns=[title]))
