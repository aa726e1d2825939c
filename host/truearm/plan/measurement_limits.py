"""The limits of a measurement: an arm with its rig, and the limits at a pose and on the path to it.

The bar's travel is limited; a ``reserve`` of it is left for errors of the model used for planning. Goswami's PUMA
deviates from its design by -16 to +22 mm along the bar, so the default is 22 mm of 37.5. A plan based on an identified
model needs almost none. Both ends of the bar sit in magnetic cups, which allow a limited angle. The one on the table
about the vertical, the one on the end about the end's z axis, which points away from the arm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from truearm import option_defaults
from truearm.model.chain import forward
from truearm.model.inverse import singular_value
from truearm.plan.branch_inverse import LEVER, Arm
from truearm.plan.collision_shapes import Mounted, Shapes, clear
from truearm.types import BallBar, Floats, Plan, Rig


@dataclass(frozen=True)
class Limits:
    """The limits at poses and on the path between them; ``tightened`` where only samples are checked."""

    joint_margin: float = np.deg2rad(2.0)  # rad (m) from the joints' limits
    singular_value: float = 0.04  # of the end's Jacobian, metres in LEVERs
    reserve: float = option_defaults.DESIGN_RESERVE  # m, of travel on either side
    chuck_angle: float = np.deg2rad(80.0)  # of the bar from the vertical
    sphere_angle: float = np.deg2rad(75.0)  # of the bar from the end's z axis

    def tightened(self) -> Limits:
        """Return limits for samples STEP apart: between two of them the bar's length bulges by less than 0.6 mm."""
        return replace(
            self,
            reserve=self.reserve + 6e-4,
            singular_value=self.singular_value + 0.004,
            chuck_angle=self.chuck_angle - 0.01,
            sphere_angle=self.sphere_angle - 0.01,
        )


AT_ONCE = 1000  # poses checked for collisions: their distances fit into the cache
STEP = 0.04  # rad, the largest rotation of a joint between two samples of a path


@dataclass(frozen=True)
class Site:
    """An arm with its rig."""

    arm: Arm
    rig: Rig
    shapes: Shapes
    limits: Limits


@dataclass(frozen=True)
class Pairing:
    """A bar between a chuck and a sphere, by their names in the rig."""

    bar: str
    chuck: str
    sphere: str

    def of(self, rig: Rig) -> tuple[BallBar, Mounted]:
        chuck, sphere = rig.chucks[self.chuck], rig.spheres[self.sphere]
        return rig.bars[self.bar], Mounted(np.array(chuck.xyz), np.array(sphere.xyz))


def pairing_at(plan: Plan, i: int) -> Pairing:
    """Return what is connected at pose i."""
    return Pairing(str(plan.bar[i]), str(plan.chuck[i]), str(plan.sphere[i]))


def of_pairing(plan: Plan, pairing: Pairing) -> NDArray[np.bool_]:
    """Return a mask (n,) of the poses with a pairing."""
    return np.asarray((plan.bar == pairing.bar) & (plan.chuck == pairing.chuck) & (plan.sphere == pairing.sphere))


def allowed(site: Site, q: Floats, pairing: Pairing | None, limits: Limits | None = None) -> NDArray[np.bool_]:
    """Return whether joints q (n, j) are within all limits, with the bar on or, for None, removed."""
    limits = limits or site.limits
    good = device_allows(site, q, pairing, limits)
    good[good] = arm_allows(site, q[good], pairing, limits)
    return good


def device_allows(site: Site, q: Floats, pairing: Pairing | None, limits: Limits) -> NDArray[np.bool_]:
    """Check the joints, the bar's length and the angles of its cups."""
    good = within_joints(site, q, limits)
    if pairing is None:
        return good
    bar, mounted = pairing.of(site.rig)
    vector, axis = bar_vectors(site, q, mounted)
    length = np.linalg.norm(vector, axis=1)
    good &= np.abs(length - bar.zero) < free_travel(bar, limits)
    good &= vector[:, 2] > length * np.cos(limits.chuck_angle)
    good &= -np.einsum("ni,ni->n", vector, axis) > length * np.cos(limits.sphere_angle)
    return good


def arm_allows(site: Site, q: Floats, pairing: Pairing | None, limits: Limits) -> NDArray[np.bool_]:
    """Check for collisions and, with the bar on, for singularities."""
    mounted = None if pairing is None else pairing.of(site.rig)[1]
    blocks = [q[i : i + AT_ONCE] for i in range(0, len(q), AT_ONCE)]
    good = np.concatenate([clear(site.shapes, block, mounted) for block in blocks or [q]])
    if mounted is not None:
        good[good] = singular_value(site.arm.chain, site.arm.params, q[good], lever=LEVER) > limits.singular_value
    return good


def within_joints(site: Site, q: Floats, limits: Limits) -> NDArray[np.bool_]:
    """Return a mask (n,) of the poses inside the joints' limits, with their margin."""
    lower, upper = site.arm.chain.limits
    return np.asarray(((q > lower + limits.joint_margin) & (q < upper - limits.joint_margin)).all(axis=-1))


def free_travel(bar: BallBar, limits: Limits) -> float:
    """Return how far the planned length may deviate from mid-travel in either direction [m]."""
    return 0.5 * abs(bar.gain) * bar.travel - limits.reserve


def bar_vectors(site: Site, q: Floats, mounted: Mounted) -> tuple[Floats, Floats]:
    """Return the vectors from chuck to sphere [m] and the end's z axes, each (n, 3)."""
    pose = forward(site.arm.chain, site.arm.params, q)
    return pose[:, :3, :3] @ mounted.p_sphere + pose[:, :3, 3] - mounted.p_chuck, pose[:, :3, 2]
