"""The accounting on random streams: mixtures of faults, arbitrary bytes and elements."""

from dataclasses import asdict

import cbor2
from blocks_bench import BLOCK_NS, COUNTS, read
from hypothesis import given, settings
from hypothesis import strategies as st
from session_stream import PERIOD_NS, Box, ident_document

from truearm.session.box_ident import parse_ident
from truearm.types import Message

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


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=260), max_size=20))
def test_arbitrary_bytes_are_counted_as_malformed(payloads):
    messages = [Message(topic, 0, payload) for payload in payloads for topic in ("/box/adc", "/sync")]
    _, reader = read(messages, parse_ident(ident_document()))
    losses = reader.losses()
    assert losses.frames + losses.frames_malformed >= len(payloads)


ELEMENT = st.one_of(
    st.integers(-(2**64), 2**64 - 1), st.binary(max_size=12), st.text(max_size=4), st.none(), st.booleans(),
    st.builds(cbor2.CBORTag, st.sampled_from([69, 78, 1000]), st.binary(max_size=24)),
)  # fmt: skip


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from([16, 17, 18, 19, 33, 64, 65, 99]), st.lists(ELEMENT, max_size=14)), max_size=8)
)
def test_frames_of_wrong_elements_end_nowhere_but_in_the_account(frames):
    payloads = [cbor2.dumps([kind, seq, *elements]) for seq, (kind, elements) in enumerate(frames)]
    _, reader = read([Message("/box/other", 0, payload) for payload in payloads], parse_ident(ident_document()))
    assert reader.losses().blocks + reader.losses().frames_malformed <= 2 * len(frames)
