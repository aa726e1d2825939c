"""Read observations from a session file: the interface between the file (record) and its evaluation (sync).

Also its samples and joint readings as arrays, and the possible effect of temperature on its lengths.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from truearm.box.condition import FAR, LVDT, LVDT_DRIFT, STEEL
from truearm.errors import Argument, InputError, RigError, SessionError
from truearm.findings import Finding
from truearm.session.labels_file import read_labels
from truearm.text import counted, one_line, page
from truearm.types import DOUBTFUL, Floats
from truearm.units import MM, PPM_PER_K
from truearm.workflows.session_parts import SUFFIX, open_finished

if TYPE_CHECKING:
    from truearm.session.observations import Survey, SyncResult
    from truearm.session.session_file import Session, Source
    from truearm.session.session_tables import Columns
    from truearm.types import BallBar, Plan, Rig

RIG = "rig.toml"
MOST_PLACES = 3  # of damage that are reported; inspect lists all


def reasons_text(rejected: Mapping[str, int]) -> str:
    """Return ``3 gap, 1 rail``."""
    return ", ".join(f"{n} {reason}" for reason, n in sorted(rejected.items()))


def nothing_observed(path: Path, dwells: Mapping[str, int], passes: Mapping[str, int], planned: bool) -> SessionError:
    """Return the error of a session that gave no observation: why not, and which command helps.

    ``dwells`` and ``passes`` along lines: the rejected ones by reason. ``planned``: the session has a plan.
    """
    from truearm.session.dwells import needs_decision

    kinds = (("dwell", "dwells", dwells), ("motion along a line", "motions along a line", passes))
    rejected = [
        f"{counted(sum(reasons.values()), *nouns)} ({reasons_text(reasons)})" for *nouns, reasons in kinds if reasons
    ]
    undecided = sum(n for reason, n in dwells.items() if needs_decision(reason, planned))
    others = sum(dwells.values()) + sum(passes.values()) - undecided
    # One wrong label is a slip of the operator. If no reading fits its label, the prediction is wrong.
    helps = {"none_fits": set(dwells) == {DOUBTFUL}, "others": undecided and others, "unexplained": not undecided}
    file = shlex.quote(one_line(str(path)))
    return SessionError(
        "no-observation", place=path, rejected=" and ".join(rejected), undecided=undecided, file=file, **helps
    )


def is_session(path: Path) -> bool:
    """Return whether a file's name is that of a session."""
    return path.suffix.lower() == SUFFIX


def attached_rig(session: Session, path: Path) -> Rig | None:
    """Return the rig given to the recorder, None if there was none. Raises RigError if it is not a valid rig."""
    from truearm.kinds.rig_file import parse_rig

    data = session.attachments.get(RIG)
    if data is None:
        return None
    try:
        return parse_rig(data.decode(), f"{path}: {RIG}")
    except UnicodeDecodeError as exc:
        raise RigError(f"{path}: {RIG} is not UTF-8 text; give the rig file with the argument rig") from exc


def recorded_rig(session: Session, path: Path) -> Rig:
    """Return the rig given to the recorder. Raises RigError if there was none, or if it is not a valid rig."""
    rig = attached_rig(session, path)
    if rig is None:
        raise RigError("no-rig", place=path)
    return rig


def paired(session: Session, survey: Survey, rig: Rig | None = None) -> SyncResult:
    """Return the observations of a survey, by the recorded rig if none is given. Raises InputError if there are none."""
    from truearm.session.observations import observations

    rig = rig or attached_rig(session, session.path)
    if rig is None:
        raise InputError(
            "the session was recorded without a rig; truearm identify and truearm session export take one with --rig"
        )
    return observations(survey, rig, session.path.name, labels=read_labels(session.path))


def surveyed(session: Session, messages: Source | None = None) -> Survey:
    """Return the survey of a session, or of other ``messages`` with what it recorded of box and host clock. Raises SessionError."""
    from truearm.session.box_ident import recorded_ident
    from truearm.session.clock import recorded_wander
    from truearm.session.observations import survey

    return survey(messages or session.batches, recorded_ident(session), wander=recorded_wander(session))


def observations_of_session(
    session: Session,
    rig: Rig | None = None,
    *,
    may_be_empty: bool = False,
    line_points: int | None = None,
    plan: Plan | None = None,
) -> SyncResult:
    """Make observations from a session. ``rig`` and ``plan`` replace the recorded ones.

    ``may_be_empty``: it need not give an observation, as a part of a session. ``line_points``: maximum number per pass
    along a line. Raises SessionError if it gives no observation, RigError if there is no rig.
    """
    from truearm.session.observations import observations

    path = session.path
    rig = rig or recorded_rig(session, path)
    labels = read_labels(path)
    try:
        read = surveyed(session)
        if plan is not None:
            read = replace(read, marks=read.marks.with_plan(plan))
        result = observations(read, rig, path.name, line_points, labels)
    except (RigError, SessionError) as exc:
        if str(exc).startswith(str(path)):
            raise
        raise exc.within(path) from exc
    if not len(result.table) and not may_be_empty:
        planned = result.survey.marks.plan() is not None
        raise nothing_observed(path, result.reasons, result.pass_reasons, planned)
    return result


