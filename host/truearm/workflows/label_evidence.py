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
from truearm.types import Rig

if TYPE_CHECKING:
    from truearm.model.robot import Robot
    from truearm.session.dwells import Dwell
    from truearm.session.observations import SyncResult
    from truearm.session.plan_matching import Marks

LEAST_DWELLS = 3  # fewer cannot support one another


class Stop(NamedTuple):
    """A stop that may be a dwell, with its file and its number there, from 1, and what was said about it."""

    place: tuple[Path, int]
    dwell: Dwell
    said: Said
    marks: Marks


def stops_of(path: Path, result: SyncResult) -> list[Stop]:
    """Return the stops of a session that may be dwells of its plan."""
    from truearm.session.dwells import DwellRules

    every, marks, tolerance = result.survey.dwells, result.survey.marks, DwellRules().pose_tolerance
    numbers = may_be_dwells(every, marks, tolerance)
    said = said_of_dwells([every[i] for i in numbers], marks, tolerance)
    return [Stop((path, i + 1), result.dwells[i], words, marks) for i, words in zip(numbers, said, strict=True)]


def chances_of(robot: Robot, rig: Rig, stops: Sequence[Stop]) -> MountingChances:
    """Return the probability of what was mounted at each stop, by all evidence. Raises InputError."""
    dwells, wanted = [stop.dwell for stop in stops], len(robot.chain.joints)
    for joints in {dwell.q.size for dwell in dwells} - {wanted}:
        raise InputError("joint-count", place="session", joints=joints, expected=wanted)
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
    labels = [pairing_of(dwell.mounted) for dwell in result.dwells if not dwell.reason]
    if len(labels) >= LEAST_DWELLS and result.table.q.shape[1] == len(robot.chain.joints):
        stops = stops_of(Path(), result)
        used = [k for k, stop in enumerate(stops) if not stop.dwell.reason]
        chances = chances_of(robot, rig, stops)
        out[: len(labels)] = [chances.supports(k, label) for k, label in zip(used, labels, strict=True)]
    return out
