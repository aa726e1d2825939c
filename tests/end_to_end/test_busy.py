"""The recorder's reader keeps up while Python is busy, and the recording continues whatever happens to the live view."""

import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from tests.end_to_end.conftest import truearm
from tests.end_to_end.test_real_time import Simulator
from tests.wire_frames import data_frame

from truearm.record.links import BoxPort, HostClock, Reopening, backlog_of
from truearm.record.operator import Operator
from truearm.record.recorder import RecordOptions, record
from truearm.record.session_writer import SessionWriter
from truearm.session.clock import fit_clock
from truearm.session.session_file import open_session
from truearm.session.streams import BoxReader

OSR = 1024  # 4069 Hz, four channels: 313 blocks a second, 77 kB
BUSY_S = 2.0


@pytest.fixture
def device(tmp_path):
    """Run a simulated box behind a pseudo-terminal in its own process."""
    simulator = Simulator(tmp_path / "sim", "--pty")
    yield simulator.record[simulator.record.index("--box") + 1]
    simulator.stop()


def test_two_seconds_of_python_lose_nothing(device, tmp_path):
    """The thread that writes counts in Python for 2 s: the reader's thread has each byte within milliseconds.

    Honest stamps: none is early (a stamp is taken after the read), which every exchange's bounds would show; and those of the
    busy time are late by what the reader waits for its turn, which Python gives every 0.2 ms, not by the 2 s that the writer is away.
    """
    sys.setswitchinterval(2e-4)
    clock = HostClock()
    busy = []

    class Toiling(Operator):
        def status(self, status):
            if not busy and status.elapsed_s > 2.0:
                begin = time.monotonic()
                busy.append(clock.now_ns())
                while time.monotonic() - begin < BUSY_S:
                    sum(k * k for k in range(1000))
                busy.append(clock.now_ns())
                waiting.append(backlog_of(link).waiting)

    waiting = []
    path = tmp_path / "s.mcap"
    link = Reopening(BoxPort(device, clock))
    try:
        with SessionWriter(path, clock) as writer:
            summary = record(link, writer, clock, options=RecordOptions(osr=OSR, duration_s=6.0), operator=Toiling())
    finally:
        link.close()
        sys.setswitchinterval(5e-3)
    assert (summary.counters.held_up, summary.counters.lost_frames) == (0, 0)
    reader = BoxReader()
    blocks = [some for messages in open_session(path).batches() for some in reader.feed(messages)] + reader.finish()
    blocks = [some for some in blocks if some.stream.id == 0]
    losses = reader.losses()
    assert (losses.frames_lost, losses.samples_lost, losses.samples_overrun, losses.console_bytes) == (0, 0, 0, 0)
    assert sum(map(len, blocks)) == pytest.approx(6.0 * 1e9 / (240 * OSR * 13), rel=0.03)
    assert waiting[0] > 10  # it did pile up, in as many pieces as the system let the reader run
    fitted = fit_clock(0, reader.exchanges(reader.segment))
    assert fitted is not None
    # a block is sent after its last sample; the one that the stop cuts short holds fewer than the others
    sent_us = np.concatenate(
        [some.table["t_us"] + (some.table["n"] - 1) * some.table["period_ns"] // 1000 for some in blocks]
    )
    messages = (message for message in open_session(path).messages() if message.topic.startswith("/box/"))
    frames = ((message.t_host_ns, data_frame(message.data)) for message in messages)
    came_ns = {data.n0: t_host_ns for t_host_ns, data in frames if data is not None and data.stream == 0}
    arrived_ns = np.array([came_ns[n0] for some in blocks for n0 in some.table["n0"].tolist()])
    host_ns, bound_ns = fitted[0].to_host_ns(sent_us)
    late_ns = arrived_ns - host_ns
    toiled = (arrived_ns >= busy[0]) & (arrived_ns <= busy[1])
    assert toiled.sum() > 0.5 * BUSY_S * 1e9 / (240 * OSR * 13)
    assert np.all(late_ns >= -bound_ns)  # each by the bound at its own time, behind the last exchange too
    quiet, loud = np.median(late_ns[~toiled]), np.median(late_ns[toiled])
    print(
        f"late: {quiet / 1e6:.2f} ms at rest, {loud / 1e6:.2f} ms while busy, {late_ns[toiled].max() / 1e6:.1f} ms at most"
    )
    # stamps of the writer's own would be late by one second in the middle; the rest is for a machine under load
    assert loud - quiet < 2e8


@pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
def test_a_terminal_that_stands_still(device, tmp_path):
    """Nobody reads what the view writes, as after Ctrl-S: it blocks within a second, the recording does not."""
    master, slave = os.openpty()
    out = tmp_path / "s.mcap"
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "200", "LINES": "50"}
    options = ("--box", device, "--rate", "4000", "--duration-s", "6", "--out", str(out))
    command = [sys.executable, "-m", "truearm", "record", *options]
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=slave, env=environment, text=True
    )
    os.close(slave)
    said, _ = process.communicate(timeout=60)
    taken = os.read(master, 1 << 20)
    os.close(master)
    assert process.returncode == 0, said
    assert b"\x1b[" in taken  # it was live
    assert len(taken) <= 8192  # what a terminal holds: some views of the two dozen that there would have been
    assert "0 frames lost" in said
    reader = BoxReader()
    for messages in open_session(out).batches():
        reader.feed(messages)
    reader.finish()
    losses = reader.losses()
    assert (losses.frames_lost, losses.samples_lost, losses.samples_overrun) == (0, 0, 0)


def test_a_view_that_fails(device, tmp_path, monkeypatch, capsys):
    """If an exception is raised in the view, the view closes."""
    from truearm.cli.main import main

    def fail(*_):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("truearm.live.state.LiveState._rows", fail)
    out = tmp_path / "s.mcap"
    assert main(["record", "--box", device, "--duration-s", "3", "--out", str(out)]) == 0
    assert "live view failed (ZeroDivisionError:" in capsys.readouterr().err
    assert truearm("inspect", out).returncode == 0
    assert not any(thread.name == "view" for thread in threading.enumerate())
