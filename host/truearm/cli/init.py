"""``truearm init``: create a project."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import click

from truearm.bounds import OneOf, Within
from truearm.cli.command import Answer, command
from truearm.cli.options import branch_given, numbers_of
from truearm.cli.project import typed
from truearm.errors import Argument, InputError
from truearm.file_names import missing_file
from truearm.model.builtin import builtin_names
from truearm.option_defaults import INSTRUMENTS, NOTHING
from truearm.record.robots.sources import check_address
from truearm.units import MM

RIG_OPTIONS = ("chucks", "spheres", "bars_mm", "measured_with")
OWN_OPTIONS: dict[str, tuple[str, ...]] = {  # of each method
    "ball-bar": (*RIG_OPTIONS, "minutes"),
    "sockets": ("ball_xyz_mm", "ball_mm", "table_mm", "places", "seats"),
}
PARTS = Within(1, 9)  # of a kind: more than a table or a flange has room for
LONGEST_BAR_MM, SHORTEST_BAR_MM = 5000.0, 50.0
INSTRUMENTS_HELP = ", ".join(f"{name}: {MM.text(sigma)}" for name, sigma in INSTRUMENTS.items())


@command(instruments=INSTRUMENTS_HELP)
def init(
    context: click.Context,
    folder: Path = Path(),
    *,
    robot: str | None = None,
    base: str = "",
    tip: str = "",
    branch: str | None = None,
    address: str | None = None,
    box: str | None = None,
    chucks: Annotated[int, PARTS] = 3,
    spheres: Annotated[int, PARTS] = 3,
    bars_mm: str | None = None,
    measured_with: Annotated[str | None, OneOf((NOTHING, *INSTRUMENTS))] = None,
    method: Annotated[str, OneOf(tuple(OWN_OPTIONS))] = "ball-bar",
    ball_mm: Annotated[float, Within(4.0, 100.0)] = 20.0,
    ball_xyz_mm: str = "0,0,100",
    table_mm: Annotated[float, Within(-5000.0, 5000.0)] = 0.0,
    places: Annotated[int, Within(2, 20)] = 6,
    seats: Annotated[int, Within(4, 100)] = 12,
    minutes: Annotated[float, Within(0.0, 1000.0)] = 30.0,
) -> Answer:
    """Create a project: truearm.toml, rig.toml and a first plan.

    On a terminal, truearm asks for robot, address and what the rig is measured with if you do not give --model; Enter accepts
    the value in brackets. A line device and sockets are
    commented out in rig.toml: remove the "#" in front of those that you have. In this folder and below it, commands
    take missing options from truearm.toml: truearm record, truearm identify and truearm status then need none.

    With --method sockets no box is needed: a ball on the robot's end is put into printed sockets. truearm then writes
    rig.toml, the printed block (socket.stl), where it stands (places.svg), joints for each seat (places.csv) and a table
    for the joints that you read (seats.csv).

    Example:
      truearm init cell3 --model ur5e --address rtde://192.168.0.2
      truearm init bench --method sockets --model arm.urdf --tip tool0

    Arguments
    ---------
    folder : FOLDER
        Folder of the project; created if missing.

    Options
    -------
    chucks : N
        Chucks (magnetic cups) on the table.
    spheres : N
        Spheres (steel balls) on the robot's end.
    bars_mm : MM,…
        Lengths of the bars at mid-travel. Default: two that suit the arm.
    measured_with
        What the positions of chucks and spheres and the lengths of the bars are measured with. {instruments}. Default:
        nothing; only the first bar then has to be measured, by calliper.
    minutes : M
        Budget of the first plan in minutes of an operator; 0: no plan.
    method
        Measure with a ball-bar, or with a ball on the end that is put into printed sockets.
    ball_xyz_mm : X,Y,Z
        Sockets: the ball's centre in the frame of the robot's end.

    Expert options
    --------------
    ball_mm : MM
        Sockets: diameter of the ball.
    table_mm : MM
        Sockets: height of the table in the robot's base frame.
    places : N
        Sockets: places of the block on the table.
    seats : N
        Sockets: postures of the arm at each place.
    json
    """
    from truearm.findings import entries, findings_of, option
    from truearm.workflows.project import ProjectWanted, create
    from truearm.workflows.project_file import Project
    from truearm.workflows.socket_project import BLOCK, DRAWING, SocketsWanted

    sockets = None
    methods = (
        (names, f"it is for --method {other_method}")
        for other_method, names in OWN_OPTIONS.items()
        if other_method != method
    )
    files = ((RIG_OPTIONS, folder / Project.rig), (("minutes",), folder / Project.plan))
    existing = ((names, f"{path} already exists and is kept") for names, path in files if path.exists())
    for names, reason in (*methods, *existing):
        for name in names:
            if typed(context, name) is not None:
                raise InputError("no-effect", place=Argument(name), reason=reason)
    if method == "sockets":
        x, y, z = numbers_of("--ball-xyz-mm", ball_xyz_mm, 3) or (0.0, 0.0, 0.0)
        ball = MM.to_si(x), MM.to_si(y), MM.to_si(z)
        sockets = SocketsWanted(MM.to_si(0.5 * ball_mm), ball, MM.to_si(table_mm), places, seats)
    asking = robot is None and sys.stdin is not None and sys.stdin.isatty()
    if robot is None and not asking:
        raise InputError("--model is missing: give a built-in robot, a robot file or a URDF (see truearm init --help)")

    def ask(option_text: str | None, question: str, read: Callable[[str], str], default: str = "") -> str:
        """Return what was given or is answered; a wrong answer is asked for again."""
        if option_text is not None or not asking:
            return read(default if option_text is None else option_text)
        while True:
            try:
                return read(click.prompt(question, default=default, err=True).strip())
            except InputError as exc:
                click.echo(f"  {exc}", err=True)

    model = ask(robot, f"Robot: {', '.join(builtin_names())}, or a robot file or URDF", _model, "ur5e")
    project = Project(
        model=_from_folder(model, folder),
        base=base,
        tip=tip,
        branch=branch or "",
        address=ask(
            address, "Address of the robot's joint readings, such as rtde://192.168.0.2 (Enter for none)", _address
        ),
        box=box or "",
    )
    instrument = ask(
        NOTHING if sockets else measured_with,
        f"What chucks, spheres and bars are measured with: {NOTHING}, or {INSTRUMENTS_HELP}",
        _instrument,
        NOTHING,
    )
    bounds = branch_given(branch) if branch else None
    request = ProjectWanted(
        project, _lengths(bars_mm or ""), instrument, chucks, spheres, minutes or None, bounds, sockets
    )
    created = create(folder, request)
    controller = [] if created.controller is None else [created.controller]
    step = "truearm status" if folder.resolve() == Path.cwd() else f"cd {shlex.quote(str(folder))} and truearm status"
    lines = [finding.text(option) for finding in controller]
    lines += [f"{path.name:<16}{path}" for path in created.written]
    lines += [finding.text(option) for finding in findings_of(created.plan)[:1]] if created.plan else []
    measuring = f"put what you measured of the rig into {folder / project.rig}"
    printing = f"print {folder / BLOCK} and place it as {folder / DRAWING} shows"
    lines.append(f"\nnext: {printing if sockets else measuring}; then {step}")
    document = {"written": [str(path) for path in created.written], "plan": created.plan}
    return Answer({**document, "findings": entries(controller)}, lines)


def _from_folder(model: str, folder: Path) -> str:
    """A robot's file as truearm.toml names it: by its way from the project's folder; names of built-in robots as they are."""
    is_relative = Path(model).is_file() and not Path(model).is_absolute() and not (folder / model).is_file()
    return Path(os.path.relpath(model, folder)).as_posix() if is_relative else model


def _model(text: str) -> str:
    """Return the name of a robot that exists; the links of a URDF are chosen later."""
    from truearm.model.robot_file import is_urdf, load_robot

    if not is_urdf(text):
        load_robot(text)
    elif not Path(text).is_file():
        raise missing_file(Path(text))
    return text


def _address(text: str) -> str:
    if text:
        check_address(text)
    return text


def _instrument(text: str) -> str:
    if text not in (NOTHING, *INSTRUMENTS):
        raise InputError(f"{text[:40]} is not one of {NOTHING}, {', '.join(INSTRUMENTS)}")
    return text


def _lengths(text: str) -> tuple[float, ...]:
    values = (numbers_of("--bars-mm", text) or ()) if text else ()
    for value in values:
        if not SHORTEST_BAR_MM <= value <= LONGEST_BAR_MM:
            raise InputError(f"--bars-mm {text[:40]}: give lengths from {SHORTEST_BAR_MM:g} to {LONGEST_BAR_MM:g} mm")
    if len(set(values)) < len(values):
        raise InputError("given-twice", place=f"--bars-mm {text[:40]}", what="a length")
    return tuple(map(MM.to_si, values))
