"""Mimic joints: joints without an encoder that move with another, as in the parallelogram of a palletizer.

The reading of a mimic joint is ``multiplier``·q + ``offset`` of the joint that it follows. Its true angle follows from
this reading by its own law, so a robot with mimic joints is an ordinary serial chain.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from truearm.types import Floats


class Mimic(NamedTuple):
    """What a mimic joint follows: the index of another joint, which mimics none."""

    followed: int
    multiplier: float
    offset: float  # rad or m


NO_MIMICS: Mapping[int, Mimic] = {}


def units_of(n_readings: int, joint_units: Sequence[str], mimics: Collection[int]) -> Sequence[str]:
    """Return the units of the readings of all joints, or of all that are not mimic joints if there are as many readings."""
    if n_readings != len(joint_units) - len(mimics):
        return joint_units
    return [unit for joint, unit in enumerate(joint_units) if joint not in mimics]


def completed(q: Floats, mimics: Mapping[int, Mimic], n_joints: int) -> Floats:
    """Return the readings of all joints (…, j), from those of all joints or of all that are not mimic joints.

    ``mimics``: by joint. The readings of mimic joints in ``q`` are not used.
    """
    if not mimics:
        return q
    moving = [joint for joint in range(n_joints) if joint not in mimics]
    readings = np.empty((*q.shape[:-1], n_joints), q.dtype)
    readings[..., moving] = q[..., moving] if q.shape[-1] == n_joints else q
    for joint, (followed, multiplier, offset) in mimics.items():
        readings[..., joint] = multiplier * readings[..., followed] + offset
    return readings
