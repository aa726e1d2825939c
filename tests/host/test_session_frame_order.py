"""Late and duplicate frames count neither as lost nor as a restart; missing frames are counted exactly."""

import numpy as np
import pytest
from blocks_bench import BLOCK_NS, COUNTS, account, box_with, read
from hypothesis import given, settings
from hypothesis import strategies as st
from session_stream import Box

from truearm.session.losses import REACH

SECOND = 80  # frames of a box at 1 kHz


def long_box(frames, seq=0):
    """A box that streams for a while, with a heartbeat a second."""
    box = Box(seq=seq)
    box.ident(0)
    for k in range(frames):
        box.data((k + 1) * BLOCK_NS, COUNTS + k)
        if k % SECOND == SECOND - 1:
            box.heartbeat((k + 1) * BLOCK_NS + 10**6)
    return box


def order_of(blocks):
    return [block.data.n0 for block in blocks]


def test_thirty_one_exchanged_seconds_and_forty_six_doubled_frames_lose_nothing():
    """Pieces of a second each that arrive in the wrong order, and frames that arrive twice, some a second later."""
    rng = np.random.default_rng(13)
    frames = long_box(80 * SECOND).messages
    pieces = [frames[at : at + SECOND] for at in range(0, len(frames), SECOND)]
    for k in rng.choice(np.arange(1, len(pieces) // 2 - 1), 31, replace=False) * 2:
        pieces[k], pieces[k + 1] = pieces[k + 1], pieces[k]
    received = [message for piece in pieces for message in piece]
    for k in sorted(rng.choice(len(received) - SECOND, 46, replace=False), reverse=True):
        received.insert(k + int(rng.integers(1, SECOND)), received[k])
    assert account(received) == {"frames_duplicated": 46}
    blocks, reader = read(received)
    assert order_of(blocks) == list(range(0, 80 * SECOND * 13, 13))
    assert [block.gap for block in blocks] == [True] + [False] * (len(blocks) - 1)
    assert len(reader.segments) == 1


@settings(max_examples=60, deadline=None)
@given(st.data(), st.sampled_from([0, 700, 2**31 - 40, 2**32 - 90]))
def test_any_order_within_reach_is_the_order_of_sending(data, seq):
    """Every frame but the ident's is late by an arbitrary part of the reach."""
    messages = long_box(150, seq).messages
    head = next(k for k, m in enumerate(messages) if m.topic == "/box/adc") + 20
    late = data.draw(st.lists(st.integers(0, REACH // 2), min_size=len(messages) - head, max_size=len(messages) - head))
    places = np.arange(len(late)) + np.array(late)
    received = [*messages[:head], *(messages[head + k] for k in np.argsort(places, kind="stable"))]
    assert account(received) == {}
    assert order_of(read(received)[0]) == list(range(0, 150 * 13, 13))


@pytest.mark.parametrize("late", [1, REACH - 1, REACH + 1])
def test_a_frame_is_waited_for_as_long_as_said(late):
    messages = long_box(3 * REACH).messages
    moved = messages.pop(700)
    messages.insert(700 + late, moved)
    lost = {"frames_lost": 1, "loss_events": 1, "samples_lost": 13, "frames_late": 1}
    assert account(messages) == ({} if late <= REACH - 1 else lost)


def test_a_late_frame_at_the_end_is_no_restart():
    messages = long_box(3 * REACH).messages
    messages.append(messages.pop(700))
    assert account(messages) == {"frames_lost": 1, "loss_events": 1, "samples_lost": 13, "frames_late": 1}


@pytest.mark.parametrize("gone", [0, 3, 8, 70])
def test_a_restart_is_known_by_its_boot_id(gone):
    """However much of its beginning is lost; frames before the heartbeat that says it belong to the new count."""
    box = long_box(200)
    at = len(box.messages)
    box.reboot(300 * BLOCK_NS)
    box.ident(300 * BLOCK_NS)
    for k in range(300):
        box.data((301 + k) * BLOCK_NS, COUNTS - k - 1)
        if k % SECOND == SECOND - 1:
            box.heartbeat((301 + k) * BLOCK_NS + 10**6)
    del box.messages[at : at + gone]
    blocks, reader = read(box.messages)
    losses = reader.losses()
    assert (losses.restarts, losses.frames_lost, losses.frames_late) == (1, gone, 0)
    assert [segment.boot_id for segment in reader.segments] == [7, 8]
    sent = sum(m.topic == "/box/adc" for m in box.messages[at:])
    assert sum(block.segment for block in blocks) == sent


def test_without_a_boot_id_a_run_of_frames_is_a_restart():
    box = long_box(200)
    at = len(box.messages)
    box.reboot(300 * BLOCK_NS)
    box.ident(300 * BLOCK_NS)
    for k in range(100):
        box.data((301 + k) * BLOCK_NS, COUNTS - k - 1)
    pages = next(k for k, m in enumerate(box.messages[at:]) if m.topic == "/box/adc")
    del box.messages[at : at + pages]
    assert account(box.messages) == {"restarts": 1, "frames_lost": pages, "loss_events": 1}


def test_a_clock_exchange_beside_a_restart_is_of_the_boot_that_answered():
    box = box_with()
    box.reboot(2 * 10**9)
    box.data(2 * 10**9 + BLOCK_NS, COUNTS)  # its ident is lost
    box.sync(2 * 10**9 + 2 * BLOCK_NS, 1e5, 1e5)
    box.heartbeat(3 * 10**9)
    _, reader = read(box.messages)
    assert [len(segment.exchanges) for segment in reader.segments] == [1, 1]
