"""RTDE: bytes written by hand from the maker's public description, and a controller that plays a script.

The sequences are those of "Real-Time Data Exchange (RTDE) Guide" (docs.universal-robots.com), section by section: package header
(size and type), then the payload's fields in the table of each package. Those marked (UR) also stand, byte for byte, in the tests of the maker's
own client library (UniversalRobots/Universal_Robots_Client_Library, tests/test_rtde_*.cpp). None of them was made by our code.
"""

import json
import math
import socket
import struct
import threading
import tracemalloc
from contextlib import suppress

import pytest
from record_files import events, topics
from record_real import box_on_a_socket
from tests.host.tcp_peer import Peer

from truearm.cli.main import main
from truearm.errors import InputError, LinkError
from truearm.record.links import HostClock
from truearm.record.robots import rtde
from truearm.record.robots.rtde import RtdeLink
from truearm.session.joint_format import parse_line, unpack

PATIENCE_S = 5.0  # only a broken client waits so long


def h(text):
    """Return the bytes of hexadecimal digits, with comments behind '#'."""
    return bytes.fromhex("".join(line.partition("#")[0] for line in text.splitlines()))


VERSION_2 = h("00 05  56  00 02  # size 5, 'V', protocol version 2")
VERSION_ACCEPTED = h("00 04  56  01  # (UR)")
VERSION_REFUSED = h("00 04  56  00")
CONTROLLER = h("00 03  76  # size 3, 'v'")
CONTROLLER_5_8 = h("00 13  76  00000005 00000008 00000000 00000000  # 5.8.0.0 (UR)")
CONTROLLER_3_15 = h("00 13  76  00000003 0000000f 00000008 00000000  # a CB3 controller")
START = h("00 03  53")
STARTED = h("00 04  53  01  # (UR)")
NOT_STARTED = h("00 04  53  00")
PAUSE = h("00 03  50")
TEXT = h("""00 16  4d         # size 22, 'M'
            07 53 74 6f 70 70 65 64        # 7, "Stopped"
            09 43 6f 6e 74 72 6f 6c 6c 65  # 9, "Controlle"
            02                # warning""")
SETUP_500 = h("00 1d  4f  407f400000000000  61637475616c5f71 2c 61637475616c5f7164  # 500.0, 'actual_q,actual_qd' (UR)")
SETUP_TYPES = h("00 13  4f  01  444f55424c45 2c 564543544f523644  # recipe 1, 'DOUBLE,VECTOR6D'; (UR) but for the size")
DATA = h("00 14  55  01  40d0070d2f1a9fbe  3ff0000000000000  # recipe 1, 16412.206, 1.0 (UR)")
DATA_Q = h("""00 3c  55  01                # size 60: 3 + 1 + 8 + 48, 'U', recipe 1
              40f8 6a00 0000 0000        # timestamp 100000.0
              3ff0000000000000 bff0000000000000 4000000000000000  # 1, -1, 2
              c000000000000000 3fe0000000000000 0000000000000000  # -2, 0.5, 0""")
NAMES = (
    "timestamp",
    "actual_q",
    "target_q",
    "actual_qd",
    "actual_current",
    "actual_digital_input_bits",
    "robot_mode",
    "runtime_state",
)
ALL_TYPES = b"DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D,VECTOR6D,UINT64,INT32,UINT32"


