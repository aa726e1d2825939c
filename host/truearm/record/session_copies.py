"""Write a new session from another one: without its damage, or with joint readings recorded elsewhere.

The other one is only read.

A recovered session has everything intact of a damaged or unfinished one. Messages keep their time, their bytes and
their number within their topic. Missing ones therefore show in the new file too, as a jump of these numbers and of the
counters of box and robot. Nothing is put in their place.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np

from truearm.errors import Argument, InputError, SessionError
from truearm.record.robots.sources import AddedReading
from truearm.record.session_writer import ROBOT_PREVIEW, SessionWriter, read_anchor
from truearm.session.frames import recorded_ident
from truearm.session.joint_format import JOINTS, READINGS
from truearm.session.session_file import CHANNELS, Damage, Session
from truearm.session.streams import BoxReader
from truearm.types import Message
from truearm.units import NS

IDENT_TOPIC = "/box/ident"  # the metadata repeat it once a minute: it is lost only with all copies


@dataclass(frozen=True)
class TopicAccount:
    """Messages of one topic. ``lost`` of them are known to be missing, by their numbers or by the end of the file.

    If a recording was cut off, it is not known what followed.
    """

    saved: int
    lost: int


@dataclass(frozen=True)
class Recovered:
    """Result of a recovery. ``seconds`` is the time from the first to the last recovered message.

    ``unread_bytes`` are not in any complete record. ``cut_off``: the end of the file is missing. ``samples`` of the
    streams can be evaluated; ``undescribed`` frames of samples cannot, because the box's ident is lost.
    """

    topics: dict[str, TopicAccount]
    damage: tuple[Damage, ...]
    cut_off: bool
    unread_bytes: int
    seconds: float
    attachments: tuple[str, ...] = ()
    samples: int = 0
    undescribed: int = 0


def recover(session: Session, out: Path, note: Mapping[str, str]) -> Recovered:
    """Write ``out``, a complete session, from one that was opened with ``allow_damaged``.

    ``note`` goes to metadata ``recovered``. Raises InputError if ``out`` exists or cannot be created, TruearmError if
    it cannot be written, SessionError if the damaged file changes while it is read.
    """
    saved, ends = Counter[str](), Counter[str](session.counted)  # messages, by the numbers from 0 on of the writer
    first_ns, last_ns = 2**63 - 1, 0
    ident = None
    with suppress(SessionError):
        ident = recorded_ident(session)
    box = BoxReader(ident)
    with SessionWriter(out, None) as writer:
        copy_head(session, writer)
        for messages in session.batches():
            for topic in messages.topics:
                numbers = messages.sequence[messages.rows(topic.__eq__)]
                saved[topic] += len(numbers)
                ends[topic] = max(ends[topic], int(numbers.max(initial=-1)) + 1)
            first_ns = int(messages.t_host_ns.min(initial=first_ns))
            last_ns = int(messages.t_host_ns.max(initial=last_ns))
            for k, message in enumerate(messages.one_by_one(np.arange(len(messages)))):
                writer.add(*message, int(messages.sequence[k]))
            box.feed(messages)
        box.finish()
        losses = box.losses()
        topics = {
            topic: TopicAccount(saved[topic], max(0, end - saved[topic])) for topic, end in sorted(ends.items()) if end
        }
        if ident is not None and not losses.blocks_without_ident and IDENT_TOPIC in topics:
            topics[IDENT_TOPIC] = TopicAccount(saved[IDENT_TOPIC], 0)
        recovered = Recovered(
            topics=topics,
            damage=session.damage,
            cut_off=session.truncated,
            unread_bytes=session.unread_bytes,
            seconds=NS.to_si(max(0, last_ns - first_ns)),
            attachments=tuple(session.attachments),
            samples=losses.samples,
            undescribed=losses.blocks_without_ident,
        )
        entries = {
            "cut_off": str(recovered.cut_off).lower(),
            "unread_bytes": str(recovered.unread_bytes),
            "messages_saved": str(saved.total()),
            "messages_lost": str(sum(account.lost for account in topics.values())),
            "damaged_at": " ".join("?" if damage.at is None else str(damage.at) for damage in recovered.damage),
        }
        writer.metadata("recovered", {**note, **entries})
        writer.close(session.metadata.get("session-end"))
    return recovered


def copy_head(session: Session, writer: SessionWriter) -> None:
    """Copy metadata and attachments, except what the writer writes itself."""
    for name, entries in session.metadata.items():
        if name not in ("session-end", CHANNELS):
            writer.metadata(name, entries)
    for name, data in session.attachments.items():
        writer.attach(name, data)


# ---------------------------------------------------------------------------------------- joint readings from elsewhere

ANCHORS = ("session", "session-end")
OWN = (JOINTS, READINGS, ROBOT_PREVIEW)  # topics of a session's readings
MAX_NS = 2**63
MAX_RATE = 1e-3  # if host clock and UTC differ by more, the clock was set in between: only the first anchor is used


def host_time(session: Session) -> Callable[[int], int]:
    """Return the function from UTC to host times [ns] of a session, linear between its two anchors.

    Raises SessionError.
    """
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

    Their arrival was not observed: host times, which become those of the messages, are computed from the controller's
    time alone, an error of which is common to all readings. Dwells are insensitive to it up to their settling time;
    motion is not. Readers recognise these readings by ``"arrival": false`` in each line and by the metadata
    ``joints-added``.

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
