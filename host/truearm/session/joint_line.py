"""One joint reading of a robot: a line of JSON (docs/session-format.md), judged alike when recorded and when read."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple, TypeGuard

import msgspec

MAX_T_S = 4e9  # ns of such times still fit 63 bits
MAX_SEQ = 2**62
MAX_JOINTS = 32
UNNUMBERED = -MAX_SEQ  # seq of a reading that has none

Joints = Annotated[list[float], msgspec.Meta(min_length=1, max_length=MAX_JOINTS)]


class Reading(NamedTuple):
    """Controller time [s], the reading's number if the robot counts them, joints [rad or m]."""

    t: float
    seq: int | None
    q: list[float]


class JointLine(msgspec.Struct, gc=False):
    """All that a line says; None for what it does not say, or not as docs/session-format.md has it."""

    t: Annotated[float, msgspec.Meta(ge=0.0, lt=MAX_T_S)]
    q: Joints
    seq: Annotated[int, msgspec.Meta(gt=UNNUMBERED, lt=MAX_SEQ)] = UNNUMBERED
    q_cmd: Joints | None = None
    qd: Joints | None = None
    current: Joints | None = None
    effort: Joints | None = None
    inputs: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] | None = None
    robot_mode: float | None = None
    runtime_state: float | None = None


ARRAYS = ("q_cmd", "qd", "current", "effort")  # a number for each joint
NUMBERS = ("robot_mode", "runtime_state")

_usual_line = msgspec.json.Decoder(JointLine).decode


def parse_line(line: bytes) -> JointLine | None:
    """What a line says, None where it is no reading. About 0.8 µs for six joints.

    A reading is an object with ``t`` and ``q``, finite numbers; ``seq`` is a whole number if there. More keys are ignored.
    """
    try:
        found = _usual_line(line)
        if not line.isascii():
            line.decode()
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return _unusual_line(line)
    return found


def parse_usual(lines: Sequence[bytes]) -> list[JointLine] | None:
    """What lines say that all are as docs/session-format.md has them, None where one is not: the same as ``parse_line``, for less."""
    try:
        return [_usual_line(line) for line in lines] if all(map(bytes.isascii, lines)) else None
    except (msgspec.MsgspecError, RecursionError):
        return None


def parse_reading(line: bytes) -> Reading | None:
    """Time, number and joints of a line, None where it is no reading: see ``parse_line``."""
    found = parse_line(line)
    return None if found is None else Reading(found.t, None if found.seq == UNNUMBERED else found.seq, found.q)


def _unusual_line(line: bytes) -> JointLine | None:
    """A line that says something that is not as it should be, which it may, but for ``t``, ``q`` and ``seq``: NaN, a word, null."""
    try:
        row = json.loads(line.decode())
    except (ValueError, RecursionError):  # no UTF-8, no JSON, a number of a thousand digits, nested without end
        return None
    if not isinstance(row, dict):
        return None
    t, seq, q, inputs = row.get("t"), row.get("seq", 0), row.get("q"), row.get("inputs")
    if not (_finite(t) and 0.0 <= t < MAX_T_S) or type(seq) is not int or abs(seq) >= MAX_SEQ:  # type: ignore[operator]
        return None
    if not are_joints(q):
        return None
    return JointLine(
        float(t),  # type: ignore[arg-type]
        [float(value) for value in q],
        seq if "seq" in row else UNNUMBERED,
        inputs=inputs if type(inputs) is int and 0 <= inputs < 2**63 else None,
        **{key: row[key] for key in ARRAYS if are_joints(row.get(key))},
        **{key: float(row[key]) for key in NUMBERS if _finite(row.get(key))},  # type: ignore[arg-type]
    )


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
