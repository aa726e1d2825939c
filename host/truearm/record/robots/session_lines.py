"""Lines of JSON over TCP that are already in the session format (docs/reference/session-format.md): stored as received."""

from __future__ import annotations

from truearm.record.links import Clock, Link, TcpLink


def connect(url: str, clock: Clock, last: Link | None) -> Link:
    """Return the link to ``tcp://HOST:PORT``. Raises InputError, LinkError."""
    return TcpLink(url, clock)
