"""Load the robot that a user names: a built-in robot by name, a robot file (TOML) or a URDF by path.

The built-in robots are one file each in ``robots/``, and those of other packages (entry points "truearm.robots").
``--help`` reads this, so it imports nothing slow.
"""

from __future__ import annotations

import difflib
import re
from contextlib import suppress
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from truearm.additions import additions, blamed, with_additions
from truearm.disk import read_text
from truearm.errors import Argument, PlugInError, RobotError

if TYPE_CHECKING:
    from truearm.model.robot import Robot

MAX_BYTES = 8_000_000
# The built-in robot that a maker's or another name means.
ROBOTS_OF = {
    "abb": "irb120 or irb1600",
    "franka": "panda or fr3",
    "lbr": "iiwa14",
    "kuka": "iiwa14 or kr6",
    "ufactory": "xarm6",
    "unimation": "puma560",
    "universal": "ur3e, ur5e or ur10e",
}
SUFFIX = ".toml"


def builtin_names() -> tuple[str, ...]:
    """Return the names of the built-in robots, sorted."""
    files = resources.files(__package__).joinpath("robots").iterdir()
    bundled = (file.name.removesuffix(SUFFIX) for file in files if file.name.endswith(SUFFIX))
    return tuple(sorted({*bundled, *(entry.name for entry in additions("robots"))}))


def builtin_text(name: str) -> str:
    """Return the robot file of a built-in robot. Raises RobotError for an unknown name."""
    if name not in builtin_names():
        raise RobotError("wrong-value", place="built-in robot", value=name, names=list(builtin_names()))
    bundled = resources.files(__package__).joinpath("robots", name + SUFFIX)
    if bundled.is_file():
        return bundled.read_text("utf-8")
    package = with_additions("robots", {}, resources.files)[name]
    with blamed(f"truearm.robots: {name}"):
        return str(package.joinpath(name + SUFFIX).read_text("utf-8"))


def names_with_branch() -> tuple[str, ...]:
    """Return the names of the built-in robots with a ``[branch]`` table, which ``truearm plan`` requires."""
    names: list[str] = []
    for name in builtin_names():
        with suppress(PlugInError):  # raised when this robot is named
            names += [name] if re.search(r"^\[branch\]", builtin_text(name), re.MULTILINE) else []
    return tuple(names)


class RobotChoice(NamedTuple):
    """A robot as named on the command line: a built-in name or a file, and links of a URDF; None for the default."""

    robot: str | None = None
    base: str | None = None
    tip: str | None = None

    @property
    def files(self) -> list[Path]:
        """Return the file that it names, if any. Raises RobotError."""
        path = None if self.robot is None else robot_file(self.robot)
        return [] if path is None else [path]

    @property
    def is_urdf(self) -> bool:
        """Return whether it names a URDF. Raises RobotError."""
        return self.robot is not None and is_urdf(self.robot)

    def load(self) -> Robot:
        """Return the robot. Raises RobotError, also if none is named."""
        return load_robot(self.robot or "", self.base, self.tip)


NO_ROBOT = RobotChoice()


def builtin_robot(name: str) -> Robot:
    """Return a built-in robot such as "puma560". Raises RobotError for an unknown name."""
    from truearm.model.robot import parse_robot

    return parse_robot(builtin_text(name))


def load_robot(robot: str, base: str | None = None, tip: str | None = None) -> Robot:
    """Return the robot called or stored at ``robot``; ``base`` and ``tip`` are links of a URDF.

    Raises RobotError that names the file, or lists the built-in robots.
    """
    from truearm.model.robot import parse_robot

    path = robot_file(robot)
    if not is_urdf(robot) and (base or tip):
        links = Argument("base"), " and ", Argument("tip")
        raise RobotError(*links, " choose links of a URDF; a built-in robot or a TOML file has its own frames")
    if path is None:
        return builtin_robot(robot)
    text = read_text(path, MAX_BYTES, RobotError)
    try:
        loaded = _urdf_robot(text, base, tip) if is_urdf(robot) else parse_robot(text)
    except RobotError as exc:
        raise exc.within(path) from exc
    return replace(loaded, file=str(path))


def robot_file(robot: str) -> Path | None:
    """Return the file that a user named as the robot; None for a built-in robot. Raises RobotError if it is neither."""
    if robot in builtin_names():
        return None
    path = Path(robot)
    if path.suffix.lower() not in (".toml", ".urdf", ".xml"):
        word = robot.lower()
        of_maker = [names for maker, names in ROBOTS_OF.items() if maker in word]
        meant = difflib.get_close_matches(word, builtin_names(), n=1) or of_maker
        names = [*builtin_names(), "a .toml or .urdf file"]
        likely = meant[0] if meant and not path.suffix else ""
        raise RobotError("wrong-value", place=Argument("robot"), value=robot, names=names, meant=likely)
    return path


def is_urdf(robot: str) -> bool:
    """Return whether a user named a URDF as the robot. Raises RobotError as ``robot_file`` does."""
    path = robot_file(robot)
    return path is not None and path.suffix.lower() != ".toml"


def _urdf_robot(text: str, base: str | None, tip: str | None) -> Robot:
    from truearm.model.robot import Robot
    from truearm.model.urdf import capsules_from_urdf, chain_from_urdf, free_without_gains

    chain = chain_from_urdf(text, base, tip)
    values = {"nominal": chain.params_nominal}
    return Robot(chain, values, free_without_gains(chain), capsules=capsules_from_urdf(text, chain))
