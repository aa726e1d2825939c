"""Count exactly what did not arrive: samples of each stream, times when the box sent nothing, and the box's own counters.

**Samples** are counted by the ``n0`` of each stream (``StreamTrack``). If ``n0`` jumps and frames were lost since the
stream's last block, the samples were lost with them; if no frames were lost, the box overran. If ``n0`` falls back
without a restart, a new ``start`` began, and with it a new run. A box left streaming by a killed recorder still holds
old blocks. The next recorder stops and restarts it; samples missing before that start are not losses of the session.

**The box's own counters** (``Heartbeats``) count from boot and wrap at 2^30 (SPEC §4). A session that joins a running
box must not be charged with earlier events. If the session did not see the boot, only events after its first heartbeat
are counted, so up to a second at the beginning of the session is not covered. If the box boots during the session,
everything is counted. The layout generated from protocol/frames.cddl gives the kind of each element: a ``counter`` is
summed; for ``largest`` or ``smallest`` the extreme is kept. A box with an older minor version sends fewer elements.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_ident import Stream
from truearm.session.session_file import Messages
from truearm.types import Ints
from truearm_wire import messages as wire

WRAP = 2**30
_ELEMENTS = [entry.partition(":")[::2] for entry in wire.LAYOUT[wire.HEARTBEAT][1:]]  # name and type, after seq
COUNTERS = tuple(name for name, kind in _ELEMENTS if kind == "counter")
# element → what is kept of it, and the name of the result
EXTREMES: Mapping[str, tuple[Callable[[int, int], int], str]] = {
    name: (max, name) if kind == "largest" else (min, f"{name}_min")
    for name, kind in _ELEMENTS
    if kind in ("largest", "smallest")
}
Summary = Mapping[str, int | None]


@dataclass
class Heartbeats:
    """The heartbeats of one boot: their number, the first and the last one, and the worst of every extreme."""

    count: int = 0
    first: Mapping[str, int] = field(default_factory=dict)
    last: Mapping[str, int] = field(default_factory=dict)
    worst: dict[str, int] = field(default_factory=dict)

    def take(self, elements: Sequence[int]) -> None:
        """Take the elements of a heartbeat: boot id, time, counters."""
        self.last = {name: value for (name, _), value in zip(_ELEMENTS, elements, strict=False)}
        self.first = self.first or self.last
        self.count += 1
        for name, (extreme, key) in EXTREMES.items():
            if name in self.last:
                self.worst[key] = extreme(self.worst.get(key, self.last[name]), self.last[name])


def summary_of(boots: Sequence[tuple[Heartbeats, bool]]) -> Summary:
    """Return the number of heartbeats, the sum of every counter and the worst of every extreme; None without heartbeats.

    ``boots``: the heartbeats of each boot, and whether it began in the session.
    """
    total: Counter[str] = Counter()
    worst: dict[str, int | None] = {key: None for _, key in EXTREMES.values()}
    for beats, booted in boots:
        total["heartbeats"] += beats.count
        for name in COUNTERS:
            begin = beats.first.get(name, 0)
            total[name] += (beats.last.get(name, 0) - begin) % WRAP + (begin if booted else 0)
        for extreme, key in EXTREMES.values():
            values = [value for value in (worst[key], beats.worst.get(key)) if value is not None]
            worst[key] = extreme(*values) if len(values) == 2 else values[0] if values else None
    return {"heartbeats": total["heartbeats"], **{name: total[name] for name in COUNTERS}, **worst}


# ------------------------------------------------------------------------------------------------------------- accounts

SILENT_NS = 2_000_000_000  # a healthy box sends a heartbeat every second
_GONE = (b'"link-lost"', b'"box-gone"')  # counted however short the silence was


@dataclass(frozen=True)
class Losses:
    """Exact accounting of a session.

    A flipped bit causes one console run and one lost frame, a traceback in the stream one console run. Frames before
    the first one seen cannot be counted, except after a restart, where ``seq`` begins at 0.
    """

    frames: int = 0  # frames of any type received, each counted once
    frames_lost: int = 0  # gaps of seq
    loss_events: int = 0  # places where seq has a gap
    frames_malformed: int = 0  # frames with a valid CRC that violate the specification, or are behind the count
    frames_unknown: int = 0  # of types unknown to this version
    blocks: int = 0
    samples: int = 0
    samples_lost: int = 0  # jumps of n0 with a gap of seq: lost with frames
    samples_overrun: int = 0  # jumps of n0 without a gap of seq: lost in the box
    blocks_without_ident: int = 0  # data of a stream without an ident: unusable
    converter_faults: int = 0  # blocks flagged by the box
    console_runs: int = 0  # runs of bytes that were not a frame
    console_text_runs: int = 0  # of these, the runs that are text
    console_bytes: int = 0
    restarts: int = 0
    starts: int = 0  # how often n0 began again without a restart
    sync_requests: int = 0
    sync_unanswered: int = 0
    box: Summary = field(default_factory=lambda: summary_of([]))  # the box's own counters, from its heartbeats


class Silences:
    """Times in a session when the box sent nothing at all: the link was lost or the box hung.

    ``gaps`` holds the host times [ns] of the last message before and the first one after, or of the session's last
    message. Frames that a box sent meanwhile and the link lost also show in ``seq``, if the box came back. ``last_ns``:
    of the session's newest message.
    """

    def __init__(self) -> None:
        self.gaps: list[tuple[int, int]] = []
        self.last_ns = 0
        self._box_ns: Ints = np.empty(0, np.int64)  # of the box's last message
        self._gone_ns: list[int] = []  # the recorder reported that it lost the box

    def take(self, messages: Messages) -> None:
        """Take a batch of messages of the session, on any topics."""
        events = messages.rows(lambda topic: topic == "/events").tolist()
        gone = [row for row in events if any(kind in messages.payload(row) for kind in _GONE)]
        self._gone_ns += messages.t_host_ns[gone].tolist()
        self._close(messages.t_host_ns[messages.rows(lambda topic: topic.startswith("/box/"))])
        self.last_ns = max(self.last_ns, int(messages.t_host_ns.max(initial=0)))

    def finish(self) -> list[tuple[int, int]]:
        """Return all gaps at the end of the session."""
        self._close(np.array([self.last_ns]))
        return self.gaps

    def _close(self, t_ns: Ints) -> None:
        t_ns = np.append(self._box_ns, t_ns)
        gone = np.searchsorted(self._gone_ns, t_ns)
        silent = np.flatnonzero((np.diff(t_ns) > SILENT_NS) | ((np.diff(gone) > 0) & (np.diff(t_ns) > 0)))
        self.gaps += zip(t_ns[silent].tolist(), t_ns[silent + 1].tolist(), strict=True)
        self._box_ns = t_ns[-1:]


COUNTED = ("blocks", "samples", "samples_lost", "samples_overrun", "converter_faults", "starts")  # see Losses


@dataclass(frozen=True)
class StreamReport:
    """A stream as received.

    ``period_ns`` is the value in its last block. ``measured_ns`` is the mean period by the box's stamps where nothing
    is missing, or NaN if there is no such part.
    """

    id: int
    name: str
    channels: tuple[str, ...]
    samples: int
    pieces: int  # gap-free pieces: 1 if no sample is missing
    period_ns: int
    measured_ns: float


@dataclass
class StreamTrack:
    """The current position of a stream and its account."""

    next_n0: int | None = None
    frames_lost: int = 0  # on the link, as of the last block
    run: int = 0
    pieces: int = 0
    blocks: int = 0
    samples: int = 0
    samples_lost: int = 0
    samples_overrun: int = 0
    converter_faults: int = 0
    starts: int = 0
    joined: bool = False  # the box was sampling before the session began and has not been started by it yet
    period_ns: int = 0
    last_t0_us: int = 0
    last_n: int = 0
    whole_us: int = 0  # device time between blocks without a gap, and the samples in it
    whole_samples: int = 0

    def take(self, n0: Ints, n: Ints, t0_us: Ints, flags: Ints, frames_lost: Ints) -> tuple[NDArray[np.bool_], Ints]:
        """Account for blocks (b,) of one boot; return before which of them samples are missing, and the run of each.

        ``frames_lost``: of the session, before each block.
        """
        joins = self.next_n0 is None  # a running box, or one that restarted: then it counts from 0
        with_frames = np.diff(frames_lost, prepend=self.frames_lost) > 0
        expected = np.append(n0[0] * (not with_frames[0]) if self.next_n0 is None else self.next_n0, (n0 + n)[:-1])
        begins = n0 < expected
        missing = np.where(begins, n0, n0 - expected)
        gap = (n0 != expected) | ((flags & wire.FLAG_OVERRUN) != 0)
        gap[0] |= joins
        run = self.run + np.cumsum(begins)
        if joins:
            self.joined = not (self.blocks or with_frames[0]) and n0[0] > 0
        of_session = np.ones(len(n0), bool)
        if self.joined and begins.any():  # what a box lost before it was started is not the session's
            of_session[: np.argmax(begins)] = False
            self.joined, self.samples_overrun, self.pieces = False, 0, 0
        self.samples_lost += int(missing[with_frames].sum())
        self.samples_overrun += int(missing[~with_frames & of_session].sum())
        self.pieces += int(np.count_nonzero(gap & of_session))
        whole = ~gap
        self.whole_us += int(np.diff(t0_us, prepend=self.last_t0_us)[whole].sum())
        self.whole_samples += int(np.append(self.last_n, n[:-1])[whole].sum())
        self.converter_faults += int(np.count_nonzero(flags & wire.FLAG_CONVERTER))
        self.starts += int(np.count_nonzero(begins))
        self.blocks += len(n0)
        self.samples += int(n.sum())
        self.next_n0, self.frames_lost, self.run = int(n0[-1] + n[-1]), int(frames_lost[-1]), int(run[-1])
        self.last_t0_us, self.last_n = int(t0_us[-1]), int(n[-1])
        return gap, run

    def restart(self, frames_lost: int) -> None:
        """Note a restart of the box; ``n0`` counts from 0 again."""
        self.next_n0, self.frames_lost = None, frames_lost

    def report(self, stream_id: int, described: Stream) -> StreamReport:
        """Return the account, under the name that an ident gives the stream."""
        return StreamReport(
            id=stream_id,
            name=described.name,
            channels=tuple(channel.name for channel in described.channels),
            samples=self.samples,
            pieces=self.pieces,
            period_ns=self.period_ns,
            measured_ns=1000.0 * self.whole_us / self.whole_samples if self.whole_samples else float("nan"),
        )
