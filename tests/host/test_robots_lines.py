"""Lines of CSV and JSON over TCP and UDP, and tables of joint readings: names, units, and what is not a reading."""

import itertools
import json
import math
import socket
import threading
import time
from contextlib import contextmanager, suppress

import pytest
from record_files import events, topics
from record_real import box_on_a_socket
from tests.host.findings_bench import listed
from tests.host.tcp_peer import Peer, Played
from tests.refusals import shown

from truearm.cli.main import main
from truearm.errors import InputError, LinkClosed, LinkError, ProtocolError, TableError
from truearm.record.intake import MAX_LINE
from truearm.record.links import HostClock, UdpLink
from truearm.record.robots.sources import FileOptions, open_source
from truearm.record.robots.text_lines import (
    OVERLONG,
    DatagramMessages,
    LineDialect,
    LinesLink,
    read_columns,
    readings,
)
from truearm.session.joint_format import format_reading, parse_line
from truearm.session.session_file import open_session

PATIENCE_S = 5.0  # only a broken link waits so long
DEG = math.pi / 180.0

NO_OPTIONS = FileOptions("")


def rows(dialect, *lines):
    return [json.loads(found) if found != line else line for line in lines for found in [dialect.line(line)]]


class TestJson:
    @pytest.mark.parametrize(
        "line",
        [
            b'{"t": 1.5, "seq": 3, "q": [0.1, -2.0]}',
            b'{"q":[1],"t":0,"q_cmd":[1],"more":{"x":1}}\r',
            b'{"t": 1, "q": []}',
            b"{",
        ],
    )
    def test_what_needs_no_change_stays_as_it_is(self, line):
        assert LineDialect({}).line(line) == line

    def test_addresses_and_declarations(self):
        dialect = LineDialect({"unit": "deg", "t_unit": "ms", "t": "stamp", "q": "pos", "q_cmd": "cmd", "qd": "vel"})
        line = b'{"stamp": 2500, "pos": [90, 180.0], "cmd": [91, 181], "vel": [1, 2], "seq": 4, "inputs": 3}'
        (row,) = rows(dialect, line)
        assert row == {
            "t": 2.5,
            "seq": 4,
            "q": [90 * DEG, 180.0 * DEG],
            "q_cmd": [91 * DEG, 181 * DEG],
            "qd": [DEG, 2 * DEG],
            "inputs": 3,
            "line": line.decode(),
        }
        (row,) = rows(LineDialect({"q": "j1,j2,j3", "unit": "deg,rad,mm"}), b'{"t": 1, "j2": 0.5, "j1": 90, "j3": 250}')
        assert row["q"] == [90 * DEG, 0.5, 0.25]
        declaration = b'{"names": {"q": ["a", "b"], "t": "time"}, "unit": "deg", "t_unit": "ns"}'
        same, row, rest = rows(
            LineDialect({}), declaration, b'{"time": 1764000000123456789, "a": 90, "b": 0}', b'{"t": 1, "q": [1]}'
        )
        assert same == declaration
        assert row["q"] == [90 * DEG, 0.0]
        assert row["t"] == 1764000000123456789 / 10**9
        assert rest == b'{"t": 1, "q": [1]}'  # not what was declared: handed on

    @pytest.mark.parametrize(
        "line",
        [
            b'{"t": 1, "q": [90, "x"]}',
            b'{"t": 1, "q": [90, NaN]}',
            b'{"t": 1, "q": [90, 1e999]}',
            b'{"t": "1", "q": [90]}',
            b'{"t": NaN, "q": [90]}',
            b'{"t": 1e999, "q": [90]}',
            b'{"t": ' + b"9" * 400 + b', "q": [90]}',
            b'{"t": true, "q": [90]}',
            b'{"q": [90]}',
            b'{"t": 1, "q": [1, 2, 3]}',  # units for two
            b"{" + b'"a":{' * 3000,
            b'{"t": 1, "q": [1, 2], "x": "' + b'\\"' * 3000 + b'"}',  # with itself inside it would be too long
        ],
    )
    def test_what_is_no_reading_goes_on_as_it_is(self, line):
        assert LineDialect({"unit": "deg,deg"}).line(line) == line

    def test_values_that_are_odd_do_not_spoil_the_reading(self):
        (row,) = rows(
            LineDialect({"unit": "deg"}),
            b'{"t": 1, "q": [90], "q_cmd": "x", "qd": [1, 2], "inputs": "y", "current": [NaN]}',
        )
        assert set(row) == {"t", "q", "qd", "line"}

    @pytest.mark.parametrize(
        "line",
        [
            b'{"unit": "grad"}',
            b'{"t_unit": "h"}',
            b'{"names": {"x": "y"}}',
            b'{"names": {"q": 3}}',
            b'{"names": 3}',
            b'{"unit": []}',
            b'{"t_unit": []}',
        ],
    )
    def test_a_declaration_that_is_not_understood(self, line):
        with pytest.raises(InputError):
            LineDialect({}).line(line)


