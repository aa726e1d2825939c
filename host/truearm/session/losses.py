"""What did not arrive, counted exactly (hop 4): frames, the samples of each stream, and where the box said nothing at all.

``frame_order`` decides what each frame is: in its place, doubled, too late, malformed, or the first of a box that restarted. Frames of a type that only a host
sends are malformed too: an echo.

``n0`` counts samples. A jump with frames lost since the stream's last block: the samples went with them; without: the box
overran. ``n0`` that falls back without a restart is a new ``start``, a new run. A box that a killed recorder left streaming still holds blocks of then.
The next one stops it and starts it anew: what was missing before that start is not the session's loss.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_ident import Stream
from truearm.session.heartbeats import NO_HEARTBEAT, Summary
from truearm.session.message_columns import Ints, Messages
from truearm_wire import messages as wire

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


COUNTED = ("blocks", "samples", "samples_lost", "samples_overrun", "converter_faults", "starts")  # see Losses


@dataclass(frozen=True)
class StreamReport:
    """A stream as it came. ``period_ns`` is what its last block says, ``measured_ns`` the mean period by the box's stamps
    where nothing is missing (NaN where that is nowhere)."""

    id: int
    name: str
    channels: tuple[str, ...]
    samples: int
    pieces: int  # that are whole in themselves: 1 where no sample is missing
    period_ns: int
    measured_ns: float


@dataclass
class StreamTrack:
    """Where a stream stands, and its account."""

    next_n0: int | None = None
    frames_lost: int = 0  # on the link, when the last block came
    run: int = 0
    pieces: int = 0
    blocks: int = 0
    samples: int = 0
    samples_lost: int = 0
    samples_overrun: int = 0
    converter_faults: int = 0
    starts: int = 0
    joined: bool = False  # the box was sampling before the session began, and was not started by it yet
    period_ns: int = 0
    last_t0_us: int = 0
    last_n: int = 0
    whole_us: int = 0  # device time between blocks without a gap, and the samples that fill it
    whole_samples: int = 0

    def take(self, n0: Ints, n: Ints, t0_us: Ints, flags: Ints, frames_lost: Ints) -> tuple[NDArray[np.bool_], Ints]:
        """Account for blocks (b,); before which of them samples are missing, and the run of each."""
        expected = np.concatenate([[-1 if self.next_n0 is None else self.next_n0], (n0 + n)[:-1]])
        lost_before = np.concatenate([[self.frames_lost], frames_lost[:-1]])
        unusual = np.flatnonzero((n0 != expected) | (frames_lost != lost_before) | (flags != 0))
        gap, run = np.zeros(len(n0), bool), np.full(len(n0), self.run)
        for k in unusual.tolist():
            if k:
                self.next_n0 = int(expected[k])
            before = self.run
            gap[k] = self._unusual(int(n0[k]), int(flags[k]), int(frames_lost[k]), seen=bool(self.blocks or k))
            self.pieces += bool(gap[k])
            if self.run != before:
                run[k:] = self.run
        last_t0 = np.concatenate([[self.last_t0_us], t0_us[:-1]])
        last_n = np.concatenate([[self.last_n], n[:-1]])
        self.whole_us += int(np.sum((t0_us - last_t0)[~gap]))
        self.whole_samples += int(np.sum(last_n[~gap]))
        self.blocks += len(n0)
        self.samples += int(np.sum(n))
        self.next_n0, self.last_t0_us, self.last_n = int(n0[-1] + n[-1]), int(t0_us[-1]), int(n[-1])
        return gap, run

    def restart(self, frames_lost: int) -> None:
        """The box restarted; ``n0`` counts from 0 again."""
        self.next_n0, self.frames_lost = None, frames_lost

    def _unusual(self, n0: int, flags: int, frames_lost: int, seen: bool) -> bool:
        """Account for what is missing before a block, of which ``seen`` says whether it is not the stream's first; whether anything is."""
        with_frames, self.frames_lost = frames_lost != self.frames_lost, frames_lost
        self.converter_faults += bool(flags & wire.FLAG_CONVERTER)
        expected = self.next_n0
        if expected is None:
            # Joined, or restarted. Without a frame lost the box had been sampling before the session began.
            missing = n0 if with_frames else 0
            self.joined = not (seen or with_frames) and n0 > 0
        elif n0 < expected:
            self.starts += 1
            self.run += 1
            if self.joined:
                self.joined, self.samples_overrun, self.pieces = False, 0, 0
            missing = n0
        else:
            missing = n0 - expected
        if with_frames:
            self.samples_lost += missing
        else:
            self.samples_overrun += missing
        return n0 != expected or bool(flags & wire.FLAG_OVERRUN)

    def report(self, stream_id: int, described: Stream) -> StreamReport:
        """The account, under the name that an ident gives the stream."""
        return StreamReport(
            id=stream_id,
            name=described.name,
            channels=tuple(channel.name for channel in described.channels),
            samples=self.samples,
            pieces=self.pieces,
            period_ns=self.period_ns,
            measured_ns=1000.0 * self.whole_us / self.whole_samples if self.whole_samples else float("nan"),
        )
