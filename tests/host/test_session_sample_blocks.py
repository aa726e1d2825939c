"""Exact accounting: injected faults, mixtures of them and arbitrary bytes are counted, and nothing else."""

import json
from dataclasses import asdict

import cbor2
import numpy as np
import pytest
from blocks_bench import BLOCK_NS, COUNTS, account, box_with, data_places, read
from hypothesis import given, settings
from hypothesis import strategies as st
from session_stream import PERIOD_NS, Box, ident_document

from truearm.session.frames import FRAME, parse_ident
from truearm.session.streams import Losses, StreamTrack
from truearm.types import Message
from truearm_wire import messages as wire
from truearm_wire.cbor import Tag


def blocks_of(n0, t0_us):
    """Return a block of 13 samples."""
    rows = np.zeros(1, FRAME)
    rows["n0"], rows["n"], rows["t_us"] = n0, 13, 13_000 * t0_us
    return rows


def test_a_clean_stream_a_traceback_and_a_short_write_lose_nothing():
    box = box_with()
    blocks, reader = read(box.messages)
    assert account(box.messages) == {}
    assert reader.losses().samples == 20 * 13
    assert [block.gap for block in blocks] == [True] + [False] * 19
    assert np.array_equal(blocks[3].counts, COUNTS + 3)
    assert [block.data.n0 for block in blocks] == list(range(0, 260, 13))
    assert reader.segment.boot_id == 7
    assert len(reader.exchanges(reader.segment)) == 1
    (stream,) = reader.streams()
    assert (stream.name, stream.samples, stream.pieces, stream.period_ns) == ("adc", 260, 1, PERIOD_NS)
    # 19 blocks between stamps that are cut to 1 µs each
    assert stream.measured_ns == pytest.approx(PERIOD_NS, abs=1000.0 / (19 * 13))
    box = box_with()
    text = b'Traceback (most recent call last):\r\n  File "main.py", line 3, in <module>\r\nMemoryError: \xc2\xb5\r\n'
    box.messages.insert(9, Message("/box/console", 5, text))
    expected = {"console_runs": 1, "console_text_runs": 1, "console_bytes": len(text)}
    assert account(box.messages) == expected
    box = box_with()
    box.heartbeat(10**9, short_writes=1, sent=99, overruns=4, dropped=2, bad_frames=3, loop_max_us=700, heap_free=9000)
    box.heartbeat(
        2 * 10**9, short_writes=1, sent=120, overruns=4, dropped=2, bad_frames=3, loop_max_us=300, heap_free=9999
    )
    counters = read(box.messages)[1].losses().box
    assert (counters["heartbeats"], counters["sent"], counters["short_writes"]) == (3, 120, 1)
    assert (counters["overruns"], counters["dropped"], counters["bad_frames"]) == (4, 2, 3)
    assert (counters["loop_max_us"], counters["heap_free_min"]) == (700, 0)
    assert account(box.messages) == {}


