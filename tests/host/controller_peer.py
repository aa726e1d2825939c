"""A simulated Universal Robots controller: the kinematics of an arm as built, as its primary interface sends them."""

import socket
import struct
import threading

import numpy as np

from truearm.export.toml_tables import dh_rows
from truearm.export.writing import link_frames

INFO, ROBOT_STATE = 5, 16


def drawn_rows(chain):
    """Return θ, a, d, α (4, 6) of a drawing with β for d."""
    values = dict(zip(chain.parameter_names, chain.params_nominal, strict=True))
    return np.array(
        [[values.get(f"joint{i + 1}.{key}", 0.0) for i in range(6)] for key in ("offset", "a", "d", "alpha")]
    )


def built(chain, seed=0, angle=8.7e-4, length=4e-4):
    """Return the parameters (p,) of an arm as built, whose base and flange are those of its controller; 0.05°, 0.4 mm."""
    rng = np.random.default_rng(seed)
    own = [(p.name.startswith("joint") and p.term == "geometry") or p.term == "offset" for p in chain.parameters]
    sigma = np.array([length if p.unit == "m" else angle for p in chain.parameters])
    return chain.params_nominal + np.where(own, sigma, 0.0) * rng.normal(size=sigma.size)


def built_rows(chain, seed=0):
    """Return θ, a, d, α (4, 6) of an arm as built: d of joints 2 to 4 are up to hundreds of metres."""
    robot, described = (link_frames(chain, chain.params_nominal, p) for p in (built(chain, seed), chain.params_nominal))
    rows = dh_rows(robot, described)
    return np.array([rows.theta + robot.offsets, rows.a, rows.d, rows.alpha])


def info(rows, checksums=(1, 2, 3, 4, 5, 0xFFFFFFFF)):
    """Return KinematicsInfo without its head."""
    return struct.pack(">6I24dI", *checksums, *np.ravel(rows), 0)


def state(content, kind=INFO):
    """Return a package of the robot's state with a sub-package before and the content."""
    other = struct.pack(">IB", 5 + 47, 0) + bytes(47)
    body = other + struct.pack(">IB", 5 + len(content), kind) + content
    return struct.pack(">IB", 5 + len(body), ROBOT_STATE) + body


def message(text=b"hello"):
    """Return a package of another type."""
    return struct.pack(">IB", 5 + len(text), 20) + text


class Controller:
    """Listens on loopback and sends ``data`` to each that connects, in small pieces; ``stays`` connected afterwards."""

    def __init__(self, data, stays=False):
        self.data, self._stays = data, stays
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self):
        kept = []
        while True:
            try:
                peer, _ = self._listener.accept()
                for i in range(0, len(self.data), 100):
                    peer.sendall(self.data[i : i + 100])
                kept.append(peer) if self._stays else peer.close()
            except OSError:
                return

    def close(self):
        self._listener.close()
