"""Which joint source an address names."""

from __future__ import annotations

from truearm.errors import InputError
from truearm.record.links import Clock, Link, TcpLink
from truearm.record.reopening import Reopening
from truearm.record.robots.rtde import RtdeLink
from truearm.record.robots.text_lines import LinesLink, open_lines

SCHEMES = ("tcp", "rtde", "lines+tcp", "lines+udp")


def open_source(url: str, clock: Clock) -> Reopening:
    """The joint source behind an address; after a loss it can be opened again.

    Raises InputError for an address that is none, LinkError where nobody answers.
    """
    scheme, separator, _ = url.partition("://")
    if not separator or scheme not in SCHEMES:
        known = ", ".join(f"{name}://" for name in SCHEMES)
        raise InputError(f"{url!r} is no address of a robot; it begins with one of {known}")
    if scheme == "rtde":
        return Reopening(_Rtde(url, clock))
    if scheme == "tcp":
        return Reopening(lambda: TcpLink(url, clock))
    return Reopening(_Lines(url, clock))


class _Rtde:
    """Opens connections to one controller, whose readings are counted on from one to the next."""

    def __init__(self, url: str, clock: Clock) -> None:
        self._url, self._clock = url, clock
        self._last: RtdeLink | None = None

    def __call__(self) -> Link:
        self._last = RtdeLink(self._url, self._clock, None if self._last is None else self._last.first_s)
        return self._last


class _Lines:
    """Opens connections to one robot, which may have said only once what its columns are."""

    def __init__(self, url: str, clock: Clock) -> None:
        self._url, self._clock = url, clock
        self._last: LinesLink | None = None

    def __call__(self) -> Link:
        self._last = open_lines(self._url, self._clock, None if self._last is None else self._last.dialect)
        return self._last
