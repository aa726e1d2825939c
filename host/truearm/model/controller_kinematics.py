"""The kinematics that a Universal Robots controller computes with, from its factory calibration.

    T(q) = Π Rz(q_i)·Rz(θ_i)·Tz(d_i)·Tx(a_i)·Rx(α_i)

Joints 2, 3 and 4 are nearly parallel, so d of their rows are up to hundreds of metres and cancel. Sources: the
sub-package KinematicsInfo of the primary interface (all rows), the controller's ``calibration.conf`` (differences from
the drawing), and the file that ``ur_calibration`` makes of the rows (``export.ur``). Layout of the sub-package:
Universal Robots' client library, ``src/primary/robot_state/kinematics_info.cpp``.
"""

from __future__ import annotations

import math
import re
import struct
from functools import reduce
from typing import NamedTuple

import numpy as np

from truearm.errors import RobotError
from truearm.model.chain_structure import far_frames
from truearm.model.transforms import elementary
from truearm.types import Floats

JOINTS = 6
INFO = struct.Struct(">6I24dI")  # checksums; θ, a, d, α; status of the calibration
LARGEST_M, LARGEST_RAD = 1e5, 100.0
ROWS = ("theta", "a", "d", "alpha")
SEGMENTS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
SIX = ("tx", "ty", "tz", "rz", "ry", "rx")


class ControllerKinematics(NamedTuple):
    """``links`` (7, 4, 4): before, between and after six joints about z.

    ``checksums``: of the joints, () if unknown.
    """

    links: Floats
    checksums: tuple[int, ...] = ()

    def forward(self, q: Floats) -> Floats:
        """Return the poses (n, 4, 4) of the flange in the base frame of the controller, at joint readings q (n, 6)."""
        return far_frames(self.links, ["rz"] * JOINTS, q)[-1]


def kinematics_of_info(info: bytes) -> ControllerKinematics:
    """Return the kinematics in a sub-package KinematicsInfo without its head. Raises RobotError."""
    if len(info) < INFO.size:
        raise RobotError(f"the kinematics have {len(info)} bytes instead of {INFO.size}; update the controller")
    numbers = INFO.unpack_from(info)
    return _of_rows(np.array(numbers[JOINTS:-1]).reshape(len(ROWS), JOINTS), numbers[:JOINTS])


def kinematics_of_conf(text: str, drawing: Floats) -> ControllerKinematics:
    """Return the kinematics of a calibration.conf and the drawing's θ, a, d, α (4, 6). Raises RobotError."""
    lists = dict(re.findall(r"^\s*(\w+)\s*=\s*\[([^\]]*)\]", text, re.MULTILINE))
    deltas = [_numbers(f"delta_{name}", lists.get(f"delta_{name}")) for name in ROWS]
    has_checksums = re.search(r"^\s*joint_checksum\b", text, re.MULTILINE)
    words = [word.strip() for word in lists.get("joint_checksum", "").split(",")] if has_checksums else []
    broken = [word for word in words if not re.fullmatch(r"0x[0-9a-fA-F]{1,8}", word)]
    if broken or len(words) not in (0, JOINTS):
        reason = f"{broken[0]!r} is not a checksum like 0x1a2b3c4d" if broken else f"needs {JOINTS} checksums"
        raise RobotError(f"joint_checksum: {reason}; copy the file from the controller again")
    return _of_rows(drawing + deltas, tuple(int(word, 16) for word in words))


def kinematics_of_yaml(text: str) -> ControllerKinematics:
    """Return the kinematics of a file of ur_calibration. Raises RobotError."""
    segments: dict[str, dict[str, str]] = {}
    for line in text.splitlines():
        if entry := re.fullmatch(r"\s*(\w+)\s*:\s*([^\s#]*)\s*(?:#.*)?", line):
            if entry[2]:
                segments.setdefault(next(reversed(segments), ""), {})[entry[1]] = entry[2]
            else:
                segments[entry[1]] = {}
    links = []
    for name in SEGMENTS:
        words = [segments.get(name, {}).get(key, "") for key in KEYS]
        x, y, z, roll, pitch, yaw = _numbers(f"kinematics of {name}", ",".join(words))
        links.append(_product(SIX, (x, y, z, yaw, pitch, roll)))
    return ControllerKinematics(np.stack([*links, np.eye(4)]))


def _numbers(name: str, text: str | None) -> list[float]:
    """Return six finite numbers. Raises RobotError."""
    try:
        values = [float(word) for word in (text or "").split(",")]
    except ValueError:
        values = []
    if len(values) != JOINTS or not all(map(math.isfinite, values)):
        raise RobotError(f"{name}: needs {JOINTS} numbers; is this a file of a Universal Robots controller?")
    return values


def _of_rows(rows: Floats, checksums: tuple[int, ...]) -> ControllerKinematics:
    """Return the kinematics of θ, a, d, α (4, 6). Raises RobotError for numbers that no arm has."""
    largest = np.array([[LARGEST_RAD], [LARGEST_M], [LARGEST_M], [LARGEST_RAD]])
    if not (np.abs(rows) <= largest).all():  # NaN too
        raise RobotError("the kinematics have numbers that no arm has; restart the controller and read them again")
    links = [_product(("rz", "tz", "tx", "rx"), (theta, d, a, alpha)) for theta, a, d, alpha in rows.T]
    return ControllerKinematics(np.stack([np.eye(4), *links]), checksums)


def _product(motions: tuple[str, ...], amounts: tuple[float, ...]) -> Floats:
    return reduce(np.matmul, map(elementary, motions, amounts))
