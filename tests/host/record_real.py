"""The box in memory in real time, behind a socket or a pseudo-terminal; and a robot."""

import json
import os
import select
import socket
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

from record_box import Box, Lab
from tests.host.tcp_peer import Peer

from truearm.record.links import HostClock

PATIENCE_S = 20.0  # only a broken recorder takes this long


def play(box, lab, receive_fd, stop):
    """Run a box in memory in real time behind a descriptor."""
    while not stop.is_set():
        ready, _, _ = select.select([receive_fd], [], [], 0.005)
        try:
            data = os.read(receive_fd, 4096) if ready else b""
            if ready and not data:
                return
            now = HostClock().now_ns()
            while lab.now < now:
                lab.step(now)
            if data:
                box.link.on_write(data)
            arrived, box.link.arrived = box.link.arrived, []
            for _, raw in arrived:
                os.write(receive_fd, raw)
        except OSError:
            return


def real_time_box():
    lab = Lab()
    lab.now = HostClock().now_ns()
    return lab, Box(lab)


@contextmanager
def box_on_a_socket(waits=False):
    """Yield a box behind ``socket://`` and its device.

    ``waits``: it is plugged in at the recorder's first byte, after pyserial emptied the input of the port that it
    opened.
    """
    stop = threading.Event()
    lab, box = real_time_box()

    def talk(peer):
        if waits:
            peer.recv(1, socket.MSG_PEEK)
        play(box, lab, peer.fileno(), stop)

    recorder = Peer(talk)
    yield box, f"socket://{recorder.address}"
    stop.set()
    recorder.close()


def line_of(k, period_s=0.01):
    """Return reading number k of a robot of two joints."""
    return json.dumps({"t": period_s * k, "seq": k, "q": [0.1, 0.2]}).encode() + b"\n"


def serve_robot(seconds):
    def talk(peer):
        for k in range(round(50 * seconds)):
            peer.sendall(line_of(k, 0.02))
            time.sleep(0.02)
        peer.sendall(b'{"end": true}\n')

    return f"tcp://{Peer(talk).address}"


class OnTerminals:
    """A box on a pseudo-terminal that can be unplugged and return under another name; ``ports`` lists USB."""

    def __init__(self, box, lab, serial="E6612345"):
        self.box, self._lab, self._serial = box, lab, serial
        self.device = ""
        self.plug()

    def plug(self):
        import tty

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.device = os.ttyname(self._slave)
        self._stop = threading.Event()
        self.box.link.arrived = []  # data that it sent meanwhile are lost
        self._thread = threading.Thread(target=play, args=(self.box, self._lab, self._master, self._stop), daemon=True)
        self._thread.start()

    def unplug(self):
        self._stop.set()
        self._thread.join(PATIENCE_S)
        os.close(self._master)
        os.close(self._slave)
        self.device = ""

    def ports(self):
        """Return the ports in the format of ``serial.tools.list_ports.comports``."""
        other = SimpleNamespace(
            device="/dev/ttyS0", vid=None, pid=None, serial_number=None, product=None, description="n/a"
        )
        box = SimpleNamespace(
            device=self.device, vid=0x2E8A, pid=5, serial_number=self._serial, product="truearm", description=""
        )
        return [other, box] if self.device else [other]
