"""The content of programs and plan files: the stops of a robot in order."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from truearm.types import Floats, Move, Plan

TIMEOUT = 5.0  # s within which the box must answer
SETTLE = 0.3  # s between arriving and signalling it
SLOW = 0.2  # rad/s, rad/s² of the first move, from any position of the arm; RAPID: 50 mm/s
LONGEST = 72  # characters of a text: RAPID's strings have 80, and a program needs some of them


class Stop(NamedTuple):
    """One stop of a program, one row of the plan file.

    Joints (j,); seconds of the move to it (0 for the first); what is measured there or on the way (``Move``); what the
    operator must do before the arm moves off and when it has arrived ("" for nothing, otherwise as ``plain`` returns
    it); the speed [m/s] of a line; what is mounted or driven along on the way, by the columns of a plan.
    """

    q: Floats
    seconds: float
    move: Move = Move.DWELL
    before: str = ""
    there: str = ""
    speed: float = float("nan")
    names: Mapping[str, str] = {}


class Signals(NamedTuple):
    """Digital lines of the controller to and from the box: numbers (UR) or names (RAPID's ``doTruearm``, ``diTruearm``)."""

    output: int = 0
    input: int | None = None


class Task(NamedTuple):
    """The content of a program other than its stops.

    Dwell at a pose [s]; the point (x, y, z) [m] of the end frame that lines keep straight.
    """

    name: str
    dwell: float = 2.0
    signals: Signals = Signals()
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)


def visits_of(stops: Sequence[Stop]) -> Plan:
    """Return stops as a plan, row by row."""
    names = {name: np.array([stop.names.get(name, "") for stop in stops]) for name in (*Plan.IDS, "line", "target")}
    move, speed = np.array([stop.move.value for stop in stops]), np.array([stop.speed for stop in stops])
    return Plan(np.array([stop.q for stop in stops]), move=move, speed=speed, **names)


def plain(text: str) -> str:
    """Return a text without characters that have a meaning in a controller's language."""
    return re.sub(r"[^\w: .-]", "_", text, flags=re.ASCII)[:LONGEST]


def identifier(name: str) -> str:
    """Return a name that is valid in both languages, is not one of their keywords, and fits RAPID's 32 characters."""
    return f"truearm_{re.sub(r'[^a-z0-9]+', '_', name.lower()).strip('_')}"[:32].rstrip("_")
