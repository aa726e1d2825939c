"""One stream of samples as it comes: what is missing from it and how fast it runs.

``n0`` counts samples. A jump with frames lost since the stream's last block: the samples went with them; without: the box
overran. ``n0`` that falls back without a restart is a new ``start``, a new run.

A box that a killed recorder left streaming still holds blocks of then. The next one stops it and starts it anew: what was missing before
that start is not the session's loss.
"""

from __future__ import annotations

from dataclasses import dataclass

from truearm.session.box_ident import Stream
from truearm.session.data_frames import Data
from truearm_wire import messages as wire

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

    def take(self, data: Data, n: int, frames_lost: int) -> bool:
        """Account for a block of n samples; whether samples are missing before it."""
        gap = not (data.n0 == self.next_n0 and frames_lost == self.frames_lost and not data.flags)
        gap = gap and self._unusual(data, frames_lost)
        if gap:
            self.pieces += 1
        else:
            self.whole_us += data.t0_us - self.last_t0_us
            self.whole_samples += self.last_n
        self.blocks += 1
        self.samples += n
        self.next_n0, self.last_t0_us, self.last_n, self.period_ns = data.n0 + n, data.t0_us, n, data.period_ns
        return gap

    def restart(self, frames_lost: int) -> None:
        """The box restarted; ``n0`` counts from 0 again."""
        self.next_n0, self.frames_lost = None, frames_lost

    def _unusual(self, data: Data, frames_lost: int) -> bool:
        """Account for what is missing before a block; whether anything is."""
        with_frames, self.frames_lost = frames_lost != self.frames_lost, frames_lost
        self.converter_faults += bool(data.flags & wire.FLAG_CONVERTER)
        expected = self.next_n0
        if expected is None:
            # Joined, or restarted. Without a frame lost the box had been sampling before the session began.
            missing = data.n0 if with_frames else 0
            self.joined = not (self.blocks or with_frames) and data.n0 > 0
        elif data.n0 < expected:
            self.starts += 1
            self.run += 1
            if self.joined:
                self.joined, self.samples_overrun, self.pieces = False, 0, 0
            missing = data.n0
        else:
            missing = data.n0 - expected
        if with_frames:
            self.samples_lost += missing
        else:
            self.samples_overrun += missing
        return data.n0 != expected or bool(data.flags & wire.FLAG_OVERRUN)

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
