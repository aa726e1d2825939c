"""Two sources in one ring, the box's output and inputs, and a host that is gone, grant by grant."""

import struct
import subprocess
from pathlib import Path

import pytest

from tests.firmware.conftest import PERIOD_NS, Bench, ident_document, real_micropython
from tests.wire_frames import command, frames
from truearm.session.frames import RESERVED_NAMES
from truearm_sim.box import FAULT_CRC, STALL, BoxProcess, BoxSetup, Grant, write_flash
from truearm_wire import messages
from truearm_wire.messages import DATA, ERROR, EVENT, HEARTBEAT, REPLY

ROOT = Path(__file__).parents[2]
LED = {"idle": 0, "streaming": 1, "host gone": 2, "fault": 3}


def blocks(found, stream):
    return [f for f in found if f[0] == DATA and f[2] == stream]


def values(block):
    return struct.unpack("<%di" % (len(block[6].data) // 4), block[6].data)


def beat(bench):
    """Return the counters of the next heartbeat by name."""
    found = [f for f in bench.give(us=2_000_000) if f[0] == HEARTBEAT][-1]
    return dict(zip(messages.names(HEARTBEAT), found[1:], strict=True))


def test_nothing_is_allocated_while_both_stream(chip):
    """As with one source: blocks of both, missing stops, damaged converter frames, edges, syncs, short writes, a stall, a host gone."""
    chip.start()
    missing = frozenset(range(0, 40000, 17))
    free, count, tx = [], 0, b""
    for i in range(2000):
        edges = struct.pack(">BBI", i % 3, i & 1, chip.now_us % 2**32) if i % 40 == 0 else b""
        rx = command(32, i) if i % 20 == 0 else b""
        room = {3: 0, 4: 100}.get(i // 250, 0xFFFF)
        flags = STALL if 1500 <= i < 1550 else 0
        chip.sample(
            13,
            both=True,
            missing=missing,
            rx=rx,
            edges=edges,
            tx_room=room,
            flags=flags,
            fault=FAULT_CRC * (i % 90 == 0),
        )
        tx += chip.answer.tx
    for f in frames(tx):
        count += f[0] == DATA
        if f[0] == HEARTBEAT:
            free.append(f[11])
    assert count > 1500
    assert len(free) >= 16
    assert set(free[1:]) == {free[1]}, "heap_free moved while streaming"
    assert free[1] > 80_000


def test_times_outside_of_blanking_and_time_out_are_no_stops(bench):
    config = bench.document(messages.GET_CONFIG)
    config["magnetostrictive"].update(blanking_ns=20_000, timeout_ns=200_000)
    bench.put(config)
    bench.start()
    edge = [2499, 2500, 25_000, 25_001]
    mag = struct.pack(">4I", *range(4)) + struct.pack("<4i", *edge)
    bench.give(mag=mag, mag_index=0)
    found = bench.give(rx=command(51, 3))
    assert values(blocks(found, 1)[0]) == (0, 2500, 25_000, 0)


def test_a_stream_that_is_off_is_not_described_and_not_started(bench):
    assert [s["id"] for s in ident_document(bench.boot)["streams"]] == [0, 1]
    assert bench.give(rx=command(49, 5, 1, 0))[0][0] == REPLY
    assert [s["id"] for s in ident_document(bench.give(rx=command(48, 6)))["streams"]] == [0]
    bench.start()
    assert (bench.answer.sampling, bench.answer.mag_sampling) == (True, False)


def test_the_streams_have_rates_of_their_own(bench):
    assert bench.give(rx=command(49, 5, 1, 2_000_000))[0][0] == REPLY
    bench.start()
    assert (bench.answer.osr, bench.answer.mag_period_ns) == (4096, 2_000_000)
    bench.sample(13, both=True)
    found = bench.give(rx=command(51, 7))
    assert [f[5] for f in blocks(found, 1)] == [2_000_000]


def test_a_pulse_is_an_edge_of_line_2_also_while_streaming(bench):
    bench.start()
    found = []
    for level in (1, 1, 0):
        found += bench.command(messages.PULSE, level)
        assert bench.answer.output == bool(level)
    events = [f for f in found if f[0] == EVENT]
    assert [(f[2], f[4]) for f in events] == [(2, 1), (2, 0)], "an edge is a change"
    assert sum(f[0] == REPLY for f in found) == 3
    assert events[0][3] == bench.now_us - 2000


def test_debouncing_keeps_the_first_edge_of_a_bounce(bench):
    config = bench.document(messages.GET_CONFIG)
    config["debounce_us"] = [500, 0]
    bench.put(config)
    times = [0, 100, 499, 900, 1000, 1399, 1500]
    edges = b"".join(struct.pack(">BBI", line, i & 1, bench.now_us + t) for line in (0, 1) for i, t in enumerate(times))
    start = bench.now_us
    found = bench.give(us=5000, edges=edges)
    kept = [[f[3] - start for f in found if f[0] == EVENT and f[2] == line] for line in (0, 1)]
    assert kept == [[0, 900, 1500], times]


def test_edges_that_nobody_had_room_for_are_counted(bench):
    """Line 0 rings while the firmware stands still: the board keeps 64, the box 32 of them."""
    given = 0
    for _ in range(3):
        edges = b"".join(struct.pack(">BBI", 0, i & 1, (bench.now_us + i) % 2**32) for i in range(32))
        bench.give(us=1000, edges=edges, flags=STALL)
        given += 32
    found = bench.give(us=1000)
    kept = sum(f[0] == EVENT for f in found)
    assert 32 <= kept <= 64
    assert beat(bench)["dropped"] == given - kept


def test_a_minute_without_a_host(chip):
    """The box keeps time, counts what it drops, shows it on its LED, and resumes: a jump of n0 of both streams, none of seq."""
    chip.put(chip.document(messages.GET_CONFIG) | {"trigger_ms": [0, 0]})  # all edges are the test's own
    chip.start()
    found = chip.sample(52, both=True)
    assert chip.answer.led == LED["streaming"]
    n_away = int(60e9 / PERIOD_NS / 52)
    for i in range(n_away):
        edges = struct.pack(">BBI", 1, i & 1, chip.now_us % 2**32) if i % 100 == 0 else b""
        chip.sample(52, both=True, tx_room=0, edges=edges)
    assert chip.now_us > 60_000_000
    assert chip.answer.led == LED["host gone"]
    tx = b""
    for _ in range(8):
        chip.give(us=10)
        tx += chip.answer.tx
    assert chip.answer.led == LED["streaming"]
    chip.sample(52, both=True)
    tx += chip.answer.tx
    found += frames(tx) + chip.give(rx=command(32, 77)) + chip.give(rx=command(51, 78))
    seqs = [f[1] for f in found]
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))
    lost = 0
    for stream, channels in ((0, 4), (1, 1)):
        mine = blocks(found, stream)
        ends = [f[3] + len(values(f)) // channels for f in mine]
        gaps = [b[3] - end for end, b in zip(ends, mine[1:], strict=False)]
        assert [f[7] == messages.FLAG_OVERRUN for f in mine[1:]] == [gap != 0 for gap in gaps]
        jumps = [gap for gap in gaps if gap]
        assert len(jumps) == 1
        lost += jumps[0]
        assert ends[-1] == (n_away + 2) * 52
        for f in mine:
            assert f[4] == chip.t_start_us + f[3] * PERIOD_NS // 1000
    (sync,) = [f for f in found if f[0] == messages.SYNC_REPLY]
    assert sync[3] == chip.now_us - 1000
    events = [f for f in found if f[0] == EVENT]
    after = beat(chip)
    assert after["overruns"] == lost > 80_000
    assert after["dropped"] + len(events) == -(-n_away // 100)


def test_the_ring_holds_two_seconds_of_both_streams(chip):
    chip.start()
    n = int(2e9 / PERIOD_NS / 13)
    for _ in range(n):
        chip.sample(13, both=True, tx_room=0)
    for _ in range(6):
        chip.give(us=10)
    assert beat(chip)["overruns"] == 0


def test_a_start_that_follows_a_stop_at_once_counts_from_zero(bench):
    bench.start()
    starts = bench.answer.starts
    bench.give(rx=command(51, 3) + command(50, 4))
    assert bench.answer.starts == starts + 1
    bench.t_start_us, bench.index = bench.now_us, 0
    found = bench.sample(52, both=True)
    assert [f[3] for f in blocks(found, 0)] == [0, 13, 26, 39]
    assert [f[3] for f in blocks(found, 1)] == [0]


def test_the_led_says_what_the_box_does(bench):
    bench.give()
    assert bench.answer.led == LED["idle"]
    bench.start()
    bench.sample(13, both=True)
    assert bench.answer.led == LED["streaming"]
    bench.give(us=1_000_000, tx_room=0)
    bench.give(us=1_000_000, tx_room=0)
    assert bench.answer.led == LED["streaming"], "a second is not an absence"
    bench.give(us=2_000_001, tx_room=0)
    assert bench.answer.led == LED["host gone"]
    bench.give()
    assert bench.answer.led == LED["streaming"]
    box = Bench(real_micropython(), self_test={"rail_5v": 3000})
    box.give()
    assert box.answer.led == LED["fault"]
    box.box.close()


def test_the_watchdog_is_fed_by_the_loop_and_not_in_a_stall(bench):
    bench.give()
    assert (bench.answer.alive, bench.answer.watchdog_ms) == (True, 2000)
    bench.give(flags=STALL)
    assert not bench.answer.alive
    bench.give()
    assert bench.answer.alive


def test_a_stop_with_a_full_ring_loses_nothing_more(bench):
    """The ring filled while the host was gone. What the sources still hold at the stop waits for space; it was lost, and no jump told of it."""
    bench.start()
    for _ in range(200):
        bench.sample(13, both=True, tx_room=0)
    tx = bench.answer.tx
    bench.sample(70, both=True, rx=command(51, 3), tx_room=300)
    tx += bench.answer.tx
    for k in range(60):
        found = bench.give(us=10, rx=command(52, 4) if k == 0 else b"", tx_room=1500)
        tx += bench.answer.tx
    assert found == []
    found = frames(tx)
    lost = 0
    for stream, channels in ((0, 4), (1, 1)):
        ends = [0] + [f[3] + len(values(f)) // channels for f in blocks(found, stream)]
        assert ends[-1] == bench.index
        lost += sum(f[3] - end for f, end in zip(blocks(found, stream), ends[:-1], strict=True))
    assert [f[:1] + f[2:4] for f in found if f[0] in (ERROR, REPLY)][0] == [ERROR, 4, messages.ERROR_STREAMING]
    assert beat(bench)["overruns"] == lost


TILT = {"name": "tilt", "period_ns": 20_000_000, "channels": [{"name": c, "unit": "V", "scale": [1, 0]} for c in "ab"]}


def polled(bench, k, periods=1):
    """Let periods of 20 ms pass, then read (k, −k)."""
    return blocks(bench.give(us=20_000 * periods, readings=struct.pack("<2i", k, -k)), messages.STREAM_SENSOR)


def test_a_polled_sensor_has_a_stream_that_shows_every_gap():
    bench = Bench(real_micropython(), sensors=[TILT])
    described = ident_document(bench.boot)["streams"][2]
    assert {key: described[key] for key in TILT} | {"id": 2} == TILT | {"id": described["id"]}
    bench.start()
    start_us, found = bench.now_us, []
    for k in range(1, 531):
        found += polled(bench, k, 4 if k in (40, 41) else 1)
    assert bench.answer.wake_us == 20_000
    found += blocks(bench.give(rx=command(51, 3)), messages.STREAM_SENSOR)
    read, lost, last = {}, 0, 0
    for f in found:
        assert f[7] == (messages.FLAG_OVERRUN if f[3] > last else 0)
        lost, last = lost + f[3] - last, f[3] + len(f[6].data) // 8
        assert f[4] == start_us + (f[3] + 1) * 20_000
        for i, k in enumerate(values(f)[::2]):
            read[f[3] + i] = k
            assert values(f)[2 * i + 1] == -k
    assert last == 536
    assert lost == beat(bench)["overruns"]
    # the fourth period of a gap is read if nothing waited before it
    assert sorted(read) == [i for i in range(536) if not 39 <= i <= 45]
    bench.box.close()


# Readings that begin with this byte: the sensor answers wrong, or not at all.
SILENT, ABSENT = 200, 100
READ = f"if out[0] == {ABSENT}: raise OSError(5)\n        return out[0] != {SILENT}"


def driven(path):
    """Return a streaming box whose sensor does not always answer."""
    flash = path / "box"
    write_flash(flash, None)
    code = (flash / "sensors.py").read_text()
    (flash / "sensors.py").write_text(code.replace("return True", READ))
    bench = Bench(real_micropython(), sensors=[TILT], flash=flash)
    bench.start()
    return bench


def test_what_a_polled_sensor_does_not_answer_is_lost_and_nothing_else(tmp_path):
    bench = driven(tmp_path)
    found = [f for k in range(1000) for f in polled(bench, k)]
    found += blocks(bench.give(rx=command(51, 3)), messages.STREAM_SENSOR)
    bench.give()
    read, last = [], 0
    for f in found:
        assert f[7] == (messages.FLAG_OVERRUN if f[3] > last else 0)
        n = len(f[6].data) // 8
        assert values(f)[::2] == tuple(range(f[3], f[3] + n))
        assert f[4] == bench.t_start_us + (f[3] + 1) * 20_000
        read, last = [*read, *range(f[3], f[3] + n)], f[3] + n
    assert read == [k for k in range(1000) if k % 256 not in (SILENT, ABSENT)]
    assert beat(bench)["overruns"] == 1000 - len(read)
    bench.box.close()


def test_a_polled_sensor_that_never_answers_is_counted(tmp_path):
    bench = driven(tmp_path)
    for _ in range(100):
        assert polled(bench, SILENT) == []
    assert beat(bench)["overruns"] == 100
    bench.box.close()


def test_a_polled_sensor_that_is_unplugged_takes_no_memory(tmp_path):
    bench = driven(tmp_path)
    tx = b""
    for _ in range(5000):
        bench.give(us=20_000, readings=bytes([ABSENT, 0, 0, 0]) * 2)
        tx += bench.answer.tx
    free = [f[11] for f in frames(tx) if f[0] == HEARTBEAT]
    assert len(free) >= 99
    assert min(free) > free[0] - 16_000
    assert polled(bench, 7) == []
    (block,) = blocks(bench.give(rx=command(51, 3)), messages.STREAM_SENSOR)
    assert (values(block), block[7]) == ((7, -7), messages.FLAG_OVERRUN)
    bench.box.close()


POLL = """
import micropython
from truearm_box.polled import Polled

class Board:
    us = 0
    def ticks(self):
        return self.us
    def ticks_diff(self, a, b):
        return a - b
    def now(self, buf):
        pass

class Sensor:
    stream = {"name": "tilt", "period_ns": 20000000, "channels": ["a", "b"]}
    def read(self, out):
        return True

board, dst, index, stamp, taken = Board(), bytearray(208), bytearray(8), bytearray(4), 0
source = Polled(board, Sensor(), 208)
source.start(0)
for k in range(100):
    board.us += 20000
    before = micropython.mem_total()
    if source.take(25, dst, 0, index, stamp):
        taken += 25
    source.broken()
    source.lost()
    after = micropython.mem_total()
    if k > 1 and after > before:
        print(k, after - before)
print(taken)
"""


def test_polling_allocates_nothing_not_even_a_frame_of_a_function():
    env = {"MICROPYPATH": ":".join(str(ROOT / name) for name in ("firmware", "protocol"))}
    done = subprocess.run([real_micropython().path, "-c", POLL], env=env, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("100\n", "")


@pytest.mark.parametrize(
    ("wrong", "words"),
    [({"name": name}, "the name is taken") for name in ("adc", "mag", *sorted(RESERVED_NAMES))]
    + [({"channels": TILT["channels"][:1] * n}, "1 to 52 channels") for n in (0, 53)]
    + [({"period_ns": n}, "its period is not") for n in (500, 999_000, 20_000_500, 4_000_001_000)],
)
def test_a_polled_sensor_with_a_wrong_stream_is_refused_at_boot(wrong, words):
    box = BoxProcess(real_micropython(), BoxSetup(sensors=[TILT | wrong]), 1)
    answer = box.grant(Grant(0))
    assert answer.end == "reset"
    assert words.encode() in answer.tx
    box.close()


@pytest.mark.parametrize(("period_ms", "block"), [(1000, 1), (100, 5)])
def test_a_slow_sensor_is_heard_about_twice_a_second_or_at_once(period_ms, block):
    bench = Bench(real_micropython(), sensors=[TILT | {"period_ns": 1_000_000 * period_ms}])
    bench.start()
    found = []
    for k in range(20):
        found += blocks(bench.give(us=1000 * period_ms, readings=struct.pack("<2i", k, -k)), messages.STREAM_SENSOR)
        assert sum(len(f[6].data) // 8 for f in found) == (k + 1) // block * block
    assert [values(f)[::2] for f in found] == [tuple(range(k, k + block)) for k in range(0, 20, block)]
    assert {f[7] for f in found} == {0}
    bench.box.close()
