"""Datagrams as a link: each is a line, or several."""

from __future__ import annotations

import select
import socket

from truearm.errors import LinkError
from truearm.record.links import Arrivals, Backlog, Clock, Reader, host_and_port

MAX_DATAGRAM = 8192  # bytes; of a longer one the rest is cut off, and what is left is no reading
_POLL_S = 0.1


class UdpLink:
    """What is sent to ``udp://host:port``, an address of this machine (0.0.0.0: all of them).

    The first sender is the robot; datagrams of others are passed over. Each is handed out with a line feed at its end. Nothing
    says that a robot has gone: it is silent.
    """

    def __init__(self, url: str, clock: Clock, name: str | None = None) -> None:
        self.name = name or url
        self._clock = clock
        self._sender: tuple[str, int] | None = None
        address = host_and_port(url, "udp")
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        try:
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.bind(address)
        except OSError as exc:
            raise LinkError(
                f"{self.name}: cannot listen there ({exc.strerror or exc}); name an address of this machine"
            ) from exc
        self.port = int(self._socket.getsockname()[1])
        self._reader = Reader(self._receive, clock)

    def read(self, timeout_s: float) -> Arrivals:
        return self._reader.read(timeout_s)

    def write(self, data: bytes) -> int:
        """Nothing is sent to such a robot."""
        return self._clock.now_ns()

    @property
    def backlog(self) -> Backlog:
        """What waits to be read."""
        return self._reader.backlog

    def close(self) -> None:
        self._reader.stop()
        self._socket.close()

    def _receive(self) -> bytes:
        try:
            ready, _, _ = select.select([self._socket], [], [], _POLL_S)
            if not ready:
                return b""
            data, sender = self._socket.recvfrom(MAX_DATAGRAM)
        except (OSError, ValueError) as exc:
            raise LinkError(f"{self.name}: the robot was lost ({exc})") from exc
        self._sender = self._sender or sender
        return data + b"\n" if sender == self._sender else b""
