"""Tools and work objects that a user gives beside programs: those that they cannot use are refused, not ignored."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches

from truearm.correct.programs.languages import ProgramLanguage
from truearm.correct.programs.program import Program
from truearm.errors import Argument
from truearm.findings import Finding, FindingError
from truearm.model.poses import Six

NUMBERED = {"krl": r"(tool_data|base_data)\d+", "ls": r"u[tf]\d+"}  # names of tools and frames that have only numbers


def check_names(
    title: str, language: ProgramLanguage, tool: Six | None, tools: Mapping[str, Six], works: Mapping[str, Six]
) -> None:
    """Raise FindingError for tools and work objects that a language cannot use; ``tool`` is given without a name."""
    for poses, argument in ((tools, "tool"), (works, "work")):
        name = next(iter(poses), "")[:40]
        if name and language == "urscript":
            raise FindingError(
                Finding("unnamed-language"),
                f"{title}: a URScript knows no tools or work objects by name, such as {name}; give one pose by ",
                Argument(argument),
            )
        wrong = next((name for name in poses if not re.fullmatch(NUMBERED.get(language, ".*"), name.lower())), None)
        if wrong is not None:
            raise FindingError(
                Finding("wrong-name"),
                f"{title}: {wrong[:40]} is no tool or frame of this language; name it like {NUMBERED[language]}",
            )
    if language != "urscript" and tool is not None and any(tool):
        raise FindingError(
            Finding("named-language"),
            f"{title}: each move of this language names its tool; give NAME=X,Y,Z,RX,RY,RZ by ",
            Argument("tool"),
        )
    if both := {name.lower() for name in tools} & {name.lower() for name in works}:
        raise FindingError(
            Finding("given-twice"), f"{title}: {min(both)[:40]} is given as a tool and as a work object; give it once"
        )


def check_mentioned(
    title: str,
    language: ProgramLanguage,
    programs: Sequence[Program],
    tools: Mapping[str, Six],
    works: Mapping[str, Six],
) -> None:
    """Raise FindingError for a tool or work object that RAPID modules declare themselves, or do not mention."""
    mentioned = {name for program in programs for name in program.names}
    declared = {name for program in programs for name in program.declared}
    for poses, what, argument in ((tools, "tool", "tool"), (works, "work object", "work")):
        for name in (name.lower() for name in poses if language == "rapid"):
            if name in declared:
                raise FindingError(
                    Finding("declared"),
                    f"{title}: {name[:40]} is declared in this program, and given by ",
                    Argument(argument),
                    "; leave one out",
                )
            if name not in mentioned:
                similar = get_close_matches(name, mentioned, 1)
                meant = f"did you mean {similar[0]}?" if similar else "correct the name, or leave it out"
                raise FindingError(
                    Finding("unmentioned"),
                    f"{title}: no line names {what} {name[:40]}, which is given by ",
                    Argument(argument),
                    f"; {meant}",
                )
