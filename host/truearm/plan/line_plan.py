"""A plan of lines: where to put a line device, and how to drive along it in both directions.

A line is straight at the target, with the tool turning evenly, as controllers do in Cartesian motion. It has a middle
posture, drawn at random, a direction, and a rotation of the tool from end to end. Inverse kinematics follows it
outwards from the middle. The entire path must satisfy the limits and the joint speed. The target must stay within the
range of the transverse sensors by twice the a-priori straightness (Renders 1991, II-C, 15 mm).

The half of the candidates with the larger errors by the robot's tolerances is kept (II-D): there, measurement errors
matter less (III-G, 4). Among these, lines are chosen like ball-bar poses, each a block of rows after fitting the six
unknowns of its own device. Each is driven at constant speed in both directions, since in one direction a delay is
indistinguishable from the device's position.

A device is assumed to be set up by hand, to BY_HAND about each axis. Otherwise its roll would be determined only by the
tenths of a millimetre by which the true arm deviates from the line.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.errors import Argument, PlanError
from truearm.estimate.information import of_rows
from truearm.estimate.problem import settled
from truearm.estimate.uncertainty import tolerance_error, weak_prior
from truearm.estimate.whitened_rows import whitened_blocks
from truearm.kinds.table import ObservationTable
from truearm.model.chain import end_and_jacobian, forward, point_forward, point_jacobians
from truearm.model.inverse import inverse, singular_value
from truearm.model.transforms import rotation_vector
from truearm.plan.bar_paths import Pace, samples, way_without_bar
from truearm.plan.branches import LEVER
from truearm.plan.choose import as_blocks, choose, condensed
from truearm.plan.forecast import Aim, Forecast, Knowledge, compiled, forecast, planned_table, prior_unit, region_root
from truearm.plan.measurement_limits import Region, Site, allowed, around, device_is_clear, poses_in
from truearm.plan.options import LineOptions
from truearm.plan.route import SETTLE, Stop, plain, short_tour, timed, visits_of
from truearm.progress import steps_of
from truearm.types import Device, Floats, Move, Plan, Rig, rms_of_columns
from truearm.units import MM

# of the tool from end to end: determines its orientation without tilting the device's magnet far
MOST_TURN = np.deg2rad(40.0)
STEPS = 8  # of the inverse kinematics from one point to the next: more only where the arm does not reach it
AT_ONCE, ROUNDS = 100, 40  # random draws
SETUP = 180.0  # s to place the device
BY_HAND = 0.052  # rad about each axis: accuracy with which a device is set up as planned (Renders III-C)


class Lines(NamedTuple):
    """Lines (l): joints (l, 2·n_points + 1, j) evenly spaced, with both ends, and the points at odd indices.

    Joint velocities (l, n_points, j) are for the points in the first direction.
    """

    q: Floats
    q_rate: Floats

    @property
    def points(self) -> Floats:
        """Return the joints at the points (l, n_points, j)."""
        return self.q[:, 1::2]

    def select(self, rows: list[int]) -> Lines:
        return Lines(self.q[rows], self.q_rate[rows])


def candidate_lines(
    site: Site,
    options: LineOptions,
    n: int,
    point: Floats,
    joint_speed: float,
    region: Region | None = None,
    seed: int = 0,
    fewest: int = 1,
) -> Lines:
    """Return up to ``n`` lines with their middles in the region. Raises PlanError for fewer than ``fewest``."""
    rng = np.random.default_rng([seed, 0x11E5])
    branch, driveable = site.arm.branch, list[tuple[Floats, Floats]]()
    for _ in steps_of(range(ROUNDS), "looking for lines that the arm can drive"):
        middle = rng.uniform(branch.lower, branch.upper, (AT_ONCE, len(branch.lower)))
        along, turn = _directions(rng), MOST_TURN * rng.random((AT_ONCE, 1)) * _directions(rng)
        p_middle = point_forward(site.arm.chain, site.arm.params, middle, point)
        if region is not None:
            inside = ((p_middle >= region.lower) & (p_middle <= region.upper)).all(axis=1)
            middle, along, turn = middle[inside], along[inside], turn[inside]
        if not len(middle):
            continue
        lines = driven_lines(site, middle, options.length * along, turn, 2 * options.points + 1, point)
        rates = _rates(site, lines[:, 1::2], options.speed * along, options.speed / options.length * turn, point)
        driveable += [
            (q, rate)
            for q, rate, u in zip(lines, rates, along, strict=True)
            if _fits(site, q, rate, u, options, point, joint_speed)
        ]
        if len(driveable) >= n:
            break
    if len(driveable) < fewest:
        raise PlanError(
            f"only {len(driveable)} lines of {MM.text(options.length)} fit within the arm's reach; ask for shorter, slower or fewer lines"
        )
    return Lines(*(np.array(column) for column in zip(*driveable[:n], strict=True)))


def _directions(rng: np.random.Generator) -> Floats:
    drawn = rng.normal(size=(AT_ONCE, 3))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def driven_lines(site: Site, middle: Floats, displacement: Floats, turn: Floats, n: int, point: Floats) -> Floats:
    """Return joints (m, n, j) along lines with middle postures ``middle`` (m, j); NaN where no joints were found.

    From end to end, a ``point`` (3,) of the end moves by ``displacement`` (m, 3) [m], and the tool turns by the
    rotation vectors ``turn`` (m, 3).
    """
    chain, params, branch = site.arm.chain, site.arm.params, site.arm.branch
    at_middle = forward(chain, params, middle)
    p_middle = point_forward(chain, params, middle, point)
    out, shares = np.full((len(middle), n, middle.shape[1]), np.nan), np.linspace(-0.5, 0.5, n)
    for side in (np.flatnonzero(shares >= 0.0), np.flatnonzero(shares < 0.0)[::-1]):
        q = middle
        for k in side:
            pose = at_middle.copy()
            pose[:, :3, :3] = Rotation.from_rotvec(shares[k] * turn).as_matrix() @ pose[:, :3, :3]
            pose[:, :3, 3] = p_middle + shares[k] * displacement - pose[:, :3, :3] @ point
            q = inverse(chain, params, pose, q, steps=STEPS)
            q[((q <= branch.lower) | (q >= branch.upper)).any(axis=1)] = np.nan
            out[:, k] = q
    return np.where(np.isnan(out).any(axis=(1, 2), keepdims=True), np.nan, out)


def _rates(site: Site, q: Floats, velocity: Floats, turning: Floats, point: Floats) -> Floats:
    """Return joint rates (m, n, j) [rad/s] at joints q (m, n, j).

    They give a point's velocity (m, 3) and the tool's turning (m, 3).

    The velocity is in m/s and the turning in rad/s.
    """
    flat = np.nan_to_num(q.reshape(-1, q.shape[2]))
    pose, jacobian = end_and_jacobian(site.arm.chain, site.arm.params, flat)
    velocity, turning = (np.repeat(vector, q.shape[1], axis=0) for vector in (velocity, turning))
    twist = np.concatenate([velocity - np.cross(turning, pose[:, :3, :3] @ point), turning], axis=1)
    return np.asarray((np.linalg.pinv(jacobian, rcond=1e-3) @ twist[..., None])[..., 0].reshape(q.shape))


def _fits(
    site: Site, q: Floats, q_rate: Floats, along: Floats, options: LineOptions, point: Floats, joint_speed: float
) -> bool:
    """Return whether a line (n, j) can be driven from end to end next to its device."""
    if np.isnan(q).any() or np.abs(q_rate).max() > joint_speed:
        return False
    path, limits = samples(q[:-1], q[1:])[0], site.limits.tightened()
    singular = singular_value(site.arm.chain, site.arm.params, path, lever=LEVER)
    if not allowed(site, path, None, limits).all() or (singular < limits.singular_value).any():
        return False
    ends = point_forward(site.arm.chain, site.arm.params, q[[0, -1]], point)
    if not device_is_clear(site.shapes, path, ends[0], ends[1], bool(point.any())):
        return False
    return 2.0 * straightness(site, q[1::2], along, point) < 0.5 * options.transverse


def straightness(site: Site, q: Floats, along: Floats, point: Floats) -> float:
    """Return the expected transverse distance [m] of a line's points from the best straight line, at the worst point.

    It is computed from the tolerances of ``weak_prior``, those of a manufacturer's drawing.
    """
    p, jac, _ = point_jacobians(site.arm.chain, site.arm.params, q, point)
    across = jac - along[:, None] * np.einsum("i,nip->np", along, jac)[:, None]
    y = (p - p.mean(axis=0)) @ along
    basis, _ = np.linalg.qr(np.stack([np.ones_like(y), y], axis=1))
    bent = across - np.einsum("nk,mk,mip->nip", basis, basis, across)
    return float(np.sqrt(((bent * weak_prior(site.arm.chain)) ** 2).sum(axis=(1, 2)).max()))


def a_priori(site: Site, q: Floats, point: Floats) -> Floats:
    """Return the expected RMS error [m] (c,) over the points of lines (c, n, j), with the tolerances ``weak_prior``."""
    chain = site.arm.chain
    error = tolerance_error(chain, weak_prior(chain), q.reshape(-1, q.shape[2]), point)
    return rms_of_columns(error.reshape(q.shape[:2]).T)


class LinePlan(NamedTuple):
    """Lines in the order of their visits, the a-priori error (l,) [m] at each, and the planned pose of the devices."""

    lines: Lines
    error: Floats
    rig: Rig  # with the devices
    devices: dict[str, Device]  # of this plan, in order
    stops: list[Stop]
    forecast: Forecast
    minutes: float

    @property
    def visits(self) -> Plan:
        """Return the stops as the recorder follows them."""
        return visits_of(self.stops)


def plan_lines(
    site: Site, knowledge: Knowledge, options: LineOptions, pace: Pace, region: Region | None = None, target: str = ""
) -> LinePlan:
    """Plan lines: candidates, choice, order and forecast.

    ``target``: the measured point of the rig, "" for the end's origin.

    Raises PlanError if too few lines fit into the workspace or the budget, and the errors of the steps.
    """
    if (options.lines is None) == (options.minutes is None):
        raise PlanError(
            "exclusive", first=Argument("lines"), second=Argument("minutes"), neither=options.minutes is None
        )
    point = np.array(knowledge.rig.targets[target].xyz) if target else np.zeros(3)
    seconds_each = SETUP + 2.0 * options.passes * (options.length / options.speed + 2.0 * SETTLE)
    budget = np.inf if options.minutes is None else 60.0 * options.minutes
    n = options.lines or int(budget / seconds_each)
    too_small = PlanError(
        f"a budget of {options.minutes or 0.0:g} min is too small: placing the device takes {SETUP:g} s, and driving along it "
        f"{seconds_each - SETUP:.0f} s; give more minutes"
    )
    if not n:
        raise too_small
    n_candidates = max(options.candidates, n if options.lines else 1)
    fewest = options.lines or 1
    candidates = candidate_lines(site, options, n_candidates, point, pace.joint_speed, region, options.seed, fewest)
    n = min(n, len(candidates.q))
    error = a_priori(site, candidates.points, point)
    erring = np.sort(np.argsort(-error, kind="stable")[: max(-(-len(error) // 2), n)])
    candidates, error = candidates.select(erring.tolist()), error[erring]
    places = point_forward(knowledge.chain, knowledge.params, candidates.points, point).reshape(-1, 3)
    aim = Aim(poses_in(site, region or around(places), point, seed=options.seed), (target,) * bool(target))
    while n:
        rows = _chosen(knowledge, candidates, n, options, aim, target)
        lines = candidates.select(rows).select(_order(candidates.q[rows]))
        names = _new_names(knowledge, n)
        stops = _stops(site, lines, names, options, pace, point, target)
        seconds = sum(stop.seconds for stop in stops) + n * seconds_each
        if seconds <= budget:
            break
        n -= 1
    else:
        raise too_small
    knowledge = replace(knowledge, rig=replace(knowledge.rig, line_travel=options.transverse))
    table, devices = line_rows(knowledge, lines, names, target, options.passes)
    knowledge, errors = _with_lines(knowledge, devices), a_priori(site, lines.points, point)
    expected = forecast(knowledge, table, aim)
    return LinePlan(lines, errors, knowledge.rig, devices, stops, expected, seconds / 60.0)


def line_rows(
    knowledge: Knowledge, lines: Lines, names: list[str], target: str, passes: int = 1
) -> tuple[ObservationTable, dict[str, Device]]:
    """Return lines in both directions as rows that would be read if the model were exact, and their devices.

    The devices are placed by these rows.
    """
    point = np.array(knowledge.rig.targets[target].xyz) if target else np.zeros(3)
    p = point_forward(knowledge.chain, knowledge.params, lines.points, point)
    axes = [_axes(line) for line in p]
    xyz = np.array([(line - line.mean(axis=0)) @ rot for line, rot in zip(p, axes, strict=True)])
    cov = tuple(tuple(s**2 * (i == k) for k in range(3)) for i, s in enumerate(knowledge.rig.line_sigma))
    devices = {}
    for name, rot in zip(names, axes, strict=True):
        rx, ry, rz = rotation_vector(rot).tolist()
        devices[name] = Device(name, cov, None, (rx, ry, rz), None, BY_HAND)

    def all_ways(values: Floats, sign: float = 1.0) -> Floats:
        passes_of_line = np.concatenate([values, sign * values[:, ::-1]] * passes, axis=1)
        return passes_of_line.reshape(-1, values.shape[2])

    table = planned_table(
        all_ways(lines.points),
        "line",
        xyz=all_ways(xyz),
        q_rate=all_ways(lines.q_rate, -1.0),
        line=np.repeat(names, 2 * passes * lines.points.shape[1]),
        target=target,
    )
    return table, devices


def _axes(line: Floats) -> Floats:
    """Return the axes (3, 3) of a device along points (n, 3): y from the first to the last."""
    y = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    x = np.cross(y, np.eye(3)[np.argmin(np.abs(y))])
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _new_names(knowledge: Knowledge, n: int) -> list[str]:
    """Return plan1, plan2 …, without names that the rig or the rows already use."""
    old = {*knowledge.rig.lines, *(() if knowledge.measured is None else knowledge.measured.line.tolist())}
    free = (name for name in map("plan{}".format, count(1)) if name not in old)
    return [next(free) for _ in range(n)]


def _with_lines(knowledge: Knowledge, devices: dict[str, Device]) -> Knowledge:
    """Return what is known with the planned devices in addition to those already used."""
    old = knowledge.rig.lines
    if knowledge.measured is not None and not old:
        cov = next(iter(devices.values())).sensor_cov
        old = {str(name): Device(str(name), cov) for name in np.unique(knowledge.measured.line) if name}
    return replace(knowledge, rig=replace(knowledge.rig, lines={**old, **devices}))


def _chosen(knowledge: Knowledge, candidates: Lines, n: int, options: LineOptions, aim: Aim, target: str) -> list[int]:
    """Return the indices of the best ``n`` candidates, each with a device of its own whose unknowns are fitted too."""
    blocks = []  # of each line, what it says of the robot beside its device
    for i in steps_of(range(len(candidates.q)), f"weighing {len(candidates.q)} lines"):
        table, devices = line_rows(knowledge, candidates.select([i]), ["own"], target, options.passes)
        alone = _with_lines(replace(knowledge, measured=None), devices)
        problem, x, columns = compiled(alone, table)
        (block,) = whitened_blocks(problem, x, columns)
        of_device = np.array([name.startswith("line.own.") for name in problem.names])[columns]
        jac = block.jac.reshape(-1, of_device.size)
        unit = prior_unit(alone, problem, columns)[~of_device]
        blocks.append(condensed(jac[:, ~of_device] * unit, jac[:, of_device]))
    root = region_root(alone, table, aim)[:, ~of_device]
    information = _information(knowledge, blocks[0].shape[1])
    return list(map(int, choose(as_blocks(blocks), information, n, options.criterion, root)))


def _information(knowledge: Knowledge, k: int) -> Floats:
    """Return the information (k, k) of the prior and of existing measurements for the robot's columns.

    The rows' own unknowns are fitted first.
    """
    information = np.eye(k)
    if knowledge.measured is None:
        return information
    problem, x, columns = compiled(replace(knowledge, measured=None), knowledge.measured)
    n_robot, unit = int(knowledge.free.sum()), prior_unit(knowledge, problem, columns)
    root = of_rows(settled(problem, x), x, columns).root * unit
    rows = condensed(root[:, :n_robot], root[:, n_robot:]) if unit.size > n_robot else root
    information[:n_robot, :n_robot] += rows.T @ rows
    return information


def _order(q: Floats) -> list[int]:
    """Order lines (l, n, j) so that each begins near the end of the previous one, which is where that one began."""
    start = q[:, 0]
    return list(map(int, short_tour(np.arange(len(q), dtype=float), np.abs(start[:, None] - start).max(axis=2))))


def _stops(
    site: Site, lines: Lines, names: list[str], options: LineOptions, pace: Pace, point: Floats, target: str
) -> list[Stop]:
    """Return the beginning of every line, its ends in both directions, and via points between lines."""
    stops: list[Stop] = []
    for number, (q, name) in enumerate(zip(lines.q, names, strict=True)):
        via = way_without_bar(site, stops[-1].q, q[0], f"line {name}", seed=number) if stops else ()
        leg = [Stop(place, 0.0, Move.VIA) for place in (*via, q[0])]
        instruction = "Remove the line device" if stops else "Check that no line device is in the way"
        leg[0] = leg[0]._replace(before=plain(f"{instruction}. Next: line {name}"))
        leg[-1] = leg[-1]._replace(there=plain(f"Place the line device along line {name}"))
        line, ends = {"line": name, "target": target}, (q[-1], q[0]) * options.passes
        stops += [*leg, *(Stop(place, 0.0, Move.LINE, speed=options.speed, names=line) for place in ends)]
    return timed(site, stops, np.tile(point, (len(stops), 1)), pace)
