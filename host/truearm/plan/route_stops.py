"""What programs and plan files are made of: the stops of a robot in order."""

from __future__ import annotations

import re
from typing import NamedTuple

from truearm.types import Floats, Move

TIMEOUT = 5.0  # s that the box has to answer
SETTLE = 0.3  # s between arriving and saying so
SLOW = 0.2  # rad/s, rad/s² of the first move, from wherever the arm stands; RAPID: 50 mm/s
LONGEST = 72  # characters of a text: RAPID's strings have 80, of which a program takes some


class Stop(NamedTuple):
    """One stop of a program, one row of the plan file.

    Joints (j,); seconds of the move there (0 for the first); what is measured there or on the way (``Move``);
    what the operator has to do before the arm sets out and when it is there ("" nothing, else as ``plain`` leaves it); the
    speed [m/s] of a line.
    """

    q: Floats
    seconds: float
    move: Move = Move.DWELL
    before: str = ""
    there: str = ""
    speed: float = float("nan")


class Signals(NamedTuple):
    """Digital lines of the controller to and from the box: numbers (UR) or names (RAPID's ``doTruearm``, ``diTruearm``)."""

    output: int = 0
    input: int | None = None


class Task(NamedTuple):
    """What a program says besides its stops.

    Rest at a pose [s]; the point (x, y, z) [m] of the end frame that lines keep straight.
    """

    name: str
    dwell: float = 2.0
    signals: Signals = Signals()
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)


def plain(text: str) -> str:
    """A text that no controller's language takes for anything else."""
    return re.sub(r"[^\w: .-]", "_", text, flags=re.ASCII)[:LONGEST]


def identifier(name: str) -> str:
    """A name that both languages take, that is not a word of theirs, of at most the 32 characters of RAPID."""
    return f"truearm_{re.sub(r'[^a-z0-9]+', '_', name.lower()).strip('_')}"[:32].rstrip("_")
