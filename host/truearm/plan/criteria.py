"""The criteria for a choice of poses. Imports nothing slow, so that ``--help`` can list them (``choose`` uses them)."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum


class Criterion(StrEnum):
    """The quantity that a choice minimises."""

    I = "I"  # noqa: E741  # the criterion's name in the literature
    D = "D"
    A = "A"
    E = "E"


SUMMARIES: Mapping[Criterion, str] = {
    Criterion.I: "the error in the region",
    Criterion.D: "the volume of the uncertainty of all parameters",
    Criterion.A: "their mean uncertainty",
    Criterion.E: "the uncertainty of the worst combination of parameters",
}  # as ``--help`` shows them
