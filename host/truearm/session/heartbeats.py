"""The box's own counters, summed over what a session holds.

They run since boot and wrap at 2^30 (SPEC §4). A session that joins a running box must not be charged with what happened
before: of a boot that the session did not see only what came after its first heartbeat is counted, so up to a second
of the session's beginning is not. Of a boot in mid-session everything is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from truearm.session.losses import BoxCounters
from truearm_wire import messages as wire

WRAP = 2**30
SUMMED = (
    "sent",
    "dropped",
    "short_writes",
    "overruns",
    "bad_frames",
    "crc_errors",
    "converter_resets",
    "missing_stops",
)
WORST = (("loop_max_us", "loop_max_us", max), ("gc_max_us", "gc_max_us", max), ("heap_free_min", "heap_free", min))

_PLACE = {name: i - 1 for i, name in enumerate(wire.names(wire.HEARTBEAT))}  # in the values: they lack seq
_APPENDED = (0,) * wire.APPENDED[wire.HEARTBEAT]  # what a box of an older minor version does not count


@dataclass
class _Boot:
    """The heartbeats of one boot: the first, the last, and the sums between them."""

    segment: int
    first: Sequence[int]
    last: Sequence[int]
    since: Counter[str] = field(default_factory=Counter)


class Heartbeats:
    """Takes the values of heartbeats (boot_id, t_us, counters …) in their order."""

    def __init__(self) -> None:
        self._boots: dict[int, _Boot] = {}
        self._worst: dict[str, int] = {}
        self._n = 0

    def take(self, segment: int, values: Sequence[int]) -> None:
        """One heartbeat of a segment. Segments of one boot id are one boot: a frame that came late looks like a restart."""
        values = (*values, *_APPENDED)
        boot = self._boots.setdefault(values[0], _Boot(segment, values, values))
        if values[_PLACE["t_us"]] >= boot.last[_PLACE["t_us"]]:  # else it came late and says nothing new
            for name in SUMMED:
                boot.since[name] += (values[_PLACE[name]] - boot.last[_PLACE[name]]) % WRAP
            boot.last = values
        self._n += 1
        for key, name, worse in WORST:
            value = values[_PLACE[name]]
            self._worst[key] = worse(self._worst.get(key, value), value)

    def counters(self, booted: Collection[int]) -> BoxCounters:
        """The sums; ``booted``: the segments that began with a boot in the session."""
        total = Counter[str]()
        for boot in self._boots.values():
            total.update(boot.since)
            if boot.segment in booted:
                total.update({name: boot.first[_PLACE[name]] for name in SUMMED})
        return BoxCounters(heartbeats=self._n, **{name: total[name] for name in SUMMED}, **self._worst)
