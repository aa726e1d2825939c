"""The lab behind ports: how it ends."""

import socket
import threading
from types import SimpleNamespace

from truearm_sim.ports import Port
from truearm_sim.serve import serve

END_NS = 200_000_000


def lab():
    """Return a lab with a silent box and a robot whose program ends soon."""
    world = SimpleNamespace(
        robot_end_ns=END_NS, robot_lines=lambda since, until, level: ([], [b"reading\n"] * (until <= END_NS))
    )
    return world, SimpleNamespace(advance=lambda t_ns, rx, room: [], output_at=None)


def test_a_robot_of_lines_says_that_it_has_ended_and_closes():
    """Also to who comes later; the lab ends when the box's client has gone."""
    box_port, robot_port = Port.listen("127.0.0.1", 0), Port.listen("127.0.0.1", 0)
    ended = threading.Event()
    thread = threading.Thread(
        target=serve, args=(*lab(), box_port, robot_port), kwargs={"ended": ended.set}, daemon=True
    )
    thread.start()
    with socket.create_connection(("127.0.0.1", box_port.number)):
        for _ in range(2):
            with socket.create_connection(("127.0.0.1", robot_port.number), timeout=5) as robot:
                said = robot.makefile("rb").read()  # until it closes
            assert said.endswith(b'{"end": true}\n')
        assert ended.is_set()
        assert b"reading" not in said
        assert thread.is_alive()
    thread.join(5)
    assert not thread.is_alive()
    box_port.close()
    robot_port.close()