class TestCsv:
    def test_a_header_and_rows(self):
        dialect = LineDialect({})
        header = b"t_ms,seq,q1_deg,q2_mm,q1_cmd_deg,q2_cmd_mm,qd1_deg_s,qd2_mm_s,inputs,note\r"
        early, head, row, again, last = rows(
            dialect, b"0,1,2", header, b"1500,7,90,100,91,110,1,20,5,hello\r", header, b"1502,8,90,100,91,110,1,20,5,"
        )
        assert early == b"0,1,2"
        assert head == again == header
        assert row == {
            "t": 1.5,
            "seq": 7,
            "q": [90 * DEG, 0.1],
            "q_cmd": [91 * DEG, 0.11],
            "qd": [DEG, 0.02],
            "inputs": 5,
            "line": "1500,7,90,100,91,110,1,20,5,hello",
        }
        assert last["t"] == 1.502

    def test_columns_in_any_order_or_in_the_address(self):
        row = ["x", "9", "3", "20", "2e9", "-5", "7", "1.5"]
        columns = read_columns(["note", "inputs", "q2_mm", "q1_deg", "qd1_rad_s", "qd2_mm_s", "seq", "t_ms"])
        line = f'{{"t":0.0015,"seq":7,"q":[{20 * DEG},0.003],"inputs":9,"x":1}}'.encode()
        assert columns.line(row, x=1) == line, "velocities beyond the limits of a session are left out"
        (row,) = rows(LineDialect({"columns": "t_s,q2_rad,q1_rad"}), b"1,2,3")
        assert row == {"t": 1.0, "q": [3.0, 2.0], "line": "1,2,3"}

    @pytest.mark.parametrize(
        "line",
        [b"1,2", b"1,2,3,4", b"1,x,3", b"1,,3", b"1,nan,3", b"1,1_0,3", b"1,inf,3", b"1,2,\xff", "1,2,٣".encode(), b""],
    )
    def test_what_is_no_row_goes_on_as_it_is(self, line):
        assert LineDialect({"columns": "t_s,q1_rad,q2_rad"}).line(line) == line

    @pytest.mark.parametrize(
        ("header", "says"),
        [
            ("seq,q1_rad", "has no column t_s"),
            ("t_s", "columns"),
            ("t_s,q2_rad", "columns"),
            ("t_s,q1_rad,q2_rad,q1_cmd_rad", "q_cmd"),
            ("t_s,q1_rad,q1_deg", "given twice"),
            ("t_s,t_ms,q1_rad", "given twice"),
            ("t_s,q1_grad", "'q1_grad'"),
            ("t_s,q1", "'q1'"),
            ("t_s,q1_rad,qd1_rad", "'qd1_rad'"),
            ("t_s,q1_rad,q1_rad_s", "'q1_rad_s'"),
            ("t_s,q0_rad", "'q0_rad'"),
            ("t_s," + ",".join(f"q{i}_rad" for i in range(1, 34)), "'q33_rad'"),
            ("t_s," + ",".join(f"x_{i}" for i in range(300)), "301 columns"),
        ],
    )
    def test_headers_that_are_not_understood(self, header, says):
        with pytest.raises(InputError, match=says) as failure:
            read_columns(header.split(","))
        assert len(str(failure.value)) < 300


