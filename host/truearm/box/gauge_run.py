"""Calibrate a sensor against reference readings and store the result in the box (``truearm box gauge``)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from truearm.box.configuration import change_lines, checked_config
from truearm.box.conversation import conversation, ident_of, streaming
from truearm.box.gauge_places import GaugeRun, KeptPlaces, Place, kept_path, read_kept
from truearm.box.gauge_references import (
    MAX_REFERENCES,
    UNITS,
    beyond,
    check_references,
    parse_reference,
    read_references,
)
from truearm.box.gauge_result import (
    HEAD,
    MAG,
    GaugeCircumstances,
    calibrate,
    too_few,
    with_calibration,
    words,
    write_page,
)
from truearm.box.requests import GaugeOptions
from truearm.errors import Argument, InputError, LinkError, TruearmError
from truearm.progress import Advance, step
from truearm.text import box_command, counted, one_line
from truearm.units import MM, NS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from truearm.box.control import BoxControl
    from truearm.session.box_ident import Channel, Ident, Stream

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
    from truearm.files.disk import check_writable

    unit, channel, say = options.unit, options.channel, operator.say
    if unit not in UNITS:
        raise InputError("wrong-value", place=Argument("unit"), value=unit[:20], names=list(UNITS))
    listed = None if options.references is None else read_references(options.references)
    page = options.out or Path(
        "gauge-" + "".join(c if c.isalnum() or c in "-_" else "_" for c in channel[:40]) + ".html"
    )
    inputs = [] if options.references is None else [options.references]
    kept = kept_path(page)  # if it exists, a page belongs to the same run: it was interrupted at the last question
    check_writable(page, options.force or kept.exists(), inputs=inputs, kind="page")
    with conversation(device, stop=stop) as box:
        stream, index = _find(ident_of(box), channel, device)
        config = checked_config(box)
        run = GaugeRun(kept, _continued(kept, ident_of(box), stream.channels[index], operator), say)
        with _told_if_kept(run, say):
            _measure_places(box, (stream, index), options, listed, run, operator)
            places = run.places
            result, tried = calibrate(places, options.order, stream.name == MAG)
            for line in words(places, result, tried, stream.channels[index]):
                say(line)
            stated = options.serial, options.instrument, options.uncertainty
            new = with_calibration(config, stream, index, places, result, *stated)
            write_page(page, _circumstances(box, options, new), stream.channels[index], places, result, tried, new)
            say(f"{page}: residuals and orders")
            if _stored(box, (config, new), device, options.yes, operator):
                run.finish()
            else:
                say(f"{device}: unchanged; {kept} keeps the places")


def _stored(
    box: BoxControl, configs: tuple[dict[str, Any], dict[str, Any]], device: str, agreed: bool, operator: GaugeOperator
) -> bool:
    """Show the changes of the box's configuration, from the first to the second, and return whether the box has them."""
    changes = change_lines(*configs)
    for line in changes:
        operator.say(line)
    if not changes:
        operator.say("the box has this calibration already")
    elif agreed or _agreed(operator):
        box.put_config(configs[1])
        operator.say(f"{device}: stored; the box uses it from now on")
    else:
        return False
    return True


@contextmanager
def _told_if_kept(run: GaugeRun, say: Callable[[str], None]) -> Iterator[None]:
    """If the run ends early, tell the operator how it is continued."""
    try:
        yield
    except (KeyboardInterrupt, TruearmError):
        if run.places:
            say(f"\n{run.path} keeps the places; the same command continues from them")
        raise


def _continued(kept: Path, ident: Ident, channel: Channel, operator: GaugeOperator) -> KeptPlaces:
    """Return the places of a run that ended early, if the operator wants them. Raises InputError."""
    empty = KeptPlaces(_uid(ident), channel.name, channel.unit, channel.scale)
    earlier = read_kept(kept, empty)
    if earlier.places:
        n_places = counted(len(earlier.places), "place")
        operator.say(f"{kept}: {n_places} from a run whose calibration was not stored")
        question = "continue from there? Only if sensor and reference stayed mounted as they were [Y/n] "
        if (operator.ask(question) or "y").lower() not in ("y", "yes"):
            return empty
        for number, place in enumerate(earlier.places, 1):
            operator.say(f"  {_placewords(number, place, channel)}")
    return earlier


def _uid(ident: Ident) -> str:
    return one_line(str(ident.document.get("uid", ""))[:32])


