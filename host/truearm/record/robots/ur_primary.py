"""Read the kinematics of a Universal Robots controller from its primary interface, port 30001.

The controller sends packages (size int32, type uint8, content). Packages of type 16 contain sub-packages (size uint32,
type uint8, content). The first package after a connection contains the sub-package KinematicsInfo, type 5. Nothing is
sent to the controller.
"""

from __future__ import annotations

import socket
import time

from truearm.errors import LinkError
from truearm.record.robots.rtde import address_of

PORT = 30001
CONNECT_S, ANSWER_S = 2.0, 5.0
HEAD = 5  # bytes: size and type
MAX_PACKAGE = 65536  # bytes; of a robot's state 1,500
ROBOT_STATE, KINEMATICS = b"\x10", 5


def kinematics_info(url: str) -> bytes:
    """Return the content of KinematicsInfo of the controller at ``rtde://host``. Raises InputError, LinkError."""
    host, _, _ = address_of(url)
    wrong = LinkError(
        f"{url}: port {PORT} sends no data of a primary interface; is it enabled, and {host} a Universal Robots controller?"
    )
    try:
        with socket.create_connection((host, PORT), CONNECT_S) as connection, connection.makefile("rb") as stream:
            connection.settimeout(ANSWER_S)
            end = time.monotonic() + ANSWER_S
            while time.monotonic() < end:
                head = stream.read(HEAD)
                package = stream.read(min(max(0, int.from_bytes(head[:4]) - HEAD), MAX_PACKAGE))
                contents = sub_packages(package) if head[4:] == ROBOT_STATE else {}
                if HEAD + len(package) != int.from_bytes(head[:4]) or contents is None:
                    raise wrong
                if KINEMATICS in contents:
                    return contents[KINEMATICS]
    except OSError as exc:
        if not isinstance(exc, TimeoutError):
            raise LinkError(
                f"{url}: cannot read port {PORT} ({exc.strerror or exc}); check address and network"
            ) from exc
    raise LinkError(f"{url}: the controller sent no kinematics on port {PORT}; check address and network")


def sub_packages(package: bytes) -> dict[int, bytes] | None:
    """Return the contents of sub-packages by type; None unless their sizes add up."""
    contents = {}
    while package:
        size = int.from_bytes(package[:4])
        if not HEAD <= size <= len(package):
            return None
        contents[package[4]], package = package[HEAD:size], package[size:]
    return contents
