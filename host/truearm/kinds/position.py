"""A target on the tool, measured as a point in a device's own axes: a tracker, or a line device (``line.py``).

    m = κ R_dᵀ (T(q)·s − p_d) ,   δm = −κ R_dᵀ (δp + δφ × r) ,   r = T(q)·s − p_d

with the device's pose (R_d, p_d) in the base frame, and its motion δp and small rotation δφ about the base axes. κ is
its scale (1; a laser's wavelength). This is (27), (28) of Renders (1991), with the lever in base axes; printed [m]×
holds for a device parallel to the base. The residual is in the device's axes, where the sensors' covariance is
declared.

Parameters are x, y, z (p_d, m) and rx, ry, rz, a rotation vector ω from the declared orientation R_r: R_d =
exp([ω]×)·R_r and δφ = J_l(ω) δω.

The joints were truly at q_reading(t + τ), so ∂m/∂τ = J_q·q̇.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from truearm.errors import ProblemError
from truearm.kinds.columns import POINT, SPREAD
from truearm.kinds.group import XYZ, Fault, Group, Linearised, RigNumber, Used, gather, linearised, or_inf, rows_of
from truearm.kinds.kind import Kind, RigUse, Scope, look_up, measured, nominal_points, sigmas, use_points
from truearm.kinds.rig_entries import DEVICE, TARGET, by_name
from truearm.model.chain import Chain, PointTrace, along, trace_point
from truearm.model.transforms import cross, rotation, rotation_and_jacobian, rotation_vector
from truearm.schema import Entries
from truearm.types import Device, Floats, Indices

STRAIGHT = 1e-9  # points that deviate from a line by 3e-5 of its length do not determine the roll about it

Placing = Callable[[Floats, Floats, Device], tuple[Floats, Floats]]  # readings, the same points by the nominal robot


@dataclass(frozen=True, kw_only=True)
class PositionRows(Group):
    """n measured points; indices refer to x followed by ``constants``."""

    COMPONENTS: ClassVar[tuple[str, ...]] = ("m", "m", "m")

    q: Floats  # (n, j)
    q_rate: Floats  # (n, j), 0 where the robot was at rest
    xyz: Floats  # (n, 3) measured, m, in the device's axes
    target: Indices  # (n, 3) in the end frame
    device: Indices  # (n, 6) x, y, z, rx, ry, rz
    reference: Floats  # (n, 3, 3) declared orientation R_r of the device
    scale: Indices  # (n, 1) of the device
    time_offset: Indices  # (n, 1)

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (3n,) and their derivatives at x (P,)."""
        q = joints_in_time(self, x)
        trace = trace_point(chain, x[: len(chain.parameters)], q, gather(x, self.constants, self.target))
        device = gather(x, self.constants, self.devices)
        rot, turns = rotation_and_jacobian(device[:, 3:])
        return in_device_axes(trace, self, x, device, rot @ self.reference[: len(device)], turns)

    @property
    def devices(self) -> Indices:
        """Return ``device``, (1, 6) if all rows have the same one, as usual."""
        return self.device[:1] if (self.device == self.device[:1]).all() else self.device

    def orientations(self) -> Indices:
        """Return the indices (r, 3) of the devices' rotation vectors."""
        return self.devices[:, 3:]


def joints_in_time(rows: PositionRows, x: Floats) -> Floats:
    """Return the joint readings (n, j) shifted by the time offset."""
    return np.asarray(rows.q + rows.q_rate * gather(x, rows.constants, rows.time_offset))


