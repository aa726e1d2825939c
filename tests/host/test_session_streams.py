"""Losses, restarts and frames that are out of place: told apart by the count and the boot id, wherever batches end."""

import json

import cbor2
import numpy as np
import pytest
from blocks_bench import BLOCK_NS, COUNTS, account, box_with, read
from hypothesis import example, given, settings
from hypothesis import strategies as st
from session_stream import CHANNELS, PERIOD_NS, Box, columns_of, ident_document

from truearm.session import streams
from truearm.session.frames import parse_ident
from truearm.session.streams import BoxReader
from truearm.types import Message
from truearm_wire import messages as wire

SECOND = 80  # frames of a box at 1 kHz
IDENT = parse_ident(ident_document())


def stream(box, frames, begin_ns=0):
    """Let a box stream, with a heartbeat a second."""
    for k in range(frames):
        box.data(begin_ns + (k + 1) * BLOCK_NS, COUNTS + k)
        if k % SECOND == SECOND - 1:
            box.heartbeat(begin_ns + (k + 1) * BLOCK_NS + 10**6)


def long_box(frames, seq=0):
    box = Box(seq=seq)
    box.ident(0)
    stream(box, frames)
    return box


def restarted(before, after, down_s=2.0):
    """The messages of a box that streams, is without power for a while and streams again; the place of its second boot."""
    box = long_box(before)
    at = len(box.messages)
    boot_ns = int((before + 1) * BLOCK_NS + 1e9 * down_s)
    box.reboot(boot_ns)
    box.ident(boot_ns)
    stream(box, after, boot_ns + 7_000)
    return box.messages, at


def boots_and(messages):
    """Return the number of segments, and the account without what a missing frame costs in samples."""
    found = account(messages)
    return len(read(messages)[1].segments), {k: n for k, n in found.items() if k not in ("samples_lost", "loss_events")}


def in_batches(messages, cuts, ident=IDENT):
    """Return all that a reader says of messages that arrive in batches."""
    reader, blocks = BoxReader(ident), []
    for a, b in zip([0, *cuts], [*cuts, len(messages)], strict=True):
        blocks += reader.feed(columns_of(messages[a:b]))
    blocks += reader.finish()
    rows = [(b.segment, *row) for b in blocks for row in b.table[["run", "gap", "n", "n0", "t_us"]].tolist()]
    segments = [(s.booted, s.boot_id, s.ident, reader.exchanges(s).tolist()) for s in reader.segments]
    return (
        rows,
        np.concatenate([b.counts for b in blocks] or [COUNTS[:0]]).tolist(),
        reader.losses(),
        segments,
        reader.output,
        reader.temperatures,
    )


@pytest.mark.parametrize("gone", [0, 3, 8, 70])
def test_a_restart_is_known_by_its_boot_id(gone):
    """However much of its beginning is lost; frames before the heartbeat that says it belong to the new boot."""
    messages, at = restarted(200, 300)
    del messages[at : at + gone]
    blocks, reader = read(messages)
    assert (reader.losses().restarts, reader.losses().frames_lost) == (1, gone)
    assert [segment.boot_id for segment in reader.segments] == [7, 8]
    assert sum(block.segment for block in blocks) == sum(m.topic == "/box/adc" for m in messages[at:])


@pytest.mark.parametrize(("before", "gone", "down_s"), [(90, 120, 2.5), (90, 120, 60.0), (200, 300, 5.0)])
def test_a_hole_over_a_restart_is_charged_to_the_new_boot_alone(before, gone, down_s):
    """The first frames received of the new boot have higher numbers than the last of the old one, and later times."""
    messages, at = restarted(before, 1000, down_s)
    del messages[at : at + gone]
    assert boots_and(messages) == (2, {"restarts": 1, "frames_lost": gone})


def test_frames_and_losses_around_a_restart():
    # The first of them are behind the old count, the others continue it: in number, and nearly in time.
    messages, at = restarted(60, 300, down_s=0.001)
    first = len(long_box(60).messages) - 20
    del messages[at : at + first]
    assert boots_and(messages) == (2, {"restarts": 1, "frames_lost": first})
    assert in_batches(messages, [at + 20]) == in_batches(messages, [])
    messages, at = restarted(200, 300)
    del messages[at - 20 : at - 10]
    assert boots_and(messages) == (2, {"restarts": 1, "frames_lost": 10})
    assert [block.segment for block in read(messages)[0]].count(0) == 190


