"""Where a controller's own base and flange are in the frames that a calibration names.

Universal Robots' controllers count poses in ``base``, half a turn about z from ur_description's ``base_link``; their flange is ``tool0``. ABB's count in the base
frame, ROS-Industrial's ``base`` or ``base_link``, and their ``tool0`` is the flange with z out of it. ROS's ``flange`` has x out of the flange (REP 199). Robots
that are not URDFs, as those that truearm brings, are in the controller's own frames. Other names say nothing of where a frame is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.types import Floats


class Frame(NamedTuple):
    """A controller's frame in a frame of the calibration, (4, 4), and how it is said."""

    pose: Floats
    words: str


def _turn(words: str, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Frame:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    return Frame(pose, words)


_HALF, _QUARTER = np.pi, 0.5 * np.pi
SAME = _turn("the same frame")
BASES = {
    "urscript": {
        "base": SAME,
        "base_link": _turn("base, half a turn about z from base_link", yaw=_HALF),
        "base_link_inertia": _turn("base, the same frame as base_link_inertia"),
    },
    "rapid": {"base": SAME, "base_link": _turn("base, the same frame as base_link")},
}
FLANGES = {
    "urscript": {
        "tool0": SAME,
        "flange": _turn("tool0, z out of the flange", roll=_QUARTER, yaw=_QUARTER),
    },
    "rapid": {"tool0": SAME, "flange": _turn("tool0, z out of the flange", pitch=_QUARTER)},
}


def base_of(language: str, frame: str, brought: bool) -> Frame | None:
    """The controller's base in the calibration's base frame; None where the name does not say. ``brought``: the robot is not a URDF."""
    return SAME if brought and frame == "base" else BASES[language].get(frame)


def flange_of(language: str, frame: str, brought: bool) -> Frame | None:
    """The controller's flange in the calibration's end frame; None where the name does not say."""
    return SAME if brought and frame in ("flange", "tool0") else FLANGES[language].get(frame)
