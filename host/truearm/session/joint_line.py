"""One joint reading of a robot: a line of JSON (docs/session-format.md), judged alike when recorded and when read."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import NamedTuple, TypeGuard

MAX_T_S = 4e9  # ns of such times still fit 63 bits
MAX_SEQ = 2**62
MAX_JOINTS = 32


class Reading(NamedTuple):
    """Controller time [s], the reading's number if the robot counts them, joints [rad or m]."""

    t: float
    seq: int | None
    q: list[float]


def parse_reading(line: bytes) -> Reading | None:
    """A reading, None where a line is none.

    It is an object with ``t`` and ``q``, finite numbers; ``seq`` is a whole number if there. More keys are ignored.
    """
    try:
        row = json.loads(line.decode())
    except (ValueError, RecursionError):  # no UTF-8, no JSON, a number of a thousand digits, nested without end
        return None
    if not isinstance(row, dict):
        return None
    t, seq, q = row.get("t"), row.get("seq", 0), row.get("q")
    if not (_finite(t) and 0.0 <= t < MAX_T_S) or type(seq) is not int or abs(seq) >= MAX_SEQ:  # type: ignore[operator]
        return None
    if not are_joints(q):
        return None
    return Reading(float(t), seq if "seq" in row else None, [float(value) for value in q])  # type: ignore[arg-type]


def are_joints(value: object) -> TypeGuard[list[float]]:
    """Whether something is a list of 1 to MAX_JOINTS finite numbers."""
    return isinstance(value, list) and 1 <= len(value) <= MAX_JOINTS and all(map(_finite, value))


def format_reading(t: float, seq: int | None, q: Sequence[float], **more: object) -> bytes:
    """The line of a reading, every number with all its digits; of ``more`` what is None is left out.

    ``more`` may hold what docs/session-format.md names: ``q_cmd``, ``qd``, ``current`` ….
    """
    row = {"t": t, "seq": seq, "q": list(q), **more}
    return json.dumps({key: value for key, value in row.items() if value is not None}, separators=(",", ":")).encode()


def _finite(value: object) -> bool:
    return (type(value) is float and math.isfinite(value)) or (type(value) is int and abs(value) < 2**53)
