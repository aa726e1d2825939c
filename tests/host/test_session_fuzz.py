"""A damaged stream, a damaged session: nothing but our own errors, in bounded time and memory; and no sample that was not sent.

A sample that comes out is the one that was sent under its number, or it is missing and counted. Damage whose CRC was put right is
another message: of it only the bounds hold.
"""

import random
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from blocks_bench import read
from mutations import (
    bounded,
    bytes_changed,
    cbor_changed,
    chunk_changed,
    is_clear,
    length_changed,
    parts_changed,
    records_of,
    with_crc,
)
from record_box import Lab, run_of
from session_stream import BLOCK, PERIOD_NS, Box, ident_document
from tests.wire_frames import data_frame

from truearm.errors import TruearmError
from truearm.record.intake import BoxStorage
from truearm.record.operator import Counters
from truearm.record.requests import Requests
from truearm.record.session_copies import recover
from truearm.record.session_writer import PREVIEW, SessionWriter
from truearm.session.frames import parse_ident
from truearm.session.joint_format import COLUMNS
from truearm.session.session_file import open_session
from truearm.types import Message
from truearm.workflows.inspect import describe
from truearm_wire.frame import frame

BLOCKS = 40
IDENT = parse_ident(ident_document())


def counts_from(n0, n=BLOCK):
    """Return samples whose values are their indices."""
    return 4 * np.arange(n0, n0 + n)[:, None] + np.arange(4)


def made():
    """Return the messages of a box in order: ident, samples, heartbeats, exchanges."""
    box = Box()
    box.ident(1_000_000)
    for k in range(BLOCKS):
        t_ns = 10**9 + k * BLOCK * PERIOD_NS * 5  # slower than true: a session of seconds from few samples
        box.data(t_ns, counts_from(BLOCK * k))
        if k % 10 == 0:
            box.heartbeat(t_ns)
            box.sync(t_ns, 1e5, 2e5)
    return box.messages


MESSAGES = made()
PAYLOADS = [message.data for message in MESSAGES if message.topic != "/sync"]
FRAMES = [bytes(frame(payload)) for payload in PAYLOADS]


class Kept:
    """A writer that keeps what it is given."""

    def __init__(self):
        self.messages = []

    def add(self, topic, t_host_ns, data):
        self.messages.append(Message(topic, t_host_ns, data))

    def add_json(self, *_):
        pass

    def event(self, *_, **__):
        pass


def check_blocks(messages, of_ours=frozenset(PAYLOADS)):
    """The samples of all frames that are ours are what was sent; the numbers of samples seen, and the account."""
    seen = []
    sent = {data._replace(seq=-1) for payload in of_ours if (data := data_frame(payload)) is not None}
    blocks, reader = read(messages, IDENT)
    for block in blocks:
        if block.data in sent:
            np.testing.assert_array_equal(block.counts, counts_from(block.data.n0, block.n))
            seen.append(block.data.n0)
    return seen, reader.losses()


def record_stream(rng, raw):
    """Return what a recorder stores of a stream that arrives in pieces: every byte."""
    kept = Kept()
    storage = BoxStorage(kept, Counters(), Requests(None, Lab(), None))
    at, ended = 0, False
    while at < len(raw) and not ended:
        piece = raw[at : at + rng.choice([1, 7, 64, 250, 4096])]
        at += len(piece)
        try:
            storage.take(10**9 + at, piece)
        except TruearmError as exc:  # an ident of another protocol, say: the recording ends with this frame
            is_clear(exc)
            ended = True
    if not ended:
        storage.flush()
    received = [m for m in kept.messages if not m.topic.startswith(PREVIEW)]  # a preview is made of a frame
    stored = b"".join(m.data if m.topic == "/box/console" else run_of(m.data) for m in received)
    assert raw.replace(b"\0", b"").startswith(stored)
    assert ended or stored == raw.replace(b"\0", b"")
    return kept.messages


def judge_stream(rng, raw):
    """Damage that the CRC tells: what comes out is what was sent, and the rest is counted."""
    stored = record_stream(rng, raw)
    seen, losses = check_blocks(stored)
    if not seen or losses.restarts or losses.starts:  # what is out of order may look like a restart
        return
    assert losses.samples == BLOCK * len(set(seen))
    # What was lost before the first frame that arrived nobody can know, but by a later loss that n0 shows it with.
    begun = next(message.data for message in stored if message.data in PAYLOADS) == PAYLOADS[0]
    counted = losses.samples + losses.samples_lost + losses.samples_overrun
    assert counted == max(seen) + BLOCK or (not begun and counted == max(seen) + BLOCK - min(seen))


