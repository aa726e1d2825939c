"""A session's messages as columns, batch by batch: all that sync sees, for other programs (``truearm export-session``).

Titles end in the unit. Each batch is a mapping of titles to columns of equal length; a table's titles stay the same from its first
batch on. Where a box or a robot describes itself otherwise later (other channels, other keys), another table begins, ``NAME-2``.
Nothing is left out, filled in or averaged: a gap is marked where it is. What sync makes of them is in ``findings``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from truearm.errors import SessionError
from truearm.session.box_ident import Channel, Ident, Stream
from truearm.session.box_messages import parse_exchange
from truearm.session.data_frames import decode
from truearm.session.dwell_samples import sample_times, within_ns
from truearm.session.joint_batch import JointBatch, parse_lines
from truearm.session.joint_line import ARRAYS, UNNUMBERED
from truearm.session.joint_readings import CHUNK as LINES
from truearm.session.joint_readings import restarts
from truearm.session.lvdt import extension, volts
from truearm.session.pipeline import Messages, Survey
from truearm.session.robot_inputs import UNKNOWN as NO_INPUTS
from truearm.session.sample_blocks import Block, BoxReader
from truearm.types import Message
from truearm_wire import messages as wire

BLOCKS = 512  # of samples, in a batch
ROWS = 2048  # of small messages, in a batch
MAX_TABLES = 100
UNKNOWN = -1  # a whole number that is not known

Columns = dict[str, NDArray[Any]]
Batch = tuple[str, Columns]

# Optional keys of a reading and how their columns are titled (docs/session-format.md).
_TITLES = {
    **{"q_cmd": "q_cmd{0}_{1}", "qd": "qd{0}_{1}_s", "current": "current{0}_A", "effort": "effort{0}_{2}"},
    **{name: name for name in ("inputs", "robot_mode", "runtime_state")},
}
_TORQUE = {"rad": "Nm", "m": "N"}


def tabulate(
    messages: Messages, found: Survey, ident: Ident | None = None, joint_units: Sequence[str] = ()
) -> Iterator[Batch]:
    """(table, columns) of all messages in one pass; memory does not grow with it.

    ``found`` is the survey of the same messages, ``joint_units`` "rad" or "m" for each joint ("rad" where none is given).
    Raises SessionError where the box describes itself in ever new ways.
    """
    names = _Names()
    box, robot, rest = _Box(found, ident), _Robot(found, joint_units), _Rest()
    for message in messages(None):
        if message.topic == "/robot/joints":
            batches = robot.feed(message)
        elif message.topic.startswith("/box/"):
            batches = box.feed(message)
        elif message.topic == "/sync":
            batches = box.exchange(message)
        else:
            batches = rest.feed(message)
        for name, columns in batches:
            yield names.of(name, columns), columns
    for part in (box, robot, rest):
        for name, columns in part.flush():
            yield names.of(name, columns), columns


@dataclass
class _Names:
    """The table that columns of these titles belong to."""

    known: dict[tuple[str, tuple[str, ...]], str] = field(default_factory=dict)

    def of(self, name: str, columns: Columns) -> str:
        key = name, tuple(columns)
        if key not in self.known:
            if len(self.known) >= MAX_TABLES:
                raise SessionError(
                    f"the session would become more than {MAX_TABLES} tables; truearm record writes a dozen"
                )
            before = sum(other == name for other, _ in self.known)
            self.known[key] = f"{name}-{before + 1}" if before else name
        return self.known[key]


@dataclass
class _Rows:
    """Small messages of one table until there are enough of them."""

    rows: list[dict[str, Any]] = field(default_factory=list)

    def columns(self) -> Columns:
        columns = {title: np.array([row[title] for row in self.rows]) for title in self.rows[0]}
        self.rows = []
        return columns


class _Small:
    """Tables of small messages."""

    def __init__(self) -> None:
        self._tables: dict[str, _Rows] = {}

    def add(self, name: str, row: dict[str, Any]) -> Iterator[Batch]:
        table = self._tables.setdefault(name, _Rows())
        table.rows.append(row)
        if len(table.rows) >= ROWS:
            yield name, table.columns()

    def flush(self) -> Iterator[Batch]:
        for name, table in self._tables.items():
            if table.rows:
                yield name, table.columns()


class _Box(_Small):
    """Streams of samples, heartbeats, edges and clock exchanges."""

    def __init__(self, found: Survey, ident: Ident | None) -> None:
        super().__init__()
        self._found = found
        self._reader = BoxReader(ident, keep_exchanges=False)
        self._blocks: dict[int, list[Block]] = {}  # by stream: of one segment, ident and timing
        self._stream: dict[int, Stream] = {}

    def feed(self, message: Message) -> Iterator[Batch]:
        for block in self._reader.feed(message):
            yield from self._block(block)
        if message.topic in ("/box/heartbeat", "/box/event"):
            yield from self._frame(message)

    def flush(self) -> Iterator[Batch]:
        for block in self._reader.finish():
            yield from self._block(block)
        for stream_id in list(self._blocks):
            yield from self._flush_stream(stream_id)
        yield from super().flush()

    def exchange(self, message: Message) -> Iterator[Batch]:
        times = parse_exchange(message.data)
        t0, t1, t2, t3 = (UNKNOWN,) * 4 if times is None else times
        row = {"arrival_ns": message.t_host_ns, "segment": self._reader.segment.index}
        yield from self.add("sync", {**row, "t0_ns": t0, "t1_us": t1, "t2_us": t2, "t3_ns": t3})

    def _block(self, block: Block) -> Iterator[Batch]:
        key, stream = block.data.stream, block.ident.streams[block.data.stream]
        waiting = self._blocks.get(key)
        if waiting:
            last = waiting[-1]
            alike = last.segment == block.segment and last.data.period_ns == block.data.period_ns
            if not alike or self._stream[key] is not stream or len(waiting) >= BLOCKS:
                yield from self._flush_stream(key)
        self._stream[key] = stream
        self._blocks.setdefault(key, []).append(block)

    def _flush_stream(self, key: int) -> Iterator[Batch]:
        blocks, stream = self._blocks.pop(key), self._stream[key]
        yield f"box_{stream.name}", samples(blocks, stream, self._found)

    def _frame(self, message: Message) -> Iterator[Batch]:
        frame = decode(message.data)
        kind = message.topic.rpartition("/")[2]
        names = wire.names(wire.HEARTBEAT if kind == "heartbeat" else wire.EVENT)
        if frame is None or any(type(value) is not int or abs(value) >= 2**63 for value in frame):
            return  # malformed: the survey's account has it
        row = dict(zip(names, frame[1:], strict=False))
        if "t_us" not in row:
            return
        clock = self._found.clocks.get(self._reader.segment.index)
        host, bound = (UNKNOWN, np.nan) if clock is None else (x[0] for x in clock.to_host_ns(np.array([row["t_us"]])))
        said = {"arrival_ns": message.t_host_ns, "segment": self._reader.segment.index}
        times = {"host_time_ns": int(host), "host_bound_ns": float(bound)}
        yield from self.add(f"box_{kind}", {**said, **times, **{name: row.get(name, UNKNOWN) for name in names}})


def samples(blocks: Sequence[Block], stream: Stream, found: Survey) -> Columns:
    """The samples of blocks of one segment and timing: when they were taken, counts and what these mean.

    ``device_time_ns`` is the box's stamp; ``host_time_ns`` that instant on the host's clock less the converter's group delay, which
    is when the signal had that value, with the bound of its error. ``gap`` 1: samples are missing before this one.
    """
    blocks = list(blocks)
    n = np.array([block.n for block in blocks])
    first = np.cumsum(n) - n
    total = int(n.sum())
    within = np.arange(total) - np.repeat(first, n)
    clock = found.clocks.get(blocks[0].segment)
    if clock is None:
        host, bounds = np.full(total, UNKNOWN, np.int64), np.full(total, np.nan)
    else:
        host, block_bounds = sample_times(blocks, clock, stream)
        bounds = np.repeat(block_bounds, n)
    gap = np.zeros(total, np.int8)
    gap[first[[block.gap for block in blocks]]] = 1
    t0_ns = 1000 * np.array([block.data.t0_us for block in blocks], np.int64)
    columns: Columns = {
        "segment": np.full(total, blocks[0].segment),
        "run": np.repeat(np.array([block.run for block in blocks]), n),
        "index": np.repeat(np.array([block.data.n0 for block in blocks], np.int64), n) + within,
        "gap": gap,
        "device_time_ns": np.repeat(t0_ns, n) + within_ns(blocks),
        "host_time_ns": host,
        "host_bound_ns": bounds,
        "flags": np.repeat(np.array([block.data.flags for block in blocks], np.int64), n),
    }
    joined = b"".join(block.data.samples for block in blocks)
    counts = np.frombuffer(joined, "<i4").reshape(total, blocks[0].channels)
    for k, channel in enumerate(stream.channels):
        for title, values in _channel(counts[:, k], channel, f"channel{k + 1}"):
            columns[title if title not in columns else f"channel{k + 1}_{title}"] = values
    return columns


def _channel(counts: NDArray[np.int32], channel: Channel, unnamed: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Counts, what the converter saw, and what the calibration makes of that in SI units."""
    name = _clean(channel.name) or unnamed
    yield f"{name}_counts", counts
    if channel.fault:
        return
    seen = volts(counts, channel)
    yield f"{name}_{_clean(channel.unit) or 'raw'}", seen
    if channel.length_unit is not None:
        yield f"{name}_m", extension(counts, channel)
    elif channel.poly:
        yield (
            f"{name}_{_clean(channel.calibrated_unit) or 'calibrated'}_calibrated",
            np.asarray(polyval(seen, channel.poly)),
        )


