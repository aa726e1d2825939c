"""Watch a box's measurements and their quality live (``truearm box monitor``)."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from truearm.box.condition import LVDT, far_from_calibration, with_spread
from truearm.box.control import BoxControl, Sent, conversation, one_line_of, streaming
from truearm.findings import option
from truearm.progress import asked_to_stop
from truearm.session.clock import fit_clock
from truearm.session.frames import Channel, Ident, Stream
from truearm.session.samples import counts_of, railed, volts
from truearm.session.streams import COUNTERS
from truearm.text import counted, faster, one_line
from truearm.units import DEGC, MDEGC, MS, NS, PPM, US
from truearm_wire.messages import EVENT, START, SYNC_REPLY, TEMPERATURE

WINDOW_S = 1.0  # averaging time of displayed values
PROBE_S = 0.25
MOST_PROBES = 16  # unanswered for four seconds
LEAST_EXCHANGES, MOST_EXCHANGES = 3, round(60.0 / PROBE_S)
RATE_KNOWN_PPM = 100.0  # a bound of the rate's error above it is worse than assuming equal clocks: crystals stay within
LOSSES = {  # counters of a heartbeat
    "dropped": "trigger edges without room in the box",
    "crc_errors": "wrong CRCs of the converter",
    "bad_frames": "bad frames received",
}
TROUBLES = tuple(name for name in COUNTERS if name not in ("sent", "short_writes", "overruns"))
Labelled = list[tuple[str, str]]  # label and value


@dataclass
class LastSecond:
    """The last second of a stream."""

    blocks: deque[NDArray[np.int32]] = field(default_factory=deque)
    samples: int = 0
    next_n0: int | None = None
    lost: int = 0
    period_ns: int = 0

    def take(self, n0: int, counts: NDArray[np.int32], period_ns: int) -> None:
        if self.next_n0 is not None and n0 > self.next_n0:
            self.lost += n0 - self.next_n0
        self.next_n0 = n0 + len(counts)
        self.period_ns = period_ns or self.period_ns
        self.blocks.append(counts)
        self.samples += len(counts)
        longest = max(1, round(NS.of(WINDOW_S) / self.period_ns)) if self.period_ns else 1000
        while len(self.blocks) > 1 and self.samples - len(self.blocks[0]) >= longest:
            self.samples -= len(self.blocks.popleft())


@dataclass
class Watch:
    """Observations of a box since it was started. Times in s and ns of the host's clock."""

    ident: Ident
    windows: dict[int, LastSecond] = field(default_factory=dict)
    thermometers: dict[int, float] = field(default_factory=dict)  # °C
    exchanges: deque[tuple[int, int, int, int]] = field(  # t0, t1, t2, t3
        default_factory=lambda: deque(maxlen=MOST_EXCHANGES)
    )
    probes: deque[tuple[int, int]] = field(  # id and t0 of the last clock requests, which a slow link answers late
        default_factory=lambda: deque(maxlen=MOST_PROBES)
    )
    edges: int = 0
    restarts: int = 0

    def take(self, sent: Sent) -> None:
        """Process a frame."""
        fields = sent.fields
        if sent.data is not None:
            stream = self.ident.streams.get(sent.data.stream)
            if stream is not None and (counts := counts_of(sent.data, stream)) is not None:
                self.windows.setdefault(stream.id, LastSecond()).take(sent.data.n0, counts, sent.data.period_ns)
        elif sent.kind == TEMPERATURE:
            self.thermometers[fields["thermometer"]] = MDEGC.to_si(fields["temperature_mdegc"])
        elif sent.kind == EVENT:
            self.edges += 1
        elif sent.kind == SYNC_REPLY and (t0 := dict(self.probes).get(fields["id"])) is not None:
            self.exchanges.append((t0, fields["t1_us"], fields["t2_us"], sent.t_host_ns))


def monitor_box(
    device: str, duration: float | None, interval_s: float, show: Callable[[Labelled], None]
) -> Iterator[str]:
    """Watch a box until ``duration`` [s] or an interrupt; ``show`` is called regularly with the measurements.

    Yields a line when the box has answered, and one at the end. Raises LinkError.
    """
    with conversation(device, stop=True) as box, asked_to_stop() as interrupted:
        watch = Watch(box.ident)
        yield one_line_of(watch.ident)
        begun_s = probe_s = time_s = time.monotonic()
        show_s, end_s = begun_s + interval_s, begun_s + (duration or math.inf)
        with streaming(box):
            while not interrupted() and time_s < end_s:
                for sent in box.sent(0.05):
                    watch.take(sent)
                if box.ident.boot_id != watch.ident.boot_id:
                    watch = Watch(box.ident, restarts=watch.restarts + 1)
                    box.command(START)
                time_s = time.monotonic()
                if time_s >= probe_s:
                    probe_s = time_s + PROBE_S
                    watch.probes.append(box.probe())
                if time_s >= show_s:
                    show_s = time_s + interval_s
                    show([*rows_of(watch, time_s - begun_s, box)])
    yield f"ended; lost: {losses(watch, box)}"