def all_of(link):
    """Return everything received until the end, and the end."""
    got, deadline = b"", HostClock().now_ns() + PATIENCE_S * 1e9
    while HostClock().now_ns() < deadline:
        try:
            got += b"".join(data for _, data in link.read(0.1))
        except LinkError as exc:
            link.close()
            return got, exc
    raise AssertionError("no end came")


class TestTcp:
    def test_lines_then_the_end(self):
        peer = Peer(b"t_s,q1_deg\n1,90\n2,180\nhello\n3,2")
        got, end = all_of(open_source(f"lines+tcp://{peer.address}", HostClock()))
        *lines, rest = got.split(b"\n")
        assert [parse_line(line) and parse_line(line).q for line in lines] == [
            None,
            [90 * DEG],
            [180 * DEG],
            None,
        ]
        assert rest == b"3,2"  # half a line is not a reading
        assert isinstance(end, LinkClosed)

    def test_plain_lines_are_untouched(self):
        sent = b'{"t": 1.50, "q": [0.10]}\nhello\r\n\xff\xfe\n{"t":2,"q":[1]}\n'
        assert all_of(open_source(f"lines+tcp://{Peer(sent).address}", HostClock()))[0] == sent
        assert all_of(open_source(f"tcp://{Peer(sent).address}", HostClock()))[0] == sent

    def test_no_piece_of_an_overlong_line_passes_for_a_reading(self):
        reading = b'{"t":1,"q":[1]}'
        peer = Peer(b"x" * MAX_LINE + reading + b"\n" + reading + b"\n")
        got, _ = all_of(open_source(f"lines+tcp://{peer.address}", HostClock()))
        assert [parse_line(line) is not None for line in got.splitlines()] == [False, False, True]
        assert got.replace(OVERLONG, b"").replace(b"\n", b"") == b"x" * MAX_LINE + reading * 2

    def test_a_header_counts_for_the_connections_behind_it_too(self):
        """A program prints it once, and goes on when the network is back. The first row of a connection may have lost its head."""
        texts = iter((b"t_s,q1_deg\n1,90\n", b"2.5,90\n13,180\n"))
        robot = Peer(lambda peer: peer.sendall(next(texts)), clients=2)
        link, lines = open_source(f"lines+tcp://{robot.address}", HostClock()), []
        for again in (False, True):
            assert not again or link.reopen(PATIENCE_S)
            got = b""
            with suppress(LinkClosed):
                while True:
                    got += b"".join(data for _, data in link.read(0.1))
            lines.append([parse_line(line) and parse_line(line).t for line in got.splitlines()])
        link.close()
        assert lines == [[None, 1.0], [None, 13.0]]


@contextmanager
def sender(address):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        try:
            opened.bind((address, 0))
        except OSError:
            pytest.skip(f"this machine has no address {address}")
        yield opened


def arrivals_of(link, count):
    """Return that many arrivals, fewer if they do not come."""
    deadline = time.monotonic() + PATIENCE_S
    arrivals = []
    while len(arrivals) < count and time.monotonic() < deadline:
        arrivals += link.read(0.1)
    return arrivals


class SetClock:
    """A clock that stands until it is set."""

    kind = "virtual"
    t_s = 100.0

    def now_ns(self):
        return round(1e9 * self.t_s)


