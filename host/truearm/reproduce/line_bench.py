"""A simulation of Renders' bench: the ULB robot drives a point of its flange along straight lines that a device
measures.

The paper states neither the position of its lines nor the posture in which the arm drove them. Here each line has a
random position, direction and starting posture in the workspace. The controller, which knows only the nominal model,
keeps the point on the line according to that model. The true arm deviates from it. The device lies along the path of
the true arm, with a random rotation about it. The readings are therefore what the paper's sensors would have shown, but
every figure depends on the random lines: quote medians over many sets.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, point_forward, point_jacobians
from truearm.model.rotation import rotation, rotation_vector
from truearm.schema import Matrix
from truearm.types import Device, Floats, LinePlacement, Point, Rig

SENSOR_VARIANCE = (3.84e-9, 10e-9, 3.84e-9)  # m², III-C, y is the longitudinal sensor
# rad², III-C prints five of six entries; 21, as for its neighbours, replaces the missing fifth.
JOINT_VARIANCE = (21e-9, 21e-9, 21e-9, 1.31e-9, 21e-9, 305e-9)
LENGTH_SIGMA, ANGLE_SIGMA = 1e-3, 0.052  # III-C: prior σ of every length and of every angle
TARGET = "flange"
# Postures from which lines start, elbow and wrist bent [rad]: a line near a singularity would be driven with a jerk.
LOWEST = np.radians([-150.0, -80.0, 30.0, -120.0, 30.0, -120.0])
HIGHEST = np.radians([150.0, 10.0, 120.0, 120.0, 110.0, 120.0])
LENGTH = 0.5  # m; the device reaches 1 m
BEHIND = 1e-9  # m, the distance within which the nominal point must reach the line
STEPS = 8  # of Newton's method from one point of a line to the next


class MeasuredLines(NamedTuple):
    """Lines as measured by their devices, and the observed pose of each device before any identification."""

    table: ObservationTable
    by_hand: Mapping[str, Floats]  # (3, 3) by line: the device's orientation as set up by hand, accurate to ANGLE_SIGMA


def line_rig(session: MeasuredLines, rule: LinePlacement, device_sigma: float, joint_noise: bool = True) -> Rig:
    """Return a rig with the paper's covariances; a ``rule`` places the devices through the nominal robot.

    ``device_sigma`` [m] is the assumed standard deviation of a device's position.
    """
    cov = _diagonal(SENSOR_VARIANCE)
    devices = {
        name: Device(name, cov, None, _triple(rotation_vector(turned)), device_sigma, ANGLE_SIGMA)
        for name, turned in session.by_hand.items()
    }
    return Rig(
        targets={TARGET: Point(TARGET, (0.0, 0.0, 0.0))},
        lines=devices,
        line_placement=rule,
        joint_cov=_diagonal(JOINT_VARIANCE) if joint_noise else (),
    )


def _triple(v: Floats) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def prior_of(chain: Chain) -> Mapping[str, float]:
    """Return the σ of III-C for all parameters of the chain except gains, by name."""
    sigma = {"m": LENGTH_SIGMA, "rad": ANGLE_SIGMA}
    return {p.name: sigma[p.unit] for p in chain.parameters if p.unit in sigma}


def measured_lines(
    chain: Chain, truth: Floats, n_lines: int, n_points: int, rng: np.random.Generator, unmodelled: float = 0.0
) -> MeasuredLines:
    """Return the readings of the devices for ``n_lines`` lines of ``n_points`` points; the true robot is ``truth``
    (p,).

    ``unmodelled`` [rad]: amplitude of the joints' gear errors, which no parameter describes.
    """
    q = _postures(chain, n_lines, n_points, rng)
    p_base = point_forward(chain, truth, q + gear_error(q, unmodelled, rng), np.zeros(3))
    names = [f"l{1 + i}" for i in range(n_lines)]
    devices = {name: _device(points, rng) for name, points in zip(names, p_base, strict=True)}
    xyz = np.stack([(p - p.mean(axis=0)) @ rot for p, rot in zip(p_base, devices.values(), strict=True)])
    xyz = xyz + np.sqrt(SENSOR_VARIANCE) * rng.standard_normal(xyz.shape)
    reading = q + np.sqrt(JOINT_VARIANCE) * rng.standard_normal(q.shape)
    by_hand = {name: rotation(ANGLE_SIGMA * rng.standard_normal(3)) @ rot for name, rot in devices.items()}
    return MeasuredLines(
        _table(reading.reshape(-1, q.shape[-1]), xyz.reshape(-1, 3), np.repeat(names, n_points)), by_hand
    )


def gear_error(q: Floats, amplitude: float, rng: np.random.Generator) -> Floats:
    """Return errors (…, j) [rad] of joints q (…, j) that repeat a few times per turn, like those of eccentric gears.

    A joint has 3 to 12 periods per turn; their phase is random too.
    """
    j = q.shape[-1]
    return amplitude * np.sin(rng.integers(3, 13, j) * q + rng.uniform(0.0, 2.0 * np.pi, j))


def _postures(chain: Chain, n_lines: int, n_points: int, rng: np.random.Generator) -> Floats:
    """Return joints (n_lines, n_points, j) that keep the nominal flange on lines within reach."""
    kept = np.zeros((0, n_points, len(chain.joints)))
    while len(kept) < n_lines:
        middle = rng.uniform(LOWEST, HIGHEST, (4 * n_lines, len(chain.joints)))
        along = rng.normal(size=(4 * n_lines, 3))
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        p_middle = point_forward(chain, chain.params_nominal, middle, np.zeros(3))
        shares = np.linspace(-0.5, 0.5, n_points) * LENGTH
        path = [_driven(chain, middle, p_middle, along, shares[shares < 0.0][::-1])[::-1]]
        path.append(_driven(chain, middle, p_middle, along, shares[shares >= 0.0]))
        q = np.concatenate(path).swapaxes(0, 1)
        there = point_forward(chain, chain.params_nominal, q, np.zeros(3))
        away = np.linalg.norm(there - p_middle[:, None] - along[:, None] * shares[:, None], axis=-1).max(axis=1)
        inside = ((q > LOWEST - 0.5) & (q < HIGHEST + 0.5)).all(axis=(1, 2))
        kept = np.concatenate([kept, q[(away < BEHIND) & inside]])
    return kept[:n_lines]


def _driven(chain: Chain, q: Floats, p_middle: Floats, along: Floats, shares: Floats) -> Floats:
    """Return joints (k, n, j): from joints q (n, j), the nominal point at k distances from the middles (n, 3)."""
    out = []
    for share in shares:
        for _ in range(STEPS):
            p, _, jac = point_jacobians(chain, chain.params_nominal, q, np.zeros(3))
            error = p_middle + share * along - p
            q = q + np.clip((np.linalg.pinv(jac, rcond=1e-2) @ error[..., None])[..., 0], -0.3, 0.3)
        out.append(q)
    return np.array(out).reshape(len(shares), *q.shape)


def _device(points: Floats, rng: np.random.Generator) -> Floats:
    """Return the axes (3, 3) of a device along a path (n, 3): y from first to last point, randomly rotated about it."""
    y = points[-1] - points[0]
    y = y / np.linalg.norm(y)
    across = np.cross(y, rng.normal(size=3))
    x = across / np.linalg.norm(across)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _table(q: Floats, xyz: Floats, lines: NDArray[np.str_]) -> ObservationTable:
    n = len(q)
    source = np.array([f"point {i + 1} of line {name[1:]}" for i, name in enumerate(lines)])
    kind, target = np.full(n, "line"), np.full(n, TARGET)
    return ObservationTable(q=q, kind=kind, source=source, xyz=xyz, line=lines, target=target)


def _diagonal(variance: tuple[float, ...]) -> Matrix:
    return tuple(tuple(v if i == k else 0.0 for k in range(len(variance))) for i, v in enumerate(variance))
