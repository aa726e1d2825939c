"""A plane touched by a target on the tool: its signed distance from the plane, 0 or the radius of a touching ball.

The prediction is n·(T(q)·s − c) − offset, with a point c and a normal n₀ declared in the rig and n = exp([t₁e₁ +
t₂e₂]×)·n₀. The three unknowns of a plane are its ``offset`` along n [m] and its two tilts t₁, t₂ [rad] about e₁ and e₂,
which form a right-handed frame with n₀. Of these, e₁ is the base axis least aligned with n₀, made perpendicular to it,
and e₂ = n₀ × e₁.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm.kinds.columns import DISTANCE
from truearm.kinds.group import Group, Linearised, RigNumber, gather, linearised, or_inf
from truearm.kinds.kind import Kind, RigUse, Scope, nominal_points, refuse, sigmas, use, use_points
from truearm.kinds.rig_entries import NAME, TARGET, by_name
from truearm.model.chain import Chain, along, trace_point
from truearm.model.transforms import cross, left_jacobian, rotation
from truearm.schema import Entries, Table, keys_of
from truearm.types import Floats, Indices, Plane


@dataclass(frozen=True, kw_only=True)
class PlaneRows(Group):
    """n touches; indices refer to x followed by ``constants``."""

    COMPONENTS = ("m",)

    q: Floats  # (n, j)
    distance: Floats  # (n,) measured, m
    target: Indices  # (n, 3) in the end frame
    plane: Indices  # (n, 3) offset and the two tilts
    point: Floats  # (n, 3) declared point c, m
    axes: Floats  # (n, 3, 3) rows e₁, e₂, n₀

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (n,) and their derivatives at x (P,)."""
        p = len(chain.parameters)
        trace = trace_point(chain, x[:p], self.q, gather(x, self.constants, self.target))
        numbers = gather(x, self.constants, self.plane)  # offset and two angles
        tilt_axes = self.axes[:, :2]
        tilt = np.einsum("nk,nki->ni", numbers[:, 1:], tilt_axes)  # a rotation vector
        normal = np.einsum("nij,nj->ni", rotation(tilt), self.axes[:, 2])
        lever = trace.p_base - self.point
        derivative = along(trace, normal[None])
        # (δφ × n)·r = (n × r)·δφ with δφ = J_l δ(tilt)
        turned = np.einsum("ni,nij,nkj->nk", cross(normal.T, lever.T).T, left_jacobian(tilt), tilt_axes)
        by_plane = np.column_stack([np.full(len(turned), -1.0), turned])[None]
        predicted = (normal * lever).sum(axis=1) - numbers[:, 0]
        columns = (self.target, derivative.jac_point), (self.plane, by_plane)
        return linearised(self.distance - predicted, derivative, x, *columns)


def frame_of(normal: Floats) -> Floats:
    """Return the rows e₁, e₂, n₀ (3, 3) for a normal (3,) of any length except 0."""
    n0 = np.asarray(normal) / np.linalg.norm(normal)
    e1 = np.eye(3)[np.argmin(np.abs(n0))]
    e1 = e1 - (e1 @ n0) * n0
    e1 /= np.linalg.norm(e1)
    return np.stack([e1, np.cross(n0, e1), n0])


def plane_numbers(name: str, flat: Plane) -> list[RigNumber]:
    """Return offset and tilts of a plane relative to its declared pose."""
    tilts = [RigNumber(f"{name}.tilt{k}", "rad", 0.0, or_inf(flat.tilt_sigma)) for k in (1, 2)]
    return [RigNumber(f"{name}.offset", "m", 0.0, or_inf(flat.offset_sigma)), *tilts]


def use_rig(scope: Scope, rows: Indices) -> RigUse:
    """Return what the rows use of the rig: targets and planes."""
    table, rig = scope.table, scope.rig
    targets = use_points(scope, rows, "target", rig.targets)
    flats = use(scope, rows, "plane", rig.planes, plane_numbers)
    planes = [rig.planes[str(label)] for label in flats.labels]
    point = np.array([flat.xyz for flat in planes], dtype=float)[flats.which]
    frames = np.array([frame_of(np.array(flat.normal)) for flat in planes])[flats.which]
    refuse(scope, rows, np.isinf(table.value[rows]), "its distance from the plane must be finite")
    distance = np.nan_to_num(table.value[rows], nan=0.0)
    sigma = np.array([flat.sigma for flat in planes])[flats.which]
    # A plane of which only the approximate direction is known starts at the mean height of its touches.
    height = ((nominal_points(scope, rows, targets) - point) * frames[:, 2]).sum(axis=1) - distance
    for i, (offset, *_) in enumerate(flats.numbers):
        if np.isinf(offset.sigma):
            flats.numbers[i][0] = offset._replace(value=float(height[flats.which == i].mean()))

    variance = sigmas(scope, rows, sigma[:, None]) ** 2
    fields = {"target": targets, "plane": flats, "distance": distance, "point": point, "axes": frames}
    return RigUse.of(PlaneRows, scope, rows, variance, **fields)


PLANE = Entries("plane", Table((NAME, *keys_of(Plane)), Plane), "planes", by_name)
KIND = Kind(
    group=PlaneRows,
    use_rig=use_rig,
    needs=("plane",),
    may=("target", DISTANCE),
    entries=(TARGET, PLANE),
    point="target",
    labels=("plane", "target"),
    grouped_by=("plane",),
    regions=("plane",),
    name="touched plane",
    residual={"m": "distance of the touching point from the flat, with its sign"},
)
