"""Rig files: TOML that says what stands around the robot (docs/table-format.md).

Every length may be written ``…_m`` or ``…_mm``. A misspelt key would silently take its default, so unknown keys are
errors.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from truearm.errors import RigError
from truearm.files.disk import parse_toml, read_text, write_atomic
from truearm.types import BallBar, Point, Rig, SocketDistance

MAX_BYTES = 2**20
HUGE = 1e12
LARGEST = 100.0  # m; a longer one was written in mm

_NAME = re.compile(r"[\w-]{1,64}")
_T = TypeVar("_T", Point, BallBar)


def read_rig(path: Path) -> Rig:
    """Read a rig file. Raises RigError that names the file, the entry and the key."""
    return parse_rig(read_text(path, MAX_BYTES, RigError), str(path))


def parse_rig(text: str, name: str) -> Rig:
    """Parse the text of a rig file; ``name`` stands for the file in messages. See ``read_rig``."""
    data = parse_toml(text, name, RigError)
    _check_keys(data, {"chuck", "sphere", "bar", "socket_distance", "seat_sigma_m", "seat_sigma_mm"}, name)
    seat_sigma = _length(data, "seat_sigma", name, default=Rig().seat_sigma)
    return Rig(
        chucks=_named(_entries(data, "chuck", name), _point),
        spheres=_named(_entries(data, "sphere", name), _point),
        bars=_named(_entries(data, "bar", name), _bar),
        socket_distances=tuple(_socket_distance(*entry) for entry in _entries(data, "socket_distance", name)),
        seat_sigma=_positive(seat_sigma, "seat_sigma", name),
    )


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
        item = build(table, _name(table, where), where)
        if item.name in result:
            raise RigError(f"{where}: the name {item.name!r} stands twice; give each its own")
        result[item.name] = item
    return result


def _point(table: Mapping[str, Any], name: str, where: str) -> Point:
    _check_keys(table, {"name", "xyz_m", "xyz_mm", "sigma_m", "sigma_mm"}, where)
    x, y, z = _coordinates(table, where)
    unknown = _in_metres(table, "sigma", where, 0.0)[0] == "unknown"
    return Point(name, (x, y, z), None if unknown else _length(table, "sigma", where, default=0.0, smallest=0.0))


def _bar(table: Mapping[str, Any], name: str, where: str) -> BallBar:
    lengths = ("zero", "travel", "sigma", "zero_sigma")
    _check_keys(table, {"name", "gain", "gain_sigma", *(f"{q}_{u}" for q in lengths for u in ("m", "mm"))}, where)
    return BallBar(
        name=name,
        zero=_positive(_length(table, "zero", where), "zero", where),
        gain=_positive(_number(table.get("gain", 1.0), "gain", where), "gain", where),
        travel=_positive(_length(table, "travel", where), "travel", where),
        sigma=_positive(_length(table, "sigma", where), "sigma", where),
        zero_sigma=_length(table, "zero_sigma", where, default=0.0, smallest=0.0),
        gain_sigma=_within(_number(table.get("gain_sigma", 0.0), "gain_sigma", where), 0.0, "gain_sigma", where),
    )


def _socket_distance(table: Mapping[str, Any], where: str) -> SocketDistance:
    keys = {f"{q}_{u}" for q in ("distance", "sigma") for u in ("m", "mm")}
    _check_keys(table, {"sockets", *keys}, where)
    sockets = table.get("sockets")
    if not isinstance(sockets, list) or len(sockets) != 2 or not all(_is_name(socket) for socket in sockets):
        raise RigError(f'{where}: sockets must be two names as in the table, such as ["0", "1"]')
    if sockets[0] == sockets[1]:
        raise RigError(f"{where}: the distance of socket {sockets[0]!r} from itself is no measurement")
    distance = _positive(_length(table, "distance", where), "distance", where)
    return SocketDistance((sockets[0], sockets[1]), distance, _positive(_length(table, "sigma", where), "sigma", where))


def _check_keys(table: Mapping[str, Any], known: set[str], where: str) -> None:
    for key in table:
        if key not in known:
            raise RigError(f"{where}: unknown key {key[:40]!r}; known are {', '.join(sorted(known))}")


def _is_name(value: object) -> bool:
    return isinstance(value, str) and _NAME.fullmatch(value) is not None


def _name(table: Mapping[str, Any], where: str) -> str:
    name = table.get("name")
    if not isinstance(name, str) or not _is_name(name):
        raise RigError(f"{where}: needs a name of up to 64 letters, digits, '-' and '_', as in the table")
    return name


def _length(
    table: Mapping[str, Any], quantity: str, where: str, default: float | None = None, smallest: float = -LARGEST
) -> float:
    """The length written as ``quantity_m`` or ``quantity_mm``, in metres."""
    value = _in_metres(table, quantity, where, default)
    return _within(_number(value[0], quantity, where) * value[1], smallest, quantity, where)


def _in_metres(table: Mapping[str, Any], quantity: str, where: str, default: object = None) -> tuple[Any, float]:
    """The raw value of a quantity and the factor that makes it metres."""
    metres, millimetres = f"{quantity}_m", f"{quantity}_mm"
    if metres in table and millimetres in table:
        raise RigError(f"{where}: has both {metres} and {millimetres}; keep one")
    if metres in table:
        return table[metres], 1.0
    if millimetres in table:
        return table[millimetres], 1e-3
    if default is None:
        raise RigError(f"{where}: needs {metres} (or {millimetres})")
    return default, 1.0


def _coordinates(table: Mapping[str, Any], where: str) -> list[float]:
    value, scale = _in_metres(table, "xyz", where)
    if not isinstance(value, list) or len(value) != 3:
        raise RigError(f"{where}: xyz must be three numbers")
    return [_within(_number(v, "xyz", where) * scale, -LARGEST, "xyz", where) for v in value]


def _number(value: object, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        shown = repr(value[:40]) if isinstance(value, str) else f"of type {type(value).__name__}"
        raise RigError(f"{where}: {key} must be a number, is {shown}")
    if not abs(value) <= HUGE:  # NaN too; an integer of a thousand digits has no float and no text
        raise RigError(f"{where}: {key} must be a finite number of reasonable size")
    return float(value)


def _within(value: float, smallest: float, key: str, where: str) -> float:
    if not smallest <= value <= LARGEST:
        raise RigError(f"{where}: {key} must lie between {smallest:g} and {LARGEST:g} (SI units), is {value:g}")
    return value


def _positive(value: float, key: str, where: str) -> float:
    if value <= 0.0:
        raise RigError(f"{where}: {key} must be greater than 0, is {value:g}")
    return value


def format_rig(rig: Rig) -> str:
    """The text of a rig file, in metres so that every number comes back bit for bit."""
    blocks = [f"seat_sigma_m = {rig.seat_sigma!r}"]
    blocks += [_point_text("chuck", point) for point in rig.chucks.values()]
    blocks += [_point_text("sphere", point) for point in rig.spheres.values()]
    blocks += [_bar_text(bar) for bar in rig.bars.values()]
    blocks += [_socket_distance_text(distance) for distance in rig.socket_distances]
    return "\n\n".join(blocks) + "\n"


def _point_text(key: str, point: Point) -> str:
    sigma = '"unknown"' if point.sigma is None else repr(float(point.sigma))
    return f"[[{key}]]\nname = {json.dumps(point.name)}\nxyz_m = {[float(v) for v in point.xyz]}\nsigma_m = {sigma}"


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
