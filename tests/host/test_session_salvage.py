"""A damaged session gives all its intact data, and the places and amounts of missing data."""

import pytest
from mcap.opcode import Opcode
from test_session import chunks_of, written

from truearm.errors import SessionError
from truearm.session.session_file import MAX_BAD, open_session

STEP_S = 0.01  # of the messages that `written` makes
N = 500


@pytest.fixture
def path(tmp_path):
    return tmp_path / "s.mcap"


@pytest.fixture
def made(path):
    """Messages of a good session, its bytes and its chunks; each chunk with the messages that are in it."""
    messages = written(path, N)
    chunks = chunks_of(path, messages)
    assert len(chunks) >= 5
    return messages, path.read_bytes(), chunks


def outside(messages, *chunks):
    """The messages of all other chunks."""
    gone = {id(message) for chunk in chunks for message in chunk.holds}
    return [message for message in messages if id(message) not in gone]


def flipped(whole, at, bit=1):
    damaged = bytearray(whole)
    damaged[at] ^= bit
    return bytes(damaged)


@pytest.mark.parametrize("which", [0, 2, -1])
@pytest.mark.parametrize(
    "where", ["opcode", "private opcode", "length", "huge length", "times", "head", "data", "last byte"]
)
def test_one_bit_costs_one_chunk(path, made, which, where):
    messages, whole, chunks = made
    chunk = chunks[which]
    start = chunk.chunk_start_offset
    at, bit = {
        "opcode": (start, 1),
        "private opcode": (start, 0x80),
        "length": (start + 1, 4),
        "huge length": (start + 7, 4),
        "times": (start + 9 + 24, 1),  # the CRC of its messages
        "head": (start + 9 + 28, 1),
        "data": (start + chunk.chunk_length // 2, 1),
        "last byte": (start + chunk.chunk_length - 1, 0x10),
    }[where]
    path.write_bytes(flipped(whole, at, bit))
    with pytest.raises(SessionError, match="allow_damaged"):
        list(open_session(path).messages())
    session = open_session(path, allow_damaged=True)
    assert list(session.messages()) == outside(messages, chunk)
    assert not session.truncated
    assert session.attachments == {"rig.toml": b"x = 1\n"}
    assert session.metadata["session-end"]["reason"] == "test"
    (damage,) = session.damage
    assert damage.at == start
    lost_s = 1e-9 * (chunk.message_end_time - chunk.message_start_time)
    assert lost_s - 1e-6 <= damage.lost_s <= lost_s + 2 * STEP_S + 1e-6
    assert damage.of_s == pytest.approx((N - 1) * STEP_S)


def test_bytes_that_are_missing(path, made):
    """3000 bytes cut from the middle are not a killed recorder."""
    messages, whole, chunks = made
    middle = chunks[2].chunk_start_offset + 30
    cut = 3000 if len(whole) > 9000 else len(whole) // 4
    path.write_bytes(whole[:middle] + whole[middle + cut :])
    hit = [c for c in chunks if c.chunk_start_offset + c.chunk_length > middle and c.chunk_start_offset < middle + cut]
    with pytest.raises(SessionError, match=f"damaged at byte {chunks[2].chunk_start_offset};"):
        open_session(path)
    session = open_session(path, allow_damaged=True)
    assert list(session.messages()) == outside(messages, *hit)
    assert not session.truncated
    (damage,) = session.damage
    assert damage.at == chunks[2].chunk_start_offset
    lost_s = 1e-9 * (hit[-1].message_end_time - hit[0].message_start_time)
    assert damage.lost_s == pytest.approx(lost_s, abs=2 * STEP_S + 1e-6)


def test_files_that_are_cut_off_or_whole(path, made):
    messages, whole, chunks = made
    session = open_session(path, allow_damaged=True)
    assert (session.damage, list(session.messages())) == ((), messages)
    # A killed recorder's file has no CRC over all: the damage in its middle is found, and told from its end.
    end = chunks[4].chunk_start_offset
    path.write_bytes(flipped(whole[: end + 40], chunks[2].chunk_start_offset + 100))
    session = open_session(path, allow_damaged=True)
    assert session.truncated
    assert [damage.at for damage in session.damage] == [chunks[2].chunk_start_offset]
    assert list(session.messages()) == outside(messages, chunks[2], *chunks[4:])
    # There MCAP says which channel is which topic, and a file that is cut off does not say it again.
    path.write_bytes(flipped(whole[: chunks[-1].chunk_start_offset], chunks[0].chunk_start_offset + 100))
    session = open_session(path, allow_damaged=True)
    assert list(session.messages()) == outside(messages, chunks[0], chunks[-1])
    assert [damage.at for damage in session.damage] == [chunks[0].chunk_start_offset]


def test_metadata_that_are_damaged_are_left_out(path, made):
    """Calibration and anchors are no better than the messages; they have a CRC of ours. Their copies are as good."""
    messages, whole, _ = made
    path.write_bytes(whole.replace(b"virtual", b"virtuaL", 1))
    session = open_session(path, allow_damaged=True)
    assert list(session.messages()) == messages
    assert session.metadata["session"]["clock"] == "virtual"
    (damage,) = session.damage
    assert whole[damage.at] == Opcode.METADATA
    path.write_bytes(whole.replace(b"virtual", b"virtuaL"))
    session = open_session(path, allow_damaged=True)
    assert "session" not in session.metadata
    assert len(session.damage) == 2


def test_names_headers_and_starts_that_are_damaged(path, made):
    # Cut off and without the chunk that declares the topics: what repeats their names is believed where it is whole.
    messages, whole, chunks = made
    start, end = chunks[0].chunk_start_offset, chunks[-1].chunk_start_offset
    head = whole[:start].replace(b"/box/adc", b"/box/adk", 1)
    path.write_bytes(flipped(head + whole[start:end], start + 100))
    assert list(open_session(path, allow_damaged=True).messages()) == outside(messages, chunks[0], chunks[-1])
    path.write_bytes(flipped(whole[:start].replace(b"/box/adc", b"/box/adk") + whole[start:end], start + 100))
    assert list(open_session(path, allow_damaged=True).messages()) == []
    messages, whole, _ = made
    path.write_bytes(whole.replace(b"truearm 0", b"truearm 9", 1))
    session = open_session(path, allow_damaged=True)
    assert list(session.messages()) == messages
    (damage,) = session.damage
    assert damage.at is None  # the CRC of the whole file does not match; those of all its parts do
    # Records that claim to be chunks and are none, one after the other.
    _, whole, chunks = made
    false = b"\x06" + (40).to_bytes(8, "little") + bytes(16) + b"\1" + bytes(23)
    path.write_bytes(whole[: chunks[0].chunk_start_offset] + false * (MAX_BAD + 1))
    with pytest.raises(SessionError, match="damaged in more than"):
        open_session(path, allow_damaged=True)


def test_a_search_goes_on_from_block_to_block(path, made, monkeypatch):
    messages, whole, chunks = made
    second = chunks[2].chunk_start_offset
    for block in (1, 7, 64):
        monkeypatch.setattr("truearm.session.session_file._BLOCK", block)
        path.write_bytes(flipped(whole, second + 7))
        assert list(open_session(path, allow_damaged=True).messages()) == outside(messages, chunks[2])