class TestBytes:
    def test_requests_answers_and_vectors(self):
        assert rtde.packed(rtde.CONTROLLER) == CONTROLLER
        assert rtde.request_outputs(["actual_q", "actual_qd"], 500.0) == SETUP_500
        assert rtde.packed(rtde.START) == START
        assert rtde.packed(rtde.PAUSE) == PAUSE
        stream = VERSION_ACCEPTED + CONTROLLER_5_8 + SETUP_TYPES + STARTED + DATA
        kinds, payloads = zip(*rtde.Packages().push(stream), strict=True)
        assert bytes(kinds) == b"VvOSU"
        assert payloads[0] == payloads[3] == b"\1"
        recipe = rtde.recipe_of(["timestamp", "target_speed_fraction"], b"\1DOUBLE,DOUBLE")
        assert recipe.values(payloads[4]) == {
            "timestamp": pytest.approx(16412.206, abs=5e-4),
            "target_speed_fraction": 1.0,
        }
        ((_, payload),) = rtde.Packages().push(DATA_Q)
        recipe = rtde.recipe_of(["timestamp", "actual_q"], SETUP_TYPES[3:])
        assert recipe.values(payload) == {"timestamp": 100000.0, "actual_q": [1.0, -1.0, 2.0, -2.0, 0.5, 0.0]}
        assert recipe.values(payload[:-1]) is None
        assert recipe.values(b"\2" + payload[1:]) is None

    @pytest.mark.parametrize(
        ("type_", "data", "value"),
        [
            ("BOOL", "01", True),
            ("UINT8", "ff", 255),
            ("UINT32", "ffffffff", 2**32 - 1),
            ("UINT64", "8000000000000001", 2**63 + 1),
            ("INT32", "fffffffe", -2),
            ("DOUBLE", "c004000000000000", -2.5),
            ("VECTOR3D", "3ff0000000000000 4000000000000000 4008000000000000", [1.0, 2.0, 3.0]),
            ("VECTOR6INT32", "00000001 00000002 00000003 ffffffff 00000005 00000006", [1, 2, 3, -1, 5, 6]),
            ("VECTOR6UINT32", "00000001 00000002 00000003 ffffffff 00000005 00000006", [1, 2, 3, 2**32 - 1, 5, 6]),
        ],
    )
    def test_every_type(self, type_, data, value):
        recipe = rtde.recipe_of(["x"], b"\7" + type_.encode())
        assert recipe.values(b"\7" + bytes.fromhex(data)) == {"x": value}

    @pytest.mark.parametrize("size", [0, 1, 2])
    def test_a_size_that_cannot_be(self, size):
        packages = rtde.Packages()
        found = packages.push(DATA_Q + bytes([0, size, 85]) + DATA_Q)
        assert [kind for kind, _ in found] == [rtde.DATA, rtde.BROKEN]
        assert found[1][1] == bytes([0, size, 85]) + DATA_Q  # nothing is lost
        assert packages.broken
        assert packages.push(DATA_Q) == []


class Controller(Peer):
    """A controller that expects requests byte by byte and answers each as the script has it; then ``last`` is done."""

    def __init__(self, script, last=lambda peer: None, connections=1):
        self.wrong, self.after = [], b""
        self._script, self._last = script, last
        super().__init__(self._play, connections)
        self.url = f"rtde://{self.address}"

    def _play(self, peer):
        peer.settimeout(PATIENCE_S)
        for request, answer in self._script:
            got = b""
            while len(got) < len(request):
                piece = peer.recv(len(request) - len(got))
                if not piece:
                    return
                got += piece
            if got != request:
                self.wrong.append((got, request))
            peer.sendall(answer)
        self._last(peer)
        with suppress(OSError):  # a client that leaves while something is on its way to it resets the connection
            while piece := peer.recv(4096):
                self.after += piece

    def finish(self):
        self.close()
        assert not self.wrong


def setup(names, hz):
    text = ",".join(names).encode()
    return struct.pack(">HBd", 11 + len(text), ord("O"), hz) + text


def answer(recipe, types):
    return struct.pack(">HBB", 4 + len(types), ord("O"), recipe) + types


def data(t, recipe=1):
    """A data package of all NAMES: q is 0.1 … 0.6, q_cmd 1.1 … 1.6, qd 2.1 …, current 3.1 …"""
    vectors = [k + 0.1 * i for k in range(4) for i in range(1, 7)]
    return struct.pack(">HBBd24dQiI", 220, ord("U"), recipe, t, *vectors, 5, 7, 2)


GREETING = [(VERSION_2, VERSION_ACCEPTED), (CONTROLLER, CONTROLLER_5_8)]
WHOLE = [*GREETING, (setup(NAMES, 500.0), answer(1, ALL_TYPES)), (START, STARTED)]


def lines_of(link, n):
    """Return at least n lines, each with its stamp."""
    arrivals, deadline = [], HostClock().now_ns() + PATIENCE_S * 1e9
    while sum(piece.count(b"\n") for _, piece in arrivals) < n and HostClock().now_ns() < deadline:
        arrivals += link.read(0.1)
    return [line for _, piece in arrivals for line in piece.splitlines()]


def readings(script, packages, n, query=""):
    controller = Controller(script, lambda peer: peer.sendall(packages))
    link = RtdeLink(controller.url + query, HostClock())
    lines = lines_of(link, n)
    link.close()
    controller.finish()
    assert controller.after == PAUSE
    return lines


