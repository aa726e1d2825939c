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
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from truearm.session.box_frames import too_many

REACH = 512  # frames that a late one may lag behind: some seconds of a box, less than what sessions hold back for late messages
BEHIND_RUN = 64  # a heartbeat comes once in 80 to 350 frames and is hardly ever lost
FAR_RUN = 2
BEFORE_FIRST = 16  # frames that may have been overtaken by the first one of a session
CIRCLE = 2**32


class Frame(NamedTuple):
    """A frame as it arrived; ``stamp`` is the kind of its device time and the time [µs], None for a frame without."""

    seq: int
    stamp: tuple[int, int] | None
    is_boot: bool  # first page of the ident that a box sends unasked at boot
    boot_id: int | None  # of a heartbeat
    t_host_ns: int
    payload: bytes
    content: Any  # what it was decoded to


class Placed(NamedTuple):
    """A frame in its place. ``lost``: frames missing before it; ``restarts``: it is the first of a new count."""

    frame: Frame
    lost: int
    restarts: bool


@dataclass
class FrameOrder:
    """Takes frames as they arrive and gives them back in the order of sending; ``doubled``, ``late`` and ``malformed`` count the others."""

    doubled: int = 0
    late: int = 0
    malformed: int = 0
    _next: int = -1  # the count that is given back next, unwrapped; -1: no frame was taken yet
    _newest: int = 0  # the highest count that was taken
    _newest_host_ns: int = 0
    _uncounted: int = 0  # below it, missing frames were sent before the session began
    _waiting: dict[int, Frame] = field(default_factory=dict)
    _remembered: OrderedDict[int, bytes] = field(default_factory=OrderedDict)  # payloads by seq
    _times: dict[int, int] = field(default_factory=dict)  # newest device time of each kind
    _placed_times: dict[int, int] = field(default_factory=dict)  # of the frames that were given back
    _boot_id: int | None = None
    _restarting: bool = False  # the next frame that is given back is the first of a count
    _suspects: list[Frame] = field(default_factory=list)
    _far: bool = False  # the suspects lie too far ahead

    @property
    def undecided(self) -> bool:
        """Whether frames are held of which nobody knows yet what they are."""
        return bool(self._suspects)

    def follows(self, seq: int, stamp: tuple[int, int], t_host_ns: int, payload: bytes) -> bool:
        """Take a frame that is simply the next one, as nearly all are, and is due at once; False for any other."""
        kind, time = stamp
        if self._waiting or self._suspects or self._next < 0 or seq != self._next % CIRCLE or self._restarting:
            return False
        if time < self._times.get(kind, 0):
            return False
        self._newest, self._newest_host_ns, self._next = self._next, t_host_ns, self._next + 1
        self._times[kind] = self._placed_times[kind] = time
        self._remember(seq, payload)
        return True

    def take(self, frame: Frame) -> Iterator[Placed]:
        """Take one frame; those that are due by then, in order."""
        if self._remembered.get(frame.seq) == frame.payload:
            self.doubled += 1
        elif self._next < 0:
            yield from self._begin(frame, max(0, frame.seq - BEFORE_FIRST), frame.seq)
        elif self._belongs(frame):
            yield from self._accept(frame)
        elif frame.is_boot:
            self._dismiss()
            yield from self._restart([frame])
        else:
            yield from self._suspect(frame)

    def finish(self) -> Iterator[Placed]:
        """What is still held, at the end of the session."""
        self._dismiss()
        yield from self._given_up(everything=True)

    def new_boot(self, boot_id: int) -> None:
        """The box said that it is of this boot; what is counted goes on."""
        self._boot_id = boot_id

    # ------------------------------------------------------------------------------------------------ the count

    def _begin(self, frame: Frame, first: int, uncounted: int) -> Iterator[Placed]:
        self._next, self._newest, self._uncounted = first, frame.seq - 1, uncounted
        self._newest_host_ns = frame.t_host_ns
        yield from self._accept(frame)

    def _unwrapped(self, seq: int) -> int:
        """The count that a seq stands for: the nearest to the newest one."""
        half = CIRCLE // 2
        return self._newest + (seq - self._newest + half) % CIRCLE - half

    def _belongs(self, frame: Frame) -> bool:
        """Whether a frame is of this count and is still waited for (rule 3)."""
        count = self._unwrapped(frame.seq)
        if count < self._next or count in self._waiting:
            return False
        if self._boot_id is not None and frame.boot_id not in (None, self._boot_id):
            return False
        if frame.is_boot and self._times:  # what a box sends at boot it sends before everything that has a time
            return False
        kind, time = frame.stamp or (None, 0)
        if count <= self._newest:  # late: sent after all that were given back
            return kind is None or time >= self._placed_times.get(kind, 0)
        if self._is_far(frame):
            return False
        return kind is None or time >= self._times.get(kind, 0)

    def _is_far(self, frame: Frame) -> bool:
        """Whether a frame lies further ahead than frames can have come since the newest."""
        return too_many(self._unwrapped(frame.seq) - self._newest, frame.t_host_ns - self._newest_host_ns)

    def _accept(self, frame: Frame) -> Iterator[Placed]:
        count = self._unwrapped(frame.seq)
        self._waiting[count] = frame
        self._remember(frame.seq, frame.payload)
        if count > self._newest:
            self._dismiss()  # the count goes on
            self._newest, self._newest_host_ns = count, frame.t_host_ns
        if frame.stamp is not None:
            kind, time = frame.stamp
            self._times[kind] = max(time, self._times.get(kind, 0))
        if frame.boot_id is not None and self._boot_id is None:
            self._boot_id = frame.boot_id
        yield from self._given_up(everything=False)

    def _remember(self, seq: int, payload: bytes) -> None:
        self._remembered[seq] = payload
        if len(self._remembered) > 2 * REACH:
            self._remembered.popitem(last=False)

    def _given_up(self, everything: bool) -> Iterator[Placed]:
        """The frames that nothing is waited for any more."""
        while self._waiting:
            lost = 0
            if self._next not in self._waiting:
                if not everything and self._newest - self._next < REACH:
                    return
                there = min(self._waiting)
                lost = max(0, there - max(self._next, self._uncounted))
                self._next = there
            frame, restarts = self._waiting.pop(self._next), self._restarting
            self._next, self._restarting = self._next + 1, False
            if frame.stamp is not None:
                self._placed_times[frame.stamp[0]] = frame.stamp[1]
            yield Placed(frame, lost, restarts)

    # ------------------------------------------------------------------------------------------------ another count

    def _suspect(self, frame: Frame) -> Iterator[Placed]:
        half = CIRCLE // 2
        if self._suspects and abs((frame.seq - self._suspects[-1].seq + half) % CIRCLE - half) > REACH:
            self._dismiss()
        if not self._suspects:
            self._far = self._is_far(frame)
        self._suspects.append(frame)
        another = self._boot_id is not None and frame.boot_id not in (None, self._boot_id)
        if another or len(self._suspects) >= (FAR_RUN if self._far else BEHIND_RUN):
            suspects, self._suspects = self._suspects, []
            yield from self._restart(suspects)

    def _restart(self, frames: list[Frame]) -> Iterator[Placed]:
        """The frames are the first of a new count; nothing more comes of the old one."""
        yield from self._given_up(everything=True)
        first, far = frames[0], self._far
        self._remembered, self._times, self._placed_times = OrderedDict(), {}, {}
        self._boot_id, self._restarting, self._far = None, True, False
        # The count of a box begins at 0; one that lies too far ahead says nothing of what was lost.
        from_ = first.seq if far else 0
        yield from self._begin(first, from_, from_)
        for frame in frames[1:]:
            yield from self.take(frame)

    def _dismiss(self) -> None:
        if self._far:
            self.malformed += len(self._suspects)
        else:
            self.late += len(self._suspects)
        self._suspects, self._far = [], False
