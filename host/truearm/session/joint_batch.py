"""Joint readings of a batch of messages as columns, made of the robot's lines or of the columns that the recorder stored beside them.

A message of ``/robot/columns`` holds what ``parse_lines`` makes of the messages of ``/robot/joints`` before it, since the last such message
(docs/session-format.md). It is CBOR: typed arrays (RFC 8746) by name, which NumPy takes as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import cbor2
import numpy as np
from numpy.typing import NDArray

from truearm.session.joint_line import (
    ARRAYS,
    MAX_JOINTS,
    MAX_SEQ,
    MAX_T_S,
    NUMBERS,
    UNNUMBERED,
    JointLine,
    parse_line,
    parse_usual,
)
from truearm.session.robot_inputs import UNKNOWN, Ints
from truearm.types import Floats

JOINTS = "/robot/joints"
COLUMNS = "/robot/columns"

_FLOAT64, _SINT64 = 86, 79  # RFC 8746: little-endian typed arrays
_DTYPES = {_FLOAT64: "<f8", _SINT64: "<i8"}


@dataclass(frozen=True, eq=False)
class JointBatch:
    """Readings (n,) in order of arrival, of j joints.

    ``seq`` is UNNUMBERED where a reading has none, ``q_cmd`` NaN where it has no commanded joints, ``inputs`` UNKNOWN where it has none.
    ``more``: velocities ``qd``, ``current``, ``effort`` (n, j), ``robot_mode``, ``runtime_state`` (n,), those that some reading has; NaN
    where it has none.
    """

    arrival_ns: Ints
    t: Floats  # s, of the controller
    seq: Ints
    q: Floats  # (n, j) rad or m
    q_cmd: Floats  # (n, j)
    inputs: Ints
    more: Mapping[str, Floats]

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice | NDArray[Any]) -> JointBatch:
        return _each(lambda column: column[rows], self)


def parse_lines(lines: Sequence[bytes], arrival_ns: Sequence[int] | Ints, joints: int | None = None) -> JointBatch:
    """The readings among ``lines``: what ``parse_line`` takes, of as many joints as ``joints`` (None: as the first)."""
    rows = parse_usual(lines)
    if rows and {len(row.q) for row in rows} == {joints or len(rows[0].q)}:
        return _columns(rows, np.array(arrival_ns, dtype=np.int64))
    found = [(row, arrival) for line, arrival in zip(lines, arrival_ns, strict=True) if (row := parse_line(line))]
    width = joints or (len(found[0][0].q) if found else 0)
    found = [(row, arrival) for row, arrival in found if len(row.q) == width]
    return _columns([row for row, _ in found], np.array([arrival for _, arrival in found], dtype=np.int64), width)


def concatenate(batches: Sequence[JointBatch]) -> JointBatch:
    """Batches of readings of equally many joints, one after the other; at least one."""
    keys = dict.fromkeys(chain.from_iterable(batch.more for batch in batches))
    filled = [
        replace(batch, more={key: batch.more.get(key, _nothing(batch, key)) for key in keys}) for batch in batches
    ]
    return filled[0] if len(filled) == 1 else _each(lambda *columns: np.concatenate(columns), *filled)


def pack(batch: JointBatch) -> bytes:
    """The message of a batch; a column that says nothing is left out."""
    columns: dict[str, NDArray[Any]] = {"arrival_ns": batch.arrival_ns, "t": batch.t, "seq": batch.seq, "q": batch.q}
    if not np.isnan(batch.q_cmd).all():
        columns["q_cmd"] = batch.q_cmd
    if (batch.inputs != UNKNOWN).any():
        columns["inputs"] = batch.inputs
    columns |= batch.more
    return cbor2.dumps({name: _tagged(column) for name, column in columns.items()})


def unpack(data: bytes) -> JointBatch | None:
    """The batch of a message, None where it is not what ``pack`` makes of readings: the lines say it all the same."""
    try:
        said = {str(name): _array(tagged) for name, tagged in cbor2.loads(data).items()}
        t, seq, arrival_ns, flat = (said.pop(name) for name in ("t", "seq", "arrival_ns", "q"))
        n, width = len(t), len(flat) // len(t)
        q = flat.reshape(n, width)
        q_cmd = said.pop("q_cmd").reshape(n, width) if "q_cmd" in said else np.full(q.shape, np.nan)
        inputs = said.pop("inputs") if "inputs" in said else np.full(n, UNKNOWN)
        more = {
            key: said[key].reshape((n, width) if key in ARRAYS else n) for key in (*ARRAYS, *NUMBERS) if key in said
        }
    except (cbor2.CBORError, AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError, RecursionError):
        return None
    whole, floats = (seq, arrival_ns, inputs), (t, q, q_cmd, *more.values())
    if any(column.dtype.kind != "i" or column.shape != (n,) for column in whole):
        return None
    if any(column.dtype.kind != "f" for column in floats) or not 1 <= width <= MAX_JOINTS:
        return None
    good = np.all((t >= 0.0) & (t < MAX_T_S)) and np.all((seq >= UNNUMBERED) & (seq < MAX_SEQ))
    good &= np.all(np.isfinite(q)) and np.all(inputs >= UNKNOWN)
    return JointBatch(arrival_ns, t, seq, q, q_cmd, inputs, more) if good else None


def _tagged(column: NDArray[Any]) -> cbor2.CBORTag:
    tag = _FLOAT64 if column.dtype.kind == "f" else _SINT64
    return cbor2.CBORTag(tag, np.ascontiguousarray(column, _DTYPES[tag]).tobytes())


def _array(tagged: Any) -> NDArray[Any]:
    return np.frombuffer(tagged.value, _DTYPES[tagged.tag])


def _columns(rows: Sequence[JointLine], arrival_ns: Ints, width: int | None = None) -> JointBatch:
    """Lines of equally many joints, ``width`` where there is no line, as columns."""
    width = len(rows[0].q) if rows else width or 0
    numbers = {key: [getattr(row, key) for row in rows] for key in NUMBERS}
    arrays = {key: _joints([getattr(row, key) for row in rows], width) for key in ARRAYS}
    q_cmd = arrays.pop("q_cmd")
    more = {key: values for key, values in arrays.items() if values is not None}
    more |= {key: np.array(said, np.float64) for key, said in numbers.items() if said.count(None) < len(said)}
    return JointBatch(
        arrival_ns=arrival_ns,
        t=np.array([row.t for row in rows], dtype=np.float64),
        seq=np.array([row.seq for row in rows], dtype=np.int64),
        q=_table([row.q for row in rows], width),
        q_cmd=np.full((len(rows), width), np.nan) if q_cmd is None else q_cmd,
        inputs=np.array([UNKNOWN if row.inputs is None else row.inputs for row in rows], dtype=np.int64),
        more=more,
    )


def _joints(values: list[list[float] | None], width: int) -> Floats | None:
    """A key's numbers (n, j), NaN where a reading has not one for each joint; None where no reading has."""
    if values.count(None) == len(values):
        return None
    nothing = [np.nan] * width
    rows = [nothing if value is None or len(value) != width else value for value in values]
    return _table(rows, width)


def _table(rows: Sequence[Sequence[float]], width: int) -> Floats:
    return np.fromiter(chain.from_iterable(rows), np.float64, width * len(rows)).reshape(len(rows), width)


def _nothing(batch: JointBatch, key: str) -> Floats:
    """A column of ``more`` of which no reading has anything."""
    return np.full(batch.q.shape if key in ARRAYS else len(batch), np.nan)


def _each(made: Callable[..., NDArray[Any]], *batches: JointBatch) -> JointBatch:
    """A batch whose every column is made of those of ``batches``, which have the same."""
    names = ("arrival_ns", "t", "seq", "q", "q_cmd", "inputs")
    columns = {name: made(*(getattr(batch, name) for batch in batches)) for name in names}
    more = {key: made(*(batch.more[key] for batch in batches)) for key in batches[0].more}
    return JointBatch(**columns, more=more)
