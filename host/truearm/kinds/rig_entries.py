"""Entries of rig files that several kinds of observation share: points, and devices that measure points."""

from __future__ import annotations

from typing import Any

from truearm.schema import IDENTIFIER, Covariance, Entries, Key, List, Number, SchemaError, Sigmas, Table, sigma
from truearm.types import Device, Point

NAME = Key("name", IDENTIFIER)
SIZE = Number("m", positive=True)
XYZ = List(Number("m"), 3)


def by_name(item: Any) -> str:
    """The name of a named thing."""
    return str(item.name)


def _device(**values: Any) -> Device:
    device = Device(**values)
    if device.xyz is None and 0.0 in (device.sigma, device.turn_sigma):
        raise SchemaError("a pose known exactly (sigma 0) needs xyz_m (or xyz_mm), and rotation_rad if turned")
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
