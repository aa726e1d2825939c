"""Store what a box sends, exactly and in order, then evaluate it.

Only what the recording itself needs is evaluated: the ident (for the streams' names, the boot id and faults), answers to
commands, clock exchanges, and ``seq`` for counting losses. This takes about 9 µs per data frame, 5 of them for the file.

A box that restarts shows a new boot id in its ident or heartbeat, or its frame count steps back. After the latter,
``suspect`` asks the recorder to have the box identify itself, and its boot id decides.

**Clock exchanges.** t0 is the host time before the request was handed over, t3 the arrival of the reply; the box's t1 and t2
lie between them (SPEC §4). A request without an answer within 2 s becomes a row with nulls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from truearm.errors import ProtocolError
from truearm.record.frame_splitter import FrameCount, FrameSplitter
from truearm.record.operator import Counters, Operator
from truearm.record.requests import Requests
from truearm.record.session_schemas import PREVIEW, PREVIEW_NS
from truearm.record.session_writer import SessionWriter
from truearm.session.frames import Data, Ident, Stream, conforms, data_of, named_elements
from truearm.session.samples import counts_of, shown
from truearm.units import MDEGC
from truearm_wire.messages import DATA, ERROR, EVENT, HEARTBEAT, IDENT, REPLY, SYNC_REPLY, TEMPERATURE

SYNC_TIMEOUT_NS = 2_000_000_000


_TOPICS = {
    EVENT: "/box/event",
    TEMPERATURE: "/box/temperature",
    HEARTBEAT: "/box/heartbeat",
    IDENT: "/box/ident",
    SYNC_REPLY: "/box/sync",
    REPLY: "/box/reply",
    ERROR: "/box/reply",
}
_BEAT_WRAP = 2**30  # of a heartbeat's counters
_LARGEST_UNNAMED_STREAM = 255


@dataclass
class BoxStorage:
    """The box's side of a recording. ``requests`` takes the answers to commands."""

    writer: SessionWriter
    counters: Counters
    requests: Requests
    operator: Operator = field(default_factory=Operator)
    suspect: bool = False  # the box may have restarted
    restarted: bool = False  # it has
    idle: int = 0  # heartbeats in a row that say that it does not stream
    heard_ns: int | None = None  # time of its last message, or since when it could be heard again
    spoke_ns: int | None = None  # time of its last message
    rtt_us: float | None = None  # the shortest clock exchange, without the time within the box
    _asked_ns: dict[int, int] = field(default_factory=dict)  # t0 of the clock requests without an answer, by id
    _frame_count: FrameCount = field(default_factory=FrameCount)
    _beats: dict[int, tuple[int, int]] = field(default_factory=dict)  # last dropped and overruns, by boot
    _next_preview_ns: dict[int, int] = field(default_factory=dict)  # by stream
    _splitter: FrameSplitter = field(default_factory=FrameSplitter)

    def take(self, t_host_ns: int, data: bytes) -> None:
        """Store and evaluate bytes that arrived. Raises ProtocolError for an ident that cannot be used."""
        # A traceback waits for the next delimiter, which may arrive with the next boot: use the time at which the text
        # itself ended.
        t_console_ns = t_host_ns if self.heard_ns is None or data[:1] != b"\0" else self.heard_ns
        self.heard_ns = self.spoke_ns = t_host_ns
        for frame, item in self._splitter.push(data):
            if frame is not None:
                self._take_frame(t_host_ns, frame, item)
            else:
                self._take_console(t_console_ns, item)
            t_console_ns = t_host_ns

    def flush(self) -> None:
        """Store what follows the last delimiter: the stream has ended or was cut."""
        if (remainder := self._splitter.flush()) and self.heard_ns is not None:
            self._take_console(self.heard_ns, remainder)

    @property
    def ident(self) -> Ident | None:
        """The box's latest description of itself."""
        return self.requests.ident

    @property
    def faults(self) -> tuple[str, ...]:
        """Return faults of the box for the operator; () before it has identified itself."""
        return () if self.ident is None else self.ident.faults

    def cleared(self) -> None:
        """Note that the box was asked and has not restarted: its frames are counted from the next one on."""
        self.suspect = False
        self._frame_count.clear()

    def asked(self, number: int, t0_ns: int) -> None:
        """Note a clock request with this id, sent at ``t0_ns``."""
        self._asked_ns[number] = t0_ns
        self.counters.probes += 1

    def expire(self, now_ns: int, older_than_ns: int = SYNC_TIMEOUT_NS) -> None:
        """Give up clock requests older than this."""
        late = [number for number, t0_ns in self._asked_ns.items() if now_ns - t0_ns >= older_than_ns]
        for number in late:
            self.writer.add_json("/sync", now_ns, {"id": number, "t0_ns": self._asked_ns.pop(number)})
            self.counters.unanswered_probes += 1

    def _take_console(self, t_host_ns: int, data: bytes) -> None:
        self.counters.console_bytes += len(data)
        self.writer.add("/box/console", t_host_ns, data)

    def _take_frame(self, t_host_ns: int, frame: list[Any], payload: bytes) -> None:
        kind, seq = frame[:2]
        data = data_of(frame) if kind == DATA and conforms(frame) else None
        stream = None if data is None or self.ident is None else self.ident.streams.get(data.stream)
        topic = _TOPICS.get(kind, "/box/other")
        if stream is not None:
            topic = f"/box/{stream.name}"
        elif data is not None and data.stream <= _LARGEST_UNNAMED_STREAM:
            topic = f"/box/stream{data.stream}"
        self.writer.add(topic, t_host_ns, payload)
        self._count(seq)
        if stream is not None and data is not None:
            self._take_samples(t_host_ns, data, stream)
        elif kind in _TOPICS and (fields := named_elements(frame)) is not None:
            self._interpret(t_host_ns, kind, fields)

    def _take_samples(self, t_host_ns: int, data: Data, stream: Stream) -> None:
        """Pass samples on, and store a block's last one now and then for viewers that cannot read frames."""
        self.counters.samples += len(data.samples) // (4 * len(stream.channels))  # int32
        if t_host_ns >= self._next_preview_ns.get(data.stream, 0) and (counts := counts_of(data, stream)) is not None:
            self._next_preview_ns[data.stream] = t_host_ns + PREVIEW_NS
            pairs = zip(stream.channels, counts[-1].tolist(), strict=True)
            row = dict(shown(*pair) for pair in pairs if not pair[0].fault)
            self.writer.add(PREVIEW + stream.name, t_host_ns, msgspec.json.encode(row))
        self.operator.block(t_host_ns, data)

    def _count(self, seq: int) -> None:
        self.counters.frames += 1
        if not self._frame_count.take(seq):
            self.suspect = True
        self.counters.lost_frames, self.counters.odd_frames = self._frame_count.lost, self._frame_count.odd

    def _interpret(self, t_host_ns: int, kind: int, fields: Mapping[str, Any]) -> None:
        if kind == SYNC_REPLY:
            self._take_exchange(t_host_ns, fields["id"], fields["t1_us"], fields["t2_us"])
        elif kind == HEARTBEAT:
            self._take_heartbeat(fields)
        elif kind in (IDENT, REPLY, ERROR):
            recorded = self.ident
            self.requests.take(kind, fields)
            if self.ident is not None and self.ident is not recorded:
                self._take_ident(t_host_ns, recorded, self.ident)

    def _take_exchange(self, t3_ns: int, number: int, t1_us: int, t2_us: int) -> None:
        """Store a clock exchange, unless it is unknown or too late."""
        t0_ns = self._asked_ns.pop(number, None)
        if t0_ns is not None:
            row = {"id": number, "t0_ns": t0_ns, "t1_us": t1_us, "t2_us": t2_us, "t3_ns": t3_ns}
            self.writer.add("/sync", t3_ns, msgspec.json.encode(row))
            rtt_us = max(0.0, (t3_ns - t0_ns) / 1000 - (t2_us - t1_us))
            self.rtt_us = rtt_us if self.rtt_us is None else min(rtt_us, self.rtt_us)

    def _take_heartbeat(self, fields: Mapping[str, Any]) -> None:
        """Count losses in the box. It counts since boot, so losses before this recording first heard of it are not
        included.
        """
        boot_id, counts = fields["boot_id"], (fields["dropped"], fields["overruns"])
        self.idle = 0 if fields["streaming"] else self.idle + 1
        self.operator.box_temperature(MDEGC.to_si(fields["temperature_mdegc"]))
        if self.ident is not None and boot_id != self.ident.boot_id:
            self.suspect = True
        before = self._beats.get(boot_id, (0, 0) if self._beats else counts)
        dropped, overruns = ((now - then) % _BEAT_WRAP for now, then in zip(counts, before, strict=True))
        if max(dropped, overruns) < _BEAT_WRAP // 2:  # else the count went back
            self._beats[boot_id] = counts
            self.counters.dropped_in_box += dropped
            self.counters.overruns_in_box += overruns

    def _take_ident(self, t_host_ns: int, recorded: Ident | None, ident: Ident) -> None:
        """Compare an ident with the one before. Raises ProtocolError if a different box answers: its calibration and its
        clock differ.
        """
        if recorded is not None:
            uids = [str(document.get("uid", ""))[:32] for document in (ident.document, recorded.document)]
            if uids[0] != uids[1]:
                raise ProtocolError(
                    f"another box answers ({uids[0] or 'without a uid'}; the recording began with {uids[1] or 'one without'}); "
                    "plug in the box of the recording and resume the session"
                )
            if ident.boot_id != recorded.boot_id:
                self.counters.restarts += 1
                self.restarted = True
                self.cleared()
                self.writer.event("box-restarted", t_host_ns, boot_id=ident.boot_id, boot_id_before=recorded.boot_id)
        for text in ident.faults:
            if recorded is None or text not in recorded.faults:
                self.writer.event("box-fault", t_host_ns, text=text)
