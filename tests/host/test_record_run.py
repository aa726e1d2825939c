"""The recorder in virtual time without faults; a robot whose readings cannot be stored at once, or are none; request ids."""

import json
import re
import subprocess
import sys
import time
from types import SimpleNamespace

import cbor2
import pytest
from record_box import HOST_0, LATENCY, PERIOD_NS, SECOND, Box, Lab, N, Robot, Wire
from record_files import Watching, events, received, run, topics
from record_real import box_on_a_socket, line_of
from tests.host.tcp_peer import Peer

from truearm.record.intake import MAX_LINE
from truearm.record.links import Backlog
from truearm.record.recorder import RecordOptions
from truearm.record.requests import CTRL_C, Requests
from truearm.session.session_file import open_session
from truearm.workflows.record import what_is_missing
from truearm_wire.frame import unframe
from truearm_wire.messages import CONFIGURE, IDENTIFY, PUT_CONFIG, RESET, START, SYNC_REQUEST, decode_payload


def test_what_is_in_the_file(lab, path):
    """Every byte of the box, by arrival; ten clock exchanges a second, between whose t0 and t3 lies the box's time."""
    box = Box(lab)
    summary = run(lab, box, path, 5.0, robot=Robot(lab, 10.0).link)
    found, session = topics(path), open_session(path)
    blocks = [cbor2.loads(m.data) for m in found["/box/adc"]]
    assert received(path) == box.sent.replace(b"\0", b"")
    assert [b[3] for b in blocks] == list(range(0, N * len(blocks), N))
    assert len(blocks) == box.blocks == pytest.approx(5 * SECOND / (N * PERIOD_NS), abs=3)
    assert [c[0] for c in box.commands] == [48, 51, 50, 51]
    assert (summary.reason, events(path), box.streaming) == ("duration", ["start", "stop"], False)
    assert summary.counters.samples == N * len(blocks)
    assert summary.counters.lost_frames == summary.counters.console_bytes == 0
    assert summary.duration_s == pytest.approx(5.0, abs=0.05)
    ident = json.loads(session.metadata["box"]["ident"])
    assert (ident["uid"], ident["streams"][0]["name"]) == ("01020304", "adc")
    assert session.metadata["session"]["clock"] == "virtual"
    assert session.metadata["session-end"]["reason"] == "duration"
    assert int(session.metadata["session-end"]["samples"]) > 0
    times = [m.t_host_ns for m in session.messages()]
    assert times == sorted(times)
    for message, block in zip(found["/box/adc"], blocks, strict=True):
        assert message.t_host_ns == pytest.approx(box.born + 1000 * block[4] + LATENCY, abs=1000)
    rows = [json.loads(m.data) for m in found["/sync"]]
    assert len(rows) == len({row["id"] for row in rows}) == summary.counters.probes == pytest.approx(50, abs=1)
    for row in rows:
        assert row["t3_ns"] - row["t0_ns"] == 2 * LATENCY
        assert row["t0_ns"] < box.born + 1000 * row["t1_us"] + 1000
        assert box.born + 1000 * row["t2_us"] < row["t3_ns"]


