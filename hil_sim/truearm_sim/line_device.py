"""The line device at the true robot: its position, and what its three sensors measure.

An operator places the device along the path of the true arm: drives to both ends of the line and moves the device until
the magnet is centred there, to SETUP. The transverse sensors, with a range of a few millimetres, therefore measure how
far the arm's path deviates from straight, and not the arm's error in its controller's model. The simulated PUMA 560 has
errors of 20 mm and bends half a metre by one or two. The rotation of the device about its axis is random; its noted
orientation, measured with a protractor, is accurate to BY_HAND (Renders 1991, III-C).

The declared error of a measurement is neither white noise of the samples, which averaging removes, nor the same at each
visit. Like a ball-bar's repeatability it belongs to the moving part: the magnet in its guide. It is random for each
drive and changes along the path, so that measurements more than 2·GRAIN apart have independent errors, wherever on the
line the robot stops and whatever its speed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.errors import PlanError
from truearm.model.chain import Chain, point_forward
from truearm.model.transforms import rotation, rotation_vector
from truearm.schema import Matrix
from truearm.types import Device, Floats, Plan, Rig
from truearm.units import MM
from truearm_sim.paths import Path, target_of
from truearm_sim.robot import Controller

STROKE = (0.05, 1.05)  # m, of the magnetostrictive wire
MIDDLE = 0.55  # m along it, where the middle of a line is placed
REACH = 0.0075  # m, range of the transverse sensors in either direction (Renders II-C: 15 mm in all)
SETUP = 5e-4  # m, accuracy of centring the device at either end of the line
BY_HAND = 0.052  # rad about each axis
GRAIN = 0.0075  # m
_POSES, _ERRORS = 0x11E, 0x6E1  # of their random numbers, in addition to the seed


@dataclass(frozen=True)
class Flaws:
    """Errors of the device that nobody declared.

    ``sound``: relative excess of the strain pulse's speed over the label. ``mag_delay``, ``adc_delay`` [s]: additional
    delay of the position and the transverse readings. ``bend`` [m]: error of the transverse readings at the ends of
    their REACH, cubic.
    """

    sound: float = 0.0
    mag_delay: float = 0.0
    adc_delay: float = 0.0
    bend: float = 0.0


class Placement(NamedTuple):
    """A device's true pose in the base frame: origin (3,), where its wire begins, and axes (3, 3), y along the wire."""

    origin: Floats
    axes: Floats


def place_devices(
    plan: Plan, paths: Mapping[int, Path], chain: Chain, params: Floats, rig: Rig, seed: int
) -> dict[str, Placement]:
    """Return where the operator places the device for each line of the plan; the robot is ``params`` (p,).

    A device with ``xyz`` in the rig is there, to its declared accuracy, whether the arm then reaches it or not. Raises
    PlanError for a line that is longer than the wire.
    """
    rng = np.random.default_rng([seed, _POSES])
    placed = dict[str, Placement]()
    for row, path in paths.items():
        name = str(plan.line[row])
        draw = rng.standard_normal((4, 3))
        if name in placed:
            continue
        if path.length > 0.98 * (STROKE[1] - STROKE[0]):
            raise PlanError(
                f"line {name!r} is {MM.text(path.length, '.0f')} long, the device's wire {MM.text(np.ptp(STROKE), '.0f')}"
            )
        q = path.joints(path.length * np.linspace(0.0, 1.0, 9))
        ends = point_forward(chain, params, q, target_of(plan, row, rig))[[0, -1]] + SETUP * draw[:2]
        declared = rig.lines.get(name)
        placed[name] = (
            _declared(declared, draw) if declared and declared.xyz is not None else _along(ends, declared, draw)
        )
    return placed


def _along(ends: Floats, declared: Device | None, draw: Floats) -> Placement:
    """Return a placement along two points (2, 3), rotated about them as declared, to BY_HAND, or at random."""
    y = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    up = draw[2]
    if declared is not None and declared.turn_sigma is not None:
        axes = rotation(BY_HAND * draw[3]) @ rotation(np.array(declared.rotation))
        y, up = np.copysign(1.0, axes[:, 1] @ y) * y, axes[:, 2]
    x = np.cross(y, up) / np.linalg.norm(np.cross(y, up))
    return Placement(ends.mean(axis=0) - MIDDLE * y, np.stack([x, y, np.cross(x, y)], axis=1))


