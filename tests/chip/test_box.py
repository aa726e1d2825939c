"""The firmware on the emulated chip: boot, time, flash, exits, a host that disappears."""

import itertools

import cbor2
import numpy as np
import pytest

from tests.host.test_box_config import default
from tests.protocol import test_foreign_client as client
from tests.wire_frames import command
from truearm_sim.box import COMMAND, WATCHDOG
from truearm_sim.chip import STORE, make_flash, read_flash
from truearm_sim.hardware import CRASH, STALL
from truearm_wire.messages import (
    BOOT_LOADER,
    CONFIGURE,
    DATA,
    HEARTBEAT,
    IDENT,
    RESET,
    RESTART,
    SELF_TEST,
    START,
    SYNC_REPLY,
    SYNC_REQUEST,
    TO_REPL,
    names,
)

from .conftest import MS, Chip, Counting, document, ident

S = 1_000_000
PERIOD_NS = 983_040


def heartbeats(found):
    return [dict(zip(names(HEARTBEAT), f[1:], strict=True)) for f in found if isinstance(f, list) and f[0] == HEARTBEAT]


def blocks(found, stream):
    return [f for f in found if isinstance(f, list) and f[0] == DATA and f[2] == stream]


def indices(found, stream):
    """Return the indices of all samples of a stream, from their counts (conftest.Counting)."""
    width = (4, 1)[stream]
    values = [np.frombuffer(f[6].data, "<i4").reshape(-1, width)[:, 0] for f in blocks(found, stream)]
    return np.concatenate(values)


@pytest.fixture(scope="module")
def switched_on(tmp_path_factory):
    """Return a box and what it sent while it booted: booting takes as long as most tests. They leave it stopped, and the flash as it is."""
    chip = Chip(tmp_path_factory.mktemp("box"))
    yield chip, chip.boot()
    chip.close()


def test_it_boots_tells_who_it_is_answers_and_keeps_time(switched_on):
    chip, said = switched_on
    who = ident(said)
    assert who["board"] == "rp2040"
    assert who["uid"].hex() == "e6614103e7452b2f"
    assert who["clock_hz"] == 1_000_000
    assert "last_error" not in who
    assert {s["id"] for s in who["streams"]} == {0, 1}
    for k in range(5):
        sent_us = chip.now_us
        (reply,) = [f for f in chip.hear(20 * MS, rx=command(SYNC_REQUEST, 70 + k)) if f[0] == 33]
        assert reply[2] == 70 + k
        assert sent_us < reply[3] < reply[4] < chip.now_us
    beats = heartbeats(chip.hear(3 * S))
    assert len(beats) == 3
    assert np.abs(np.diff([b["t_us"] for b in beats]) - S).max() < 10 * MS  # as late as a step of the loop
    assert all(b["reset_cause"] == 1 and b["streaming"] == 0 and b["bad_frames"] == 0 for b in beats)
    # 24.5 °C through a 12-bit ADC of 3.3 V: 0.81 mV a step, 0.47 °C
    assert abs(beats[-1]["temperature_mdegc"] - 24_500) < 470
    assert beats[-1]["heap_free"] > 50_000


def test_its_self_test_measures_every_part(switched_on):
    chip, _ = switched_on
    results = cbor2.loads(document(chip.ask(SELF_TEST, ms=1500), 64))
    assert results["converter_id"]["value"] >> 8 == 0x24
    assert all(results[f"noise_{c}"]["ok"] == 1 for c in range(4))
    assert results["stops"] == {"ok": 1, "value": 16, "unit": "", "low": 15, "high": 16}
    assert results["rail_5v"]["ok"] == 1
    assert abs(results["temperature"]["value"] - 24_500) < 470


def test_a_box_without_an_lvdt_passes_its_self_test(power_on):
    """Line only: no channel is divided by another, so nothing is asked of a primary that is not there. With ``over`` it is missed."""

    class Nothing(Counting):
        def counts(self, k0, k1, start_ns, period_ns):
            return np.random.default_rng(k0).integers(-20, 20, (k1 - k0, 4)).astype(np.int32)

    chip = power_on(signals=Nothing())
    assert "fault" not in ident(chip.boot())
    assert "excitation" not in cbor2.loads(document(chip.ask(SELF_TEST, ms=1500), 64))
    config = chip.config()
    config["channels"][0]["over"] = config["channels"][3]["name"]
    chip.put_config(config)
    assert cbor2.loads(document(chip.ask(SELF_TEST, ms=1500), 64))["excitation"]["ok"] == 0


