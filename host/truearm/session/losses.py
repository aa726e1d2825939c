"""What did not arrive, counted exactly (hop 4).

``frame_order`` decides what each frame is: in its place, doubled, too late, malformed, or the first of a box that restarted. Frames of a type that only a host
sends are malformed too: an echo.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from truearm.session.heartbeats import NO_HEARTBEAT, Summary
from truearm.session.message_columns import Messages

SILENT_NS = 2_000_000_000  # a box that is well sends a heartbeat every second
_GONE = (b'"link-lost"', b'"box-gone"')  # however short the silence was then


@dataclass(frozen=True)
class Losses:
    """Exact accounting of a session.

    A flipped bit makes one console run and one lost frame; a traceback in the stream one console run; a doubled frame
    one duplicate. Frames before the first one seen cannot be counted; after a restart ``seq`` begins at 0, so
    there they are.
    """

    frames: int = 0  # frames received, each counted once, of whatever type
    frames_lost: int = 0  # gaps of seq
    loss_events: int = 0  # places where seq has a gap
    frames_duplicated: int = 0
    frames_late: int = 0  # frames that came when they were no longer waited for: counted as lost, too
    frames_malformed: int = 0  # frames with a good CRC that do not keep to the specification
    frames_unknown: int = 0  # of types that this version does not know
    blocks: int = 0
    samples: int = 0
    samples_lost: int = 0  # jumps of n0 with a gap of seq: they went with lost frames
    samples_overrun: int = 0  # jumps of n0 without a gap of seq: lost in the box
    blocks_without_ident: int = 0  # data of a stream that no ident describes: unusable
    converter_faults: int = 0  # blocks that the box flagged
    console_runs: int = 0  # runs of bytes that were no frame
    console_text_runs: int = 0  # those of them that are text
    console_bytes: int = 0
    restarts: int = 0
    starts: int = 0  # times that n0 began anew without a restart
    sync_requests: int = 0
    sync_unanswered: int = 0
    box: Summary = field(default_factory=lambda: NO_HEARTBEAT)  # the box's own counters, of its heartbeats


class Silences:
    """Where a session goes on and its box says nothing, in its frames or otherwise: a link that was lost, a box that hangs.

    ``gaps`` holds the last word before and the first one after, or the session's last message, as host times [ns].
    What a box sent meanwhile and the link lost shows in ``seq`` too, if it ever came back.
    """

    def __init__(self) -> None:
        self.gaps: list[tuple[int, int]] = []
        self._box_ns: int | None = None
        self._last_ns = 0
        self._gone = False  # the recorder says that it lost the box

    def take(self, messages: Messages) -> None:
        """Take a batch of messages of the session, of whatever topics."""
        box = messages.rows(lambda topic: topic.startswith("/box/"))
        events = messages.rows(lambda topic: topic == "/events")
        gone = [row for row in events.tolist() if any(kind in messages.payload(row) for kind in _GONE)]
        t_ns = messages.t_host_ns[box]
        silent = np.diff(t_ns, prepend=t_ns[:1]) > SILENT_NS
        silent[:1] = True
        silent[[k for k in np.searchsorted(box, gone).tolist() if k < len(box)]] = True
        for k in np.flatnonzero(silent).tolist():  # nothing was silent between the others
            if k:
                self._box_ns = int(t_ns[k - 1])
                self._gone = any(box[k - 1] < row < box[k] for row in gone)
            else:
                self._gone |= any(row < box[0] for row in gone)
            self._close(int(t_ns[k]))
        if len(box):
            self._box_ns, self._gone = int(t_ns[-1]), any(row > box[-1] for row in gone)
        else:
            self._gone |= bool(gone)
        self._last_ns = max(self._last_ns, int(messages.t_host_ns.max(initial=0)))

    def finish(self) -> list[tuple[int, int]]:
        """All gaps, when the session is at its end."""
        self._close(self._last_ns)
        return self.gaps

    def _close(self, now_ns: int) -> None:
        if self._box_ns is not None and now_ns - self._box_ns > (0 if self._gone else SILENT_NS):
            self.gaps.append((self._box_ns, now_ns))
