"""Universal Robots controllers as a joint source: RTDE on port 30004, with readings as lines.

A line holds each number of a data package with all its digits: ``t`` (timestamp: seconds since the controller
started), ``q`` (actual_q), and if the controller has them ``q_cmd`` (target_q), ``qd`` (actual_qd), ``current``
(actual_current [A]), ``inputs`` (actual_digital_input_bits), ``robot_mode`` and ``runtime_state``. Measured and
commanded joints are kept separate: ``target_q`` never replaces ``actual_q``.

RTDE has no sequence numbers. A controller that runs short of time skips packages. This shows in the timestamps, which
are multiples of its cycle. ``seq`` is the time since the first timestamp in periods, so skipped packages are gaps in
``seq``.

The kinematics of the controller come from its primary interface on port 30001 (``kinematics_info()``).
"""

from __future__ import annotations

import json
import math
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

from truearm.errors import InputError, LinkClosed, LinkError
from truearm.record.links import Arrivals, Clock, Link, LinkOnTop, TcpLink, parse_address
from truearm.session.joint_format import MAX_T_S, format_reading

# ------------------------------------------------------------------------------------------------------------- packages
#
# Protocol version 2, based on the manufacturer's public description: "Real-Time Data Exchange (RTDE) Guide",
# docs.universal-robots.com. Everything is big-endian. A package consists of its size [2 bytes, including these three],
# its type [1 byte, a letter] and a payload:
#
#     letter  client → controller                          controller → client
#     V       version (2 bytes)                            accepted (1 byte)
#     v       –                                            major, minor, bugfix, build (4 bytes each)
#     O       frequency [Hz] (double), names with commas   recipe (1 byte; 0: not accepted), types with commas
#     S, P    –                                            accepted (1 byte)
#     U                                                    recipe (1 byte), the values in the order of the names
#     M                                                    length (1 byte), text, length (1), source, level (1 byte)
#
# S starts the data packages U, P pauses them. A name that the controller does not have gets the type NOT_FOUND.

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


def packed(kind: int, payload: bytes = b"") -> bytes:
    """Return a package as bytes; the payload must fit (65532 bytes)."""
    return _HEAD.pack(_HEAD.size + len(payload), kind) + payload


def request_outputs(names: Sequence[str], frequency_hz: float) -> bytes:
    """Return a request for data packages of these fields."""
    return packed(OUTPUTS, struct.pack(">d", frequency_hz) + ",".join(names).encode())


