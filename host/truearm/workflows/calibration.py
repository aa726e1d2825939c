"""What later commands read of an identification: a result.json and the robot that it is of."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from truearm.errors import InputError
from truearm.files.result_file import StoredResult, read_result
from truearm.files.robot_file import joint_units, load_robot
from truearm.model.builtin import builtin_names
from truearm.model.chain import Chain
from truearm.model.mountings import NONE, Mountings, mountings
from truearm.model.poses import six_of
from truearm.types import Floats

LARGEST_JOINT = 100.0  # rad, m


class Calibration(NamedTuple):
    """A robot's chain with its nominal and identified parameters (p,)."""

    chain: Chain
    nominal: Floats
    identified: Floats
    joint_units: tuple[str, ...]
    robot: str  # what --robot names
    stored: StoredResult
    covariance: Floats  # (p, p) of the parameters
    unseen: Floats  # (p, d) directions that the observations did not see, the largest weight of each being 1


def read_calibration(result: Path, robot: str | None, base: str | None = None, tip: str | None = None) -> Calibration:
    """Read a result and its robot; ``robot`` None: the built-in one of the name that the result has.

    Raises InputError where the two do not belong together.
    """
    stored = read_result(result)
    frames = stored.robot
    if robot is None:
        if frames.name not in builtin_names():
            raise InputError(f"{result}: is of robot {frames.name[:60]!r}; name its file with --robot")
        robot = frames.name
    if robot.lower().endswith((".urdf", ".xml")):
        base, tip = base or frames.base_frame, tip or frames.end_frame
    chain = load_robot(robot, base, tip).chain
    mine = stored.of_robot
    names = tuple(name for name, is_robot in zip(stored.parameter_names, mine, strict=True) if is_robot)
    if names != chain.parameter_names or frames.joint_units != joint_units(chain):
        raise InputError(
            f"{result}: its parameters are not those of robot {robot}; give the robot it was identified with"
        )
    nominal, identified = stored.nominal[mine], stored.value[mine]
    if not np.allclose(nominal, chain.params_nominal, rtol=0.0, atol=1e-9):
        at = int(np.argmax(np.abs(nominal - chain.params_nominal)))
        raise InputError(
            f"{result}: began from another {names[at]} than robot {robot} has; give the robot it was identified with"
        )
    if not np.isfinite(identified).all() or not np.abs(identified).max() < 1e4:
        raise InputError(f"{result}: a parameter's value is missing or absurd; identify again")
    known = _covariance(stored, names), _unseen(result, stored, names)
    return Calibration(chain, nominal, identified, joint_units(chain), robot, stored, *known)


def check_names(*paths: Path | None) -> None:
    """Raise InputError for "-": neither standard input nor standard output is meant by any of these."""
    if Path("-") in paths:
        raise InputError("-: is no file name; standard input and output are not used, give files")


def chosen_mountings(calibration: Calibration, own_frames: bool) -> Mountings:
    """The mountings to take out: the calibration's, or none."""
    return mountings(calibration.chain, calibration.nominal, calibration.identified) if own_frames else NONE


def six_text(pose: Floats) -> str:
    """A pose in mm and deg."""
    x, y, z, alpha, beta, gamma = six_of(pose)
    turns = ", ".join(f"{np.rad2deg(v):.4f}" for v in (alpha, beta, gamma))
    return f"x, y, z {1e3 * x:.3f}, {1e3 * y:.3f}, {1e3 * z:.3f} mm; Rz, Ry, Rx {turns} deg"


def mounting_lines(chain: Chain, nominal: Floats, identified: Floats) -> list[str]:
    """The mountings by the names of the frames that they lie between."""
    found = mountings(chain, nominal, identified)
    return [
        f"robot's base in {chain.base_frame}: {six_text(found.base)}",
        f"{chain.end_frame} beyond the nominal one, in its axes: {six_text(found.tool)}",
    ]


def joints_of(option: str, text: str | None, units: tuple[str, ...]) -> Floats | None:
    """Joint readings (j,) of an option in deg and mm; None where it was not given. Raises InputError."""
    if text is None:
        return None
    scale = np.array([math.radians(1.0) if unit == "rad" else 1e-3 for unit in units])
    q = scale * numbers_of(option, text, len(units))
    if np.abs(q).max() > LARGEST_JOINT:
        raise InputError(f"{option} {text[:60]}: no joint goes so far")
    return q


def numbers_of(option: str, text: str, count: int) -> Floats:
    """The numbers between the commas of an option. Raises InputError."""
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.size != count or not np.isfinite(values).all():
        raise InputError(f"{option} {text[:60]}: needs {count} numbers between commas")
    return values


def _covariance(stored: StoredResult, names: tuple[str, ...]) -> Floats:
    """(p, p) of the robot's parameters, 0 for what was held."""
    at = {name: i for i, name in enumerate(names)}
    covariance = np.zeros((len(names), len(names)))
    rows = [i for i, name in enumerate(stored.covariance_names) if name in at]
    to = [at[stored.covariance_names[i]] for i in rows]
    covariance[np.ix_(to, to)] = np.nan_to_num(stored.covariance[np.ix_(rows, rows)])
    return covariance


def _unseen(result: Path, stored: StoredResult, names: tuple[str, ...]) -> Floats:
    """(p, d) the robot's part of the null space. Raises InputError."""
    at = {name: i for i, name in enumerate(names)}
    try:
        directions = list(stored.document["null_space"])
        unseen = np.zeros((len(names), len(directions)))
        for k, direction in enumerate(directions):
            for name, weight in zip(direction["names"], direction["weights"], strict=True):
                if name in at:
                    unseen[at[name], k] = float(weight)
    except (TypeError, ValueError, KeyError, OverflowError) as exc:
        raise InputError(f"{result}: its null_space has the wrong form: {exc}") from exc
    if not np.isfinite(unseen).all():
        raise InputError(f"{result}: its null_space has weights that are no numbers")
    return unseen