@pytest.mark.parametrize("seq", [0, 700, 2**32 - 1])
def test_a_single_frame_behind_the_count_changes_nothing(seq):
    """It states the box's own boot id: the count continues."""
    messages = long_box(20 * SECOND).messages
    beat = next(m for m in messages if m.topic == "/box/heartbeat")
    _, _, *rest = cbor2.loads(beat.data)
    messages.insert(10 * SECOND, beat._replace(data=bytes(wire.encode_payload([wire.HEARTBEAT, seq, *rest]))))
    assert account(messages) == {"frames_malformed": 1}
    assert [block.gap for block in read(messages)[0]].count(True) == 1


@pytest.mark.parametrize("bit", [12, 30])
def test_a_first_frame_ahead_of_the_count_is_malformed_itself(bit):
    """One that states the boot id; another one could be the last of a boot before."""
    messages = long_box(20 * SECOND).messages
    messages = messages[[k for k, m in enumerate(messages) if m.topic == "/box/heartbeat"][1] :]
    seq = cbor2.loads(messages[0].data)[1]
    assert not seq & 1 << bit
    numbers = [b"\x1a" + number.to_bytes(4, "big") for number in (seq, seq | 1 << bit)]
    odd = messages[0]._replace(data=messages[0].data.replace(*numbers, 1))
    assert account([odd, *messages[1:]]) == account(messages[1:]) | {"frames_malformed": 1}


@pytest.mark.parametrize("of", ["heartbeat", "adc"])
@pytest.mark.parametrize("bit", [2, 12, 30])
def test_a_single_frame_ahead_of_the_count_is_malformed_itself(of, bit):
    """Wherever a batch ends; its place is a lost frame."""
    messages = long_box(20 * SECOND).messages
    at = [k for k, m in enumerate(messages) if m.topic == f"/box/{of}"][9]
    seq = cbor2.loads(messages[at].data)[1]
    assert not seq & 1 << bit
    numbers = [b"\x1a" + number.to_bytes(4, "big") for number in (seq, seq | 1 << bit)]
    odd = messages[at]._replace(data=messages[at].data.replace(*numbers, 1))
    whole, messages[at] = account(messages), odd
    found = account(messages)
    assert (found["frames_malformed"], found["frames_lost"]) == (1, 1)
    assert not whole
    for cut in (at, at + 1, at + 2):
        assert in_batches(messages, [cut]) == in_batches(messages, [])


@pytest.mark.parametrize("number", [2**63, 2**70, -(2**70), -1, 2**1500])
def test_numbers_that_no_box_can_send_are_malformed(number):
    """As a type, and as an element that has no range of its own."""
    box = long_box(4 * SECOND)
    beat = next(m for m in box.messages if m.topic == "/box/heartbeat")
    _, _, boot, *rest = cbor2.loads(beat.data)
    odd = ([number, box.seq, boot, *rest], [wire.HEARTBEAT, box.seq + 1, boot, *(number for _ in rest)])
    messages = [*box.messages, *(beat._replace(data=cbor2.dumps(frame)) for frame in odd)]
    assert account(messages)["frames_malformed"] == 2


@pytest.mark.parametrize("n", [1, SECOND, 5 * SECOND])
def test_a_piece_that_stands_twice_in_a_file_is_malformed(n):
    messages = long_box(40 * SECOND).messages
    messages[30 * SECOND : 30 * SECOND] = messages[SECOND : SECOND + n]
    assert boots_and(messages) == (1, {"frames_malformed": n})


