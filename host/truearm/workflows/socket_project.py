"""The files of a project with printed sockets (docs/tutorials/sockets.md), and joints of seats from a log.

The arm rests in the sockets in the order of the rows of the table of seats.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.distance import pdist

from truearm.disk import read_text, write_atomic
from truearm.errors import Argument, InputError, PlanError
from truearm.estimate.uncertainty import weak_prior
from truearm.findings import Finding, entries
from truearm.kinds.csv_cells import CsvTable, csv_text, read_cells, read_header
from truearm.kinds.rig_file import parse_rig
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import MAX_BYTES, PAGE, table_titles
from truearm.model.robot import Robot
from truearm.plan.forecast import Aim, Knowledge, forecast, planned_table
from truearm.plan.socket_places import Site, SocketBlock, plans_of_sites
from truearm.progress import step
from truearm.record.robots.sources import FileOptions, readings_of_file
from truearm.session.joint_format import parse_lines
from truearm.text import counted
from truearm.types import Floats, Rig
from truearm.units import DEG, MM, SUFFIXES
from truearm.workflows.plan import forecast_document, knowledge_of
from truearm.workflows.requests import SocketSeats

SEAT_NOISE = np.sqrt(3.0) * Rig().seat_sigma  # m, of all coordinates
SEATS, PLACES, BLOCK, DRAWING = "seats.csv", "places.csv", "socket.stl", "places.svg"
RIG = """\
# The rig of {name}: a ball on the robot's end, and a printed block with two sockets that is moved from place to place.
# Where the block stands is not measured: truearm estimates it.

# Standard deviation of a ball's position in a socket. 0.1 mm is typical of a printed socket and a steel ball.
seat_sigma_mm = 0.1

# The ball's centre in the frame of the robot's end, to about 5 mm: nearer, it may be a mirror image of another one.
[[sphere]]
name = "ball"
xyz_mm = [{ball}]
sigma_mm = 5

