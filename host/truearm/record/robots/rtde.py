"""Universal Robots controllers as a joint source: RTDE on port 30004 (``rtde_packages``), with readings as lines.

A line holds each number of a data package with all its digits: ``t`` (timestamp: seconds since the controller
started), ``q`` (actual_q), and if the controller has them ``q_cmd`` (target_q), ``qd`` (actual_qd), ``current``
(actual_current [A]), ``inputs`` (actual_digital_input_bits), ``robot_mode`` and ``runtime_state``. Measured and
commanded joints are kept separate: ``target_q`` never replaces ``actual_q``.

RTDE has no sequence numbers. A controller that runs short of time skips packages. This shows in the timestamps, which
are multiples of its cycle. ``seq`` is the time since the first timestamp in periods, so skipped packages are gaps in
``seq``.

Everything else (text messages, packages of other types or lengths) is passed on as lines that are not readings, each
with the package's type and payload, byte by byte (Latin-1); the recorder keeps them in ``/robot/console``. A package with all fields takes about 5 µs, at 500 per second.
"""

from __future__ import annotations

import json
import math
from contextlib import suppress

from truearm.errors import InputError, LinkClosed, LinkError
from truearm.record.links import Arrivals, Clock, Link, LinkOnTop, TcpLink, parse_address
from truearm.record.robots import rtde_packages as rtde
from truearm.session.joint_format import MAX_T_S, format_reading

PORT = 30004
ANSWER_NS = 5_000_000_000
MOST_UNASKED = 10_000  # packages before an answer: a controller sends at most ANSWER_NS of data, at 500 Hz
NEEDED = {"timestamp": "DOUBLE", "actual_q": "VECTOR6D"}  # with their types
WANTED = {  # with their keys in a line
    "target_q": "q_cmd",
    "actual_qd": "qd",
    "actual_current": "current",
    "actual_digital_input_bits": "inputs",
    "robot_mode": "robot_mode",
    "runtime_state": "runtime_state",
}
FULL_RATE_HZ = {True: 500.0, False: 125.0}  # key: e-Series or later, i.e. controller software 5 or later
VERSION_BYTES = 16  # major, minor, bugfix and build
EXAMPLE = "rtde://192.168.0.2, with ?hz=125 for a lower rate"


def connect(url: str, clock: Clock, last: Link | None) -> Link:
    """Return a link that continues the ``seq`` of the ``last`` one. Raises as ``RtdeLink`` does."""
    return RtdeLink(url, clock, last.first_s if isinstance(last, RtdeLink) else None)