def test_frames_without_a_boot_id_are_not_held_for_ever(monkeypatch):
    """Of a file that no recorder has written: the count continues behind the hole."""
    monkeypatch.setattr(streams, "MOST_HELD", 100)
    messages = box_with(blocks=400).messages[:-199]  # behind its only heartbeat
    del messages[60:65]
    messages += box_with(blocks=400).messages[-190:]
    beat = max(k for k, m in enumerate(messages) if m.topic == "/box/heartbeat")
    reader = BoxReader(IDENT)
    before, behind = reader.feed(columns_of(messages[beat + 1 :])) + reader.finish()
    assert (len(before), len(behind)) == (sum(m.topic == "/box/adc" for m in messages[beat + 1 :]) - 100, 100)


def recording(rng, frames, reboots):
    """Return the messages of a streaming box with all kinds of occasional frames; some are lost, doubled or flipped."""
    box, t = Box(), 0
    box.ident(0)
    for k in range(frames):
        t += BLOCK_NS
        if k in reboots:
            box.reboot(t := t + 10**8)
            box.ident(t)
        box.data(t, COUNTS[: int(rng.integers(1, 14))], int(rng.random() < 0.02), int(rng.random() < 0.02) * 5)
        if rng.random() < 0.05:
            box.heartbeat(t)
        if rng.random() < 0.1:
            box.sync(t, 1e5, 1e5)
        if rng.random() < 0.06:
            box.frame("event", t, wire.EVENT, int(rng.integers(0, 3)), box.device_us(t), 1)
        if rng.random() < 0.02:
            box.n0 = 0  # started again
    received = []
    for message in box.messages:
        fate = rng.random() if message.topic != "/sync" else 1.0
        if fate > 0.02:
            received.append(message)
        if fate < 0.01:
            received += [message, message]
        elif fate < 0.015:
            data = bytearray(message.data)
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
            received.append(message._replace(data=bytes(data)))
    return received


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.lists(st.integers(1, 400), max_size=8))
@example(79, [166])
@example(265, [3, 28, 71, 102, 140])
def test_where_batches_end_changes_nothing(seed, cuts):
    messages = recording(np.random.default_rng(seed), 200, {60, 61, 150})
    cuts = sorted({min(cut, len(messages)) for cut in cuts})
    assert in_batches(messages, cuts) == in_batches(messages, [])


def test_exchanges_of_odd_text():
    lines = [b"{}", b"1],[2", b'{"t0_ns":1', json.dumps({"t0_ns": 1, "t1_us": 2, "t2_us": True, "t3_ns": 4}).encode()]
    good = json.dumps({"t0_ns": 1, "t1_us": 2, "t2_us": 3, "t3_ns": 4}).encode()
    _, reader = read([Message("/sync", k, line) for k, line in enumerate([good, *lines, good])])
    assert reader.exchanges(reader.segment).tolist() == 2 * [[1, 2, 3, 4]]
    assert (reader.losses().sync_requests, reader.losses().sync_unanswered) == (6, 4)


def test_counts_of_frames_of_several_lengths():
    box = Box()
    box.ident(0)
    sent = [np.arange(n * CHANNELS).reshape(n, CHANNELS) - 7 * n for n in (13, 13, 4, 1, 13, 2)]
    for k, counts in enumerate(sent):
        box.data((k + 1) * BLOCK_NS, counts)
    reader = BoxReader()
    (blocks,) = reader.feed(columns_of(box.messages)) + reader.finish()
    np.testing.assert_array_equal(blocks.counts, np.concatenate(sent))
    assert blocks.within_ns().tolist() == [k * PERIOD_NS for counts in sent for k in range(len(counts))]


@pytest.mark.parametrize("seed", range(20))
def test_a_boot_without_an_identity_costs_none_of_the_others_samples(seed):
    """Its ident is lost, and the box restarts again before its first heartbeat."""
    rng = np.random.default_rng(seed)
    box, received, whole = Box(), [], 0
    for boot in range(4):
        if boot:
            box.reboot(box.messages[-1].t_host_ns + 10**9)
        begin = len(box.messages)
        box.ident(box.boot_host_ns)
        stream(box, int(rng.choice([5, 60, 79, 150])), box.boot_host_ns)
        new = [m for m in box.messages[begin:] if boot % 2 == 0 or m.topic != "/box/ident"]
        whole += (boot % 2 == 0 or len(new) > SECOND) and sum(m.topic == "/box/adc" for m in new)
        received += new
    assert len(read(received)[0]) >= whole
