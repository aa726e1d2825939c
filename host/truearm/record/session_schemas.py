"""MCAP encodings and schemas of a session's channels, for other programs (docs/reference/session-format.md).

PlotJuggler looks up every channel's schema. Foxglove reads JSON with a JSON schema in which every property has one
type; it does not support CBOR.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from truearm.session.joint_format import ARRAYS, COLUMNS, JOINTS, READINGS
from truearm.types import BAR_MOUNTED, LINE_MOUNTED
from truearm_wire import messages as wire

PREVIEW = "/preview/"  # followed by a stream's name
ROBOT_PREVIEW = "/robot/preview"
PREVIEW_NS = 100_000_000  # between two values displayed

_INTEGER, _NUMBER, _TEXT, _BOOLEAN = ({"type": name} for name in ("integer", "number", "string", "boolean"))
_NUMBERS = {"type": "array", "items": _NUMBER}
_MOUNTED = dict.fromkeys((*BAR_MOUNTED, "shell", *LINE_MOUNTED), _TEXT)
_LINE = {
    **{"t": _NUMBER, "seq": _INTEGER},
    **dict.fromkeys(("q", *ARRAYS), _NUMBERS),
    **dict.fromkeys(("inputs", "robot_mode", "runtime_state"), _INTEGER),
    **{"line": _TEXT, "arrival": _BOOLEAN},
}
_JSON: dict[str, dict[str, Any]] = {
    "/sync": dict.fromkeys(("id", "t0_ns", "t1_us", "t2_us", "t3_ns"), _INTEGER),
    **dict.fromkeys((JOINTS, ROBOT_PREVIEW), _LINE),
    "/events": {
        "kind": _TEXT,
        **_MOUNTED,
        **dict.fromkeys(("text", "reason", "device"), _TEXT),
        **dict.fromkeys(("begin_ns", "end_ns", "heard_ns", "pose", "lost", "boot_id", "boot_id_before"), _INTEGER),
        **dict.fromkeys(("mean_m", "noise_m", "away_s"), _NUMBER),
        "settled": _BOOLEAN,
    },
    "/plan": {"pose": _INTEGER, "move": _TEXT, **_MOUNTED, "speed_m_s": _NUMBER, "q": _NUMBERS},
}
_FRAMES = (
    *(wire.DATA, wire.EVENT, wire.HEARTBEAT, wire.IDENT, wire.TEMPERATURE, wire.SYNC_REPLY, wire.REPLY, wire.ERROR),
)
_COLUMNS = """; n readings of j joints: those since the last such message
columns = {"arrival_ns": ints, "t": floats, "seq": ints, "q": floats, * text => ints / floats}
floats = #6.86(bytes) ; RFC 8746 float64, little endian
ints = #6.79(bytes)   ; RFC 8746 sint64, little endian
"""
_BYTES = "received bytes that are not a frame or a reading, exactly as they came"


class Encodings(NamedTuple):
    """A channel's encoding, and the name, encoding and data of its schema."""

    message: str
    name: str
    schema: str
    data: str


def encodings_of(topic: str, first: bytes) -> Encodings:
    """Return the encodings of a topic, given its first message."""
    if topic in ("/box/console", "/robot/console"):
        return Encodings("application/octet-stream", "truearm/bytes", "text/plain", _BYTES)
    if topic in (COLUMNS, READINGS):
        return Encodings("cbor", "truearm" + topic, "cddl", _COLUMNS)
    if topic.startswith("/box/"):
        return Encodings("cbor", "truearm" + topic, "cddl", _grammar())
    properties = _JSON.get(topic, {})
    if topic.startswith(PREVIEW):
        properties = dict.fromkeys(json.loads(first), _NUMBER)
    return Encodings("json", "truearm" + topic, "jsonschema", json.dumps({"type": "object", "properties": properties}))


def _grammar() -> str:
    """Return the CDDL (RFC 8610) of a box's frames; protocol/SPEC.md §4 explains them. ``/box/other`` has others too."""
    frames = (
        f"[{', '.join([str(kind), *(f'{name}: any' for name in wire.names(kind)), '* any'])}]" for kind in _FRAMES
    )
    return f"frame = {' / '.join(frames)}\n"
