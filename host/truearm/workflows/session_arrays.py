"""Samples and joint readings of a session as arrays, for ``truearm.read_session``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from truearm.errors import Argument, InputError
from truearm.session.session_tables import UNKNOWN, Batch, Columns, tabulate
from truearm.types import Floats
from truearm.workflows.session_observations import surveyed
from truearm.workflows.session_parts import open_finished

COUNTS = "_counts"


def channel_samples(parts: Sequence[Path], channel: str, allow_damaged: bool = False) -> tuple[Floats, Floats]:
    """Return the host times (n,) [s] and the values (n,) of a channel of the box.

    A value is a length [m] or in the channel's calibrated unit, or without a calibration what the converter measured,
    usually [V]. Raises InputError, naming the channels of the session, if it does not have this one.
    """
    channels: dict[str, None] = {}
    times, values = [np.zeros(0)], [np.zeros(0)]
    for table, columns in _batches(parts, allow_damaged):
        if table.startswith("box_"):
            channels |= dict.fromkeys(title.removesuffix(COUNTS) for title in columns if title.endswith(COUNTS))
            if channel + COUNTS in columns:
                titles = [title for title in columns if title.startswith(f"{channel}_") and title != channel + COUNTS]
                times.append(_host_seconds(columns))
                values.append(columns[min(titles, key=_rank, default=channel + COUNTS)].astype(float))
    if channel not in channels:
        names = ", ".join(sorted(channels)) or "none"
        raise InputError(Argument("channel"), f": the session has no samples of {channel!r}; its channels are {names}")
    return np.concatenate(times), np.concatenate(values)


def joint_readings(parts: Sequence[Path], allow_damaged: bool = False) -> tuple[Floats, Floats]:
    """Return the host times (n,) [s] and the joint readings (n, j) [rad, m] of a session."""
    times, readings = [], []
    for table, columns in _batches(parts, allow_damaged):
        if table.startswith("joints"):
            q = [column for title, column in columns.items() if title[:1] == "q" and title[1:2].isdigit()]
            times.append(_host_seconds(columns))
            readings.append(np.column_stack(q))
    if not times:
        raise InputError("no-joint-readings", place=parts[0])
    return np.concatenate(times), np.concatenate(readings)


def _batches(parts: Sequence[Path], allow_damaged: bool) -> Iterator[Batch]:
    for part in parts:
        yield from tabulate(surveyed(open_finished(part, allow_damaged)))


def _rank(title: str) -> int:
    """Return how far a column of a channel is from a calibrated value."""
    return 0 if title.endswith("_m") else 1 if title.endswith("_calibrated") else 2


def _host_seconds(columns: Columns) -> Floats:
    """Return host times [s], as in an ObservationTable; NaN where unknown."""
    time = columns["host_time_ns"]
    return np.where(time == UNKNOWN, np.nan, 1e-9 * time)
