"""The built-in robots: one file each in ``robots/``, and those of other packages (entry points "truearm.robots"). Imports nothing slow, so that ``--help`` can list them."""

from __future__ import annotations

import re
from importlib import resources

from truearm.additions import additions, blamed
from truearm.errors import RobotError

SUFFIX = ".toml"


def builtin_names() -> tuple[str, ...]:
    """Return the names of the built-in robots, sorted."""
    files = resources.files(__package__).joinpath("robots").iterdir()
    bundled = (file.name.removesuffix(SUFFIX) for file in files if file.name.endswith(SUFFIX))
    return tuple(sorted({*bundled, *additions("robots")}))


def builtin_text(name: str) -> str:
    """Return the robot file of a built-in robot. Raises RobotError for an unknown name."""
    if name not in builtin_names():
        raise RobotError("wrong-value", place="built-in robot", value=name, names=list(builtin_names()))
    bundled = resources.files(__package__).joinpath("robots", name + SUFFIX)
    if bundled.is_file():
        return bundled.read_text("utf-8")
    entry = additions("robots")[name]
    with blamed(entry):
        return resources.files(entry.load()).joinpath(name + SUFFIX).read_text("utf-8")


def names_with_branch() -> tuple[str, ...]:
    """Return the names of the built-in robots with a ``[branch]`` table, which ``truearm plan`` requires."""
    return tuple(name for name in builtin_names() if re.search(r"^\[branch\]", builtin_text(name), re.MULTILINE))
