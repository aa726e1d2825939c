"""``truearm record`` in real time, over a socket and a pseudo-terminal, ended by time, by the robot, by a signal."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from record_real import PATIENCE_S, box_on_a_socket, serve_robot
from tests.refusals import ended, shown

from truearm.cli.main import main
from truearm.plan.plan_file import write_plan
from truearm.record.links import HostClock
from truearm.session.session_file import open_session
from truearm.types import Plan
from truearm.workflows.record import nearest_osr, plan_rows

posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals or a pseudo-terminal")

CALIBRATED = {
    "name": "lvdt",
    "calibration": {"unit": "mm", "poly": [[0, 0], [1, 0]], "serial": "7", "date": "2026-11-01"},
}
RIG = """
[[chuck]]
name = "c1"
xyz_mm = [0, 0, 0]
[[sphere]]
name = "s1"
xyz_mm = [0, 0, 100]
[[bar]]
name = "bar46"
zero_mm = 460
travel_mm = 75
sigma_mm = 0.084
"""

EARLIER = b"\x89MCAP0\r\nan earlier recording"


def test_a_recording_ended_by_time(tmp_path, capsys):
    out = tmp_path / "s.mcap"
    (tmp_path / "rig.toml").write_text(RIG)
    plan = Plan(np.array([[0.1, 0.2]]), *(np.array([name]) for name in ("a", "bar46", "c1", "s1")))
    write_plan(tmp_path / "plan.csv", plan)
    with box_on_a_socket() as (box, device):
        box.lvdt = CALIBRATED
        options = ["--duration-s", "0.5", "--rate", "2000", "--mounted", "bar=bar46,chuck=c1"]
        files = ["--out", str(out), "--rig", str(tmp_path / "rig.toml"), "--plan", str(tmp_path / "plan.csv")]
        assert main(["record", "--box", device, *options, *files]) == 0
    assert not box.streaming
    session = open_session(out)
    found = {}
    for message in session.messages():
        found.setdefault(message.topic, []).append(message)
    assert len(found["/box/adc"]) == box.blocks
    assert [json.loads(m.data) for m in found["/plan"]] == plan_rows(plan)
    assert session.attachments["rig.toml"] == RIG.encode()
    assert session.metadata["session"]["clock"] == HostClock.kind
    assert json.loads(session.metadata["box"]["ident"])["streams"][0]["osr"] == 2048
    for row in (json.loads(m.data) for m in found["/sync"]):
        assert box.born + 1000 * row["t1_us"] >= row["t0_ns"] - 1000
        assert box.born + 1000 * row["t2_us"] <= row["t3_ns"]
    assert shown["recorded"]["ended"] == "duration"


def test_a_recording_ended_by_the_robot(tmp_path, capsys):
    with box_on_a_socket() as (_, device):
        out = str(tmp_path / "s.mcap")
        assert main(["record", "--box", device, "--address", serve_robot(0.5), "--out", out]) == 0
    lines = list(open_session(out).messages({"/robot/joints"}))
    assert [json.loads(m.data)["seq"] for m in lines] == list(range(len(lines)))
    assert capsys.readouterr().out.startswith(f"{out}: ")
    assert (shown["recorded"]["readings"], shown["recorded"]["ended"]) == (len(lines), "robot closed")


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_completes_the_file(tmp_path, number):
    out = tmp_path / "s.mcap"
    with box_on_a_socket() as (box, device):
        command = [sys.executable, "-m", "truearm", "record", "--box", device, "--out", str(out)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        deadline = time.monotonic() + PATIENCE_S
        while box.blocks < 10 and time.monotonic() < deadline:
            time.sleep(0.01)
        process.send_signal(number)
        said, complaint = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "Traceback" not in complaint
    assert said.split()[-1] == "interrupted."
    assert not box.streaming
    assert len(list(open_session(out).messages({"/box/adc"}))) == box.blocks


class TestRefused:
    @pytest.mark.parametrize(
        ("options", "says"),
        [
            (["--rate", "5"], "--rate 5 Hz"),
            (["--rate", "nan"], "--rate must be"),
            (["--duration-s", "-1"], "usage"),
            (["--duration-s", "inf"], "--duration-s must be"),
            (["--mounted", "bar46"], "KEY=NAME"),
            (["--mounted", "bar=a,bar=b"], "given-twice"),
            (["--plan", "none.csv"], "missing-file"),
            (["--rig", "none.toml"], "missing-file"),
            (["--box", "ftp://x"], "wrong-value"),
            (["--address", "x:1"], "tcp://"),
        ],
        ids=lambda value: " ".join(value) if isinstance(value, list) else "",
    )
    def test_options(self, tmp_path, monkeypatch, capsys, options, says):
        monkeypatch.chdir(tmp_path)
        with box_on_a_socket() as (_, device):
            assert main(["record", "--box", device, "--out", "s.mcap", *options]) == 2
        complaint = capsys.readouterr().err
        ended(complaint, says)
        assert complaint.count("\n") == 1
        assert not (tmp_path / "s.mcap").exists()

    def test_names_that_the_rig_does_not_have(self, tmp_path, capsys):
        (tmp_path / "rig.toml").write_text(RIG)
        files = ["--rig", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "s.mcap")]
        assert main(["record", "--box", "/dev/none", "--mounted", "chuck=c9", *files]) == 2
        assert "'c9'" in capsys.readouterr().err

    def test_an_existing_file(self, tmp_path, capsys):
        record, out = ["record", "--box", "/dev/none", "--out", str(tmp_path / "s.mcap")], tmp_path / "s.mcap"
        out.write_bytes(EARLIER)
        assert main(record) == 2
        assert "--force" in capsys.readouterr().err
        assert out.read_bytes() == EARLIER
        out.write_text("precious")
        assert main([*record, "--force"]) == 2
        ended(capsys.readouterr().err, "file-exists")
        assert out.read_text() == "precious"

    def test_no_file_to_write(self, tmp_path, capsys):
        """A failed recording removes its file: /dev/null must not be taken for one."""
        (tmp_path / "null.mcap").symlink_to(os.devnull)
        (tmp_path / "folder.mcap").mkdir()
        for name in ("null.mcap", "folder.mcap"):
            assert main(["record", "--box", "/dev/none", "--force", "--out", str(tmp_path / name)]) == 2
            ended(capsys.readouterr().err, "unreadable-file")
        assert (tmp_path / "null.mcap").is_symlink()

    def test_nothing_there(self, tmp_path, capsys):
        (tmp_path / "s.mcap").write_bytes(EARLIER)
        arguments = ["--box", str(tmp_path / "none"), "--out", str(tmp_path / "s.mcap"), "--force"]
        assert main(["record", *arguments]) == 1
        ended(capsys.readouterr().err, "link-lost", reason="not found")
        assert (tmp_path / "s.mcap").read_bytes() == EARLIER


@pytest.mark.parametrize(
    ("rate", "osr"), [(1000, 4096), (1017.25, 4096), (250, 16384), (32_000, 128), (1500, 4096), (1600, 2048)]
)
def test_the_nearest_rate(rate, osr):
    assert nearest_osr(rate) == osr
