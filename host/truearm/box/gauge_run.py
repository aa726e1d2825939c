"""A sensor's calibration against reference readings, into the box: what ``truearm box gauge`` does."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from truearm.box.configuration import change_lines, checked_config
from truearm.box.conversation import conversation, ident_of
from truearm.box.gauge_result import HEAD, MAG, Place, calibrate, with_calibration, words, write_page
from truearm.errors import Argument, InputError, LinkError, TableError
from truearm.text import one_line
from truearm.units import MM, NS, suffixes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from truearm.box.control import BoxControl
    from truearm.session.box_ident import Channel, Ident, Stream
    from truearm.session.samples import MeanOfSamples

UNITS = suffixes("m", ("mm", "um", "in"))
SETTLE_S = 0.2  # the converter's filter fills, and a hand leaves the stage
PATIENCE_S = 5.0
MAX_REFERENCES = 1000
MAX_BYTES = 1 << 18
MAX_METRES = 10.0
STILL_MOVES = 5.0  # standard deviations of a drift
FEWEST = 16  # samples of which a mean and its error can be told


class Operator(Protocol):
    """Who sets the references: hears what is measured, and answers."""

    def say(self, text: str) -> None:
        """Show a line."""

    def ask(self, prompt: str) -> str | None:
        """What the operator types, None at the end of the input."""


@dataclass(frozen=True)
class GaugeOptions:
    """How to calibrate a channel.

    ``references``: a file of them, None to ask for each in ``unit``. ``seconds``: samples at each place. ``order`` of the polynomial,
    None for the one with the least left-out error. ``serial``: of the sensor, None as before. ``page``: to write, None for a name by the
    channel. ``agreed``: store the calibration without asking.
    """

    channel: str
    references: Path | None = None
    unit: str = "mm"
    seconds: float = 2.0
    order: int | None = None
    serial: str | None = None
    page: Path | None = None
    agreed: bool = False
    force: bool = False


def gauge_channel(device: str, options: GaugeOptions, operator: Operator, stop: bool = False) -> None:
    """Sample a channel at references, fit its calibration, write the page and store it in the box if the operator agrees.

    Raises InputError, TableError, LinkError.
    """
    from truearm.files.disk import check_writable
    from truearm.report.gauge_page import MARK

    unit, channel, say = options.unit, options.channel, operator.say
    if unit not in UNITS:
        raise InputError(Argument("unit"), f" {unit[:20]!r} is not one of {', '.join(UNITS)}")
    listed = None if options.references is None else read_references(options.references)
    page = options.page or Path(
        "gauge-" + "".join(c if c.isalnum() or c in "-_" else "_" for c in channel[:40]) + ".html"
    )
    inputs = [] if options.references is None else [options.references]
    check_writable(page, options.force, inputs=inputs, ours=lambda head: MARK.encode() in head)
    with conversation(device, stop=stop) as box:
        stream, index = _find(ident_of(box), channel)
        config = checked_config(box)
        places = _measured_places(box, (stream, index), options, listed, operator)
        result, tried = calibrate(places, options.order, stream.name == MAG)
        for line in words(places, result, tried, stream.channels[index]):
            say(line)
        new = with_calibration(config, stream, index, places, result, options.serial)
        write_page(page, channel, stream.channels[index], places, result, tried, new)
        say(f"{page}: residuals and orders")
        changes = change_lines(config, new)
        for line in changes:
            say(line)
        if not changes:
            say("the box has this calibration already")
        elif options.agreed or _agreed(operator):
            box.put_config(new)
            say(f"{device}: stored and in force")
        else:
            say(f"{device}: unchanged")


def read_references(path: Path) -> list[float]:
    """The references [m] of a CSV file. Raises TableError."""
    from truearm.files.csv_cells import numbers, read_cells
    from truearm.files.disk import read_text
    from truearm.files.observation_columns import Column

    header, rows = read_cells(read_text(path, MAX_BYTES, TableError), str(path))
    columns = [
        Column(name, at, unit) for at, name in enumerate(header) for unit in UNITS if name == f"reference_{unit}"
    ]
    if len(columns) != 1:
        raise TableError(f"{path}: needs one column named reference_mm, reference_um or reference_in")
    if not 1 <= len(rows) <= MAX_REFERENCES:
        raise TableError(f"{path}: has {len(rows)} references; 1 to {MAX_REFERENCES} are possible")
    return [float(value) for value in numbers(rows, columns[0], str(path), MAX_METRES, required=True)]


def parse_reference(text: str, scale: float) -> float:
    """A reference [m] as it was typed. Raises InputError."""
    try:
        value = float(text.strip().replace(",", ".")) * scale
    except ValueError:
        value = math.nan
    if not abs(value) <= MAX_METRES:
        raise InputError(f"{text.strip()[:40]!r} is no reading of a reference")
    return value


def _find(ident: Ident, name: str) -> tuple[Stream, int]:
    from truearm.session.box_ident import find_channel

    found = find_channel(ident, name)
    if found is None:
        names = ", ".join(c.name for stream in ident.streams.values() for c in stream.channels)
        off = "; its stream is off (truearm box config set magnetostrictive.period_us=983.04)" if name == HEAD else ""
        raise InputError(f"the box has no channel {name[:40]!r}{off}; there are {names}")
    if found[0].channels[found[1]].fault:
        raise InputError(f"channel {name} cannot be used: {found[0].channels[found[1]].fault}")
    return found


# --- at the stage


def _measured_places(
    box: BoxControl,
    found: tuple[Stream, int],
    options: GaugeOptions,
    listed: list[float] | None,
    operator: Operator,
) -> list[Place]:
    """Ask for references and sample at each, until they end."""
    places: list[Place] = []
    stream, index = found
    for reference in _typed(places, options.unit, operator) if listed is None else _listed(listed, places, operator):
        counts = sample(box, stream, options.seconds)
        problem = trouble(counts[:, index], stream)
        if problem:
            operator.say(f"  not taken: {problem}")
            continue
        place = _place(reference, counts[:, index], stream, stream.channels[index], box)
        if moves(place.mean):
            operator.say(f"  not taken: {_moved(place, stream.channels[index])}; leave it alone and take it again")
            continue
        places.append(place)
        operator.say(f"  {_placewords(len(places), place, stream.channels[index])}")
    return places


def _listed(references: Sequence[float], places: Sequence[Place], operator: Operator) -> Iterator[float]:
    """Each reference until it is among the places that were taken, or is to be skipped."""
    for number, reference in enumerate(references, 1):
        taken = len(places)
        while len(places) == taken:
            line = operator.ask(
                f"{number} of {len(references)}: set {MM.text(reference, '.4f')}, then Enter (s: skip, q: enough): "
            )
            if line is None or line == "q":
                return
            if line == "s":
                break
            yield reference


def _typed(places: list[Place], unit: str, operator: Operator) -> Iterator[float]:
    while len(places) < MAX_REFERENCES:
        line = operator.ask(f"reference [{unit}] (empty: done, undo): ")
        if not line:
            return
        if line == "undo":
            operator.say(f"  {'dropped place ' + str(len(places)) if places else 'there is none'}")
            del places[-1:]
            continue
        try:
            yield parse_reference(line, UNITS[unit])
        except InputError as exc:
            operator.say(f"  {exc}; type a number of {unit}")


def _agreed(operator: Operator) -> bool:
    return (operator.ask("store it in the box? [y/N] ") or "").lower() in ("y", "yes")


def sample(box: BoxControl, stream: Stream, seconds: float) -> NDArray[np.int32]:
    """Counts (n, channels) of a stream over so many seconds. The box is started and stopped.

    Raises LinkError if too few samples come.
    """
    from truearm.session.samples import with_ratios
    from truearm_wire.messages import START, STOP

    skip, wanted = (max(1, round(NS.of(s) / stream.period_ns)) for s in (SETTLE_S, seconds))
    box.command(START)
    try:
        blocks = _collect(box, stream, skip, max(wanted, FEWEST), SETTLE_S + seconds + PATIENCE_S)
    finally:
        box.command(STOP)
        for _ in box.sent(0.0):  # what was under way
            continue
    return with_ratios(np.concatenate(blocks), stream.channels)


def _collect(box: BoxControl, stream: Stream, skip: int, wanted: int, patience_s: float) -> list[NDArray[np.int32]]:
    """Blocks of ``wanted`` samples in all, from number ``skip`` on."""
    blocks: list[NDArray[np.int32]] = []
    width = len(stream.channels)
    have, end_s = 0, box.now_s + patience_s
    while box.now_s < end_s:
        for data in (sent.data for sent in box.sent(0.05)):
            if data is None or data.stream != stream.id or data.n0 < skip or len(data.samples) % (4 * width):
                continue
            blocks.append(np.frombuffer(data.samples, "<i4").reshape(-1, width))
            have += len(blocks[-1])
            if have >= wanted:
                return blocks
    raise LinkError(f"the box sent {have} of {wanted} samples of {stream.name} in {patience_s:.0f} s")


def trouble(counts: NDArray[np.int32], stream: Stream) -> str:
    """Why these counts (n,) are no reading; "" if they are."""
    from truearm.session.samples import railed

    if stream.name != MAG:
        return (
            "the input is at the converter's rail; move the sensor, or lower the gain" if railed(counts).any() else ""
        )
    missing = int(np.count_nonzero(counts == 0))
    if 2 * missing > counts.size or counts.size - missing < FEWEST:
        return f"{missing} of {counts.size} stop pulses are missing; is the magnet on the rod?"
    return ""


def _place(reference: float, counts: NDArray[np.int32], stream: Stream, channel: Channel, box: BoxControl) -> Place:
    from truearm.session.samples import mean_of, volts

    good = counts[counts != 0] if stream.name == MAG else counts
    beat = box.heartbeat.get("temperature_mdegc")
    return Place(reference, mean_of(volts(good, channel)), None if beat is None else beat / 1000)


def _placewords(number: int, place: Place, channel: Channel) -> str:
    mean = place.mean
    noisy = f"noise {mean.noise:.2g}, mean ± {math.sqrt(mean.variance):.2g} {channel.unit}"
    return one_line(f"{number}: {MM.text(place.reference, '.4f')} at {mean.mean:.8g} {channel.unit} ({noisy})")


def moves(mean: MeanOfSamples) -> bool:
    """Whether a sensor moved while it was sampled: beyond chance, and by more than a sample's noise. A creep below that spoils nothing."""
    return abs(mean.drift) > max(STILL_MOVES * mean.drift_sigma, mean.noise)


def _moved(place: Place, channel: Channel) -> str:
    return one_line(f"the sensor moved by {place.mean.drift:+.2g} {channel.unit} while it was sampled")