def test_two_runs_are_the_same(tmp_path):
    for name in ("a", "b"):
        lab = Lab()
        run(lab, Box(lab), tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_configure_only_if_it_differs(lab, path):
    box = Box(lab)
    run(lab, box, path, options=RecordOptions(osr=2048))
    assert [c[0] for c in box.commands] == [48, 51, 49, 48, 50, 51]
    assert box.commands[2][2:] == [0, 2048]
    assert json.loads(open_session(path).metadata["box"]["ident"])["streams"][0]["osr"] == 2048


def test_plan_rig_and_mounting_come_first_and_progress_is_shown(lab, path):
    poses = [{"pose": i, "shell": "s", "bar": "b", "chuck": "c", "sphere": "p", "q": [0.1, i]} for i in range(3)]
    options = RecordOptions(plan=poses, rig_toml=b"# rig\n", mounted={"bar": "b", "chuck": "c"})
    seen = []
    run(lab, Box(lab), path, options=options, operator=Watching(seen.append))
    assert [json.loads(m.data) for m in topics(path)["/plan"]] == poses
    assert open_session(path).attachments == {"rig.toml": b"# rig\n"}
    assert events(path, "mounted") == [{"kind": "mounted", "bar": "b", "chuck": "c"}]
    assert len(seen) == pytest.approx(12, abs=2)
    first, last = seen[0], seen[-1]
    assert (first.state, first.counters.samples, first.rtt_us, first.robot_ok) == ("identifying", 0, None, None)
    assert last.state == "recording"
    assert last.counters.samples > 2500


def test_a_box_left_streaming_by_a_killed_recorder(lab, path):
    box = Box(lab)
    box.streaming = True
    box._block(box.boot_id, 0)
    for _ in range(2000):
        lab.step(HOST_0 + SECOND)
    run(lab, box, path)
    found = topics(path)
    assert [c[0] for c in box.commands] == [48, 51, 50, 51]
    assert found["/box/stream0"]  # what came before the ident gave the stream a name
    firsts = [cbor2.loads(m.data)[3] for m in found["/box/adc"]]
    assert firsts.count(0) == 1


BURST = 30_000  # readings of 52 bytes: 380 pieces of 4096 bytes
SMALL_QUEUE = (
    "import truearm.record.links as l; l._QUEUE_ITEMS = 16; from truearm.cli.main import main; raise SystemExit(main())"
)


def bursting_robot(lost):
    """Return the address of a robot that sends a burst, then a few readings as they come; ``lost`` are left out."""

    def talk(peer):
        peer.sendall(b"".join(map(line_of, range(BURST))))
        for k in range(BURST + lost, BURST + lost + 100):
            peer.sendall(line_of(k))
            time.sleep(0.01)
        peer.sendall(b'{"end": true}\n')

    return f"tcp://{Peer(talk).address}"


@pytest.mark.parametrize(("lost", "code"), [(0, 0), (7, 4)])
def test_a_stream_that_was_held_up_is_complete_if_nothing_is_missing(tmp_path, lost, code):
    """TCP makes the sender wait, so only readings that the robot itself left out are lost."""
    out = tmp_path / "s.mcap"
    with box_on_a_socket() as (_, device):
        options = ["--unchecked", "--box", device, "--address", bursting_robot(lost), "--out", out]
        command = [sys.executable, "-c", SMALL_QUEUE, "record", *map(str, options)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == code, done.stderr
    assert "robot sends more than can be stored" in done.stderr
    assert re.findall(r"(\d+) readings\b(?!/)", done.stderr.splitlines()[-1]) == [str(lost)] * bool(lost)
    stored = [json.loads(m.data)["seq"] for m in topics(out)["/robot/joints"]]
    assert stored == [*range(BURST), *range(BURST + lost, BURST + lost + 100)]


class Backlogged(Wire):
    """A link whose reader holds what has arrived: few pieces are taken at a time."""

    @property
    def backlog(self):
        return Backlog(len(self.arrived))

    def read(self, timeout_s):
        arrived = super().read(timeout_s)
        self.arrived = arrived[10:]
        return arrived[:10]


@pytest.mark.parametrize("mute", [False, True])
@pytest.mark.parametrize("ending", ["duration", "interrupted"])
def test_what_was_received_before_the_end_is_stored(lab, path, ending, mute):
    """Readings that came at once, as after a laptop woke, were dropped; also if the box does not answer any more."""
    robot, box = Robot(lab, 100.0, link=Backlogged), Box(lab)
    end_ns = HOST_0 + 2 * SECOND
    burst = [json.dumps({"t": 200 + k, "seq": 1000 + k, "q": [0.0] * 6}).encode() for k in range(5000)]

    def wake():
        for line in burst:
            robot.say(line)
        if mute:
            box.link.on_write = lambda data: None

    lab.at(end_ns, wake)
    how = {"seconds": 2.0} if ending == "duration" else {"seconds": None, "interrupted": lambda: lab.now >= end_ns}
    summary = run(lab, box, path, robot=robot.link, **how)
    assert summary.reason == ending
    assert bool(summary.box_gone) == mute
    assert summary.counters.robot_unstored == 0
    stored = [m.data for m in topics(path)["/robot/joints"]]
    assert stored == robot.sent[: len(stored)]
    assert stored[-1] not in burst
    assert set(burst) <= set(stored)


@pytest.mark.parametrize(
    ("drops", "counts", "skipped", "says"),
    [
        (False, True, 0, ""),
        (False, False, 0, ""),
        (False, True, 3, "3 readings are missing"),
        (True, True, 0, ""),
        (True, True, 1, "1 reading is missing"),
        (True, False, 0, "readings may be missing"),
    ],
)
def test_what_a_held_up_robot_lost(lab, path, drops, counts, skipped, says):
    """By the numbers of its readings; without numbers, datagrams may be lost and a stream is not."""
    robot = Robot(lab, 2.0, counts=counts)
    robot.link.backlog = Backlog(0, 1, drops)
    say = robot.say
    robot.say = lambda line: None if 10 <= (json.loads(line)["t"] - 100) / 0.008 + 0.5 < 10 + skipped else say(line)
    summary = run(lab, Box(lab), path, seconds=3.0, robot=robot.link)
    missing = [finding.text() for finding in what_is_missing(summary, with_robot=True)]
    assert (says in missing[0]) if says else missing == []


def at(now_ns):
    return Requests(None, SimpleNamespace(now_ns=lambda: now_ns), None)


@pytest.mark.parametrize("hours", [0, 1e-3, 200.0])
@pytest.mark.parametrize(("kind", "arguments"), [(IDENTIFY, ()), (SYNC_REQUEST, ()), (START, ()), (RESET, (0,))])
def test_no_frame_stops_a_box_that_boots(hours, kind, arguments):
    requests = at(int(hours * 3600e9))
    made = [requests.make(kind, *arguments) for _ in range(1000)]
    assert not any(CTRL_C in data for _, data in made)
    assert len({number for number, _ in made}) == 1000
    for number, data in made:
        assert decode_payload(unframe(data.strip(b"\0"))) == [kind, number, *arguments]


@pytest.mark.parametrize(("kind", "arguments"), [(PUT_CONFIG, (0, 1, b"\x03")), (CONFIGURE, (0, 4096))])
def test_what_holds_the_byte_whatever_its_id_is_sent_all_the_same(kind, arguments):
    """A page, or two zeros three bytes apart (COBS). They follow an answer, so the box has booted."""
    number, data = at(0).make(kind, *arguments)
    assert CTRL_C in data
    assert decode_payload(unframe(data.strip(b"\0"))) == [kind, number, *arguments]


GOOD = b'{"t": 1.5, "seq": 3, "q": [0.1, -2]}'
OTHERS = [
    b"hello",
    b"\xff\xfe",
    b"[1, 2]",
    b'{"t": 1}',
    b'{"t": "1", "q": [1, 2]}',
    b'{"t": true, "q": [1, 2]}',
    b'{"t": NaN, "q": [1, 2]}',
    b'{"t": 1e999, "q": [1, 2]}',
    b'{"t": 1, "q": [1, Infinity]}',
    b'{"t": 1, "q": [1, null]}',
    b'{"t": 1, "q": []}',
    b'{"t": 1, "q": 1}',
    b'{"t": 1, "q": [1, 2], "seq": "x"}',
    b'{"t": 1, "q": [1, 2, 3]}',
    b'{"t": 1, "q": [' + b"1," * 32 + b"1]}",
    b'{"t": ' + b"9" * 400 + b', "q": [1, 2]}',
    b'{"t": ' + b"9" * 5000 + b', "q": [1, 2]}',
    b"[" * 8000,
    b'{"q":' * 1500,
]


def test_what_is_no_reading_is_kept_as_console(lab, path):
    """Also a line without end, in pieces."""
    link = Wire(lab, "robot in memory")

    def talk():
        for line in OTHERS:
            link.deliver(GOOD + b"\n" + line + b"\n")
        for _ in range(100):
            link.deliver(b"x" * 1000)

    lab.at(HOST_0 + SECOND, talk)
    summary = run(lab, Box(lab), path, robot=link)
    stored = topics(path)
    assert [m.data for m in stored["/robot/joints"]] == [GOOD] * len(OTHERS)
    console = [m.data for m in stored["/robot/console"]]
    assert console[: len(OTHERS)] == OTHERS
    assert b"".join(console[len(OTHERS) :]) == b"x" * 100_000
    assert max(map(len, console)) <= MAX_LINE
    assert summary.counters.robot_other_joints == 1