def test_a_configuration_outlives_a_restart(power_on):
    chip = power_on()
    chip.boot()
    config = chip.config()
    config["osr"] = 2048
    config["magnetostrictive"]["period_ns"] = 0
    answers = chip.put_config(config)
    assert [f[0] for f in answers].count(IDENT) >= 1
    chip.ask(RESET, RESTART, ms=500)
    assert chip.end == "reset"
    chip = power_on(cause=COMMAND)
    who = ident(chip.boot())
    assert [s["id"] for s in who["streams"]] == [0]
    assert who["streams"][0]["osr"] == 2048
    assert heartbeats(chip.hear(S))[0]["reset_cause"] == COMMAND


@pytest.mark.soak  # tests/firmware/test_power.py cuts a littlefs in MicroPython a thousand times
def test_power_that_fails_while_it_writes_leaves_the_old_or_the_new_configuration(power_on, tmp_path):
    chip = power_on()
    chip.boot()
    config = chip.config()
    chip.put_config(config)
    for cut, osr in ((1, 128), (3, 256), (5, 512)):
        before = config["osr"]
        config["osr"] = osr
        chip.hardware.control({"pico": "cut", "operations": cut})
        chip.put_config(config)
        assert chip.end == "power cut"
        chip = power_on()
        chip.boot()
        after = chip.config()
        assert after["osr"] in (before, osr)
        config["osr"] = after["osr"]
        assert after == config
    assert "config.json" in read_flash(tmp_path / STORE)


def test_a_firmware_that_hangs_or_fails_is_reset_and_tells_it_at_the_next_boot(power_on):
    """And at last a command leads to the ROM's boot loader."""
    chip = power_on()
    chip.boot()
    chip.give(3 * S, flags=STALL)
    assert chip.end == "watchdog"
    chip = power_on(cause=WATCHDOG)
    chip.boot()
    assert heartbeats(chip.hear(S))[0]["reset_cause"] == WATCHDOG
    found = chip.hear(500 * MS, flags=CRASH)
    (text,) = [f for f in found if isinstance(f, bytes)]
    assert b"Traceback" in text
    assert b"RuntimeError: injected by the simulator" in text
    assert chip.end == "reset"
    chip = power_on(cause=COMMAND)
    assert "RuntimeError: injected by the simulator" in ident(chip.boot())["last_error"]
    chip.ask(RESET, BOOT_LOADER, ms=500)
    assert chip.end == "boot loader"


def test_ctrl_c_at_boot_and_a_command_lead_to_the_prompt(power_on):
    chip = power_on()
    chip.give(S)
    assert b"KeyboardInterrupt" in chip.give(500 * MS, rx=b"\x03")
    assert b"42" in chip.give(S, rx=b"6 * 7\r\n")
    chip = power_on()
    chip.boot()
    assert [f[0] for f in chip.ask(TO_REPL) if isinstance(f, list)] == [64]
    assert b"42" in chip.give(10 * S, rx=b"6 * 7\r\n")  # and no watchdog bites
    busy = b"import machine; print([c for c in range(12) if machine.mem32[0x50000010 + 64 * c] & 1 << 24], 'busy')\r\n"
    assert b"[] busy" in chip.give(S, rx=busy)
    assert chip.end == ""


