"""Links to a box or a robot: bytes with the host's arrival time, the clock of these stamps, and possible ports.

The recorder only knows ``Link`` and ``Clock``. It uses no other clock and waits only in ``Link.read``, so the simulator
can supply virtual time. A real link reads in a thread of its own: bytes are stamped on arrival, not when the recorder
processes them.
"""

from __future__ import annotations

import errno
import os
import queue
import select
import socket
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable
from urllib.parse import parse_qsl, urlsplit

import serial
from serial.tools import list_ports

from truearm.errors import InputError, LinkClosed, LinkError

Arrivals = list[tuple[int, bytes]]

_POLL_S = 0.1  # how long a reader thread waits before it checks whether to stop
_READ_BYTES = 4096
_QUEUE_ITEMS = 16384  # 25 s of a box at 4 kHz; beyond that the operating system blocks the sender
_READ_ITEMS = 128  # returned at a time: a sender that is faster than the recorder must not block everything else
_WRITE_TIMEOUT_S = 2.0
_CONNECT_TIMEOUT_S = 5.0


# NTP slews CLOCK_MONOTONIC by up to 500 ppm for minutes, which would look like a rate of the box's clock. Without a raw
# clock, perf_counter is the best available; on Windows it is the performance counter, which nothing slews.
_RAW: int | None = getattr(time, "CLOCK_MONOTONIC_RAW", None)


class Clock(Protocol):
    """The host's clock. ``kind`` is "monotonic-raw", "monotonic" or "virtual"."""

    kind: str

    def now_ns(self) -> int: ...

    def utc_anchor(self) -> tuple[int, int]:
        """Return one instant as UTC [ns since 1970] and on this clock [ns]."""
        ...


class Link(Protocol):
    """A byte stream in both directions. Every method raises LinkError if the stream is lost."""

    name: str

    def read(self, timeout_s: float) -> Arrivals:
        """Return ``(t_host_ns, bytes)`` for each piece that arrived, waiting up to ``timeout_s`` for the first.

        [] if none.

        Raises LinkClosed if the other side closed the stream, after everything before it has been returned.
        """
        ...

    def write(self, data: bytes) -> int:
        """Send ``data`` and return the host time [ns] just before it was handed over."""
        ...

    def close(self) -> None: ...


@runtime_checkable
class Reopenable(Protocol):
    """A link that can come back after it was lost."""

    def reopen(self, timeout_s: float) -> bool:
        """Try to open the link again, waiting up to ``timeout_s``; return whether it is back."""
        ...


class Backlog(NamedTuple):
    """Backlog between a link's reader and the recorder: pieces waiting, and how often the reader had to stop for them.

    ``drops``: what the reader does not fetch in time is lost. Otherwise the sender waits, and only sends late.
    ``foreign``: datagrams of other senders than the robot, which are dropped.
    """

    waiting: int = 0
    held_up: int = 0
    drops: bool = False
    foreign: int = 0


def backlog_of(link: Link) -> Backlog:
    """Return the backlog of a link that reads in a thread; zeros for others."""
    return Backlog(*getattr(link, "backlog", ()))


class LinkOnTop:
    """A link whose bytes come from another one, in another form."""

    _foreign = 0  # datagrams that it has dropped

    def __init__(self, link: Link, clock: Clock) -> None:
        self.name = link.name
        self._link = link
        self._clock = clock

    def write(self, data: bytes) -> int:
        return self._link.write(data)

    @property
    def backlog(self) -> Backlog:
        """Return the backlog."""
        return backlog_of(self._link)._replace(foreign=self._foreign)

    def close(self) -> None:
        self._link.close()


class HostClock:
    """The operating system's monotonic clock, without NTP slewing if available."""

    kind = "monotonic" if _RAW is None and sys.platform != "win32" else "monotonic-raw"

    def now_ns(self) -> int:
        return time.perf_counter_ns() if _RAW is None else time.clock_gettime_ns(_RAW)

    def utc_anchor(self) -> tuple[int, int]:
        """Return the tightest of five readings of both clocks."""
        readings = [(self.now_ns(), time.time_ns(), self.now_ns()) for _ in range(5)]
        begin, utc, end = min(readings, key=lambda r: r[2] - r[0])
        return utc, (begin + end) // 2