def test_a_box_is_charged_from_its_boot_in_the_session():
    # A killed recorder left it streaming: old blocks of its ring, a jump to those of now, the new start, and a loss
    # behind that.
    track = StreamTrack()
    for t0_us, n0 in enumerate((5000, 5013, 10_200, 10_213, 0, 13, 39)):
        track.take(blocks_of(n0, t0_us))
    assert [track.counted[name] for name in ("samples_overrun", "starts", "pieces")] == [13, 1, 2]
    joined = StreamTrack()
    for t0_us, n0 in enumerate((5000, 5026)):  # never started: what is missing is missing
        joined.take(blocks_of(n0, t0_us))
    assert (joined.counted["samples_overrun"], joined.counted["pieces"]) == (13, 2)
    box = Box(seq=5000)
    for k, overruns in enumerate((61_000, 61_000, 61_007)):
        box.heartbeat((2 + k) * 10**9, overruns=overruns, short_writes=12, bad_frames=3, sent=5000 + 80 * k)
    counters = read(box.messages)[1].losses().box
    assert (counters["heartbeats"], counters["sent"]) == (3, 160)
    assert (counters["overruns"], counters["short_writes"], counters["bad_frames"]) == (7, 0, 0)
    # Asked for, ident carries the command's req_id.
    box = Box(seq=5000)
    for page, pages, data in wire.pages(cbor2.dumps(ident_document())):
        box.frame("ident", 10**9, wire.IDENT, 4, page, pages, data)
    box.heartbeat(2 * 10**9, overruns=9)
    assert read(box.messages)[1].losses().box["overruns"] == 0
    box = Box()
    box.ident(10**9)
    box.heartbeat(2 * 10**9, overruns=9)
    assert read(box.messages)[1].losses().box["overruns"] == 9
    joined = box.messages[-1:]
    box.reboot(3 * 10**9)
    box.heartbeat(4 * 10**9, overruns=5)  # its ident was lost
    reader = read([*joined, box.messages[-1]])[1]
    assert (reader.losses().restarts, reader.losses().box["overruns"]) == (1, 5)


