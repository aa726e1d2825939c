"""The reader of columns gives the same result as the reader of single messages, for any damage and any batch boundaries."""

import json
from dataclasses import asdict

import cbor2
import numpy as np
import oracle_box_reader as oracle
import pytest
from blocks_bench import BLOCK_NS, COUNTS
from hypothesis import given, settings
from hypothesis import strategies as st
from session_stream import CHANNELS, PERIOD_NS, Box, ident_document
from session_worlds import world

from truearm.session.box_ident import parse_ident
from truearm.session.box_reader import BoxReader
from truearm.session.message_columns import columns_of
from truearm.types import Message
from truearm_wire import messages as wire
from truearm_wire.cbor import Tag

FATES = st.sampled_from(["lost", "doubled", "doubled later", "flipped", "swapped", "late", "console"])


class TwoStreams(Box):
    """A box with a second stream, whose frames contain the time of each sample."""

    n0_mag = 0

    def offsets(self, t_host_ns, n=5):
        times = Tag(69, (np.arange(n) * 900).astype("<u2").tobytes())
        samples = Tag(78, np.arange(n, dtype="<i4").tobytes())
        self.frame("mag", t_host_ns, wire.DATA, 1, self.n0_mag, self.device_us(t_host_ns), times, samples, 0)
        self.n0_mag += n


def described():
    document = ident_document(7)
    channel = {"name": "magnetostrictive", "unit": "s", "scale": [8, -9]}
    mag = {"id": 1, "name": "mag", "period_ns": PERIOD_NS, "osr": 0, "group_delay_ns": 0, "channels": [channel]}
    document["streams"].append(mag)
    document["thermometers"] = [{"name": "bar"}]
    return parse_ident(document)


def recording(rng, frames, seq=0, reboots=()):
    """Return a streaming box with all kinds of occasional frames."""
    box = TwoStreams(seq=seq)
    box.ident(0)
    t = 0
    for k in range(frames):
        t += BLOCK_NS
        if k in reboots:
            t += 10**8
            box.reboot(t)
            box.n0_mag = 0
            box.ident(t)
        box.data(t, COUNTS[: int(rng.integers(1, 14))], int(rng.random() < 0.02), int(rng.random() < 0.02) * 5)
        if rng.random() < 0.1:
            box.offsets(t)
        if rng.random() < 0.05:
            box.heartbeat(t)
        if rng.random() < 0.1:
            box.sync(t, 1e5, 1e5)
        if rng.random() < 0.03:
            box.frame("event", t, wire.EVENT, int(rng.integers(0, 3)), box.device_us(t), 1)
        if rng.random() < 0.03:
            box.frame("temperature", t, wire.TEMPERATURE, box.device_us(t), int(rng.integers(0, 2)), 24_000)
        if rng.random() < 0.02:
            box.n0 = 0  # started again
    return box.messages


def suffered(rng, messages, share, fates):
    """Return the messages as they arrive, some of them damaged."""
    received = []
    later = []
    for k, message in enumerate(messages):
        received += [m for at, m in later if at == k]
        fate = fates[int(rng.integers(len(fates)))] if rng.random() < share and message.topic != "/sync" else "kept"
        if fate == "flipped":
            data = bytearray(message.data)
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
            received.append(message._replace(data=bytes(data)))
        elif fate == "console":
            received.append(message._replace(topic="/box/console"))
        elif fate == "swapped" and received:
            received.insert(len(received) - int(rng.integers(1, min(4, len(received)) + 1)), message)
        elif fate == "late":
            later.append((k + int(rng.integers(1, 700)), message))
        elif fate != "lost":
            received.append(message)
            if fate == "doubled":
                received.append(message)
            elif fate == "doubled later":
                later.append((k + int(rng.integers(1, 700)), message))
    return received


def one_by_one(messages, ident):
    """Return the oracle's result: blocks with the message at which each was released, and the rest."""
    reader, blocks = oracle.BoxReader(ident), []
    for at, message in enumerate(messages):
        blocks += [(at, block) for block in reader.feed(message)]
    blocks += [(len(messages), block) for block in reader.finish()]
    streams = {}
    for at, b in blocks:
        stream = streams.setdefault(b.data.stream, [])
        values = b.segment, b.run, b.gap, b.n, b.data.n0, b.data.t0_us, b.data.period_ns, b.data.flags, b.t_host_ns, at
        stream.append((*values, b.data.offsets_us, b.counts.tobytes(), b.ident))
    return streams, summary(reader)


