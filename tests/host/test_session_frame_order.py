"""Late and duplicate frames count neither as lost nor as a restart; missing frames are counted exactly."""

import cbor2
import numpy as np
import pytest
from blocks_bench import BLOCK_NS, COUNTS, account, box_with, read
from hypothesis import given, settings
from hypothesis import strategies as st
from session_stream import Box

from truearm.session.frame_order import REACH
from truearm.session.losses import Silences
from truearm.session.message_columns import columns_of
from truearm.types import Message
from truearm_wire import messages as wire
from truearm_wire.cbor import Tag

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


def sequence(message):
    return cbor2.loads(message.data)[1]


def renumbered(payload, by):
    """Return a frame with a seq that is larger by this number."""
    kind, seq, *rest = cbor2.loads(payload)
    rest = [Tag(value.tag, value.value) if isinstance(value, cbor2.CBORTag) else value for value in rest]
    return bytes(wire.encode_payload([kind, seq + by, *rest]))


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


def test_without_a_heartbeat_a_run_of_frames_is_a_restart():
    """The box sends a heartbeat every second. Only if all of them are lost does the number of frames decide."""
    box = long_box(1200)
    at = len(box.messages)
    box.reboot(1300 * BLOCK_NS)
    box.ident(1300 * BLOCK_NS)
    for k in range(2 * REACH):
        box.data((1301 + k) * BLOCK_NS, COUNTS - k - 1)
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


def restarted(before, after, down_s=2.0):
    """A box that streams, is without power for a while and streams again; and the place of its second boot."""
    box = long_box(before)
    at = len(box.messages)
    boot_ns = int((before + 1) * BLOCK_NS + 1e9 * down_s)
    box.reboot(boot_ns)
    box.ident(boot_ns)
    for k in range(after):
        box.data(boot_ns + (k + 1) * BLOCK_NS + 7_000, COUNTS - k - 1)
        if k % SECOND == SECOND - 1:
            box.heartbeat(boot_ns + (k + 1) * BLOCK_NS + 10**6)
    return box.messages, at


def restarts_and(messages):
    """Return the number of segments, and the account without what a missing frame costs in samples."""
    found = account(messages)
    return len(read(messages)[1].segments), {k: n for k, n in found.items() if k not in ("samples_lost", "loss_events")}


def test_the_first_page_of_a_boot_that_arrives_twice_is_no_restart():
    """However much later: its bytes are kept as long as the session lasts."""
    messages = long_box(5 * REACH).messages
    messages.insert(4 * REACH, messages[0])
    assert account(messages) == {"frames_duplicated": 1}


@pytest.mark.parametrize("n", [1, SECOND, 5 * SECOND])
def test_a_piece_that_arrives_twice_is_no_restart(n):
    """Much later than bytes are remembered, and longer than a run of suspects without a boot id."""
    messages = long_box(40 * SECOND).messages
    messages[30 * SECOND : 30 * SECOND] = messages[SECOND : SECOND + n]
    assert account(messages) == {"frames_duplicated": n}


@pytest.mark.parametrize("n", [1, SECOND, 5 * SECOND])
def test_a_piece_that_arrives_much_too_late_is_no_restart(n):
    messages = long_box(40 * SECOND).messages
    piece = messages[SECOND : SECOND + n]
    del messages[SECOND : SECOND + n]
    messages[30 * SECOND : 30 * SECOND] = piece
    assert restarts_and(messages) == (1, {"frames_lost": n, "frames_late": n})


def test_the_first_page_of_a_boot_that_arrives_late_is_no_restart():
    """The heartbeats before it have stated the boot id that it contains."""
    messages, at = restarted(2000, 1000)
    page = messages.pop(at)
    messages.insert(at + 3 * SECOND, page)
    assert restarts_and(messages) == (2, {"restarts": 1})
    messages.insert(at + 10 * SECOND, messages.pop(messages.index(page)))
    assert restarts_and(messages) == (2, {"restarts": 1, "frames_lost": 1, "frames_late": 1})


@pytest.mark.parametrize("held_up_s", [0, 30])
def test_a_piece_of_an_earlier_boot_is_no_restart(held_up_s):
    """It has heartbeats; a boot id that the session has left does not come back."""
    messages, at = restarted(3000, 3000)
    piece = [m._replace(t_host_ns=m.t_host_ns + held_up_s * 10**9) for m in messages[10 * SECOND : 15 * SECOND]]
    del messages[10 * SECOND : 15 * SECOND]
    messages[at + 10 * SECOND : at + 10 * SECOND] = piece
    assert restarts_and(messages) == (2, {"restarts": 1, "frames_lost": 5 * SECOND, "frames_late": 5 * SECOND})


def test_frames_of_a_new_boot_that_fit_behind_the_old_ones_belong_to_the_new_boot():
    """The first of them are behind the old count, the others continue it: in number, and nearly in time."""
    messages, at = restarted(60, 300, down_s=0.001)
    first = len(long_box(60).messages) - 20
    del messages[at : at + first]
    assert restarts_and(messages) == (2, {"restarts": 1, "frames_lost": first})


def test_a_hole_too_large_for_the_link_is_a_hole_if_the_boot_id_says_so():
    """A host that sleeps does not see the time in which the link lost the frames."""
    messages = long_box(200 * SECOND).messages
    at, gone = 20 * SECOND, 150 * SECOND
    asleep_ns = messages[at + gone].t_host_ns - messages[at].t_host_ns
    received = [*messages[:at], *(m._replace(t_host_ns=m.t_host_ns - asleep_ns) for m in messages[at + gone :])]
    assert restarts_and(received) == (1, {"frames_lost": gone})


