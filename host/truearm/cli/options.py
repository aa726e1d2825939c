"""Arguments and options that several commands share. --help reads this, so it imports nothing slow."""

from pathlib import Path
from typing import Annotated

import typer

from truearm.model.builtin import builtin_names

ROBOT_HELP = f"Built-in robot ({', '.join(builtin_names())}), robot file (.toml) or URDF (.urdf)."
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
