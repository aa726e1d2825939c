"""Count exactly what did not arrive: frames, samples of each stream, and times when the box sent nothing.

**Frames** are counted by their ``seq`` in ``frame_order``.

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

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_frames import MAX_DEVICE_US
from truearm.session.box_ident import Stream
from truearm.session.message_columns import Messages
from truearm.types import Ints
from truearm_wire import messages as wire

REMEMBERED = 256  # holes, and late numbers that fill none; a number that arrives later than that is not looked up


class MissingNumbers:
    """Counts skipped numbers that did not arrive late.

    A number that was never missing, or arrives late twice, fills nothing.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._open: deque[tuple[int, int]] = deque(maxlen=REMEMBERED)  # the numbers around each hole
        self._spare: deque[int] = deque(maxlen=REMEMBERED)  # late numbers with a hole that may still appear

    def skip(self, before: int, after: int) -> None:
        """Record that ``after`` followed ``before``."""
        if after - before > 1:
            self.lost += after - before - 1
            self._open.append((before, after))
            for number in [n for n in self._spare if before < n < after]:
                self._spare.remove(number)
                self.fill(number)

    def fill(self, number: int) -> None:
        """Record a number that arrived late, or before the next one showed that it had been skipped."""
        for k, (before, after) in enumerate(self._open):
            if before < number < after:
                del self._open[k]
                self._open.extend((a, b) for a, b in ((before, number), (number, after)) if b - a > 1)
                self.lost -= 1
                return
        self._spare.append(number)

    def forget(self) -> None:
        """Restart the numbering; losses so far are kept."""
        self._open.clear()
        self._spare.clear()


# ----------------------------------------------------------------------------------------------- the box's own counters

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
NO_HEARTBEAT: Summary = {
    "heartbeats": 0,
    **dict.fromkeys(COUNTERS, 0),
    **{key: None for _, key in EXTREMES.values()},
}


@dataclass
class _Boot:
    """The heartbeats of one boot: first, last, and the sums between them."""

    segment: int
    first: Mapping[str, int]
    last: Mapping[str, int]
    since: Counter[str] = field(default_factory=Counter)


class Heartbeats:
    """Processes the values of heartbeats (boot_id, t_us, counters …) in order."""

    def __init__(self) -> None:
        self._boots: dict[int, _Boot] = {}
        self._worst: dict[str, int | None] = {key: None for _, key in EXTREMES.values()}
        self._n = 0
        self.temperatures: dict[int, list[tuple[int, int]]] = {}  # of each segment: device time [µs], m°C

    def take(self, segment: int, values: Sequence[int]) -> None:
        """Take one heartbeat of a segment.

        Segments with the same boot id are one boot, because a late frame can look like a restart.
        """
        beat = {name: value for (name, _), value in zip(_ELEMENTS, values, strict=False)}
        boot = self._boots.setdefault(beat["boot_id"], _Boot(segment, beat, beat))
        if beat["t_us"] >= boot.last["t_us"]:  # else it is late and contains nothing new
            for name in COUNTERS:
                boot.since[name] += (beat.get(name, 0) - boot.last.get(name, 0)) % WRAP
            boot.last = beat
        self._n += 1
        if "temperature_mdegc" in beat and 0 <= beat["t_us"] < MAX_DEVICE_US:
            self.temperatures.setdefault(segment, []).append((beat["t_us"], beat["temperature_mdegc"]))
        for name, (extreme, key) in EXTREMES.items():
            if name in beat:
                before = self._worst[key]
                self._worst[key] = beat[name] if before is None else extreme(before, beat[name])

    def summary(self, booted: Collection[int]) -> Summary:
        """Return the number of heartbeats, the sum of every counter and the worst of every extreme; None without
        heartbeats.

        ``booted``: the segments that began with a boot in the session.
        """
        total = Counter[str]()
        for boot in self._boots.values():
            total.update(boot.since)
            if boot.segment in booted:
                total.update({name: boot.first.get(name, 0) for name in COUNTERS})
        return {"heartbeats": self._n, **{name: total[name] for name in COUNTERS}, **self._worst}


# ------------------------------------------------------------------------------------------------------------- accounts

