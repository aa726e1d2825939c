"""Add joint readings recorded elsewhere to a session: a new file is written, the old one is left unchanged.

The arrival of such readings was not observed. Their host times are computed from the controller's time alone, which the
user describes in one of two ways. Either it is UTC, and the session's two anchors relate UTC to the host's clock; or it
was zero a given number of seconds after the session began. The host time becomes the message's time. Readers of the
session recognise these readings by ``"arrival": false`` in each line and by the metadata ``joints-added``. An error of
the host time is common to all readings. Dwells are insensitive to it up to their settling time; motion is not.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping
from operator import attrgetter
from pathlib import Path

from truearm.errors import Argument, InputError, SessionError
from truearm.record.robots.sources import AddedReading
from truearm.record.session_schemas import ROBOT_PREVIEW
from truearm.record.session_writer import SessionWriter, copy_head, read_anchor
from truearm.session.joint_format import JOINTS, READINGS
from truearm.session.session_file import Session
from truearm.types import Message
from truearm.units import NS

ANCHORS = ("session", "session-end")
OWN = (JOINTS, READINGS, ROBOT_PREVIEW)  # topics of a session's readings
MAX_NS = 2**63
MAX_RATE = 1e-3  # if host clock and UTC differ by more, the clock was set in between: only the first anchor is used


def host_time(session: Session) -> Callable[[int], int]:
    """Return the function from UTC to host times [ns] of a session, linear between its two anchors. Raises SessionError."""
    anchors = [anchor for name in ANCHORS if (anchor := read_anchor(session.metadata.get(name, {}))) is not None]
    if not anchors:
        raise SessionError(f"{session.path}: does not say when it was recorded; is this a session of truearm record?")
    (utc, host), (utc_end, host_end) = anchors[0], anchors[-1]
    span, host_span = utc_end - utc, host_end - host
    is_steady = span > 0 and abs(host_span - span) <= MAX_RATE * span

    def host_ns(utc_ns: int) -> int:
        since = utc_ns - utc
        return host + since + (since * (host_span - span) // span if is_steady else 0)

    return host_ns


def add_readings(
    session: Session,
    readings: Iterator[AddedReading],
    out: Path,
    zero_s: float | None,
    note: Mapping[str, str],
    replace: bool = False,
) -> int:
    """Write ``out`` with everything in ``session`` and the readings; return the number of readings.

    ``zero_s``: when, after the session's begin, the controller's time was zero; None: it is UTC. ``note`` becomes
    metadata. With ``replace`` the session's own readings are left out; without it there must be none.

    Raises SessionError if there are some, or if a file is damaged; InputError if no reading lies within the session.
    """
    host_ns_of = host_time(session)
    begin_ns, end_ns = _span(session, replace)
    zero_ns = 0 if zero_s is None else begin_ns + round(NS.of(zero_s))
    count = inside = 0

    def added() -> Iterator[Message]:
        nonlocal count, inside
        for reading in readings:
            t_ns = round(NS.of(reading.t))
            host_ns = host_ns_of(t_ns) if zero_s is None else zero_ns + t_ns
            if not 0 <= host_ns < MAX_NS:
                raise _outside(f"the reading at {reading.t:g} s does not lie")
            count += 1
            inside += begin_ns <= host_ns <= end_ns
            yield Message(JOINTS, host_ns, reading.line)

    with SessionWriter(out, None) as writer:
        copy_head(session, writer)
        old = (m for m in session.messages() if not (replace and m.topic in OWN))
        for message in heapq.merge(old, added(), key=attrgetter("t_host_ns")):
            writer.add(message.topic, message.t_host_ns, message.data)
        if not inside:
            raise _outside("no reading lies")
        writer.metadata("joints-added", {**note, "readings": str(count)})
        writer.close(session.metadata.get("session-end"))
    return count


def _outside(subject: str) -> InputError:
    zero = Argument("zero")
    return InputError(
        f"{subject} within the session; is ", zero, " right? Without ", zero, ", the controller's time is taken as UTC"
    )


def _span(session: Session, replace: bool) -> tuple[int, int]:
    """Return the first and last host time of the session's messages. Raises SessionError if they include readings."""
    begin_ns, end_ns = MAX_NS, -1
    for message in session.messages():
        if message.topic in OWN and not replace:
            raise SessionError(
                f"{session.path}: has joint readings already; give ",
                *(Argument("replace"), " to replace them in the new file"),
            )
        begin_ns, end_ns = min(begin_ns, message.t_host_ns), max(end_ns, message.t_host_ns)
    if end_ns < 0:
        raise SessionError(f"{session.path}: contains no messages; give a session of truearm record")
    return begin_ns, end_ns
