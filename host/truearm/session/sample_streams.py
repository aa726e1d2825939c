"""One stream of samples as it comes: what is missing from it and how fast it runs.

``n0`` counts samples. A jump with frames lost since the stream's last block: the samples went with them; without: the box
overran. ``n0`` that falls back without a restart is a new ``start``, a new run.

A box that a killed recorder left streaming still holds blocks of then. The next one stops it and starts it anew: what was missing before
that start is not the session's loss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_ident import Stream
from truearm.session.message_columns import Ints
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