class RtdeLink(LinkOnTop):
    """Connects, negotiates the fields and starts the stream; ``read`` returns lines. See the module docstring.

    ``first_s``: the timestamp from which ``seq`` counts, taken from an earlier connection; None: the first one
    received. ``url``: ``rtde://host[:port][?hz=125]``. Without ``hz`` the controller's own rate is used: 500 Hz, or 125
    Hz before software 5. Raises InputError for any other url or a rate that does not divide the controller's, LinkError
    if no controller answers or it refuses.
    """

    def __init__(self, url: str, clock: Clock, first_s: float | None = None) -> None:
        host, port, hz = address_of(url)
        address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        super().__init__(TcpLink(f"tcp://{address}", clock, name=url), clock)
        self.numeric = True  # the recorder stores columns in place of lines
        self._packages = rtde.Packages()
        self._pending: Arrivals = []  # lines received during the set-up
        self._recipe: rtde.Recipe | None = None
        self.first_s = first_s
        try:
            self._set_up(hz)
        except (LinkError, InputError):
            self._link.close()
            raise

    def read(self, timeout_s: float) -> Arrivals:
        lines, self._pending = self._pending, []
        if self._packages.broken and not lines:  # once may be a damaged package: a recording connects again
            raise LinkError(
                f"{self.name}: sends data that are not RTDE; is this port {PORT} of a Universal Robots controller?"
            )
        return lines or [
            (t_host_ns, self._line(*package))
            for t_host_ns, data in self._link.read(timeout_s)
            for package in self._packages.push(data)
        ]

    def close(self) -> None:
        """Pause the stream and close the connection."""
        with suppress(LinkError):
            self._link.write(rtde.package(rtde.PAUSE))
        super().close()

    # --- set-up

    def _set_up(self, hz: float | None) -> None:
        if self._ask(rtde.VERSION, rtde.package(rtde.VERSION, b"\0\2")) != b"\1":
            raise LinkError(f"{self.name}: the controller does not speak version 2 of RTDE; update its software")
        version = self._ask(rtde.CONTROLLER, rtde.package(rtde.CONTROLLER))
        if len(version) != VERSION_BYTES:
            raise LinkError(f"{self.name}: the controller does not report its version; is this a Universal Robots arm?")
        full_hz = FULL_RATE_HZ[int.from_bytes(version[:4]) >= 5]
        self._hz = hz or full_hz
        if full_hz % self._hz:  # packages would not be evenly spaced, and seq would count wrong
            raise InputError(
                f"{self.name}: give a rate that divides the controller's {full_hz:g} Hz, such as ?hz={full_hz / 4.0:g}"
            )
        self._recipe = self._agree()
        if self._ask(rtde.START, rtde.package(rtde.START)) != b"\1":
            raise LinkError(f"{self.name}: the controller refuses to send data packages; restart the controller")

    def _agree(self) -> rtde.Recipe:
        """Return the recipe of the wanted fields that the controller has."""
        names = [*NEEDED, *WANTED]
        answer = self._ask(rtde.OUTPUTS, rtde.request_outputs(names, self._hz))
        if rtde.NOT_FOUND in (types := rtde.types_of(answer)):
            names = [name for name, type_ in zip(names, types, strict=False) if type_ != rtde.NOT_FOUND]
            answer = self._ask(rtde.OUTPUTS, rtde.request_outputs(names, self._hz)) if {*NEEDED} <= {*names} else answer
        recipe = rtde.recipe_of(names, answer)
        if recipe is None or rtde.types_of(answer)[: len(NEEDED)] != list(NEEDED.values()):
            raise LinkError(
                f"{self.name}: the controller refuses the fields {', '.join(names)} ({answer[1:201]!r}); update its software"
            )
        return recipe

    def _ask(self, kind: int, request: bytes) -> bytes:
        """Return the payload of the answer to a request; other packages wait. Raises LinkError if there is none."""
        self._link.write(request)
        answer, deadline_ns = None, self._clock.now_ns() + ANSWER_NS
        while answer is None and not self._packages.broken and self._clock.now_ns() < deadline_ns:
            try:
                arrivals = self._link.read(0.1)
            except LinkClosed as exc:
                raise LinkError(
                    f"{self.name}: the controller closed the connection; is RTDE enabled in its settings?"
                ) from exc
            for t_host_ns, data in arrivals:
                for package in self._packages.push(data):
                    if package[0] == kind and answer is None:
                        answer = package[1]
                    else:
                        self._pending.append((t_host_ns, self._line(*package)))
            if len(self._pending) > MOST_UNASKED:
                break
        if answer is None:
            raise LinkError(
                f"{self.name}: no answer to RTDE's {chr(kind)!r}; is this port {PORT} of a Universal Robots controller?"
            )
        return answer

    # --- packages → lines

    def _line(self, kind: int, payload: bytes) -> bytes:
        values = self._recipe.values(payload) if kind == rtde.DATA and self._recipe is not None else None
        if values is not None and all(
            map(math.isfinite, (values["timestamp"], *values["actual_q"]))
        ):  # JSON has no others
            return self._reading(**values) + b"\n"
        return json.dumps({"rtde": kind, "payload": payload.decode("latin-1")}).encode() + b"\n"

    def _reading(self, timestamp: float, actual_q: list[float], **values: rtde.Value) -> bytes:
        seq = None
        if 0.0 <= timestamp < MAX_T_S:  # else it is not a reading and cannot start the count
            self.first_s = timestamp if self.first_s is None else min(timestamp, self.first_s)
            seq = round((timestamp - self.first_s) * self._hz)
        return format_reading(timestamp, seq, actual_q, **{WANTED[name]: value for name, value in values.items()})


def address_of(url: str) -> tuple[str, int, float | None]:
    """Return host, port and rate of an address. Raises InputError."""
    host, port, options = parse_address(url, "rtde", PORT, with_options=True)
    hz = options.pop("hz", None)
    if options or not (hz is None or (hz.replace(".", "", 1).isdecimal() and 1.0 <= float(hz) <= 500.0)):
        raise InputError("wrong-value", place="address", value=url, form=EXAMPLE)
    return host, port, None if hz is None else float(hz)
