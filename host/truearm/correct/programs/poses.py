"""Poses of literals, and the numbers that a literal needs for a pose."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.correct.programs.data import Form, Literal
from truearm.correct.programs.reading import Uncertain
from truearm.model.poses import pose_of
from truearm.types import Floats
from truearm.units import DEG, MM, UNITS

UNIT_QUATERNION = 1e-3  # largest deviation of a quaternion's norm from 1


def matrix_of_angles(x: float, y: float, z: float, a: float, b: float, c: float) -> Floats:
    """Return the pose (4, 4) at x, y, z [mm], rotated by a, b, c [deg] about z, the new y and the new x."""
    return np.asarray(_poses(Form.ANGLES, np.array([[x, y, z, a, b, c]]))[0])


def matrix_of_quaternion(xyz: Sequence[float], quaternion: Sequence[float]) -> Floats:
    """Return the pose (4, 4) at xyz [mm], rotated by a quaternion, scalar first. Raises Uncertain if it is no unit one."""
    check_quaternion(quaternion)
    return np.asarray(_poses(Form.ROBTARGET, np.array([[*xyz, *quaternion]]))[0])


def check_quaternion(quaternion: Sequence[float]) -> None:
    """Raise Uncertain unless a quaternion has the norm 1."""
    norm = math.hypot(*quaternion)
    if not abs(norm - 1.0) <= UNIT_QUATERNION:
        raise Uncertain("quaternion", norm=norm)


def check_reach(literal: Literal) -> None:
    """Raise Uncertain for numbers that no robot can reach."""
    if literal.form is Form.ROBTARGET:
        check_quaternion(literal.numbers[3:7])
    number, largest = max(literal.numbers[:6], key=abs), UNITS["m"].largest
    if not abs(number) <= (largest if literal.form in (Form.VECTOR, Form.RADIANS) else MM.of(largest)):
        raise Uncertain("range", number=number)


def poses_of(literals: Sequence[Literal]) -> Floats:
    """Return the poses (n, 4, 4) [m] of literals; NaN for joint readings."""
    poses = np.full((len(literals), 4, 4), np.nan)
    for form in {literal.form for literal in literals if not literal.form.is_joints}:
        rows = [row for row, literal in enumerate(literals) if literal.form is form]
        poses[rows] = _poses(form, np.array([literals[row].numbers[: form.size] for row in rows]))
    return poses


def _poses(form: Form, numbers: Floats) -> Floats:
    """Return the poses (n, 4, 4) [m] of numbers (n, 6 or 7) that are no joint readings."""
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, 3], angles = MM.to_si(numbers[:, :3]), numbers[:, 3:]
    if form is Form.VECTOR:
        return pose_of(numbers[:, :3], angles)
    is_quaternion = form is Form.ROBTARGET
    turn = (
        Rotation.from_quat(np.roll(angles, -1, axis=1))
        if is_quaternion
        else Rotation.from_euler("ZYX", angles, degrees=True)
    )
    poses[:, :3, :3] = turn.as_matrix()
    return poses


def readings_of(literal: Literal) -> Floats:
    """Return the joint readings [rad] of a literal of six."""
    readings = np.array(literal.numbers[:6])
    return np.asarray(DEG.to_si(readings)) if literal.form is Form.DEGREES else readings


def texts_of_readings(literal: Literal, readings: Floats) -> list[str]:
    """Return joint readings (6,) [rad] as the numbers of a literal, to 1e-10 rad or 1e-8 deg."""
    if literal.form is Form.DEGREES:
        return [plain(value, 8) for value in DEG.of(readings)]
    return [plain(value, 10) for value in readings.tolist()]


def texts_of_poses(literals: Sequence[Literal], poses: Floats) -> list[list[str]]:
    """Return poses (n, 4, 4) as the numbers of literals: to 1 nm (mm: 10 nm) and 1e-9 of a rotation.

    A rotation vector is the one nearest to the literal's own, and so are a quaternion's sign and whole turns of angles.
    """
    texts: list[list[str]] = [[] for _ in literals]
    for form in {literal.form for literal in literals}:
        rows = [row for row, literal in enumerate(literals) if literal.form is form]
        turn = Rotation.from_matrix(poses[rows, :3, :3])
        old = np.array([literals[row].numbers[3 : form.size] for row in rows])
        xyz = poses[rows, :3, 3]
        if form is Form.ROBTARGET:
            angles, decimals = np.roll(turn.as_quat(), 1, axis=1), (5, 10)
            angles *= np.where((angles * old).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        else:
            is_vector = form is Form.VECTOR
            angles = _nearest_vectors(turn.as_rotvec(), old) if is_vector else _nearest_angles(turn, old)
            decimals = (9, 9) if is_vector else (6, 8)
        numbers = np.concatenate([xyz if form is Form.VECTOR else MM.of(xyz), angles], axis=1)
        for row, values in zip(rows, numbers.tolist(), strict=True):
            texts[row] = [plain(value, decimals[column > 2]) for column, value in enumerate(values)]
    return texts


def _nearest_vectors(vectors: Floats, old: Floats) -> Floats:
    """Return rotation vectors (n, 3) with whole turns added to be nearest to the old ones."""
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    axis = vectors / np.maximum(angle, 1e-12)
    alternatives = np.stack([axis * (angle + 2.0 * np.pi * turns) for turns in (-2, -1, 0, 1, 2)])
    nearest = np.linalg.norm(alternatives - old, axis=2).argmin(axis=0)
    return np.asarray(np.where(angle < 1e-9, vectors, alternatives[nearest, np.arange(len(vectors))]))


def _nearest_angles(turn: Rotation, old: Floats) -> Floats:
    """Return A, B, C (n, 3) [deg] or the other angles of the same rotation, whichever are nearer to the old ones."""
    angles = turn.as_euler("ZYX", degrees=True)
    mirrored = np.stack([angles[:, 0] + 180.0, 180.0 - angles[:, 1], angles[:, 2] + 180.0], axis=1)
    alternatives = np.stack([solution + 360.0 * np.round((old - solution) / 360.0) for solution in (angles, mirrored)])
    nearest = np.abs(alternatives - old).max(axis=2).argmin(axis=0)
    return np.asarray(alternatives[nearest, np.arange(len(angles))])


def plain(value: float, decimals: int) -> str:
    """Return a number without an exponent, trailing zeros or a negative zero."""
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
