"""Project folders: what ``truearm init`` writes, and what ``truearm status`` finds."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from importlib.resources import files
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from truearm.disk import working_folder, write_atomic
from truearm.errors import InputError, TruearmError
from truearm.option_defaults import INSTRUMENTS, NOTHING
from truearm.progress import step
from truearm.units import MM
from truearm.workflows.project_file import FILE, Project, format_project, read_project

if TYPE_CHECKING:
    from truearm.findings import Finding
    from truearm.model.robot import Branch
    from truearm.model.robot_file import RobotChoice
    from truearm.types import BallBar, Point, Rig
    from truearm.workflows.requests import FirstRig, SocketSeats

GAIN_SIGMA = 1e-3  # of a conditioner (docs/how-to/rig.md)


def sessions_of(folder: Path) -> list[Path]:
    """Return the sessions of a folder, the newest last.

    Parts that continue a session are read with it and are not listed, nor are recovered copies.
    """
    from truearm.workflows.recorded_session import first_stem, recovered_name

    recordings = by_time(folder.glob("*.mcap"))
    return [
        path
        for path in recordings
        if (first_stem(path) == path.stem or path.with_name(f"{first_stem(path)}.mcap") not in recordings)
        and recovered_name(path) not in recordings
    ]


def results_of(folder: Path) -> list[Path]:
    """Return the results of a folder, the newest last."""
    return by_time(folder.glob("*.json"))


def folders_of(home: Path) -> list[Path]:
    """Return the project's folder and the folders in it, without hidden ones."""
    return [home, *sorted(path for path in home.iterdir() if path.is_dir() and not path.name.startswith("."))]


def result_document(path: Path) -> dict[str, Any]:
    """Return the document of a result; empty for any other file."""
    from truearm.estimate.result_file import FORMAT

    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) and document.get("format") == FORMAT else {}


def result_in_use(folder: Path) -> Path | None:
    """Return the newest result of a folder that was not simulated, or else the newest; None if there is none."""
    newest_first = results_of(folder)[::-1]
    measured = (path for path in newest_first if not result_document(path).get("simulated"))
    return next(measured, newest_first[0] if newest_first else None)


def robot_of(project: Project, home: Path) -> RobotChoice:
    """Return the robot of a project in a folder, which may not exist yet."""
    from truearm.model.robot_file import RobotChoice

    model = Path(os.path.normpath(home / project.model))
    return RobotChoice(str(model) if model.is_file() else project.model, project.base or None, project.tip or None)


def by_time(files: Iterable[Path]) -> list[Path]:
    """Return files by the time of their last change: names need not be dates. Files of the same time are by name."""
    return sorted(files, key=lambda path: (path.stat().st_mtime_ns, path.name))


def new_file(folder: Path, suffix: str) -> Path:
    """Return the path of a new file in this folder, named by date and time; the folder is created."""
    folder.mkdir(parents=True, exist_ok=True)
    return unused(folder / f"{datetime.now().astimezone():%Y-%m-%d-%H%M%S}{suffix}")


def unused(path: Path) -> Path:
    """Return the path, or a numbered one next to it if it exists."""
    numbered = (path.with_stem(f"{path.stem}-{number}") for number in count(2))
    return next(candidate for candidate in chain([path], numbered) if not candidate.exists())


