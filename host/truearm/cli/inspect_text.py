"""The tables of ``truearm inspect --details``, from the document that ``--json`` prints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Table

from truearm.cli.findings_text import table_of
from truearm.session.dwells import MOUNTING
from truearm.text import counted, one_line
from truearm.types import BAR_MOUNTED
from truearm.units import MM_S, ONE, UM, URAD, Scale

Rows = Sequence[Mapping[str, Any]]

MOST_ROWS = 24  # of a table of dwells or passes
TOPICS = ("topic", "messages", "rate/Hz", "longest gap/s", "bytes")
STREAMS = ("stream", "channels ", "samples", "nominal/Hz", "by box/Hz", "by host/Hz", "pieces")
DWELLS = ("dwell", "robot time/s", "settling/s", "used/s", "pose", "mounted ", "rejected ")
PASSES = ("pass", "robot time/s", "mm/s", "points", "noise x, y, z/µm", "joints/µrad", "line ", "rejected ")


def tables(document: Mapping[str, Any]) -> Iterator[Table | str]:
    """Return topics, streams, the box's text, dwells and passes.

    Names from the file have their control characters made visible; console text has so already.
    """
    yield table_of(TOPICS, (_topic(name, topic) for name, topic in document["topics"].items()))
    if document["streams"]:
        yield table_of(STREAMS, map(_stream, document["streams"]))
    runs = document["console"]
    yield from (f"  | {line}" for run in runs for line in run.splitlines())
    if document["losses"]["console_runs"] > len(runs):
        yield f"  | … {document['losses']['console_runs'] - len(runs)} more"
    for titles, make, rows in (
        (DWELLS, _dwell, document["dwells"]["table"]),
        (PASSES, _pass, document["passes"]["table"]),
    ):
        shown = rows if len(rows) <= MOST_ROWS else [row for row in rows if row["reason"] not in ("", MOUNTING)]
        if shown:
            yield table_of(titles, map(make, shown[:MOST_ROWS]))
        if len(shown) > MOST_ROWS:
            yield f"… {len(shown) - MOST_ROWS} more; --json has all"


def _topic(name: str, topic: Mapping[str, Any]) -> tuple[object, ...]:
    rate = _number(topic["rate_hz"], ".2f")
    return one_line(name), topic["messages"], rate, f"{topic['longest_silence_s']:.3f}", topic["bytes"]


def _stream(stream: Mapping[str, Any]) -> tuple[object, ...]:
    rates = (_number(stream[f"rate_{name}_hz"], ".4f") for name in ("nominal", "measured", "by_host"))
    name, channels = one_line(stream["name"]), one_line(", ".join(stream["channels"]))
    return name, channels, stream["samples"], *rates, stream["pieces"]


def _dwell(row: Mapping[str, Any]) -> tuple[object, ...]:
    mounted = " ".join(row[key] for key in BAR_MOUNTED if key in row)
    times = f"{row['t_robot_s']:.1f}", f"{row['settling_s']:.2f}", f"{row['used_s']:.2f}"
    reason = f"{row['reason']}: {row['detail']}" if row["detail"] else row["reason"]
    return row["dwell"], *times, "-" if row["pose"] is None else row["pose"], one_line(mounted) or "-", one_line(reason)


def _pass(row: Mapping[str, Any]) -> tuple[object, ...]:
    noise = " ".join(_number(value, ".1f", UM) for value in row["noise_m"])
    joints = _number(max(row["joint_noise"], default=None), ".1f", URAD)
    direction = {1: ", y increases", -1: ", y decreases"}.get(row["direction"], "")
    dropped = "".join(f", {counted(count, 'point')} not made: {reason}" for reason, count in row["dropped"].items())
    figures = f"{row['t_robot_s']:.1f}", _number(row["speed_m_s"], ".1f", MM_S), row["points"], noise, joints
    return row["pass"], *figures, one_line(row["line"]) + direction, row["reason"] + dropped


def _number(value: float | None, form: str, scale: Scale = ONE) -> str:
    return "-" if value is None else format(scale.of(value), form)
