"""Rig files: TOML that says what stands around the robot (docs/table-format.md).

Every length may be written ``…_m`` or ``…_mm``. A misspelt key would silently take its default, so unknown keys are
errors.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from truearm.errors import RigError
from truearm.files.disk import parse_toml, read_text, write_atomic
from truearm.files.rig_devices import (
    device,
    device_text,
    joint_cov,
    matrix_text,
    numbers,
    plane,
    plane_text,
    sigma_text,
)
from truearm.files.rig_values import (
    LARGEST,
    check_keys,
    in_si,
    is_name,
    keys,
    length,
    name_of,
    number,
    positive,
    sigma_or_unknown,
    three,
    within,
)
from truearm.types import BallBar, Device, Plane, Point, Rig, SocketDistance

MAX_BYTES = 2**20
SECONDS = {"s": 1.0, "ms": 1e-3}
PLACEMENTS = ("least_squares", "two_point")
ENTRIES = {"chuck", "sphere", "bar", "socket", "socket_distance", "target", "line", "tracker", "plane"}
TOP_LEVEL = {
    *keys(("seat_sigma", "line_sigma", "line_travel")),
    *keys(("time_offset", "time_offset_sigma"), SECONDS),
    *("line_placement", "joint_sigma_rad", "joint_sigma_deg", "joint_cov_si"),
}
_T = TypeVar("_T", Point, BallBar, Device, Plane)


def read_rig(path: Path) -> Rig:
    """Read a rig file. Raises RigError that names the file, the entry and the key."""
    return parse_rig(read_text(path, MAX_BYTES, RigError), str(path))


def parse_rig(text: str, name: str) -> Rig:
    """Parse the text of a rig file; ``name`` stands for the file in messages. See ``read_rig``."""
    data = parse_toml(text, name, RigError)
    check_keys(data, ENTRIES | TOP_LEVEL, name)
    default = Rig()
    seat_sigma = length(data, "seat_sigma", name, default=default.seat_sigma)
    placement = data.get("line_placement", default.line_placement)
    if placement not in PLACEMENTS:
        raise RigError(f"{name}: line_placement must be {' or '.join(map(repr, PLACEMENTS))}")
    line_sigma = three(data, "line_sigma", name, default=default.line_sigma)
    positive(min(line_sigma), "line_sigma", name)
    offset, seconds = in_si(data, "time_offset", name, SECONDS, default.time_offset)
    return Rig(
        chucks=_named(_entries(data, "chuck", name), _point),
        spheres=_named(_entries(data, "sphere", name), _point),
        bars=_named(_entries(data, "bar", name), _bar),
        socket_distances=tuple(_socket_distance(*entry) for entry in _entries(data, "socket_distance", name)),
        seat_sigma=positive(seat_sigma, "seat_sigma", name),
        targets=_named(_entries(data, "target", name), _point),
        lines=_named(_entries(data, "line", name), device),
        line_sigma=line_sigma,
        line_placement=placement,
        line_travel=_line_travel(data, name),
        trackers=_named(_entries(data, "tracker", name), device),
        planes=_named(_entries(data, "plane", name), plane),
        time_offset=within(number(offset, "time_offset", name) * seconds, -LARGEST, "time_offset", name),
        time_offset_sigma=sigma_or_unknown(data, "time_offset_sigma", name, "unknown", SECONDS),
        joint_cov=joint_cov(data, name),
        sockets=_sockets(_entries(data, "socket", name)),
    )


def _line_travel(data: Mapping[str, Any], name: str) -> float | None:
    if not keys(("line_travel",)) & data.keys():
        return None
    return positive(length(data, "line_travel", name), "line_travel", name)


def _entries(data: Mapping[str, Any], key: str, name: str) -> list[tuple[Mapping[str, Any], str]]:
    """The tables of ``[[key]]``, each with the words that name it in messages."""
    tables = data.get(key, [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise RigError(f"{name}: {key} must be written as [[{key}]] entries")
    return [(table, f"{name}: [[{key}]] {i}") for i, table in enumerate(tables, start=1)]


def _named(
    entries: list[tuple[Mapping[str, Any], str]], build: Callable[[Mapping[str, Any], str, str], _T]
) -> dict[str, _T]:
    result: dict[str, _T] = {}
    for table, where in entries:
        item = build(table, name_of(table, where), where)
        if item.name in result:
            raise RigError(f"{where}: the name {item.name!r} stands twice; give each its own")
        result[item.name] = item
    return result


def _sockets(entries: list[tuple[Mapping[str, Any], str]]) -> dict[tuple[str, str], Point]:
    result: dict[tuple[str, str], Point] = {}
    for table, where in entries:
        place, name = table.get("place", ""), name_of(table, where)
        if place != "" and not is_name(place):
            raise RigError(f"{where}: place must be a name as in the table")
        if (place, name) in result:
            raise RigError(f"{where}: socket {name!r} of place {place!r} stands twice")
        result[place, name] = _point({k: v for k, v in table.items() if k != "place"}, name, where)
    return result


def _point(table: Mapping[str, Any], name: str, where: str) -> Point:
    check_keys(table, {"name"} | keys(("xyz", "sigma")), where)
    return Point(name, three(table, "xyz", where), sigma_or_unknown(table, "sigma", where, 0.0))


def _bar(table: Mapping[str, Any], name: str, where: str) -> BallBar:
    check_keys(table, {"name", "gain", "gain_sigma"} | keys(("zero", "travel", "sigma", "zero_sigma")), where)
    return BallBar(
        name=name,
        zero=positive(length(table, "zero", where), "zero", where),
        gain=positive(number(table.get("gain", 1.0), "gain", where), "gain", where),
        travel=positive(length(table, "travel", where), "travel", where),
        sigma=positive(length(table, "sigma", where), "sigma", where),
        zero_sigma=length(table, "zero_sigma", where, default=0.0, smallest=0.0),
        gain_sigma=within(number(table.get("gain_sigma", 0.0), "gain_sigma", where), 0.0, "gain_sigma", where),
    )


def _socket_distance(table: Mapping[str, Any], where: str) -> SocketDistance:
    check_keys(table, {"sockets"} | keys(("distance", "sigma")), where)
    sockets = table.get("sockets")
    if not isinstance(sockets, list) or len(sockets) != 2 or not all(is_name(socket) for socket in sockets):
        raise RigError(f'{where}: sockets must be two names as in the table, such as ["0", "1"]')
    if sockets[0] == sockets[1]:
        raise RigError(f"{where}: the distance of socket {sockets[0]!r} from itself is no measurement")
    distance = positive(length(table, "distance", where), "distance", where)
    return SocketDistance((sockets[0], sockets[1]), distance, positive(length(table, "sigma", where), "sigma", where))


def format_rig(rig: Rig) -> str:
    """The text of a rig file, in metres so that every number comes back bit for bit."""
    blocks = [_top_text(rig)]
    blocks += [_point_text("chuck", point) for point in rig.chucks.values()]
    blocks += [_point_text("sphere", point) for point in rig.spheres.values()]
    blocks += [_bar_text(bar) for bar in rig.bars.values()]
    blocks += [_point_text("socket", point, place) for (place, _), point in rig.sockets.items()]
    blocks += [_socket_distance_text(distance) for distance in rig.socket_distances]
    blocks += [_point_text("target", point) for point in rig.targets.values()]
    blocks += [device_text("line", line) for line in rig.lines.values()]
    blocks += [device_text("tracker", tracker) for tracker in rig.trackers.values()]
    blocks += [plane_text(flat) for flat in rig.planes.values()]
    return "\n\n".join(blocks) + "\n"


def _top_text(rig: Rig) -> str:
    lines = [
        f"seat_sigma_m = {float(rig.seat_sigma)!r}",
        f"line_sigma_m = {numbers(rig.line_sigma)}",
        f"line_placement = {json.dumps(rig.line_placement)}",
        f"time_offset_s = {float(rig.time_offset)!r}",
        f"time_offset_sigma_s = {sigma_text(rig.time_offset_sigma)}",
    ]
    if rig.line_travel is not None:
        lines.append(f"line_travel_m = {float(rig.line_travel)!r}")
    if rig.joint_cov:
        lines.append(f"joint_cov_si = {matrix_text(rig.joint_cov)}")
    return "\n".join(lines)


def _point_text(key: str, point: Point, place: str = "") -> str:
    lines = [f"[[{key}]]", *([f"place = {json.dumps(place)}"] if place else []), f"name = {json.dumps(point.name)}"]
    return "\n".join([*lines, f"xyz_m = {numbers(point.xyz)}", f"sigma_m = {sigma_text(point.sigma)}"])


def _bar_text(bar: BallBar) -> str:
    lines = [f"{q}_m = {float(getattr(bar, q))!r}" for q in ("zero", "travel", "sigma", "zero_sigma")]
    lines += [f"{q} = {float(getattr(bar, q))!r}" for q in ("gain", "gain_sigma")]
    return "\n".join(["[[bar]]", f"name = {json.dumps(bar.name)}", *lines])


def _socket_distance_text(distance: SocketDistance) -> str:
    sockets = json.dumps(list(distance.sockets))
    sizes = f"distance_m = {float(distance.distance)!r}\nsigma_m = {float(distance.sigma)!r}"
    return f"[[socket_distance]]\nsockets = {sockets}\n{sizes}"


def write_rig(path: Path, rig: Rig) -> None:
    """Write a rig file that ``read_rig`` reads back exactly. Raises InputError."""
    write_atomic(path, format_rig(rig))
