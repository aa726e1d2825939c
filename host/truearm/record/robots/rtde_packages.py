"""Encode and decode packages of Universal Robots' Real-Time Data Exchange (RTDE), protocol version 2.

Based on the manufacturer's public description: "Real-Time Data Exchange (RTDE) Guide", docs.universal-robots.com. Everything is
big-endian. A package consists of its size [2 bytes, including these three], its type [1 byte, a letter] and a payload::

    letter  client → controller                          controller → client
    V       version (2 bytes)                            accepted (1 byte)
    v       –                                            major, minor, bugfix, build (4 bytes each)
    O       frequency [Hz] (double), names with commas   recipe (1 byte; 0: not accepted), types with commas
    S, P    –                                            accepted (1 byte)
    U                                                    recipe (1 byte), the values in the order of the names
    M                                                    length (1 byte), text, length (1 byte), source, level (1 byte: 0 … 3)

S starts the data packages U, P pauses them. A name that the controller does not have gets the type NOT_FOUND.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

VERSION, CONTROLLER, OUTPUTS, START, PAUSE, DATA, TEXT = b"VvOSPUM"
BROKEN = 256  # not a type: data where a package should begin
NOT_FOUND = "NOT_FOUND"

TYPES = {  # a vector is a list
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}

_HEAD = struct.Struct(">HB")

Value = Any  # a number, or a list of them


def package(kind: int, payload: bytes = b"") -> bytes:
    """Return a package as bytes; the payload must fit (65532 bytes)."""
    return _HEAD.pack(_HEAD.size + len(payload), kind) + payload


def request_outputs(names: Sequence[str], frequency_hz: float) -> bytes:
    """Return a request for data packages of these fields; with their commas they may take MAX_NAMES_BYTES."""
    return package(OUTPUTS, struct.pack(">d", frequency_hz) + ",".join(names).encode())


class Packages:
    """Splits bytes that arrive in arbitrary pieces into packages ``(type, payload)``; holds less than 64 kB and one
    piece.

    A size below 3 is invalid. The bytes from there on are returned as BROKEN, then nothing more, and ``broken`` is
    true.
    """

    def __init__(self) -> None:
        self._remainder = b""
        self.broken = False

    def push(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return the packages completed by ``data``."""
        if self.broken:
            return []
        packages: list[tuple[int, bytes]] = []
        data, offset = self._remainder + data, 0
        while offset + _HEAD.size <= len(data):
            size, kind = _HEAD.unpack_from(data, offset)
            if size < _HEAD.size:
                self.broken, self._remainder = True, b""
                return [*packages, (BROKEN, data[offset:])]
            if offset + size > len(data):
                break
            packages.append((kind, data[offset + _HEAD.size : offset + size]))
            offset += size
        self._remainder = data[offset:]
        return packages


@dataclass(frozen=True)
class Recipe:
    """Layout of a data package: the number of the recipe, then the fields; ``places`` are those of their values."""

    number: int
    layout: struct.Struct
    places: Mapping[str, int | slice]

    def values(self, payload: bytes) -> dict[str, Value] | None:
        """Return the values of a data package by name, vectors as lists; None if it does not match this recipe."""
        if len(payload) != self.layout.size or payload[0] != self.number:
            return None
        _, *values = self.layout.unpack(payload)
        return {name: values[place] for name, place in self.places.items()}


def types_of(payload: bytes) -> list[str]:
    """Return the types in an answer to OUTPUTS."""
    return payload[1:].decode(errors="replace").split(",")


def recipe_of(names: Sequence[str], payload: bytes) -> Recipe | None:
    """Return the recipe from the answer to OUTPUTS; None if it is refused or does not match the names."""
    types = types_of(payload)
    if len(types) != len(names) or not payload[0] or not TYPES.keys() >= {*types}:
        return None
    formats = [TYPES[type_] for type_ in types]
    ends = list(accumulate(int(form[:-1] or 1) for form in formats))
    places = {
        name: slice(begin, end) if form[:-1] else begin
        for name, form, begin, end in zip(names, formats, [0, *ends], ends, strict=False)
    }
    return Recipe(payload[0], struct.Struct(f">B{''.join(formats)}"), places)
