"""Long recordings in real time over a pseudo-terminal on a loaded machine: nothing is lost, or the loss is counted."""

import re
import subprocess
import sys

import pytest
from tests.end_to_end.conftest import truearm_process
from tests.end_to_end.test_real_time import Simulator

from truearm.session.box_ident import recorded_ident
from truearm.session.session_file import open_session
from truearm.session.streams import BoxReader

pytestmark = pytest.mark.soak
LOAD = "while True: sum(k * k for k in range(100_000))"


@pytest.fixture
def load():
    """Another process that never rests."""
    process = subprocess.Popen([sys.executable, "-c", LOAD])
    yield
    process.kill()
    process.wait()


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
