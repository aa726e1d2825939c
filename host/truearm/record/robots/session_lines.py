"""Lines of JSON over TCP that are already as a session has them (docs/session-format.md): stored as they come."""

from __future__ import annotations

from truearm.record.links import Clock, Link, TcpLink


def connect(url: str, clock: Clock, last: Link | None) -> Link:
    """Return the link to ``tcp://HOST:PORT``. Raises InputError, LinkError."""
    return TcpLink(url, clock)