@pytest.mark.parametrize("n", [1, 2, 3, 60])
def test_pieces_exchanged_around_a_restart_are_one_restart(n):
    """What the box sent before the restart and arrives after it is late, not the beginning of yet another count."""
    messages, at = restarted(3000, 1000)
    messages[at - n : at + n] = [*messages[at : at + n], *messages[at - n : at]]
    segments, found = restarts_and(messages)
    assert (segments, found) == (2, {"restarts": 1, "frames_late": n})


@pytest.mark.parametrize("before", [SECOND, 2 * SECOND])
@pytest.mark.parametrize("later", [1, 20, 40])
def test_a_piece_of_a_short_boot_that_arrives_after_a_restart_is_no_second_restart(before, later):
    """Device times do not tell such boots apart, but the piece has a heartbeat."""
    messages, at = restarted(before, 1000, down_s=0.2)
    piece = messages[at - 40 : at]
    assert any(message.topic == "/box/heartbeat" for message in piece)
    messages[at - 40 : at + later] = [*messages[at : at + later], *piece]
    segments, found = restarts_and(messages)
    assert (segments, found["restarts"], found.get("frames_lost", 0)) == (2, 1, 0)


def test_an_event_in_a_late_piece_of_an_earlier_boot_is_late():
    """It has no device time that orders it; without the frames before it, it would follow a hole in the new boot."""
    messages, at = restarted(400, 1000, down_s=3.0)
    place = at - 50
    event = wire.encode_payload([wire.EVENT, sequence(messages[place - 1]) + 1, 0, 10**6, 1])
    messages[place:at] = [
        messages[place - 1]._replace(topic="/box/event", data=bytes(event)),
        *(message._replace(data=renumbered(message.data, 1)) for message in messages[place:at]),
    ]
    piece = messages[place - 10 : place + 10]
    del messages[place - 10 : place + 10]
    messages[at - 18 : at - 18] = piece
    assert restarts_and(messages) == (2, {"restarts": 1, "frames_lost": 20, "frames_late": 20})


@pytest.mark.parametrize("lost", [0, 1])
def test_a_boot_whose_first_page_waits_for_the_link_longer_than_the_boot_before_lasted(lost):
    """A bridge that takes longer to start than the box: the first page comes out with the link, long after the boot."""
    box = long_box(400)
    boot_ns = 401 * BLOCK_NS
    box.reboot(boot_ns)
    link_ns = boot_ns + 10**10
    box.ident(link_ns)
    box.seq += lost
    for k in range(600):
        box.data(link_ns + k * BLOCK_NS, COUNTS + k)
        if k % SECOND == SECOND - 1:
            box.heartbeat(link_ns + k * BLOCK_NS + 10**6)
    assert restarts_and(box.messages) == (2, {"restarts": 1} | ({"frames_lost": lost} if lost else {}))


def test_a_frame_of_an_earlier_boot_that_arrives_twice_is_doubled_not_late():
    messages, at = restarted(400, 1000)
    messages.insert(at + 700, messages[at - 50])
    assert restarts_and(messages) == (2, {"restarts": 1, "frames_duplicated": 1})


def test_the_last_frames_before_a_restart_that_arrive_twice_are_doubled():
    messages, at = restarted(3000, 1000)
    messages[at + 5 : at + 5] = messages[at - 2 : at]
    assert restarts_and(messages) == (2, {"restarts": 1, "frames_duplicated": 2})


@pytest.mark.parametrize(("before", "gone", "down_s"), [(90, 120, 2.5), (90, 120, 60.0), (200, 300, 5.0)])
def test_a_hole_over_a_restart_is_charged_to_the_new_boot_alone(before, gone, down_s):
    """The first frames received of the new boot have higher numbers than the last of the old one, and later times."""
    messages, at = restarted(before, 1000, down_s)
    del messages[at : at + gone]
    assert restarts_and(messages) == (2, {"restarts": 1, "frames_lost": gone})


@pytest.mark.parametrize("seconds", [3, 40])
def test_frames_that_a_link_held_up_are_of_the_same_boot(seconds):
    """Some were lost when the link's buffer was full; the others arrive all at once."""
    messages = long_box(40 * SECOND).messages
    at = 10 * SECOND
    held = [m._replace(t_host_ns=m.t_host_ns + seconds * 10**9) for m in messages[at + 20 :]]
    received = [*messages[:at], *held]
    assert restarts_and(received) == (1, {"frames_lost": 20})


def times_of_silence(times, batch, events=()):
    silences, rows = Silences(), [Message("/box/adc", t, b"") for t in times]
    rows += [Message("/events", t, b'{"kind":"link-lost"}') for t in events]
    for at in range(0, len(rows), batch):
        silences.take(columns_of(rows[at : at + batch]))
    return silences.finish()


@pytest.mark.parametrize("batch", [1, 3, 1000])
def test_pieces_in_another_order_are_no_silence(batch):
    times = [k * 10**8 for k in range(400)]
    swapped = [*times[:100], *times[150:200], *times[100:150], *times[200:]]
    assert times_of_silence(swapped, batch) == []
    cut = [t for t in swapped if not 20.05e9 < t < 25.95e9]
    assert times_of_silence(cut, batch) == [(20_000_000_000, 26_000_000_000)]
    # 10 to 20 s arrive last; of them 13 to 16 s are missing
    late = [*times[:100], *times[200:], *(t for t in times[100:200] if not 13.05e9 < t < 15.95e9)]
    assert times_of_silence(late, batch) == [(13_000_000_000, 16_000_000_000)]
