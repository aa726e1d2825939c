"""Rig file entries shared by several kinds of observation: points, and devices that measure points."""

from __future__ import annotations

from typing import Any

from truearm.schema import IDENTIFIER, Covariance, Entries, Key, List, Number, SchemaError, Sigmas, Table, sigma
from truearm.types import Device, Point

NAME = Key("name", IDENTIFIER)
SIZE = Number("m", positive=True)
XYZ = List(Number("m"), 3)


def by_name(item: Any) -> str:
    """Return the name of a named entry."""
    return str(item.name)


def _device(**values: Any) -> Device:
    device = Device(**values)
    if device.xyz is None and 0.0 in (device.sigma, device.turn_sigma):
        raise SchemaError("an exactly known pose (sigma 0) needs xyz_m (or xyz_mm), and rotation_rad if it is rotated")
    return device


POINT = Table((NAME, Key("xyz", XYZ), Key("sigma", sigma("m", unknown=True), optional=True)), Point)
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
SPHERE = Entries("sphere", POINT, "spheres", by_name)
TARGET = Entries("target", POINT, "targets", by_name)