class _Robot:
    """The readings of the robot, in order of arrival, each with its place on the host's clock."""

    def __init__(self, found: Survey, units: Sequence[str]) -> None:
        self._clocks = found.joints.clocks
        n = len(found.joints.step)
        self._units = tuple(units) or ("rad",) * n
        if n and len(self._units) != n:
            raise SessionError(f"the session has readings of {n} joints, the robot has {len(self._units)}")
        self._lines: list[Message] = []
        self._segment = -1
        self._latest_s = -np.inf
        self._keys: set[str] = set()  # optional ones that came so far

    def feed(self, message: Message) -> Iterator[Batch]:
        self._lines.append(message)
        if len(self._lines) >= LINES:
            yield from self.flush()

    def flush(self) -> Iterator[Batch]:
        lines, arrival_ns = [message.data for message in self._lines], [message.t_host_ns for message in self._lines]
        batch = parse_lines(lines, arrival_ns, len(self._units) or None)
        self._lines = []
        if not len(batch):
            return
        t, seq = batch.t, batch.seq
        starts = restarts(t, self._latest_s)
        if self._segment < 0:
            starts = np.union1d([0], starts)
        segment = np.zeros(t.size, np.int64)
        segment[starts] = 1
        segment = self._segment + np.cumsum(segment)
        current = t[int(starts[-1]) :] if starts.size else t
        self._latest_s = max(float(current.max()), -np.inf if starts.size else self._latest_s)
        self._segment = int(segment[-1])
        host = np.empty(t.size, np.int64)
        for k in np.unique(segment):
            host[segment == k] = self._clocks[k].to_host_ns(t[segment == k])
        columns: Columns = {
            "arrival_ns": batch.arrival_ns,
            "host_time_ns": host,
            "segment": segment,
            "controller_time_s": t,
            "seq": np.where(seq == UNNUMBERED, UNKNOWN, seq),
            **{f"q{j}_{unit}": batch.q[:, j - 1] for j, unit in enumerate(self._units, start=1)},
        }
        yield "joints", columns | self._optional(batch)

    def _optional(self, batch: JointBatch) -> Columns:
        said = dict(batch.more)
        if not np.isnan(batch.q_cmd).all():
            said["q_cmd"] = batch.q_cmd
        if (batch.inputs != NO_INPUTS).any():
            said["inputs"] = np.where(batch.inputs == NO_INPUTS, np.nan, batch.inputs)
        self._keys |= said.keys()
        columns: Columns = {}
        for key, title in _TITLES.items():
            if key not in self._keys:
                continue
            if key not in ARRAYS:
                columns[title] = said.get(key, np.full(len(batch), np.nan))
                continue
            values = said.get(key, np.full(batch.q.shape, np.nan))
            for j, unit in enumerate(self._units):
                columns[title.format(j + 1, unit, _TORQUE.get(unit, unit))] = values[:, j]
        return columns


class _Rest(_Small):
    """Events."""

    def feed(self, message: Message) -> Iterator[Batch]:
        if message.topic == "/events":
            text = message.data.decode(errors="backslashreplace")
            yield from self.add("events", {"arrival_ns": message.t_host_ns, "kind": _kind(text), "event": text})


def _kind(text: str) -> str:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return ""
    kind = document.get("kind") if isinstance(document, dict) else None
    return kind if isinstance(kind, str) else ""


def _clean(text: str) -> str:
    """A stranger's name as part of a title."""
    return re.sub(r"[^A-Za-z0-9_/°µ-]+", "_", text)[:32]
