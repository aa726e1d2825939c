"""How a target is corrected. Imports nothing slow, so that ``--help`` can list the methods."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Method(StrEnum):
    """What makes the joint readings of a target; the numbers are those of Renders et al. 1991."""

    NEWTON = "newton"
    FALSE_TARGET = "false-target"
    JOINTS = "joints"
    OFFSETS = "offsets"


class MethodEntry(NamedTuple):
    """What ``--help`` says of a method, and what it corrects.

    ``links``: errors of the links between the joints; every method corrects the whole joint law. ``steps``: it can be
    applied several times.
    """

    summary: str
    links: bool = True
    steps: bool = False


METHODS = {
    Method.NEWTON: MethodEntry("full inverse of the identified robot"),
    Method.FALSE_TARGET: MethodEntry("the mirror image of the error is told, Renders 1991 (32)", steps=True),
    Method.JOINTS: MethodEntry("the error through the nominal Jacobian, (34)", steps=True),
    Method.OFFSETS: MethodEntry("the joints alone: offsets, gains and what else the joint law has, (35)", links=False),
}


def methods_help() -> str:
    """Return one sentence a method."""
    return " ".join(f"{method}: {entry.summary}." for method, entry in METHODS.items())


def with_steps() -> tuple[str, ...]:
    """Return the names of the methods that can be applied several times."""
    return tuple(method.value for method, entry in METHODS.items() if entry.steps)
