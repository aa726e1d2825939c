"""Describe the contents of a session file as a document (``truearm inspect``)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from truearm.errors import InputError
from truearm.findings import entries
from truearm.progress import step
from truearm.report.session_findings import session_findings
from truearm.session.joint_format import parse_line
from truearm.session.session_tables import dwell_columns, pass_columns, rows_of
from truearm.text import one_line, without_nan
from truearm.types import Move
from truearm.units import NS, PPM
from truearm.workflows.recorded_session import paired, surveyed

if TYPE_CHECKING:
    from truearm.session.dwells import Dwell
    from truearm.session.line_passes import LinePass
    from truearm.session.observations import Survey
    from truearm.session.session_file import Messages, Session
    from truearm.types import Ints

CONSOLE_RUNS = 10  # displayed of the box's text
CONSOLE_BYTES = 400  # displayed of each run
SILENT_NS = 2_000_000_000  # a healthy box sends a heartbeat every second
GONE = (b'"link-lost"', b'"box-gone"')  # counted however short the silence was


class Contents:
    """Takes what only inspection wants of messages as they pass: their times, and the texts of box and robot."""

    def __init__(self) -> None:
        self.first_ns, self.last_ns = 2**63 - 1, 0
        self.console: list[bytes] = []  # the first texts of the box
        self.robot_bytes = 0  # of what is no joint reading
        self.other_joints = 0  # readings with a different number of joints, which the recorder did not accept
        self._box_ns: list[Ints] = []  # of the box's messages
        self._gone_ns: list[int] = []  # the recorder reported that it lost the box

    def watched(self, batches: Iterator[Messages]) -> Iterator[Messages]:
        """Yield the same messages; they are taken the first time."""
        is_first = not self._box_ns
        for messages in batches:
            if is_first:
                self._take(messages)
            yield messages

    def _take(self, messages: Messages) -> None:
        self.first_ns = int(messages.t_host_ns.min(initial=self.first_ns))
        self.last_ns = int(messages.t_host_ns.max(initial=self.last_ns))
        robot = messages.payloads(messages.rows("/robot/console".__eq__))
        self.robot_bytes += sum(map(len, robot))
        self.other_joints += sum(parse_line(line) is not None for line in robot)
        rows = messages.rows("/box/console".__eq__)[: CONSOLE_RUNS - len(self.console)]
        self.console += [data[:CONSOLE_BYTES] for data in messages.payloads(rows)]
        events = messages.rows("/events".__eq__).tolist()
        losses = [row for row in events if any(kind in messages.payload(row) for kind in GONE)]
        self._gone_ns += messages.t_host_ns[losses].tolist()
        self._box_ns.append(messages.t_host_ns[messages.rows(lambda topic: topic.startswith("/box/"))])

    @property
    def silences(self) -> list[tuple[int, int]]:
        """Return when the box sent nothing at all, as its link was lost or it hung: pairs of host times [ns].

        They are of the last message before and of the first one after, or of the session's last message.
        """
        t_ns = np.concatenate([*self._box_ns, [self.last_ns]]).astype(np.int64)
        steps_ns, losses = np.diff(t_ns), np.diff(np.searchsorted(self._gone_ns, t_ns))
        silent = np.flatnonzero((steps_ns > SILENT_NS) | ((losses > 0) & (steps_ns > 0)))
        return list(zip(t_ns[silent].tolist(), t_ns[silent + 1].tolist(), strict=True))


@step("inspecting the session")
def describe(session: Session) -> dict[str, Any]:
    """Return the contents of a session as a JSON-compatible document; unknown values are None.

    Raises SessionError if the file is damaged.
    """
    contents = Contents()
    survey = surveyed(session, lambda: contents.watched(session.batches()))
    document = {
        "file": str(session.path),
        "truncated": session.truncated,
        "damage": [asdict(damage) for damage in session.damage],
        "duration_s": max(NS.to_si(contents.last_ns - contents.first_ns), 0.0),
        "metadata": {
            key: session.metadata.get(key, {}) for key in ("session", "session-end", "joints-added", "recovered")
        },
        "attachments": sorted(session.attachments),
        "simulated": any(ident.simulated for ident in survey.idents.values()),
        "firmware": sorted({ident.firmware for ident in survey.idents.values()}),
        "streams": [_stream(stream, survey) for stream in survey.streams],
        "losses": asdict(survey.losses) | _silences(contents, survey),
        "console": [printable(data) for data in contents.console],
        "clock": [asdict(report) for report in survey.clock_reports],
        "temperature_degc": {
            "box": survey.temperature.extremes,
            "thermometers": {name: readings.extremes for name, readings in survey.thermometers.items()},
        },
        "robot": _robot(survey, contents),
        "events": survey.marks.kinds,
        "plan_poses": len(survey.marks.dwells),
        **_measured(session, survey),
    }
    document = without_nan(document)
    return {**document, "findings": entries(session_findings(document))}


def printable(data: bytes) -> str:
    """Return untrusted bytes as printable text; anything else as \\x.. escapes."""
    text = data.decode(errors="backslashreplace").replace("\r\n", "\n")
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def _stream(stream: Any, survey: Survey) -> dict[str, Any]:
    """Return rates by the box's own stamps, and by the host's clock if the exchanges relate the two."""
    ppm = survey.clock_reports[-1].rate_ppm if survey.clock_reports else math.nan
    by_host = NS.factor / (stream.measured_ns * (1.0 + PPM.to_si(ppm)))
    return {
        **asdict(stream),
        "rate_nominal_hz": NS.factor / stream.period_ns if stream.period_ns else None,
        "rate_measured_hz": NS.factor / stream.measured_ns,
        "rate_by_host_hz": by_host,
    }


def _silences(contents: Contents, survey: Survey) -> dict[str, Any]:
    """Return the times when nothing came from the box [s of the session], and the number of samples lost in them.

    After a silence the indices of the samples tell what is missing: a computer that slept receives everything late.
    They do not where the box began again, or the silence never ended; then it is what the box would have taken.
    """
    gaps, begin_ns, losses = contents.silences, contents.first_ns, survey.losses
    rate_hz = sum(NS.factor / stream.period_ns for stream in survey.streams if stream.period_ns)
    begun_again = losses.restarts or losses.starts
    ended_ns = sum(end - start for start, end in gaps if end < contents.last_ns and not begun_again)
    endless_ns = sum(end - start for start, end in gaps) - ended_ns
    counted = min(losses.samples_lost + losses.samples_overrun, round(NS.to_si(ended_ns) * rate_hz))
    return {
        "silences": [{"from_s": NS.to_si(a - begin_ns), "to_s": NS.to_si(b - begin_ns)} for a, b in gaps],
        "samples_missing": counted + round(NS.to_si(endless_ns) * rate_hz),
    }


def _robot(survey: Survey, contents: Contents) -> dict[str, Any]:
    """Return how many readings of the robot there are, what is wrong with them, and how their clock was related."""
    joints = survey.joints
    names = ("readings", "duplicated", "late", "lost", "gaps", "restarts", "rate_hz")
    return {
        **{name: getattr(joints, name) for name in names},
        "malformed": joints.malformed + contents.other_joints,
        "console_bytes": contents.robot_bytes,
        "joints": len(joints.step),
        "quantisation_rad": joints.step.tolist(),
        "clock": [asdict(report) for report in joints.reports],
        "note": "a constant latency from controller to host cannot be seen from arrivals",
    }


def _measured(session: Session, survey: Survey) -> dict[str, Any]:
    """Return dwells by the joint readings and passes along lines; with a rig also their outcome."""
    result, problem = None, ""
    try:
        result = paired(session, survey)
    except InputError as exc:  # reported like everything else about the file; the file itself was read to its end
        problem = one_line(str(exc))
    dwells = survey.dwells if result is None else result.dwells
    usable = [dwell for dwell in dwells if not dwell.reason]
    reasons = Counter(dwell.reason for dwell in dwells if dwell.reason)
    bounds = (dwell.clock_bound_ns for dwell in usable)
    return {
        "dwells": {
            "found": len(survey.dwells),
            "rejected": dict(sorted(reasons.items())) if result is None else result.reasons,
            "mountings": result.n_mountings if result else 0,
            "observations": len(usable) if result else None,
            "samples_used": result and result.samples_used,
            "clock_bound_ns": max(bounds, default=None) if result else None,
            "not_paired": problem or None,
            "table": _dwell_rows(survey, dwells),
        },
        "passes": {
            "planned": sum(row.move == Move.LINE for row in survey.marks.rows),
            "found": len(result.passes) if result else None,
            "rejected": result.pass_reasons if result else {},
            "points": sum(len(line_pass.table) for line_pass in result.passes) if result else None,
            "table": _pass_rows(result.passes) if result else [],
        },
    }


def _dwell_rows(survey: Survey, dwells: Sequence[Dwell]) -> list[dict[str, Any]]:
    """Describe every stop with the columns of ``session export``, and where and how long it is used."""
    return [
        {
            **row,
            "t_robot_s": dwell.stood_s,
            "used_s": 0.0 if dwell.reason else dwell.end_s - dwell.start_s,
            "length_m": dwell.value,
        }
        for row, dwell in zip(rows_of(dwell_columns(survey, dwells)), dwells, strict=True)
    ]


def _pass_rows(passes: Sequence[LinePass]) -> list[dict[str, Any]]:
    """Describe every pass with the columns of ``session export``, and by axis, joint and reason."""
    return [
        {
            **row,
            "t_robot_s": line_pass.leg.start_s,
            "noise_m": line_pass.noise.tolist(),
            "joint_noise": line_pass.q_noise.tolist(),
            "joint_error": line_pass.q_error,
            "dropped": line_pass.dropped,
        }
        for row, line_pass in zip(rows_of(pass_columns(passes)), passes, strict=True)
    ]
