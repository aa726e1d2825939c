"""A robot that sends what it is given: one end of a TCP connection, and a link in memory."""

import socket
import threading

from truearm.errors import LinkClosed


class Peer:
    """A listener; the other end is the robot's address."""

    def __init__(self, data):
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self._data = data
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        peer, _ = self._listener.accept()
        with peer:
            peer.sendall(self._data)
        self._listener.close()


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
