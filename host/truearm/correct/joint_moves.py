"""How a program's moves to joint readings are treated. Imports nothing slow: ``--help`` lists the choices."""

from __future__ import annotations

from enum import StrEnum


class JointMoves(StrEnum):
    """Keep the moves as they are, or correct their readings too."""

    KEEP = "keep"
    CORRECT = "correct"
