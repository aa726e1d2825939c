"""What a box says about itself (SPEC §5): pages joined within bounds, the document checked and kept whole."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import cbor2

from truearm.errors import ProtocolError
from truearm_wire.messages import PAGE_BYTES, PAGES_MAX

PROTOCOL_MAJOR = 1
MAX_STREAMS = 16
MAX_CHANNELS = 32
_MAX_DEPTH = 16

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}")
# A stream of such a name would share its topic with the frames of that kind.
RESERVED_NAMES = frozenset({"event", "heartbeat", "ident", "sync", "reply", "other", "console"})


@dataclass(frozen=True)
class Stream:
    """One stream of a box: its topic is ``/box/<name>``. ``period_ns`` and ``group_delay_ns`` belong to ``osr``."""

    id: int
    name: str
    period_ns: int
    osr: int
    group_delay_ns: int
    n_channels: int


@dataclass(frozen=True)
class Ident:
    """A box: ``document`` is the whole of what it said, fit for JSON (bytes as hexadecimal text)."""

    firmware: str
    uid: str
    boot_id: int
    streams: Mapping[int, Stream]
    document: Mapping[str, Any] = field(repr=False)


class Pages:
    """Joins the pages of one document at a time."""

    def __init__(self) -> None:
        self._key: tuple[int, int] | None = None  # req_id and number of pages of the document being joined
        self._parts: list[bytes] = []

    def push(self, req_id: int, page: int, pages: int, data: bytes) -> bytes | None:
        """The document, when this page completes it. A page out of order drops the document; a doubled one does not."""
        if not 1 <= pages <= PAGES_MAX or page >= pages or len(data) > PAGE_BYTES:
            return None
        if page == 0:
            self._key, self._parts = (req_id, pages), []
        if self._key != (req_id, pages) or page > len(self._parts):
            self._key = None
            return None
        self._parts[page:] = [data]
        if len(self._parts) < pages:
            return None
        self._key = None
        return b"".join(self._parts)


def parse_ident(data: bytes) -> Ident:
    """Check an ident document. Raises ProtocolError; unknown keys and a newer minor version are accepted."""
    try:
        document = cbor2.loads(data, max_depth=_MAX_DEPTH)
    except cbor2.CBORError as exc:
        raise ProtocolError(f"the box's description of itself cannot be decoded ({exc}); update its firmware") from exc
    if not isinstance(document, dict):
        raise ProtocolError("the box's description of itself is no map; update its firmware")
    _check_protocol(document.get("protocol"))
    return Ident(
        firmware=_get(document, "firmware", str),
        uid=_get(document, "uid", bytes).hex(),
        boot_id=_get(document, "boot_id", int),
        streams=_streams(_get(document, "streams", list)),
        document=_plain(document),
    )


def _check_protocol(version: Any) -> None:
    if not isinstance(version, list) or len(version) < 2 or not all(type(v) is int for v in version):
        raise ProtocolError("the box does not say which protocol it speaks; update its firmware")
    if version[0] != PROTOCOL_MAJOR:
        side = "truearm" if version[0] > PROTOCOL_MAJOR else "the box's firmware"
        raise ProtocolError(
            f"the box speaks protocol {version[0]}.{version[1]}, this truearm {PROTOCOL_MAJOR}.x; update {side}"
        )


def _streams(entries: list[Any]) -> dict[int, Stream]:
    if not 1 <= len(entries) <= MAX_STREAMS or not all(isinstance(entry, dict) for entry in entries):
        raise ProtocolError(f"the box describes {len(entries)} streams; 1 to {MAX_STREAMS} maps are expected")
    streams = [_stream(entry) for entry in entries]
    if len({s.id for s in streams}) < len(streams) or len({s.name for s in streams}) < len(streams):
        raise ProtocolError("two streams of the box share an id or a name; update its firmware")
    return {stream.id: stream for stream in streams}


def _stream(entry: dict[str, Any]) -> Stream:
    name = _get(entry, "name", str)
    if not _NAME.fullmatch(name) or name in RESERVED_NAMES:
        raise ProtocolError(f"the box names a stream {name[:40]!r}, which cannot be a topic; update its firmware")
    channels = _get(entry, "channels", list)
    if not 1 <= len(channels) <= MAX_CHANNELS:
        raise ProtocolError(f"stream {name} has {len(channels)} channels; 1 to {MAX_CHANNELS} are expected")
    numbers = {key: _get(entry, key, int) for key in ("id", "period_ns", "osr", "group_delay_ns")}
    return Stream(name=name, n_channels=len(channels), **numbers)


def _get(table: Mapping[str, Any], key: str, kind: type) -> Any:
    value = table.get(key)
    if type(value) is not kind or (isinstance(value, int) and not 0 <= value < 2**64):
        raise ProtocolError(f"the box's description of itself has no usable {key!r}; update its firmware")
    return value


def _plain(value: Any) -> Any:
    """``value`` as JSON can hold it."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if value is None or isinstance(value, str | bool | int) else str(value)
