"""The firmware core in a real MicroPython (and in CPython), driven grant by grant."""

import itertools
import struct

import pytest

from tests.firmware.conftest import PERIOD_NS, Bench, flash_folder, ident_document, real_micropython
from tests.wire_frames import command, frames
from truearm_sim.box import STALL
from truearm_wire import cbor, frame

DATA, EVENT, HEARTBEAT, IDENT, SYNC, REPLY, ERROR = 16, 17, 18, 19, 33, 64, 65


def data_of(found):
    return [f for f in found if f[0] == DATA]


def counts_of(block):
    return struct.unpack("<%di" % (len(block[6].data) // 4), block[6].data)


def quads(values):
    return zip(*[iter(values)] * 4, strict=True)


def assert_contiguous(blocks, start=0):
    """Check that every sample is there once, in order, with the counts of `records`; return their number."""
    n = start
    for block in blocks:
        assert block[3] == n
        for i, (a, b, c, d) in enumerate(quads(counts_of(block))):
            k = (n + i) % 2**23
            assert (a, b, c, d) == (k, -k, 2**23 - 1, -(2**23))
        n += len(counts_of(block)) // 4
    return n


def test_boot_sends_ident_and_heartbeat(bench):
    document = ident_document(bench.boot)
    assert document["protocol"] == [1, 4]
    assert document["boot_id"] == 0xDEADBEEF
    assert document["uid"] == bytes.fromhex("e6614103e7452b2f")
    stream = document["streams"][0]
    assert (stream["osr"], stream["period_ns"]) == (4096, PERIOD_NS)
    assert [c["name"] for c in stream["channels"]] == ["lvdt", "transverse_a", "transverse_b", "excitation"]
    assert [f[1] for f in bench.boot] == list(range(len(bench.boot))), "seq counts every frame from 0"
    assert [f[0] for f in bench.boot].count(HEARTBEAT) == 1


def test_time_passes_the_wraps_of_30_and_32_bits(chip):
    chip.start()
    chip.sample(20)
    for far in (2**30, 2**32, 3 * 2**32, 2**40):
        chip.now_us = far - 30000
        chip.give(us=0, rx=command(51, 2 + far.bit_length()))
        chip.give(us=0, rx=command(50, 100 + far.bit_length()))
        chip.t_start_us, chip.index = far - 30000, 0
        blocks = data_of([f for _ in range(6) for f in chip.sample(13)])
        assert [b[4] for b in blocks] == [far - 30000 + 13 * k * PERIOD_NS // 1000 for k in range(6)]
        assert blocks[-1][4] > far > blocks[0][4]


def test_the_longest_answers_on_a_link_that_is_never_idle(tmp_path):
    """A configuration of all its pages and a traceback of full length: the most that telling of them takes of the heap."""
    channels = [{**GOOD, "note": "x" * 690}] * 4
    flash = flash_folder(tmp_path, {"osr": 1024, "channels": channels})
    (flash / "last_error.txt").write_text("y" * 600)
    box = Bench(real_micropython(), flash)
    document = ident_document(box.boot)
    assert (document["streams"][0]["channels"], document["last_error"]) == (channels, "y" * 600)
    box.start()
    tx = b""
    for i in range(4000):
        rx = command(48, 10 + i) if box.answer.rx_room > 500 else b""
        box.sample(13, rx=rx, tx_room=240)
        tx += box.answer.tx
    answered = [f for f in frames(tx[: tx.rindex(0) + 1]) if isinstance(f, list) and f[0] == IDENT]
    assert len(answered) > 300
    assert not box.answer.reset
    box.box.close()


def test_an_edge_that_waits_keeps_its_time(chip):
    """The host is away for two hours; the edge's 32-bit stamp wraps meanwhile."""
    chip.give(us=1000)
    chip.give(us=5000, edges=struct.pack(">BBI", 0, 1, 5500), tx_room=0)
    chip.now_us += 7_200_000_000
    found = chip.give() + chip.give()
    (event,) = [f for f in found if f[0] == EVENT]
    assert event[2:] == [0, 5500, 1]


def test_edges_beyond_the_room_are_counted(bench):
    edges = b"".join(struct.pack(">BBI", 0, i & 1, i) for i in range(20))
    for _ in range(3):
        bench.give(tx_room=0, edges=edges)
    found = [f for _ in range(4) for f in bench.give()]
    events = [f for f in found if f[0] == EVENT]
    assert [f[3] for f in events] == [i % 20 for i in range(33)], "32 wait and one was on its way"
    (beat,) = [f for f in bench.give(us=2_000_000) if f[0] == HEARTBEAT]
    assert beat[5] == 60 - 33


def test_requests_wait_while_the_link_is_held_back(bench):
    bench.start()
    for i in range(5):
        bench.sample(13, tx_room=0, rx=command(32, i))
    found = [f for _ in range(3) for f in bench.give(us=10)]
    assert [f[2] for f in found if f[0] == SYNC] == [0, 1, 2, 3, 4]


def test_start_waits_for_the_samples_of_the_last_one(bench):
    """A stop whose samples still wait: a start is refused, nothing is lost, each command has its own answer."""
    bench.start()
    for _ in range(20):
        bench.sample(13, tx_room=0)
    tx = b""
    for rx in (command(51, 3), command(50, 4), command(48, 5)):
        bench.give(us=10, rx=rx, tx_room=300)
        tx += bench.answer.tx
    for _ in range(30):
        bench.give(us=10, tx_room=300)
        tx += bench.answer.tx
    found = frames(tx)
    assert assert_contiguous(data_of(found)) == 260
    assert [(f[0], f[2]) for f in found if f[0] in (REPLY, ERROR)] == [(ERROR, 4), (REPLY, 3)]
    assert {f[2] for f in found if f[0] == IDENT} == {5}
    assert bench.give(rx=command(50, 6))[0][0] == REPLY


def test_a_command_is_executed_once(bench):
    bench.start()
    bench.sample(26)
    again = bench.give(rx=command(50, 2))
    assert again[0][:1] == [REPLY]
    assert again[0][2] == 2
    assert data_of(bench.sample(13))[0][3] == 26, "the repeated start did not begin again"


@pytest.mark.parametrize(
    "payload",
    [
        bytes([0x82, 0x18, 0x20, 0x05]),
        bytes([0x82, 0x18, 0x20, 0x19, 0, 5]),  # not the shortest form
        bytes([0x82, 0x18, 0x20, 0x1B, 0, 0, 0, 0, 0, 0, 0, 5]),
        bytes([0x82, 0x19, 0, 0x20, 0x05]),
        cbor.encode([32, 5, 1, 2]),  # of a newer minor version
    ],
)
def test_sync_requests_of_any_form_are_answered(bench, payload):
    (reply,) = bench.give(rx=frame.frame(payload))
    assert reply[0] == SYNC
    assert reply[2] == 5


def test_stalled_firmware_loses_what_lapped_the_board(bench):
    bench.start()
    first = data_of(bench.sample(13))
    for _ in range(6):
        bench.sample(100, flags=STALL)
    found = bench.sample(13)
    (jump,) = [(a[3] + 13, b[3]) for a, b in itertools.pairwise(first + data_of(found)) if a[3] + 13 != b[3]]
    assert jump[1] - jump[0] == 500, "five hundred were in the board when the sixth hundred lapped them"
    beat = [f for f in bench.give(us=2_000_000) if f[0] == HEARTBEAT][-1]
    assert beat[7] == 500


GOOD = {"name": "lvdt", "unit": "V", "scale": [1, -7]}


@pytest.mark.parametrize(
    ("config", "fault"),
    [
        ({"osr": 4096.0, "channels": [GOOD] * 4}, "osr: must be one of"),
        ([], "it is not a table"),
        ({"osr": 1024, "channels": [{**GOOD, "scale": 1.43e-7}] * 4}, "mantissa, exponent"),
        ({"osr": 1024, "channels": [{**GOOD, "scale": [1.5, -7]}] * 4}, "mantissa, exponent"),
        ({"osr": 1024, "channels": [{**GOOD, "calibration": None}] * 4}, "calibration: must be a table"),
        (
            {"osr": 1024, "channels": [{**GOOD, "calibration": {"unit": "m", "poly": ["x"]}}] * 4},
            "lvdt: calibration: poly: must be",
        ),
        ({"osr": 1024, "channels": [{**GOOD, "note": "x" * 3000}] * 4}, "longer than"),
        ({"osr": 1024, "channels": [{**GOOD, "note": "x" * 760}] * 4}, "it has 17 pages, at most 16 fit"),
        ({"osr": 1024, "channels": [{**GOOD, "note": 1.5}] * 4}, "not on this wire"),
    ],
)
def test_damaged_configuration_is_reported_and_the_box_still_boots(config, fault):
    box = Bench(real_micropython(), config=config)
    document = ident_document(box.boot)
    assert document["fault"].startswith("config: ")
    assert fault in document["fault"]
    assert document["streams"][0]["osr"] == 4096
    box.box.close()
