"""Copy everything intact from a damaged or unfinished session to a new, complete one. The old file is only read.

Messages keep their time, their bytes and their number within their topic. Missing ones therefore show in the new file
too, as a jump of these numbers and of the counters of box and robot. Nothing is put in their place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from truearm.errors import SessionError
from truearm.record.session_writer import SessionWriter, copy_head
from truearm.session.frames import recorded_ident
from truearm.session.session_file import Damage, Session
from truearm.session.streams import BoxReader
from truearm.units import NS

IDENT = "/box/ident"  # the metadata repeat it once a minute: it is lost only with all copies


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
            for k, message in enumerate(messages.of(np.arange(len(messages)))):
                writer.add(*message, int(messages.sequence[k]))
            box.feed(messages)
        box.finish()
        losses = box.losses()
        topics = {
            topic: TopicAccount(saved[topic], max(0, end - saved[topic])) for topic, end in sorted(ends.items()) if end
        }
        if ident is not None and not losses.blocks_without_ident and IDENT in topics:
            topics[IDENT] = TopicAccount(saved[IDENT], 0)
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
