"""A route as a program; the suffix of the file selects the language.

The first move starts anywhere and is slow. Every other move is straight in joint space and takes the seconds of the
route. At a pose the program sets an output ("at rest"), waits for the dwell, and clears the output. A line is driven
straight in space at the planned speed, with the output set. With an ``input`` the program also waits until the box has
answered, at most TIMEOUT, and until the answer is cleared. Before leaving a pairing or a line it stops until bar or
device is removed, and at the next one until it is mounted.

Imports nothing slow, so that ``--help`` can list the languages. To add one, write a module with ``text(stops, task) ->
str`` and add its line to ``DIALECTS``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from truearm.errors import PlanError

if TYPE_CHECKING:
    from truearm.plan.route_stops import Stop, Task

N_AXES = 6


class Dialect(NamedTuple):
    """A programming language: its name, its module here, how its files begin, whether any arm can use it."""

    name: str
    module: str
    begins: bytes
    any_joints: bool = False


DIALECTS: Mapping[str, Dialect] = {
    ".script": Dialect("URScript", "route_urscript", b"def truearm_"),
    ".mod": Dialect("RAPID", "route_rapid", b"MODULE truearm_"),
    ".csv": Dialect("all stops", "route_csv", b"pose,", any_joints=True),
}


def dialects_help() -> str:
    """Return the suffixes and their languages, as ``--help`` and messages show them."""
    return ", ".join(f"{suffix} ({dialect.name})" for suffix, dialect in DIALECTS.items())


def program(stops: Sequence[Stop], suffix: str, task: Task) -> str:
    """Return the program for a suffix of DIALECTS. Raises PlanError for others, and for an arm without six joints."""
    check_suffix(suffix)
    check_joints(suffix, len(stops[0].q))
    text: Callable[[Sequence[Stop], Task], str] = import_module(f"{__package__}.{DIALECTS[suffix].module}").text
    return text(stops, task)


def check_joints(suffix: str, n_joints: int) -> None:
    """Raise PlanError if the language of a suffix of DIALECTS is not for an arm with so many joints."""
    dialect = DIALECTS[suffix]
    if not dialect.any_joints and n_joints != N_AXES:
        raise PlanError(
            f"{dialect.name} programs have six joints, the robot has {n_joints}; "
            "give a program that ends in .csv: a table of all stops"
        )


def check_suffix(suffix: str) -> None:
    """Raise PlanError for a suffix that is not in DIALECTS."""
    if suffix not in DIALECTS:
        raise PlanError(f"programs cannot be written as {suffix or 'a file without suffix'!r}; use {dialects_help()}")
