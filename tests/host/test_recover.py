"""`truearm session recover`: a new, complete session with all intact data of a damaged one, and a list of the losses."""

import hashlib
import json
import os
import random
import re
import signal
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import SeekingReader
from record_box import Box, Lab, N
from record_files import run
from test_session import chunks_of, written
from tests.host.findings_bench import listed
from tests.refusals import ended, refused

from truearm.cli.main import main
from truearm.record.links import HostClock
from truearm.record.recorder import RecordOptions
from truearm.record.session_copies import recover
from truearm.record.session_writer import SessionWriter
from truearm.session.session_file import open_session
from truearm.workflows.inspect import describe

KILLED_WHILE_IT_WRITES = """
import os, signal, sys
from truearm.cli.main import main
from truearm.record.session_writer import SessionWriter
SessionWriter.close = lambda self, end=None: os.kill(os.getpid(), signal.SIGKILL)
main(sys.argv[1:])
"""


@pytest.fixture
def made(tmp_path):
    """Return the messages of a session, its bytes, its chunks, and the file to be damaged."""
    path = tmp_path / "s.mcap"
    messages = written(path)
    return messages, path.read_bytes(), chunks_of(path, messages), path


def mended(path, out):
    """Return the messages of the file that recover writes, which must be complete for truearm and for the library."""
    found = recover(open_session(path, allow_damaged=True), out, {"source": path.name})
    session = open_session(out)
    read = list(session.messages())
    with out.open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        assert reader.get_summary().statistics.message_count == len(read)
        assert [m.data for _, _, m in reader.iter_messages(log_time_order=False)] == [m.data for m in read]
    assert {topic: account.saved for topic, account in found.topics.items()} == {
        topic: sum(m.topic == topic for m in read) for topic in found.topics
    }
    return read, found, session


def test_one_damaged_chunk(made, tmp_path, printed):
    messages, whole, chunks, path = made
    damaged = bytearray(whole)
    damaged[chunks[2].chunk_start_offset + 100] ^= 1
    path.write_bytes(damaged)
    before = hashlib.sha256(damaged).hexdigest()
    document = json.loads(printed("session", "recover", path, "--json"))
    assert hashlib.sha256(path.read_bytes()).hexdigest() == before
    out = tmp_path / "s-recovered.mcap"
    session = open_session(out)
    read = list(session.messages())
    lost = [m for m in messages if m not in read]
    assert lost
    assert lost == chunks[2].holds
    for topic in {m.topic for m in messages}:
        saved, missing = (sum(m.topic == topic for m in those) for those in (read, lost))
        assert document["topics"][topic] == {"saved": saved, "lost": missing}
    shown = listed(document)
    assert (shown["recovered"]["messages"], shown["recovered"]["lost"]) == (len(read), len(lost))
    begin_s = 1e-9 * (chunks[1].message_end_time - chunks[0].message_start_time)
    assert shown["session-damaged"]["from_s"] == pytest.approx(begin_s)
    assert session.attachments == {"rig.toml": b"x = 1\n"}
    assert session.metadata["session-end"]["reason"] == "test"
    assert session.metadata["recovered"]["sha256"] == before
    assert session.metadata["recovered"]["messages_lost"] == str(len(lost))
    assert session.metadata["session"]["version"]


def test_numbers_keep_their_gap(made, tmp_path):
    """What is missing shows in the new file as well, to whoever counts."""
    messages, whole, chunks, path = made
    damaged = bytearray(whole)
    damaged[chunks[1].chunk_start_offset + 60] ^= 1
    path.write_bytes(damaged)
    read, _, _ = mended(path, tmp_path / "new.mcap")
    with (tmp_path / "new.mcap").open("rb") as file:
        numbers = [m.sequence for _, c, m in SeekingReader(file).iter_messages(["/box/adc"])]
    adc = [m for m in messages if m.topic == "/box/adc"]
    assert [adc[number] for number in numbers] == [m for m in read if m.topic == "/box/adc"]
    assert numbers != list(range(len(numbers)))


@pytest.mark.parametrize("n", [40, pytest.param(1000, marks=pytest.mark.soak)])
def test_cut_anywhere(made, tmp_path, n):
    """Every message of every chunk that ended before the cut is saved, and nothing else."""
    messages, whole, chunks, path = made
    rng = random.Random(1)
    ends = [chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks]
    for size in [chunks[0].chunk_start_offset, ends[0] - 1, ends[0], *(rng.randrange(8, len(whole)) for _ in range(n))]:
        path.write_bytes(whole[:size])
        out = tmp_path / f"{size}.mcap"
        read, found, session = mended(path, out)
        assert read == messages[: len(read)]
        ended = [chunk for chunk, end in zip(chunks, ends, strict=True) if end <= size]
        assert read == [message for chunk in ended for message in chunk.holds]
        assert found.cut_off
        assert not found.damage
        before = open_session(path, allow_damaged=True).metadata
        assert {**session.metadata, "channels": 0, "recovered": 0} == {**before, "channels": 0, "recovered": 0}
        out.unlink()


def test_what_is_whole_is_left_alone(made, tmp_path, printed):
    *_, path = made
    assert listed(json.loads(printed("session", "recover", path, "--json"))).keys() == {"session-intact"}
    assert os.listdir(tmp_path) == ["s.mcap"]