def test_blocks_of_two_streams_are_accounted_for_apart():
    """The head's frames between the converter's: each stream has its own n0, and a stop that is missing is not a gap."""
    document = ident_document(7)
    channel = {"name": "magnetostrictive", "unit": "s", "scale": [8, -9]}
    mag = {"id": 1, "name": "mag", "period_ns": PERIOD_NS, "osr": 0, "group_delay_ns": 0, "channels": [channel]}
    document["streams"].append(mag)
    box = Box()
    ticks = np.arange(12_500, 12_500 + 52, dtype="<i4")
    for k in range(8):
        box.data((k + 1) * BLOCK_NS, COUNTS + k)
        if k % 4 == 3:
            t0, flags = box.device_us(BLOCK_NS * (k - 3)), wire.FLAG_MISSING_STOP if k == 7 else 0
            tag = Tag(78, ticks.tobytes())
            box.frame("mag", k * BLOCK_NS + 10**6, wire.DATA, 1, 52 * (k // 4), t0, PERIOD_NS, tag, flags)
    blocks, reader = read(box.messages, parse_ident(document))
    mine = [block for block in blocks if block.data.stream == 1]
    assert [(block.n, block.channels, block.gap) for block in mine] == [(52, 1, True), (52, 1, False)]
    assert np.array_equal(mine[0].counts[:, 0], ticks)
    losses = reader.losses()
    assert (losses.samples, losses.samples_lost, losses.samples_overrun, losses.converter_faults) == (
        8 * 13 + 104,
        0,
        0,
        0,
    )
    assert [report.name for report in reader.streams()] == ["adc", "mag"]


def test_a_heartbeat_of_version_1_0_is_whole():
    box = box_with()
    values = [9, 0, 3, 26, 1, 900, 4500, 151000, 31250, 1, 1]
    box.frame("heartbeat", 10**9, wire.HEARTBEAT, box.boot_id, box.device_us(10**9), *values)
    losses = read(box.messages)[1].losses()
    assert losses.frames_malformed == 0
    assert (
        losses.box["short_writes"],
        losses.box["overruns"],
        losses.box["crc_errors"],
        losses.box["missing_stops"],
    ) == (
        3,
        26,
        0,
        0,
    )


def test_runs_begun_joined_and_wrapped():
    box = Box(seq=5000)
    box.heartbeat(10**9, sent=2**30 - 50)
    box.heartbeat(2 * 10**9, sent=30)
    assert read(box.messages)[1].losses().box["sent"] == 80
    box = box_with(blocks=4)
    box.n0 = 0
    box.data(10 * BLOCK_NS, COUNTS)
    blocks, _ = read(box.messages)
    assert account(box.messages) == {"starts": 1}
    assert (blocks[-1].segment, blocks[-1].run, blocks[-1].gap) == (0, 1, True)
    box = box_with()
    ident = parse_ident(ident_document())
    messages = box.messages[data_places(box)[4] :]
    blocks, reader = read(messages, ident)
    assert reader.losses() == Losses(
        frames=len([m for m in messages if m.topic != "/sync"]), blocks=16, samples=16 * 13, sync_requests=1,
        box=reader.losses().box,
    )  # fmt: skip
    assert blocks[0].gap
    nothing = {"id": 1, "t0_ns": 5, "t1_us": None, "t2_us": None, "t3_ns": None}
    box = box_with()
    box.messages += [Message("/sync", 9, json.dumps(nothing).encode()), Message("/sync", 9, b"{")]
    assert account(box.messages) == {"sync_unanswered": 2}


def test_data_without_an_ident_or_with_a_wrong_one():
    box = box_with()
    messages = [m for m in box.messages if m.topic != "/box/ident"]
    blocks, reader = read(messages)
    assert blocks == []
    assert reader.losses().blocks_without_ident == 20
    assert reader.losses().frames_lost == 0
    box = Box()
    wrong = cbor2.dumps({**ident_document(), "streams": 5})
    for page, pages, data in wire.pages(wrong):
        box.frame("ident", 0, wire.IDENT, 0, page, pages, data)
    box.ident(1)
    box.data(10**7, COUNTS)
    blocks, reader = read(box.messages)
    assert reader.losses().frames_malformed == 1
    assert len(blocks) == 1


KINDS = st.sampled_from(["data", "data", "data", "heartbeat", "sync", "overrun", "reboot"])
FATES = st.sampled_from(["kept", "kept", "kept", "kept", "lost", "doubled", "broken"])


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(KINDS, FATES, st.integers(1, 40)), min_size=1, max_size=60), st.integers(0, 2**32 - 1))
def test_any_mixture_of_faults_is_counted_exactly(plan, seq):
    """A stream with known faults. Each boot ends with a block that arrives, so that every gap before it shows."""
    box = Box(seq=seq)
    box.ident(0)
    received = list(box.messages)
    expected = dict.fromkeys(
        ("frames_lost", "frames_malformed", "console_runs", "restarts", "samples_lost", "samples_overrun"), 0
    )
    missing = {"link": 0, "samples": 0, "frames": 0}
    t = 10**6

    def emit(kind, fate, skip):
        nonlocal t
        t += BLOCK_NS + skip * PERIOD_NS
        before = len(box.messages)
        skip = skip if kind == "overrun" else 0
        if kind in ("data", "overrun"):
            box.data(t, COUNTS, skip=skip)
        elif kind == "heartbeat":
            box.heartbeat(t)
        else:
            box.sync(t, 1e5, 1e5)
        new = box.messages[before:]
        is_data = kind in ("data", "overrun")
        missing["samples"] += skip
        if fate in ("lost", "broken"):
            missing["frames"] += 1
            missing["link"] += 1
            missing["samples"] += 13 * is_data
            if fate == "broken":
                expected["console_runs"] += 1
                received.append(new[0]._replace(topic="/box/console"))
            return
        received.extend(new)
        expected["frames_lost"] += missing["frames"]
        missing["frames"] = 0
        if fate == "doubled":
            expected["frames_malformed"] += 1
            received.append(new[0])
        if is_data:
            expected["samples_lost" if missing["link"] else "samples_overrun"] += missing["samples"]
            missing["link"] = missing["samples"] = 0

    emit("data", "kept", 1)
    for kind, fate, skip in plan:
        if kind != "reboot":
            emit(kind, fate, skip)
            continue
        emit("data", "kept", 1)
        box.reboot(t := t + 10**7)
        expected["restarts"] += 1
        before = len(box.messages)
        box.ident(t)
        received.extend(box.messages[before:])
        emit("data", "kept", 1)
    emit("data", "kept", 1)

    losses = asdict(read(received)[1].losses())
    assert {name: losses[name] for name in expected} == expected
    assert losses["starts"] == 0
