"""The criteria for a choice of poses. Imports nothing slow, so that ``--help`` can list them (``choose`` uses them)."""

from __future__ import annotations

from enum import StrEnum


class Criterion(StrEnum):
    """The quantity that a choice minimises; ``summary``: the text that ``--help`` shows."""

    summary: str

    def __new__(cls, value: str, summary: str = "") -> Criterion:
        criterion = str.__new__(cls, value)
        criterion._value_, criterion.summary = value, summary
        return criterion

    I = "I", "the error in the region"  # noqa: E741  # the criterion's name in the literature
    D = "D", "the volume of the uncertainty of all parameters"
    A = "A", "their mean uncertainty"
    E = "E", "the uncertainty of the worst combination of parameters"
