"""Frames in the order in which the box sent them, however they arrived, and what is missing between them (hop 4).

Every frame from the box counts in one ``seq`` (SPEC §4). A link or a damaged file may deliver frames late, twice or never, and
a box that restarts begins a new count. What a frame is, is decided in this order:

1. The bytes of a frame that is remembered under its seq: **doubled**. It changes nothing.
2. The first page of the ident that a box sends unasked at boot: a **restart**.
3. The next frame, or one ahead of it by no more than the link can have carried since (``too_many``) and with a device time that
   does not run backward: it belongs to the count. It waits until those before it have come, or until a frame REACH further on has; what has not
   come by then is **lost**. A frame that arrives late within that reach takes its place.
4. All others are **suspects**. They begin a new count if a heartbeat among them has another boot id, if BEHIND_RUN of them follow each other without a frame of
   the old count between, or FAR_RUN where they lie too far ahead. As soon as the old count goes on they are dismissed: frames that came **too late**,
   or that are **malformed** because nothing can have counted so far.

So neither a late frame nor a doubled one is a restart: the boot id decides.

Frames come in runs (``frame_columns``), whose seq goes on by one, whose device times do not run backward and whose heartbeats are of one boot. What holds
for the first frame of a run therefore holds for as many more as ``_belonging`` says; a frame alone is a run of one.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import NamedTuple

from truearm.session.box_frames import too_many
from truearm.session.frame_columns import CIRCLE, Run

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
        self._n_remembered += len(run)
        while self._n_remembered > 2 * REACH:
            seq, n, oldest = self._remembered.popleft()
            forgotten = oldest.first(min(n, self._n_remembered - 2 * REACH))
            self._n_remembered -= len(forgotten)
            if len(forgotten) < n:
                rest = oldest.after(forgotten)
                self._remembered.appendleft(((seq + len(forgotten)) % CIRCLE, len(rest), rest))

    def _is_doubled(self, run: Run) -> bool:
        """Whether the bytes of a frame are remembered under its seq."""
        asked = run.seq
        for seq, n, known in self._remembered:
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
