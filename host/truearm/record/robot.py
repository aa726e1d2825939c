"""A robot's joint readings: JSON lines over a link, told apart from everything else that a robot may print."""

from __future__ import annotations

import json
from math import isfinite
from typing import Any

from truearm.record.frames import Runs

MAX_LINE = 8192  # bytes
MAX_JOINTS = 32


class JointLines:
    """Lines of a robot's stream, exactly as received without their line feed.

    A joint line is a JSON object with ``t`` (controller seconds) and ``q`` (rad or m, as many joints as the first line
    had), all finite; ``seq`` a whole number if there, ``q_cmd`` like ``q`` if there. About 6 µs a line of six joints.
    """

    def __init__(self) -> None:
        self._runs = Runs(b"\n", MAX_LINE)
        self._n_joints: int | None = None

    def push(self, data: bytes) -> list[tuple[bool, bytes]]:
        """``(True, line)`` for joint lines, ``(False, bytes)`` for all else, in order."""
        return [(whole and self._is_joints(line), line) for whole, line in self._runs.push(data)]

    def flush(self) -> bytes:
        """What came behind the last line feed, when the stream has ended."""
        return self._runs.flush()

    def _is_joints(self, line: bytes) -> bool:
        try:
            row = json.loads(line.decode())
        except (ValueError, RecursionError):  # no UTF-8, no JSON, a number of a thousand digits, nested without end
            return False
        if not isinstance(row, dict) or not _is_number(row.get("t")) or not isinstance(row.get("seq", 0), int):
            return False
        q = row.get("q")
        if not _is_vector(q) or not 1 <= len(q) <= MAX_JOINTS:
            return False
        if self._n_joints is None:
            self._n_joints = len(q)
        q_cmd = row.get("q_cmd", q)
        return len(q) == self._n_joints and _is_vector(q_cmd) and len(q_cmd) == len(q)


def _is_number(value: Any) -> bool:
    if type(value) is int:
        return abs(value) < 2**63
    return type(value) is float and isfinite(value)


def _is_vector(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_number, value))
