"""The entries of a rig file that measure: lines, trackers, flats, and the joints' own noise (docs/table-format.md)."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from truearm.errors import RigError
from truearm.files.rig_values import (
    LARGEST_MATRIX,
    RADIANS,
    check_keys,
    in_si,
    keys,
    length,
    number,
    positive,
    sigma_or_unknown,
    square,
    three,
    within,
)
from truearm.types import Device, Matrix, Plane


def device(table: Mapping[str, Any], name: str, where: str) -> Device:
    """A [[line]] or [[tracker]]."""
    angles = keys(("rotation", "turn_sigma", "rotation_sigma"), RADIANS)
    check_keys(table, {"name", "covariance_m2"} | keys(("sigma", "xyz", "position_sigma")) | angles, where)
    placed = any(key in table for key in keys(("xyz",)))
    sigmas = (
        sigma_or_unknown(table, "position_sigma", where, "unknown"),
        sigma_or_unknown(table, "turn_sigma", where, "unknown", RADIANS),
    )
    if not placed and 0.0 in sigmas:
        raise RigError(f"{where}: a pose known exactly (sigma 0) needs xyz_m (or xyz_mm), and rotation_rad if turned")
    measured = any(key in table for key in keys(("rotation_sigma",), RADIANS))
    turn = sigma_or_unknown(table, "rotation_sigma", where, 0.0, RADIANS) if measured else None
    return Device(
        name=name,
        sensor_cov=_sensor_cov(table, where),
        xyz=three(table, "xyz", where) if placed else None,
        rotation=three(table, "rotation", where, RADIANS, default=(0.0, 0.0, 0.0)),
        sigma=sigmas[0],
        turn_sigma=sigmas[1],
        rotation_sigma=turn if turn is None else positive(turn, "rotation_sigma", where),
    )


def plane(table: Mapping[str, Any], name: str, where: str) -> Plane:
    """A [[plane]]."""
    lengths = keys(("xyz", "sigma", "offset_sigma"))
    check_keys(table, {"name", "normal"} | lengths | keys(("tilt_sigma",), RADIANS), where)
    value = table.get("normal")
    if not isinstance(value, list) or len(value) != 3:
        raise RigError(f"{where}: normal must be three numbers, such as [0, 0, 1] for a table seen from above")
    x, y, z = (number(v, "normal", where) for v in value)
    if not any((x, y, z)):
        raise RigError(f"{where}: normal must not be zero")
    return Plane(
        name=name,
        xyz=three(table, "xyz", where),
        normal=(x, y, z),
        sigma=positive(length(table, "sigma", where), "sigma", where),
        offset_sigma=sigma_or_unknown(table, "offset_sigma", where, "unknown"),
        tilt_sigma=sigma_or_unknown(table, "tilt_sigma", where, "unknown", RADIANS),
    )


def joint_cov(data: Mapping[str, Any], where: str) -> Matrix:
    """S_q from ``joint_sigma_rad`` (or ``_deg``), one a joint, or ``joint_cov_si``, j×j; empty where there is none."""
    given = [key for key in ("joint_cov_si", "joint_sigma_rad", "joint_sigma_deg") if key in data]
    if not given:
        return ()
    if len(given) > 1:
        raise RigError(f"{where}: has both {given[0]} and {given[1]}; keep one")
    if given == ["joint_cov_si"]:
        matrix = square(data["joint_cov_si"], "joint_cov", where)
        _check_covariance(matrix, "joint_cov", where, singular=True)
        return matrix
    value, scale = in_si(data, "joint_sigma", where, RADIANS)
    if not isinstance(value, list) or not 0 < len(value) <= LARGEST_MATRIX:
        raise RigError(f"{where}: {given[0]} must be a list of numbers, one a joint")
    sigma = [within(number(v, "joint_sigma", where) * scale, 0.0, "joint_sigma", where) for v in value]
    return _diagonal(sigma)


def _sensor_cov(table: Mapping[str, Any], where: str) -> Matrix:
    """S_x from ``sigma_mm`` (or ``_m``), three numbers along the device's axes, or ``covariance_m2``, 3×3."""
    if "covariance_m2" not in table:
        sigma = three(table, "sigma", where)
        positive(min(sigma), "sigma", where)
        return _diagonal(sigma)
    if any(key in table for key in keys(("sigma",))):
        raise RigError(f"{where}: has both a sigma and a covariance_m2; keep one")
    matrix = square(table["covariance_m2"], "covariance_m2", where, 3)
    _check_covariance(matrix, "covariance_m2", where, singular=False)
    return matrix


def _check_covariance(matrix: Matrix, key: str, where: str, *, singular: bool) -> None:
    array = np.array(matrix)
    if not np.allclose(array, array.T, rtol=1e-9, atol=0.0):
        raise RigError(f"{where}: {key} must be symmetric")
    least, most = np.linalg.eigvalsh(array)[[0, -1]]
    rounding = 1e-12 * abs(most)
    if least < -rounding or (least <= rounding and not singular):
        raise RigError(f"{where}: {key} is no covariance, it has an eigenvalue of {least:g}")


def _diagonal(sigma: Iterable[float]) -> Matrix:
    values = tuple(sigma)
    return tuple(tuple(s * s if i == k else 0.0 for k in range(len(values))) for i, s in enumerate(values))


def device_text(key: str, thing: Device) -> str:
    """The entry of a line or tracker."""
    lines = [f"[[{key}]]", f"name = {json.dumps(thing.name)}", f"covariance_m2 = {matrix_text(thing.sensor_cov)}"]
    if thing.xyz is not None:
        lines.append(f"xyz_m = {numbers(thing.xyz)}")
    if thing.xyz is not None or any(thing.rotation):
        lines.append(f"rotation_rad = {numbers(thing.rotation)}")
    lines += [f"position_sigma_m = {sigma_text(thing.sigma)}", f"turn_sigma_rad = {sigma_text(thing.turn_sigma)}"]
    if thing.rotation_sigma is not None:
        lines.append(f"rotation_sigma_rad = {float(thing.rotation_sigma)!r}")
    return "\n".join(lines)


def plane_text(thing: Plane) -> str:
    """The entry of a flat."""
    lines = ["[[plane]]", f"name = {json.dumps(thing.name)}", f"xyz_m = {numbers(thing.xyz)}"]
    lines += [f"normal = {numbers(thing.normal)}", f"sigma_m = {float(thing.sigma)!r}"]
    lines += [f"offset_sigma_m = {sigma_text(thing.offset_sigma)}", f"tilt_sigma_rad = {sigma_text(thing.tilt_sigma)}"]
    return "\n".join(lines)


def numbers(values: Iterable[float]) -> str:
    """A TOML array that comes back bit for bit."""
    return str([float(v) for v in values])


def matrix_text(matrix: Matrix) -> str:
    """A TOML array of rows."""
    return f"[{', '.join(numbers(row) for row in matrix)}]"


def sigma_text(sigma: float | None) -> str:
    """A standard deviation, or that nothing is known."""
    return '"unknown"' if sigma is None else repr(float(sigma))
