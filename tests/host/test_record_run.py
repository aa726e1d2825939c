"""The recorder with a box in memory, in virtual time: the content of the file without faults."""

import json

import cbor2
import pytest
from record_box import HOST_0, LATENCY, PERIOD_NS, SECOND, Box, Lab, N, Robot
from record_files import Watching, events, received, run, topics

from truearm.record.recorder import RecordOptions
from truearm.session.session_file import open_session


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
