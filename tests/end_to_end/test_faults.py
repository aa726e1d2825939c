"""Faults of the box or the link are in the file and counted exactly, and no sample across a gap is used."""

import json

import cbor2
import numpy as np
import pytest
from mcap.reader import make_reader
from tests.end_to_end.conftest import record_session, truearm

from truearm.workflows.recorded_session import observations_of_session, open_finished
from truearm_sim.lab import STEP_NS
from truearm_sim.simbox import Fault
from truearm_wire.frame import frame

POSES = 18
FAULT_S = 21.0
DURATION_S = 50.0


def inspect(path):
    done = truearm("inspect", path, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def messages(path):
    with path.open("rb") as f:
        yield from ((channel.topic, message) for _, channel, message in make_reader(f).iter_messages())


def received(path):
    """Return the bytes of the box's frames and console in the order of the file, without delimiters."""
    runs = []
    for topic, message in messages(path):
        if topic == "/box/console":
            runs.append(message.data)
        elif topic.startswith("/box/"):
            runs.append(frame(message.data).strip(b"\0"))
    return b"".join(runs)


@pytest.fixture(scope="module", params=["flip", "lose", "double", "text", "short-write", "stall", "crash", "reboot"])
def faulty(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("faults") / f"{request.param}.mcap"
    return request.param, record_session(
        path, POSES, faults=[Fault(FAULT_S, request.param)], seed=3, duration_s=DURATION_S
    )


EXPECTED = {  # frames lost, malformed, console runs with text, console runs, restarts
    "flip": (1, 0, 0, 1, 0),
    "lose": (1, 0, 0, 0, 0),
    "double": (0, 1, 0, 0, 0),
    "text": (0, 0, 1, 1, 0),
    "short-write": (0, 0, 0, 0, 0),
    "stall": (0, 0, 0, 0, 0),
    "crash": (0, 0, 1, 1, 1),
    "reboot": (0, 0, 0, 0, 1),
}


def test_the_file_holds_every_byte_that_was_received_and_heartbeats_go_on(faulty):
    _, session = faulty
    assert received(session.path) == b"".join(session.sent).replace(b"\0", b"")
    beats = [cbor2.loads(m.data) for topic, m in messages(session.path) if topic == "/box/heartbeat"]
    assert len(beats) >= 45


def test_inspect_counts_exactly_what_was_injected(faulty):
    kind, session = faulty
    losses = inspect(session.path)["losses"]
    counted = tuple(
        losses[key] for key in ("frames_lost", "frames_malformed", "console_text_runs", "console_runs", "restarts")
    )
    assert counted == EXPECTED[kind]
    lost_samples = losses["samples_lost"] + losses["samples_overrun"]
    assert lost_samples == (13 if kind in ("flip", "lose") else 0)
    short = losses["box"]["short_writes"]
    assert short == (1 if kind == "short-write" else 0)


def test_no_sample_across_a_gap_is_used(faulty):
    """A dwell that the fault hit keeps a whole piece or is rejected; all others are used, and every mean is right."""
    kind, session = faulty
    result = observations_of_session(open_finished(session.path))
    truth = session.world.truth
    outage = {"crash": 3.0, "reboot": 3.0, "stall": 0.3}.get(kind, 0.02)
    hit = (truth.dwell_start < FAULT_S + outage) & (truth.dwell_end > FAULT_S)
    whole = np.flatnonzero(~hit & (truth.dwell_start > 2.0) & (truth.dwell_end < DURATION_S))
    used = {d.pose: d for d in result.dwells if not d.reason}
    assert set(whole) <= set(used)
    error = result.table.value - truth.length[[d.pose for d in result.dwells if not d.reason]]
    # the mean of a dwell's samples: 3 µm of noise over hundreds of samples, and what is left of the settling
    assert np.abs(error).max() < 1e-6
    if kind in ("flip", "lose", "crash", "reboot"):
        fault_ns = session.lab.host_ns(int(FAULT_S * 1e9))
        for (
            dwell
        ) in used.values():  # one side of the gap alone; the gap lies within a step of the lab and a block of the fault
            longer_side_ns = max(fault_ns - dwell.start_host_ns, dwell.end_host_ns - fault_ns) + STEP_NS + 13 * 983040
            assert not dwell.start_host_ns < fault_ns < dwell.end_host_ns or dwell.n_samples * 983040 <= longer_side_ns