def _declared(device: Device, draw: Floats) -> Placement:
    turned = rotation((device.turn_sigma or 0.0) * draw[3]) @ rotation(np.array(device.rotation))
    return Placement(np.array(device.xyz) + (device.sigma or 0.0) * draw[2], turned)


def written_down(rig: Rig, placed: Mapping[str, Placement], seed: int) -> Rig:
    """Return the rig with the operator's notes on devices missing in it: orientations, to BY_HAND about each axis."""
    rng = np.random.default_rng([seed, _POSES, 1])
    cov: Matrix = tuple(tuple(s**2 * (i == k) for k in range(3)) for i, s in enumerate(rig.line_sigma))
    noted = dict(rig.lines)
    for name, placement in placed.items():
        rx, ry, rz = rotation_vector(rotation(BY_HAND * rng.standard_normal(3)) @ placement.axes).tolist()
        noted.setdefault(name, Device(name, cov, None, (rx, ry, rz), None, BY_HAND))
    return replace(rig, lines=noted)


def drive_errors(seed: int, row: int, way: Floats) -> Floats:
    """Return errors (k, 3) in standard deviations at positions (k,) [m] along the drive to one row of the plan.

    They are pure functions of the three arguments.
    """
    share, first = np.modf(way / GRAIN)
    grains = first.astype(int)
    drawn = np.random.Generator(np.random.Philox(key=seed, counter=[0, row, _ERRORS, 0]))
    knots = drawn.standard_normal((int(grains.max(initial=0)) + 2, 3))
    turn = 0.5 * np.pi * share[:, None]
    return np.asarray(np.cos(turn) * knots[grains] + np.sin(turn) * knots[grains + 1])


def sensor_sigma(rig: Rig, name: str) -> Floats:
    """Return the declared σ (3,) [m] of a device along its axes."""
    return np.asarray(np.sqrt(np.diagonal(np.array(rig.lines[name].sensor_cov))))


class LineDevices:
    """What the devices of a plan measure, as a function of true time."""

    def __init__(
        self, controller: Controller, chain: Chain, params: Floats, rig: Rig, placed: Mapping[str, Placement], seed: int
    ) -> None:
        plan = controller.plan
        self._controller, self._chain, self._params, self._seed = controller, chain, params, seed
        self._placed, self._name = placed, plan.line
        # The drive at each stop: to it or, where a line begins there, from it; −1 where the magnet is not in a guide.
        after = np.append(plan.lines[1:], False)
        self._drive = np.where(plan.lines, np.arange(len(plan)), np.where(after, np.arange(len(plan)) + 1, -1))
        self._sigma = {name: sensor_sigma(rig, name) for name in placed}
        self._target = {row: target_of(plan, row, rig) for row in np.flatnonzero(plan.lines).tolist()}

    def position(self, t: Floats) -> Floats:
        """Return the magnet in the device's axes (k, 3) [m] at true times t (k,), with drive errors.

        NaN out of range.
        """
        out = np.full((len(t), 3), np.nan)
        stop = self._controller.stop_index(t)
        row = self._controller.pose[stop]
        guided = self._controller.is_line[stop] | (t >= self._controller.arrive[stop])
        drives = np.where(guided & ~self._controller.mounting[stop], self._drive[row], -1)
        for drive in np.unique(drives[drives >= 0]).tolist():
            at = np.flatnonzero(drives == drive)
            out[at] = self._seen(drive, t[at], row[at] == drive)
        return out

    def _seen(self, drive: int, t: Floats, under_way: NDArray[np.bool_]) -> Floats:
        name = str(self._name[drive])
        origin, axes = self._placed[name]
        q = self._controller.q_true(t)
        there = (point_forward(self._chain, self._params, q, self._target[drive]) - origin) @ axes
        way = np.where(under_way, self._controller.way(t), 0.0)
        seen = there + self._sigma[name] * drive_errors(self._seed, drive, way)
        inside = (np.abs(there[:, [0, 2]]) < REACH).all(axis=1) & (there[:, 1] > STROKE[0]) & (there[:, 1] < STROKE[1])
        return np.where(inside[:, None], seen, np.nan)