@step("making the project")
def create(
    folder: Path, project: Project, first: FirstRig, sockets: SocketSeats | None, branch: Branch | None, minutes: float
) -> tuple[list[Path], dict[str, Any] | None, Finding | None]:
    """Write truearm.toml, rig.toml and a first plan into a folder, or with ``sockets`` the files of printed ones.

    Returns the files, the forecast of the first plan, None if none was made, and what was read of the robot's
    controller, None if the address is not that of one.

    ``branch``: of the robot, None for that of its file. ``minutes``: of the first plan, 0 for none.
    Existing files are not overwritten. Raises InputError for a folder that is already a project, and whatever loading
    the robot and planning raise; then nothing is written.
    """
    from truearm.kinds.rig_file import read_rig
    from truearm.plan.branches import branch_of
    from truearm.plan.first_rig import first_rig
    from truearm.plan.options import Budget
    from truearm.workflows.controller_model import ROBOT_FILE, controller_choice
    from truearm.workflows.plan import BallBarOptions, plan_ball_bar_files
    from truearm.workflows.requests import PlanFiles
    from truearm.workflows.socket_project import SEATS, plan_sockets

    if (folder / FILE).exists():
        raise InputError(f"{folder / FILE} already exists; edit it, or use another folder")
    folders = [folder / name for name in (project.sessions, project.results)]
    for path in folders:
        if path.is_file():
            raise InputError(f"{path}: cannot be used as a folder: it is a file")
    choice = robot_of(project, folder)
    with _workplace(folder) as new:
        read, controller = controller_choice(choice.robot or "", project.address, new)
        if read is not None:
            choice, project = read, replace(project, model=ROBOT_FILE)
            if (folder / ROBOT_FILE).exists():
                raise InputError("file-exists", place=folder / ROBOT_FILE)
        robot, plan = choice.load(), None
        if sockets is not None:
            bounded = robot if branch is None else replace(robot, branch=branch_of(robot, branch))
            contents, plan = plan_sockets(bounded, sockets, project.name or robot.chain.name)
            for name, content in contents.items():
                write_atomic(new / name, content)
            project = replace(project, table=SEATS, plan="")
        else:
            rig = folder / project.rig
            if not rig.exists():
                rig = new / project.rig
                bounded = replace(robot, branch=branch_of(robot, branch))
                points = first_rig(bounded, first.chucks, first.spheres)
                write_atomic(rig, _rig_text(_as_measured(points, first), project.name or robot.chain.name))
            read_rig(rig)
            if minutes and not (folder / project.plan).exists():
                files = PlanFiles(choice, rig, branch=branch, out=new / project.plan)
                plan = plan_ball_bar_files(files, Budget(minutes=minutes), BallBarOptions())
        write_atomic(new / FILE, format_project(project))
        written = [folder / FILE, *(folder / path.name for path in by_time(new.iterdir()) if path.name != FILE)]
        folder.mkdir(parents=True, exist_ok=True)
        _move(new, written)
        for path in folders:
            path.mkdir(parents=True, exist_ok=True)
    return written, plan, controller


@contextmanager
def _workplace(folder: Path) -> Iterator[Path]:
    """Make a temporary folder in ``folder``, or in the nearest one above it that exists. Raises InputError."""
    try:
        with working_folder(next(path for path in (folder, *folder.parents) if path.exists())) as new:
            yield new
    except OSError as exc:
        raise InputError(f"{folder}: cannot be used as a folder: {exc.strerror}") from exc


def _move(new: Path, files: list[Path]) -> None:
    """Move files from the folder ``new`` to their places: all of them, or none if one exists, as after another init."""
    reserved: list[Path] = []
    try:
        for path in files:
            path.touch(exist_ok=False)
            reserved.append(path)
        for path in files:
            os.replace(new / path.name, path)
    except OSError as exc:
        for path in reserved:
            path.unlink()
        if isinstance(exc, FileExistsError):
            raise InputError(f"{exc.filename} already exists; edit it, or use another folder") from exc
        raise


def _as_measured(rig: Rig, first: FirstRig) -> Rig:
    """Return a first rig with the available bars and the accuracy of its measurements.

    If nothing is measured, the first bar still has to be, by calliper, because lengths need a scale; the others by
    tape.
    """
    from truearm.plan.first_rig import bars

    sigma = INSTRUMENTS.get(first.measured_with or NOTHING)
    scale_sigma, other_sigma = (INSTRUMENTS["calliper"], INSTRUMENTS["tape"]) if sigma is None else (sigma, sigma)
    chucks = {name: replace(chuck, sigma=sigma) for name, chuck in rig.chucks.items()}
    spheres = {name: replace(sphere, sigma=sigma) for name, sphere in rig.spheres.items()}
    measured = {
        bar.name: replace(bar, zero_sigma=other_sigma if number else scale_sigma, gain_sigma=GAIN_SIGMA)
        for number, bar in enumerate((bars(*first.lengths) if first.lengths else rig.bars).values())
    }
    return replace(rig, chucks=chucks, spheres=spheres, bars=measured)


