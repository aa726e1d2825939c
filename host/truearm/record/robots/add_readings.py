"""Add joint readings recorded elsewhere to a session: a new file is written, the old one is left unchanged.

The arrival of such readings was not observed. Their host times are computed from the controller's time alone, which the
user describes in one of two ways. Either it is UTC, and the session's two anchors relate UTC to the host's clock; or it
was zero a given number of seconds after the session began. The host time becomes the message's time. Readers of the
session recognise these readings by ``"arrival": false`` in each line and by the metadata ``joints-added``. An error of
the host time is common to all readings. Dwells are insensitive to it up to their settling time; motion is not.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from operator import attrgetter
from pathlib import Path

from truearm.errors import Argument, InputError, SessionError
from truearm.record.robots.sources import AddedReading
from truearm.record.session_schemas import ROBOT_PREVIEW
from truearm.record.session_writer import Anchor, SessionWriter, copy_head, read_anchor
from truearm.session.joint_format import JOINTS, READINGS
from truearm.session.session_file import Session
from truearm.types import Message
from truearm.units import NS

ANCHORS = ("session", "session-end")
OWN = (JOINTS, READINGS, ROBOT_PREVIEW)  # topics of a session's readings
MAX_NS = 2**63
MAX_RATE = 1e-3  # if host clock and UTC differ by more, the clock was set in between: only the first anchor is used


class Anchors:
    """The clock of a copied session: the old anchors, and no time of its own."""

    def __init__(self, session: Session) -> None:
        self.kind = session.metadata.get("session", {}).get("clock", "monotonic")
        anchors = [anchor for name in ANCHORS if (anchor := read_anchor(session.metadata.get(name, {}))) is not None]
        if not anchors:
            raise SessionError(
                f"{session.path}: does not say when it was recorded; is this a session of truearm record?"
            )
        self.first, self.last = anchors[0], anchors[-1]
        self._next = self.first

    def now_ns(self) -> int:
        return self.first[1]

    def utc_anchor(self) -> Anchor:
        """Return the first anchor at the first call and the last one afterwards, as the writer writes them."""
        anchor, self._next = self._next, self.last
        return anchor

    def host_ns(self, utc_ns: int) -> int:
        """Return the host time at a UTC time, by linear interpolation between the anchors."""
        (utc, host), (utc_end, host_end) = self.first, self.last
        span, host_span = utc_end - utc, host_end - host
        since = utc_ns - utc
        if span > 0 and abs(host_span - span) <= MAX_RATE * span:
            since += since * (host_span - span) // span
        return host + since


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
    anchors = Anchors(session)
    begin_ns, end_ns = _span(session, replace)
    zero_ns = anchors.host_ns(0) if zero_s is None else begin_ns + round(NS.of(zero_s))
    count = inside = 0

    def added() -> Iterator[Message]:
        nonlocal count, inside
        for reading in readings:
            t_ns = round(NS.of(reading.t))
            host_ns = anchors.host_ns(t_ns) if zero_s is None else zero_ns + t_ns
            if not 0 <= host_ns < MAX_NS:
                raise _outside(reading.t, zero_s)
            count += 1
            inside += begin_ns <= host_ns <= end_ns
            yield Message(JOINTS, host_ns, reading.line)

    with SessionWriter(out, anchors) as writer:
        copy_head(session, writer, without="session")  # it was written with the first anchor
        old = (m for m in session.messages() if not (replace and m.topic in OWN))
        for message in heapq.merge(old, added(), key=attrgetter("t_host_ns")):
            writer.add(message.topic, message.t_host_ns, message.data)
        if not inside:
            raise _outside(None, zero_s)
        writer.metadata("joints-added", {**note, "readings": str(count)})
        end = session.metadata.get("session-end", {})
        writer.close({key: value for key, value in end.items() if key not in ("utc_ns", "monotonic_ns")})
    return count


def _outside(t: float | None, zero_s: float | None) -> InputError:
    subject = "no reading lies" if t is None else f"the reading at {t:g} s does not lie"
    zero = Argument("zero")
    remedy = (
        (
            "if the controller's time is not UTC, give the time of the session at which the controller's time was 0 with ",
            zero,
        )
        if zero_s is None
        else ("is ", zero, " right?")
    )
    return InputError(f"{subject} within the session; ", *remedy)


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
