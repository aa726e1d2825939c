"""Box and robot in real time in one process, the recorder in another, over pyserial and TCP; then all further commands."""

import re
import subprocess
import sys

import pytest
from mcap.reader import make_reader
from tests.end_to_end.conftest import truearm, truearm_process

from truearm.workflows.session_observations import observations_of_session
from truearm.workflows.session_parts import open_finished
from truearm_sim.clocks import draw_clocks


class Simulator:
    """A running `truearm simulate`."""

    def __init__(self, folder, *options):
        command = [sys.executable, "-u", "-m", "truearm", "simulate", "--out", str(folder), "--port", "0"]
        self.process = subprocess.Popen(
            [*command, "--robot-port", "0", *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.head = ""
        while "truearm record" not in self.head:
            line = self.process.stdout.readline()
            if not line:
                self.stop()
                raise RuntimeError("truearm simulate ended: " + self.head)
            self.head += line
        self.record = re.search(r"truearm (record .*)", self.head).group(1).split()

    def stop(self):
        self.process.terminate()
        self.process.wait(timeout=10)
        self.process.stdout.close()


@pytest.fixture(params=[pytest.param("socket", marks=pytest.mark.soak), "pty"])
def simulator(request, tmp_path):
    simulator = Simulator(tmp_path, *(["--pty"] if request.param == "pty" else []))
    yield simulator
    simulator.stop()


def test_recorded_over_a_real_port(simulator, tmp_path):
    """Seven seconds: the box's samples, the robot's lines, clocks, and at least one dwell with the right length."""
    assert "MicroPython" in simulator.head
    session = tmp_path / "session.mcap"
    done = truearm_process(*simulator.record, "--duration-s", 8, timeout_s=60)
    if done.returncode == 4:  # it ended within a dwell: that pose alone gave no observation
        assert "1 visited pose of the plan gave no observation" in done.stderr
    else:
        assert done.returncode == 0, done.stderr
    report = truearm("inspect", session)
    assert report.returncode == 0, report.stderr
    with session.open("rb") as f:
        summary = make_reader(f).get_summary()
        counts = {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}
    assert counts["/box/adc"] >= 7 * 1017.25 / 13 - 20
    assert counts["/robot/joints"] >= 330
    assert counts["/sync"] >= 40
    assert counts["/box/heartbeat"] >= 6
    assert "/box/console" not in counts
    result = observations_of_session(open_finished(session))
    assert (
        result.survey.losses.frames_lost
        == result.survey.losses.samples_lost
        == result.survey.losses.samples_overrun
        == 0
    )
    assert len(result.table) >= 1
    # the host against the crystal that the simulator drew (the opposite sign), within the bound at both ends
    (report,) = result.survey.clock_reports
    span_us = report.device_us[1] - report.device_us[0]
    truth = -draw_clocks(1).device.ppm
    assert abs(report.rate_ppm - truth) <= 1e6 * 2 * report.bound_ns / (1e3 * span_us)