class Packages:
    """Splits bytes that arrive in any pieces into packages ``(type, payload)``; holds less than 64 kB and a piece.

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


# ----------------------------------------------------------------------------------------------------- the joint source

PORT = 30004
ANSWER_NS = 5_000_000_000
MOST_UNASKED = 10_000  # packages before an answer: a controller sends at most ANSWER_NS of data, at 500 Hz
NEEDED = {"timestamp": "DOUBLE", "actual_q": "VECTOR6D"}  # with their types
WANTED = {  # with their keys in a line
    "target_q": "q_cmd",
    "actual_qd": "qd",
    "actual_current": "current",
    "actual_digital_input_bits": "inputs",
    "robot_mode": "robot_mode",
    "runtime_state": "runtime_state",
}
FULL_RATE_HZ = {True: 500.0, False: 125.0}  # key: e-Series or later, i.e. controller software 5 or later
VERSION_BYTES = 16  # major, minor, bugfix and build
EXAMPLE = "rtde://192.168.0.2, with ?hz=125 for a lower rate"


def connect(url: str, clock: Clock, last: Link | None) -> Link:
    """Return a link that continues the ``seq`` of the ``last`` one. Raises as ``RtdeLink`` does."""
    return RtdeLink(url, clock, last.first_s if isinstance(last, RtdeLink) else None)


class RtdeLink(LinkOnTop):
    """Connects, negotiates the fields and starts the stream; ``read`` returns lines. See the module docstring.

    ``first_s``: the timestamp from which ``seq`` counts, taken from an earlier connection; None: the first one
    received. ``url``: ``rtde://host[:port][?hz=125]``. Without ``hz`` the controller's own rate is used: 500 Hz, or 125
    Hz before software 5. Raises InputError for any other url or a rate that does not divide the controller's, LinkError
    if no controller answers or it refuses.
    """

    def __init__(self, url: str, clock: Clock, first_s: float | None = None) -> None:
        host, port, hz = address_of(url)
        address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        super().__init__(TcpLink(f"tcp://{address}", clock, name=url), clock)
        self.numeric = True  # the recorder stores columns in place of lines
        self._packages = Packages()
        self._pending: Arrivals = []  # lines received during the set-up
        self._recipe: Recipe | None = None
        self.first_s = first_s
        try:
            self._set_up(hz)
        except (LinkError, InputError):
            self._link.close()
            raise

    def read(self, timeout_s: float) -> Arrivals:
        lines, self._pending = self._pending, []
        if self._packages.broken and not lines:  # once may be a damaged package: a recording connects again
            raise LinkError(
                f"{self.name}: sends data that are not RTDE; is this port {PORT} of a Universal Robots controller?"
            )
        return lines or [
            (t_host_ns, self._line(*package))
            for t_host_ns, data in self._link.read(timeout_s)
            for package in self._packages.push(data)
        ]

    def close(self) -> None:
        """Pause the stream and close the connection."""
        with suppress(LinkError):
            self._link.write(packed(PAUSE))
        super().close()

    # --- set-up

    def _set_up(self, hz: float | None) -> None:
        if self._ask(VERSION, packed(VERSION, b"\0\2")) != b"\1":
            raise LinkError(f"{self.name}: the controller does not speak version 2 of RTDE; update its software")
        version = self._ask(CONTROLLER, packed(CONTROLLER))
        if len(version) != VERSION_BYTES:
            raise LinkError(f"{self.name}: the controller does not report its version; is this a Universal Robots arm?")
        full_hz = FULL_RATE_HZ[int.from_bytes(version[:4]) >= 5]
        self._hz = hz or full_hz
        if full_hz % self._hz:  # packages would not be evenly spaced, and seq would count wrong
            raise InputError(
                f"{self.name}: give a rate that divides the controller's {full_hz:g} Hz, such as ?hz={full_hz / 4.0:g}"
            )
        self._recipe = self._agree()
        if self._ask(START, packed(START)) != b"\1":
            raise LinkError(f"{self.name}: the controller refuses to send data packages; restart the controller")

    def _agree(self) -> Recipe:
        """Return the recipe of the wanted fields that the controller has."""
        names = [*NEEDED, *WANTED]
        answer = self._ask(OUTPUTS, request_outputs(names, self._hz))
        if NOT_FOUND in (types := types_of(answer)):
            names = [name for name, type_ in zip(names, types, strict=False) if type_ != NOT_FOUND]
            answer = self._ask(OUTPUTS, request_outputs(names, self._hz)) if {*NEEDED} <= {*names} else answer
        recipe = recipe_of(names, answer)
        if recipe is None or types_of(answer)[: len(NEEDED)] != list(NEEDED.values()):
            raise LinkError(
                f"{self.name}: the controller refuses the fields {', '.join(names)} ({answer[1:201]!r}); update its software"
            )
        return recipe

    def _ask(self, kind: int, request: bytes) -> bytes:
        """Return the payload of the answer to a request; other packages wait. Raises LinkError if there is none."""
        self._link.write(request)
        answer, deadline_ns = None, self._clock.now_ns() + ANSWER_NS
        while answer is None and not self._packages.broken and self._clock.now_ns() < deadline_ns:
            try:
                arrivals = self._link.read(0.1)
            except LinkClosed as exc:
                raise LinkError(
                    f"{self.name}: the controller closed the connection; is RTDE enabled in its settings?"
                ) from exc
            for t_host_ns, data in arrivals:
                for package in self._packages.push(data):
                    if package[0] == kind and answer is None:
                        answer = package[1]
                    else:
                        self._pending.append((t_host_ns, self._line(*package)))
            if len(self._pending) > MOST_UNASKED:
                break
        if answer is None:
            raise LinkError(
                f"{self.name}: no answer to RTDE's {chr(kind)!r}; is this port {PORT} of a Universal Robots controller?"
            )
        return answer

    # --- packages → lines

    def _line(self, kind: int, payload: bytes) -> bytes:
        """Return a reading, or a line with the type and payload of any other package, byte by byte (Latin-1).

        The recorder keeps the latter in ``/robot/console``. A package with all fields takes about 5 µs, at 500 per
        second.
        """
        values = self._recipe.values(payload) if kind == DATA and self._recipe is not None else None
        # JSON has no others
        if values is not None and all(map(math.isfinite, (values["timestamp"], *values["actual_q"]))):
            return self._reading(**values) + b"\n"
        return json.dumps({"rtde": kind, "payload": payload.decode("latin-1")}).encode() + b"\n"

    def _reading(self, timestamp: float, actual_q: list[float], **values: Value) -> bytes:
        seq = None
        if 0.0 <= timestamp < MAX_T_S:  # else it is not a reading and cannot start the count
            self.first_s = timestamp if self.first_s is None else min(timestamp, self.first_s)
            seq = round((timestamp - self.first_s) * self._hz)
        return format_reading(timestamp, seq, actual_q, **{WANTED[name]: value for name, value in values.items()})


def address_of(url: str) -> tuple[str, int, float | None]:
    """Return host, port and rate of an address. Raises InputError."""
    host, port, options = parse_address(url, "rtde", PORT, with_options=True)
    hz = options.pop("hz", None)
    if options or not (hz is None or (hz.replace(".", "", 1).isdecimal() and 1.0 <= float(hz) <= 500.0)):
        raise InputError("wrong-value", place="address", value=url, form=EXAMPLE)
    return host, port, None if hz is None else float(hz)


# ------------------------------------------------------------------------------------------------ the primary interface

PRIMARY_PORT = 30001
CONNECT_S, ANSWER_S = 2.0, 5.0
PRIMARY_HEAD = 5  # bytes: size and type
MAX_PACKAGE = 65536  # bytes; of a robot's state 1,500
ROBOT_STATE, KINEMATICS = b"\x10", 5


def kinematics_info(url: str) -> bytes:
    """Return the content of KinematicsInfo of the controller at ``rtde://host``. Raises InputError, LinkError.

    The controller sends packages (size int32, type uint8, content). Packages of type 16 contain sub-packages (size
    uint32, type uint8, content). The first package after a connection contains the sub-package KinematicsInfo, type 5.
    Nothing is sent to the controller.
    """
    host, _, _ = address_of(url)
    wrong = LinkError(
        f"{url}: port {PRIMARY_PORT} sends no data of a primary interface; is it enabled, and {host} a Universal Robots controller?"
    )
    try:
        with (
            socket.create_connection((host, PRIMARY_PORT), CONNECT_S) as connection,
            connection.makefile("rb") as stream,
        ):
            connection.settimeout(ANSWER_S)
            end = time.monotonic() + ANSWER_S
            while time.monotonic() < end:
                head = stream.read(PRIMARY_HEAD)
                package = stream.read(min(max(0, int.from_bytes(head[:4]) - PRIMARY_HEAD), MAX_PACKAGE))
                contents = sub_packages(package) if head[4:] == ROBOT_STATE else {}
                if PRIMARY_HEAD + len(package) != int.from_bytes(head[:4]) or contents is None:
                    raise wrong
                if KINEMATICS in contents:
                    return contents[KINEMATICS]
    except OSError as exc:
        if not isinstance(exc, TimeoutError):
            raise LinkError(
                f"{url}: cannot read port {PRIMARY_PORT} ({exc.strerror or exc}); check address and network"
            ) from exc
    raise LinkError(f"{url}: the controller sent no kinematics on port {PRIMARY_PORT}; check address and network")


def sub_packages(package: bytes) -> dict[int, bytes] | None:
    """Return the contents of sub-packages by type; None unless their sizes add up."""
    contents = {}
    while package:
        size = int.from_bytes(package[:4])
        if not PRIMARY_HEAD <= size <= len(package):
            return None
        contents[package[4]], package = package[PRIMARY_HEAD:size], package[size:]
    return contents
