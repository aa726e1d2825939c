"""Ctrl-C, sent to the complete process group as a terminal does, at every stage of the demo; outputs that cannot be written."""

import os
import signal
import subprocess
import sys
import time

import pytest
from tests.end_to_end.conftest import interpreter, standard_plan

from truearm.record.recorder import record
from truearm.workflows.simulate import record_virtually, write_setup
from truearm_sim.simbox import SimulatedBox
from truearm_sim.world import World

COMMAND = [sys.executable, "-m", "truearm"]


@pytest.mark.parametrize("after_s", [0.05, 0.5, 2.0, 3.5])
def test_interrupted_demo_is_one_line_and_130(tmp_path, after_s):
    process = subprocess.Popen(
        [*COMMAND, "demo", "--out", str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a suite that runs in the background inherits an ignored SIGINT, and so would this process
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    time.sleep(after_s)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    if after_s > 0.4:  # earlier, Python itself may not have begun to look after it
        # CPython ends itself by the signal, which a shell shows as 130 too, if it struck while a dataclass was being compiled.
        assert process.returncode in (130, -signal.SIGINT), stderr
        assert len(stderr.splitlines()) <= 1
        assert "Traceback" not in stderr
    assert not (tmp_path / "report.html").exists()


IN_A_CALLBACK = """
import signal, time, weakref
from truearm.__main__ import keep_interrupts
signal.signal(signal.SIGINT, signal.default_int_handler)  # as at a terminal: a shell may start jobs that ignore it
keep_interrupts()
class Lock: pass
lock = Lock()
reference = weakref.ref(lock, lambda _: signal.raise_signal(signal.SIGINT))
try:
    del lock
    time.sleep(1)
    print("lost")
except KeyboardInterrupt:
    print("kept")
"""


def test_an_interrupt_in_a_callback_is_not_lost():
    """As of an import, in which Python forgets the module's lock: the demo once ran to its end."""
    done = subprocess.run([sys.executable, "-c", IN_A_CALLBACK], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("kept\n", "")


def test_an_interrupt_while_the_file_is_being_completed_is_not_lost(tmp_path, monkeypatch):
    """The recorder asks no more; the demo once ran to its end after one of a thousand interrupts."""
    plan = standard_plan(9, 1)
    world = World(1, plan)
    box = SimulatedBox(world, interpreter(), seed=1)
    write_setup(tmp_path, world)
    (tmp_path / "session.mcap").write_text("of an earlier rehearsal")

    def struck_after(*arguments, **keywords):
        summary = record(*arguments, **keywords)
        signal.raise_signal(signal.SIGINT)
        return summary

    monkeypatch.setattr("truearm.workflows.simulate.record", struck_after)
    with pytest.raises(KeyboardInterrupt):
        record_virtually(tmp_path, world, box, 16384, 1)
    box.close()
    assert (tmp_path / "session.mcap").read_bytes().startswith(b"\x89MCAP")


def test_full_disk_behind_standard_output():
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full on this platform")
    with open("/dev/full", "w") as full:
        done = subprocess.run([*COMMAND, "--help"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.splitlines() == ["truearm: cannot write: No space left on device"]


def test_closed_standard_output():
    done = subprocess.run(["sh", "-c", f"'{sys.executable}' -m truearm --version >&-"], capture_output=True, text=True)
    assert "Traceback" not in done.stderr