def in_batches(messages, ident, cuts):
    """Return the same from the reader of columns, in batches that end at these messages."""
    reader, streams, begin = BoxReader(ident), {}, 0

    def keep(blocks, begin):
        for b in blocks:
            counts = np.split(b.counts(), b.first[1:])
            columns = b.run, b.gap, b.n, b.n0, b.t0_us, b.period_ns, b.flags, b.t_host_ns, begin + b.at
            for k, row in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
                offsets = b.offsets_us.get(k, b"")
                streams.setdefault(b.stream.id, []).append((b.segment, *row, offsets, counts[k].tobytes(), b.ident))

    for end in [*cuts, len(messages)]:
        keep(reader.feed(columns_of(messages[begin:end])), begin)
        begin, last = end, begin
    keep(reader.finish(), last)
    return streams, summary(reader)


def summary(reader):
    segments = [
        (s.booted, s.boot_id, s.ident, np.reshape(s.exchanges, (-1, 4)).tolist(), s.output, s.temperatures)
        for s in reader.segments
    ]  # fmt: skip
    return asdict(reader.losses()), str(reader.streams()), segments


def assert_same(messages, ident, cuts):
    assert in_batches(messages, ident, cuts) == one_by_one(messages, ident)


@settings(max_examples=80, deadline=None)
@given(
    st.integers(0, 2**32),
    st.sampled_from([0, 700, 2**31 - 40, 2**32 - 90]),
    st.sampled_from([0.0, 0.01, 0.1, 0.5]),
    st.lists(FATES, min_size=1, max_size=7),
    st.lists(st.integers(0, 400), max_size=3),
    st.lists(st.integers(0, 400), max_size=6),
    st.booleans(),
)
def test_the_columns_say_what_the_single_messages_say(seed, seq, share, fates, reboots, cuts, known):
    rng = np.random.default_rng(seed)
    messages = suffered(rng, recording(rng, int(rng.integers(1, 400)), seq, reboots), share, fates)
    cuts = sorted(min(cut, len(messages)) for cut in cuts)
    assert_same(messages, described() if known else None, cuts)


@pytest.mark.parametrize("seed", [1, 2])
def test_at_every_end_of_a_batch(seed):
    rng = np.random.default_rng(seed)
    fates = ["lost", "doubled", "doubled later", "flipped", "swapped", "late", "console"]
    messages = suffered(rng, recording(rng, 90, reboots=(40,)), 0.1, fates)
    expected = one_by_one(messages, described())
    for cut in range(len(messages) + 1):
        assert in_batches(messages, described(), [cut]) == expected


def test_long_loss_and_late_seconds():
    """More than the reach is missing; seconds that arrive in the wrong order, and some frames twice."""
    rng = np.random.default_rng(3)
    messages = recording(rng, 3000)
    del messages[1200:1900]
    for k in range(200, len(messages) - 200, 160):
        messages[k : k + 80], messages[k + 80 : k + 160] = messages[k + 80 : k + 160], messages[k : k + 80]
    for k in rng.choice(len(messages) - 100, 46, replace=False).tolist():
        messages.insert(k + 60, messages[k])
    assert_same(messages, described(), [500, 1000, 1003])


def test_a_boot_id_that_becomes_known_within_a_run():
    """The pages of a boot wait for frames before them; a run that releases them has a heartbeat of another boot."""
    box = Box(seq=2**32 - 700)
    box.ident(0)
    box.seq = 85
    box.data(10**9, COUNTS)
    box.boot_id = 8
    box.heartbeat(10**9 + 10**6)
    assert_same(box.messages, described(), [])


def test_a_run_that_fills_a_hole_and_seems_to_be_of_an_earlier_boot_from_its_second_frame_on():
    """The device time of that frame is years ahead, as if its boot had begun long before the session."""
    box, second = Box(seq=1100), 10**9
    box.data(550 * second, COUNTS)
    box.reboot(552 * second)
    box.ident(552 * second)
    box.seq = 633
    for k, seq in enumerate([633, 816, 814, 815]):
        box.seq = seq
        box.boot_host_ns -= 2 * 10**15 * (seq == 815)
        box.data((612 + 90 * (k > 0)) * second + (seq == 816), COUNTS)
    assert_same(box.messages, described(), [])


