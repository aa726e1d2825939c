"""Datagrams as a link: each contains one or more lines."""

from __future__ import annotations

import socket

from truearm.errors import LinkError
from truearm.record.links import ROBOT_LOST, Backlog, Clock, StreamLink, host_and_port

MAX_DATAGRAM = 8192  # bytes; a longer one is truncated, and the rest is not a reading


class Datagram(bytes):
    """The contents of a datagram, and the address that sent it."""

    sender: str


class UdpLink(StreamLink):
    """Receives datagrams sent to ``udp://host:port``, an address of this machine (0.0.0.0: all of them), as ``Datagram``.

    Each is returned with a line feed at its end. A robot that has gone is just silent; UDP does not report it.
    """

    def __init__(self, url: str, clock: Clock, name: str | None = None) -> None:
        address = host_and_port(url, "udp")
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        try:
            opened = socket.socket(family, socket.SOCK_DGRAM)
            opened.bind(address)
        except OSError as exc:
            raise LinkError(
                f"{name or url}: cannot listen there ({exc.strerror or exc}); give an address of this machine"
            ) from exc
        self.port = int(opened.getsockname()[1])
        super().__init__(name or url, clock, opened, ROBOT_LOST)

    def _send(self, data: bytes) -> None:
        """Do nothing: such a robot receives no data."""

    @property
    def backlog(self) -> Backlog:
        """Return the backlog."""
        return super().backlog._replace(drops=True)

    def _receive(self) -> bytes:
        if not self._readable():
            return b""
        data, (sender, *_) = self._stream.recvfrom(MAX_DATAGRAM)
        datagram = Datagram(data + b"\n")
        datagram.sender = sender
        return datagram
