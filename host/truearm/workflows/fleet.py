"""Many arms: identify the robot of every project found in some folders, several at a time (``truearm fleet``).

Each arm writes files of its own, whole. A further run does only what is missing, so nothing is lost with a worker.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from truearm.additions import plug_in_error
from truearm.disk import check_writable, system_reason, write_atomic
from truearm.errors import Argument, ExitCode, InputError, TruearmError
from truearm.kinds.csv_cells import csv_text
from truearm.progress import step
from truearm.report.result_findings import verdict
from truearm.text import counted
from truearm.workflows.identify import DEFAULTS, IdentifyFiles, identify_files
from truearm.workflows.inputs import Sources, hashed_inputs
from truearm.workflows.project import new_file, result_document, results_of, robot_of, sessions_of
from truearm.workflows.project_file import FILE, Project, read_project
from truearm.workflows.recorded_session import with_parts
from truearm.workflows.report import Issue, report_files
from truearm.workflows.requests import FleetOptions

LOCAL = "local"  # in place of the address of a Dask scheduler: a cluster on this machine
RUNS = 2  # a worker that is killed ends a run
BEST_FIRST = (ExitCode.DONE, ExitCode.UNUSABLE, ExitCode.INCOMPLETE, ExitCode.INPUT, ExitCode.FAILED)


@dataclass(frozen=True)
class Arm:
    """The row of an arm: its folder, its verdict or error, mean errors [mm] where nothing was fitted, or None."""

    arm: str
    robot: str = ""
    serial: str = ""
    code: ExitCode = ExitCode.DONE
    verdict: str = ""
    before_mm: float | None = None
    after_mm: float | None = None
    result: str = ""


def projects_in(folders: Sequence[Path]) -> list[Path]:
    """Return the folders of all projects in these folders or below them. Raises InputError if a folder has none."""
    homes: set[Path] = set()
    for folder in folders:
        projects = {file.parent for file in folder.rglob(FILE)}
        if not projects:
            raise InputError("no-arm", place=folder, file=FILE)
        homes |= projects
    return sorted({home.resolve(): home for home in sorted(homes)}.values())


def sources_of(project: Project, home: Path) -> Sources:
    """Return what ``truearm identify`` reads in a project's folder. Raises InputError if nothing was measured."""
    if project.table:
        return Sources((home / project.table,), {"": home / project.rig})
    sessions = sessions_of(home / project.sessions)
    if not sessions:
        raise InputError("not-measured", place=home / project.sessions)
    return Sources(tuple(with_parts(sessions)))


def identified_arm(home: Path, options: FleetOptions) -> Arm:
    """Identify the robot of a project, unless a result of the same files and options exists; return its row."""
    row = Arm(str(home))
    try:
        project = read_project(home / FILE)
        row = replace(row, robot=Path(project.model).stem, serial=project.serial)
        files = IdentifyFiles(robot_of(project, home), sources_of(project, home))
        result = _earlier_result(home / project.results, files, options)
        if result is None:
            result = new_file(home / project.results, ".json")
            identify_files(replace(files, results=(result,)), options.hold_out, DEFAULTS)
        document = result_document(result)
        change, code = document["mean_change"] or {}, ExitCode.DONE if document["usable"] else ExitCode.UNUSABLE
        row = replace(row, result=str(result), code=code, verdict=verdict(document).text())
        row = replace(row, before_mm=change.get("mean_before_mm"), after_mm=change.get("mean_after_mm"))
        page = result.with_suffix(".html")
        if options.reports and not page.exists():
            report_files(result, replace(files, command=f"truearm report {result.name}"), page, Issue(project))
    except TruearmError as exc:
        return replace(row, code=exc.exit_code, verdict=str(exc))
    except Exception as exc:
        if error := plug_in_error(exc):
            return replace(row, code=error.exit_code, verdict=str(error))
        if isinstance(exc, OSError):
            return replace(row, code=ExitCode.FAILED, verdict=f"{exc.filename}: {system_reason(exc)}")
        raise
    return row


def _earlier_result(folder: Path, files: IdentifyFiles, options: FleetOptions) -> Path | None:
    """Return the newest result of the same files and the same options, None if there is none."""
    inputs = msgspec.to_builtins(hashed_inputs(files.sources, files.robot))
    made_with = msgspec.json.decode(msgspec.json.encode({"hold_out": options.hold_out, **vars(DEFAULTS)}))
    for path in reversed(results_of(folder)):
        document = result_document(path)
        if (document.get("inputs"), document.get("made_with")) == (inputs, made_with):
            return path
    return None


@contextmanager
def workers(options: FleetOptions, limit: int) -> Iterator[type[Exception]]:
    """Let joblib use the workers of the options, at most ``limit``; yield the error that says that some were killed.

    Raises InputError if the scheduler cannot be reached.
    """
    import joblib

    if options.dask is None:
        with joblib.parallel_config("loky", n_jobs=min(options.workers or joblib.cpu_count(), limit)):
            yield BrokenProcessPool
        return
    try:
        from distributed import Client, KilledWorker
    except ImportError:
        place, install = Argument("dask"), "truearm[dask]"
        raise InputError("missing-package", place=place, package="distributed", install=install) from None
    cluster: dict[str, Any] = {"address": options.dask, "timeout": 5.0}  # s, of connecting
    if options.dask != LOCAL and options.workers is not None:
        raise InputError("no-effect", place=Argument("workers"), reason=f"{options.dask} has workers of its own")
    if options.dask == LOCAL:
        cluster = {"n_workers": options.workers, "threads_per_worker": 1, "dashboard_address": None}
    try:
        client = Client(**cluster)
    except (OSError, ValueError) as exc:
        raise InputError(f"{options.dask}: no Dask scheduler answers: {exc}") from exc
    with client, joblib.parallel_config("dask", n_jobs=-1):
        yield KilledWorker


def identify_fleet(folders: Sequence[Path], options: FleetOptions) -> list[Arm]:
    """Return a row for each project in the folders, and write them to ``options.out``. Raises InputError."""
    from joblib import Parallel, delayed

    homes = projects_in(folders)
    if options.out is not None:
        check_writable(options.out, kind="fleet")  # a rerun replaces its table
    rows: dict[str, Arm] = {}
    with workers(options, len(homes)) as worker_killed, step(f"identifying {counted(len(homes), 'arm')}") as advance:
        for _ in range(RUNS):  # a killed worker ends a run; the next one takes the arms that are missing
            jobs = [delayed(identified_arm)(home, options) for home in homes if str(home) not in rows]
            with suppress(worker_killed):
                for row in Parallel(return_as="generator_unordered")(jobs) if jobs else ():
                    rows[row.arm] = row
                    advance(len(rows) / len(homes))
    reason = "the process was killed in two runs, as happens without free memory; run again with fewer workers"
    lost = Arm("", code=ExitCode.FAILED, verdict=reason)
    fleet = [rows.get(str(home), replace(lost, arm=str(home))) for home in homes]
    if options.out is not None:
        write_atomic(options.out, csv_text([Arm.__dataclass_fields__, *(asdict(row).values() for row in fleet)]))
    return fleet


def worst(fleet: Sequence[Arm]) -> ExitCode:
    """Return the exit code of all arms: the worst of theirs."""
    return max((row.code for row in fleet), key=BEST_FIRST.index)
