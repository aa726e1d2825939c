"""The criteria for a choice of poses. Imports nothing slow, so that ``--help`` can list them (``choose`` uses them)."""

from __future__ import annotations

from enum import StrEnum
from typing import assert_never


class Criterion(StrEnum):
    """The quantity that a choice minimises."""

    I = "I"  # noqa: E741  # the criterion's name in the literature
    D = "D"
    A = "A"
    E = "E"


def criterion_summary(criterion: Criterion) -> str:
    """Return the text that ``--help`` shows for a criterion."""
    match criterion:
        case Criterion.I:
            return "the error in the region"
        case Criterion.D:
            return "the volume of the uncertainty of all parameters"
        case Criterion.A:
            return "their mean uncertainty"
        case Criterion.E:
            return "the uncertainty of the worst combination of parameters"
        case _:
            assert_never(criterion)
