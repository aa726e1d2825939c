"""A session file that is deleted, renamed, replaced or truncated while it is written, and a robot that floods its link."""

import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from record_box import HOST_0, SECOND, Box
from record_files import events, run, topics
from record_real import box_on_a_socket, line_of
from test_record_command import RIG
from tests.host.tcp_peer import Peer
from tests.refusals import refused

from truearm.errors import SessionError
from truearm.record.recorder import RecordOptions, record
from truearm.record.session_copies import recover
from truearm.record.session_writer import SessionWriter
from truearm.session.session_file import open_session

pytestmark = pytest.mark.skipif(os.name != "posix", reason="a file that is open cannot be deleted elsewhere")
AT_NS = HOST_0 + 1_500_000_000
PLAN = [{"pose": k, "bar": "b46", "chuck": "c1", "sphere": "s1", "q": [0.1 * k, 0.0]} for k in range(2)]
OPTIONS = RecordOptions(plan=PLAN, rig_toml=RIG.encode(), mounted={"bar": "b46", "chuck": "c1", "sphere": "s1"})


def lost(lab, path, happens, at_ns=AT_NS):
    """Record for 3 s while something happens to the file."""
    lab.at(at_ns, happens)
    return run(lab, Box(lab), path, options=OPTIONS)


def samples(path):
    """Return the indices of the frames' first samples, in the order of the file."""
    from tests.wire_frames import data_frame

    return [data_frame(m.data).n0 for m in topics(path)["/box/adc"]]


def is_head_whole(path):
    found = topics(path)
    assert [json.loads(m.data) for m in found["/plan"]] == PLAN
    assert open_session(path).attachments["rig.toml"] == RIG.encode()
    assert "ident" in open_session(path).metadata["box"]
    assert events(path, "mounted") == [{"kind": "mounted", **OPTIONS.mounted}]
    return True


@pytest.mark.parametrize("what", ["deleted", "replaced"])
def test_nothing_is_lost_of_a_file_that_is_gone(lab, path, what):
    def happens():
        path.unlink()
        if what == "replaced":
            path.write_text("somebody else's")

    summary = lost(lab, path, happens)
    rescued = path.with_name(f"{path.stem}-rescued{path.suffix}")
    (loss,) = summary.file_losses
    assert loss.startswith(f"{path}: was {what}")
    assert loss.endswith(str(rescued))
    assert events(rescued, "file-lost")[0]["text"] == summary.file_losses[0]
    first = samples(rescued)
    assert first == list(range(0, 10 * len(first), 10))
    assert 10 * len(first) == summary.counters.samples
    assert is_head_whole(rescued)
    assert path.exists() == (what == "replaced")


@pytest.mark.parametrize("again", [True, False])
def test_nothing_is_lost_of_a_folder_that_is_removed(lab, tmp_path, monkeypatch, again):
    """The folder is made again; where that is impossible, the rescued file is in the folder for temporary files."""
    folder, other = tmp_path / "a" / "b", tmp_path / "temporary"
    folder.mkdir(parents=True)
    other.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(other))

    def happens():
        shutil.rmtree(folder.parent)
        if not again:
            folder.parent.write_text("a file where the folder was")

    summary = lost(lab, folder / "s.mcap", happens)
    rescued = (folder if again else other) / "s-rescued.mcap"
    (loss,) = summary.file_losses
    assert loss.startswith(f"{folder / 's.mcap'}: was deleted")
    assert loss.endswith(str(rescued))
    assert 10 * len(samples(rescued)) == summary.counters.samples
    assert is_head_whole(rescued)


@pytest.mark.parametrize("both", [False, True])
def test_a_full_disk_keeps_no_part_of_a_rescued_file(lab, tmp_path, monkeypatch, both):
    """Another disk takes it; if that is full too, nothing says that the content of a deleted file can be read."""
    folder, other = tmp_path / "full", tmp_path / "temporary"
    folder.mkdir()
    other.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(other))
    path = folder / "s.mcap"

    class Full(io.FileIO):
        def write(self, data):
            super().write(data[:100])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    opened = Path.open

    def open_(self, mode="r", *more, **named):
        full = "rescued" in self.name and (both or self.parent == folder) and "x" in mode
        return Full(self, "x+") if full else opened(self, mode, *more, **named)

    monkeypatch.setattr(Path, "open", open_)
    if both:
        with refused("cannot-write", place=path):
            lost(lab, path, path.unlink)
        assert list(other.iterdir()) == []
    else:
        summary = lost(lab, path, path.unlink)
        assert str(other / "s-rescued.mcap") in summary.file_losses[0]
        first = samples(other / "s-rescued.mcap")
        assert (first[0], first[-1] + 10) == (0, summary.counters.samples)
    assert list(folder.iterdir()) == []


def test_a_renamed_file_is_written_to_as_before(lab, path):
    other = path.with_name("other.mcap")
    summary = lost(lab, path, lambda: path.rename(other))
    (text,) = summary.file_losses
    assert text.startswith(f"{path}: was renamed")
    assert 10 * len(samples(other)) == summary.counters.samples
    assert [p.name for p in path.parent.iterdir()] == ["other.mcap"]


