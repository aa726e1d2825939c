"""A robot that sends what it is given: one end of a TCP connection, and a link in memory."""

import socket
import threading
from contextlib import suppress

from truearm.errors import LinkClosed


class Peer:
    """A listener that sends its clients data, or talks to them, one after the other; the other end is the robot's address."""

    def __init__(self, talk, clients=1):
        self._talk = talk if callable(talk) else lambda peer: peer.sendall(talk)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._run, args=(clients,), daemon=True)
        self._thread.start()

    def _run(self, clients):
        with self._listener, suppress(OSError):  # from a client that leaves
            for _ in range(clients):
                peer, _ = self._listener.accept()
                with peer:
                    self._talk(peer)

    def close(self):
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # close alone does not end an accept under way
        self._listener.close()
        self._thread.join(20.0)


class Played:
    """A link that delivers pieces, then nothing or its end."""

    name = "played"

    def __init__(self, pieces, ends=True):
        self.pieces, self.ends = list(pieces), ends

    def __call__(self, *_, **__):
        return self

    def read(self, timeout_s):
        if self.pieces:
            return [(0, self.pieces.pop(0))]
        if self.ends:
            raise LinkClosed("played: the end")
        return []

    def write(self, data):
        return 0

    def close(self):
        pass
