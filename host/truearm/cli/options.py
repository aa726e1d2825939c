"""Arguments and options shared by several commands. --help imports this module, so it imports nothing slow."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from truearm.bounds import SEED, Within
from truearm.errors import InputError
from truearm.model.builtin import builtin_names, names_with_branch
from truearm.units import DEG, MM, Scale, from_shown

if TYPE_CHECKING:
    from truearm.model.poses import Six
    from truearm.model.workspace import Branch
    from truearm.types import Payload
    from truearm.workflows.certificates import Issue

LARGEST_MM, LARGEST_DEG = 1e5, 720.0  # of a frame
LONGEST_NAME = 64  # letters of a rig's name, as of a table's identifiers


def bounded(by: Within, scale: Scale | None = None) -> dict[str, Any]:
    """Return the keywords that declare an option's bounds, converted from SI to the unit of the option."""
    ends = {"min": by.least, "max": by.most}
    shown = {name: end if scale is None else scale.of(end) for name, end in ends.items()}
    return {name: end if math.isfinite(end) else None for name, end in shown.items()}


def completed(names: Collection[str]) -> Callable[[str], list[str]]:
    """Return a function that completes a partly typed option value from ``names``."""
    return lambda incomplete: [
        name for name in names if name.startswith(incomplete)
    ]  # typer requires this argument name


# What is read
SessionArgument = Annotated[Path, typer.Argument(metavar="SESSION", help="Session file (.mcap) of truearm record.")]
InputsArgument = Annotated[
    list[Path],
    typer.Argument(metavar="INPUT...", help="Sessions (.mcap) and tables (.csv), which are read as one table."),
]
ResultArgument = Annotated[Path, typer.Argument(metavar="RESULT", help="What truearm identify --out wrote (.json).")]
AllowDamagedOption = Annotated[
    bool,
    typer.Option(
        "--allow-damaged",
        "--allow-truncated",
        help="Read the intact part of a file that is damaged or unfinished.",
    ),
]


AllowUnusableOption = Annotated[
    bool, typer.Option("--allow-unusable", help="Use the result although its fit is not usable.")
]


# The robot
def _robot(default: str = "") -> Any:
    names = ", ".join(builtin_names())
    return typer.Option(
        "--model",
        metavar="ROBOT",
        autocompletion=completed(builtin_names()),
        help=f"Built-in robot ({names}), robot file (.toml) or URDF (.urdf).{default}",
    )


RobotOption = Annotated[str, _robot()]
OptionalRobotOption = Annotated[str | None, _robot()]
IdentifiedRobotOption = Annotated[str | None, _robot(" Default: the built-in robot of the result.")]
BaseOption = Annotated[
    str | None, typer.Option("--base", metavar="LINK", help="First link of a URDF. Default: its root.")
]
TipOption = Annotated[
    str | None, typer.Option("--tip", metavar="LINK", help="Last link of a URDF. Default: its only leaf.")
]
IdentifiedBaseOption = Annotated[
    str | None, typer.Option("--base", metavar="LINK", help="First link of a URDF. Default: the one of the result.")
]
IdentifiedTipOption = Annotated[
    str | None, typer.Option("--tip", metavar="LINK", help="Last link of a URDF. Default: the one of the result.")
]
BranchOption = Annotated[
    str | None,
    typer.Option(
        metavar="LOW:HIGH,…",
        help="Bounds of every joint [deg], within which the arm keeps one configuration. Default: the robot file's [branch], "
        f"which {', '.join(names_with_branch())} have.",
    ),
]
OwnFramesOption = Annotated[
    bool,
    typer.Option(
        "--own-frames",
        help="Use the robot's own base and flange frames: leave out the mounting of base and tool.",
    ),
]
PayloadOption = Annotated[
    str | None,
    typer.Option(
        "--payload",
        metavar="KG[,X,Y,Z]",
        help="Payload [kg], and its centre in the end frame [mm]. Needs a result that was identified under different payloads.",
    ),
]

