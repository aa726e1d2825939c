"""A plan of lines: where to put a line device, and how to drive along it in both directions.

The error at each candidate (``straight``) is computed from the tolerances of the robot (Renders 1991, II-D), and the
half with the larger errors is kept. There, measurement errors matter less (III-G, 4). Among these, lines are chosen
like ball-bar poses, each a block of rows after fitting the six unknowns of its own device. Each is driven at constant
speed in both directions, since in one direction a delay is indistinguishable from the device's position.

A device is assumed to be set up by hand, to BY_HAND about each axis. Otherwise its roll would be determined only by the
tenths of a millimetre by which the true arm deviates from the line.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import NamedTuple

import numpy as np

from truearm.errors import Argument, PlanError
from truearm.estimate.information import of_rows
from truearm.estimate.problem import settled
from truearm.estimate.whitened_rows import whitened_blocks
from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward
from truearm.model.rotation import rotation_vector
from truearm.plan.bar_paths import Pace, way_without_bar
from truearm.plan.cartesian_lines import Lines, a_priori, candidate_lines
from truearm.plan.choose import as_blocks, choose, condensed
from truearm.plan.forecast import Aim, Forecast, Knowledge, compiled, forecast, planned_table, prior_unit, region_root
from truearm.plan.measurement_limits import Site
from truearm.plan.options import LineOptions
from truearm.plan.region import Region, around, poses_in
from truearm.plan.route import timed
from truearm.plan.route_stops import SETTLE, Stop, plain, visits_of
from truearm.plan.visit_order import short_tour
from truearm.progress import steps_of
from truearm.types import Device, Floats, Move, Plan, Rig

SETUP = 180.0  # s to place the device
BY_HAND = 0.052  # rad about each axis: accuracy with which a device is set up as planned (Renders III-C)


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
    """Plan lines: candidates, choice, order and forecast. ``target``: the measured point of the rig, "" for the end's
    origin.

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
    """Return the best ``n`` lines, after fitting the unknowns of their own devices."""
    blocks = []
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
