"""``truearm init``: create a project."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import click

from truearm.bounds import OneOf, Within
from truearm.cli.command import Answer, command
from truearm.cli.options import READERS
from truearm.cli.project import typed
from truearm.disk import missing_file
from truearm.errors import Argument, InputError
from truearm.model.robot_file import builtin_names
from truearm.option_defaults import INSTRUMENTS, NOTHING
from truearm.record.robots.sources import check_address
from truearm.units import MM
from truearm.workflows.requests import FirstRig, SocketSeats

RIG_OPTIONS = ("chucks", "spheres", "bars_mm", "measured_with")
OWN_OPTIONS: dict[str, tuple[str, ...]] = {  # of each method
    "ball-bar": (*RIG_OPTIONS, "minutes"),
    "sockets": ("ball_xyz_mm", "ball_mm", "table_mm", "places", "seats"),
}
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
    box: str = "",
    rig: FirstRig,
    method: Annotated[str, OneOf(tuple(OWN_OPTIONS))] = "ball-bar",
    sockets: SocketSeats,
    minutes: Annotated[float, Within(0.0, 1000.0)] = 30.0,
) -> Answer:
    """Create a project: truearm.toml, rig.toml and a first plan.

    On a terminal, truearm asks for robot, address and what the rig is measured with if you do not give --model; Enter
    accepts the value in brackets. A line device and sockets are commented out in rig.toml: remove the "#" in front of
    those that you have. In this folder and below it, commands take missing options from truearm.toml: truearm record,
    truearm identify and truearm status then need none.

    With --method sockets no box is needed: a ball on the robot's end is put into printed sockets. truearm then writes
    rig.toml, the printed block (socket.stl), where it stands (places.svg), joints for each seat (places.csv) and a
    table for the joints that you read (seats.csv).

    Example:
      truearm init cell3 --model ur5e --address rtde://192.168.0.2
      truearm init bench --method sockets --model arm.urdf --tip tool0

    Arguments
    ---------
    folder : FOLDER
        Folder of the project; created if missing. Default: this folder.

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
        Sockets: the ball's centre in the frame of the robot's end. Default: 0,0,100.

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
    from truearm.findings import Finding, entries, findings_of
    from truearm.workflows.project import create
    from truearm.workflows.project_file import Project
    from truearm.workflows.socket_project import BLOCK, DRAWING

    with_sockets = method == "sockets"
    other_method = "ball-bar" if with_sockets else "sockets"
    unused = dict.fromkeys(OWN_OPTIONS[other_method], f"it is for --method {other_method}")
    for names, path in ((RIG_OPTIONS, folder / Project.rig), (("minutes",), folder / Project.plan)):
        unused |= dict.fromkeys(names if path.exists() else (), f"{path} already exists and is kept")
    for name, reason in unused.items():
        if typed(context, name) is not None:
            raise InputError("no-effect", place=Argument(name), reason=reason)
    if len(set(rig.lengths)) < len(rig.lengths):
        raise InputError("given-twice", place=Argument("bars_mm"), what="a length")
    asking = robot is None and sys.stdin is not None and sys.stdin.isatty()
    if robot is None and not asking:
        raise InputError("--model is missing: give a built-in robot, a robot file or a URDF (see truearm init --help)")

    def ask(option_text: str | None, question: str, check: Callable[[str], object], default: str = "") -> str:
        """Return what was given or is answered; a wrong answer is asked for again."""
        while asking and option_text is None:
            try:
                answer: str = click.prompt(question, default=default, err=True).strip()
                check(answer)
                return answer
            except InputError as exc:
                click.echo(f"  {exc}", err=True)
        check(default if option_text is None else option_text)
        return default if option_text is None else option_text

    model = ask(robot, f"Robot: {', '.join(builtin_names())}, or a robot file or URDF", _check_model, "ur5e")
    if Path(model).is_file() and not Path(model).is_absolute() and not (folder / model).is_file():
        model = Path(os.path.relpath(model, folder)).as_posix()
    address_question = "Address of the robot's joint readings, such as rtde://192.168.0.2 (Enter for none)"
    address = ask(address, address_question, lambda text: check_address(text) if text else None)
    measured_question = f"What chucks, spheres and bars are measured with: {NOTHING}, or {INSTRUMENTS_HELP}"
    instruments = OneOf((NOTHING, *INSTRUMENTS))
    instrument = NOTHING if with_sockets else rig.measured_with
    instrument = ask(instrument, measured_question, lambda text: instruments.check("measured_with", text), NOTHING)
    bounds = READERS["branch"].read("--branch", branch) if branch else None
    project = Project(model=model, base=base, tip=tip, branch=branch or "", address=address, box=box)
    written, plan, controller = create(
        folder, project, replace(rig, measured_with=instrument), sockets if with_sockets else None, bounds, minutes
    )
    step = "truearm status" if folder.resolve() == Path.cwd() else f"cd {shlex.quote(str(folder))} and truearm status"
    places = {"block": folder / BLOCK, "drawing": folder / DRAWING} if with_sockets else {"rig": folder / project.rig}
    following = Finding(
        "init-next", {"block": None, **{name: str(path) for name, path in places.items()}, "step": step}
    )
    own = [*filter(None, [controller]), following]
    document = {"written": [str(path) for path in written], "plan": plan, "findings": entries(own)}
    planned = findings_of(plan)[:1] if plan else []
    return Answer(document, findings=[*planned, *own], details_hint="")


def _check_model(text: str) -> None:
    """Raise InputError unless a robot exists; the links of a URDF are chosen later."""
    from truearm.model.robot_file import is_urdf, load_robot

    if not is_urdf(text):
        load_robot(text)
    elif not Path(text).is_file():
        raise missing_file(Path(text))
