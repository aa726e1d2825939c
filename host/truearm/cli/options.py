"""Arguments and options that several commands share. --help reads this, so it imports nothing slow."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Annotated

import typer

from truearm.errors import InputError
from truearm.model.builtin import builtin_names

ROBOT_HELP = f"Built-in robot ({', '.join(builtin_names())}), robot file (.toml) or URDF (.urdf)."
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
SeedOption = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Of everything that is drawn by chance.")]


def warn(text: str) -> None:
    """Print a warning on standard error."""
    typer.echo(f"warning: {text}", err=True)


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
    return f"[{'|'.join(names)}]"
