"""Convert the messages of a session to columns, batch by batch, for other programs (``truearm session export``).

Titles end in the unit. Each batch is a mapping of titles to columns of equal length. A table's titles stay the same
from its first batch on; if a box or a robot later describes itself differently (other channels, other keys), another
table ``NAME-2`` begins. Nothing is left out, filled in or averaged: gaps are marked.

Plan, dwells and passes are columns too (``plan_columns()``, ``dwell_columns()``, ``pass_columns()``). An unknown number
is NaN, an unknown integer UNKNOWN.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from truearm.errors import SessionError
from truearm.session.clock import UNKNOWN, host_times
from truearm.session.dwells import Dwell
from truearm.session.frames import Channel, fields_of, parse_exchange
from truearm.session.joint_format import NO_INPUTS, OPTIONAL, UNNUMBERED, JointBatch, concatenate
from truearm.session.joint_readings import JointStream, SegmentedReadings
from truearm.session.line_passes import LinePass
from truearm.session.observations import Survey, read_blocks
from truearm.session.plan_matching import read_mark
from truearm.session.samples import extension, volts, with_ratios
from truearm.session.session_file import Messages
from truearm.session.streams import Blocks, BoxReader, segment_at
from truearm.types import BAR_MOUNTED, LINE_MOUNTED
from truearm_wire import messages as wire

MAX_TABLES = 100

Columns = dict[str, NDArray[Any]]
Batch = tuple[str, Columns]

# Optional keys of a reading for each joint, and the titles of their columns (docs/reference/session-format.md).
_TITLES = {"q_cmd": "q_cmd{0}_{1}", "qd": "qd{0}_{1}_s", "current": "current{0}_A", "effort": "effort{0}_{2}"}
_SMALL = {  # topics of small messages, and the frames of the box on them
    **{"/box/heartbeat": wire.HEARTBEAT, "/box/event": wire.EVENT, "/box/temperature": wire.TEMPERATURE},
    **dict.fromkeys(("/sync", "/events"), 0),
}
_TORQUE = {"rad": "Nm", "m": "N"}


def tabulate(survey: Survey, joint_units: Sequence[str] = ()) -> Iterator[Batch]:
    """Yield (table, columns) for all messages of the surveyed session, in one pass with constant memory.

    ``joint_units``: "rad" or "m" for each joint ("rad" if not given). Raises SessionError if the box's description
    keeps changing.
    """
    titles: dict[str, list[tuple[str, ...]]] = {}  # of the tables of each name
    for name, columns in _batches(survey, joint_units):
        tables = titles.setdefault(name, [])
        if tuple(columns) not in tables:
            tables.append(tuple(columns))
            if sum(map(len, titles.values())) > MAX_TABLES:
                raise SessionError(
                    f"the session would become more than {MAX_TABLES} tables; a session of truearm record has about a dozen"
                )
        number = tables.index(tuple(columns)) + 1
        yield name if number == 1 else f"{name}-{number}", columns


def _batches(survey: Survey, joint_units: Sequence[str]) -> Iterator[Batch]:
    n, messages_before = len(survey.joints.step), 0
    units = tuple(joint_units) or ("rad",) * n
    if n and len(units) != n:
        raise SessionError("other-robot", place="session", joints=n, expected=len(units))
    order, keys = SegmentedReadings(len(units) or None), list[JointBatch]()
    for messages, blocks in read_blocks(survey.source, BoxReader(survey.ident)):
        yield from ((f"box_{released.stream.name}", samples(released, survey)) for released in blocks)
        yield from _small_tables(messages, messages_before, survey)
        yield from _readings(order.take(messages), survey.joints, units, keys)
        messages_before += len(messages)
    yield from _readings(order.finish(), survey.joints, units, keys)


def _small_tables(messages: Messages, messages_before: int, survey: Survey) -> Iterator[Batch]:
    """Yield tables of clock exchanges, events, and all frames of the box but samples."""
    rows = messages.rows(lambda topic: topic in _SMALL)
    segments = segment_at(survey.segments, rows + messages_before).tolist()
    tables: dict[str, list[dict[str, Any]]] = {}
    for segment, message in zip(segments, messages.one_by_one(rows), strict=True):
        row: dict[str, Any] = {"arrival_ns": message.t_host_ns}
        if message.topic == "/events":
            event = read_mark(message.topic, message.data)
            kind_name = "" if event is None else event.kind
            row |= {"kind": kind_name, "event": message.data.decode(errors="backslashreplace")}
        elif message.topic == "/sync":
            exchange = parse_exchange(message.data) or (UNKNOWN,) * 4
            row |= {"segment": segment, **dict(zip(("t0_ns", "t1_us", "t2_us", "t3_ns"), exchange, strict=True))}
        else:
            kind = _SMALL[message.topic]
            elements = fields_of(kind, message.data)
            if elements is None or not all(-(2**63) <= value < 2**63 for value in elements.values()):
                continue  # malformed: counted by the survey
            row |= {"segment": segment, "host_time_ns": UNKNOWN, "host_bound_ns": np.nan}
            row |= {name: elements.get(name, UNKNOWN) for name in wire.names(kind)}
            if message.topic == "/box/temperature":
                row["name"] = _thermometer(survey, segment, elements)
        tables.setdefault(message.topic.removeprefix("/").replace("/", "_"), []).append(row)
    for name, listed in tables.items():
        columns = {title: np.array([row[title] for row in listed]) for title in listed[0]}
        if "host_time_ns" in columns:
            placed = host_times(survey.clocks, columns["segment"], columns["t_us"])
            columns["host_time_ns"], columns["host_bound_ns"] = placed
        yield name, columns


def _thermometer(survey: Survey, segment: int, elements: dict[str, Any]) -> str:
    """Return the name of the thermometer of a reading; "" if the box does not name it."""
    ident, number = survey.idents.get(segment), elements.get("thermometer", UNKNOWN)
    return ident.thermometers[number] if ident is not None and 0 <= number < len(ident.thermometers) else ""


def samples(blocks: Blocks, survey: Survey) -> Columns:
    """Return the samples of blocks: times, counts and converted values.

    ``device_time_ns`` is the box's stamp. ``host_time_ns`` is that instant on the host's clock minus the converter's
    group delay, which is when the signal had that value; the bound of its error is given too. ``gap`` 1: samples are
    missing before this one.
    """
    stream, table, n, within_ns = blocks.stream, blocks.table, blocks.table["n"], blocks.within_ns()
    counts = with_ratios(blocks.counts, stream.channels)
    total = len(counts)
    host, bounds = host_times(survey.clocks, np.full(len(table), blocks.segment), table["t_us"])
    placed = np.repeat(host, n) + within_ns - stream.group_delay_ns
    columns: Columns = {
        "segment": np.full(total, blocks.segment),
        "run": np.repeat(table["run"].astype(np.int64), n),
        "index": np.arange(total) + np.repeat(table["n0"] - blocks.first[:-1], n),
        "gap": blocks.gaps().astype(np.int8),
        "device_time_ns": np.repeat(1000 * table["t_us"], n) + within_ns,
        "host_time_ns": placed if blocks.segment in survey.clocks else np.full(total, UNKNOWN),
        "host_bound_ns": np.repeat(bounds, n),
        "flags": np.repeat(table["flags"].astype(np.int64), n),
    }
    for k, channel in enumerate(stream.channels):
        for title, values in _channel(counts[:, k], channel, f"channel{k + 1}"):
            columns[title if title not in columns else f"channel{k + 1}_{title}"] = values
    return columns


def _channel(counts: NDArray[np.int32], channel: Channel, unnamed: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Return counts, the converter's input, and the calibrated value in SI units."""
    name = _clean(channel.name) or unnamed
    yield f"{name}_counts", counts
    if channel.fault:
        return
    measured = volts(counts, channel)
    yield f"{name}_{_clean(channel.unit) or 'raw'}", measured
    if channel.length_unit is not None:
        yield f"{name}_m", extension(counts, channel)
    elif channel.poly:
        yield (
            f"{name}_{_clean(channel.calibrated_unit) or 'calibrated'}_calibrated",
            np.asarray(polyval(measured, channel.poly)),
        )


