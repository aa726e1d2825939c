"""Arguments and options that several commands share. --help reads this, so it imports nothing slow."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Annotated

import typer

from truearm.errors import InputError
from truearm.model.builtin import builtin_names
from truearm.text import one_line
from truearm.units import DEG, MM, Scale, from_shown

ROBOT_HELP = f"Built-in robot ({', '.join(builtin_names())}), robot file (.toml) or URDF (.urdf)."
DEVICE_HELP = "The box: /dev/ttyACM0, COM3 or socket://127.0.0.1:7007."
DeviceOption = Annotated[str, typer.Option(metavar="DEVICE", help=DEVICE_HELP)]
StopOption = Annotated[
    bool, typer.Option("--stop", help="Stop the box first if it streams, as a recorder that was killed leaves it.")
]
LARGEST_MM, LARGEST_DEG = 1e5, 720.0  # of a frame
LONGEST_NAME = 64  # letters of a rig's name, as of a table's identifiers

ResultArgument = Annotated[Path, typer.Argument(metavar="RESULT", help="What truearm identify --out wrote (.json).")]
IdentifiedRobotOption = Annotated[
    str | None,
    typer.Option(
        "--robot", metavar="ROBOT", help="The robot that was identified; default: the built-in one of that name."
    ),
]
IdentifiedBaseOption = Annotated[
    str | None, typer.Option("--base", metavar="LINK", help="Of a URDF; default: as identified.")
]
IdentifiedTipOption = Annotated[
    str | None, typer.Option("--tip", metavar="LINK", help="Of a URDF; default: as identified.")
]
SeedOption = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Random seed.")]


def warn(text: str) -> None:
    """Print a warning on standard error."""
    typer.echo(f"warning: {text}", err=True)


def planning(text: str) -> None:
    """Print a step of a plan on standard error."""
    typer.echo(f"planning: {text}", err=True)


def say_parts(path: Path, what: str) -> None:
    """Print on standard error which further parts of a session a command leaves out: ``what`` to do with them. Raises SessionError."""
    from truearm.workflows.session_parts import session_parts

    parts = [one_line(part.name) for part in session_parts(path)[1:]]
    if parts:
        typer.echo(f"{one_line(path.name)} goes on in {', '.join(parts)}: {what}", err=True)


def silent(_: str) -> None:
    """Print nothing: what --json prints stands alone."""


def rigs_of(given: list[str] | None) -> dict[str, Path]:
    """The files of ``--rig`` by rig name, "" for one without a name; ./a=b.toml has none.

    Raises InputError where names do not tell the rigs apart.
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
        raise InputError(f"--rig {files['']}: several rigs need names, --rig NAME=FILE")
    return files


def one_of(names: Collection[str]) -> Callable[[str], str]:
    """Return what checks an option against the names of a registry. It raises typer.BadParameter for another name."""

    def checked(text: str) -> str:
        if text not in names:
            raise typer.BadParameter(f"{text!r} is not one of {', '.join(names)}")
        return text

    return checked


def choices(names: Collection[str]) -> str:
    """Return the names of a registry as ``--help`` shows the values of an option."""
    return f"<{'|'.join(names)}>"


def numbers_of(option: str, text: str | None, count: int | None = None) -> tuple[float, ...] | None:
    """The numbers between the commas of an option, None where it was not given. Raises InputError."""
    if text is None:
        return None
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if not values or (count is not None and (len(values) != count or not all(map(math.isfinite, values)))):
        raise InputError(f"{option} {text[:60]}: needs {count or 'some'} numbers between commas")
    return values


def spans_of(option: str, text: str, scale: Scale) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lower and upper ends in SI of an option "LOW:HIGH,LOW:HIGH,…" in a unit. Raises InputError."""
    try:
        spans = [(float(low), float(high)) for low, high in (part.split(":") for part in text.split(","))]
    except ValueError:
        spans = []
    if not spans or not all(low < high and math.isfinite(high - low) for low, high in spans):
        raise InputError(f"{option} {text[:60]!r}: needs LOW:HIGH in {scale.suffix}, LOW below HIGH, between commas")
    return tuple(scale.to_si(low) for low, _ in spans), tuple(scale.to_si(high) for _, high in spans)


def joints_of(option: str, shown: Sequence[float] | None, units: Sequence[str]) -> tuple[float, ...] | None:
    """The joints [rad, m] of an option in deg and mm, by the units of the robot's joints. Raises InputError."""
    if shown is None:
        return None
    if len(shown) != len(units) or not all(map(math.isfinite, shown)):
        text = ",".join(f"{value:g}" for value in shown)
        raise InputError(f"{option} {text[:60]}: needs {len(units)} numbers between commas")
    return tuple(from_shown(value, unit) for value, unit in zip(shown, units, strict=True))


def frame_of(option: str, text: str | None) -> tuple[float, float, float, float, float, float]:
    """Position [m] and rotation vector [rad] of an option in mm and deg; zeros where it was not given. Raises InputError."""
    x, y, z, rx, ry, rz = numbers_of(option, text, 6) or (0.0,) * 6
    if max(map(abs, (x, y, z))) > LARGEST_MM or max(map(abs, (rx, ry, rz))) > LARGEST_DEG:
        raise InputError(f"{option} {text}: needs x, y, z in mm and a rotation vector in deg")
    return MM.to_si(x), MM.to_si(y), MM.to_si(z), DEG.to_si(rx), DEG.to_si(ry), DEG.to_si(rz)


def check_finite(**given: float | None) -> None:
    """Raise InputError for an option that is nan or inf, which typer's bounds let pass."""
    for name, value in given.items():
        if value is not None and not math.isfinite(value):
            raise InputError(f"--{name.replace('_', '-')} must be a finite number, is {value}")
