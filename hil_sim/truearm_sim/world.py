"""The world that the box measures, as a function of time and seed: a true robot, a ball-bar, a line device, clocks.

Nothing here has state: samples and readings are the same for any order and any chunks of requests. (One block of
samples of each kind is kept, because readers request the next few samples of it.) True time starts at 0 with the first
move.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain import Chain, point_forward
from truearm.model.robot import Robot
from truearm.model.robot_file import builtin_robot
from truearm.plan import plan_file
from truearm.plan.branches import branch_of
from truearm.plan.first_rig import bars, circle, first_rig
from truearm.plan.forecast import Knowledge
from truearm.types import REFERENCE_DEGC, Floats, Plan, Rig
from truearm_sim import sensors
from truearm_sim.arm import Arm
from truearm_sim.clocks import Clock, Clocks, draw_clocks
from truearm_sim.line_device import REACH, Flaws, LineDevices, Placement, place_devices, written_down
from truearm_sim.paths import line_paths
from truearm_sim.robot import Controller, Inputs, States, new_pairing
from truearm_sim.shells import plan_shells
from truearm_sim.thermal import Thermal
from truearm_sim.true_robot import PAPER, moving, true_params

NO_BAR = (math.nan,) * 4  # zero, gain, travel and sigma at rows of a plan with the bar off
NO_POINT = (math.nan,) * 3
MAG_PERIOD_NS = 983_040  # 1017 Hz
MAG_STROKE = (0.05, 0.55)  # m, of the magnetostrictive sensor if no lines are driven
MAG_MIDDLE = 0.30
MAG_Y = 0.15  # m, of the sensor's middle in the base frame


Level = Callable[[Floats], NDArray[np.bool_]]


@dataclass(frozen=True)
class RobotInput:
    """The controller's digital input to which the box's trigger output is wired, and the connection.

    The output toggles every ``trigger_ms``. The input is ``inverted`` (a pull-down at an NPN input). Each edge of the
    output appears with its own delay [s]; the delays differ by less than the time between edges.
    """

    number: int
    trigger_ms: tuple[int, int] = (50, 150)
    inverted: bool = False
    rising_delay_s: float = 0.0
    falling_delay_s: float = 0.0

    def level(self, output: Level, t: Floats) -> NDArray[np.bool_]:
        """Return whether the input is on (m,) at true times (m,)."""
        risen, not_fallen = output(t - self.rising_delay_s), output(t - self.falling_delay_s)
        quick_to_fall = self.falling_delay_s < self.rising_delay_s
        high = risen & not_fallen if quick_to_fall else risen | not_fallen
        return high ^ self.inverted


def standard_rig(robot: Robot | None = None) -> Rig:
    """Return a rig with three chucks on the table in front of a robot, three spheres on its endpoint, and two bars.

    The bars are 46 and 61 cm for the PUMA 560, which is the default, otherwise in proportion to the arm's reach. Raises
    PlanError for a robot without a branch.
    """
    if robot is not None and robot.chain.name != PAPER:
        return first_rig(robot)
    return Rig(
        chucks=circle("c", 3, (0.45, 0.15, 0.08), 0.20, turn=0.2, digits=6),
        spheres=circle("s", 3, (0.0, 0.0, 0.04), 0.13, turn=0.5, digits=6),
        bars=bars(0.46, 0.61),
    )


def arrivals(plan: Plan) -> NDArray[np.int64]:
    """Return the row (n,) at which the robot arrived at its position of each row: it stays there while rows repeat."""
    came = np.concatenate([[True], np.any(np.diff(plan.q, axis=0) != 0.0, axis=1)]) | new_pairing(plan)
    return np.maximum.accumulate(np.where(came, np.arange(len(plan)), 0))


def standard_plan(n_poses: int = 800, seed: int = 0, rig: Rig | None = None, robot: Robot | None = None) -> Plan:
    """Return ``n_poses`` poses with each bar of the rig, one bar after the other, planned on a robot's design model.

    The PUMA 560 is the default. Raises PlanError for a robot that cannot reach them.
    """
    robot = robot or builtin_robot(PAPER)
    knowledge = replace(Knowledge.design(robot, rig or standard_rig(robot)), branch=branch_of(robot))
    speed = np.array(moving(robot).speed)
    return plan_file.concatenate(*(plan_shells(knowledge, bar, n_poses, seed, speed) for bar in knowledge.rig.bars))


@dataclass(frozen=True)
class Truth:
    """The target of a calibration and its reference: parameters (p,), clocks, dwells in true time."""

    params: Floats
    clocks: Clocks
    dwell_start: Floats  # (n,) s
    dwell_end: Floats  # (n,) s
    length: Floats  # (n,) m, of the bar while the robot is at rest, including repeatability
    lines: Mapping[str, Placement]  # the pose of each line device
    robot_delay: float  # s, delay of the robot's readings


@dataclass(frozen=True)
class Sensor:
    """A further sensor of the box. ``stream``: its entry in the ident; ``counts`` (n, c): at true joints (n, j)."""

    stream: Mapping[str, Any]
    counts: Callable[[Chain, Floats, Floats], Floats]


class Setup(NamedTuple):
    """The wiring of the lab and its faults.

    ``clocks``: random from the seed by default. ``robot_rate`` [Hz]: of the robot's readings, which are late by
    ``robot_delay_s``. ``mag_period_ns``: period at which the box is configured to read its magnetostrictive sensor, 0:
    never; default: MAG_PERIOD_NS where lines are driven. A share ``lost_stops`` of its shots has no stop pulse.
    ``flaws``: undeclared errors of the line device. ``robot_input``: the input wired to the box's trigger output, which
    is then configured to toggle; None: nothing. ``thermal``: how bar and sensor warm up; None: not at all, and the box
    has no thermometers.
    """

    clocks: Clocks | None = None
    robot_rate: float = 50.0
    robot_delay_s: float = 0.0
    mag_period_ns: int | None = None
    lost_stops: float = 0.0
    flaws: Flaws | None = None
    robot_input: RobotInput | None = None
    thermal: Thermal | None = None
    sensors: tuple[Sensor, ...] = ()


USUAL = Setup()


class World:
    """The true robot visiting ``plan`` with the bars of ``rig``, as seen by the box and the robot's socket."""

    def __init__(
        self,
        seed: int,
        plan: Plan,
        rig: Rig | None = None,
        params: Floats | None = None,
        arm: Arm | None = None,
        robot: Robot | None = None,
        setup: Setup = USUAL,
    ) -> None:
        """Create a world.

        ``robot``: the PUMA 560 by default. ``params`` (p,): its true ones, by default ``true_params``.

        ``arm``: a stiff one by default. Raises PlanError if the plan names something missing in the rig, and for a line
        that cannot be driven.
        """
        robot = robot or builtin_robot(PAPER)
        self.seed = seed
        self.rig = rig or standard_rig(robot)
        plan_file.check_against_rig(plan, self.rig, "the plan")
        self.chain: Chain = robot.chain
        self.params = true_params(robot, seed) if params is None else params
        self.clocks = setup.clocks or draw_clocks(seed)
        knowledge = {name: (bar.zero, bar.gain, bar.travel, bar.sigma) for name, bar in self.rig.bars.items()}
        bars = np.array([knowledge.get(name, NO_BAR) for name in plan.bar.tolist()]).T
        chucks, spheres = (
            {name: p.xyz for name, p in points.items()} for points in (self.rig.chucks, self.rig.spheres)
        )
        self._p_chuck = np.array([chucks.get(name, NO_POINT) for name in plan.chuck.tolist()])
        self._p_sphere = np.array([spheres.get(name, NO_POINT) for name in plan.sphere.tolist()])
        self._zero, self._gain, self._travel = bars[:3]
        self._scatter = sensors.repeatability(seed, len(plan))[arrivals(plan)] * bars[3]
        arm, paths = moving(robot, arm), line_paths(plan, self.chain, self.chain.params_nominal, self.rig)
        self.controller = Controller.from_plan(
            plan, self.clocks.robot, seed, setup.robot_rate, self._runs_out(plan), arm, paths, setup.robot_delay_s
        )
        self.placed = place_devices(plan, paths, self.chain, self.params, self.rig, seed)
        self.rig = written_down(self.rig, self.placed, seed)
        self._flaws = setup.flaws or Flaws()
        self._thermal = setup.thermal
        self._devices: LineDevices | None = None
        if paths:
            self._devices = LineDevices(self.controller, self.chain, self.params, self.rig, self.placed, seed)
        pose = self.controller.pose
        self._settled_length = self._distance(self.controller.q_rest, pose) + self._scatter[pose]
        self._mag_period_ns = (MAG_PERIOD_NS if paths else 0) if setup.mag_period_ns is None else setup.mag_period_ns
        self._lost_stops = setup.lost_stops
        self.robot_input = setup.robot_input
        self._sensors = setup.sensors
        self.sensor_streams = [sensor.stream for sensor in setup.sensors]
        self._kept: dict[str, tuple[tuple[int, ...], NDArray[Any]]] = {}

    @property
    def duration(self) -> float:
        """Return the end of the last dwell [s], true time."""
        return self.controller.duration

    @property
    def truth(self) -> Truth:
        robot, dwells = self.controller, self.controller.dwells
        times = robot.arrive[dwells], robot.leave[dwells]
        return Truth(self.params, self.clocks, *times, self._settled_length[dwells], self.placed, robot.delay)

    def _distance(self, q: Floats, poses: NDArray[np.int64]) -> Floats:
        """Return the centre-to-centre distance (m,) [m] at true joints q (m, j), for each pose's chuck and sphere."""
        p_sphere = point_forward(self.chain, self.params, q, self._p_sphere[poses])
        apart: Floats = np.linalg.norm(p_sphere - self._p_chuck[poses], axis=-1)
        return apart

    def _runs_out(self, plan: Plan) -> NDArray[np.bool_]:
        """Return a mask (n,) of the poses on the way to which the bar would exceed its travel and must be removed."""
        shares = np.linspace(0.0, 1.0, 33)[:, None]
        poses = np.repeat(np.arange(1, len(plan)), len(shares))
        steps = plan.q[:-1, None] + shares * (plan.q[1:] - plan.q[:-1])[:, None]
        strain = np.abs(self._distance(steps.reshape(len(poses), -1), poses) - self._zero[poses])
        worst = strain.reshape(-1, len(shares)).max(axis=1)
        return np.concatenate([[False], worst > 0.5 * self._travel[1:]])

    def length(self, t: Floats) -> Floats:
        """Return the bar's true length (m,) [m] at true times t (m,), including repeatability; NaN while off."""
        stop = self.controller.stop_index(t)
        length = self._settled_length[stop]
        moving = ~self.controller.is_settled(t)
        pose = self.controller.pose[stop[moving]]
        length[moving] = self._distance(self.controller.q_true(t[moving]), pose) + self._scatter[pose]
        return np.where(self.controller.bar_is_on(t), length, np.nan)

    def samples(
        self, k0: int, k1: int, t_start_device_ns: int, period: int
    ) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """Return samples k0 ≤ k < k1 of a stream: counts (m, 4) and stamps (m,) [µs of the device clock, rounded down].

        Sample k is taken at the device time ``t_start_device_ns + k·period`` [ns], and shows the signal at an earlier
        time, by the converter's group delay.
        """
        stamps = (t_start_device_ns + np.arange(k0, k1, dtype=np.int64) * period) // 1000
        return self.counts(k0, k1, t_start_device_ns, period), stamps

    def counts(self, k0: int, k1: int, t_start_device_ns: int, period: int) -> NDArray[np.int32]:
        """Return counts (m, 4) of the same samples."""
        return self._blocks(self._counts, k0, k1, t_start_device_ns, period)

    def flight_times(self, k0: int, k1: int, t_start_device_ns: int, period_ns: int) -> NDArray[np.int64]:
        """Return times of flight (m,) [ps] of the magnetostrictive head's shots k0 ≤ k < k1; −1 without a stop pulse.

        Shot k is at the device time ``t_start_device_ns + k·period_ns`` and shows the magnet's position at that time.
        """
        return self._blocks(self._flights, k0, k1, t_start_device_ns, period_ns)

    def magnet_position(self, t: Floats) -> Floats:
        """Return the position of the magnet on the magnetostrictive sensor (m,) [m] at true times t (m,).

        If lines are driven it is that on the device, including errors of the drive; NaN: it is out of every device's
        range. Otherwise a carriage follows the bar's sphere along y within the stroke; while the bar is off it rests in
        the middle.
        """
        if self._devices is not None:
            return self._devices.position(t - self._flaws.mag_delay)[:, 1]
        pose = self.controller.pose[self.controller.stop_index(t)]
        p_sphere = point_forward(self.chain, self.params, self.controller.q_true(t), self._p_sphere[pose])
        along = np.clip(MAG_MIDDLE + p_sphere[:, 1] - MAG_Y, *MAG_STROKE)
        position: Floats = np.where(self.controller.bar_is_on(t), along, MAG_MIDDLE)
        return position

    def _blocks(
        self,
        make: Callable[[NDArray[np.int64], int], NDArray[Any]],
        k0: int,
        k1: int,
        t_start_device_ns: int,
        period: int,
    ) -> NDArray[Any]:
        """Return samples k0 ≤ k < k1, read only, from whole blocks.

        ``make`` creates each from its device times [ns] and number.

        The last block is kept: readers request the next few samples of it.
        """
        parts = []
        for block in range(k0 // sensors.BLOCK, max(k0, k1 - 1) // sensors.BLOCK + 1):
            key, begin = (block, t_start_device_ns, period), block * sensors.BLOCK
            if make.__name__ not in self._kept or self._kept[make.__name__][0] != key:
                of_block = np.arange(begin, begin + sensors.BLOCK, dtype=np.int64)
                made = make(t_start_device_ns + of_block * period, block)
                made.flags.writeable = False
                self._kept[make.__name__] = key, made
            parts.append(self._kept[make.__name__][1][max(k0 - begin, 0) : k1 - begin])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _counts(self, device_ns: NDArray[np.int64], block: int) -> NDArray[np.int32]:
        period = int(device_ns[1] - device_ns[0])
        shown_ns = device_ns - sensors.group_delay_ns(period // sensors.MODULATOR_NS)
        t = self.clocks.device.true(1e-9 * shown_ns)
        pose = self.controller.pose[self.controller.stop_index(t)]
        longer, larger = self._warmed(t)
        extension = (self.length(t) - self._zero[pose] * longer) / (self._gain[pose] * larger)
        return sensors.sample_counts(extension, self.seed, block, self.transverse(t))

    def _warmed(self, t: Floats) -> tuple[Floats, Floats]:
        """Return the factors (m,) of the bar's zero and its sensor's gain at true times t (m,)."""
        thermal = self._thermal
        if thermal is None:
            return np.ones(t.size), np.ones(t.size)
        bar, sensor = (thermal.degc(name, t / self.duration) - REFERENCE_DEGC for name in ("bar", "sensor"))
        return 1.0 + thermal.expansion * bar, 1.0 + thermal.gain_drift * sensor

    @property
    def has_thermometers(self) -> bool:
        """Return whether there are thermometers on the box's wire."""
        return self._thermal is not None

    def thermometers(self, t: float) -> tuple[tuple[bytes, int], ...]:
        """Return address and m°C of each thermometer on the box's wire at true time t."""
        return self._thermal.readings(t / self.duration) if self._thermal else ()

    def readings(self, t: float) -> bytes:
        """Return the counts of the further sensors at true time t, as 32-bit integers, little endian."""
        if not self._sensors:
            return b""
        q = self.controller.q_true(np.array([t]))
        counts = [sensor.counts(self.chain, self.params, q)[0] for sensor in self._sensors]
        return bytes(np.rint(np.concatenate(counts)).astype("<i4"))

    def box_warmer(self, t: float) -> float:
        """Return how much warmer the box is at true time t than it would be otherwise [K]."""
        return (
            float(self._thermal.degc("box", np.array([t / self.duration]))[0]) - REFERENCE_DEGC
            if self._thermal
            else 0.0
        )

    def transverse(self, t: Floats) -> Floats | None:
        """Return the magnet at the transverse sensors (m, 2) [m] at true times t (m,), NaN out of range.

        None without a line device.
        """
        if self._devices is None:
            return None
        across = self._devices.position(t - self._flaws.adc_delay)[:, [0, 2]]
        return across + self._flaws.bend * (across / REACH) ** 3

    def _flights(self, device_ns: NDArray[np.int64], block: int) -> NDArray[np.int64]:
        position = self.magnet_position(self.clocks.device.true(1e-9 * device_ns))
        return sensors.flight_times(position / (1.0 + self._flaws.sound), self._lost_stops, self.seed, block)

    def robot_lines(self, t0_ns: int, t1_ns: int, level: Level | None = None) -> tuple[NDArray[np.int64], list[bytes]]:
        """Return true times of sending (m,) [ns] and lines of the robot's socket with t0 ≤ true time < t1.

        None after its end.

        ``level``: of the wire to the controller's digital input, at true times.
        """
        t, lines = self.controller.reading_lines(
            1e-9 * t0_ns, 1e-9 * min(t1_ns, self.robot_end_ns), self._inputs(level)
        )
        return np.rint(1e9 * t).astype(np.int64), lines

    def robot_states(self, t0_ns: int, t1_ns: int, level: Level | None = None) -> States:
        """Return the same readings as numbers; the controller continues after its program has ended."""
        return self.controller.states(1e-9 * t0_ns, 1e-9 * t1_ns, self._inputs(level))

    def _inputs(self, level: Level | None) -> Inputs | None:
        if level is None or self.robot_input is None:
            return None
        wired, bit = self.robot_input, 1 << self.robot_input.number
        return lambda t: np.where(wired.level(level, t), bit, 0).astype(np.int64)

    @property
    def robot_end_ns(self) -> int:
        """Return the true time at which the robot's program ends [ns]: half a second after its last dwell."""
        return round(1e9 * (self.duration + 0.5))

    @property
    def device_clock(self) -> Clock:
        """Return the box's crystal."""
        return self.clocks.device

    def box_config(self, osr: int = 4096) -> dict[str, Any]:
        """Return the configuration file of this world's box: its rates, its channels, its sensors' labels."""
        channels: list[dict[str, Any]] = [
            {"name": name, "unit": "V", "scale": list(sensors.SCALE)} for name in sensors.CHANNELS
        ]
        channels[0]["calibration"] = sensors.calibration()
        if self._devices is not None:
            for channel, poly, letter in zip(channels[1:], sensors.TRANSVERSE_POLY, "ab", strict=False):
                channel["calibration"] = sensors.calibration(poly, f"sim-transverse-{letter}")
        config: dict[str, Any] = {
            "version": 2,
            "osr": osr,
            "channels": channels,
            "magnetostrictive": sensors.magnetostrictive(self._mag_period_ns),
            "debounce_us": [0, 0],
            "trigger_ms": list(self.robot_input.trigger_ms) if self.robot_input else [0, 0],
            "watchdog_ms": 2000,
        }
        if self._thermal:
            channels[0]["calibration"]["temperature_mdegc"] = sensors.CALIBRATED_MDEGC
            config["thermometers"] = self._thermal.named()
        return config
