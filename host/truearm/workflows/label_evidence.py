"""What plan, operator and readings say about the labels of a session's dwells; ``identify`` leaves out refuted ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import InputError
from truearm.estimate.mounted_pairings import MountingChances, Readings, Words, mountings
from truearm.session.dwell_labels import Said, may_be_dwells, pairing_of, said_of_dwells
from truearm.types import BAR_MOUNTED, DwellLabel, Rig

if TYPE_CHECKING:
    from truearm.model.robot import Robot
    from truearm.session.dwells import Dwell
    from truearm.session.observations import Survey, SyncResult
    from truearm.session.plan_matching import Marks

LEAST_DWELLS = 3  # fewer cannot support one another


class Stop(NamedTuple):
    """A stop that may be a dwell, with its file and its number there, from 1, and what was said about it."""

    place: tuple[Path, int]
    dwell: Dwell
    said: Said
    marks: Marks


def stops_of(path: Path, rig: Rig, survey: Survey) -> list[Stop]:
    """Return the stops of a session that may be dwells of its plan.

    They are measured as if one bar had been mounted all the time: the sensor's readings do not depend on it.
    """
    from truearm.session.dwells import DwellRules
    from truearm.session.observations import observations

    every, marks, tolerance = survey.dwells, survey.marks, DwellRules().pose_tolerance
    numbers = may_be_dwells(every, marks, tolerance)
    said = said_of_dwells([every[i] for i in numbers], marks, tolerance)
    bar = max(rig.bars.values(), key=lambda bar: bar.travel).name
    mounted = dict(zip(BAR_MOUNTED, (bar, next(iter(rig.chucks)), next(iter(rig.spheres))), strict=True))
    labels = [DwellLabel(dwell.start_host_ns, dwell.end_host_ns, mounted) for dwell in every]
    measured = observations(lambda: iter(()), rig, found=survey, labels=labels).dwells
    return [Stop((path, i + 1), measured[i], words, marks) for i, words in zip(numbers, said, strict=True)]


def chances_of(robot: Robot, rig: Rig, stops: Sequence[Stop]) -> MountingChances:
    """Return the probability of what was mounted at each stop, by all evidence. Raises InputError."""
    dwells, wanted = [stop.dwell for stop in stops], len(robot.chain.joints)
    for joints in {dwell.q.size for dwell in dwells} - {wanted}:
        raise InputError("other-robot", place="session", joints=joints, expected=wanted)
    extension, beyond = np.full(len(dwells), np.nan), np.zeros(len(dwells), dtype=bool)
    for i, dwell in enumerate(dwells):
        if not dwell.reason:
            bar = rig.bars[dwell.mounted["bar"]]
            extension[i] = (dwell.value - bar.zero) / bar.gain
        beyond[i] = dwell.reason == "out of travel" or (dwell.reason == "rail" and "fault" not in dwell.detail)
    words = Words([stop.said.planned for stop in stops], [stop.said.typed for stop in stops])
    readings = Readings(np.array([dwell.q for dwell in dwells]), extension, beyond)
    return mountings(robot.chain, rig, readings, words, robot.free)


def borne_out_rows(robot: Robot, rig: Rig, result: SyncResult) -> NDArray[np.bool_]:
    """Return the rows (n,) of a session's table that are no dwells, or have labels that the readings support."""
    out = np.ones(len(result.table), dtype=bool)
    used = {i + 1: pairing_of(dwell.mounted) for i, dwell in enumerate(result.dwells) if not dwell.reason}
    if len(used) >= LEAST_DWELLS and result.table.q.shape[1] == len(robot.chain.joints):
        stops = stops_of(Path(), rig, result.survey)
        number, chances = {stop.place[1]: k for k, stop in enumerate(stops)}, chances_of(robot, rig, stops)
        out[: len(used)] = [chances.supports(number[place], label) for place, label in used.items()]
    return out
