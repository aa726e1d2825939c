"""Splitting bytes into frames: nothing is lost, however the bytes are divided, and only valid frames are found."""

import json
from pathlib import Path

import cbor2
import pytest
from hypothesis import given
from hypothesis import strategies as st
from record_box import array, data, frame, run_of, u32, u64
from tests.wire_frames import data_frame

from truearm.record.links import Runs
from truearm.record.requests import MAX_RUN, FrameCount, FrameSplitter, frame_of
from truearm.session.frames import decode, is_echo

VECTORS = Path(__file__).parents[2] / "protocol" / "vectors"

payloads = st.binary(max_size=240).map(lambda tail: array(16, len(tail), cbor2.dumps(tail)))
junk = st.binary(max_size=40).map(lambda raw: raw.replace(b"\0", b"."))


def cut(stream: bytes, lengths: list[int]) -> list[bytes]:
    """The stream in pieces of the given lengths, over and over."""
    pieces, at, k = [], 0, 0
    while at < len(stream):
        pieces.append(stream[at : at + lengths[k % len(lengths)]])
        at += len(pieces[-1])
        k += 1
    return pieces


def split(pieces: list[bytes]) -> list[tuple[bool, bytes]]:
    splitter = FrameSplitter()
    items = [item for piece in pieces for item in splitter.push(piece)]
    items = [(elements is not None, item) for elements, item in items]
    return [*items, (False, rest)] if (rest := splitter.flush()) else items


def rejoined(items: list[tuple[bool, bytes]]) -> bytes:
    return b"".join(run_of(item) if is_frame else item for is_frame, item in items)


class TestSplitter:
    @given(
        st.lists(st.binary(max_size=200) | payloads.map(frame), max_size=30).map(b"".join),
        st.lists(st.integers(1, 300), min_size=1, max_size=5),
    )
    def test_what_goes_in_comes_out(self, stream, lengths):
        items = split(cut(stream, lengths))
        assert rejoined(items) == stream.replace(b"\0", b"")
        assert items == split([stream])

    @given(
        st.lists(st.tuples(payloads, junk, st.sampled_from([b"", b"\0", b"\0\0\0"])), min_size=1, max_size=20),
        st.lists(st.integers(1, 100), min_size=1, max_size=5),
    )
    def test_frames_among_junk_all_come_out(self, parts, lengths):
        stream = b"".join(text + frame(payload) + extra for payload, text, extra in parts)
        items = split(cut(stream, lengths))
        assert [item for is_frame, item in items if is_frame] == [payload for payload, _, _ in parts]
        assert b"".join(item for is_frame, item in items if not is_frame) == b"".join(text for _, text, _ in parts)

    def test_memory_is_bounded_and_the_tail_of_an_overlong_run_is_no_frame(self):
        runs = Runs(b"\0", MAX_RUN)
        n_out = 0
        for _ in range(1000):
            pieces = [piece for _, piece in runs.push(b"x" * 1000)]
            assert all(len(piece) <= MAX_RUN for piece in pieces)
            n_out += sum(map(len, pieces))
        assert n_out + len(runs.flush()) == 1_000_000
        assert 1_000_000 - n_out <= MAX_RUN
        run = run_of(data(1, 0, 0))
        stream = b"x" * MAX_RUN + run + b"\0"
        for pieces in ([stream], [stream[:-1], b"\0"]):
            assert not any(is_frame for is_frame, _ in split(pieces))


class TestPayload:
    def test_every_flipped_bit_is_noticed(self):
        """CRC-32 finds every single flipped bit; one that makes a delimiter leaves two runs that are not frames."""
        raw = frame(data(77, 120, 123_456))
        for bit in range(8, 8 * (len(raw) - 1)):
            flipped = bytearray(raw)
            flipped[bit // 8] ^= 1 << bit % 8
            assert not any(is_frame for is_frame, _ in split([bytes(flipped)])), bit

    @pytest.mark.parametrize(
        "payload",
        [
            cbor2.dumps("not an array"),
            cbor2.dumps({16: 1}),
            b"\x80\x00\x00",  # an empty array
            b"\x9f\x10\x01\xff",  # of indefinite length
            array(-1, 2, 3),
            array("16", 2, 3),
            array(b"\xf9\x3c\x00", 2, 3),  # 1.0
            array(256, 2, 3),
            b"\x98\x00\x10\x01",
        ],
        ids=lambda p: p.hex(),
    )
    def test_a_good_crc_around_no_frame(self, payload):
        assert frame_of(run_of(payload)) == (None, run_of(payload))

    @pytest.mark.parametrize("payload", [b"\x82\x10", b"\x81\x10" + b"\0" * 249], ids=["short", "long"])
    def test_lengths_beyond_the_specification(self, payload):
        assert frame_of(run_of(payload)) == (None, run_of(payload))

    @given(st.integers(0, 255), st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 2, 4, 8]))
    def test_type_and_seq_in_any_width(self, kind, seq, width):
        wide = {0: cbor2.dumps(seq), 4: u32(seq), 8: u64(seq)}
        payload = array(kind, wide.get(width, cbor2.dumps(seq)), "more")
        elements, item = frame_of(run_of(payload))
        assert item == (run_of(payload) if is_echo([kind]) else payload)
        assert elements == (None if is_echo([kind]) else [kind, seq, "more"])

    @given(st.binary(max_size=12))
    def test_any_bytes_are_looked_at_safely(self, raw):
        for look in (frame_of, data_frame, decode):
            look(raw)


@pytest.mark.parametrize(
    ("counts", "lost", "odd"),
    [
        ([7, 8, 10, 11], 1, 0),
        ([7, 8, 8, 9], 0, 1),
        ([7, 8, 5000, 9, 10], 0, 1),  # 4991 frames were once said to be lost
        ([7, 8, 5000, 11, 12], 2, 1),
        ([7, 8, 5000, 5000, 5001], 4991, 1),
        ([2**32 - 2, 40, 2**32 - 1, 0], 0, 1),
        ([2**32 - 2, 1, 2], 2, 0),
        ([7, 8, 0, 1], 0, 2),  # restarted
    ],
)
def test_frames_that_are_lost_or_out_of_place(counts, lost, odd):
    count = FrameCount()
    for seq in counts:
        count.take(seq)
    assert (count.lost, count.odd) == (lost, odd)


class TestVectors:
    """The golden frames of protocol/vectors, and the corrupted ones."""

    @pytest.mark.parametrize("entry", json.loads((VECTORS / "frames.json").read_text()), ids=lambda e: e["name"])
    def test_golden(self, entry):
        raw = (VECTORS / entry["file"]).read_bytes()
        ((is_frame, payload),) = split([raw])
        assert is_frame != (entry["values"][0] == 32 or 48 <= entry["values"][0] < 64)
        if not is_frame:  # only a host sends such: an echo
            assert payload == raw.strip(b"\0")
            return
        assert frame(payload) == raw
        assert frame_of(raw.strip(b"\0"))[0][:2] == entry["values"][:2]

    @pytest.mark.parametrize("entry", json.loads((VECTORS / "corrupted.json").read_text()), ids=lambda e: e["name"])
    def test_corrupted(self, entry):
        raw = (VECTORS / entry["file"]).read_bytes()
        items = split([raw])
        assert not any(is_frame for is_frame, _ in items)
        assert b"".join(item for _, item in items) == raw.replace(b"\0", b"")