def in_device_axes(
    trace: PointTrace, rows: PositionRows, x: Floats, device: Floats, rot: Floats, turns: Floats
) -> Linearised:
    """Return residual and derivatives for traced targets and devices (n or 1, 6).

    ``rot`` are the devices' orientations and ``turns`` the left Jacobians of their rotation vectors, (n or 1, 3, 3).
    """
    lever = trace.p_base - device[:, :3]  # r
    at_scale_1 = np.einsum("nik,ni->nk", rot, lever)
    predicted, axes = at_scale_1, rot.transpose(2, 0, 1)  # (3, n or 1, 3) the device's, in the base frame
    scale = gather(x, rows.constants, rows.scale)
    if (scale != 1.0).any():
        predicted, axes = scale * predicted, scale * axes
    derivative = along(trace, axes)
    columns = [(rows.target, derivative.jac_point), (rows.scale, at_scale_1.T[:, :, None])]
    if (rows.device < x.size).any():
        # −u·(δφ × r) = (u × r)·δφ
        moment = cross(axes.transpose(2, 0, 1), lever.T[:, None]).transpose(1, 2, 0)
        columns.append((rows.device[:, :3], np.broadcast_to(-axes, (3, *lever.shape))))
        columns.append((rows.device[:, 3:], np.einsum("wni,nik->wnk", moment, turns)))
    if (rows.time_offset < x.size).any():
        columns.append((rows.time_offset, (derivative.jac_joints * rows.q_rate).sum(axis=2, keepdims=True)))
    return linearised(rows.xyz - predicted, derivative, x, *columns)


def place(p_device: Floats, p_base: Floats, declared: Floats) -> tuple[Floats, Floats]:
    """Return the pose of a device that maps points (n, 3) in its own axes to points of the base, by least squares.

    The pose is a position (3,) and a rotation (3, 3). The part of the orientation that the points do not determine is
    taken from ``declared`` (3, 3): the roll about points on one line, or all of it for a single point.
    """
    middle_device, middle_base = p_device.mean(axis=0), p_base.mean(axis=0)
    rot = nearest_rotation((p_base - middle_base).T @ (p_device - middle_device), declared)
    return middle_base - rot @ middle_device, rot


def nearest_rotation(correlation: Floats, declared: Floats, largest_rank: int = 2) -> Floats:
    """Return the rotation R (3, 3) that maximises tr(Rᵀ H); among equals, the one closest to ``declared`` R_r.

    With ``correlation`` H (3, 3) = Σ p_base p_deviceᵀ = U S Vᵀ and two significant singular values, R = U diag(1, 1,
    ±1) Vᵀ (Arun, Huang, Blostein 1987; the sign ensures a rotation). Points on a line give one significant value: H
    only requires that v₁ is rotated to u₁, so R = u₁v₁ᵀ + U⊥ Q V⊥ᵀ, with Q (2, 2) in the same way closest to R_r in
    that plane. A single point gives none, and R = R_r. ``largest_rank`` 1 uses at most one: the roll about the line is
    then the declared one, regardless of the points.
    """
    u, size, vt = np.linalg.svd(correlation)
    k = min(largest_rank, int((size > STRAIGHT * size[0]).sum()), 2)
    left, _, right = np.linalg.svd(u[:, k:].T @ declared @ vt[k:].T)
    left[:, -1] *= np.sign(np.linalg.det(u) * np.linalg.det(vt) * np.linalg.det(left) * np.linalg.det(right))
    return np.asarray(u[:, :k] @ vt[:k] + u[:, k:] @ left @ right @ vt[k:])


def use_rig(scope: Scope, rows: Indices) -> RigUse:
    """Return what the rows use of the rig: targets and trackers."""
    return RigUse.of(PositionRows, scope, rows, **points_of(scope, rows, "tracker", scope.rig.trackers))


def _placed(xyz: Floats, p_base: Floats, device: Device) -> tuple[Floats, Floats]:
    return place(xyz, p_base, rotation(np.array(device.rotation)))


