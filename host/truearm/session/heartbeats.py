"""The box's own counters, summed over what a session holds.

They run since boot and wrap at 2^30 (SPEC §4). A session that joins a running box must not be charged with what happened
before: of a boot that the session did not see only what came after its first heartbeat is counted, so up to a second
of the session's beginning is not. Of a boot in mid-session everything is.

What an element is stands in the layout that is generated from protocol/frames.cddl: a ``counter`` is summed, of a ``largest``
or ``smallest`` the extreme is kept. A box of an older minor version sends fewer elements.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

from truearm_wire import messages as wire

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

    def take(self, segment: int, values: Sequence[int]) -> None:
        """One heartbeat of a segment. Segments of one boot id are one boot: a frame that came late looks like a restart."""
        beat = {name: value for (name, _), value in zip(_ELEMENTS, values, strict=False)}
        boot = self._boots.setdefault(beat["boot_id"], _Boot(segment, beat, beat))
        if beat["t_us"] >= boot.last["t_us"]:  # else it came late and says nothing new
            for name in COUNTERS:
                boot.since[name] += (beat.get(name, 0) - boot.last.get(name, 0)) % WRAP
            boot.last = beat
        self._n += 1
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