class TestUdp:
    @pytest.fixture
    def free(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            return probe.getsockname()[1]

    def test_the_robot_is_who_sends_readings(self, free):
        """A stranger whose datagrams were no readings once was the robot: the real one was locked out as long as it sent.
        One that looked like a wrong header ended the recording; only the robot's own does.
        """
        clock = SetClock()
        link = open_source(f"lines+udp://127.0.0.1:{free}", clock)
        with sender("127.0.0.1") as stranger, sender("127.0.0.2") as robot:
            for line in (b"t_s,time_of_day", b'{"names": {"colour": "c"}}', b"who is there"):
                stranger.sendto(line, ("127.0.0.1", free))
            robot.sendto(b"t_s,q1_rad", ("127.0.0.1", free))
            arrivals = arrivals_of(link, 4)[2:]
            for k in range(5):
                stranger.sendto(b"who is there", ("127.0.0.1", free))
                robot.sendto(b"%d,0.5" % k, ("127.0.0.1", free))
            arrivals += arrivals_of(link, 6)
            while link.backlog.foreign < 4:
                assert not link.read(0.01)
            robot.sendto(b"t_s,q1_inch", ("127.0.0.1", free))
            with pytest.raises(ProtocolError, match="q1_inch"):
                arrivals_of(link, 2)
        link.close()
        assert [line for _, line in arrivals[:3]] == [b"who is there\n", b"t_s,q1_rad\n", b"who is there\n"]
        assert [parse_line(line).t for _, line in arrivals[3:]] == [0.0, 1.0, 2.0, 3.0, 4.0]

    def test_another_address_takes_over_after_three_seconds_without_a_reading(self, free):
        clock = SetClock()
        link = open_source(f"lines+udp://127.0.0.1:{free}?columns=t_s,q1_rad", clock)
        with sender("127.0.0.1") as first, sender("127.0.0.2") as second:
            first.sendto(b"0,0.5", ("127.0.0.1", free))
            assert arrivals_of(link, 1)
            clock.t_s += 2.9
            first.sendto(b"emergency stop", ("127.0.0.1", free))  # is no reading
            assert arrivals_of(link, 1)
            for k in range(5):
                second.sendto(b"%d,0.5" % k, ("127.0.0.1", free))
            while link.backlog.foreign < 5:
                assert not link.read(0.01)
            clock.t_s += 0.2
            second.sendto(b"who is there", ("127.0.0.1", free))  # nor does this take over
            first.sendto(b"waiting", ("127.0.0.1", free))
            assert len(arrivals_of(link, 2)) == 2
            second.sendto(b"5,0.5", ("127.0.0.1", free))
            with pytest.raises(
                LinkError, match=r"127\.0\.0\.1 sent no reading for 3 s, and 127\.0\.0\.2 sends instead"
            ):
                arrivals_of(link, 1)
            while not link.reopen(0.1):
                pass
            second.sendto(b"6,0.5", ("127.0.0.1", free))
            assert parse_line(arrivals_of(link, 1)[0][1]).t == 6.0
        assert link.backlog.foreign == 5  # of the first link
        link.close()

    def test_a_recording_counts_other_senders_and_notes_the_change(self, free, tmp_path, monkeypatch, capsys, printed):
        monkeypatch.setattr("truearm.record.robots.text_lines.SILENCE_S", 0.2)
        stop = threading.Event()

        def play():
            with sender("127.0.0.1") as first, sender("127.0.0.2") as second:
                for k in itertools.count():
                    if k < 150:  # 1.5 s, in which also a busy computer opens box and robot
                        first.sendto(b"%d,0.5" % k, ("127.0.0.1", free))
                    second.sendto(b"%d,0.7" % (1000 + k), ("127.0.0.1", free))
                    if stop.wait(0.01):
                        return

        out = tmp_path / "s.mcap"
        with sender("127.0.0.2"), box_on_a_socket() as (_, device):
            thread = threading.Thread(target=play)
            thread.start()
            address = f"lines+udp://127.0.0.1:{free}?columns=t_s,q1_rad"
            code = main(["record", "--box", device, "--address", address, "--duration-s", "3", "--out", str(out)])
            stop.set()
            thread.join()
        assert code == 0
        assert shown["recording-disturbed"]["robot_foreign"] > 0
        capsys.readouterr()
        assert [kind for kind in events(out) if kind.startswith("robot")] == [
            "robot-foreign",
            "robot-lost",
            "robot-back",
        ]
        q = [json.loads(m.data)["q"] for m in topics(out)["/robot/joints"]]
        assert [0.5] in q
        assert q[-1] == [0.7]
        foreign = open_session(out).metadata["session-end"]["robot_foreign"]
        assert int(foreign) >= 20
        assert listed(json.loads(printed("inspect", out, "--json")))["foreign-datagrams"] == {"n": int(foreign)}

    def test_a_port_that_is_taken(self, free):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
            robot.bind(("127.0.0.1", free))
            with pytest.raises(LinkError, match="cannot listen there"):
                open_source(f"lines+udp://127.0.0.1:{free}", HostClock())


@pytest.mark.parametrize(
    "url",
    [
        "x://127.0.0.1:1",
        "127.0.0.1:1",
        "lines+tcp://127.0.0.1",
        "lines+udp://",
        "lines+tcp://127.0.0.1:1?unit",
        "lines+tcp://127.0.0.1:1?unit=grad",
        "lines+tcp://127.0.0.1:1?columns=a,b",
        "lines+tcp://127.0.0.1:1?nonsense=1",
        "lines+tcp://127.0.0.1:1?" + "&".join(["t=x"] * 30),
    ],
)
def test_addresses_that_are_none(url):
    with pytest.raises(InputError):
        open_source(url, HostClock())


@pytest.mark.parametrize("size", [1, 3, 7, 1000])
def test_how_the_stream_is_cut_does_not_matter(size):
    sent = b"t_s,q1_deg\n1,90\n" + b'{"names":{"q":"p"}}\n{"t":1,"p":[2]}\n' + b"y" * 9000 + b"\n2,180\n"
    pieces = [sent[i : i + size] for i in range(0, len(sent), size)]
    link = LinesLink(Played(pieces), HostClock(), LineDialect({}))
    got = b"".join(data for _ in range(len(pieces)) for _, data in link.read(0.0))
    assert [parse_line(line).q for line in got.splitlines() if parse_line(line)] == [[90 * DEG], [2.0], [math.pi]]


class TestTable:
    @staticmethod
    def table(tmp_path, text, encoding="utf-8"):
        path = tmp_path / "joints.csv"
        path.write_bytes(text.encode(encoding))
        return path

    def test_rows(self, tmp_path):
        path = self.table(
            tmp_path, '\ufefft_s,seq,q1_deg,q1_cmd_deg,x_mode\r\n1.5,1,90,91,idle\r\n\r\n1.52,2,45,46,"a, b"\r\n'
        )
        found = [(reading.t, json.loads(reading.line)) for reading in readings(path, NO_OPTIONS)]
        assert [t for t, _ in found] == [1.5, 1.52]
        assert found[1][1] == {"t": 1.52, "seq": 2, "q": [45 * DEG], "q_cmd": [46 * DEG], "arrival": False}

    @pytest.mark.parametrize(
        ("text", "says"),
        [
            ("", "has no column t_s"),
            ("a,b\n1,2\n", "no column t_s"),
            ("t_s,q1_rad\n1,2,3\n", "row 2:"),
            ("t_s,q1_rad\n1,2\n\n2,x\n", "row 4:"),
            ("t_s,q1_rad\n-1,2\n", "row 2:"),
            ("t_s,q1_rad\n2,2\n1,2\n", "row 3: time goes back from 2 s to 1 s"),
            ('t_s,q1_rad\n1,"2\n', "CSV"),
            ("t_s,q1_rad\n1,\x00\n", "row 2: "),
            ("t_s,q1_rad\n" + "1" * 9000 + ",2\n", "more than"),
        ],
    )
    def test_what_is_wrong_is_said_with_its_row(self, tmp_path, text, says):
        path = self.table(tmp_path, text)
        with pytest.raises(TableError, match=says) as failure:
            list(readings(path, NO_OPTIONS))
        assert str(failure.value).startswith(str(path))
        assert "\n" not in str(failure.value)


class Bytes(LineDialect):
    """Two bytes are the joints of a reading, in degrees."""

    def line(self, line):
        return (
            format_reading(1.0, None, [math.radians(angle) for angle in line])
            if len(line) == 2
            else line.hex().encode()
        )


def test_a_datagram_of_bytes_reaches_its_dialect_whole():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(("127.0.0.1", 0))
        to = robot.getsockname()
    link = DatagramMessages(UdpLink(f"udp://127.0.0.1:{to[1]}", HostClock()), HostClock(), Bytes({}))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        for message in (b"\n\x1e", b"\n\n\n", b"\x1e\n"):
            robot.sendto(message, to)
    lines = []
    while len(lines) < 3:
        lines += [line for _, line in link.read(PATIENCE_S)]
    link.close()
    assert [parse_line(line).q if b"{" in line else line for line in lines] == [
        pytest.approx([math.radians(10), math.radians(30)]),
        b"0a0a0a\n",
        pytest.approx([math.radians(30), math.radians(10)]),
    ]