def points_of(
    scope: Scope, rows: Indices, column: str, entries: Mapping[str, Device], placed: Placing = _placed
) -> dict[str, Any]:
    """Return the fields of ``PositionRows`` for points in the axes of the devices named in a column.

    ``placed`` computes the pose of a device that the rig does not place, from its readings.
    """
    table = scope.table
    xyz = measured(scope, rows, POINT)
    labels, which = look_up(scope, rows, column, entries)
    devices = [entries[str(label)] for label in labels]
    targets = use_points(scope, rows, "target", scope.rig.targets)

    def placed_by_rows(i: int) -> tuple[Floats, Floats]:
        of_device = which == i
        p_base = nominal_points(scope, rows[of_device], targets._replace(which=targets.which[of_device]))
        return placed(xyz[of_device], p_base, devices[i])

    names = [scope.prefix + ".".join(filter(None, (column, str(label)))) for label in labels]
    numbers = [_device_numbers(name, devices[i], partial(placed_by_rows, i)) for i, name in enumerate(names)]
    scale_numbers = [[RigNumber(f"{name}.scale", "1", 1.0, 0.0)] for name in names]
    faults = (Fault(slice(None), step=False),) if column == "tracker" else ()
    offset = RigNumber(f"{scope.prefix}time_offset", "s", scope.rig.time_offset, or_inf(scope.rig.time_offset_sigma))
    number = offset if _moving(scope) else offset._replace(sigma=0.0)
    clock = Used([""], [[number]], np.zeros(len(rows), dtype=np.intp), (Fault(slice(None), step=False),))
    declared = np.array([rotation(np.array(d.rotation)) for d in devices])
    still = np.broadcast_to(0.0, (len(rows), table.q.shape[1]))
    rates = np.nan_to_num(table.q_rate[rows], nan=0.0) if number is offset else still
    return {
        "sensor_cov": _device_cov(scope, rows, devices, which),
        "q_rate": rates,
        "xyz": xyz,
        "target": targets,
        "device": Used(labels, numbers, which),
        "reference": rows_of(declared, which),
        "scale": Used(labels, scale_numbers, which, faults),
        "time_offset": clock,
    }


def _device_numbers(name: str, device: Device, placed_by_rows: Callable[[], tuple[Floats, Floats]]) -> list[RigNumber]:
    """Return x, y, z, rx, ry, rz of a device; if the rig has no pose, from its readings and the nominal robot."""
    sigmas = [or_inf(device.sigma)] * 3 + [or_inf(device.turn_sigma)] * 3
    if device.xyz is not None:
        values = [*device.xyz, 0.0, 0.0, 0.0]
    elif 0.0 in sigmas:
        raise ProblemError(f"{name} has sigma 0 (exactly known) but no position; give xyz_mm, or a sigma above 0")
    else:
        p, rot = placed_by_rows()
        values = [*p, *rotation_vector(rot @ rotation(np.array(device.rotation)).T)]
    units = ("m", "m", "m", "rad", "rad", "rad")
    numbers = zip((*XYZ, "rx", "ry", "rz"), units, values, sigmas, strict=True)
    return [RigNumber(f"{name}.{k}", unit, float(value), sigma) for k, unit, value, sigma in numbers]


def _device_cov(scope: Scope, rows: Indices, devices: Sequence[Device], which: Indices) -> Floats:
    """Return variances (n, 3), or covariances (n, 3, 3) if a device's axes are correlated.

    A row's own sigma takes precedence over the device's. The point's own noise is added to either.
    """
    device_cov = np.array([device.sensor_cov for device in devices])
    variances = np.diagonal(device_cov, axis1=1, axis2=2)
    has_sigma = np.isfinite(scope.column("sigma", rows)[:, None])
    of_row = sigmas(scope, rows, np.ones((1, 3))) ** 2
    of_point = np.nan_to_num(scope.column("xyz_sigma", rows), nan=0.0) ** 2
    if np.array_equal(device_cov, variances[:, :, None] * np.eye(3)):
        return np.asarray(np.where(has_sigma, of_row, rows_of(variances, which)) + of_point)
    diagonal = np.eye(3)
    full = np.where(has_sigma[:, :, None], of_row[:, :, None] * diagonal, rows_of(device_cov, which))
    return np.asarray(full + of_point[:, :, None] * diagonal)


def _moving(scope: Scope) -> bool:
    """Return whether any row has joint velocities. Raises ProblemError for a row that has only some of them."""
    finite = np.isfinite(scope.table.q_rate)
    bad = np.flatnonzero(~(finite.all(axis=1) | np.isnan(scope.table.q_rate).all(axis=1)))
    if bad.size:
        raise ProblemError(
            f"{scope.table.source[bad[0]]}: has velocities of only some joints, or values that are not finite; give finite velocities of all joints, or none"
        )
    return bool(finite.any())


TRACKER = Entries("tracker", DEVICE, "trackers", by_name)
KIND = Kind(
    group=PositionRows,
    use_rig=use_rig,
    needs=("tracker", POINT),
    may=("target", SPREAD),
    entries=(TARGET, TRACKER),
    point="target",
    labels=("target",),
    grouped_by=("tracker", "target"),
    regions=("tracker",),
    name="tracked point",
    residual={"m": "distance of the measured from the predicted point"},
)
