"""A session of four minutes with any one 64 kB block zeroed loses the seconds that stood in it, and nothing else."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import SeekingReader
from record_box import Box, Lab, N
from record_files import run
from tests.host.findings_bench import listed

from truearm.cli.main import main
from truearm.record.recorder import RecordOptions
from truearm.record.recover import recover
from truearm.record.session_writer import SessionWriter
from truearm.session.session_file import open_session
from truearm.workflows.inspect import describe

BLOCK_BYTES = 65_536
DATA_END = b"\x0f\x04\0\0\0\0\0\0\0"  # MCAP's record between the chunks and the summary
TOUCHED_S = 2.0  # of the chunks that begin before the block or end after it
PLAN = [{"pose": k, "bar": "b46", "chuck": "c1", "sphere": "s1", "q": [0.1 * k, 0.2, 0.3]} for k in range(40)]
MOUNTED = {"bar": "b46", "chuck": "c1", "sphere": "s1"}
RIG = b"[[chuck]]\n"


def recorded(path, seconds):
    """Return the bytes of a recording, its metadata and its chunks: bytes, times [ns] and messages of each."""
    lab = Lab()
    run(lab, Box(lab), path, seconds, RecordOptions(plan=PLAN, rig_toml=RIG, mounted=MOUNTED))
    session = open_session(path)
    columns = [next(replace(session, chunks=[chunk]).batches()) for chunk in session.chunks]
    with path.open("rb") as file:
        chunks = SeekingReader(file).get_summary().chunk_indexes
    return SimpleNamespace(
        whole=path.read_bytes(),
        metadata=session.metadata,
        holds=[list(messages.of(np.arange(len(messages)))) for messages in columns],
        bytes=np.array([(c.chunk_start_offset, c.chunk_start_offset + c.chunk_length) for c in chunks]),
        log_ns=np.array([(c.message_start_time, c.message_end_time) for c in chunks]),
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("recording") / "session.mcap", 240.0)


def recorded_messages(path):
    return sorted(message for message in open_session(path).messages() if message.topic != "/robot/columns")


def zeroed(recording, begin, n_bytes, path):
    damaged = bytearray(recording.whole)
    damaged[begin : begin + n_bytes] = bytes(len(damaged[begin : begin + n_bytes]))
    path.write_bytes(damaged)


def is_of_head(message):
    return message.topic == "/plan" or b'"mounted"' in message.data


def check_block(recording, begin, path):
    end = begin + BLOCK_BYTES
    zeroed(recording, begin, BLOCK_BYTES, path)
    out = path.with_name("recovered.mcap")
    out.unlink(missing_ok=True)
    session = open_session(path, allow_damaged=True)
    found = recover(session, out, {})

    touched = (recording.bytes[:, 0] < end) & (recording.bytes[:, 1] > begin)
    expected = [
        message
        for messages, lost in zip(recording.holds, touched, strict=True)
        for message in messages
        if not lost or is_of_head(message)
    ]
    mended = open_session(out)
    assert recorded_messages(out) == sorted(expected)
    assert found.samples == N * sum(message.topic == "/box/adc" for message in expected)
    assert found.topics["/box/ident"].lost == 0  # a later copy serves
    assert mended.attachments == {"rig.toml": RIG}
    assert mended.metadata["box"] == recording.metadata["box"]
    assert mended.metadata["session"] == recording.metadata["session"]

    inside = (recording.bytes[:, 0] >= begin) & (recording.bytes[:, 1] <= end)
    first_ns, last_ns = recording.log_ns.min(), recording.log_ns.max()
    inside_s = 1e-9 * np.ptp(recording.log_ns[inside]) if inside.any() else 0.0
    spans = [(damage.from_s, damage.from_s + damage.lost_s) for damage in found.damage]
    if found.cut_off:
        spans.append((found.seconds, 1e-9 * (last_ns - first_ns)))
    assert sum(stop - start for start, stop in spans) <= inside_s + TOUCHED_S
    for start_ns, stop_ns in recording.log_ns[touched]:
        assert any(
            start <= 1e-9 * (start_ns - first_ns) + 1e-3 and 1e-9 * (stop_ns - first_ns) <= stop + 1e-3
            for start, stop in spans
        )

    document = describe(session)
    assert document["losses"]["samples"] == found.samples
    assert [(place["from_s"], place["lost_s"]) for place in document["damage"]] == [
        (damage.from_s, damage.lost_s) for damage in found.damage
    ]
    assert document["plan_poses"] == len(PLAN)
    assert document["events"]["mounted"] == 1


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_one_block(recording, tmp_path, share):
    check_block(recording, round(share * (len(recording.whole) - BLOCK_BYTES)), tmp_path / "session.mcap")


def test_the_last_chunks_with_what_the_summary_says_of_them(recording, tmp_path):
    """The footer is intact, but the statistics are not: how much was lost cannot be known, and is not 0 s."""
    begin = int(recording.bytes[-40, 0])
    statistics_end = recording.whole.rindex(DATA_END) + 3000
    path = tmp_path / "session.mcap"
    zeroed(recording, begin, statistics_end - begin, path)
    found = recover(open_session(path, allow_damaged=True), tmp_path / "recovered.mcap", {})
    assert (found.cut_off, found.damage) == (True, ())
    assert found.seconds == pytest.approx(1e-9 * (recording.log_ns[-41, 1] - recording.log_ns[0, 0]), abs=1.0)


@pytest.mark.soak
@pytest.mark.parametrize("shift", [0, 1000])
def test_every_block(recording, tmp_path, shift):
    for begin in range(shift, len(recording.whole), BLOCK_BYTES):
        check_block(recording, begin, tmp_path / "session.mcap")


def test_a_damaged_summary(recording, tmp_path, capsys):
    """No data are lost, but other programs find the chunks by it. The file was called intact, with nothing to recover."""
    path = tmp_path / "session.mcap"
    zeroed(recording, recording.whole.rindex(DATA_END) + 2000, 500, path)
    assert main(["inspect", str(path)]) == 2
    assert "damaged in its summary" in capsys.readouterr().err
    assert main(["session", "recover", str(path)]) == 0
    recovered = recorded_messages(path.with_name("session-recovered.mcap"))
    path.write_bytes(recording.whole)
    assert recovered == recorded_messages(path)


def test_a_session_without_copies(tmp_path, printed, monkeypatch):
    """Sessions of earlier versions have none: the messages are saved, but nothing says what their samples mean."""
    monkeypatch.setattr(SessionWriter, "_copy_head", lambda self, attached: None)
    path = tmp_path / "session.mcap"
    zeroed(recorded(path, 5.0), 8, 4096, path)
    monkeypatch.undo()
    said = listed(json.loads(printed("session", "recover", path, "--json")))["recovered"]
    assert (said["samples"], said["undescribed"] > 0) == (0, True)


def test_times_that_jump_do_not_multiply_copies(tmp_path):
    path = tmp_path / "session.mcap"
    with SessionWriter(path, None) as writer:
        writer.attach("large.bin", np.random.default_rng(1).bytes(300_000))
        for hour in range(100):
            writer.add_json("/events", hour * 3600 * 10**9, {"kind": "note"})
    assert path.stat().st_size < 3 * 300_000 + 100_000