# Nothing left behind is less than what the others leave.
@pytest.mark.parametrize(
    "left_behind",
    [*(pytest.param(less, marks=pytest.mark.soak) for less in (b"", b"\x01", b"6 * 7")), b"\x01unfinished"],
)
def test_a_client_of_the_specification_alone_finds_the_box_at_its_prompt(power_on, left_behind):
    """§8: the prompt echoes what was sent, Ctrl-C, Ctrl-B and Ctrl-D leave it; then identify, stop, start. A raw prompt is silent."""
    identify = next(frame for k in range(1, 100) if 3 not in (frame := client.frame(48, k)))
    chip = power_on()
    chip.give(S)
    chip.give(500 * MS, rx=b"\x03")
    chip.give(500 * MS, rx=left_behind)
    heard = b"".join(chip.give(200 * MS, rx=identify) for _ in range(25))
    assert list(client.payloads(heard)) == []
    assert (b">>> " in heard) == (b"\x01" not in left_behind)
    chip.give(500 * MS, rx=b"\x03\x02\x04")
    heard = b"".join(chip.give(200 * MS, rx=b"\0" + identify) for _ in range(25))
    pages = [f for f in client.payloads(heard) if f[0] == 19 and f[2] > 0]
    said, _ = client.cbor(b"".join(f[5] for f in pages[: pages[0][4]]))
    assert (said["board"], said["protocol"][0]) == ("rp2040", 1)
    for frame_type, req_id in ((51, 101), (50, 102)):
        answers = client.payloads(chip.give(200 * MS, rx=client.frame(frame_type, req_id)))
        assert [f[2] for f in answers if f[0] == 64] == [req_id]
    found = [f for f in client.payloads(chip.give(S)) if f[0] == 16 and f[2] == 0]
    assert len(found) > 70
    assert all(b[3] - a[3] == 13 for a, b in itertools.pairwise(found))


@pytest.mark.parametrize("wrap", [pytest.param(1 << 30, marks=pytest.mark.soak), 1 << 32])
def test_time_goes_on_where_counters_wrap(power_on, wrap):
    """2^30: MicroPython's small integers and ticks; 2^32: the lower half of the hardware timer."""
    start_us = wrap - int(3.5e6)  # it has booted and streams
    chip = power_on(start_us=start_us)
    chip.boot()
    chip.ask(START, ms=10)
    found = chip.hear(1200 * MS)
    for stream in (0, 1):
        t0 = np.array([f[4] for f in blocks(found, stream)])
        n0 = np.array([f[3] for f in blocks(found, stream)])
        assert t0[0] < wrap < t0[-1]
        assert np.ptp(t0 - n0 * PERIOD_NS / 1000) <= 1.0 + 1e-9
    beats = [b["t_us"] for b in heartbeats(found)]
    assert start_us < beats[0] < chip.now_us
    (reply,) = [f for f in chip.hear(50 * MS, rx=command(SYNC_REQUEST, 1)) if f[0] == 33]
    assert wrap < reply[3] < reply[4] < chip.now_us


def test_a_host_that_stalls_or_leaves_costs_what_the_ring_does_not_hold_and_it_is_counted(power_on):
    chip = power_on(
        config=default() | {"trigger_ms": [0, 0]}
    )  # an edge sent between frames lets the ring fill once more
    chip.boot()
    chip.ask(CONFIGURE, 1, 0, ms=20)
    chip.ask(START, ms=10)
    before = chip.hear(300 * MS)
    held = chip.hear(3 * S, room=0)  # the ring holds 2.5 s of one source
    assert held == []
    after = chip.hear(1600 * MS)  # the ring is sent, and a heartbeat behind it
    k = np.concatenate([indices(before, 0), indices(after, 0)]) // 4
    gaps = np.diff(k) - 1
    lost = int(gaps.sum())
    assert np.count_nonzero(gaps) <= 1
    assert heartbeats(after)[-1]["overruns"] == lost
    chip.hardware.host_gone = True
    chip.give(3 * S)
    assert chip.end == ""
    chip.hardware.host_gone = False
    back = chip.hear(1600 * MS)
    assert heartbeats(back)[-1]["reset_cause"] == 1
    assert heartbeats(back)[-1]["overruns"] > lost
    assert len(blocks(back, 0)) > 200


def test_a_board_with_another_clock_is_refused(power_on, tmp_path):
    """A boot.py that overclocks the chip: the firmware does not start, the reason stands at the prompt."""
    make_flash(tmp_path / STORE, {"boot.py": b"import machine; machine.freq(133000000)"})
    chip = power_on()
    said = chip.give(500 * MS)  # it comes in the first 0.2 s
    assert b"the system clock is 133000000 Hz" in said
    assert not [
        f for f in chip.hear(100 * MS, rx=command(SYNC_REQUEST, 70)) if isinstance(f, list) and f[0] == SYNC_REPLY
    ]