# Rig and plan
_RIG = "Rig: chucks, spheres, bars, sockets, devices (.toml)."
RigOption = Annotated[Path, typer.Option("--rig", metavar="FILE", help=_RIG)]
RecordedRigOption = Annotated[
    Path | None,
    typer.Option(
        "--rig",
        metavar="FILE",
        help=f"{_RIG} It is stored in the session. Default with --resume: the rig of that session.",
    ),
]
SessionRigOption = Annotated[
    Path | None, typer.Option("--rig", metavar="FILE", help=f"{_RIG} Default: the rig in the session.")
]
NamedRigsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--rig",
        metavar="[NAME=]FILE",
        help=f"{_RIG} NAME=FILE is for rows with NAME in their column rig and for the session NAME.mcap "
        "(repeatable). Default: the rig in each session.",
    ),
]
PlanOption = Annotated[Path | None, typer.Option("--plan", metavar="FILE", help="Plan: what the robot visits (.csv).")]

# The certificate; what is not given comes from truearm.toml
NameOption = Annotated[str | None, typer.Option("--name", metavar="TEXT", help="Name of the robot.")]
SerialOption = Annotated[str | None, typer.Option("--serial", metavar="TEXT", help="Serial number of the robot.")]
OperatorOption = Annotated[str | None, typer.Option("--operator", metavar="TEXT", help="Name of the operator.")]
ControllerOption = Annotated[
    str | None, typer.Option("--controller", metavar="TEXT", help="Controller of the robot and its software.")
]
CustomerOption = Annotated[str | None, typer.Option("--customer", metavar="TEXT", help="Whom the certificate is for.")]
NumberOption = Annotated[str, typer.Option("--number", metavar="TEXT", help="Number of the certificate.")]
ToleranceOption = Annotated[
    float | None,
    typer.Option("--tolerance", metavar="MM", min=1e-3, max=100.0, help="Permitted error of the tool: pass or fail."),
]


def issue_of(number: str, tolerance_mm: float | None, **texts: str | None) -> Issue:
    """Return whom a certificate is for, by the options and the project's file."""
    from truearm.files.project_file import Project, read_project
    from truearm.files.project_folder import find_project
    from truearm.workflows.certificates import Issue

    file = find_project(Path.cwd())
    project = Project("") if file is None else read_project(file)
    given = {key: text for key, text in texts.items() if text is not None}
    return Issue(replace(project, **given), number, None if tolerance_mm is None else MM.to_si(tolerance_mm))


# The box
_BOX = "Port of the box: /dev/ttyACM0, COM3 or socket://127.0.0.1:7007."
BoxOption = Annotated[str, typer.Option("--box", metavar="DEVICE", help=_BOX)]
OptionalBoxOption = Annotated[str | None, typer.Option("--box", metavar="DEVICE", help=_BOX)]
StopOption = Annotated[
    bool, typer.Option("--stop", help="Stop the box first if it is streaming, for example after a recorder was killed.")
]
DurationOption = Annotated[
    float | None, typer.Option("--duration", metavar="S", help="End after S seconds. Ctrl-C ends earlier.")
]
PlainOption = Annotated[
    bool, typer.Option("--plain", help="Print lines instead of a live view. Always so if the output is not a terminal.")
]

# What is written
ForceOption = Annotated[
    bool, typer.Option("--force", help="Overwrite the output file if it is of the kind that this command writes.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")]
SeedOption = Annotated[int, typer.Option("--seed", metavar="N", help="Random seed.", **bounded(SEED))]


def out_file(what: str) -> Any:
    """Return the option ``--out FILE`` of a command that writes ``what``."""
    return typer.Option("--out", metavar="FILE", help=f"File to write: {what}.")


def out_folder(what: str) -> Any:
    """Return the option ``--out FOLDER`` of a command that writes ``what``."""
    return typer.Option("--out", metavar="FOLDER", help=f"Folder to write: {what}.")


