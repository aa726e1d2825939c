"""Put the frames of a box into the order of sending, and tell a loss, a late frame and a restart apart.

Frames leave ``FrameOrder`` in the order in which the box sent them, regardless of the order of arrival. All frames
share one ``seq`` counter (SPEC §4). A link or a damaged file may deliver frames late, twice or never, and a box that
restarts begins a new count. The boot id decides which of these it is. Heartbeats state it, one a second, and so does the
first page of the ident that a box sends at boot. The first of these rules that applies classifies a frame:

1. *The next frame, or one ahead of it*, belongs to the count: it is ahead by no more than the link can have carried
   since (``too_many``), its device time does not run backward, and it states no other boot id. It waits until all
   earlier frames have arrived or until a frame REACH later has arrived; frames still missing then are **lost**. A late
   frame within that reach takes its place.
2. *A frame that is remembered* under its seq with the same bytes is **doubled**.
3. *A frame of an earlier boot*, by its device time (``_is_of_old``) or by the boot id of a first page, is **late** if
   its seq is missing in that count and doubled otherwise.
4. *A first page with a new boot id* begins a new count: a **restart**.
5. *Any other frame is a suspect* until the next boot id: one behind, one far ahead, one that follows suspects, and one
   after a hole that arrived DELAYED_NS later than its device time says. If the boot id is a new one, a new count begins
   with the suspects. If it is that of the count, a suspect ahead follows a hole; one behind is late or doubled,
   however long ago it was sent. The same holds if the count itself continues first, but then a suspect too far ahead is
   **malformed**. A boot id of an earlier count decides nothing. If the box cannot have sent so many frames in the device
   time in between (``_is_elsewhere``), its count goes on elsewhere: a new count, and nobody knows what was lost.

**What cannot be decided** is decided by number: 2 · REACH suspects in a row without a new boot id are a restart, and
LONELY_RUN of them if the count itself has no boot id. Fewer frames of a boot of which neither the first page nor a
heartbeat arrived are counted as late or doubled, or as frames after a hole if their numbers are higher. So are the frames
of a new boot that arrive before the last ones of the previous boot. Frames of an earlier boot that arrive late are not
among its lost ones if they were sent after the last frame that arrived in time.

Frames arrive in runs (``box_frames``): seq increases by one, device times do not run backward, and all heartbeats have
the same boot id. What holds for the first frame of a run therefore holds for as many frames as ``_belonging`` returns.
A single frame is a run of one.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import NamedTuple

from truearm.session.box_frames import too_many
from truearm.session.frame_columns import CIRCLE, FrameRun

REACH = 512  # frames that a late one may lag behind: some seconds, less than sessions hold back for late messages
DELAYED_NS = 2_000_000_000  # longer than a block of samples lasts and than a link usually delays
LONELY_RUN = 64  # suspects in a row that are another count, if this one has no boot id
FORMER = 100  # counts before this one that are remembered
BEFORE_FIRST = 16  # frames that the first one of a session, or the first with a time of a count, may have overtaken
HOLES = 1000  # remembered, to tell late frames from doubled ones
_HALF = CIRCLE // 2


class Placed(NamedTuple):
    """Frames in order. ``lost``: frames missing before the first; ``restarts``: the first frame begins a new count.

    ``at``: row of the newest batch that released the frames, unless the frames themselves arrived later. ``waited``: the
    first frames of the new count were missing, so the restart was certain before these frames were released.
    """

    run: FrameRun
    lost: int
    restarts: bool
    at: int
    waited: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """A waiting run; ``count`` is that of its first frame."""

    count: int
    run: FrameRun

    @property
    def end(self) -> int:
        return self.count + len(self.run)


_COUNT = attrgetter("count")


class _Remembered:
    """The newest 2 · REACH frames of a count, by seq."""

    def __init__(self) -> None:
        self._parts: deque[tuple[int, int, FrameRun]] = deque()  # in order of acceptance, each with its seq and length
        self._n = 0
        self._by_seq: dict[int, tuple[int, FrameRun]] = {}  # of these: length and frames, by the first seq
        self._long: set[int] = set()  # the first seq of those with more than one frame

    def add(self, run: FrameRun) -> None:
        """Remember a run; the oldest frames are forgotten."""
        self._parts.append((run.seq, len(run), run))
        self._index(run.seq, len(run), run)
        self._n += len(run)
        while self._n > 2 * REACH:
            seq, n, oldest = self._parts.popleft()
            self._by_seq.pop(seq, None)
            self._long.discard(seq)
            forgotten = oldest.first(min(n, self._n - 2 * REACH))
            self._n -= len(forgotten)
            if len(forgotten) < n:
                rest = oldest.after(forgotten)
                self._parts.appendleft(((seq + len(forgotten)) % CIRCLE, len(rest), rest))
                self._index(*self._parts[0])

    def payload(self, asked: int) -> bytes | None:
        """Return the bytes of the frame with this seq; None if it is not remembered."""
        for seq in (asked, *self._long):
            found = self._by_seq.get(seq)
            if found is not None and (asked - seq) % CIRCLE < found[0]:
                known = found[1]
                return known.after(known.first((asked - seq) % CIRCLE)).payload
        return None

    def _index(self, seq: int, n: int, run: FrameRun) -> None:
        self._by_seq[seq] = n, run
        if n > 1:
            self._long.add(seq)


class _Old(NamedTuple):
    """A count before a restart. ``born_ns``: host time of its device time 0 [ns]."""

    newest_seq: int
    born_ns: int | None
    remembered: _Remembered
    holes: list[tuple[int, int]]


@dataclass
class FrameOrder:
    """Takes runs in order of arrival and returns them in the order of sending.

    ``doubled``, ``late`` and ``malformed`` count the other frames.
    """

    doubled: int = 0
    late: int = 0
    malformed: int = 0
    _next: int = -1  # the count to be returned next, unwrapped; -1: no frame yet
    _newest: int = 0  # the highest count so far
    _newest_host_ns: int = 0
    _born_ns: int | None = None  # host time of device time 0, by the newest frame that has a time
    _uncounted: int = 0  # missing frames below this were sent before the session began
    _waiting: list[_Held] = field(default_factory=list)  # by ascending count
    _remembered: _Remembered = field(default_factory=_Remembered)
    _holes: list[tuple[int, int]] = field(default_factory=list)  # the first lost count, and the first after it
    _times: dict[int, int] = field(default_factory=dict)  # newest device time of each kind
    _placed_times: dict[int, int] = field(default_factory=dict)  # of the frames already returned
    _boot_id: int | None = None
    _restarting: bool = False  # the next frame returned is the first of a count
    _waiting_restart: bool = False  # and it is held, because frames before it are missing
    _former: list[_Old] = field(default_factory=list)
    _old_until: int = 0  # below this count, frames of the old count may arrive between those of this one
    _old_seq: int | None = None  # of the newest frame taken as one of the old count
    _left: set[int] = field(default_factory=set)  # the boot ids of earlier counts
    _suspects: list[FrameRun] = field(default_factory=list)  # of one frame each
    _far: bool = False  # the suspects lie too far ahead

    @property
    def undecided(self) -> bool:
        """Whether frames are held that are not classified yet, or that begin a new count."""
        return bool(self._suspects) or self._waiting_restart

    def parts(self, run: FrameRun) -> Iterator[FrameRun]:
        """Yield a run in parts that can each be taken at once. Take each part before requesting the next."""
        while len(run):
            head = run.first(max(1, self._belonging(run)))
            yield head
            run = run.after(head)

    def take(self, part: FrameRun) -> Iterator[Placed]:
        """Take a part of a run and return the frames that are now due, in order."""
        yield from self._take(part, part.row)

    def finish(self, at: int) -> Iterator[Placed]:
        """Return the frames still held, at the end of the session."""
        yield from self._dismiss(at)
        yield from self._all_waiting(at)

    def new_boot(self, boot_id: int) -> None:
        """Note the boot id stated by the box; the current count continues."""
        if self._boot_id not in (None, boot_id):
            self._left.add(self._boot_id)
        self._boot_id = boot_id
        self._left.discard(boot_id)

    def _take(self, run: FrameRun, at: int) -> Iterator[Placed]:
        """Take frames that belong to the count, or a single frame for which this is not known."""
        if len(run) > 1 or self._belonging(run):
            yield from self._accept(run, at)
        elif self._is_doubled(run):
            self.doubled += 1
        elif self._is_of_old(run):
            self._old_seq = run.seq
            self._count_unused(run, of_old=True)
        elif self._next < 0:
            yield from self._begin(run, max(0, run.seq - BEFORE_FIRST), run.seq, at)
        elif run.is_boot and self._is_known(run):
            self._count_unused(run)
        elif run.is_boot:
            yield from self._dismiss(at)
            yield from self._restart([run], at)
        else:
            yield from self._suspect(run, at)

    # ------------------------------------------------------------------------------------------------ the count

    def _begin(self, run: FrameRun, first: int, uncounted: int, at: int) -> Iterator[Placed]:
        self._next, self._newest, self._uncounted = first, run.seq - 1, uncounted
        self._newest_host_ns = run.t_host_ns
        yield from self._accept(run, at)

    def _unwrapped(self, seq: int) -> int:
        """Return the unwrapped count of a seq: the one nearest to the newest."""
        return self._newest + _apart(seq, self._newest)

    def _belonging(self, run: FrameRun) -> int:
        """Return how many of the first frames of a run belong to this count and are still awaited."""
        young = self._is_young()
        follows = run.seq == (self._newest + 1) % CIRCLE and not young
        if self._suspects and run.seq == (self._suspects[-1].seq + 1) % CIRCLE:
            return 0
        if self._next < 0 or (not follows and self._is_of_old(run)) or self._is_delayed(run):
            return 0
        n = self._awaited(run)
        beat, boot_id = run.first_heartbeat()
        if self._boot_id is not None and boot_id not in (None, self._boot_id):
            n = min(n, beat - run.begin)
        if self._waiting and beat > run.begin:  # waiting frames that this run releases may state the boot id
            n = min(n, beat - run.begin)
        alone = self._suspects or (self._former and not follows)  # each frame may be of a former count
        return min(n, 1) if alone else n

    def _is_young(self) -> bool:
        """Return whether frames of the old count may arrive between those of this one."""
        return bool(self._former) and self._newest < self._old_until

    def _is_known(self, run: FrameRun) -> bool:
        """Return whether a frame states the boot id of this count or of an earlier one."""
        _, boot_id = run.first_heartbeat()
        return boot_id is not None and (boot_id == self._boot_id or boot_id in self._left)

    def _is_missing(self, run: FrameRun) -> bool:
        """Return whether this count, or a former one, has lost a frame with this seq."""
        count = self._unwrapped(run.seq)
        if any(begin <= count < end for begin, end in self._holes):
            return True
        return any(
            0 < _apart(run.seq, old.newest_seq) <= REACH
            or any((run.seq - begin) % CIRCLE < end - begin for begin, end in old.holes)
            for old in self._former
        )

    def _awaited(self, run: FrameRun, far: bool = False) -> int:
        """Return for how many of the first frames of a run this count has a place; ``far``: however far ahead."""
        count, n = self._unwrapped(run.seq), len(run)
        if count < max(self._next, 0):
            return 0
        if count > self._newest:
            if self._is_far(run) and not far:
                return 0
            times = self._times
        else:  # late: sent after all frames already returned
            place = bisect_left(self._waiting, count, key=_COUNT)
            if (place and count < self._waiting[place - 1].end) or self._waiting[place].count == count:
                return 0
            n = min(n, self._waiting[place].count - count)
            times = self._placed_times
        if run.is_boot and self._times and not self._is_known(run):
            return 0  # a box sends its boot ident before any frame with a time
        for kind, frame, t_us, _ in run.times():
            if t_us < times.get(kind, 0):
                n = min(n, frame - run.begin)
        return n

    def _is_far(self, run: FrameRun) -> bool:
        """Return whether a frame lies further ahead than frames can have arrived since the newest."""
        return too_many(self._unwrapped(run.seq) - self._newest, run.t_host_ns - self._newest_host_ns)

    def _is_delayed(self, run: FrameRun) -> bool:
        """Return whether a frame after a hole or a suspect arrived much later than its device time says.

        It was held up, or it is of a later boot.
        """
        if self._boot_id is None or self._born_ns is None:
            return False
        if self._unwrapped(run.seq) <= self._newest + (not self._suspects):
            return False
        born_ns = run.born_ns
        return born_ns is not None and born_ns - self._born_ns > DELAYED_NS

    def _is_of_old(self, run: FrameRun) -> bool:
        """Return whether a frame is of the count before the restart: by its device time, or by its seq if it has none.

        A frame without a time that follows one of the old count is of that count too.

        A frame that arrives late seems to be of a later boot, never of an earlier one.
        """
        old = self._former[-1] if self._former else None
        if old is None or old.born_ns is None or self._born_ns is None or self._born_ns - old.born_ns <= DELAYED_NS:
            return False
        born_ns = run.born_ns
        if born_ns is None:
            near = abs(_apart(run.seq, old.newest_seq)) <= REACH < abs(_apart(run.seq, self._newest))
            follows = self._old_seq is not None and run.seq == (self._old_seq + 1) % CIRCLE
            return (near or follows) and self._is_young() and not run.is_boot
        if not self._times and 0 < _apart(run.seq, self._newest) <= BEFORE_FIRST:
            return False  # the first page may have waited for the link: it does not tell when the box booted
        return 2 * born_ns < old.born_ns + self._born_ns

    def _accept(self, run: FrameRun, at: int) -> Iterator[Placed]:
        held = _Held(self._unwrapped(run.seq), run)
        continues = held.count > self._newest
        self._waiting.insert(bisect_left(self._waiting, held.count, key=_COUNT), held)
        self._remembered.add(run)
        if continues:
            self._newest, self._newest_host_ns = held.end - 1, run.last_host_ns
            born_ns = run.last_born_ns
            self._born_ns = self._born_ns if born_ns is None else born_ns
            if self._former and self._newest >= self._old_until:
                self._former[-1] = self._former[-1]._replace(remembered=_Remembered())
        for kind, _, _, t_us in run.times():
            self._times[kind] = max(t_us, self._times.get(kind, 0))
        _, boot_id = run.first_heartbeat()
        if self._boot_id is None and boot_id is not None:
            self.new_boot(boot_id)
        if continues:
            yield from self._dismiss(at)
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
        """Return the first waiting run."""
        held = self._waiting.pop(0)
        count, run = held.count, held.run
        lost = 0
        if count > self._next:
            lost = max(0, count - max(self._next, self._uncounted))
            self._holes = [*self._holes[-HOLES:], (self._next, count)]
        restarts, self._restarting = self._restarting, False
        waited, self._waiting_restart = self._waiting_restart, False
        self._next = count + len(run)
        for kind, _, _, t_us in run.times():
            self._placed_times[kind] = t_us
        return Placed(run, lost, restarts, at, waited)

    def _is_doubled(self, run: FrameRun) -> bool:
        """Return whether the bytes of a frame are remembered."""
        stores = [self._remembered, *(old.remembered for old in self._former[-1:])]
        payload = run.payload
        return any(store.payload(run.seq) == payload for store in stores)

    # ------------------------------------------------------------------------------------------------ another count

    def _suspect(self, run: FrameRun, at: int) -> Iterator[Placed]:
        if self._suspects and abs(_apart(run.seq, self._suspects[-1].seq)) > REACH:
            yield from self._dismiss(at)
        if not self._suspects:
            self._far = self._is_far(run)
        self._suspects.append(run)
        _, boot_id = run.first_heartbeat()
        stated = None not in (boot_id, self._boot_id)
        same = stated and boot_id == self._boot_id
        elsewhere = same and self._is_elsewhere(run)
        self._far |= elsewhere
        if (
            (stated and not same and boot_id not in self._left)
            or self._enough()
            or (elsewhere and len(self._suspects) > 1)
        ):
            suspects, self._suspects = self._suspects, []
            yield from self._restart(suspects, at)
        elif same and not elsewhere:
            yield from self._dismiss(at, ours=True)

    def _is_elsewhere(self, run: FrameRun) -> bool:
        """Return whether more frames would be missing than any link carries in the device time since the newest frame."""
        born_ns = run.born_ns
        if born_ns is None or self._born_ns is None:
            return self._is_far(run)
        device_ns = (run.t_host_ns - born_ns) - (self._newest_host_ns - self._born_ns)
        return too_many(self._unwrapped(run.seq) - self._newest, device_ns)

    def _enough(self) -> bool:
        """Return whether so many suspects in a row are another count although no boot id says so."""
        return len(self._suspects) >= (LONELY_RUN if self._boot_id is None else 2 * REACH)

    def _restart(self, runs: Sequence[FrameRun], at: int) -> Iterator[Placed]:
        """Begin a new count with these frames; the old one is closed."""
        yield from self._all_waiting(at)
        first, far = runs[0], self._far
        old = _Old(self._newest % CIRCLE, self._born_ns, self._remembered, self._holes)
        self._former = [*(one._replace(remembered=_Remembered()) for one in self._former[-FORMER:]), old]
        self._born_ns = next((run.born_ns for run in runs if run.born_ns is not None), None)
        if first.is_boot:
            self._born_ns = first.t_host_ns
        self._remembered, self._holes, self._times, self._placed_times = _Remembered(), [], {}, {}
        if self._boot_id is not None:
            self._left.add(self._boot_id)
        self._boot_id, self._restarting, self._far, self._old_seq = None, True, False, None
        self._old_until = first.seq + REACH
        # A box counts from 0. A count that lies too far ahead gives no information about losses.
        from_ = first.seq if far else 0
        yield from self._begin(first, from_, from_, at)
        self._waiting_restart = self._restarting
        for run in runs[1:]:
            yield from self._take(run, at)

    def _dismiss(self, at: int, ours: bool = False) -> Iterator[Placed]:
        """Release the suspects: no new count begins with them. ``ours``: the boot id says that they are of this count."""
        suspects, self._suspects = self._suspects, []
        self._far = False
        for run in suspects:
            _, boot_id = run.first_heartbeat()
            other = None not in (boot_id, self._boot_id) and boot_id != self._boot_id
            if self._awaited(run, far=ours) and not other:
                yield from self._accept(run, at)
            else:
                self._count_unused(run)

    def _count_unused(self, run: FrameRun, of_old: bool = False) -> None:
        """Count a frame that arrived too late, twice, or with a seq that no count has reached."""
        reached = any(_apart(run.seq, old.newest_seq) <= REACH for old in self._former)
        if self._is_far(run) and not reached:
            self.malformed += 1
        elif self._is_missing(run) or (not of_old and self._unwrapped(run.seq) >= self._next - 2 * REACH):
            self.late += 1
        else:
            self.doubled += 1  # it arrived once already, longer ago than bytes are remembered


def _apart(seq: int, other: int) -> int:
    """Return how far a seq lies ahead of another, around the circle."""
    return (seq - other + _HALF) % CIRCLE - _HALF
