"""The options of plans in SI units, declared once: the commands' ``--help`` reads this, so it imports nothing slow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, NamedTuple

from truearm import option_defaults
from truearm.bounds import CANDIDATES, CHECK_POSES, DWELL, MINUTES, SEED, TRAVEL, VISITS, OneOf, Within

TABLE = ".csv"  # for an arm with any number of joints
LANGUAGES: Mapping[str, str] = {".script": "URScript", ".mod": "RAPID", TABLE: "all stops"}  # of programs, by suffix


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


class Budget(NamedTuple):
    """How much to measure: ``n`` poses, including every visit of a check pose, or an operator's ``minutes``."""

    n: int | None = None
    minutes: float | None = None


@dataclass(frozen=True)
class PoseOptions:
    """What ``truearm.BallBarOptions`` describes, but for the region."""

    criterion: Annotated[str, OneOf(tuple(Criterion))] = option_defaults.CRITERION
    candidates: Annotated[int, CANDIDATES] = 5000
    bars: tuple[str, ...] = ()
    reserve: Annotated[float | None, TRAVEL] = None
    spread: Annotated[float, TRAVEL] = 0.0
    dwell: Annotated[float, DWELL] = option_defaults.DWELL
    seed: Annotated[int, SEED] = option_defaults.SEED
    visits: Annotated[int, VISITS] = 1
    check_poses: Annotated[int, CHECK_POSES] = option_defaults.CHECK_POSES
    joint_laws: bool = False


@dataclass(frozen=True)
class LineOptions:
    """How many lines, or the minutes for them, and how they are chosen and driven.

    ``length`` of a line and ``transverse`` range of the device [m], ``speed`` [m/s]. ``passes``: how often each is
    driven there and back. ``points``: read in each direction. ``target``: the measured point of the rig, None for its
    only one.
    """

    lines: Annotated[int | None, Within(1, 100)] = None
    minutes: Annotated[float | None, MINUTES] = None
    length: Annotated[float, Within(0.01, 5.0)] = 0.5
    transverse: Annotated[float, Within(1e-3, 0.5)] = 15e-3
    speed: Annotated[float, Within(1e-3, 1.0)] = 50e-3
    passes: Annotated[int, Within(1, 20)] = 1
    points: Annotated[int, Within(3, 500)] = 12
    target: str | None = None
    criterion: Annotated[str, OneOf(tuple(Criterion))] = option_defaults.CRITERION
    candidates: Annotated[int, Within(1, 5000)] = 120
    seed: Annotated[int, SEED] = option_defaults.SEED


@dataclass(frozen=True)
class ApproachOptions:
    """Where and how often poses are approached.

    ``bar``, ``chuck`` and ``sphere``: None for the rig's first. ``rounds``: of visits to each of the ``poses``.
    ``long_dwell`` [s]: of one rest at each pose. ``reserve`` [m] and ``dwell`` [s] as in ``PoseOptions``.
    """

    bar: str | None = None
    chuck: str | None = None
    sphere: str | None = None
    poses: Annotated[int, Within(1, 50)] = 4
    rounds: Annotated[int, Within(2, 100)] = 4
    long_dwell: Annotated[float, Within(2.0, 60.0)] = 20.0
    reserve: Annotated[float | None, TRAVEL] = None
    dwell: Annotated[float, DWELL] = option_defaults.DWELL
    seed: Annotated[int, SEED] = option_defaults.SEED
    candidates: int = 400


def languages_help() -> str:
    """Return the suffixes of programs and their languages, as ``--help`` and messages show them."""
    return ", ".join(f"{suffix} ({language})" for suffix, language in LANGUAGES.items())