def _rig_text(rig: Rig, name: str) -> str:
    """Format a rig file for people: in mm, with an explanation of each part."""
    template = files("truearm.workflows").joinpath("rig_template.toml").read_text(encoding="utf-8")
    points = {
        f"{noun}s": "\n".join(_point_text(noun, point) for point in getattr(rig, f"{noun}s").values())
        for noun in ("chuck", "sphere")
    }
    return template.format(name=name, **points, bars="\n".join(map(_bar_text, rig.bars.values())))


def _point_text(kind: str, point: Point) -> str:
    xyz = ", ".join(f"{MM.of(x):g}" for x in point.xyz)
    sigma = '"unknown"' if point.sigma is None else f"{MM.of(point.sigma):g}"
    return f'[[{kind}]]\nname = "{point.name}"\nxyz_mm = [{xyz}]\nsigma_mm = {sigma}\n'


def _bar_text(bar: BallBar) -> str:
    lengths = {"zero": bar.zero, "travel": bar.travel, "sigma": bar.sigma, "zero_sigma": bar.zero_sigma}
    keys = "\n".join(f"{key}_mm = {MM.of(value):g}" for key, value in lengths.items())
    return f'[[bar]]\nname = "{bar.name}"\n{keys}\ngain_sigma = {bar.gain_sigma:g}\n'


def state_of(path: Path) -> dict[str, Any]:
    """Return what a project has, as JSON; ``path`` is its truearm.toml. Raises InputError if that is invalid."""
    from truearm.plan.plan_file import read_plan
    from truearm.workflows.socket_project import seats_noted

    project, home = read_project(path), path.parent
    rig, plan, seats = (
        home / name if name and (home / name).exists() else None for name in (project.rig, project.plan, project.table)
    )
    return {
        "format": "truearm-status",
        "project": vars(project),
        "folder": str(home),
        "rig": str(rig) if rig else None,
        "plan": str(plan) if plan else None,
        "poses": int(read_plan(plan).dwells.sum()) if plan else 0,
        "seats": {"file": str(seats), **seats_noted(seats)} if seats else None,
        "sessions": [_session(path, project) for path in sessions_of(home / project.sessions)],
        "results": [_result(path) for path in results_of(home / project.results)],
    }


def _session(path: Path, project: Project) -> dict[str, Any]:
    """Return a recording: ``other_robot`` is the one for which it was recorded if that is not the project's."""
    from truearm.disk import is_held
    from truearm.session.session_file import has_footer
    from truearm.workflows.recorded_session import recorded_model

    size = path.stat().st_size
    with path.open("rb") as file:
        complete = has_footer(file, size)
    model = recorded_model(path)
    return {
        "file": str(path),
        "size_bytes": size,
        "complete": complete,
        "written": not complete and is_held(path),
        "other_robot": model if model and model != Path(project.model).name else None,
    }


def _result(path: Path) -> dict[str, Any]:
    from truearm.estimate.result_file import read_result

    try:
        result = read_result(path)
    except (TruearmError, ValueError, OSError) as exc:
        document = result_document(path)
        unread = {"held_out_rms_mm": None, "status": f"cannot be read: {exc}", "unusable_because": None}
        return {"file": str(path), **unread, "simulated": bool(document.get("simulated"))}
    return {
        "file": str(path),
        "held_out_rms_mm": (result.held_out or {}).get("rms_mm"),
        "status": result.status,
        "unusable_because": result.unusable_because,
        "simulated": result.simulated,
    }
