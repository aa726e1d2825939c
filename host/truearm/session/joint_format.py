"""The robot's joint readings as a session holds them: lines of JSON, and the same readings as columns.

A reading is a line of JSON (docs/reference/session-format.md), checked in the same way during recording
(``parse_line()``) and reading (``parse_lines()``). A message on ``/robot/columns`` holds the result of
``parse_lines()`` for the preceding messages of ``/robot/joints``, since the last such message. It is CBOR: typed arrays
(RFC 8746) by name, which NumPy uses as they are. The readings of a source that sends numbers, not text, are such
columns alone (``/robot/readings``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import attrgetter, methodcaller
from typing import Annotated, Any, TypeGuard

import cbor2
import msgspec
import numpy as np
from numpy.typing import NDArray

from truearm.progress import uncollected
from truearm.session.session_file import LATEST_NS, Messages
from truearm.types import Ints

MAX_T_S = 4e9  # such times in ns still fit 63 bits
MAX_SEQ = 2**62
MAX_JOINTS = 32
MAX_Q = 1e9  # rad or m, and whatever else joints report: differences and squares of such numbers are finite
UNNUMBERED = -MAX_SEQ  # seq of a reading without a number

Joints = Annotated[
    list[Annotated[float, msgspec.Meta(gt=-MAX_Q, lt=MAX_Q)]], msgspec.Meta(min_length=1, max_length=MAX_JOINTS)
]


class JointLine(msgspec.Struct, gc=False):
    """The contents of a line; None for what is missing or does not conform to docs/reference/session-format.md."""

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


ARRAYS = ("q_cmd", "qd", "current", "effort")  # one number per joint
NUMBERS = ("robot_mode", "runtime_state")
OPTIONAL = (*ARRAYS, "inputs", *NUMBERS)
WHOLE = ("arrival_ns", "seq", "inputs")  # of integers
_READ = ("t", "seq", "q")  # of every line
_NEEDED = ("arrival_ns", *_READ)
_OF_JOINTS = ("q", *ARRAYS)

_TYPES = {field.name: field.type for field in msgspec.structs.fields(JointLine)}
_usual_line = msgspec.json.Decoder(JointLine).decode
_encoded = msgspec.json.Encoder(enc_hook=methodcaller("tolist")).encode  # NumPy's numbers too


def parse_line(line: bytes) -> JointLine | None:
    """Parse a line; None if it is not a reading. Takes about 0.8 µs for six joints.

    A reading is an object with a number ``t`` and numbers ``q`` below MAX_Q; ``seq`` is an integer if present. Other
    keys are ignored.
    """
    try:
        row = _usual_line(line)
        if not line.isascii():
            line.decode()
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return _unusual_line(line)
    return row


def _unusual_line(line: bytes) -> JointLine | None:
    """Parse a line with invalid values such as NaN, a word or null.

    These are accepted except in ``t``, ``q`` and ``seq``.
    """
    try:
        row = json.loads(line.decode())
        for key in OPTIONAL:
            try:
                msgspec.convert(row.get(key), _TYPES[key])
            except msgspec.ValidationError:
                del row[key]
        return msgspec.convert(row, JointLine)
    except (ValueError, AttributeError, RecursionError, msgspec.ValidationError):  # not UTF-8, JSON or an object
        return None


def are_joints(value: object) -> TypeGuard[list[float]]:
    """Return whether a value is a list of 1 to MAX_JOINTS numbers below MAX_Q."""
    try:
        return msgspec.convert(value, Joints) is not None
    except msgspec.ValidationError:
        return False


def format_reading(t: float, seq: int | None, q: Sequence[float], **optional: object) -> bytes:
    """Return the line of a reading, every number with all its digits.

    Entries of ``optional`` that are None are left out.

    ``optional`` may hold the keys of docs/reference/session-format.md: ``q_cmd``, ``qd``, ``current`` ….
    """
    row = {"t": t, "seq": seq, "q": q, **optional}
    return _encoded({key: value for key, value in row.items() if value is not None})


JOINTS = "/robot/joints"
COLUMNS = "/robot/columns"
READINGS = "/robot/readings"  # of a source that sends numbers: the same columns, without lines

NO_INPUTS = -1  # inputs of a reading without them
_FLOAT64, _SINT64 = 86, 79  # RFC 8746: little-endian typed arrays
_DTYPES = {_FLOAT64: "<f8", _SINT64: "<i8"}
_RANGES: dict[str, tuple[float, float]] = {  # of the numbers of a batch: from, to less than
    "arrival_ns": (0, LATEST_NS),
    "t": (0.0, MAX_T_S),
    "seq": (UNNUMBERED, MAX_SEQ),
    "inputs": (NO_INPUTS, 2**63),
    **dict.fromkeys(_OF_JOINTS, (-MAX_Q, MAX_Q)),
}


@dataclass(frozen=True, eq=False)
class JointBatch:
    """Readings (n,) of j joints in order of arrival.

    ``columns``: host time ``arrival_ns`` (n,), the controller's time ``t`` (n,) [s], ``seq`` (n,), UNNUMBERED where a
    reading has no number, joints ``q`` (n, j) [rad or m]; and what any reading has of commanded joints ``q_cmd``,
    velocities ``qd``, ``current``, ``effort`` (n, j), ``inputs``, ``robot_mode`` and ``runtime_state`` (n,). Where a
    reading does not have it, it is NaN, or NO_INPUTS.
    """

    columns: Mapping[str, NDArray[Any]]

    arrival_ns = property(lambda self: self.columns["arrival_ns"])
    t = property(lambda self: self.columns["t"])
    seq = property(lambda self: self.columns["seq"])
    q = property(lambda self: self.columns["q"])

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice | NDArray[Any]) -> JointBatch:
        return JointBatch({key: column[rows] for key, column in self.columns.items()})


@uncollected()
def parse_lines(lines: Sequence[bytes], arrival_ns: Sequence[int] | Ints, joints: int | None = None) -> JointBatch:
    """Return the readings among ``lines``, as ``parse_line`` accepts them, of ``joints`` joints (None: the first's)."""
    rows = [(row, arrival) for line, arrival in zip(lines, arrival_ns, strict=True) if (row := parse_line(line))]
    width = joints or (len(rows[0][0].q) if rows else 0)
    rows = [(row, arrival) for row, arrival in rows if len(row.q) == width]
    return columns_of_rows([row for row, _ in rows], [arrival for _, arrival in rows], width)


def concatenate(batches: Sequence[JointBatch]) -> JointBatch:
    """Concatenate at least one batch of readings of the same joints; missing columns are filled with no value."""
    if len(batches) == 1:
        return batches[0]
    width = batches[0].q.shape[1]
    columns = {
        key: [b.columns[key] if key in b.columns else _column(key, [None] * len(b), width) for b in batches]
        for key in dict.fromkeys(chain.from_iterable(batch.columns for batch in batches))
    }
    return JointBatch({key: np.concatenate(parts) for key, parts in columns.items()})


def pack(batch: JointBatch) -> bytes:
    """Encode a batch as a message."""
    return cbor2.dumps({name: _tagged(column) for name, column in batch.columns.items()})


def unpack(*messages: bytes) -> JointBatch | None:
    """Decode the batches in messages as one batch.

    None if ``pack`` cannot have made one of them, as the lines contain the same data, or if their columns differ.
    """
    try:
        batches = [
            {key: np.frombuffer(tagged.value, _DTYPES[tagged.tag]) for key, tagged in cbor2.loads(data).items()}
            for data in messages
        ]
        columns = {key: np.concatenate([batch[key] for batch in batches]) for key in batches[0]}
        n, width = len(columns["t"]), len(columns["q"]) // len(columns["t"])
        shapes = {key: (n, width) if key in _OF_JOINTS else (n,) for key in (*_NEEDED, *OPTIONAL)}
        columns = {key: columns[key].reshape(shapes[key]) for key in shapes if key in columns or key in _NEEDED}
    except (cbor2.CBORError, AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError, RecursionError):
        return None
    if any(batch.keys() != batches[0].keys() for batch in batches):
        return None
    good = 1 <= width <= MAX_JOINTS and not any(np.isnan(columns[key]).any() for key in ("t", "q"))
    good = good and all((column.dtype.kind == "i") == (key in WHOLE) for key, column in columns.items())
    for key, (lowest, beyond) in _RANGES.items():
        good = good and not (key in columns and np.any((columns[key] < lowest) | (columns[key] >= beyond)))
    return JointBatch(columns) if good else None


def joint_batch(messages: Messages, joints: int | None) -> tuple[JointBatch, int]:
    """Return the readings of a batch of messages in order, and how many lines and columns are malformed.

    ``joints``: number of joints per reading; None: as in the first. The columns beside lines are used if they are those
    of the lines; else the lines are parsed.
    """
    lines, columns, numbers = (messages.rows(topic.__eq__) for topic in (JOINTS, COLUMNS, READINGS))
    arrival_ns = messages.t_host_ns[lines]
    batch = unpack(*messages.payloads(columns)) if len(columns) else None
    if batch is None or not np.array_equal(batch.arrival_ns, arrival_ns) or joints not in (None, batch.q.shape[1]):
        batch = parse_lines(messages.payloads(lines), arrival_ns, joints)
    batches, malformed = [batch] if len(batch) else [], len(lines) - len(batch)
    for data in messages.payloads(numbers):
        read = unpack(data)
        if read is not None and read.q.shape[1] == (joints or (batches or [read])[0].q.shape[1]):
            batches.append(read)
        else:
            malformed += 1
    return concatenate(batches or [batch]), malformed


def _tagged(column: NDArray[Any]) -> cbor2.CBORTag:
    tag = _FLOAT64 if column.dtype.kind == "f" else _SINT64
    return cbor2.CBORTag(tag, np.ascontiguousarray(column, _DTYPES[tag]).tobytes())


def columns_of_rows(
    rows: Sequence[JointLine], arrival_ns: Sequence[int] | Ints, width: int | None = None
) -> JointBatch:
    """Return the columns of lines with equal numbers of joints; ``width`` is used if there are no lines."""
    width = len(rows[0].q) if rows else width or 0
    columns: dict[str, NDArray[Any]] = {"arrival_ns": np.array(arrival_ns, np.int64)}
    for key in (*_READ, *OPTIONAL):
        values = list(map(attrgetter(key), rows))
        if key in _READ or values.count(None) < len(rows):
            columns[key] = _column(key, values, width)
    return JointBatch(columns)


def _column(key: str, values: Sequence[Any], width: int) -> NDArray[Any]:
    """Return a column of values.

    None, and arrays of another number of joints, are values that a reading does not have.
    """
    if key in _OF_JOINTS:
        nothing = [np.nan] * width
        rows = (nothing if value is None or len(value) != width else value for value in values)
        return np.fromiter(chain.from_iterable(rows), np.float64, width * len(values)).reshape(len(values), width)
    if key in WHOLE:
        return np.array([NO_INPUTS if value is None else value for value in values], np.int64)
    return np.array(values, np.float64)
