"""Rig files: TOML that says what stands around the robot (docs/table-format.md).

Each entry is declared once, by a ``Table``: its keys, and what they make. The file is read and written by it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from truearm.errors import RigError
from truearm.files.disk import parse_toml, read_text, write_atomic
from truearm.schema import (
    HUGE,
    IDENTIFIER,
    Choice,
    Covariance,
    Entries,
    Key,
    List,
    Number,
    SchemaError,
    Sigmas,
    Table,
    read,
    sigma,
)
from truearm.types import BallBar, Device, Plane, Point, Rig, SocketDistance

MAX_BYTES = 2**20
NAME = Key("name", IDENTIFIER)
SIZE = Number("m", positive=True)
XYZ = List(Number("m"), 3)


class Socket(NamedTuple):
    """A socket, and the place that it stands at."""

    point: Point
    place: str = ""


def _socket(place: str = "", **point: Any) -> Socket:
    return Socket(Point(**point), place)


def _socket_distance(sockets: tuple[str, str], distance: float, sigma: float) -> SocketDistance:
    if sockets[0] == sockets[1]:
        raise SchemaError(f"the distance of socket {sockets[0]!r} from itself is no measurement")
    return SocketDistance(sockets, distance, sigma)


def _device(**values: Any) -> Device:
    device = Device(**values)
    if device.xyz is None and 0.0 in (device.sigma, device.turn_sigma):
        raise SchemaError("a pose known exactly (sigma 0) needs xyz_m (or xyz_mm), and rotation_rad if turned")
    return device


def _plane(**values: Any) -> Plane:
    plane = Plane(**values)
    if not any(plane.normal):
        raise SchemaError("normal must not be zero; [0, 0, 1] is that of a table seen from above")
    return plane


POINT = Table((NAME, Key("xyz", XYZ), Key("sigma", sigma("m", unknown=True), optional=True)), Point)
BAR = Table(
    (
        NAME,
        Key("zero", SIZE),
        Key("gain", Number("1", positive=True), optional=True),
        Key("travel", SIZE),
        Key("sigma", SIZE),
        Key("zero_sigma", sigma("m"), optional=True),
        Key("gain_sigma", sigma("1"), optional=True),
    ),
    lambda gain=1.0, **values: BallBar(gain=gain, **values),
)
SOCKET = Table(
    (Key("place", IDENTIFIER, optional=True), *POINT.keys),
    _socket,
    lambda socket: {"place": socket.place, **vars(socket.point)},
)
SOCKET_DISTANCE = Table(
    (Key("sockets", List(IDENTIFIER, 2)), Key("distance", SIZE), Key("sigma", SIZE)), _socket_distance
)
DEVICE = Table(
    (
        NAME,
        Key("covariance_m2", Covariance(3), field="sensor_cov"),
        Key("sigma", Sigmas(SIZE, 3), field="sensor_cov"),
        Key("xyz", XYZ, optional=True),
        Key("rotation", List(Number("rad"), 3), optional=True),
        Key("position_sigma", sigma("m", unknown=True), optional=True, field="sigma"),
        Key("turn_sigma", sigma("rad", unknown=True), optional=True),
        Key("rotation_sigma", Number("rad", positive=True), optional=True),
    ),
    _device,
)
PLANE = Table(
    (
        NAME,
        Key("xyz", XYZ),
        Key("normal", List(Number("1", most=HUGE), 3)),
        Key("sigma", SIZE),
        Key("offset_sigma", sigma("m", unknown=True), optional=True),
        Key("tilt_sigma", sigma("rad", unknown=True), optional=True),
    ),
    _plane,
)
JOINT_COVARIANCE = (
    Key("joint_cov_si", Covariance(singular=True), optional=True, field="joint_cov"),
    Key("joint_sigma", Sigmas(sigma("rad")), optional=True, field="joint_cov"),
)


def by_name(item: Any) -> str:
    """The name of a named thing."""
    return str(item.name)


def _rig(sockets: Mapping[tuple[str, str], Socket] | None = None, **values: Any) -> Rig:
    return Rig(sockets={key: socket.point for key, socket in (sockets or {}).items()}, **values)


def _values(rig: Rig) -> dict[str, Any]:
    return {**vars(rig), "sockets": {key: Socket(point, key[0]) for key, point in rig.sockets.items()}}


RIG = Table(
    (
        Key("seat_sigma", SIZE, optional=True),
        Key("line_sigma", List(SIZE, 3), optional=True),
        Key("line_placement", Choice(("least_squares", "two_point")), optional=True),
        Key("time_offset", Number("s"), optional=True),
        Key("time_offset_sigma", sigma("s", unknown=True), optional=True),
        Key("line_travel", SIZE, optional=True),
        *JOINT_COVARIANCE,
    ),
    _rig,
    _values,
    (
        Entries("chuck", POINT, "chucks", by_name),
        Entries("sphere", POINT, "spheres", by_name),
        Entries("bar", BAR, "bars", by_name),
        Entries("socket", SOCKET, "sockets", lambda socket: (socket.place, socket.point.name)),
        Entries("socket_distance", SOCKET_DISTANCE, "socket_distances"),
        Entries("target", POINT, "targets", by_name),
        Entries("line", DEVICE, "lines", by_name),
        Entries("tracker", DEVICE, "trackers", by_name),
        Entries("plane", PLANE, "planes", by_name),
    ),
)


def read_rig(path: Path) -> Rig:
    """Read a rig file. Raises RigError that names the file, the entry and the key."""
    return parse_rig(read_text(path, MAX_BYTES, RigError), str(path))


def parse_rig(text: str, name: str) -> Rig:
    """Parse the text of a rig file; ``name`` stands for the file in messages. See ``read_rig``."""
    return read(RIG, parse_toml(text, name, RigError), name, RigError)


def format_rig(rig: Rig) -> str:
    """The text of a rig file, in metres so that every number comes back bit for bit."""
    return RIG.format(rig)


def write_rig(path: Path, rig: Rig) -> None:
    """Write a rig file that ``read_rig`` reads back exactly. Raises InputError."""
    write_atomic(path, format_rig(rig))
