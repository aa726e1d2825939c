"""The pose of a controller's own base and flange in the frames named by a calibration.

Universal Robots' controllers express poses in ``base``, rotated by half a turn about z from ur_description's
``base_link``; their flange is ``tool0``. ABB's controllers use the base frame, ROS-Industrial's ``base`` or
``base_link``, and their ``tool0`` is the flange with z pointing out of it. ROS's ``flange`` has x pointing out of the
flange (REP 199). Robots that are not URDFs, such as truearm's built-in ones, use the controller's own frames. ROS-Industrial's ``base`` of KUKA and Fanuc arms is the controller's world frame. Other
names do not determine the pose of a frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.text import one_line
from truearm.types import Floats


class Frame(NamedTuple):
    """A controller's frame in a frame of the calibration, (4, 4), and its description in words."""

    pose: Floats
    words: str

    def called(self, name: str) -> str:
        """Return what this frame is; ``name`` is that of the calibration's frame."""
        return f"the calibration's frame {one_line(name[:60])}" if self is SAME else self.words


def _turn(words: str, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Frame:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    return Frame(pose, words)


_HALF, _QUARTER = np.pi, 0.5 * np.pi
SAME = _turn("the same frame")
BASES = {
    "urscript": {
        "base_link": _turn("base (half a turn about z from base_link)", yaw=_HALF),
        "base_link_inertia": _turn("base (the same frame as base_link_inertia)"),
    },
    "rapid": {"base_link": _turn("base (the same frame as base_link)")},
}  # beside base, which is each controller's own
FLANGES = {
    "urscript": {"flange": _turn("tool0 (z out of the flange)", roll=_QUARTER, yaw=_QUARTER)},
    "rapid": {"flange": _turn("tool0 (z out of the flange)", pitch=_QUARTER)},
}  # beside tool0
OUT = {"tool0": 2, "flange": 0}  # which of a frame's axes points out of the flange
ALONG = 1.0 - 1e-6


def base_of(language: str, frame: str) -> Frame | None:
    """Return the controller's base in the calibration's base frame, or None if the name does not determine it."""
    return SAME if frame == "base" else BASES.get(language, {}).get(frame)


def flange_of(language: str, frame: str, brought: bool, axis: Floats | None = None) -> Frame | None:
    """Return the controller's flange in the calibration's end frame, or None if the name does not determine it.

    ``brought``: the robot is not a URDF. ``axis``: the last joint's axis (3,) in the end frame. In a URDF, it must be
    the direction that points out of a frame of this name: not every description follows REP 199.
    """
    if brought:
        return SAME if frame in ("flange", "tool0") else None
    if axis is not None and abs(axis[OUT.get(frame, 2)]) < ALONG:
        return None
    return SAME if frame == "tool0" else FLANGES.get(language, {}).get(frame)
