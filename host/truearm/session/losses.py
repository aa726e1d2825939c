"""What did not arrive, counted exactly (hop 4): frames, the samples of each stream, and where the box said nothing at all.

**Frames** come in the order in which the box sent them out of ``FrameOrder``, however they arrived. Every frame counts in one ``seq`` (SPEC §4). A link or a
damaged file may deliver frames late, twice or never, and a box that restarts begins a new count. What a frame is, is decided in this order:

1. The bytes of a frame that is remembered under its seq: **doubled**. It changes nothing.
2. The first page of the ident that a box sends unasked at boot: a **restart**.
3. The next frame, or one ahead of it by no more than the link can have carried since (``too_many``) and with a device time that
   does not run backward: it belongs to the count. It waits until those before it have come, or until a frame REACH further on has; what has not
   come by then is **lost**. A frame that arrives late within that reach takes its place.
4. All others are **suspects**. They begin a new count if a heartbeat among them has another boot id, if BEHIND_RUN of them follow each other without a frame of
   the old count between, or FAR_RUN where they lie too far ahead. As soon as the old count goes on they are dismissed: frames that came **too late**,
   or that are **malformed** because nothing can have counted so far, as are frames of a type that only a host sends: an echo.

So neither a late frame nor a doubled one is a restart: the boot id decides. Frames come in runs (``box_frames``), whose seq goes on by one, whose device times
do not run backward and whose heartbeats are of one boot. What holds for the first frame of a run therefore holds for as many more as ``_belonging`` says; a
frame alone is a run of one.

**Samples** count in the ``n0`` of each stream (``StreamTrack``). A jump with frames lost since the stream's last block: the samples went with them; without:
the box overran. ``n0`` that falls back without a restart is a new ``start``, a new run. A box that a killed recorder left streaming still holds blocks of then.
The next one stops it and starts it anew: what was missing before that start is not the session's loss.

**The box's own counters** (``Heartbeats``) run since boot and wrap at 2^30 (SPEC §4). A session that joins a running box must not be charged with what happened
before: of a boot that the session did not see only what came after its first heartbeat is counted, so up to a second
of the session's beginning is not. Of a boot in mid-session everything is. What an element is stands in the layout that is generated from
protocol/frames.cddl: a ``counter`` is summed, of a ``largest`` or ``smallest`` the extreme is kept. A box of an older minor version sends fewer elements.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_frames import CIRCLE, MAX_DEVICE_US, Run, too_many
from truearm.session.box_ident import Stream
from truearm.session.message_columns import Ints, Messages
from truearm_wire import messages as wire

REMEMBERED = 256  # holes, and late numbers that fill none; a number that comes later than that is not looked for


class MissingNumbers:
    """Counts numbers that were skipped and did not come late. A number that was never missed, or comes late twice, fills nothing."""

    def __init__(self) -> None:
        self.lost = 0
        self._open: deque[tuple[int, int]] = deque(maxlen=REMEMBERED)  # the numbers around each hole
        self._spare: deque[int] = deque(maxlen=REMEMBERED)  # late numbers whose hole may still show

    def skip(self, before: int, after: int) -> None:
        """``after`` came next after ``before``."""
        if after - before > 1:
            self.lost += after - before - 1
            self._open.append((before, after))
            for number in [n for n in self._spare if before < n < after]:
                self._spare.remove(number)
                self.fill(number)

    def fill(self, number: int) -> None:
        """A number came late, or out of time before the next one showed that it was skipped."""
        for k, (before, after) in enumerate(self._open):
            if before < number < after:
                del self._open[k]
                self._open.extend((a, b) for a, b in ((before, number), (number, after)) if b - a > 1)
                self.lost -= 1
                return
        self._spare.append(number)

    def forget(self) -> None:
        """Numbers begin anew; what was lost stays so."""
        self._open.clear()
        self._spare.clear()


# --------------------------------------------------------------------------------------------------------------- frames

REACH = 512  # frames that a late one may lag behind: some seconds of a box, less than what sessions hold back for late messages
BEHIND_RUN = 64  # a heartbeat comes once in 80 to 350 frames and is hardly ever lost
FAR_RUN = 2
BEFORE_FIRST = 16  # frames that may have been overtaken by the first one of a session
_HALF = CIRCLE // 2


class Placed(NamedTuple):
    """Frames in their place. ``lost``: frames missing before the first; ``restarts``: it is the first of a new count.

    ``at``: the row of the newest batch with which they came out, but for frames that arrived later themselves.
    """

    run: Run
    lost: int
    restarts: bool
    at: int


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """A run that waits; ``count`` of its first frame."""

    count: int
    run: Run

    @property
    def end(self) -> int:
        return self.count + len(self.run)


_COUNT = attrgetter("count")


@dataclass
class FrameOrder:
    """Takes runs as they arrive and gives them back in the order of sending; ``doubled``, ``late`` and ``malformed`` count the other frames."""

    doubled: int = 0
    late: int = 0
    malformed: int = 0
    _next: int = -1  # the count that is given back next, unwrapped; -1: no frame was taken yet
    _newest: int = 0  # the highest count that was taken
    _newest_host_ns: int = 0
    _uncounted: int = 0  # below it, missing frames were sent before the session began
    _waiting: list[_Held] = field(default_factory=list)  # by ascending count
    _remembered: deque[tuple[int, int, Run]] = field(
        default_factory=deque
    )  # as they were taken, each with its seq and length
    _n_remembered: int = 0
    _by_seq: dict[int, tuple[int, Run]] = field(default_factory=dict)  # of them: length and frames, by the first seq
    _long: set[int] = field(default_factory=set)  # the first seq of those that are more than one frame
    _times: dict[int, int] = field(default_factory=dict)  # newest device time of each kind
    _placed_times: dict[int, int] = field(default_factory=dict)  # of the frames that were given back
    _boot_id: int | None = None
    _restarting: bool = False  # the next frame that is given back is the first of a count
    _suspects: list[Run] = field(default_factory=list)  # of one frame each
    _far: bool = False  # the suspects lie too far ahead

    @property
    def undecided(self) -> bool:
        """Whether frames are held of which nobody knows yet what they are."""
        return bool(self._suspects)

    def parts(self, run: Run) -> Iterator[Run]:
        """A run in parts that can be taken at once; to be asked for one by one, each when the one before was taken."""
        while len(run):
            head = run.first(max(1, self._belonging(run)))
            yield head
            run = run.after(head)

    def take(self, part: Run) -> Iterator[Placed]:
        """Take a part of a run; the frames that are due by then, in order."""
        yield from self._take(part, part.row)

    def finish(self, at: int) -> Iterator[Placed]:
        """What is still held, at the end of the session."""
        self._dismiss()
        yield from self._all_waiting(at)

    def new_boot(self, boot_id: int) -> None:
        """The box said that it is of this boot; what is counted goes on."""
        self._boot_id = boot_id

    def _take(self, run: Run, at: int) -> Iterator[Placed]:
        """Take frames that belong to the count, or a single one of which that is not known."""
        if len(run) > 1 or self._belonging(run):
            yield from self._accept(run, at)
        elif self._is_doubled(run):
            self.doubled += 1
        elif self._next < 0:
            yield from self._begin(run, max(0, run.seq - BEFORE_FIRST), run.seq, at)
        elif run.is_boot:
            self._dismiss()
            yield from self._restart([run], at)
        else:
            yield from self._suspect(run, at)

    # ------------------------------------------------------------------------------------------------ the count

    def _begin(self, run: Run, first: int, uncounted: int, at: int) -> Iterator[Placed]:
        self._next, self._newest, self._uncounted = first, run.seq - 1, uncounted
        self._newest_host_ns = run.t_host_ns
        yield from self._accept(run, at)

    def _unwrapped(self, seq: int) -> int:
        """The count that a seq stands for: the nearest to the newest one."""
        return self._newest + (seq - self._newest + _HALF) % CIRCLE - _HALF

    def _belonging(self, run: Run) -> int:
        """How many of the first frames of a run are of this count and still waited for (rule 3)."""
        count, n = self._unwrapped(run.seq), len(run)
        if count < max(self._next, 0) or self._next < 0:
            return 0
        if count > self._newest:
            if self._is_far(run):
                return 0
            times = self._times
        else:  # late: sent after all that were given back
            place = bisect_left(self._waiting, count, key=_COUNT)
            if (place and count < self._waiting[place - 1].end) or self._waiting[place].count == count:
                return 0
            n = min(n, self._waiting[place].count - count)
            times = self._placed_times
        if run.is_boot and self._times:  # what a box sends at boot it sends before everything that has a time
            return 0
        for kind, frame, t_us, _ in run.times():
            if t_us < times.get(kind, 0):
                n = min(n, frame - run.begin)
        beat, boot_id = run.first_heartbeat()
        if self._boot_id is not None and boot_id not in (None, self._boot_id):
            n = min(n, beat - run.begin)
        return n

    def _is_far(self, run: Run) -> bool:
        """Whether a frame lies further ahead than frames can have come since the newest."""
        return too_many(self._unwrapped(run.seq) - self._newest, run.t_host_ns - self._newest_host_ns)

    def _accept(self, run: Run, at: int) -> Iterator[Placed]:
        held = _Held(self._unwrapped(run.seq), run)
        self._waiting.insert(bisect_left(self._waiting, held.count, key=_COUNT), held)
        self._remember(run)
        if held.count > self._newest:
            self._dismiss()  # the count goes on
            self._newest, self._newest_host_ns = held.end - 1, run.last_host_ns
        for kind, _, _, t_us in run.times():
            self._times[kind] = max(t_us, self._times.get(kind, 0))
        _, boot_id = run.first_heartbeat()
        if self._boot_id is None:
            self._boot_id = boot_id
        while self._waiting:
            hole = self._waiting[0].count > self._next
            if hole:
                ahead = self._newest - self._next - REACH
                if ahead < 0:
                    return
                at = max(at, run.frames.row[run.end - 1 - ahead]) if ahead < len(run) - 1 else at
            last = self._waiting[0] is held
            yield self._given_back(at)
            if last and len(run) > 1:
                at = max(at, run.frames.row[run.end - 1])

    def _all_waiting(self, at: int) -> Iterator[Placed]:
        while self._waiting:
            yield self._given_back(at)

    def _given_back(self, at: int) -> Placed:
        """The first run that waits."""
        held = self._waiting.pop(0)
        count, run = held.count, held.run
        lost = max(0, count - max(self._next, self._uncounted)) if count > self._next else 0
        restarts, self._restarting = self._restarting, False
        self._next = count + len(run)
        for kind, _, _, t_us in run.times():
            self._placed_times[kind] = t_us
        return Placed(run, lost, restarts, at)

    def _remember(self, run: Run) -> None:
        self._remembered.append((run.seq, len(run), run))
        self._index(run.seq, len(run), run)
        self._n_remembered += len(run)
        while self._n_remembered > 2 * REACH:
            seq, n, oldest = self._remembered.popleft()
            self._by_seq.pop(seq, None)
            self._long.discard(seq)
            forgotten = oldest.first(min(n, self._n_remembered - 2 * REACH))
            self._n_remembered -= len(forgotten)
            if len(forgotten) < n:
                rest = oldest.after(forgotten)
                self._remembered.appendleft(((seq + len(forgotten)) % CIRCLE, len(rest), rest))
                self._index(*self._remembered[0])

    def _index(self, seq: int, n: int, run: Run) -> None:
        self._by_seq[seq] = n, run
        if n > 1:
            self._long.add(seq)

    def _is_doubled(self, run: Run) -> bool:
        """Whether the bytes of a frame are remembered under its seq."""
        asked = run.seq
        for seq in (asked, *self._long):
            n, known = self._by_seq.get(seq, (0, run))
            if (asked - seq) % CIRCLE < n:
                return run.payload == known.after(known.first((asked - seq) % CIRCLE)).payload
        return False

    # ------------------------------------------------------------------------------------------------ another count

    def _suspect(self, run: Run, at: int) -> Iterator[Placed]:
        if self._suspects and abs((run.seq - self._suspects[-1].seq + _HALF) % CIRCLE - _HALF) > REACH:
            self._dismiss()
        if not self._suspects:
            self._far = self._is_far(run)
        self._suspects.append(run)
        _, boot_id = run.first_heartbeat()
        another = self._boot_id is not None and boot_id not in (None, self._boot_id)
        if another or len(self._suspects) >= (FAR_RUN if self._far else BEHIND_RUN):
            suspects, self._suspects = self._suspects, []
            yield from self._restart(suspects, at)

    def _restart(self, runs: Sequence[Run], at: int) -> Iterator[Placed]:
        """The frames are the first of a new count; nothing more comes of the old one."""
        yield from self._all_waiting(at)
        first, far = runs[0], self._far
        self._remembered, self._n_remembered, self._times, self._placed_times = deque(), 0, {}, {}
        self._by_seq, self._long = {}, set()
        self._boot_id, self._restarting, self._far = None, True, False
        # The count of a box begins at 0; one that lies too far ahead says nothing of what was lost.
        from_ = first.seq if far else 0
        yield from self._begin(first, from_, from_, at)
        for run in runs[1:]:
            yield from self._take(run, at)

    def _dismiss(self) -> None:
        if self._far:
            self.malformed += len(self._suspects)
        else:
            self.late += len(self._suspects)
        self._suspects, self._far = [], False


# ----------------------------------------------------------------------------------------------- the box's own counters

WRAP = 2**30
_ELEMENTS = [entry.partition(":")[::2] for entry in wire.LAYOUT[wire.HEARTBEAT][1:]]  # name and type, after seq
COUNTERS = tuple(name for name, kind in _ELEMENTS if kind == "counter")
# element → what is kept of it, and the name of that
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
    """The heartbeats of one boot: the first, the last, and the sums between them."""

    segment: int
    first: Mapping[str, int]
    last: Mapping[str, int]
    since: Counter[str] = field(default_factory=Counter)


class Heartbeats:
    """Takes the values of heartbeats (boot_id, t_us, counters …) in their order."""

    def __init__(self) -> None:
        self._boots: dict[int, _Boot] = {}
        self._worst: dict[str, int | None] = {key: None for _, key in EXTREMES.values()}
        self._n = 0
        self.temperatures: dict[int, list[tuple[int, int]]] = {}  # of each segment: device time [µs], m°C

    def take(self, segment: int, values: Sequence[int]) -> None:
        """One heartbeat of a segment. Segments of one boot id are one boot: a frame that came late looks like a restart."""
        beat = {name: value for (name, _), value in zip(_ELEMENTS, values, strict=False)}
        boot = self._boots.setdefault(beat["boot_id"], _Boot(segment, beat, beat))
        if beat["t_us"] >= boot.last["t_us"]:  # else it came late and says nothing new
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
        """Return the number of heartbeats, the sum of every counter and the worst of every extreme, None without one.

        ``booted``: the segments that began with a boot in the session.
        """
        total = Counter[str]()
        for boot in self._boots.values():
            total.update(boot.since)
            if boot.segment in booted:
                total.update({name: boot.first.get(name, 0) for name in COUNTERS})
        return {"heartbeats": self._n, **{name: total[name] for name in COUNTERS}, **self._worst}


# ------------------------------------------------------------------------------------------------------------- accounts

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
