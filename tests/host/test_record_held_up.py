"""A robot whose readings cannot be stored at once: late readings are complete, lost ones are not."""

import json
import subprocess
import sys
import time

import pytest
from record_box import HOST_0, SECOND, Box, Robot, Wire
from record_files import run, topics
from record_real import box_on_a_socket, line_of
from tests.host.tcp_peer import Peer

from truearm.record.links import Backlog
from truearm.workflows.record import what_is_missing

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
    if lost:
        assert "robot sent more than could be stored: 7 readings" in done.stderr.splitlines()[-1]
    else:
        assert "no reading is missing" in done.stdout
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
    missing = what_is_missing(summary, with_robot=True)
    assert (says in missing) if says else missing == ""