def _readings(
    pieces: Sequence[tuple[int, JointBatch]], joints: JointStream, units: Sequence[str], keys: list[JointBatch]
) -> Iterator[Batch]:
    """Yield the table of readings in order of arrival, by segment.

    ``keys``: a batch of no readings, with all keys so far.
    """
    if not pieces:
        return
    segment = np.concatenate([np.full(len(piece), number) for number, piece in pieces])
    batch = concatenate([*keys, *(piece for _, piece in pieces)])
    keys[:] = [batch[:0]]
    columns: Columns = {
        "arrival_ns": batch.arrival_ns,
        "host_time_ns": joints.to_host_ns(segment, batch.t),
        "segment": segment,
        "controller_time_s": batch.t,
        "seq": np.where(batch.seq == UNNUMBERED, UNKNOWN, batch.seq),
        **_joints(batch.q, units),
    }
    for key in OPTIONAL:
        values = batch.columns.get(key)
        if values is not None and key in _TITLES:
            titles = [_TITLES[key].format(j, unit, _TORQUE.get(unit, unit)) for j, unit in enumerate(units, start=1)]
            columns |= zip(titles, values.T, strict=True)
        elif values is not None:
            columns[key] = np.where(values == NO_INPUTS, np.nan, values) if key == "inputs" else values
    yield "joints", columns


def _clean(text: str) -> str:
    """Return an untrusted name as part of a title."""
    return re.sub(r"[^A-Za-z0-9_/°µ-]+", "_", text)[:32]