def test_a_renamed_file_that_is_deleted_then(lab, path):
    other = path.with_name("other.mcap")
    lab.at(HOST_0 + 2 * SECOND + SECOND // 2, lambda: other.unlink())
    summary = lost(lab, path, lambda: path.rename(other))
    assert [text.split(" was ")[1].split()[0] for text in summary.file_losses] == ["renamed", "deleted"]
    (rescued,) = path.parent.iterdir()
    assert 10 * len(samples(rescued)) == summary.counters.samples


@pytest.mark.parametrize("size", [0, 1000])
def test_what_comes_after_a_truncation_can_be_recovered(lab, path, size):
    """Nothing of the last second is lost, which waited in memory; nor plan, rig and what is mounted, which are repeated."""
    summary = lost(lab, path, lambda: os.truncate(path, size))
    (text,) = summary.file_losses
    assert "truncated" in text
    out = path.with_name("recovered.mcap")
    recover(open_session(path, allow_damaged=True), out, {})
    assert is_head_whole(out)
    first = samples(out)
    assert first == list(range(first[0], summary.counters.samples, 10))
    assert first[0] * 983_040 < 1_500_000_000


def test_a_file_is_deleted_between_the_last_sync_and_the_end(lab, path):
    class Late(SessionWriter):
        def close(self, end=None):
            if end is not None:
                path.unlink()
            super().close(end)

    with Late(path, lab) as writer:
        summary = record(Box(lab).link, writer, lab, options=RecordOptions(duration_s=2.0))
    assert len(summary.file_losses) == 1
    rescued = path.with_name(f"{path.stem}-rescued{path.suffix}")
    assert not open_session(rescued).truncated
    assert 10 * len(samples(rescued)) == summary.counters.samples


@pytest.mark.parametrize("at", [100, -50])
def test_bytes_that_are_overwritten_in_place_are_seen_at_the_end(lab, path, at):
    """Neither the name nor the length of the file changes; without damage nothing is reported."""

    def happens():
        with path.open("r+b") as file:
            file.seek(at, os.SEEK_SET if at >= 0 else os.SEEK_END)
            file.write(b"\xff\x00\xff\x00")

    (text,) = lost(lab, path, happens).file_losses
    assert text.startswith(f"{path}: ")
    assert f"truearm inspect {path}" in text
    with pytest.raises(SessionError):
        open_session(path)
    other = path.with_name("other.mcap")
    assert run(lab, Box(lab), other, options=OPTIONS).file_losses == ()
    assert not open_session(other).truncated


def test_a_second_rescue_takes_another_name(lab, path):
    rescued = path.with_name(f"{path.stem}-rescued{path.suffix}")
    rescued.write_text("of yesterday")
    lost(lab, path, path.unlink)
    assert rescued.read_text() == "of yesterday"
    assert is_head_whole(path.with_name(f"{path.stem}-rescued-2{path.suffix}"))


def test_the_command_says_it_within_two_seconds(tmp_path):
    """And again when a signal has ended it: the recording is not complete."""
    out = tmp_path / "s.mcap"
    (tmp_path / "rig.toml").write_text(RIG)
    with box_on_a_socket() as (_, device):
        options = ["--unchecked", "--box", device, "--rig", tmp_path / "rig.toml", "--out", out]
        command = [sys.executable, "-m", "truearm", "record", *map(str, options)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while not (out.exists() and out.stat().st_size > 2000):
            time.sleep(0.02)
        time.sleep(1.0)
        out.unlink()
        happened = time.monotonic()
        for line in process.stderr:
            if "while it was written" in line:
                break
        said_s = time.monotonic() - happened
        process.send_signal(signal.SIGHUP)
        stdout, _ = process.communicate(timeout=30)
    assert said_s < 2.0
    assert process.returncode == 4
    rescued = tmp_path / "s-rescued.mcap"
    assert str(rescued) in stdout
    assert not open_session(rescued).truncated


# of what was received and not stored, five seconds are stored at the end
SHORT_WAITING = """
import sys
from truearm.cli.main import main
from truearm.record import recorder
recorder.WAITING_NS = 10**9
sys.exit(main())
"""


def flood(lines=None):
    """Return the address of a robot that sends as fast as it can: one reading, and then readings or other ``lines``."""
    readings = b"".join(line_of(k, 1e-4) for k in range(5000))

    def talk(peer):
        peer.sendall(line_of(0))
        while True:
            peer.sendall(lines or readings)

    return f"tcp://{Peer(talk).address}"


def test_a_robot_that_floods_takes_neither_the_clock_nor_the_end(tmp_path):
    out = tmp_path / "s.mcap"
    with box_on_a_socket() as (_, device):
        options = ["--unchecked", "--box", device, "--address", flood(), "--duration-s", "2", "--out", out]
        command = [sys.executable, "-c", SHORT_WAITING, "record", *map(str, options)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 4, done.stderr
    assert "robot sent more than could be stored, so readings may be missing" in done.stderr.splitlines()[-1]
    assert "robot sends more than can be stored" in done.stderr
    assert "silent" not in done.stdout + done.stderr
    session = open_session(out)
    rows = [(m.topic, m.t_host_ns, json.loads(m.data)) for m in session.messages({"/sync", "/events"})]
    assert sum("t3_ns" in row for _, _, row in rows) >= 8  # of 20, on a machine that does other things too
    start, stop = (next(t for _, t, row in rows if row.get("kind") == kind) for kind in ("start", "stop"))
    assert 2.0 <= (stop - start) / SECOND < 4.0 + 1.0
    assert int(session.metadata["session-end"]["samples"]) > 1.5 * 1017


@pytest.mark.soak
def test_a_flood_of_junk_does_not_end_the_recording(tmp_path):
    """The box is recorded to the end, and the exit code says that not everything was stored."""
    out = tmp_path / "s.mcap"
    with box_on_a_socket() as (_, device):
        address = flood(b"x" * 4095 + b"\n")
        options = ["--unchecked", "--box", device, "--address", address, "--duration-s", "4", "--out", out]
        command = [sys.executable, "-m", "truearm", "record", *map(str, options)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 4, done.stderr
    end = open_session(out).metadata["session-end"]
    assert end["reason"] == "duration"
    assert int(end["robot_lines"]) == 1
    assert int(end["samples"]) > 3 * 1017 * 10 // 10