# The distance of the two sockets; it is the scale of the result. Measure the printed block with a calliper: the mean of the
# distances over the outer and over the inner edges of the two cones.
[[socket_distance]]
sockets = ["0", "1"]
distance_mm = {distance:g}
sigma_mm = 0.1
"""
PER_REST = 20  # readings that are looked at in the shortest rest


def plan_sockets(robot: Robot, request: SocketSeats, name: str) -> tuple[dict[str, str | bytes], dict[str, Any]]:
    """Plan seats in printed sockets: files by name (rig, plan, table, block, drawing), and the forecast as JSON.

    Raises PlanError.

    The first plan is taken that predicts every place from the others as well as a ball repeats in its socket, or else
    the best one.
    """
    block = SocketBlock(0.5 * request.ball)
    ball = ", ".join(f"{MM.of(x):g}" for x in request.ball_xyz)
    rig_text = RIG.format(name=name, ball=ball, distance=MM.of(block.distance))
    rig = parse_rig(rig_text, "rig.toml")
    knowledge, plans = _within_tolerances(knowledge_of(robot, rig)), []
    for sites in plans_of_sites(robot, request.ball_xyz, block, request.table, request.places, request.seats):
        tables = _tables(sites)
        worst = _between_places(knowledge, tables)
        plans.append((worst, sites, tables))
        if worst < SEAT_NOISE:
            break
    _, sites, tables = min(plans, key=itemgetter(0))
    seated = ObservationTable.joined(tables)
    predicted = forecast(knowledge, seated, Aim(seated.q, tuple(rig.spheres)))
    if predicted.cartesian is None:
        raise PlanError(
            f"{len(seated)} seats at {len(sites)} places do not determine the arm; plan more seats or places",
            **{"seats": len(seated), "places": len(sites)},
        )
    moving = robot.chain.motors
    units = [DEG if robot.chain.joints[joint].kind == "revolute" else MM for joint in moving]
    joints = [f"q{i}_{'deg' if unit is DEG else 'mm'}" for i, unit in enumerate(units, start=1)]
    plan: list[list[object]] = [["seat", "place", "socket", "ball_x_mm", "ball_y_mm", "ball_z_mm", *joints]]
    seats: list[list[object]] = [["kind", "place", "socket", *joints]]
    for number, site in enumerate(sites, start=1):
        for socket, side in enumerate((-0.5, 0.5)):
            centre = site.place + [0.0, 0.0, block.centre_height] + side * block.distance * site.direction
            for q in site.q[socket][:, moving]:
                row = [f"p{number}", socket]
                values = [unit.of(value) for unit, value in zip(units, q.tolist(), strict=True)]
                plan.append([len(seats), *row, *(f"{MM.of(x):.1f}" for x in centre), *(f"{x:.2f}" for x in values)])
                seats.append(["seat", *row, *("" for _ in joints)])
    files: dict[str, str | bytes] = {
        "rig.toml": rig_text,
        PLACES: csv_text(plan),
        SEATS: csv_text(seats),
        BLOCK: stl(block),
        DRAWING: "\n".join(_drawing(sites, block, request.table)) + "\n",
    }
    document = forecast_document(predicted)
    facts: dict[str, Any] = {"seats": len(seats) - 1, "places": len(sites), "sigma": {"mm": MM.of(rig.seat_sigma)}}
    facts["span"] = {"mm": MM.of(float(pdist([site.place for site in sites]).max(initial=0.0)))}
    if predicted.cartesian is not None:
        facts |= {name: {"mm": document[f"cartesian_{key}_mm"]} for name, key in (("rms", "rms"), ("largest", "worst"))}
    return files, {**document, "findings": entries([Finding("planned-seats", facts)])}


def _within_tolerances(knowledge: Knowledge) -> Knowledge:
    """Return an arm as its drawing allows: with exactly parallel axes, less is identifiable than of a real one."""
    tolerance = knowledge.free * weak_prior(knowledge.chain)
    return replace(
        knowledge, params=knowledge.params + tolerance * np.random.default_rng(0).normal(size=tolerance.size)
    )


def _tables(sites: list[Site]) -> list[ObservationTable]:
    """Return the seats of each place as rows."""
    return [
        ObservationTable.joined([planned_table(q, "seat", place=f"p{i}", socket=str(k)) for k, q in enumerate(site.q)])
        for i, site in enumerate(sites, start=1)
    ]


def _between_places(knowledge: Knowledge, tables: list[ObservationTable]) -> float:
    """Return the largest RMS error [m] of a place in a fit of the others, but for its pose; inf if undetermined."""
    errors = []
    for i, table in enumerate(tables):
        other_tables = ObservationTable.joined([*tables[:i], *tables[i + 1 :]])
        errors.append(forecast(knowledge, other_tables, Aim(table.q, tuple(knowledge.rig.spheres))).cartesian_rms)
    return float(np.max(np.where(np.isnan(errors), np.inf, errors)))


def seats_noted(path: Path) -> dict[str, Any]:
    """Return the rows of a table of seats, those with joints, and its last place.

    Raises InputError for another file.
    """
    header, rows = read_cells(read_text(path, MAX_BYTES, InputError), str(path))
    joints = [index for index, title in enumerate(header) if title.startswith("q")]
    noted = sum(all(row.cells[index] for index in joints) for row in rows)
    last_place = rows[-1].cells[header.index("place")] if rows and "place" in header else ""
    return {"rows": len(rows), "noted": noted, "last_place": last_place}


def stl(block: SocketBlock) -> bytes:
    """Return a block as binary STL in mm."""
    corners = MM.of(block.triangles())
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets["normal"], facets["corners"] = normal / np.linalg.norm(normal, axis=1, keepdims=True), corners
    return b"truearm".ljust(80) + len(facets).to_bytes(4, "little") + bytes(facets.tobytes())


def _drawing(sites: list[Site], block: SocketBlock, table: float) -> Iterator[str]:
    """Yield an SVG of the table from above, at a scale of 1:1 and with a grid of 100 mm; the base's x points up."""
    places = MM.of(np.array([site.place for site in sites]))
    length, width, _ = map(MM.of, block.size)
    border = 100.0 * np.ceil(np.abs(places[:, :2]).max(axis=0) / 100.0 + 1.0)
    top, half_width = float(border[0]), float(border[1])
    yield f'<svg xmlns="http://www.w3.org/2000/svg" width="{2 * half_width:g}mm" height="{top + 100:g}mm" font-size="14"'
    yield f' viewBox="{-half_width:g} {-top:g} {2 * half_width:g} {top + 100:g}" font-family="sans-serif" fill="none" stroke="#bbb">'
    for x in np.arange(-100.0, top + 1.0, 100.0):
        yield f'<path d="M{-half_width:g} {-x:g}H{half_width:g}"/>'
    for y in np.arange(-half_width, half_width + 1.0, 100.0):
        yield f'<path d="M{y:g} {-top:g}V100"/>'
    yield '<path d="M0 0V-80m-6 12l6-12l6 12M0 0H-80m12-6l-12 6l12 6" stroke="#000" stroke-width="2"/>'
    yield '<g fill="#000" stroke="none"><text x="8" y="-70">x</text><text x="-76" y="20">y</text>'
    yield '<text x="8" y="20">base of the robot</text></g>'
    for number, (site, (x, y, z)) in enumerate(zip(sites, places.tolist(), strict=True), start=1):
        turn = DEG.of(np.arctan2(-site.direction[0], -site.direction[1]))
        box = f", on a box of {z - MM.of(table):g} mm" * (z > MM.of(table))
        yield f'<g transform="translate({-y:g} {-x:g})" stroke="#000"><g transform="rotate({turn:.1f})">'
        yield f'<rect x="{-length / 2:g}" y="{-width / 2:g}" width="{length:g}" height="{width:g}"/>'
        for socket, side in enumerate((-0.5, 0.5)):
            offset = MM.of(side * block.distance)
            yield f'<circle cx="{offset:g}" r="{MM.of(block.radius):g}"/>'
            yield f'<text x="{offset - 4:g}" y="5" fill="#000" stroke="none">{socket}</text>'
        yield f'</g><text y="{length / 2 + 18:g}" fill="#000" stroke="none" text-anchor="middle">'
        yield f"p{number}: x {x:g}, y {y:g} mm{box}</text></g>"
    yield "</svg>"


