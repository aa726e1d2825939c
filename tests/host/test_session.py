"""Session files are read back as written, by truearm and by the mcap library; damage gives one clear error."""

import io
import json
import random
from pathlib import Path

import mcap.records
import pytest
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Chunk
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer
from record_box import MS, SECOND, Lab
from tests.refusals import refused

from truearm.errors import InputError, SessionError
from truearm.record.session_copies import recover
from truearm.record.session_writer import CHUNK_NS, SessionWriter
from truearm.session.session_file import MAX_CHUNK_BYTES, open_session
from truearm.types import Message


def written(path: Path, n: int = 500, finish: bool = True) -> list[Message]:
    """Write a session of ``n`` steps of 10 ms; if not finished, it lacks its last chunk and its end."""
    lab = Lab()
    writer = SessionWriter(path, lab, overwrite=True)
    writer.attach("rig.toml", b"x = 1\n")
    writer.metadata("box", {"ident": "{}"})
    messages = []
    for k in range(n):
        t_ns = lab.now + 10 * MS * k
        messages.append(Message("/box/adc", t_ns, bytes([k % 256]) * 150))
        if k % 7 == 0:
            messages.append(Message("/sync", t_ns, json.dumps({"id": k, "t0_ns": t_ns}).encode()))
        if k % 50 == 3:
            messages.append(Message("/box/console", t_ns, b"Traceback\xff\n"))
    for message in messages:
        writer.add(*message)
    if finish:
        writer.close({"reason": "test"})
    return messages


def chunks_of(path: Path, messages: list[Message]) -> list:
    """Return the chunks of a session, each with those of its messages that it holds."""
    rest = iter(messages)
    with path.open("rb") as file:
        chunks = SeekingReader(file).get_summary().chunk_indexes
        for chunk in chunks:
            file.seek(chunk.chunk_start_offset + 9)
            records = breakup_chunk(Chunk.read(ReadDataStream(file)))
            chunk.holds = [next(rest) for record in records if isinstance(record, mcap.records.Message)]
    return chunks


