"""Tools and work objects that a user gives beside programs: those that they cannot use are refused, not ignored."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches

from truearm.correct.programs.languages import ProgramLanguage
from truearm.correct.programs.program import Program
from truearm.errors import Argument, FindingError
from truearm.findings import Finding
from truearm.model.poses import Six

NAMES = {"rapid": ".*", "krl": r"(tool_data|base_data)\d+", "ls": r"u[tf]\d+"}  # a URScript has no names


def check_given(
    title: str,
    language: ProgramLanguage,
    programs: Sequence[Program],
    tool: Six | None,
    tools: Mapping[str, Six],
    works: Mapping[str, Six],
) -> None:
    """Raise FindingError for tools and work objects that programs cannot use; ``tool`` is given without a name.

    RAPID modules must mention them, and not declare them themselves.
    """

    def refuse(code: str, *text: str) -> FindingError:
        return FindingError(Finding(code), f"{title}: {text[0]}", *text[1:])

    if language in NAMES and tool is not None and any(tool):
        text = "each move of this language names its tool; give NAME=X,Y,Z,RX,RY,RZ by "
        raise refuse("named-language", text, Argument("tool"))
    if both := {name.lower() for name in tools} & {name.lower() for name in works}:
        raise refuse("given-twice", f"{min(both)[:40]} is given as a tool and as a work object; give it once")
    mentioned = {name for program in programs for name in program.names}
    declared = {name for program in programs for name in program.declared}
    for name, what, argument in [
        *((name, "tool", "tool") for name in tools),
        *((name, "work object", "work") for name in works),
    ]:
        word = name[:40]
        if language not in NAMES:
            text = f"a URScript knows no tools or work objects by name, such as {word}; give one pose by "
            raise refuse("unnamed-language", text, Argument(argument))
        if not re.fullmatch(NAMES[language], name.lower()):
            text = f"{word} is no tool or frame of this language; name it like {NAMES[language]}"
            raise refuse("wrong-name", text)
        if language == "rapid" and name.lower() in declared:
            text = f"{word} is declared in this program, and given by "
            raise refuse("declared", text, Argument(argument), "; leave one out")
        if language == "rapid" and name.lower() not in mentioned:
            similar = get_close_matches(name.lower(), mentioned, 1)
            meant = f"did you mean {similar[0]}?" if similar else "correct the name, or leave it out"
            text = f"no line names {what} {word}, which is given by "
            raise refuse("unmentioned", text, Argument(argument), f"; {meant}")
