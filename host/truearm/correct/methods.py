"""The methods to correct targets and joint moves. Imports nothing slow, so that ``--help`` can list them."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple, assert_never


class Method(StrEnum):
    """How the joint readings of a target are computed; the numbers are those of Renders et al. 1991."""

    NEWTON = "newton"
    FALSE_TARGET = "false-target"
    JOINTS = "joints"
    OFFSETS = "offsets"


class MethodEntry(NamedTuple):
    """The text that ``--help`` shows for a method, and what the method corrects.

    ``links``: errors of the links between the joints; every method corrects the complete joint law. ``steps``: the
    method can be applied several times.
    """

    summary: str
    links: bool = True
    steps: bool = False


def entry(method: Method) -> MethodEntry:
    """Return the entry of a method."""
    match method:
        case Method.NEWTON:
            return MethodEntry("full inverse of the identified robot")
        case Method.FALSE_TARGET:
            return MethodEntry(
                "shift the target by the opposite of the error, equation (32) of Renders 1991", steps=True
            )
        case Method.JOINTS:
            return MethodEntry("convert the error to joint shifts by the nominal Jacobian, equation (34)", steps=True)
        case Method.OFFSETS:
            summary = "correct the joint law alone (offsets, gains and its other terms), equation (35)"
            return MethodEntry(summary, links=False)
        case _:
            assert_never(method)


def methods_help() -> str:
    """Return one sentence per method."""
    return " ".join(f"{method}: {entry(method).summary}." for method in Method)


def with_steps() -> tuple[str, ...]:
    """Return the names of the methods that can be applied several times."""
    return tuple(method.value for method in Method if entry(method).steps)


class JointMoves(StrEnum):
    """How a program's moves to joint readings are treated: kept as they are, or corrected too."""

    KEEP = "keep"
    CORRECT = "correct"
