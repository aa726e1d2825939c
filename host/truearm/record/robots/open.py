"""Which joint source an address names."""

from __future__ import annotations

from truearm.errors import InputError
from truearm.record.links import Clock, Link, TcpLink
from truearm.record.robots.lines import open_lines
from truearm.record.robots.rtde import RtdeLink

SCHEMES = ("tcp", "rtde", "lines+tcp", "lines+udp")


def open_source(url: str, clock: Clock) -> Link:
    """The joint source behind an address.

    Raises InputError for an address that is none, LinkError where nobody answers.
    """
    scheme, separator, _ = url.partition("://")
    if not separator or scheme not in SCHEMES:
        known = ", ".join(f"{name}://" for name in SCHEMES)
        raise InputError(f"{url!r} is no address of a robot; it begins with one of {known}")
    if scheme == "rtde":
        return RtdeLink(url, clock)
    if scheme == "tcp":
        return TcpLink(url, clock)
    return open_lines(url, clock)