class TestRefusals:
    @pytest.fixture
    def cut(self, made):
        _, whole, _, path = made
        path.write_bytes(whole[: len(whole) // 2])
        return path

    def refused(self, capsys, *arguments):
        assert main(["session", "recover", *map(str, arguments)]) == 2
        said = capsys.readouterr()
        assert not said.out
        assert said.err.count("\n") == 1
        return said.err

    def test_nothing_is_overwritten(self, cut, tmp_path, capsys):
        other = tmp_path / "other.mcap"
        other.write_text("precious")
        assert "file that this command writes" in self.refused(capsys, cut, "--out", other)
        assert other.read_text() == "precious"
        assert "file that this command writes" in self.refused(capsys, cut, "--out", other, "--force")
        assert other.read_text() == "precious"
        other.write_bytes(cut.read_bytes())
        assert main(["session", "recover", str(cut), "--out", str(other), "--force"]) == 0
        assert not open_session(other).truncated

    @pytest.mark.parametrize("linked", [False, True])
    def test_the_damaged_file_itself(self, cut, tmp_path, capsys, linked):
        out, before = cut, cut.read_bytes()
        if linked:
            out = tmp_path / "link.mcap"
            out.symlink_to(cut)
        ended(self.refused(capsys, cut, "--out", out, "--force"), "given-twice")
        assert cut.read_bytes() == before

    @pytest.mark.parametrize("size", [0, 3, 8, 60])
    def test_nothing_to_save(self, cut, tmp_path, capsys, size):
        cut.write_bytes(cut.read_bytes()[:size])
        self.refused(capsys, cut)
        assert os.listdir(tmp_path) == ["s.mcap"]

    def test_a_recording_that_was_killed_before_the_start(self, tmp_path, capsys):
        path = tmp_path / "s.mcap"
        writer = SessionWriter(path, HostClock(), hold=True)
        writer.attach("rig.toml", b"")
        writer.add_json("/plan", 1, {"q": [0.0]})  # in a chunk that was not written
        writer._out.file.close()
        ended(self.refused(capsys, path), "malformed-file", place=path)
        assert os.listdir(tmp_path) == ["s.mcap"]

    @pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
    def test_what_a_killed_recover_left_is_removed(self, cut, tmp_path):
        """And nothing else: not what another recover works in now, nor a stranger's folder."""
        command = [sys.executable, "-c", KILLED_WHILE_IT_WRITES, "session", "recover", str(cut)]
        assert subprocess.run(command, timeout=60).returncode == -signal.SIGKILL
        (left,) = tmp_path.glob(".truearm-*")
        at_work = left.with_name(re.sub(r"-[0-9]+-", f"-{os.getpid()}-", left.name))
        at_work.mkdir()
        (tmp_path / ".truearm-mine").mkdir()
        assert main(["session", "recover", str(cut)]) == 0
        assert sorted(tmp_path.glob(".truearm-*")) == sorted([at_work, tmp_path / ".truearm-mine"])

    def test_no_file(self, tmp_path, capsys):
        ended(self.refused(capsys, tmp_path / "none.mcap"), "missing-file")
        for nameless in ("", "/"):
            assert "regular file" in self.refused(capsys, nameless)

    def test_a_file_that_shrinks_meanwhile(self, made, tmp_path):
        _, whole, _, path = made
        path.write_bytes(whole[:-10])
        session = open_session(path, allow_damaged=True)
        path.write_bytes(whole[:300])
        with refused("damaged-session", place=path, where="at byte "):
            recover(session, tmp_path / "new.mcap", {})


def test_a_session_that_is_still_written_is_left_alone(tmp_path, capsys):
    path = tmp_path / "s.mcap"
    writer = SessionWriter(path, None)
    writer.add_json("/events", 1, {"kind": "start"})
    writer.add_json("/events", 3 * 10**9, {"kind": "later"})  # ends a chunk
    assert main(["session", "recover", str(path)]) == 2
    assert "still being written" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["s.mcap"]
    writer._out.file.close()  # as when its process is killed
    assert main(["session", "recover", str(path)]) == 0


# a session of four minutes with any one 64 kB block zeroed loses the seconds that stood in it, and nothing else

BLOCK_BYTES = 65_536
DATA_END = b"\x0f\x04\0\0\0\0\0\0\0"  # MCAP's record between the chunks and the summary
TOUCHED_S = 2.0  # of the chunks that begin before the block or end after it
PLAN = [{"pose": k, "bar": "b46", "chuck": "c1", "sphere": "s1", "q": [0.1 * k, 0.2, 0.3]} for k in range(40)]
MOUNTED = {"bar": "b46", "chuck": "c1", "sphere": "s1"}
RIG = b"[[chuck]]\n"


def recording_of(path, seconds):
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
        holds=[list(messages.one_by_one(np.arange(len(messages)))) for messages in columns],
        bytes=np.array([(c.chunk_start_offset, c.chunk_start_offset + c.chunk_length) for c in chunks]),
        log_ns=np.array([(c.message_start_time, c.message_end_time) for c in chunks]),
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return recording_of(tmp_path_factory.mktemp("recording") / "session.mcap", 240.0)


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
    zeroed(recording_of(path, 5.0), 8, 4096, path)
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
