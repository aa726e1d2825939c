"""Tools and work objects that a user gives beside a program: those that it cannot use are refused, not ignored."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import assert_never

from truearm.errors import Argument, ProgramError
from truearm.files.programs.program import Program
from truearm.files.programs.suffixes import ProgramLanguage
from truearm.model.poses import Six


def check_names(
    path: Path, language: ProgramLanguage, tool: Six | None, tools: Mapping[str, Six], works: Mapping[str, Six]
) -> None:
    """Refuse tools and work objects that the program's language cannot use. Raises ProgramError.

    ``tool``: given without a name.
    """
    match language:
        case "urscript":
            for given, argument in ((tools, "tool"), (works, "work")):
                if given:
                    wrong = f"{path}: a URScript knows no tools or work objects by name, such as {next(iter(given))[:40]}; give one pose by "
                    raise ProgramError(wrong, Argument(argument))
        case "rapid":
            if tool is not None and any(tool):
                wrong = f"{path}: each move of a RAPID program names its tool; give NAME=X,Y,Z,RX,RY,RZ by "
                raise ProgramError(wrong, Argument("tool"))
        case _:
            assert_never(language)
    if both := {name.lower() for name in tools} & {name.lower() for name in works}:
        name = min(both)[:40]
        raise ProgramError(f"{path}: {name} is given as a tool and as a work object; give it once")


def check_used(path: Path, program: Program, works: Mapping[str, Six]) -> None:
    """Refuse a tool or work object that a program does not mention: its name may be misspelt. Raises ProgramError."""
    for name, similar in program.unused.items():
        is_work = name in {work.lower() for work in works}
        meant = f"did you mean {similar}?" if similar else "correct the name, or leave it out"
        what = "work object" if is_work else "tool"
        given = f"{path}: no line names {what} {name[:40]}, which is given by "
        raise ProgramError(given, Argument("work" if is_work else "tool"), f"; {meant}")
