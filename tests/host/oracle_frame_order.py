"""Frames in the order in which the box sent them, however they arrived, and what is missing between them.

The rules are those of ``truearm.session.losses``, each written for one frame.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from truearm.session.box_frames import too_many

REACH = 512  # frames that a late one may lag behind: some seconds, less than sessions hold back for late messages
DELAYED_NS = 2_000_000_000
LONELY_RUN = 64
FORMER = 100
BEFORE_FIRST = 16  # frames that the first one of a session may have overtaken
HOLES = 1000
CIRCLE = 2**32


class Frame(NamedTuple):
    """A frame as it arrived; ``stamp`` is the kind of its device time and the time [µs], None for a frame without."""

    seq: int
    stamp: tuple[int, int] | None
    is_boot: bool  # first page of the ident that a box sends unasked at boot
    boot_id: int | None  # that it states
    t_host_ns: int
    payload: bytes
    content: Any  # the decoded content

    @property
    def born_ns(self) -> int | None:
        """Host time at which the device time was 0."""
        return None if self.stamp is None else self.t_host_ns - 1000 * self.stamp[1]


class Placed(NamedTuple):
    """A frame in its place. ``lost``: frames missing before it; ``restarts``: it is the first of a new count."""

    frame: Frame
    lost: int
    restarts: bool


@dataclass
class FrameOrder:
    """Take frames as they arrive and return them in the order of sending.

    ``doubled``, ``late`` and ``malformed`` count the others.
    """

    doubled: int = 0
    late: int = 0
    malformed: int = 0
    _next: int = -1  # the next count to return, unwrapped; -1: no frame yet
    _newest: int = 0  # the highest count so far
    _newest_host_ns: int = 0
    _born_ns: int | None = None
    _uncounted: int = 0  # missing frames below this were sent before the session began
    _waiting: dict[int, Frame] = field(default_factory=dict)
    _remembered: OrderedDict[int, bytes] = field(default_factory=OrderedDict)  # payloads by seq
    _times: dict[int, int] = field(default_factory=dict)  # newest device time of each kind
    _placed_times: dict[int, int] = field(default_factory=dict)  # of the returned frames
    _boot_id: int | None = None
    _restarting: bool = False  # the next returned frame is the first of a count
    _suspects: list[Frame] = field(default_factory=list)
    _far: bool = False  # the suspects are too far ahead
    _holes: list[range] = field(default_factory=list)  # what was given up
    # of each count before: newest seq, born_ns, payloads by seq, what was given up
    _former: list[tuple[int, int | None, OrderedDict[int, bytes], list[range]]] = field(default_factory=list)
    _old_until: int = 0
    _old_seq: int | None = None  # of the newest frame taken as one of the count before
    _left: set[int] = field(default_factory=set)  # boot ids of earlier counts

    @property
    def undecided(self) -> bool:
        """Return whether frames are held that cannot be classified yet."""
        return bool(self._suspects) or self._restarting

    def follows(self, seq: int, stamp: tuple[int, int], t_host_ns: int, payload: bytes) -> bool:
        """Take a frame that is simply the next one, like almost all, and is due at once; return False for any other."""
        kind, time = stamp
        if (
            self._is_young()
            or self._waiting
            or self._suspects
            or self._next < 0
            or seq != self._next % CIRCLE
            or self._restarting
        ):
            return False
        if time < self._times.get(kind, 0):
            return False
        self._newest, self._newest_host_ns, self._next = self._next, t_host_ns, self._next + 1
        self._times[kind] = self._placed_times[kind] = time
        self._born_ns = t_host_ns - 1000 * time
        self._remember(seq, payload)
        return True

    def take(self, frame: Frame) -> Iterator[Placed]:
        """Take one frame; return those that are due, in order."""
        if self._belongs(frame):
            yield from self._accept(frame)
        elif self._is_doubled(frame):
            self.doubled += 1
        elif self._is_of_old(frame):
            self._old_seq = frame.seq
            self._count_unused(frame, of_old=True)
        elif self._next < 0:
            yield from self._begin(frame, max(0, frame.seq - BEFORE_FIRST), frame.seq)
        elif frame.is_boot and self._is_known(frame):
            self._count_unused(frame)
        elif frame.is_boot:
            yield from self._dismiss()
            yield from self._restart([frame])
        else:
            yield from self._suspect(frame)

    def finish(self) -> Iterator[Placed]:
        """Return the frames still held, at the end of the session."""
        yield from self._dismiss()
        yield from self._given_up(everything=True)

    def new_boot(self, boot_id: int) -> None:
        """Set the boot reported by the box; the count continues."""
        if self._boot_id not in (None, boot_id):
            self._left.add(self._boot_id)
        self._boot_id = boot_id
        self._left.discard(boot_id)

    # ------------------------------------------------------------------------------------------------ the count

    def _begin(self, frame: Frame, first: int, uncounted: int) -> Iterator[Placed]:
        self._next, self._newest, self._uncounted = first, frame.seq - 1, uncounted
        self._newest_host_ns = frame.t_host_ns
        yield from self._accept(frame)

    def _unwrapped(self, seq: int) -> int:
        """Return the count that a seq represents: the nearest to the newest one."""
        half = CIRCLE // 2
        return self._newest + (seq - self._newest + half) % CIRCLE - half

    def _belongs(self, frame: Frame) -> bool:
        """Return whether a frame belongs to this count and is still expected."""
        if self._suspects and frame.seq == (self._suspects[-1].seq + 1) % CIRCLE:
            return False
        follows = frame.seq == (self._newest + 1) % CIRCLE and not self._is_young()
        if self._next < 0 or (not follows and self._is_of_old(frame)) or self._is_delayed(frame):
            return False
        if self._boot_id is not None and frame.boot_id not in (None, self._boot_id):
            return False
        return self._awaited(frame)

    def _is_young(self) -> bool:
        """Return whether frames of the count before may still arrive among those of this one."""
        return bool(self._former) and self._newest < self._old_until

    def _is_known(self, frame: Frame) -> bool:
        """Return whether a frame states the boot id of this count or of an earlier one."""
        return frame.boot_id is not None and (frame.boot_id == self._boot_id or frame.boot_id in self._left)

    def _is_missing(self, frame: Frame) -> bool:
        """Return whether this count, or the one before, has lost a frame of this seq."""
        count = self._unwrapped(frame.seq)
        if any(count in hole for hole in self._holes):
            return True
        for newest, _, _, holes in self._former:
            if 0 < apart(frame.seq, newest) <= REACH:
                return True
            if any((frame.seq - hole.start) % CIRCLE < len(hole) for hole in holes):
                return True
        return False

    def _awaited(self, frame: Frame, far: bool = False) -> bool:
        count = self._unwrapped(frame.seq)
        if count < self._next or count in self._waiting:
            return False
        if frame.is_boot and self._times and not self._is_known(frame):
            return False  # the frames of a boot are sent before everything with a time
        kind, time = frame.stamp or (None, 0)
        if count <= self._newest:  # late: sent after all returned frames
            return kind is None or time >= self._placed_times.get(kind, 0)
        if self._is_far(frame) and not far:
            return False
        return kind is None or time >= self._times.get(kind, 0)

    def _is_delayed(self, frame: Frame) -> bool:
        """Return whether a frame after a hole was held up, or is of a later boot."""
        count = self._unwrapped(frame.seq)
        doubtful = count > self._newest + 1 or (count > self._newest and self._suspects)
        if not doubtful or None in (self._boot_id, self._born_ns, frame.born_ns):
            return False
        return frame.born_ns - self._born_ns > DELAYED_NS

    def _is_of_old(self, frame: Frame) -> bool:
        """Return whether a frame is of the count before the restart."""
        if not self._former or self._born_ns is None:
            return False
        newest_seq, old_born_ns, _, _ = self._former[-1]
        if old_born_ns is None or self._born_ns - old_born_ns <= DELAYED_NS:
            return False
        if frame.born_ns is None:
            near = abs(apart(frame.seq, newest_seq)) <= REACH < abs(apart(frame.seq, self._newest))
            follows = self._old_seq is not None and frame.seq == (self._old_seq + 1) % CIRCLE
            return (near or follows) and self._is_young() and not frame.is_boot
        if not self._times and 0 < apart(frame.seq, self._newest) <= BEFORE_FIRST:
            return False  # the first page may have waited for the link: it does not tell when the box booted
        return abs(frame.born_ns - old_born_ns) < abs(frame.born_ns - self._born_ns)

    def _is_doubled(self, frame: Frame) -> bool:
        stores = [self._remembered, *(old[2] for old in self._former[-1:])]
        return any(store.get(frame.seq) == frame.payload for store in stores)

    def _is_far(self, frame: Frame) -> bool:
        """Return whether a frame is further ahead than frames can have arrived since the newest."""
        return too_many(self._unwrapped(frame.seq) - self._newest, frame.t_host_ns - self._newest_host_ns)

    def _accept(self, frame: Frame) -> Iterator[Placed]:
        count = self._unwrapped(frame.seq)
        self._waiting[count] = frame
        self._remember(frame.seq, frame.payload)
        continues = count > self._newest
        if frame.stamp is not None:
            kind, time = frame.stamp
            self._times[kind] = max(time, self._times.get(kind, 0))
        if frame.boot_id is not None and self._boot_id is None:
            self.new_boot(frame.boot_id)
        if continues:
            self._newest, self._newest_host_ns = count, frame.t_host_ns
            if frame.born_ns is not None:
                self._born_ns = frame.born_ns
            if self._former and count >= self._old_until:
                self._forget_bytes()
            yield from self._dismiss()
        yield from self._given_up(everything=False)

    def _forget_bytes(self) -> None:
        self._former = [(newest, born_ns, OrderedDict(), holes) for newest, born_ns, _, holes in self._former]

    def _remember(self, seq: int, payload: bytes) -> None:
        self._remembered[seq] = payload
        if len(self._remembered) > 2 * REACH:
            self._remembered.popitem(last=False)

    def _given_up(self, everything: bool) -> Iterator[Placed]:
        """Return the frames for which nothing is expected any more."""
        while self._waiting:
            lost = 0
            if self._next not in self._waiting:
                if not everything and self._newest - self._next < REACH:
                    return
                there = min(self._waiting)
                lost = max(0, there - max(self._next, self._uncounted))
                self._holes = [*self._holes[-HOLES:], range(self._next, there)]
                self._next = there
            frame, restarts = self._waiting.pop(self._next), self._restarting
            self._next, self._restarting = self._next + 1, False
            if frame.stamp is not None:
                self._placed_times[frame.stamp[0]] = frame.stamp[1]
            yield Placed(frame, lost, restarts)

    # ------------------------------------------------------------------------------------------------ another count

    def _suspect(self, frame: Frame) -> Iterator[Placed]:
        if self._suspects and abs(apart(frame.seq, self._suspects[-1].seq)) > REACH:
            yield from self._dismiss()
        if not self._suspects:
            self._far = self._is_far(frame)
        self._suspects.append(frame)
        enough = LONELY_RUN if self._boot_id is None else 2 * REACH
        stated = frame.boot_id is not None and self._boot_id is not None
        new = stated and frame.boot_id != self._boot_id and frame.boot_id not in self._left
        same = stated and frame.boot_id == self._boot_id
        elsewhere = same and self._is_elsewhere(frame)
        if elsewhere:
            self._far = True
        if new or len(self._suspects) >= enough or (elsewhere and len(self._suspects) >= 2):
            suspects, self._suspects = self._suspects, []
            yield from self._restart(suspects)
        elif same and not elsewhere:
            yield from self._dismiss(ours=True)

    def _is_elsewhere(self, frame: Frame) -> bool:
        """Return whether the box cannot have sent so many frames since the newest one."""
        if frame.born_ns is None or self._born_ns is None:
            return self._is_far(frame)
        now_ns, newest_ns = frame.t_host_ns - frame.born_ns, self._newest_host_ns - self._born_ns
        return too_many(self._unwrapped(frame.seq) - self._newest, now_ns - newest_ns)

    def _restart(self, frames: list[Frame]) -> Iterator[Placed]:
        """Begin a new count with these frames; the old one is finished."""
        yield from self._given_up(everything=True)
        first, far = frames[0], self._far
        self._forget_bytes()
        old = self._newest % CIRCLE, self._born_ns, self._remembered, self._holes
        self._former, self._old_until = [*self._former[-FORMER:], old], first.seq + REACH
        born = [frame.born_ns for frame in frames if frame.born_ns is not None]
        self._born_ns = first.t_host_ns if first.is_boot else born[0] if born else None
        self._remembered, self._holes, self._times, self._placed_times = OrderedDict(), [], {}, {}
        if self._boot_id is not None:
            self._left.add(self._boot_id)
        self._boot_id, self._restarting, self._far, self._old_seq = None, True, False, None
        # The count of a box begins at 0; one that is too far ahead gives no information on losses.
        from_ = first.seq if far else 0
        yield from self._begin(first, from_, from_)
        for frame in frames[1:]:
            yield from self.take(frame)

    def _dismiss(self, ours: bool = False) -> Iterator[Placed]:
        """Release the suspects; ``ours``: the boot id says that they are of this count."""
        suspects, self._suspects = self._suspects, []
        self._far = False
        for frame in suspects:
            other = None not in (frame.boot_id, self._boot_id) and frame.boot_id != self._boot_id
            if self._awaited(frame, far=ours) and not other:
                yield from self._accept(frame)
            else:
                self._count_unused(frame)

    def _count_unused(self, frame: Frame, of_old: bool = False) -> None:
        """Count a frame that arrived too late, twice, or with a seq that no count has reached."""
        count = self._unwrapped(frame.seq)
        reached = any(apart(frame.seq, old[0]) <= REACH for old in self._former)
        if self._is_far(frame) and not reached:
            self.malformed += 1
        elif self._is_missing(frame) or (not of_old and count >= self._next - 2 * REACH):
            self.late += 1
        else:
            self.doubled += 1


def apart(seq: int, other: int) -> int:
    """Return how far a seq is ahead of another one on the circle."""
    return (seq - other + CIRCLE // 2) % CIRCLE - CIRCLE // 2
