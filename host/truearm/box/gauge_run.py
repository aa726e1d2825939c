"""Calibrate a sensor against reference readings and store the result in the box (``truearm box gauge``)."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from truearm.box.condition import usable_channel
from truearm.box.configuration import change_lines, checked_config
from truearm.box.control import BoxControl, conversation, streaming
from truearm.box.gauge_calibration import (
    HEAD,
    MAX_REFERENCES,
    UNITS,
    Place,
    Places,
    beyond,
    calibrate,
    check_references,
    gauge_page,
    parse_reference,
    read_references,
    with_calibration,
)
from truearm.box.requests import GaugeOptions
from truearm.disk import check_writable, write_atomic
from truearm.errors import LinkError, TruearmError
from truearm.findings import Finding, option
from truearm.progress import step
from truearm.session.box_ident import Channel, Ident, Stream
from truearm.session.sample_noise import mean_of, quick_noise
from truearm.session.samples import counts_of, railed, volts
from truearm.text import counted, one_line
from truearm.types import Floats
from truearm.units import MM, NS

SETTLE_S = 0.2  # for the converter's filter to fill and the operator's hand to leave the stage
PATIENCE_S = 5.0
STROKE = 0.1  # m, of a displacement transducer; the ball-bar's LVDT has 75 mm
SOUND = 2850.0  # m/s, highest velocity in the rod of a magnetostrictive sensor
STILL_MOVES = 6.0  # standard deviations of the mean of one piece
PIECES = 8  # of the samples at a position
FEWEST = 16  # fewest samples for a mean and its error


class GaugeOperator(Protocol):
    """The person who sets the references: is shown the measurements and answers."""

    def say(self, text: str) -> None:
        """Show a line."""

    def ask(self, prompt: str) -> str | None:
        """Return what the operator types, None at the end of the input."""


def gauge_channel(device: str, options: GaugeOptions, operator: GaugeOperator, stop: bool = False) -> None:
    """Sample a channel at references, fit its calibration, write the page and store it in the box if the operator agrees.

    Raises InputError, TableError, LinkError.
    """
    say, inputs = operator.say, [] if options.references is None else [options.references]
    listed = None if options.references is None else read_references(options.references)
    name = re.sub(r"[^\w-]", "_", options.channel[:40])
    page = options.out or Path(f"gauge-{name}.html")
    places_file = page.with_suffix(".places.json")
    # a page beside such a file belongs to the same run: it was interrupted at the last question
    check_writable(page, options.force or places_file.exists(), inputs=inputs, kind="page")
    with conversation(device, stop=stop) as box:
        ident, config = box.ident, checked_config(box)
        stream, index = usable_channel(ident, options.channel, device)
        channel = stream.channels[index]
        places = _continued(places_file, ident, channel, operator)
        run = GaugeRun(box, stream, channel, options, operator, places_file, places)
        try:
            run.measure(listed)
            calibration = calibrate(places, channel, options.order)
            for line in calibration.lines():
                say(line)
            new = with_calibration(config, calibration, options)
            write_atomic(page, gauge_page(calibration, options, ident, new))
            changes = change_lines(config, new)
            for line in (f"{page}: residuals and orders", *changes):
                say(line)
            if not changes:
                say("the box has this calibration already")
            elif options.yes or (operator.ask("store it in the box? [y/N] ") or "").lower() in ("y", "yes"):
                box.put_config(new)
                say(f"{device}: stored; the box uses it from now on")
            else:
                say(f"{device}: unchanged; {places_file} keeps the places")
                return
            places_file.unlink(missing_ok=True)
        except (KeyboardInterrupt, TruearmError):
            if places.places:
                say(f"\n{places_file} keeps the places; the same command continues from them")
            raise


def _continued(places_file: Path, ident: Ident, channel: Channel, operator: GaugeOperator) -> Places:
    """Return the places of a run that ended early, if the operator wants them. Raises InputError."""
    uid = one_line(str(ident.document.get("uid", ""))[:32])
    empty = Places(uid, channel.name, channel.unit, channel.scale)
    earlier = empty.earlier(places_file)
    if earlier.places:
        n_places = counted(len(earlier.places), "place")
        operator.say(f"{places_file}: {n_places} from a run whose calibration was not stored")
        question = "continue from there? Only if sensor and reference stayed mounted as they were [Y/n] "
        if (operator.ask(question) or "y").lower() not in ("y", "yes"):
            return empty
        for number in range(1, len(earlier.places) + 1):
            operator.say(earlier.line(number))
    return earlier


@dataclass(frozen=True)
class GaugeRun:
    """The measurement of places, which are kept in ``places_file``."""

    box: BoxControl
    stream: Stream
    channel: Channel
    options: GaugeOptions
    operator: GaugeOperator
    places_file: Path
    places: Places

    @property
    def stroke(self) -> float:
        """The greatest distance [m] of two references: the pulse of a rod returns in one period."""
        usual = SOUND * NS.to_si(self.stream.period_ns) if self.channel.name == HEAD else STROKE
        return usual if self.options.stroke is None else self.options.stroke

    def measure(self, listed: Sequence[float] | None) -> None:
        """Sample at references, listed [m] or typed, until the operator ends. Raises InputError, LinkError."""
        if listed is None:
            prompt = f"reference [{self.options.unit}] (empty line: done; undo: drop the last place): "
            while len(self.places.places) < MAX_REFERENCES and (line := self._answer(prompt, "")) is not None:
                self._typed(line)
            return
        measured = self.places.references.tolist()
        check_references(listed, measured, self.stroke, f"{self.options.references}")
        for number, reference in enumerate(listed, 1):
            if reference in measured:
                measured.remove(reference)
                continue
            prompt = f"{number} of {len(listed)}: set {MM.text(reference, '.4f')}, then Enter (s: skip, q: enough): "
            while (line := self._answer(prompt, "q")) not in (None, "s") and not self._add(reference):
                continue
            if line is None:
                return

    def _answer(self, prompt: str, end: str) -> str | None:
        """Return what the operator types. ``end`` returns None, but if the places are too few only when typed twice."""
        line = self.operator.ask(prompt)
        if line == end and self.places.places and (few := self.places.too_few()):
            again = f"{end or 'an empty line'} once more ends without a calibration"
            self.operator.say(f"  {few.text(option)}; {again}")
            line = self.operator.ask(prompt)
        return None if line == end else line

    def _typed(self, line: str) -> None:
        """Drop the last place, or measure at the reference that was typed."""
        say, unit, places = self.operator.say, self.options.unit, self.places
        if line == "undo":
            say(f"  dropped place {len(places.places)}" if places.places else "  there is none")
            del places.places[-1:]
            places.write(self.places_file, say)
            return
        reference = parse_reference(line, UNITS[unit])
        if reference is None:
            wrong = {"place": "reference", "value": line[:40], "form": f"a reading in {unit}, such as 12.5"}
            say(f"  {Finding('wrong-value', wrong).text(option)}")
        elif error := beyond(reference, places.references.tolist(), self.stroke):
            say(f"  {error.text(option)}; undo drops the last place")
        else:
            self._add(reference)

    def _add(self, reference: float) -> bool:
        """Sample at a reference [m] and add the place, unless the samples give no reading."""
        channel, say = self.channel, self.operator.say
        counts = sample(self.box, self.stream, self.options.sample)[:, self.stream.channels.index(channel)]
        readings = volts(counts[counts != 0] if channel.name == HEAD else counts, channel)
        if problem := trouble(counts, channel, readings):
            say(f"  {problem.text(option)}")
            return False
        temperature = self.box.heartbeat.get("temperature_mdegc")
        degc = None if temperature is None else temperature / 1000
        self.places.places.append(Place(reference, mean_of(readings), degc))
        self.places.write(self.places_file, say)
        say(self.places.line(len(self.places.places)))
        return True


def sample(box: BoxControl, stream: Stream, seconds: float) -> NDArray[np.int32]:
    """Return counts (n, channels) of a stream over the given number of seconds. The box is started and stopped.

    Raises LinkError if too few samples arrive.
    """
    skip, n_needed = (max(1, round(NS.of(duration) / stream.period_ns)) for duration in (SETTLE_S, seconds))
    n_needed, patience_s = max(n_needed, FEWEST), SETTLE_S + seconds + PATIENCE_S
    blocks: list[NDArray[np.int32]] = []
    n_samples, end_s = 0, box.now_s + patience_s
    with streaming(box), step(f"sampling {stream.name} for {seconds:g} s") as advance:
        while n_samples < n_needed and box.now_s < end_s:
            for data in (sent.data for sent in box.sent(0.05)):
                counts = counts_of(data, stream) if data and data.stream == stream.id and data.n0 >= skip else None
                blocks += [] if counts is None else [counts]
            n_samples = sum(map(len, blocks))
            advance(min(n_samples / n_needed, 1.0))
    for _ in box.sent(0.0):  # data in transit
        continue
    if n_samples < n_needed:
        raise LinkError("link-lost", n=n_samples, needed=n_needed, stream=stream.name, seconds=patience_s)
    return np.concatenate(blocks)[:n_needed]


def trouble(counts: NDArray[np.int32], channel: Channel, readings: Floats) -> Finding | None:
    """Return why these counts (n,) and their readings are not those of a place; None if they are."""
    if channel.name == HEAD:
        missing = int(np.count_nonzero(counts == 0))
        if 2 * missing > counts.size or counts.size - missing < FEWEST:
            return Finding("place-rejected", {"missing": missing, "n": counts.size})
    elif railed(counts).any():
        return Finding("place-rejected", {"at_end": True})
    moved = motion(readings)
    return Finding("place-rejected", {"moved": f"{moved:+.2g} {channel.unit}"}) if moved else None


def motion(samples: Floats) -> float:
    """Return how far a sensor moved while its samples (n,) were taken; 0.0 if it did not move.

    It moved if the means of eighths differ by more than one sample's noise, estimated from second differences that
    motion does not affect, and by more than six standard deviations of such a mean. A creep below that is harmless.
    """
    pieces = np.array_split(samples, max(2, min(PIECES, samples.size // PIECES)))
    means = np.array([piece.mean() for piece in pieces])
    steps = np.abs(np.diff(samples))
    if not steps.any():
        return 0.0
    noise = max(quick_noise(samples), float(steps[steps > 0.0].min()))
    first, last = sorted((int(means.argmin()), int(means.argmax())))
    moved = float(means[last] - means[first])
    return moved if abs(moved) > noise * max(1.0, STILL_MOVES / math.sqrt(pieces[-1].size)) else 0.0