def _circumstances(box: BoxControl, options: GaugeOptions, new: dict[str, Any]) -> GaugeCircumstances:
    """Return what the page states about box, sensor, instrument and operator.

    ``new`` is the configuration with the sensor's serial number.
    """
    ident = ident_of(box)
    calibrations = [c.get("calibration", {}) for c in new["channels"] if c["name"] == options.channel] or [new[HEAD]]
    return GaugeCircumstances(
        channel=options.channel,
        instrument=options.instrument,
        uncertainty=options.uncertainty,
        operator=options.operator,
        uid=_uid(ident),
        firmware=one_line(ident.firmware[:32]),
        serial=str(calibrations[0].get("serial", "")),
    )


def _find(ident: Ident, name: str, device: str) -> tuple[Stream, int]:
    from truearm.session.box_ident import find_channel

    channel = find_channel(ident, name)
    if channel is None:
        names = ", ".join(c.name for stream in ident.streams.values() for c in stream.channels)
        on = box_command("config set magnetostrictive.period_us=983.04", device)
        off = f"; its stream is off (switch it on with {on})" if name == HEAD else ""
        raise InputError(f"the box has no channel {name[:40]!r}{off}; it has {names}")
    stream, index = channel
    if fault := stream.channels[index].fault:
        raise InputError(
            f"channel {name} cannot be used: {fault}; correct it with "
            f"{box_command(f'config set channel.{name}.KEY=VALUE', device)}"
        )
    return channel


# --- at the stage


def _measure_places(
    box: BoxControl,
    channel: tuple[Stream, int],
    options: GaugeOptions,
    listed: list[float] | None,
    run: GaugeRun,
    operator: GaugeOperator,
) -> None:
    """Ask for references and sample at each, until the operator ends."""
    stream, index = channel
    stroke = _stroke(stream) if options.stroke is None else options.stroke
    if listed is not None:
        check_references(listed, [place.reference for place in run.places], stroke, f"{options.references}")
    references = _typed(run, options.unit, stroke, operator) if listed is None else _listed(listed, run, operator)
    for reference in references:
        counts = sample(box, stream, options.sample)
        problem = trouble(counts[:, index], stream)
        if problem:
            operator.say(f"  rejected: {problem}")
            continue
        readings = _readings(counts[:, index], stream, stream.channels[index])
        moved = motion(readings)
        if moved:
            operator.say(
                f"  rejected: {_moved(moved, stream.channels[index])}; do not touch it, and measure this place again"
            )
            continue
        place = _place(reference, readings, box)
        run.add(place)
        operator.say(f"  {_placewords(len(run.places), place, stream.channels[index])}")


def _listed(references: Sequence[float], run: GaugeRun, operator: GaugeOperator) -> Iterator[float]:
    """Yield each reference until it has been measured or is skipped; those of an earlier run have been measured."""
    asked_again = False
    measured = [place.reference for place in run.places]
    for number, reference in enumerate(references, 1):
        if reference in measured:
            measured.remove(reference)
            continue
        n_places = len(run.places)
        while len(run.places) == n_places:
            line = operator.ask(
                f"{number} of {len(references)}: set {MM.text(reference, '.4f')}, then Enter (s: skip, q: enough): "
            )
            if line is None or (line == "q" and (asked_again or _are_enough(run.places, "q", operator))):
                return
            if line == "s":
                break
            asked_again = line == "q"
            if not asked_again:
                yield reference


def _typed(run: GaugeRun, unit: str, stroke: float, operator: GaugeOperator) -> Iterator[float]:
    """Yield references as they are typed. A single empty line ends them only if the places are enough."""
    asked_again = False
    while len(run.places) < MAX_REFERENCES:
        line = operator.ask(f"reference [{unit}] (empty line: done; undo: drop the last place): ")
        if line is None or (not line and (asked_again or _are_enough(run.places, "an empty line", operator))):
            return
        asked_again = not line
        if not line:
            continue
        if line == "undo":
            operator.say(f"  {'dropped place ' + str(len(run.places)) if run.places else 'there is none'}")
            if run.places:
                run.drop()
            continue
        try:
            reference = parse_reference(line, UNITS[unit])
        except InputError as exc:
            operator.say(f"  {exc}; type the reading of the reference in {unit}, such as 12.5")
            continue
        measured = (place.reference for place in run.places)
        farthest = max(measured, key=lambda other: abs(other - reference), default=reference)
        if abs(farthest - reference) > stroke:
            operator.say(f"  {beyond(reference, farthest, stroke)}; undo drops the last place")
        else:
            yield reference


def _are_enough(places: Sequence[Place], end: str, operator: GaugeOperator) -> bool:
    """Return whether the measurement may end: with enough places, or before the first. Otherwise tell the operator."""
    missing = too_few(places) if places else ""
    if missing:
        operator.say(f"  {missing}. Measure the next one; {end} once more ends without a calibration")
    return not missing