def damaged_stream(rng):
    kind = rng.randrange(4)
    if kind == 0:
        return "bytes", bytes_changed(rng, b"".join(FRAMES))
    if kind == 1:
        return "frames", b"".join(bytes_changed(rng, f) if rng.random() < 0.1 else f for f in FRAMES)
    if kind == 2:
        return "moved", b"".join(parts_changed(rng, FRAMES))
    payloads = [cbor_changed(rng, p) if rng.random() < 0.1 else p for p in PAYLOADS]
    return "repaired", b"".join(b"\0" + run_of(p) + b"\0" for p in payloads)


@pytest.mark.parametrize("n", [200, pytest.param(10_000, marks=pytest.mark.soak)])
def test_streams(n):
    outcomes = Counter()
    for seed in range(n):
        rng = random.Random(seed)
        kind, raw = damaged_stream(rng)
        outcomes[kind] += 1
        with bounded():
            if kind == "repaired":
                check_blocks(record_stream(rng, raw))
            else:
                judge_stream(rng, raw)
    assert min(outcomes.values()) > n / 20


# where, how many bytes are taken out, and what is put in their place
@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Return a complete session of the messages: its bytes, and a folder."""
    folder = tmp_path_factory.mktemp("fuzz")
    writer = SessionWriter(folder / "s.mcap", Lab())
    writer.attach("rig.toml", b"")
    for message in MESSAGES:
        writer.add(*message)
    for k in range(60):
        writer.add("/robot/joints", 10**9 + 10**7 * k, b'{"t":%d.5,"seq":%d,"q":[0.5,1.5]}' % (k, k))
    writer.close({"reason": "test"})
    whole = (folder / "s.mcap").read_bytes()
    return SimpleNamespace(folder=folder, whole=whole, messages=list(open_session(folder / "s.mcap").messages()))


def damaged_file(rng, whole):
    """Return a damaged session, and whether its messages may differ or change their order."""
    magic, records = whole[:8], records_of(whole)
    kind = rng.randrange(6)
    if kind == 0:
        return whole[: rng.randrange(len(whole))], ""
    if kind == 1:
        return magic + b"".join(length_changed(rng, records)) + magic, ""
    if kind == 2:
        return magic + b"".join(parts_changed(rng, records)) + magic, "order"
    if kind == 3:
        return magic + b"".join(with_crc(parts_changed(rng, records))) + magic, "order crc"
    if kind == 4:
        return magic + b"".join(chunk_changed(rng, records)) + magic, "content crc"
    return bytes_changed(rng, whole), "order"  # a repeated stretch may be a whole chunk


def recorded(messages):
    """What was recorded; the columns of joint readings are made from the lines beside them, of the copy again."""
    return [message for message in messages if message.topic != COLUMNS]


def judge_file(session, data, may):
    path, out = session.folder / "odd.mcap", session.folder / "recovered.mcap"
    path.write_bytes(data)
    for allow_damaged in (False, True):
        try:
            opened = open_session(path, allow_damaged)
            read = list(opened.messages())
        except TruearmError as exc:
            is_clear(exc, str(path))
            continue
        if not allow_damaged and "crc" not in may:
            assert read == session.messages
        if "content" not in may:
            assert not Counter(read) - Counter(session.messages * 9)
            check_blocks(read)
        if not may:
            rest = iter(session.messages)
            assert all(message in rest for message in read)
            assert len(read) == len(session.messages) or opened.damage or opened.truncated
        try:
            describe(opened)
        except TruearmError as exc:
            is_clear(exc)
        if allow_damaged:
            out.unlink(missing_ok=True)
            recover(opened, out, {})
            assert recorded(open_session(out).messages()) == recorded(read)
            return "read"
    return "refused"


@pytest.mark.parametrize("n", [50, pytest.param(10_000, marks=pytest.mark.soak)])
def test_files(session, n):
    outcomes = Counter()
    for seed in range(n):
        with bounded():
            outcomes[judge_file(session, *damaged_file(random.Random(seed), session.whole))] += 1
    assert outcomes["read"] > n / 2