def rows_of(watch: Watch, elapsed_s: float, box: BoxControl) -> Iterator[tuple[str, str]]:
    """Yield (label, value) for everything displayed."""
    yield "time", f"{elapsed_s:.0f} s"
    for stream in watch.ident.streams.values():
        yield from _stream_rows(stream, watch.windows.get(stream.id))
    yield "clock", clock_words(watch)
    if beat := box.heartbeat:
        degc = MDEGC.to_si(beat["temperature_mdegc"])
        longest = MS.text(US.to_si(beat["loop_max_us"]), ".1f")
        yield "box", f"{DEGC.text(degc, '.1f')}, longest loop {longest}"
        if warning := far_from_calibration(watch.ident, LVDT, degc):
            yield "temperature", warning.text(option)
    if watch.ident.thermometers:
        values = (watch.thermometers.get(k) for k in range(len(watch.ident.thermometers)))
        texts = ("not read yet" if value is None else DEGC.text(value, ".2f") for value in values)
        yield "thermometers", ", ".join(map(" ".join, zip(map(one_line, watch.ident.thermometers), texts, strict=True)))
    if watch.edges:
        yield "trigger", counted(watch.edges, "edge")
    yield "losses", losses(watch, box)


def _stream_rows(stream: Stream, window: LastSecond | None) -> Labelled:
    if window is None:
        return [(stream.name, "no samples yet")]
    rate = f"{NS.factor / window.period_ns:.2f} Hz" if window.period_ns else "no fixed rate"
    rows = [(stream.name, f"{rate}, {counted(window.lost, 'sample')} lost")]
    counts = np.concatenate(window.blocks)
    return rows + [(one_line(c.name), value_of(counts[:, k], c, stream)) for k, c in enumerate(stream.channels)]


def value_of(counts: NDArray[np.int32], channel: Channel, stream: Stream) -> str:
    """Return the mean of counts (n,) in the channel's best unit, with the standard deviation of one sample."""
    if channel.fault:
        return channel.fault
    if stream.name == "mag":
        counts = counts[counts != 0]
        if not counts.size:
            return "no stop pulses; is the magnet on the rod?"
    elif railed(counts).any():
        return "at the end of the converter's range"
    values = np.polynomial.polynomial.polyval(volts(counts, channel), channel.poly or (0.0, 1.0))
    unit = channel.calibrated_unit if channel.poly else channel.unit
    return with_spread(float(np.mean(values)), float(np.std(values)), unit)


def clock_words(watch: Watch) -> str:
    """Describe how well the host knows the box's clock from the exchanges of the last minute."""
    count = len(watch.exchanges)
    fitted = fit_clock(0, np.array(watch.exchanges)) if count >= LEAST_EXCHANGES else None
    if fitted is None:
        return "not known yet"
    clock, report = fitted
    # A few exchanges later it is known whether a clock stepped.
    _, (bound_ns,) = clock.to_host_ns(np.array([watch.exchanges[max(count - 4, count // 2)][1]]))
    first_us, last_us = report.device_us
    rate_bound_ppm = PPM.of(2.0 * NS.to_si(float(bound_ns)) / US.to_si(float(max(1, last_us - first_us))))
    rate = f"host {faster(report.rate_ppm, 1)}" if rate_bound_ppm < RATE_KNOWN_PPM else "rate not known yet"
    return (
        f"± {US.text(NS.to_si(float(bound_ns)), '.0f')}, {rate}, "
        f"shortest round trip {US.text(NS.to_si(report.rtt_min_ns), '.0f')}"
    )


def losses(watch: Watch, box: BoxControl) -> str:
    """Return the counts of everything that went wrong, including zeros."""
    beat = box.heartbeat
    counts = [
        f"{counted(box.frame_count.lost, 'frame')} on the link",
        f"{counted(beat.get('overruns', 0), 'sample')} in the box",
        *(f"{beat[key]} {LOSSES.get(key, key.replace('_', ' '))}" for key in TROUBLES if beat.get(key)),
    ]
    return ", ".join(counts + [counted(watch.restarts, "restart")] * (watch.restarts > 0))