def _stroke(stream: Stream) -> float:
    """Return the greatest distance [m] of two references of a usual sensor: the pulse of a rod returns in one period."""
    return SOUND * NS.to_si(stream.period_ns) if stream.name == MAG else STROKE


def _agreed(operator: GaugeOperator) -> bool:
    return (operator.ask("store it in the box? [y/N] ") or "").lower() in ("y", "yes")


def sample(box: BoxControl, stream: Stream, seconds: float) -> NDArray[np.int32]:
    """Return counts (n, channels) of a stream over the given number of seconds. The box is started and stopped.

    Raises LinkError if too few samples arrive.
    """
    from truearm.session.samples import with_ratios

    skip, n_wanted = (max(1, round(NS.of(s) / stream.period_ns)) for s in (SETTLE_S, seconds))
    with streaming(box), step(f"sampling {stream.name} for {seconds:g} s") as advance:
        blocks = _collect(box, stream, skip, max(n_wanted, FEWEST), SETTLE_S + seconds + PATIENCE_S, advance)
    for _ in box.sent(0.0):  # data in transit
        continue
    return with_ratios(np.concatenate(blocks), stream.channels)


def _collect(
    box: BoxControl, stream: Stream, skip: int, n_wanted: int, patience_s: float, advance: Advance
) -> list[NDArray[np.int32]]:
    """Collect blocks with ``n_wanted`` samples in total, from number ``skip`` on."""
    blocks: list[NDArray[np.int32]] = []
    width = len(stream.channels)
    n_samples, end_s = 0, box.now_s + patience_s
    while box.now_s < end_s:
        for data in (sent.data for sent in box.sent(0.05)):
            if data is None or data.stream != stream.id or data.n0 < skip or len(data.samples) % (4 * width):
                continue
            blocks.append(np.frombuffer(data.samples, "<i4").reshape(-1, width))
            n_samples += len(blocks[-1])
            advance(min(n_samples / n_wanted, 1.0))
            if n_samples >= n_wanted:
                return blocks
    raise LinkError(
        f"the box sent {n_samples} of {n_wanted} samples of {stream.name} in {patience_s:.0f} s; test the box with truearm box test"
    )


def trouble(counts: NDArray[np.int32], stream: Stream) -> str:
    """Return why these counts (n,) are not a reading; "" if they are."""
    from truearm.session.samples import railed

    if stream.name != MAG:
        return (
            "the input is at the end of the converter's range; move the sensor, or lower the channel's gain with "
            "truearm box config set"
            if railed(counts).any()
            else ""
        )
    missing = int(np.count_nonzero(counts == 0))
    if 2 * missing > counts.size or counts.size - missing < FEWEST:
        return f"{missing} of {counts.size} stop pulses are missing; is the magnet on the rod?"
    return ""


def _readings(counts: NDArray[np.int32], stream: Stream, channel: Channel) -> NDArray[np.float64]:
    """Return the counts (n,) in the channel's unit, without those of missing stop pulses."""
    from truearm.session.samples import volts

    return volts(counts[counts != 0] if stream.name == MAG else counts, channel)


def _place(reference: float, read: NDArray[np.float64], box: BoxControl) -> Place:
    from truearm.session.sample_noise import mean_of

    beat = box.heartbeat.get("temperature_mdegc")
    return Place(reference, mean_of(read), None if beat is None else beat / 1000)


def _placewords(number: int, place: Place, channel: Channel) -> str:
    mean = place.mean
    noisy = f"noise {mean.noise:.2g}, mean ± {math.sqrt(mean.variance):.2g} {channel.unit}"
    return one_line(f"{number}: {MM.text(place.reference, '.4f')} at {mean.mean:.8g} {channel.unit} ({noisy})")


def motion(samples: NDArray[np.float64]) -> float:
    """Return how far a sensor moved while its samples (n,) were taken; 0.0 if it did not move.

    It moved if the means of eighths differ by more than one sample's noise, estimated from second differences that
    motion does not affect, and by more than six standard deviations of such a mean. A creep below that is harmless.
    """
    from truearm.session.sample_noise import quick_noise

    pieces = np.array_split(samples, max(2, min(PIECES, samples.size // PIECES)))
    means = np.array([piece.mean() for piece in pieces])
    steps = np.abs(np.diff(samples))
    if not steps.any():
        return 0.0
    noise = max(quick_noise(samples), float(steps[steps > 0.0].min()))
    first, last = sorted((int(means.argmin()), int(means.argmax())))
    moved = float(means[last] - means[first])
    return moved if abs(moved) > noise * max(1.0, STILL_MOVES / math.sqrt(pieces[-1].size)) else 0.0


def _moved(by: float, channel: Channel) -> str:
    return one_line(f"the sensor moved by {by:+.2g} {channel.unit} while it was sampled")
