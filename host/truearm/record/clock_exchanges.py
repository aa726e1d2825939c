"""Clock exchanges with the box: pending requests, and the ``/sync`` rows made from them.

t0 is the host time before the request was handed over, t3 the arrival of the reply; the box's t1 and t2 lie between
them (SPEC §4). A request without an answer within 2 s becomes a row with nulls. So does one with an implausible answer,
in which the box claims to have held the request for longer than the round trip (the answer itself is kept in
``/box/sync``).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from truearm.record.session_writer import SessionWriter
from truearm.record.status import Counters

SYNC_TIMEOUT_NS = 2_000_000_000
_STAMP_US = 2.0  # each stamp is a whole number of microseconds
_RATE = 1e-3  # ten times the error of a crystal


@dataclass
class ClockExchanges:
    """Exchanges by id: those pending, and the outcome of the others."""

    writer: SessionWriter
    counters: Counters
    rtt_us: float | None = None  # the shortest exchange, without the time within the box
    _pending: dict[int, int] = field(default_factory=dict)  # id: t0

    def asked(self, probe: int, t0_ns: int) -> None:
        """Note a request sent at ``t0_ns``."""
        self._pending[probe] = t0_ns
        self.counters.probes += 1

    def answered(self, probe: int, t1_us: int, t2_us: int, t3_ns: int) -> None:
        """Note a reply, unless it is unknown, too late, doubled or implausible."""
        t0_ns = self._pending.get(probe)
        if t0_ns is None:
            return
        away_us = (t3_ns - t0_ns) / 1000
        if not 0 <= t2_us - t1_us <= away_us * (1 + _RATE) + _STAMP_US:
            return
        del self._pending[probe]
        row = {"id": probe, "t0_ns": t0_ns, "t1_us": t1_us, "t2_us": t2_us, "t3_ns": t3_ns}
        self.writer.add("/sync", t3_ns, msgspec.json.encode(row))
        rtt_us = max(0.0, away_us - (t2_us - t1_us))
        self.rtt_us = rtt_us if self.rtt_us is None else min(rtt_us, self.rtt_us)

    def expire(self, now_ns: int, older_than_ns: int = SYNC_TIMEOUT_NS) -> None:
        """Drop requests older than this."""
        late = [probe for probe, t0_ns in self._pending.items() if now_ns - t0_ns >= older_than_ns]
        for probe in late:
            self.writer.add_json("/sync", now_ns, {"id": probe, "t0_ns": self._pending.pop(probe)})
            self.counters.unanswered_probes += 1