SILENT_NS = 2_000_000_000  # a healthy box sends a heartbeat every second
_GONE = (b'"link-lost"', b'"box-gone"')  # counted however short the silence was


@dataclass(frozen=True)
class Losses:
    """Exact accounting of a session.

    A flipped bit causes one console run and one lost frame, a traceback in the stream one console run, and a doubled
    frame one duplicate. Frames before the first one seen cannot be counted, except after a restart, where ``seq``
    begins at 0.
    """

    frames: int = 0  # frames of any type received, each counted once
    frames_lost: int = 0  # gaps of seq
    loss_events: int = 0  # places where seq has a gap
    frames_duplicated: int = 0
    frames_late: int = 0  # frames that arrived too late to be used; also counted as lost
    frames_malformed: int = 0  # frames with a valid CRC that violate the specification
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
    box: Summary = field(default_factory=lambda: NO_HEARTBEAT)  # the box's own counters, from its heartbeats


class Silences:
    """Times in a session when the box sent nothing at all: the link was lost or the box hung.

    ``gaps`` holds the host times [ns] of the last message before and the first one after, or of the session's last
    message. Frames that a box sent meanwhile and the link lost also show in ``seq``, if the box came back. ``last_ns``:
    of the session's newest message.
    """

    def __init__(self) -> None:
        self.gaps: list[tuple[int, int]] = []
        self._box_ns: int | None = None
        self.last_ns = 0
        self._gone = False  # the recorder reported that it lost the box

    def take(self, messages: Messages) -> None:
        """Take a batch of messages of the session, on any topics."""
        box = messages.rows(lambda topic: topic.startswith("/box/"))
        events = messages.rows(lambda topic: topic == "/events")
        gone = [row for row in events.tolist() if any(kind in messages.payload(row) for kind in _GONE)]
        t_ns = messages.t_host_ns[box]
        newest = np.maximum.accumulate(np.append(t_ns[:1] if self._box_ns is None else self._box_ns, t_ns))
        silent = t_ns - newest[:-1] > SILENT_NS
        silent[:1] = True
        silent[[k for k in np.searchsorted(box, gone).tolist() if k < len(box)]] = True
        for k in np.flatnonzero(silent).tolist():  # no silence between the others
            if k:
                self._box_ns = int(newest[k])
                self._gone = any(box[k - 1] < row < box[k] for row in gone)
            else:
                self._gone |= any(row < box[0] for row in gone)
            self._close(int(t_ns[k]))
        if len(box):
            self._box_ns, self._gone = int(newest[-1]), any(row > box[-1] for row in gone)
            self._divide(t_ns[t_ns < newest[:-1]])
        else:
            self._gone |= bool(gone)
        self.last_ns = max(self.last_ns, int(messages.t_host_ns.max(initial=0)))

    def finish(self) -> list[tuple[int, int]]:
        """Return all gaps at the end of the session."""
        self._close(self.last_ns)
        return self.gaps

    def _divide(self, late_ns: Ints) -> None:
        """Divide the gaps at messages that stand later in the session than newer ones."""
        found = []
        for begin, end in self.gaps:
            inside = np.unique(late_ns[(late_ns > begin) & (late_ns < end)])
            parts = pairwise([begin, *inside.tolist(), end])
            found += [(a, b) for a, b in parts if b - a > SILENT_NS or not len(inside)]
        self.gaps = found

    def _close(self, now_ns: int) -> None:
        if self._box_ns is not None and now_ns - self._box_ns > (0 if self._gone else SILENT_NS):
            self.gaps.append((self._box_ns, now_ns))


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
        """Account for blocks (b,); return before which of them samples are missing, and the run of each."""
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
        """Note a restart of the box; ``n0`` counts from 0 again."""
        self.next_n0, self.frames_lost = None, frames_lost

    def _unusual(self, n0: int, flags: int, frames_lost: int, seen: bool) -> bool:
        """Account for what is missing before a block and return whether anything is.

        ``seen``: the block is not the first of the stream.
        """
        with_frames, self.frames_lost = frames_lost != self.frames_lost, frames_lost
        self.converter_faults += bool(flags & wire.FLAG_CONVERTER)
        expected = self.next_n0
        if expected is None:
            # Joined or restarted. If no frame is lost, the box had been sampling before the session began.
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