class StreamLink:
    """A stream that a thread reads and stamps.

    It stamps what ``_receive`` of the subclass returns, which is b"" after a while without data.
    """

    def __init__(self, name: str, clock: Clock, stream: Any, lost: str) -> None:
        """``stream`` is closed with the link; ``lost``: what an error says, with {} for its cause."""
        self.name = name
        self._clock = clock
        self._stream = stream
        self._lost = lost
        self._queue: queue.Queue[tuple[int, bytes] | LinkError] = queue.Queue(_QUEUE_ITEMS)
        self._error: LinkError | None = None
        self._held_up = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Arrivals:
        arrivals: Arrivals = []
        with suppress(queue.Empty):
            while self._error is None and len(arrivals) < _READ_ITEMS:
                item = self._queue.get(not arrivals, timeout_s)  # waits for the first alone
                if isinstance(item, LinkError):
                    self._error = item
                else:
                    arrivals.append(item)
        if not arrivals and self._error is not None:
            raise self._error
        return arrivals

    def write(self, data: bytes) -> int:
        t_host_ns = self._clock.now_ns()
        try:
            self._send(data)
        except OSError as exc:
            raise self._loss(exc) from exc
        return t_host_ns

    @property
    def backlog(self) -> Backlog:
        """Return the backlog."""
        return Backlog(self._queue.qsize(), self._held_up)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        self._stream.close()

    def _receive(self) -> bytes:
        raise NotImplementedError

    def _send(self, data: bytes) -> None:
        raise NotImplementedError

    def _readable(self) -> bool:
        return bool(select.select([self._stream.fileno()], [], [], _POLL_S)[0])

    def _loss(self, exc: Exception) -> LinkError:
        return LinkError(f"{self.name}: {self._lost.format(exc)}")

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                data = self._receive()
                t_host_ns = self._clock.now_ns()
            except (LinkError, OSError, ValueError) as exc:  # the last of a closed descriptor
                self._put(exc if isinstance(exc, LinkError) else self._loss(exc))
                return
            if data:
                self._put((t_host_ns, data))

    def _put(self, item: tuple[int, bytes] | LinkError) -> None:
        if self._queue.full():
            self._held_up += 1
        while not self._stopping.is_set():
            with suppress(queue.Full):
                return self._queue.put(item, timeout=_POLL_S)


class SerialLink(StreamLink):
    """A box on a serial device (``/dev/ttyACM0``, ``COM3``) or behind ``socket://host:port``, through pyserial.

    The port is opened exclusively and DTR is raised, without which a Pico sends nothing.
    """

    def __init__(self, device: str, clock: Clock) -> None:
        if not device or "://" in device:
            parse_address(device, "socket")
        self._selects = os.name == "posix" or device.startswith("socket://")
        try:
            port = serial.serial_for_url(
                device,
                timeout=0 if self._selects else _POLL_S,
                write_timeout=_WRITE_TIMEOUT_S,
                exclusive=True,
                baudrate=115200,
            )
        except (serial.SerialException, OSError, ValueError) as exc:
            raise LinkError(_why_not_open(device, exc)) from exc
        super().__init__(device, clock, port, "the link was lost ({}); check its cable and power")

    def _receive(self) -> bytes:
        """Return a piece of any length; pyserial's ``in_waiting`` of a socket is only 0 or 1."""
        if self._selects:
            return bytes(self._stream.read(_READ_BYTES)) if self._readable() else b""
        return bytes(self._stream.read(max(1, getattr(self._stream, "in_waiting", 1))))

    def _send(self, data: bytes) -> None:
        self._stream.write(data)


_UNREACHABLE = "does not answer; is the address right, the network up, and the machine on?"
_HINTS = {
    errno.ENOENT: "not found; plug the box in, or correct the name of its port",
    errno.EACCES: "permission denied; on Linux, join the group that owns it (dialout)",
    **dict.fromkeys((errno.EBUSY, errno.EAGAIN), "is in use by another program; close it"),
    **dict.fromkeys((errno.ENOTTY, errno.EISDIR), "is no serial port; find the box's with truearm box list"),
    **dict.fromkeys((errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH), _UNREACHABLE),
    errno.ECONNREFUSED: "nothing listens there; is the address right, and the box, the robot or the simulator running?",
}


def _why_not_open(name: str, exc: Exception) -> str:
    causes = [error for error in (exc, exc.__context__) if error is not None]  # pyserial wraps the actual error
    if isinstance(causes[-1], socket.gaierror):
        return f"{name}: unknown host name; check it, or give the address, such as 127.0.0.1"
    if isinstance(causes[-1], TimeoutError):
        return f"{name}: {_UNREACHABLE}"
    # termios.error has no attribute errno
    numbers = [number for error in causes for number in (getattr(error, "errno", None), *error.args[:1])]
    hint = next((_HINTS[number] for number in numbers if number in _HINTS), "")
    return f"{name}: {hint}" if hint else f"{name}: cannot be opened ({exc})"


ROBOT_LOST = "the robot was lost ({}); check the network and the controller"


