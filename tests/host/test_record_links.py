"""Links to sockets and pseudo-terminals through pyserial: bytes, ends, and error messages."""

import contextlib
import os
import socket
import threading
import time

import pytest

from truearm.errors import InputError, LinkClosed, LinkError
from truearm.record.links import PAUSE_S, BoxPort, HostClock, Reopening, SerialLink, TcpLink, parse_address

posix = pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
PATIENCE_S = 10.0  # only a broken link waits so long


class Server:
    """Accepts one connection after another; the newest is ``peer``."""

    def __init__(self):
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.socket.getsockname()[1]}"
        self.peers = []
        self.accepted = threading.Semaphore(0)
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        while True:
            try:
                self.peers.append(self.socket.accept()[0])
            except OSError:
                return
            self.accepted.release()

    def peer(self):
        assert self.accepted.acquire(timeout=PATIENCE_S)
        return self.peers[-1]

    def stop_listening(self):
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)  # close alone does not end an accept under way
        self.socket.close()

    def close(self):
        self.stop_listening()
        for peer in self.peers:
            peer.close()


@pytest.fixture
def server():
    server = Server()
    yield server
    server.close()


def read_until(link, n):
    """Return at least ``n`` bytes, as (stamp, bytes)."""
    arrivals, deadline = [], time.monotonic() + PATIENCE_S
    while sum(len(data) for _, data in arrivals) < n and time.monotonic() < deadline:
        arrivals += link.read(0.1)
    return arrivals


def read_until_error(link):
    """Return what was received before the error, and the error."""
    arrivals, deadline = [], time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        try:
            arrivals += link.read(0.1)
        except LinkError as exc:
            return b"".join(data for _, data in arrivals), exc
    raise AssertionError("no error came")


class TestSocket:
    def test_bytes_and_stamps(self, server):
        clock = HostClock()
        link = SerialLink(f"socket://{server.address}", clock)
        peer = server.peer()
        before = clock.now_ns()
        sent = bytes(range(256)) * 400
        peer.sendall(sent)
        arrivals = read_until(link, len(sent))
        stamps = [t for t, _ in arrivals]
        assert b"".join(data for _, data in arrivals) == sent
        assert len(arrivals) < len(sent) / 100  # not byte by byte
        assert before <= stamps[0]
        assert stamps == sorted(stamps)
        assert stamps[-1] <= clock.now_ns()
        link.close()

    def test_lost_after_everything_was_handed_out_then_back(self, server):
        link = Reopening(BoxPort(f"socket://{server.address}", HostClock()))
        peer = server.peer()
        peer.sendall(b"last words")
        peer.close()
        data, error = read_until_error(link)
        assert data == b"last words"
        assert "lost" in str(error)
        with pytest.raises(LinkError):  # again and again
            link.read(0.0)
        assert link.reopen(PATIENCE_S)
        server.peer().sendall(b"back")
        assert b"".join(data for _, data in read_until(link, 4)) == b"back"
        link.close()
        with pytest.raises(LinkError, match="closed"):
            link.read(0.0)
        with pytest.raises(LinkError, match="closed"):
            link.write(b"x")

    def test_reopening_in_vain(self, server):
        link = Reopening(BoxPort(f"socket://{server.address}", HostClock()))
        server.stop_listening()
        assert not link.reopen(2.5 * PAUSE_S)  # two attempts
        with pytest.raises(LinkError):
            link.read(0.0)


@posix
class TestTerminal:
    def test_both_ways_and_unplugged(self):
        import tty

        box, device = os.openpty()
        tty.setraw(device)
        name = os.ttyname(device)
        link = SerialLink(name, HostClock())
        sent = bytes(range(256)) * 8
        os.write(box, sent)
        assert b"".join(data for _, data in read_until(link, len(sent))) == sent
        link.write(b"\0\n\r\x03\0")  # nothing may be translated
        assert os.read(box, 100) == b"\0\n\r\x03\0"
        os.close(device)
        os.close(box)
        assert isinstance(read_until_error(link)[1], LinkError)
        link.close()

    def test_in_use(self):
        box, device = os.openpty()
        link = SerialLink(os.ttyname(device), HostClock())
        with pytest.raises(LinkError, match="in use by another program"):
            SerialLink(os.ttyname(device), HostClock())
        link.close()
        os.close(device)
        os.close(box)


class TestTcp:
    def test_closed_in_order(self, server):
        link = TcpLink(f"tcp://{server.address}", HostClock())
        peer = server.peer()
        peer.sendall(b'{"t": 1}\n')
        peer.close()
        data, error = read_until_error(link)
        assert data == b'{"t": 1}\n'
        assert isinstance(error, LinkClosed)
        link.close()

    def test_reset(self, server):
        link = TcpLink(f"tcp://{server.address}", HostClock())
        peer = server.peer()
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # close with a reset
        peer.close()
        error = read_until_error(link)[1]
        assert not isinstance(error, LinkClosed)
        assert "lost" in str(error)
        link.close()


@pytest.mark.parametrize(
    ("device", "says"),
    [
        ("ttyACM9", "ttyACM9: not found"),
        ("file", "is no serial port"),
        (".", "is no serial port"),
        ("socket://127.0.0.1:1", "nothing listens there"),
    ],
)
def test_why_a_device_cannot_be_opened(tmp_path, device, says):
    (tmp_path / "file").write_text("x")
    with pytest.raises(LinkError, match=says):
        SerialLink(device if "://" in device else str(tmp_path / device), HostClock())


@pytest.mark.parametrize(
    "device", ["", "loop://", "rfc2217://localhost:1", "socket://", "socket://host", "socket://:1", "socket://h:x"]
)
def test_no_device(device):
    with pytest.raises(InputError):
        SerialLink(device, HostClock())


@pytest.mark.parametrize(
    "url",
    [
        "",
        "localhost:7008",
        "udp://localhost:1",
        "tcp://h",
        "tcp://h:70000",
        "tcp://h:1/x",
        "tcp://h:1?x=1",
        "tcp://[::1:5",
    ],
)
def test_no_address(url):
    with pytest.raises(InputError, match=r"tcp://host:port"):
        TcpLink(url, HostClock())


def test_addresses():
    assert parse_address("tcp://127.0.0.1:7008?a=b", "tcp", with_options=True) == ("127.0.0.1", 7008, {"a": "b"})
    assert parse_address("socket://[::1]", "socket", 7007) == ("::1", 7007, {})


@pytest.mark.parametrize("raw", [True, False])
def test_the_clock_is_one_that_nothing_slews(monkeypatch, raw):
    """Two readings of the system's clock bracket one of ours."""
    if raw:
        system = getattr(time, "CLOCK_MONOTONIC_RAW", None)
        if system is None:
            pytest.skip("this system has no raw clock")
        assert HostClock.kind == "monotonic-raw"
    else:
        monkeypatch.setattr("truearm.record.links._RAW", None)
    read = (lambda: time.clock_gettime_ns(system)) if raw else time.perf_counter_ns
    before, ours, (_, anchor), after = read(), HostClock().now_ns(), HostClock().utc_anchor(), read()
    assert before <= ours <= anchor <= after