class Rest(NamedTuple):
    """A time in which no joint moves: begin and end [s] on the controller's clock, and joints (j,) [rad, m]."""

    begin: float
    end: float
    q: Floats


def rests(t: Floats, q: Floats, shortest: float, bounds: Floats) -> list[Rest]:
    """Return the times of at least ``shortest`` [s] in which every joint stays within a range of its bound (j,).

    ``t`` (n,) [s] ascends, ``q`` (n, j). Overlapping times are one rest.
    """
    first_rows = np.unique(np.floor(t * (PER_REST / shortest)), return_index=True)[1]
    t, q = t[first_rows], q[first_rows]
    end = np.searchsorted(t, t + shortest)  # of the window that begins at each reading, the last one in it
    begin = np.flatnonzero(end < len(t))
    windows = np.stack([begin, end[begin] + 1], axis=1).ravel()
    padded = np.concatenate([q, q[-1:]])
    span = (
        np.maximum.reduceat(padded, windows)[::2] - np.minimum.reduceat(padded, windows)[::2] if begin.size else q[:0]
    )
    still = begin[(span <= bounds).all(axis=1)]
    change = np.zeros(len(t), dtype=int)  # between a reading and the next: within a window or not
    np.add.at(change, still, 1)
    np.add.at(change, end[still], -1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.cumsum(change) > 0]).astype(int)))
    pairs = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return [Rest(float(t[i]), float(t[k]), np.median(q[i : k + 1], axis=0)) for i, k in pairs]


@step("reading the log")
def fill_seats(table: Path, source: Path, options: FileOptions, shortest: float, bound: float) -> Finding:
    """Write the joints of each rest in a log into the next row of a table of seats that has none.

    ``shortest`` [s], ``bound`` [rad]. Raises InputError if there are not as many rests as such rows; then nothing is
    written.
    """
    header, rows = read_cells(read_text(table, MAX_BYTES, InputError), str(table))
    joints = CsvTable(str(table), rows, read_header(header, table_titles(), str(table), PAGE)).numbered("q")
    if not joints:
        raise InputError("missing-column", place=str(table), column="q1_rad")
    empty = [row.cells for row in rows if not all(row.cells[joint.position] for joint in joints)]
    lines = [reading.line for reading in readings_of_file(source, options)]
    log = parse_lines(lines, range(len(lines)))
    if log.q.shape[1] != len(joints):
        raise InputError("other-robot", place=source, joints=log.q.shape[1], expected=len(joints))
    units = [SUFFIXES[joint.unit] for joint in joints]
    bounds = np.array([bound if unit.si == "rad" else MM.to_si(DEG.of(bound)) for unit in units])
    stops = rests(log.t, log.q, shortest, bounds)
    if len(stops) != len(empty) or not stops:
        times = [f"{stop.begin:.1f} to {stop.end:.1f} s" for stop in stops]
        counts = f"{counted(len(stops), 'rest')}, and {table} has {counted(len(empty), 'row')} without joints"
        advice = "rest in each socket once, and longer than elsewhere: choose "
        end = f", or delete rows that were not measured. Rests: {', '.join(times) or 'none'}"
        text = f"{source}: has {counts}; {advice}", Argument("rest_s"), " and ", Argument("rest_deg"), end
        raise InputError(*text, rests=times, rows=len(empty))
    for cells, stop in zip(empty, stops, strict=True):
        for joint, unit, value in zip(joints, units, stop.q.tolist(), strict=True):
            cells[joint.position] = f"{unit.of(value):.7g}"
    write_atomic(table, csv_text([header, *(row.cells for row in rows)]))
    durations = [stop.end - stop.begin for stop in stops]
    values = {"place": str(table), "n": len(stops), "shortest": {"s": min(durations)}, "longest": {"s": max(durations)}}
    return Finding("seats-filled", values)