class TcpLink(StreamLink):
    """A robot's stream behind ``tcp://host:port``; ``name`` identifies it in errors, by default the url."""

    def __init__(self, url: str, clock: Clock, name: str | None = None) -> None:
        host, port, _ = parse_address(url, "tcp")
        try:
            connection = socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT_S)
        except OSError as exc:
            raise LinkError(_why_not_open(name or url, exc)) from exc
        connection.settimeout(_WRITE_TIMEOUT_S)
        _notice_silence(connection)
        super().__init__(name or url, clock, connection, ROBOT_LOST)

    def _send(self, data: bytes) -> None:
        self._stream.sendall(data)

    def _receive(self) -> bytes:
        if not self._readable():
            return b""
        if data := self._stream.recv(_READ_BYTES):
            return bytes(data)
        raise LinkClosed(f"{self.name}: the robot closed its stream")


def _notice_silence(connection: socket.socket) -> None:
    """Have the operating system probe a silent peer: a pulled cable does not close a connection."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 5), ("TCP_KEEPINTVL", 2), ("TCP_KEEPCNT", 3)):  # lost after 11 s
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


MAX_DATAGRAM = 8192  # bytes; a longer one is truncated, and the rest is not a reading


class Datagram(bytes):
    """The contents of a datagram, and the address that sent it."""

    sender: str


class UdpLink(StreamLink):
    """Receives datagrams sent to ``udp://host:port`` as ``Datagram``.

    The host is an address of this machine (0.0.0.0: all of them).

    Each is returned with a line feed at its end. A robot that has gone is just silent; UDP does not report it.
    """

    def __init__(self, url: str, clock: Clock, name: str | None = None) -> None:
        host, port, _ = parse_address(url, "udp")
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            opened = socket.socket(family, socket.SOCK_DGRAM)
            opened.bind((host, port))
        except OSError as exc:
            reason = f"cannot listen there ({exc.strerror or exc}); give an address of this machine"
            raise LinkError(f"{name or url}: {reason}") from exc
        super().__init__(name or url, clock, opened, ROBOT_LOST)

    def _send(self, data: bytes) -> None:
        """Do nothing: such a robot receives no data."""

    @property
    def backlog(self) -> Backlog:
        """Return the backlog."""
        return super().backlog._replace(drops=True)

    def _receive(self) -> bytes:
        if not self._readable():
            return b""
        data, (sender, *_) = self._stream.recvfrom(MAX_DATAGRAM)
        datagram = Datagram(data + b"\n")
        datagram.sender = sender
        return datagram


def parse_address(
    url: str, scheme: str, port: int | None = None, with_options: bool = False
) -> tuple[str, int, dict[str, str]]:
    """Return host, port (``port`` where none is given) and options of ``scheme://host:port?name=value``.

    Raises InputError.
    """
    try:
        address = urlsplit(url)
        host, number = address.hostname, address.port or port
        options = parse_qsl(address.query, True, bool(address.query), max_num_fields=20)
    except ValueError:
        host = None
    if host is None or not number or address.scheme != scheme or address.path or (options and not with_options):
        form = f"{scheme}://host{'' if port else ':port'}, such as {scheme}://127.0.0.1{'' if port else ':7007'}"
        raise InputError("wrong-value", place="address", value=url, form=form)
    return host, number, dict(options)


class Runs:
    """The runs of bytes between delimiters in a stream that arrives in arbitrary pieces.

    A run beyond ``limit`` is returned in pieces, so memory stays below the limit and one piece of the stream.
    """

    def __init__(self, delimiter: bytes, limit: int) -> None:
        self._delimiter = delimiter
        self._limit = limit
        self._remainder = b""
        self._overlong = False  # part of the run in ``_remainder`` has been returned already

    def push(self, data: bytes) -> list[tuple[bool, bytes]]:
        """Return ``(whole, bytes)`` for every run finished by ``data``.

        Pieces of a run beyond the limit are not whole.
        """
        *runs, self._remainder = (self._remainder + data).split(self._delimiter)
        items: list[tuple[bool, bytes]] = []
        for run in runs:
            if self._overlong or len(run) > self._limit:
                items += self._pieces(run)
                self._overlong = False
            elif run:
                items.append((True, run))
        if len(self._remainder) > self._limit:
            items += self._pieces(self._remainder)
            self._overlong, self._remainder = True, b""
        return items

    def flush(self) -> bytes:
        """Return what follows the last delimiter when the stream has ended."""
        remainder, self._remainder, self._overlong = self._remainder, b"", False
        return remainder

    def _pieces(self, run: bytes) -> list[tuple[bool, bytes]]:
        return [(False, run[k : k + self._limit]) for k in range(0, len(run), self._limit)]


# ------------------------------------------------------------------------------------------------- links that come back

PAUSE_S = 0.25  # between attempts; a newly connected box takes about one second to show its port


class Reopening:
    """Opens a link with ``open_link`` now, and again with ``reopen`` after it was lost.

    It tries in a thread, because an unreachable address can block the caller for seconds. Raises what ``open_link``
    raises now.
    """

    def __init__(self, open_link: Callable[[], Link]) -> None:
        self._open = open_link
        self._link: Link | None = open_link()
        self._opening: Future[Link] | None = None
        self._held_up = self._foreign = 0  # of the previous links
        self.name = self._link.name
        self.numeric = getattr(self._link, "numeric", False)

    def read(self, timeout_s: float) -> Arrivals:
        return self._opened().read(timeout_s)

    def write(self, data: bytes) -> int:
        return self._opened().write(data)

    def reopen(self, timeout_s: float) -> bool:
        """Return whether the link is back, waiting up to ``timeout_s``; attempts continue between calls."""
        if self._opening is None:
            self.close()
            self._opening = Future()
            threading.Thread(target=_reopen, args=(self._open, self._opening), daemon=True).start()
        try:
            link = self._opening.result(timeout_s)
        except TimeoutError:
            return False
        self._opening, self._link, self.name = None, link, link.name
        return True

    def close(self) -> None:
        if self._opening is not None:
            if not self._opening.cancel():
                self._opening.result().close()
            self._opening = None
        if self._link is not None:
            link, self._link = self._link, None
            backlog = backlog_of(link)
            self._held_up, self._foreign = self._held_up + backlog.held_up, self._foreign + backlog.foreign
            link.close()

    @property
    def backlog(self) -> Backlog:
        """Return the backlog of the open link, with the counts of all links."""
        current = Backlog() if self._link is None else backlog_of(self._link)
        return current._replace(held_up=current.held_up + self._held_up, foreign=current.foreign + self._foreign)

    def _opened(self) -> Link:
        if self._link is None:
            raise LinkError(f"{self.name}: the link is closed")
        return self._link


def _reopen(open_link: Callable[[], Link], opening: Future[Link]) -> None:
    """Try until a link is open; if nobody wants it any more, it is closed."""
    while not opening.cancelled():
        try:
            link = open_link()
        except (LinkError, InputError):
            time.sleep(PAUSE_S)
            continue
        if opening.set_running_or_notify_cancel():
            opening.set_result(link)
        else:
            link.close()
        return


# --------------------------------------------------------------------------------------------------------- a box's port

# Raspberry Pi's vendor number; its products with a serial port are MicroPython and programs made with the Pico SDK.
VENDOR = 0x2E8A
PRODUCTS = {0x0005: "MicroPython", 0x000A: "Pico SDK", 0x0009: "Pico SDK (RP2350)"}


@dataclass(frozen=True)
class UsbPort:
    """A serial port. ``usb`` is "2e8a:0005", or "" if it is not on USB; ``candidate``: it may be a box."""

    device: str
    usb: str
    serial: str
    product: str
    candidate: bool


def usb_ports() -> list[UsbPort]:
    """Return all serial ports of this machine, possible boxes first."""
    ports = [
        UsbPort(
            device=port.device,
            usb="" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
            serial=port.serial_number or "",
            product=port.product or PRODUCTS.get(port.pid or 0, "") or port.description or "",
            candidate=port.vid == VENDOR and port.pid in PRODUCTS,
        )
        for port in list_ports.comports()
    ]
    return sorted(ports, key=lambda port: (not port.candidate, port.device))


def find_boxes() -> list[UsbPort]:
    """Return the ports that may be boxes, in order of their names."""
    return [port for port in usb_ports() if port.candidate]


class BoxPort:
    """Opens a box's port, and later the port with the same USB identity: a reconnected box may get another name.

    ``device`` is its last name. Without an identity (a socket, a pseudo-terminal), only the name is used.
    """

    def __init__(self, device: str, clock: Clock) -> None:
        self.device = device
        self._clock = clock
        self._identity = next((_identity(port) for port in usb_ports() if port.device == device), None)

    def __call__(self) -> SerialLink:
        """Open the port.

        Raises LinkError and InputError as ``SerialLink`` does, and LinkError if no port has the identity.
        """
        if self._identity is not None:
            names = [port.device for port in usb_ports() if _identity(port) == self._identity]
            if not names:
                raise LinkError("no-box", place=self.device)
            self.device = names[0]
        return SerialLink(self.device, self._clock)


def _identity(port: UsbPort) -> tuple[str, str] | None:
    return (port.usb, port.serial) if port.usb and port.serial else None
