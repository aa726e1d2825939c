"""A route as a program; the suffix of the file selects the language.

The first move starts anywhere and is slow. Every other move is straight in joint space and takes the seconds of the
route. At a pose the program sets an output ("at rest"), waits for the dwell, and clears the output. A line is driven
straight in space at the planned speed, with the output set. With an ``input`` the program also waits until the box has
answered, at most TIMEOUT, and until the answer is cleared. Before leaving a pairing or a line it stops until bar or
device is removed, and at the next one until it is mounted.

Imports nothing slow, so that ``--help`` can list the languages. To add one, describe it in ``route_languages`` and add
its suffix to ``LANGUAGES`` here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from truearm.errors import PlanError

if TYPE_CHECKING:
    from truearm.plan.route_stops import Stop, Task

N_AXES = 6
TABLE = ".csv"  # for an arm with any number of joints
LANGUAGES: Mapping[str, str] = {".script": "URScript", ".mod": "RAPID", TABLE: "all stops"}


def languages_help() -> str:
    """Return the suffixes and their languages, as ``--help`` and messages show them."""
    return ", ".join(f"{suffix} ({language})" for suffix, language in LANGUAGES.items())


def program(stops: Sequence[Stop], suffix: str, task: Task) -> str:
    """Return the program for a suffix of LANGUAGES. Raises PlanError for others, and for an arm without six joints."""
    from truearm.plan import route_languages

    check_suffix(suffix)
    check_joints(suffix, len(stops[0].q))
    if suffix == TABLE:
        return route_languages.table_text(stops, task)
    language = route_languages.RAPID if suffix == ".mod" else route_languages.URSCRIPT
    return route_languages.program_text(language, stops, task)


def check_joints(suffix: str, n_joints: int) -> None:
    """Raise PlanError if the language of a suffix of LANGUAGES is not for an arm with so many joints."""
    if suffix != TABLE and n_joints != N_AXES:
        raise PlanError(
            f"{LANGUAGES[suffix]} programs have six joints, the robot has {n_joints}; "
            f"give a program that ends in {TABLE}: a table of all stops"
        )


def check_suffix(suffix: str) -> None:
    """Raise PlanError for a suffix that is not in LANGUAGES."""
    if suffix not in LANGUAGES:
        raise PlanError(f"programs cannot be written as {suffix or 'a file without suffix'!r}; use {languages_help()}")