def rigs_of(given: list[str] | None) -> dict[str, Path]:
    """Return the files of ``--rig`` by rig name, "" for one without a name, such as ./a=b.toml.

    Raises InputError if several rigs have the same name or none.
    """
    files: dict[str, Path] = {}
    for text in given or ():
        name, equals, file = text.partition("=")
        named = bool(equals) and re.fullmatch(rf"[\w-]{{1,{LONGEST_NAME}}}", name, re.ASCII) is not None
        name, path = (name, Path(file)) if named else ("", Path(text))
        if name in files:
            which = f"rig {name} is given twice" if name else "several rigs need names, --rig NAME=FILE"
            raise InputError(f"--rig {text}: {which}")
        files[name] = path
    if "" in files and len(files) > 1:
        raise InputError(f"--rig {files['']}: several rigs need names; write --rig NAME=FILE")
    return files


def one_of(names: Collection[str]) -> Callable[[str], str]:
    """Return a function that checks an option against ``names``. It raises typer.BadParameter for another name."""

    def checked(text: str) -> str:
        if text not in names:
            raise typer.BadParameter(f"{text!r} is not one of {', '.join(names)}")
        return text

    return checked


def choices(names: Collection[str]) -> str:
    """Return ``names`` as ``--help`` shows the values of an option."""
    return f"<{'|'.join(names)}>"


def numbers_of(option: str, text: str | None, count: int | None = None) -> tuple[float, ...] | None:
    """Return the numbers of an option, separated by commas; None if it was not given. Raises InputError."""
    if text is None:
        return None
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if not values or (count is not None and (len(values) != count or not all(map(math.isfinite, values)))):
        raise InputError(f"{option} {text[:60]}: needs {count or 'one or more'} numbers, separated by commas")
    return values


def payload_of(text: str | None) -> Payload:
    """Return the payload of the option; none if it was not given. Raises InputError."""
    from truearm.types import Payload

    mass, *centre = numbers_of("--payload", text) or (0.0,)
    if len(centre) not in (0, 3):
        raise InputError(f"--payload {(text or '')[:60]}: needs KG, or KG,X,Y,Z with the centre in mm")
    x, y, z = map(MM.to_si, centre or (0.0, 0.0, 0.0))
    return Payload(mass, (x, y, z))


def spans_of(option: str, text: str, scale: Scale) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the lower and upper ends in SI of an option "LOW:HIGH,LOW:HIGH,…" in a unit. Raises InputError."""
    try:
        spans = [(float(low), float(high)) for low, high in (part.split(":") for part in text.split(","))]
    except ValueError:
        spans = []
    if not spans or not all(low < high and math.isfinite(high - low) for low, high in spans):
        raise InputError(
            f"{option} {text[:60]!r}: needs LOW:HIGH in {scale.suffix}, LOW below HIGH, separated by commas"
        )
    return tuple(scale.to_si(low) for low, _ in spans), tuple(scale.to_si(high) for _, high in spans)


def joints_of(option: str, shown: Sequence[float] | None, units: Sequence[str]) -> tuple[float, ...] | None:
    """Return the joints [rad, m] of an option in deg and mm; ``units`` are those of the joints. Raises InputError."""
    if shown is None:
        return None
    if len(shown) != len(units) or not all(map(math.isfinite, shown)):
        text = ",".join(f"{value:g}" for value in shown)
        raise InputError(f"{option} {text[:60]}: needs {len(units)} numbers, separated by commas")
    return tuple(from_shown(value, unit) for value, unit in zip(shown, units, strict=True))


def frame_of(option: str, text: str | None) -> Six:
    """Return position [m] and rotation vector [rad] of an option in mm and deg; zeros if not given. Raises InputError."""
    x, y, z, rx, ry, rz = numbers_of(option, text, 6) or (0.0,) * 6
    if max(map(abs, (x, y, z))) > LARGEST_MM or max(map(abs, (rx, ry, rz))) > LARGEST_DEG:
        raise InputError(f"{option} {text}: needs x, y, z in mm and a rotation vector in deg")
    return MM.to_si(x), MM.to_si(y), MM.to_si(z), DEG.to_si(rx), DEG.to_si(ry), DEG.to_si(rz)


def branch_given(text: str | None) -> Branch | None:
    """Return the joint bounds [rad] of the option in deg, None if it was not given. Raises InputError."""
    import numpy as np

    from truearm.model.workspace import Branch

    if text is None:
        return None
    lower, upper = spans_of("--branch", text, DEG)
    return Branch(np.array(lower), np.array(upper))
