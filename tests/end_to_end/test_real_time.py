"""Box and robot in real time in one process, the recorder in another, over pyserial and TCP; long recordings on a loaded machine in make soak."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from tests.end_to_end.conftest import truearm, truearm_process

from truearm.session.frames import recorded_ident
from truearm.session.joint_format import unpack
from truearm.session.session_file import open_session
from truearm.session.streams import BoxReader
from truearm.workflows.recorded_session import observations_of_session, open_finished
from truearm_sim.clocks import draw_clocks
from truearm_sim.world import Setup, World, standard_plan


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
        assert "1 visited pose " in done.stderr
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


def test_rtde_from_the_simulator_to_the_dwell(tmp_path):
    """Four seconds at 500 Hz: every reading is in the session, bit for bit the World's, measured and commanded apart."""
    simulator = Simulator(tmp_path, "--protocol", "rtde", "--poses", "9")
    try:
        assert any(word.startswith("rtde://127.0.0.1:") for word in simulator.record)
        done = truearm_process(*simulator.record, "--duration-s", 4, timeout_s=60)
    finally:
        simulator.stop()
    assert done.returncode == 0, done.stderr
    session = tmp_path / "session.mcap"
    rows = unpack(*(message.data for message in open_session(session).messages({"/robot/readings"})))
    assert len(rows) >= 3.5 * 500
    # The Port drops what a slow reader does not take; seq and t tell of it alike.
    seq, t = rows.seq, rows.t
    assert np.array_equal(seq, np.rint((t - t[0]) * 500.0))
    states = World(1, standard_plan(9, 1), setup=Setup(robot_rate=500.0)).robot_states(0, 20 * 10**9)
    first = int(np.searchsorted(states.t_robot, t[0] - 1e-6))
    for key, read in (("q", rows.q), ("q_cmd", rows.columns["q_cmd"]), ("qd", rows.columns["qd"])):
        assert np.array_equal(read, getattr(states, key)[first + seq]), key
    assert not list(open_session(session).messages({"/robot/console"}))
    report = truearm("inspect", session, "--json")
    robot = json.loads(report.stdout)["robot"]
    assert robot["readings"] == len(rows)
    assert robot["lost"] == seq[-1] + 1 - len(rows)


LOAD = "while True: sum(k * k for k in range(100_000))"


@pytest.fixture
def load():
    """Another process that never rests."""
    process = subprocess.Popen([sys.executable, "-c", LOAD])
    yield
    process.kill()
    process.wait()


@pytest.mark.soak
@pytest.mark.parametrize(("rate", "seconds", "poses"), [(1000, 600, 90), (4000, 60, 18)])
@pytest.mark.usefixtures("load")
def test_everything_is_there_or_counted(tmp_path, rate, seconds, poses):
    """Every sample that the box took, by its own count, is in the file or in the account of losses."""
    simulator = Simulator(tmp_path, "--pty", "--poses", str(poses))
    try:
        done = truearm_process(*simulator.record, "--rate", rate, "--duration-s", seconds, timeout_s=seconds + 60)
    finally:
        simulator.stop()
    # the end may fall into a dwell, which is then too short (code 4); nothing else is wrong
    short = re.search(r"dwells: \d+ usable, 1 too short;", " ".join(done.stdout.split()))
    cut = short and "1 visited pose of the plan gave no observation;" in done.stderr
    assert done.returncode == (4 if cut else 0), done.stderr
    session = open_session(tmp_path / "session.mcap")
    reader, taken, begin_us = BoxReader(recorded_ident(session)), 0, None
    for blocks in (*(reader.feed(messages) for messages in session.batches()), reader.finish()):
        for some in blocks:
            last, n = some.table[-1], some.table["n"][-1]
            taken, end_us = last["n0"] + n, last["t_us"] + n * last["period_ns"] / 1000
            begin_us = some.table["t_us"][0] if begin_us is None else begin_us
    losses = reader.losses()
    print(f"{rate} Hz, {seconds} s: {losses}")
    assert losses.samples + losses.samples_lost + losses.samples_overrun == taken
    # the box's own time, which counts without the samples, to half a period and its microseconds
    period_us = reader.streams()[0].period_ns / 1000
    assert taken == pytest.approx((end_us - begin_us) / period_us, abs=0.6)
    assert (end_us - begin_us) / 1e6 == pytest.approx(seconds, abs=1.0)
    assert losses.restarts == losses.frames_malformed == 0
    assert losses.samples_lost + losses.samples_overrun < 1e-3 * taken  # on a machine that is not wholly overloaded
