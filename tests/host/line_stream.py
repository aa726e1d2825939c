"""Session messages from a robot that drives straight lines past a line device, with known truth.

The magnet is a point on a PUMA 560's endpoint. The robot follows a straight line of its nominal model at constant speed
between ramps; the true position of the magnet follows from the true parameters. Readings show the joints ``delay_s``
earlier.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from session_stream import PERIOD_NS, SCALE, Box, ident_of, joint_messages, renumber

from truearm.model.chain import point_forward, point_jacobians
from truearm.model.robot_file import builtin_robot
from truearm.types import Message
from truearm_sim.paths import Path
from truearm_wire import messages as wire
from truearm_wire.cbor import Tag

ROBOT = builtin_robot("puma560")
CHAIN, DESIGN = ROBOT.chain, ROBOT.parameter_sets["design"]
MAGNET = np.array([0.0, 0.02, 0.06])  # in the end frame
GROUP_DELAY_NS = 1_500_000
SOUND = 25400.0 / 9.05  # m/s
FIRST_NS = 2_000_000_000
STEP = 2.0 * np.pi / 2**19
AWAY = 0.5  # V: for a magnet out of range
NOISE = (2e-6, 5e-6, 2e-6)  # m: of single readings of x, y, z


@dataclass
class LineBox(Box):
    """A box with both streams."""

    n1: int = 0

    def document(self) -> dict[str, object]:
        """Return the ident: converter with two transverse transducers of 20 mm/V, magnetostrictive head in ticks of 8 ns."""
        plain = [{"name": name, "unit": "V", "scale": SCALE} for name in ("lvdt", "excitation")]
        aside = {"unit": "V", "scale": SCALE, "calibration": {"unit": "mm", "poly": [[0, 0], [20, 0]]}}
        across = [{"name": name, **aside} for name in ("transverse_a", "transverse_b")]
        adc = {"id": 0, "name": "adc", "period_ns": PERIOD_NS, "osr": 4096, "group_delay_ns": GROUP_DELAY_NS}
        mag = {"id": 1, "name": "mag", "period_ns": PERIOD_NS, "osr": 0, "group_delay_ns": 0}
        poly = [[round(SOUND * 4), -9], [round(SOUND * 1e6), -6]]
        along = {"name": "magnetostrictive", "unit": "s", "scale": [8, -9], "calibration": {"unit": "m", "poly": poly}}
        channels = [plain[0], *across, plain[1]]
        return ident_of([{**adc, "channels": channels}, {**mag, "channels": [along]}], self.boot_id)

    def flights(self, t_host_ns: int, ticks: np.ndarray) -> None:
        """Add a block of times of flight with the first interrogation at this host time."""
        samples = Tag(78, np.ascontiguousarray(ticks, "<i4").tobytes())
        arrival = t_host_ns + len(ticks) * PERIOD_NS + 300_000
        flags = 4 if np.any(ticks == 0) else 0
        self.frame("mag", arrival, wire.DATA, 1, self.n1, self.device_us(t_host_ns), PERIOD_NS, samples, flags)
        self.n1 += len(ticks)


@dataclass
class Line:
    """A straight line of the nominal robot: joints by distance along it, and the pose of the device."""

    name: str
    way: CubicSpline  # m → (6,) joints
    length: float
    origin: np.ndarray  # (3,) of the device in the base frame
    turn: np.ndarray  # (3, 3) its axes, y along the line

    def drive(self, speed: float) -> Path:
        return Path(self.way, self.length, speed, 2.0 * speed)


@dataclass
class Truth:
    """The truth of a session. ``t`` and ``way`` tabulate the motion of one line after another."""

    params: np.ndarray
    lines: list[Line]
    legs: list[tuple[float, float, int, float, float]] = field(default_factory=list)  # start, end [s], line, from, to

    def q(self, t: np.ndarray) -> np.ndarray:
        """Return true joints (n, 6) at host times t [s]; between lines the robot moves in joint space."""
        q = np.empty((t.size, 6))
        q[:] = self.at(0, self.legs[0][3])
        for k, (start, end, line, a, b) in enumerate(self.legs):
            on = (t >= start) & (t <= end)
            drive = self.lines[line].drive(self.speed)
            q[on] = drive.joints(a + np.sign(b - a) * drive.along(t[on] - start))
            is_last, rest = k + 1 == len(self.legs), self.at(k, b)
            until, goal = (np.inf, rest) if is_last else (self.legs[k + 1][0], self.at(k + 1, self.legs[k + 1][3]))
            after = (t > end) & (t <= until)
            share = np.clip((t[after] - end - 0.3) / max(until - end - 0.6, 1e-9), 0.0, 1.0)
            q[after] = rest + (share**3 * (10.0 + share * (6.0 * share - 15.0)))[:, None] * (goal - rest)
        return q

    speed: float = 0.1

    def at(self, k: int, way: float) -> np.ndarray:
        return self.lines[self.legs[k][2]].way(way)

    def on_line(self, t: np.ndarray) -> np.ndarray:
        """Return the driven leg (n,) at times t, −1 for none; also between the legs of a line the magnet is on a device."""
        out = np.full(t.size, -1)
        for k, (start, end, line, *_) in enumerate(self.legs):
            more = k + 1 < len(self.legs) and self.legs[k + 1][2] == line
            out[(t >= start - 0.2) & (t <= (self.legs[k + 1][0] if more else end + 0.2))] = line
        return out

    def xyz(self, t: np.ndarray) -> np.ndarray:
        """Return true readings (n, 3) in the axes of the device at the magnet; NaN where there is none."""
        p = point_forward(CHAIN, self.params, self.q(t), np.broadcast_to(MAGNET, (t.size, 3)))
        out = np.full((t.size, 3), np.nan)
        which = self.on_line(t)
        for k, line in enumerate(self.lines):
            out[which == k] = (p[which == k] - line.origin) @ line.turn
        return out


def line_at(name: str, q_middle: np.ndarray, direction: np.ndarray, length: float) -> Line:
    """Return a line of the nominal robot through a pose; the orientation is that with the least joint motion."""
    direction = direction / np.linalg.norm(direction)
    middle = point_forward(CHAIN, DESIGN, q_middle[None], MAGNET[None])[0]
    half = [_followed(q_middle, middle, sign * direction, 0.5 * length) for sign in (-1.0, 1.0)]
    q = np.concatenate([half[0][::-1], q_middle[None], half[1]])
    way = np.linspace(0.0, length, len(q))
    x = np.cross(direction, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    turn = np.stack([x, direction, np.cross(x, direction)], axis=1)
    return Line(name, CubicSpline(way, q), length, middle - direction * (0.5 * length + 0.1), turn)


def _followed(q: np.ndarray, start: np.ndarray, direction: np.ndarray, length: float, steps: int = 100) -> np.ndarray:
    found = []
    for k in range(1, steps + 1):
        goal = start + direction * (length * k / steps)
        for _ in range(6):
            p, _, jac = point_jacobians(CHAIN, DESIGN, q, MAGNET)
            q = q + np.linalg.pinv(jac) @ (goal - p)
        found.append(q)
    return np.array(found)


def some_lines(rng: np.random.Generator, count: int, length: float = 0.4) -> list[Line]:
    """Return lines in several directions through poses in front of the robot, without large or fast joint motion."""
    found: list[Line] = []
    low, high = np.deg2rad([[-50, -90, 120, -90, 30, -90], [50, -20, 200, 90, 90, 90]])
    while len(found) < count:
        line = line_at(f"l{len(found) + 1}", rng.uniform(low, high), rng.normal(size=3) * [1.0, 1.0, 0.6], length)
        q = line.way(np.linspace(0.0, length, 80))
        if np.ptp(q, axis=0).max() < 1.2 and np.abs(np.diff(q, axis=0)).max() < 0.03:
            found.append(line)
    return found


def true_params(rng: np.random.Generator) -> np.ndarray:
    """Return nominal parameters with the free ones changed by a millimetre and some milliradians."""
    unit = np.array([{"m": 1e-3, "rad": 4e-3}.get(p.unit, 0.0) for p in CHAIN.parameters])
    return DESIGN + unit * ROBOT.free * rng.standard_normal(unit.size)


@dataclass
class Made:
    """A session and its truth; ``box`` contains its clock."""

    messages: list[Message]
    truth: Truth
    end_ns: int


def line_session(
    rng: np.random.Generator,
    lines: Sequence[Line],
    params: np.ndarray | None = None,
    there_and_back: bool = True,
    speed: float = 0.1,
    delay_s: float = 0.0,
    plan: bool = True,
    lost_stops: float = 0.0,
) -> Made:
    """Drive each line forwards and back."""
    truth = Truth(DESIGN if params is None else params, list(lines), speed=speed)
    t = 4.0
    for k, line in enumerate(lines):
        for a, b in ((0.0, line.length), (line.length, 0.0))[: 1 + there_and_back]:
            end = t + line.drive(speed).seconds
            truth.legs.append((t, end, k, a, b))
            t = end
        t += 2.5
    end_ns = int(1e9 * t)
    box = LineBox(ppm=31.0, boot_host_ns=-3_000_000_000)
    box.ident(1_000_000)
    start = len(box.messages)
    for at in np.arange(5e7, end_ns, 2.5e8):
        box.sync(int(at), 90e3 + rng.exponential(1e5), 90e3 + rng.exponential(1e5))
    for at in range(10**9, end_ns, 10**9):
        box.heartbeat(at)
    _streams(box, truth, rng, end_ns, lost_stops)
    frames = renumber(box.messages[:start] + sorted(box.messages[start:], key=lambda m: m.t_host_ns))
    times = np.arange(10**9, end_ns, 1e9 / 125.0)
    robot = joint_messages(rng, times, STEP * np.rint(truth.q(1e-9 * times - delay_s) / STEP))
    said = _plan(truth) if plan else _mounted(truth)
    return Made(sorted([*said, *frames, *robot], key=lambda m: m.t_host_ns), truth, end_ns)


def _streams(box: LineBox, truth: Truth, rng: np.random.Generator, end_ns: int, lost: float) -> None:
    shots = np.arange(FIRST_NS + 317_000, end_ns, PERIOD_NS)
    y = truth.xyz(1e-9 * shots)[:, 1] + NOISE[1] * rng.standard_normal(shots.size)
    ticks = np.floor(y / SOUND / 8e-9)
    gone = np.isnan(y) | (rng.random(shots.size) < lost)
    ticks = np.where(gone, 0, ticks).astype(np.int64)
    for k in range(0, shots.size - 52, 52):
        box.flights(int(shots[k]), ticks[k : k + 52])
    samples = np.arange(FIRST_NS, end_ns, PERIOD_NS)
    xyz = truth.xyz(1e-9 * (samples - GROUP_DELAY_NS))
    counts = np.zeros((samples.size, 4), np.int64)
    for column, axis in ((1, 0), (2, 2)):
        volts = (xyz[:, axis] + NOISE[axis] * rng.standard_normal(samples.size)) / 0.02
        counts[:, column] = np.clip(np.rint(np.where(np.isnan(volts), AWAY, volts) / 143e-9), -(2**23), 2**23 - 1)
    for k in range(0, samples.size - 13, 13):
        box.data(int(samples[k]), counts[k : k + 13])


def _plan(truth: Truth) -> list[Message]:
    rows: list[dict[str, object]] = []
    for k, (_, _, line, a, b) in enumerate(truth.legs):
        if k == 0 or truth.legs[k - 1][2] != line:
            rows.append({"move": "via", "q": truth.at(k, a).tolist()})
        ends = {"line": truth.lines[line].name, "target": "magnet", "speed_m_s": truth.speed}
        rows.append({"move": "line", **ends, "q": truth.at(k, b).tolist()})
    return [Message("/plan", 0, json.dumps({"pose": k, **row}).encode()) for k, row in enumerate(rows)]


def _mounted(truth: Truth) -> list[Message]:
    """Return mounting messages: a second before a line's first leg, and "nothing" half a second after its last."""
    said = []
    for k, (start, end, line, *_) in enumerate(truth.legs):
        if k == 0 or truth.legs[k - 1][2] != line:
            words = {"kind": "mounted", "line": truth.lines[line].name, "target": "magnet"}
            said.append(Message("/events", int(1e9 * (start - 0.25)), json.dumps(words).encode()))
        if k + 1 == len(truth.legs) or truth.legs[k + 1][2] != line:
            said.append(Message("/events", int(1e9 * (end + 0.25)), json.dumps({"kind": "mounted"}).encode()))
    return said