def moved(rng, frames):
    """Return a recording with a restart and pieces of it lost, doubled, flipped or moved, often near the restart."""
    seq = int(rng.choice([0, 0, 2**32 - 700]))
    at = int(rng.integers(20, frames))
    received = recording(rng, frames, seq, (at,) if rng.random() < 0.8 else ())
    boot = next((k for k, m in enumerate(received) if k and m.topic == "/box/ident"), 0)
    if rng.random() < 0.3:
        received = [m for m in received if m.topic != "/box/ident" or rng.random() < 0.5]
    for _ in range(int(rng.integers(1, 8))):
        if len(received) < 2:
            break
        near = int(rng.integers(-5, 5)) + boot
        begin = int(np.clip(near if rng.random() < 0.5 else rng.integers(len(received)), 0, len(received) - 1))
        n = int(rng.choice([1, 2, 3, 30, 64, 65, 90]))
        piece, later = received[begin : begin + n], int(rng.choice([1, 2, 100, 511, 512, 513, 1023, 1025, 1100]))
        fate = rng.random()
        if fate < 0.3 or 0.5 < fate < 0.75:
            del received[begin : begin + n]
        if fate < 0.5:
            place = min(len(received), begin + later)
            received[place:place] = piece
        elif fate > 0.75 and piece[0].data:
            data = bytearray(piece[0].data)
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
            received[begin] = piece[0]._replace(data=bytes(data))
    return received or [Message("/box/adc", 0, b"")]


def assert_same_when_moved(seed, frames):
    rng = np.random.default_rng(seed)
    received = moved(rng, int(rng.choice(frames)))
    some = int(rng.choice([0, 1, 5, 60]))
    cuts = np.unique(rng.integers(0, len(received), some)) if rng.random() < 0.9 else np.arange(1, len(received))
    assert_same(received, described() if rng.random() < 0.5 else None, cuts.tolist())


@pytest.mark.parametrize("seed", range(30))
def test_pieces_moved_around_a_restart(seed):
    assert_same_when_moved(seed, [40, 300])


@pytest.mark.soak
def test_pieces_moved_around_a_restart_in_many_worlds():
    for seed in range(1000, 4000):
        assert_same_when_moved(seed, [40, 300, 1500])


def assert_same_in_a_world(seed):
    rng = np.random.default_rng(seed)
    received = world(rng)
    ident = described() if rng.random() < 0.5 else None
    expected = one_by_one(received, ident)
    some = np.unique(rng.integers(0, len(received), int(rng.choice([1, 5, 60])))).tolist()
    singly = [*range(1, len(received))]
    for cuts in ([], some, singly) if seed % 10 == 0 else ([], some):
        assert in_batches(received, ident, cuts) == expected
    if len(received) < 80:
        for cut in range(0, len(received), 1 if seed % 10 == 0 else 20):
            assert in_batches(received, ident, [cut]) == expected


def test_random_worlds():
    for seed in range(30):
        assert_same_in_a_world(seed)


@pytest.mark.soak
def test_many_random_worlds():
    for seed in range(10_000, 14_000):
        assert_same_in_a_world(seed)


FRAME = st.one_of(
    st.binary(max_size=260),
    st.tuples(st.sampled_from([16, 17, 18, 19, 33, 64, 99]), st.integers(0, 3), st.lists(
        st.one_of(st.integers(-5, 40), st.integers(0, 2**64 - 1), st.binary(max_size=40), st.just(cbor2.CBORTag(78, bytes(16)))),
        max_size=18,
    )).map(lambda f: cbor2.dumps([f[0], f[1], *f[2]])),
)  # fmt: skip


@settings(max_examples=80, deadline=None)
@given(st.lists(FRAME, max_size=12), st.integers(0, 2**32), st.integers(0, 60))
def test_strangers_frames_among_the_boxs(payloads, seed, cut):
    rng = np.random.default_rng(seed)
    messages = recording(rng, 40)
    for payload in payloads:
        messages.insert(int(rng.integers(len(messages) + 1)), Message("/box/other", 5, payload))
    assert_same(messages, described(), [min(cut, len(messages))])


def test_exchanges_of_odd_text():
    lines = [b"{}", b"1],[2", b'{"t0_ns":1', json.dumps({"t0_ns": 1, "t1_us": 2, "t2_us": True, "t3_ns": 4}).encode()]
    good = json.dumps({"t0_ns": 1, "t1_us": 2, "t2_us": 3, "t3_ns": 4}).encode()
    messages = [Message("/sync", k, line) for k, line in enumerate([good, *lines, good])]
    assert_same(messages, None, [2])


def test_counts_of_frames_of_several_lengths():
    box = Box()
    box.ident(0)
    sent = [np.arange(n * CHANNELS).reshape(n, CHANNELS) - 7 * n for n in (13, 13, 4, 1, 13, 2)]
    for k, counts in enumerate(sent):
        box.data((k + 1) * BLOCK_NS, counts)
    (blocks,) = BoxReader().feed(columns_of(box.messages))
    np.testing.assert_array_equal(blocks.counts(), np.concatenate(sent))
    assert blocks.within_ns().tolist() == [k * PERIOD_NS for counts in sent for k in range(len(counts))]