class TestClient:
    def test_a_stream(self):
        lines = readings(WHOLE, data(12.0) + data(12.002), 2)
        first, second = map(json.loads, lines)
        assert first == {
            "t": 12.0,
            "seq": 0,
            "q": [0.1 * i for i in range(1, 7)],
            "q_cmd": [1 + 0.1 * i for i in range(1, 7)],
            "qd": [2 + 0.1 * i for i in range(1, 7)],
            "current": [3 + 0.1 * i for i in range(1, 7)],
            "inputs": 5,
            "robot_mode": 7,
            "runtime_state": 2,
        }  # bit by bit: each double came through text and back
        assert (second["t"], second["seq"]) == (12.002, 1)
        assert all(parse_line(line) for line in lines)

    def test_gaps_and_rates(self):
        ticks = [0, 1, 2, 5, 6]
        lines = readings(WHOLE, b"".join(data(2047.786 + 0.002 * k) for k in ticks), 5)
        assert [json.loads(line)["seq"] for line in lines] == ticks
        script = [*GREETING, (setup(NAMES, 100.0), answer(1, ALL_TYPES)), (START, STARTED)]
        lines = readings(script, data(1.0) + data(1.01), 2, "?hz=100")
        assert [json.loads(line)["seq"] for line in lines] == [0, 1]

    def test_who_talks_without_being_asked_is_none(self):
        """Packages that are right and that nobody wants: they are not gathered for seconds."""

        def talk(peer):
            with suppress(OSError):
                for _ in range(2000):
                    peer.sendall(1000 * TEXT)

        controller = Controller([], talk)
        tracemalloc.start()
        with pytest.raises(LinkError, match="RTDE"):
            RtdeLink(controller.url, HostClock())
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
        tracemalloc.stop()
        controller.finish()

    def test_an_old_controller_has_another_rate_and_fewer_fields(self):
        script = [
            (VERSION_2, VERSION_ACCEPTED),
            (CONTROLLER, CONTROLLER_3_15),
            (
                setup(NAMES, 125.0),
                answer(0, ALL_TYPES.replace(b"UINT32", b"NOT_FOUND").replace(b"UINT64", b"NOT_FOUND")),
            ),
            (setup([*NAMES[:5], "robot_mode"], 125.0), answer(3, b"DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D,VECTOR6D,INT32")),
            (START, STARTED),
        ]
        packages = b"".join(struct.pack(">HBBd24di", 208, 85, 3, t, *[0.5] * 24, 7) for t in (1.0, 1.008))
        first, second = map(json.loads, readings(script, packages, 2))
        assert set(first) == {"t", "seq", "q", "q_cmd", "qd", "current", "robot_mode"}
        assert (first["seq"], second["seq"]) == (0, 1)

    @pytest.mark.parametrize(("controller", "hz", "full"), [(CONTROLLER_5_8, 200, 500), (CONTROLLER_3_15, 500, 125)])
    def test_a_rate_that_does_not_divide_the_full_one(self, controller, hz, full):
        player = Controller([(VERSION_2, VERSION_ACCEPTED), (CONTROLLER, controller)])
        with pytest.raises(InputError, match=f"divides .* controller's {full} Hz"):
            RtdeLink(f"{player.url}?hz={hz}", HostClock())
        player.finish()

    def test_everything_else_is_kept_and_is_no_reading(self):
        unknown, short, other = (
            h("00 06 02 aa bb cc"),
            data(5.0)[:-4].replace(b"\0\xdc", b"\0\xd8", 1),
            data(5.0, recipe=9),
        )
        lines = readings(WHOLE, TEXT + unknown + short + other + data(5.0), 5)
        text, *strangers, reading = map(json.loads, lines)
        assert text == {"rtde": ord("M"), "payload": "\x07Stopped\tControlle\x02"}
        assert [row["payload"].encode("latin-1") for row in strangers] == [unknown[3:], short[3:], other[3:]]
        assert [row["rtde"] for row in strangers] == [2, 85, 85]
        assert reading["t"] == 5.0
        assert not any(parse_line(line) for line in lines[:-1])
        script = [*WHOLE[:-1], (START, TEXT + STARTED + data(1.0))]
        lines = readings([(script[0][0], TEXT + script[0][1]), *script[1:]], data(1.002), 4)
        assert [sorted(json.loads(line))[0] for line in lines] == ["payload", "payload", "current", "current"]

    @pytest.mark.parametrize("t", [float("nan"), float("inf"), -1.0, 1e300])
    def test_an_impossible_time_is_no_reading(self, t):
        lines = readings(WHOLE, data(1.0) + data(t) + data(1.002), 3)
        assert [parse_line(line) is not None for line in lines] == [True, False, True]
        if not math.isfinite(t):  # which a line cannot hold
            assert json.loads(lines[1])["payload"].encode("latin-1") == data(t)[3:]

    def test_the_stamp_is_that_of_the_last_byte(self):
        clock = HostClock()
        sent = []

        def in_two_parts(peer):
            peer.sendall(data(1.0)[:100])
            threading.Event().wait(0.05)
            sent.append(clock.now_ns())
            peer.sendall(data(1.0)[100:])

        controller = Controller(WHOLE, in_two_parts)
        link = RtdeLink(controller.url, clock)
        arrivals = []
        while not arrivals:
            arrivals = link.read(0.1)
        assert arrivals[0][0] >= sent[0]
        link.close()
        controller.finish()

    def test_a_stream_that_breaks(self):
        """What came before and the bytes that are none are handed out before the error."""
        controller = Controller(WHOLE, lambda peer: peer.sendall(data(1.0) + b"\0\0\0junk"))
        link = RtdeLink(controller.url, HostClock())
        reading, broken = map(json.loads, lines_of(link, 2))
        assert reading["t"] == 1.0
        assert broken["payload"].encode() == b"\0\0\0junk"
        with pytest.raises(LinkError, match="RTDE"):
            lines_of(link, 3)
        link.close()
        controller.finish()


