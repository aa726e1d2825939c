"""The methods to correct targets and joint moves. Imports nothing slow, so that ``--help`` can list them."""

from __future__ import annotations

from enum import StrEnum


class Method(StrEnum):
    """How the joint readings of a target are computed; the numbers are those of Renders et al. 1991.

    ``summary``: the text that ``--help`` shows. ``links``: the method corrects errors of the links between the joints;
    every method corrects the complete joint law. ``steps``: it can be applied several times.
    """

    summary: str
    links: bool
    steps: bool

    def __new__(cls, value: str, summary: str = "", links: bool = True, steps: bool = False) -> Method:
        method = str.__new__(cls, value)
        method._value_, method.summary, method.links, method.steps = value, summary, links, steps
        return method

    NEWTON = "newton", "full inverse of the identified robot"
    FALSE_TARGET = (
        "false-target",
        "shift the target by the opposite of the error, equation (32) of Renders 1991",
        True,
        True,
    )
    JOINTS = "joints", "convert the error to joint shifts by the nominal Jacobian, equation (34)", True, True
    OFFSETS = "offsets", "correct the joint law alone (offsets, gains and its other terms), equation (35)", False


def methods_help() -> str:
    """Return one sentence per method."""
    return " ".join(f"{method}: {method.summary}." for method in Method)


def with_steps() -> tuple[str, ...]:
    """Return the names of the methods that can be applied several times."""
    return tuple(method.value for method in Method if method.steps)


class JointMoves(StrEnum):
    """How a program's moves to joint readings are treated: kept as they are, or corrected too."""

    KEEP = "keep"
    CORRECT = "correct"
