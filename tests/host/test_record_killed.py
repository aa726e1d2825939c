"""SIGKILL of a real `truearm record` at random moments: all but at most the last two seconds can be recovered."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest
from record_box import run_of
from record_real import box_on_a_socket, serve_robot
from test_record_command import RIG

from truearm.cli.main import main
from truearm.record.links import HostClock
from truearm.record.requests import frame_of
from truearm.session.session_file import open_session
from truearm_wire.messages import HEARTBEAT

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
MOST_LOST_NS = 2_000_000_000
LONGEST_S = 6.0


def killed(folder, after_s):
    """Return a recording that was killed this long after the box had started, what the box sent, and when it was killed."""
    out = folder / "s.mcap"
    (folder / "rig.toml").write_text(RIG)
    with box_on_a_socket() as (box, device):
        options = [
            "--unchecked",
            "--box",
            device,
            "--address",
            serve_robot(60),
            "--rig",
            folder / "rig.toml",
            "--out",
            out,
        ]
        command = [sys.executable, "-m", "truearm", "record", *map(str, options)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 30
        while not box.streaming and time.monotonic() < deadline:
            time.sleep(0.002)
        time.sleep(after_s)
        at_ns = HostClock().now_ns()
        process.send_signal(signal.SIGKILL)
        process.wait()
        return out, box.sent, at_ns


def runs_of(session):
    """Return what the box sent according to the file."""
    messages = [m for m in session.messages() if m.topic.startswith("/box/")]
    return [m.data if m.topic == "/box/console" else run_of(m.data) for m in messages]


@pytest.mark.parametrize("n", [2, pytest.param(50, marks=pytest.mark.soak)])
def test_at_any_moment(tmp_path, capsys, n):
    """Every byte of the box up to two seconds before the end, in order; every reading of the robot likewise."""
    rng = random.Random(2)
    lost_s = []
    for k in range(n):
        folder = tmp_path / str(k)
        folder.mkdir()
        # right after the start, in the first chunk, and anywhere later
        after_s = rng.choice([0.0, rng.uniform(0.0, 1.0), rng.uniform(1.0, LONGEST_S)]) if k else 3.0
        out, sent, killed_ns = killed(folder, after_s)
        mended = folder / "recovered.mcap"
        assert main(["session", "recover", str(out), "--out", str(mended)]) == 0
        session = open_session(mended)
        assert session.attachments["rig.toml"] == RIG.encode()
        assert session.metadata["box"]["ident"]
        runs, found = [run for run in sent.split(b"\0") if run], runs_of(session)
        first = runs.index(found[0]) if found else 0
        assert found == runs[first : first + len(found)]
        # opening a port throws away what came before
        assert {frame_of(run)[0][0] for run in runs[:first]} <= {HEARTBEAT}
        times = [m.t_host_ns for m in session.messages() if m.topic.startswith("/box/")]
        begin_ns = int(session.metadata["session"]["monotonic_ns"])
        last_ns = max(times, default=begin_ns)
        assert killed_ns - last_ns <= MOST_LOST_NS
        lost_s.append(1e-9 * (killed_ns - last_ns))
        readings = [json.loads(m.data)["seq"] for m in session.messages({"/robot/joints"})]
        assert readings == list(range(len(readings)))
        if after_s >= 3.0:
            assert killed_ns - max(m.t_host_ns for m in session.messages({"/robot/joints"})) <= MOST_LOST_NS
        capsys.readouterr()
    print(f"{n} killed: the last {min(lost_s):.2f} to {max(lost_s):.2f} s are missing")