def test_a_package_of_an_impossible_size_costs_a_connection_and_not_the_recording(tmp_path):
    times = iter([(1.0, b"\0\1U"), (2.0, b"")])

    def talk(peer):
        t, broken = next(times)
        peer.sendall(b"".join(data(t + 0.002 * k) for k in range(5)) + broken)

    controller = Controller(WHOLE, talk, connections=2)
    out = tmp_path / "s.mcap"
    with box_on_a_socket() as (_, device):
        code = main(["record", "--box", device, "--address", controller.url, "--duration-s", "1.5", "--out", str(out)])
    controller.finish()
    assert code == 0
    assert [kind for kind in events(out) if kind.startswith("robot")] == ["robot-lost", "robot-back"]
    stored = topics(out)
    assert "/robot/joints" not in stored
    read = unpack(*(message.data for message in stored["/robot/readings"]))
    assert read.t.tolist() == [t + 0.002 * k for t in (1.0, 2.0) for k in range(5)]
    assert len(stored["/robot/preview"]) == 2  # ten a second, for viewers
    assert json.loads(stored["/robot/preview"][0].data)["q"] == read.q[0].tolist()


REFUSALS = {
    "version": ([(VERSION_2, VERSION_REFUSED)], "speak version 2"),
    "no controller": ([(VERSION_2, VERSION_ACCEPTED), (CONTROLLER, h("00 04 76 01"))], "report its version"),
    "fields": (
        [*GREETING, (setup(NAMES, 500.0), answer(0, b"DOUBLE,NOT_FOUND" + ALL_TYPES[15:]))],
        "refuses .*fields",
    ),
    "rubbish": ([*GREETING, (setup(NAMES, 500.0), answer(1, b"\xff\xfe"))], "refuses .*fields"),
    "start": ([*WHOLE[:-1], (START, NOT_STARTED)], "refuses to send"),
    "another protocol": ([(VERSION_2, b"HTTP/1.1 400 Bad Request\r\n\r\n")], "no answer to RTDE's 'V'"),
    "sizes": ([(VERSION_2, b"\0\0\0\0")], "RTDE"),
}


@pytest.mark.parametrize(("script", "says"), REFUSALS.values(), ids=REFUSALS)
def test_refusals_are_one_clear_line(monkeypatch, script, says):
    monkeypatch.setattr("truearm.record.robots.rtde.ANSWER_NS", 300_000_000)
    controller = Controller(script)
    with pytest.raises(LinkError, match=says) as failure:
        RtdeLink(controller.url, HostClock())
    assert str(failure.value).startswith(controller.url)
    assert "\n" not in str(failure.value)
    controller.finish()


def test_nobody_there():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"rtde://127.0.0.1:{listener.getsockname()[1]}"
    with pytest.raises(LinkError, match=url):
        RtdeLink(url, HostClock())


@pytest.mark.parametrize(
    "url",
    [
        "rtde://",
        "rtde://h:0x",
        "rtde://h/x",
        "rtde://h?hz=",
        "rtde://h?hz=0",
        "rtde://h?hz=501",
        "rtde://h?x=1",
        "rtde://h:99999",
    ],
)
def test_an_address_that_is_none(url):
    with pytest.raises(InputError, match="address: "):
        RtdeLink(url, HostClock())
