"""What is done with the moves of a program that go to joint readings. Imports nothing slow, so that ``--help`` can list the choices."""

from __future__ import annotations

from enum import StrEnum


class JointMoves(StrEnum):
    """Keep them as they are, or correct their readings too."""

    KEEP = "keep"
    CORRECT = "correct"
