"""The client interfaces of the simulated lab: a TCP port or a pseudo-terminal."""

from __future__ import annotations

import os
import select
import socket
from dataclasses import dataclass, field

LINK_BYTES = 16384  # capacity of the link when its reader is slow
RX_BYTES = 256


@dataclass
class Port:
    """A listening TCP port with at most one client, and the data waiting to be sent to it."""

    listener: socket.socket
    client: socket.socket | None = None
    pending: bytearray = field(default_factory=bytearray)

    @staticmethod
    def listen(host: str, port: int) -> Port:
        """Open the port. Raises OSError if it is in use."""
        listener = socket.create_server((host, port), backlog=1)
        listener.setblocking(False)
        return Port(listener)

    @property
    def number(self) -> int:
        return int(self.listener.getsockname()[1])

    def connected(self) -> bool:
        """Return whether there is a client; accepts a waiting one. A newer client replaces the older one."""
        try:
            client, _ = self.listener.accept()
        except BlockingIOError:
            return self.client is not None
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.drop()
        self.client = client
        return True

    def room(self) -> int:
        return max(0, LINK_BYTES - len(self.pending)) if self.client else 0

    def receive(self) -> bytes:
        if self.client is None:
            return b""
        try:
            data = self.client.recv(RX_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self.drop()
        return data

    def wait(self, timeout_s: float) -> None:
        """Wait until there is something to receive, at most for ``timeout_s``."""
        select.select([self.listener if self.client is None else self.client], [], [], timeout_s)

    def send(self, data: bytes) -> None:
        self.pending += data
        if self.client is None or not self.pending:
            return
        try:
            del self.pending[: self.client.send(self.pending)]
        except BlockingIOError:
            return
        except OSError:
            self.drop()

    def drop(self) -> None:
        """End the client's connection; data waiting for it are lost, as on a real line."""
        if self.client is not None:
            self.client.close()
        self.client = None
        self.pending.clear()

    def close(self) -> None:
        self.drop()
        self.listener.close()


class Terminal:
    """A pseudo-terminal in raw mode with the interface of a port. It counts as connected after the first write."""

    def __init__(self) -> None:
        import tty  # not available on every platform

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.pending = bytearray()
        self._seen = False
        self._ahead = b""

    def connected(self) -> bool:
        if not self._seen:
            self._ahead = self.receive()
            self._seen = bool(self._ahead)
        return self._seen

    def room(self) -> int:
        return max(0, LINK_BYTES - len(self.pending)) if self._seen else 0

    def receive(self) -> bytes:
        if self._ahead:
            data, self._ahead = self._ahead, b""
            return data
        try:
            return os.read(self._master, RX_BYTES)
        except BlockingIOError:
            return b""

    def wait(self, timeout_s: float) -> None:
        """Wait until there is something to receive, at most for ``timeout_s``."""
        select.select([self._master], [], [], timeout_s)

    def send(self, data: bytes) -> None:
        self.pending += data
        try:
            while self.pending:
                del self.pending[: os.write(self._master, self.pending[:4096])]
        except BlockingIOError:
            return

    def close(self) -> None:
        os.close(self._master)
        os.close(self._slave)
