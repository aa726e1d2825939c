"""One end of a TCP connection that sends what it is given and closes."""

import socket
import threading


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