class TestRoundTrip:
    def test_ours(self, tmp_path):
        messages = written(tmp_path / "s.mcap")
        session = open_session(tmp_path / "s.mcap")
        assert not session.truncated
        assert list(session.messages()) == messages
        assert list(session.messages()) == messages  # as often as one likes
        assert list(session.messages({"/sync"})) == [m for m in messages if m.topic == "/sync"]
        assert list(session.messages([])) == []
        assert session.attachments == {"rig.toml": b"x = 1\n"}
        assert session.metadata["session"]["clock"] == "virtual"
        assert session.metadata["session-end"]["reason"] == "test"
        assert int(session.metadata["session"]["utc_ns"]) == 1_700_000_000 * SECOND

    @pytest.mark.parametrize("reader", [SeekingReader, NonSeekingReader])
    def test_the_mcap_library_reads_it(self, tmp_path, reader):
        messages = written(tmp_path / "s.mcap")
        with (tmp_path / "s.mcap").open("rb") as file:
            read = [
                (c.topic, m.publish_time, m.data)
                for _, c, m in reader(file, validate_crcs=True).iter_messages(log_time_order=False)
            ]
        assert read == messages

    def test_log_time_is_utc(self, tmp_path):
        """By the pair of times in the metadata; a recovered file has the same."""
        messages = written(tmp_path / "s.mcap")
        start = open_session(tmp_path / "s.mcap").metadata["session"]
        offset = int(start["utc_ns"]) - int(start["monotonic_ns"])
        recover(open_session(tmp_path / "s.mcap", allow_damaged=True), tmp_path / "r.mcap", {})
        for name in ("s.mcap", "r.mcap"):
            with (tmp_path / name).open("rb") as file:
                reader = SeekingReader(file, validate_crcs=True)
                read = [m.log_time for _, _, m in reader.iter_messages(log_time_order=False)]
                statistics = reader.get_summary().statistics
            assert read == [m.t_host_ns + offset for m in messages]
            assert (statistics.message_start_time, statistics.message_end_time) == (read[0], read[-1])

    def test_a_tail_of_zeros(self, tmp_path):
        """A power cut may leave a file's length on the disk without its last bytes."""
        messages = written(tmp_path / "s.mcap", 300)
        whole = (tmp_path / "s.mcap").read_bytes()
        for kept in (len(whole) // 4, len(whole) // 3, len(whole) // 2):
            (tmp_path / "cut.mcap").write_bytes(whole[:kept] + bytes(20_000))
            read = list(open_session(tmp_path / "cut.mcap", allow_damaged=True).messages())
            assert 0 < len(read) < len(messages)
            assert read == messages[: len(read)]

    def test_slow_data_does_not_wait_for_a_full_chunk(self, tmp_path):
        lab = Lab()
        writer = SessionWriter(tmp_path / "s.mcap", lab)
        writer.add("/box/adc", lab.now, b"lonely")
        writer.tick(lab.now + CHUNK_NS - 1)
        assert list(open_session(tmp_path / "s.mcap", allow_damaged=True).messages()) == []
        writer.tick(lab.now + CHUNK_NS)
        assert [m.data for m in open_session(tmp_path / "s.mcap", allow_damaged=True).messages()] == [b"lonely"]

    def test_the_disk_is_told_once_a_second_of_real_time(self, tmp_path, monkeypatch):
        calls = []
        now_s = [0.0]
        monkeypatch.setattr("truearm.record.session_writer.os.fsync", calls.append)
        monkeypatch.setattr("truearm.record.session_writer.time.monotonic", lambda: now_s[0])
        writer = SessionWriter(tmp_path / "s.mcap", Lab())
        for k in range(100):  # 10 chunks a second of real time, as in virtual time
            writer.add("/box/adc", k * CHUNK_NS, b"x")
            writer.tick((k + 1) * CHUNK_NS)
            now_s[0] += 0.1
        assert len(calls) == 10
        writer.close()
        assert len(calls) == 11


class TestStrangers:
    def test_no_flipped_bit_passes(self, tmp_path):
        """One bit anywhere in a complete file: what is read is what was written, or the file is refused.

        Metadata (the box's calibration, the clock's anchors) and what stands between chunks have no CRC of their own.
        """
        messages = written(tmp_path / "s.mcap", 60)
        session = open_session(tmp_path / "s.mcap")
        whole = (tmp_path / "s.mcap").read_bytes()
        with (tmp_path / "s.mcap").open("rb") as file:
            data_bytes = SeekingReader(file).get_summary().chunk_indexes[0].chunk_start_offset
        path = tmp_path / "d.mcap"
        bits = [*range(8 * 8, 8 * data_bytes, 3), *random.Random(2).sample(range(8 * data_bytes, 8 * len(whole)), 500)]
        for bit in bits:
            damaged = bytearray(whole)
            damaged[bit // 8] ^= 1 << bit % 8
            path.write_bytes(damaged)
            try:
                found = open_session(path)
                read = list(found.messages())
            except SessionError:
                continue
            assert bit >= 8 * data_bytes  # before the first chunk stand the metadata
            assert (found.metadata, found.attachments, read) == (session.metadata, session.attachments, messages)

    @pytest.mark.parametrize(
        ("content", "code"), [(b"", "not-a-session"), (b"kind,q1_rad\n", "not-a-session"), (None, "missing-file")]
    )
    def test_no_session(self, tmp_path, content, code):
        if content is not None:
            (tmp_path / "s.mcap").write_bytes(content)
        with refused(code, place=tmp_path / "s.mcap"):
            open_session(tmp_path / "s.mcap")

    def test_a_folder(self, tmp_path):
        with refused("unreadable-file", place=tmp_path):
            open_session(tmp_path)

    @pytest.mark.parametrize("claim", ["small", "honest"])
    def test_a_bomb_is_not_unpacked(self, tmp_path, claim):
        size = MAX_CHUNK_BYTES * 4
        compressor = zstandard.ZstdCompressor().compressobj(size=size)
        body = b"".join(compressor.compress(bytes(1 << 20)) for _ in range(size >> 20)) + compressor.flush()
        chunk = Chunk(
            compression="zstd",
            data=body,
            message_start_time=0,
            message_end_time=0,
            uncompressed_crc=0,
            uncompressed_size=size if claim == "honest" else 100,
        )
        path = tmp_path / "s.mcap"
        path.write_bytes(with_chunk(chunk))
        with pytest.raises(SessionError, match="damaged"):
            list(open_session(path).messages())

    def test_a_time_that_no_clock_shows(self, tmp_path):
        """As when bytes of a chunk were changed and its CRC made right again."""
        writer = SessionWriter(tmp_path / "s.mcap", Lab())
        writer.add("/robot/joints", 2**62 - 1, b"{}")
        writer.add("/robot/joints", 2**62, b"{}")
        writer.close()
        with pytest.raises(SessionError, match="damaged"):
            list(open_session(tmp_path / "s.mcap").messages())

    def test_absurd_metadata(self, tmp_path):
        with (tmp_path / "s.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start()
            writer.add_metadata("big", {"x": "y" * (2 << 20)})
            writer.finish()
        with pytest.raises(SessionError, match="damaged"):
            open_session(tmp_path / "s.mcap")


def with_chunk(chunk: Chunk) -> bytes:
    """Return a complete MCAP file that contains this chunk."""
    stream = io.BytesIO()
    writer = Writer(stream, use_statistics=False)
    writer.start()
    head = stream.tell()
    writer.finish()
    builder = RecordBuilder()
    chunk.write(builder)
    whole = stream.getvalue()
    return whole[:head] + builder.end() + whole[head:]


class TestWriterErrors:
    def test_no_overwriting_unless_told(self, tmp_path):
        written(tmp_path / "s.mcap", 3)
        before = (tmp_path / "s.mcap").read_bytes()
        with refused("file-exists"):
            SessionWriter(tmp_path / "s.mcap", Lab())
        assert (tmp_path / "s.mcap").read_bytes() == before

    def test_no_folder(self, tmp_path):
        with pytest.raises(InputError, match="cannot be written"):
            SessionWriter(tmp_path / "none" / "s.mcap", Lab())

    def test_closing_twice(self, tmp_path):
        with SessionWriter(tmp_path / "s.mcap", Lab()) as writer:
            writer.close({"reason": "first"})
            size = writer.path.stat().st_size
        assert (tmp_path / "s.mcap").stat().st_size == size
        assert open_session(tmp_path / "s.mcap").metadata["session-end"]["reason"] == "first"

    def test_held(self, tmp_path):
        """Before it is kept, it is what a killed recorder leaves; closed before, it is none."""
        path = tmp_path / "s.mcap"
        lab = Lab()
        with SessionWriter(path, lab, hold=True) as writer:
            writer.add("/box/adc", lab.now, b"early")
            writer.tick(lab.now + CHUNK_NS)
            assert not writer.kept
            assert open_session(path, allow_damaged=True).truncated  # what a killed recorder leaves
            writer.keep()
            writer.keep()
            writer.add("/box/adc", lab.now, b"late")
        assert [m.data for m in open_session(path).messages()] == [b"early", b"late"]
        with SessionWriter(tmp_path / "never.mcap", lab, hold=True):
            pass
        assert not (tmp_path / "never.mcap").exists()

    @pytest.mark.parametrize("earlier", [False, True])
    def test_of_two_recorders_with_one_name_the_second_is_refused_at_its_start(self, tmp_path, earlier):
        """Not when its box has started: what it had received was lost."""
        path = tmp_path / "s.mcap"
        if earlier:
            written(path, 3)
        before = path.read_bytes() if earlier else b""
        with SessionWriter(path, Lab(), overwrite=earlier, hold=True) as first:
            with refused("in-use" if earlier else "file-exists"):
                SessionWriter(path, Lab(), overwrite=earlier, hold=True)
            assert path.read_bytes()[: len(before)] == before
            first.keep()
        assert open_session(path).metadata["session"]

    @pytest.mark.parametrize("end", ["deleted", "closed"])
    def test_an_earlier_recording_is_intact_until_there_is_another(self, tmp_path, end):
        path = tmp_path / "s.mcap"
        written(path, 3)
        before = path.read_bytes()
        with SessionWriter(path, Lab(), overwrite=True, hold=True) as writer:
            assert path.read_bytes() == before
            if end == "deleted":
                path.unlink()
                writer.keep()
        assert open_session(path).path == path
        assert (path.read_bytes() == before) == (end == "closed")

    def test_a_file_that_came_while_it_was_held(self, tmp_path):
        writer = SessionWriter(tmp_path / "s.mcap", Lab(), hold=True)
        (tmp_path / "s.mcap").write_text("precious")
        with refused("file-exists"):
            writer.keep()
        writer.close()
        assert (tmp_path / "s.mcap").read_text() == "precious"