def damage_findings(session: Session) -> list[Finding]:
    """Return the first damaged places of a session of which the intact parts are used."""
    from truearm.report.session_findings import damage_finding

    values = {"place": str(session.path), "more": max(len(session.damage) - MOST_PLACES, 0)}
    return [damage_finding({**vars(damage), **values}) for damage in session.damage[:MOST_PLACES]]


def reading_findings(session: Session, result: SyncResult, rig: Rig) -> list[Finding]:
    """Return what is noticed while the observations of a session are made."""
    named, n = {"place": str(session.path)}, result.survey.losses.plan_events_malformed
    malformed = [Finding("malformed-plan", {**named, "plan_events_malformed": n})] if n else []
    return [*damage_findings(session), *malformed, *_other_temperature(result, rig, str(session.path))]


COUNTS = "_counts"


def channel_samples(paths: Sequence[Path], channel: str, allow_damaged: bool = False) -> tuple[Floats, Floats]:
    """Return the host times (n,) [s] and the values (n,) of a channel of the box.

    A value is a length [m] or in the channel's calibrated unit, or without a calibration what the converter measured,
    usually [V]. Raises InputError, naming the channels of the session, if it does not have this one.
    """
    channels: dict[str, None] = {}
    times, values = [np.zeros(0)], [np.zeros(0)]
    for t, columns in _tables("box_", paths, allow_damaged):
        channels |= dict.fromkeys(title.removesuffix(COUNTS) for title in columns if title.endswith(COUNTS))
        if channel + COUNTS in columns:
            titles = [title for title in columns if title.startswith(f"{channel}_") and title != channel + COUNTS]
            ranks = {title: (not title.endswith("_m"), not title.endswith("_calibrated")) for title in titles}
            times.append(t)
            values.append(columns[min(titles, key=ranks.__getitem__, default=channel + COUNTS)].astype(float))
    if channel not in channels:
        names = ", ".join(sorted(channels)) or "none"
        raise InputError(Argument("channel"), f": the session has no samples of {channel!r}; its channels are {names}")
    return np.concatenate(times), np.concatenate(values)


def joint_readings(paths: Sequence[Path], allow_damaged: bool = False) -> tuple[Floats, Floats]:
    """Return the host times (n,) [s] and the joint readings (n, j) [rad, m] of a session."""
    times, readings = [], []
    for t, columns in _tables("joints", paths, allow_damaged):
        times.append(t)
        joints = [column for title, column in columns.items() if title[:1] == "q" and title[1:2].isdigit()]
        readings.append(np.column_stack(joints))
    if not times:
        raise InputError("no-joint-readings", place=paths[0])
    return np.concatenate(times), np.concatenate(readings)


def _tables(kind: str, paths: Sequence[Path], allow_damaged: bool) -> Iterator[tuple[Floats, Columns]]:
    """Yield parts of a kind of table: host times [s], as in an ObservationTable, NaN where unknown, and all columns."""
    from truearm.session.clock import UNKNOWN
    from truearm.session.session_tables import tabulate

    for path in paths:
        for name, columns in tabulate(surveyed(open_finished(path, allow_damaged))):
            if name.startswith(kind):
                time = columns["host_time_ns"]
                yield np.where(time == UNKNOWN, np.nan, 1e-9 * time), columns


def _other_temperature(result: SyncResult, rig: Rig, place: str) -> Iterator[Finding]:
    """Return the possible error of the lengths if the session was measured FAR from the box's temperature at which the
    ball-bar's channel was calibrated, and rows lack the bar's temperature.
    """
    table = result.table.select(result.table.kind == "ball_bar")
    streams = (stream for ident in result.survey.idents.values() for stream in ident.streams.values())
    channels = (channel for stream in streams for channel in stream.channels if channel.name == LVDT)
    noted = (channel.calibrated_degc for channel in channels if math.isfinite(channel.calibrated_degc))
    unread = ~np.isfinite(table.bar_temperature)
    warmer = table.temperature[unread] - next(noted, np.nan)
    largest = float(warmer[np.nanargmax(np.abs(warmer))]) if np.isfinite(warmer).any() else 0.0
    if abs(largest) < FAR:
        return
    bars = [rig.bars[name] for name in np.unique(table.bar[unread]).tolist() if name in rig.bars]
    bar = max(bars, key=lambda bar: possible_error(bar, largest))
    expansion, drift = coefficients(bar)
    lengths = {"error": possible_error(bar, largest), "length": bar.zero, "travel": 0.5 * bar.travel}
    values = {
        **{name: {"mm": MM.of(length)} for name, length in lengths.items()},
        **{"expansion": PPM_PER_K.of(expansion), "drift": PPM_PER_K.of(drift)},
        **{"place": place, "channel": LVDT, "difference": {"degc": abs(largest)}, "warmer": largest > 0.0},
    }
    yield Finding("other-temperature", {**values, "page": page("Build and measure the rig")})


def coefficients(bar: BallBar) -> tuple[float, float]:
    """Return the expansion of a bar and the drift of its sensor's gain [1/K] from the rig, or usual values."""
    return bar.expansion or STEEL, bar.gain_drift or LVDT_DRIFT


def possible_error(bar: BallBar, warmer: float) -> float:
    """Return the possible error of a length [m] if bar and sensor are warmer by these kelvins, at the end of the
    stroke.
    """
    expansion, drift = coefficients(bar)
    return abs(warmer) * (abs(expansion) * bar.zero + abs(drift) * 0.5 * bar.travel)
