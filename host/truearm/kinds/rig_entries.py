"""Rig file entries shared by several kinds of observation: points, and devices that measure points."""

from __future__ import annotations

import re
from typing import Any

from truearm.schema import IDENTIFIER, Entries, Key, SchemaError, Sigmas, Table, Text, keys_of, values_of
from truearm.schema import NAME as SCHEMA_NAME
from truearm.types import SIZE, Device, Point

NAME = Key("name", IDENTIFIER)
EVERY = "*"  # the name of an entry that stands for all names without one
NAME_OR_EVERY = Key("name", Text(pattern=re.compile(rf"{SCHEMA_NAME.pattern}|\*"), wanted=f"{IDENTIFIER.wanted}, or *"))


def by_name(item: Any) -> str:
    """Return the name of a named entry."""
    return str(item.name)


def _device(**values: Any) -> Device:
    device = Device(**values)
    if device.xyz is None and 0.0 in (device.sigma, device.turn_sigma):
        raise SchemaError("an exactly known pose (sigma 0) needs xyz_m (or xyz_mm), and rotation_rad if it is rotated")
    return device


POINT = Table((NAME, *keys_of(Point)), Point)
TARGET_POINT = Table((NAME_OR_EVERY, *keys_of(Point)), Point)
OF_DEVICE = values_of(Device)
DEVICE = Table(
    (
        NAME_OR_EVERY,
        Key("covariance_m2", OF_DEVICE["sensor_cov"], field="sensor_cov"),
        Key("sigma", Sigmas(SIZE, 3), field="sensor_cov"),
        Key("xyz", OF_DEVICE["xyz"], optional=True),
        Key("rotation", OF_DEVICE["rotation"], optional=True),
        Key("position_sigma", OF_DEVICE["sigma"], optional=True, field="sigma"),
        Key("turn_sigma", OF_DEVICE["turn_sigma"], optional=True),
        Key("rotation_sigma", OF_DEVICE["rotation_sigma"], optional=True),
    ),
    _device,
)
SPHERE = Entries("sphere", POINT, "spheres", by_name)
TARGET = Entries("target", TARGET_POINT, "targets", by_name)
