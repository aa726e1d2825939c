"""Reduce the messages of a session to observations.

``survey`` reads the session. It accounts for every frame, collects the clock exchanges and the robot's data, keeps the
samples of the kinds' channels on the disk, and finds the dwells and the legs. ``observations`` processes the samples of
one dwell and one leg after another. A dwell gives one observation and a leg along a line device many, or a reason why
not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from truearm.clocks import WANDER
from truearm.kinds import registry
from truearm.kinds.kind import DwellSensor
from truearm.kinds.table import ObservationTable
from truearm.session.clock import BoxTemperature, ClockReport, DeviceClock, box_temperature, fit_clock
from truearm.session.dwells import Dwell, find_dwells, has_manual_joints, measured, usual_noise, without_noisy
from truearm.session.frames import Ident
from truearm.session.joint_readings import JointReader, JointStream
from truearm.session.line_passes import Leg, LinePass, find_legs, measure
from truearm.session.plan_matching import Marks, check_rig, labelled, paired, passes_of, with_mountings
from truearm.session.samples import ChannelSamples, Samples
from truearm.session.session_file import Messages, Source
from truearm.session.streams import Blocks, BoxReader, Losses, Segment, StreamReport
from truearm.session.trigger_edges import with_edges
from truearm.types import MOUNTING, DwellLabel, Floats, Rig

# Names given by the box's configuration: the columns that kinds of observation declare
THERMOMETERS = {"bar": "bar_temperature", "sensor": "sensor_temperature"}
BAR, LINE = "ball_bar", "line"
SensorsOf = Callable[[Rig, Mapping[str, str]], Sequence[DwellSensor | None]]


@dataclass(frozen=True)
class Survey:
    """Results of the first pass. ``clocks``: of each segment with exchanges."""

    losses: Losses
    streams: tuple[StreamReport, ...]
    segments: tuple[Segment, ...]
    clocks: dict[int, DeviceClock]
    clock_reports: tuple[ClockReport, ...]
    temperature: BoxTemperature
    thermometers: Mapping[str, BoxTemperature]  # by name
    joints: JointStream
    dwells: tuple[Dwell, ...]
    legs: tuple[Leg, ...]  # () where no line was planned or mounted
    marks: Marks
    samples: dict[str, tuple[ChannelSamples, ...]]  # by kind of observation
    source: Source
    ident: Ident | None  # of the box, as known beforehand

    @property
    def idents(self) -> dict[int, Ident]:
        """The description of the box in each segment that has one."""
        return {segment.index: segment.ident for segment in self.segments if segment.ident is not None}


@dataclass(frozen=True)
class SyncResult:
    """Observations and their origin.

    The table has one row per dwell without a reason, in order, followed by the rows of the passes.
    """

    table: ObservationTable
    dwells: tuple[Dwell, ...]
    passes: tuple[LinePass, ...]
    survey: Survey
    samples_used: int

    @property
    def reasons(self) -> dict[str, int]:
        """Number of rejected dwells by reason; stops for mounting are not included."""
        return dict(Counter(dwell.reason for dwell in self.dwells if dwell.reason not in ("", MOUNTING)))

    @property
    def n_mountings(self) -> int:
        """Number of stops for mounting."""
        return sum(dwell.reason == MOUNTING for dwell in self.dwells)

    @property
    def with_bar(self) -> bool:
        """Whether a bar was planned or mounted; without one, the dwells are only stops between lines."""
        return bool(self.survey.marks.dwells) or any("bar" in dwell.mounted for dwell in self.dwells)

    @property
    def pass_reasons(self) -> dict[str, int]:
        """Number of rejected passes by reason."""
        return dict(Counter(line_pass.reason for line_pass in self.passes if line_pass.reason))


def read_blocks(source: Source, box: BoxReader) -> Iterator[tuple[Messages, list[Blocks]]]:
    """Yield the messages of a session in batches, with the blocks of samples released by each."""
    messages = None
    for messages in source():
        yield messages, box.feed(messages)
    if messages is not None:
        yield messages.take(np.empty(0, np.intp)), box.finish()


def survey(source: Source, ident: Ident | None = None, wander: float = WANDER) -> Survey:
    """Read all messages and return the survey.

    ``ident`` (from the session's metadata) is used until the box sends its own; ``wander``: how far the rate of the
    host's clock may wander.
    """
    box, robot, marks = BoxReader(ident), JointReader(), Marks()
    samples = {name: tuple(map(ChannelSamples, kind.channels)) for name, kind in registry.kinds().items()}
    for messages, blocks in read_blocks(source, box):
        for message in messages.one_by_one(messages.rows(lambda topic: topic in ("/plan", "/events"))):
            marks.feed(message.topic, message.t_host_ns, message.data)
        robot.keeps = robot.keeps or marks.names_lines
        robot.take(messages)
        for channels in chain.from_iterable(samples.values()):
            channels.keep(blocks)
    fits = {s.index: fit for s in box.segments if (fit := fit_clock(s.index, box.exchanges(s), wander)) is not None}
    clocks = {index: clock for index, (clock, _) in fits.items()}
    for channels in chain.from_iterable(samples.values()):
        channels.place(clocks)
    joints = with_edges(robot.finish(), box.output, clocks, wander)
    temperatures = {name: box_temperature(readings, clocks) for name, readings in box.temperatures.items()}
    dwells = find_dwells(joints, samples[BAR][0])
    return Survey(
        losses=replace(box.losses(), plan_events_malformed=marks.malformed),
        streams=box.streams(),
        segments=tuple(box.segments),
        clocks=clocks,
        clock_reports=tuple(report for _, report in fits.values()),
        temperature=temperatures.pop(None),
        thermometers={name: readings for name, readings in temperatures.items() if name is not None},
        joints=joints,
        dwells=tuple(dwells),
        legs=tuple(find_legs(joints)) if marks.names_lines else (),
        marks=marks,
        samples=samples,
        source=source,
        ident=ident,
    )


def observations(
    surveyed: Survey,
    rig: Rig,
    name: str = "session",
    line_points: int | None = None,
    labels: Sequence[DwellLabel] | None = None,
) -> SyncResult:
    """Return the observations of the ball-bar and of a line device.

    ``name`` is the session's name in the table's ``source``. ``line_points``: maximum number of rows per pass along a
    line; None: as many as the noise allows. ``labels``: what was mounted, if settled afterwards; plan and events are
    then not used. Raises RigError if a dwell's bar, chuck or sphere, a line or its target is not in the rig. Raises
    SessionError if the box has no channel for the ball-bar or no calibration of it.
    """
    marks = surveyed.marks
    dwells = paired(surveyed.dwells, marks) if labels is None else labelled(surveyed.dwells, labels)
    for dwell in dwells:
        if not dwell.reason:
            check_rig(dwell.mounted, rig)
    dwells = with_mountings(dwells, marks)
    passes = passes_of(surveyed.legs, marks, rig)
    reach = np.inf if rig.line_travel is None else 0.5 * rig.line_travel
    of_channels: list[tuple[str, list[Dwell]]] = []
    for kind_name, kind in registry.kinds().items():
        if kind.dwell is not None:  # what was mounted does not rule out sensors other than the bar
            bare = (replace(dwell, reason=stop.reason) for dwell, stop in zip(dwells, surveyed.dwells, strict=True))
            stops = dwells if kind_name == BAR else list(bare)
            for number in range(len(kind.channels)):
                of_channels.append((kind_name, _measured(stops, kind_name, number, kind.dwell_sensors, surveyed, rig)))
    dwells = dict(of_channels)[BAR]
    driven, channels, any_clock = list[LinePass](), surveyed.samples[LINE], bool(surveyed.clocks)
    for line_pass in passes:
        outcome: LinePass | None = line_pass
        if line_pass.reason not in ("too long", "ambiguous"):
            outcome = measure(line_pass, channels, surveyed.joints, any_clock, reach, line_points)
        driven += [] if outcome is None else [outcome]
    counts = [dwell.n_samples for dwell in dwells if not dwell.reason] + [line_pass.n_samples for line_pass in driven]
    tables = [_of_dwells(dwells, kind, surveyed.joints, name) for kind, dwells in of_channels]
    for number, line_pass in enumerate(driven, start=1):
        source = [f"{name} pass {number}.{row}" for row in range(1, len(line_pass.table) + 1)]
        tables += [line_pass.table.replace(source=source)] if not line_pass.reason else []
    table = ObservationTable.joined(tables)
    t_host_ns = (1e9 * table.time).astype(np.int64)
    read = THERMOMETERS.keys() & surveyed.thermometers.keys()
    simulated = any(box.simulated for box in surveyed.idents.values())
    table = table.replace(
        **{THERMOMETERS[place]: surveyed.thermometers[place].between(t_host_ns) for place in read},
        temperature=surveyed.temperature.at(t_host_ns),
        simulated="yes" if simulated else None,
    )
    return SyncResult(table, tuple(dwells), tuple(driven), surveyed, sum(counts))


def _measured(
    dwells: Sequence[Dwell], name: str, number: int, sensors_of: SensorsOf, surveyed: Survey, rig: Rig
) -> list[Dwell]:
    """Return the dwells, those without a reason with what the sensor on a kind's channel, by number, measured."""
    samples, dwells = surveyed.samples[name][number], list(dwells)
    sensors = {i: sensors_of(rig, dwell.mounted)[number] for i, dwell in enumerate(dwells) if not dwell.reason}
    if name == BAR and sensors:
        samples.check()

    def during(i: int) -> Samples | None:
        return samples.during(dwells[i].start_host_ns, dwells[i].end_host_ns)

    usual = usual_noise(map(during, sensors))
    for i, sensor in sensors.items():
        dwell, read = dwells[i], during(i)
        if sensor is None:
            dwells[i] = replace(dwell, reason="no plan match")
            continue
        dwell = dwell if sensor.names is dwell.mounted else replace(dwell, mounted=dict(sensor.names))
        if read is None:
            dwells[i] = replace(dwell, reason="no samples" if surveyed.clocks else "no clock")
        else:
            dwells[i] = measured(dwell, read, sensor, surveyed.joints, usual)
    return without_noisy(dwells)


def _of_dwells(dwells: Sequence[Dwell], kind: str, joints: JointStream, name: str) -> ObservationTable:
    rows = [(i, dwell) for i, dwell in enumerate(dwells, start=1) if not dwell.reason]
    declared, shape = registry.kinds()[kind], (len(rows), len(joints.step))
    named = {key: [dwell.mounted.get(key, "") for _, dwell in rows] for key in (*declared.identifiers, "shell")}
    side = np.array([came_from(joints, dwell) for _, dwell in rows]).reshape(shape)
    return ObservationTable(
        {**named, declared.quantities[0].field: [dwell.value for _, dwell in rows]},
        q=np.array([dwell.q for _, dwell in rows]).reshape(shape),
        kind=kind,
        sigma=[dwell.sigma for _, dwell in rows],
        source=[f"{name} dwell {i}" for i, _ in rows],
        time=[0.5e-9 * (dwell.start_host_ns + dwell.end_host_ns) for _, dwell in rows],
        side=np.where(side == 0.0, np.nan, side),
    )


LEAST = 5e-4  # rad or m; a smaller motion is a swing about the position, not an approach
BACK_BINS = 200  # how far back the last motion is searched: 10 s


def came_from(joints: JointStream, dwell: Dwell) -> Floats:
    """Return the direction (j,) of the last motion of each joint before a dwell.

    −1 or 1, or 0 if the joint did not move or the direction is not known, as with readings that were noted one by one.
    """
    times, last = joints.bins.times, 0 if has_manual_joints(joints) else dwell.bins[0]
    while last > 0 and times.t_first_s[last - 1] >= dwell.stood_s and times.segment[last - 1] == dwell.segment:
        last -= 1
    first = max(0, last - BACK_BINS)
    broken = np.flatnonzero(times.gap[first + 1 : last + 1] | (times.segment[first:last] != dwell.segment))
    first += int(broken[-1]) + 1 if broken.size else 0
    if first == last:
        return np.zeros(dwell.q.size)
    mean, below, above, _ = joints.bins.joints(first, last)
    above, below = above + (mean - dwell.q), below - (mean - dwell.q)
    moved = np.maximum(above, below) > LEAST
    latest = len(moved) - 1 - np.argmax(moved[::-1], axis=0), np.arange(dwell.q.size)
    return np.where(moved.any(axis=0), np.where(above[latest] > below[latest], -1.0, 1.0), 0.0)