def plan_columns(survey: Survey, joint_units: Sequence[str] = ()) -> Columns | None:
    """Return the plan's rows as recorded, including via points and lines; None if there are none.

    ``pose`` is the number that dwells and passes refer to.
    """
    rows = survey.marks.rows
    if not rows:
        return None
    q = np.array([row.q for row in rows])
    units = tuple(joint_units) if len(joint_units) == q.shape[1] else ("rad",) * q.shape[1]
    return {
        "pose": np.array([row.number for row in rows]),
        "move": np.array([row.move for row in rows], dtype=np.str_),
        **_joints(q, units),
        **_mounted([row.mounted for row in rows], ("shell", *BAR_MOUNTED, *LINE_MOUNTED)),
    }


def dwell_columns(survey: Survey, dwells: Sequence[Dwell], joint_units: Sequence[str] = ()) -> Columns:
    """Return one row per dwell; those without an observation have a reason."""
    units = tuple(joint_units) or ("rad",) * len(survey.joints.step)
    return {
        "dwell": np.arange(1, len(dwells) + 1),
        "reason": _of(dwells, "reason", np.str_),
        "detail": _of(dwells, "detail", np.str_),
        "host_start_ns": _of(dwells, "start_host_ns", int),
        "host_end_ns": _of(dwells, "end_host_ns", int),
        "segment": _of(dwells, "segment", int),
        "controller_start_s": _of(dwells, "start_s"),
        "controller_end_s": _of(dwells, "end_s"),
        "settling_s": _of(dwells, "start_s") - _of(dwells, "stood_s"),
        "pose": _poses(dwells),
        **_mounted([dwell.mounted for dwell in dwells], ("shell", *BAR_MOUNTED)),
        "readings": _of(dwells, "n_readings", int),
        "samples": _of(dwells, "n_samples", int),
        "value_m": _of(dwells, "value"),
        "sigma_m": _of(dwells, "sigma"),
        "noise_m": _of(dwells, "noise"),
        "drift_m": _of(dwells, "drift"),
        "samples_effective": _of(dwells, "n_eff"),
        "clock_bound_ns": _of(dwells, "clock_bound_ns"),
        **_joints(np.array([dwell.q for dwell in dwells]).reshape(len(dwells), len(units)), units),
    }


def pass_columns(passes: Sequence[LinePass]) -> Columns:
    """Return one row per motion along a line; those that gave no rows have a reason.

    ``noise``: standard deviation of single samples about the motion.
    """
    legs = [line_pass.leg for line_pass in passes]
    noise = np.array([line_pass.noise for line_pass in passes]).reshape(len(passes), 3)

    def tally(dropped: Mapping[str, int]) -> str:
        return ", ".join(f"{count} {reason}" for reason, count in dropped.items())

    return {
        "pass": np.arange(1, len(passes) + 1),
        "reason": _of(passes, "reason", np.str_),
        "host_start_ns": _of(legs, "start_host_ns", int),
        "host_end_ns": _of(legs, "end_host_ns", int),
        "segment": _of(legs, "segment", int),
        "controller_start_s": _of(legs, "start_s"),
        "controller_end_s": _of(legs, "end_s"),
        "pose": _poses(passes),
        **_mounted([line_pass.mounted for line_pass in passes], LINE_MOUNTED),
        "direction": _of(passes, "direction", int),
        "speed_m_s": _of(passes, "speed"),
        "points": np.array([len(line_pass.table) for line_pass in passes], dtype=np.int64),
        "points_dropped": np.array([sum(line_pass.dropped.values()) for line_pass in passes], dtype=np.int64),
        "dropped": np.array([tally(line_pass.dropped) for line_pass in passes], dtype=np.str_),
        "window_s": 2e-9 * _of(passes, "window_ns"),
        "samples": _of(passes, "n_samples", int),
        **{f"noise_{axis}_m": noise[:, k] for k, axis in enumerate("xyz")},
        "correlation_s": _of(passes, "correlation_s"),
        "joint_noise_si": np.array([line_pass.q_noise.max(initial=0.0) for line_pass in passes]),
        "time_sigma_s": _of(passes, "time_sigma_s"),
        "clock_bound_ns": _of(passes, "clock_bound_ns"),
    }


def rows_of(columns: Columns) -> list[dict[str, Any]]:
    """Return dwells or passes as one mapping per row, whose ``pose`` is None if it is unknown."""
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    entries = (dict(zip(columns, row, strict=True)) for row in rows)
    return [{**entry, "pose": None if entry["pose"] == UNKNOWN else entry["pose"]} for entry in entries]


def _of(items: Sequence[object], name: str, kind: type = float) -> NDArray[Any]:
    return np.array([getattr(item, name) for item in items], dtype=kind)


def _poses(items: Sequence[Dwell] | Sequence[LinePass]) -> NDArray[np.int64]:
    return np.array([UNKNOWN if item.pose is None else item.pose for item in items], dtype=np.int64)


def _mounted(mountings: Sequence[dict[str, str]], keys: Sequence[str]) -> Columns:
    return {key: np.array([mounted.get(key, "") for mounted in mountings], dtype=np.str_) for key in keys}


def _joints(q: NDArray[np.float64], units: Sequence[str]) -> Columns:
    return {f"q{j}_{unit}": q[:, j - 1] for j, unit in enumerate(units, start=1)}
