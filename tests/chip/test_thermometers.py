"""Thermometers on the emulated chip: detection, readings to a sixteenth of a degree, and every fault of the wire."""

import pytest

from .bench import run_steps


def crc8(data: bytes) -> int:
    """Return Dallas' checksum, bit by bit: the remainder of x^8 + x^5 + x^4 + 1, least significant bit first."""
    crc = 0
    for bit in (byte >> k & 1 for byte in data for k in range(8)):
        crc = (crc >> 1) ^ (0x8C if (crc ^ bit) & 1 else 0)
    return crc


UIDS = [uid + f"{crc8(bytes.fromhex(uid)):02x}" for uid in ("28aa0102030405", "28aa0102130405", "28bb0102030405")]
MAKE = """
from drivers.ds18b20 import Thermometers
bus = Thermometers(machine, rp2, chip, 9, 7)
def done(uid):
    bus.begin(uid)
    steps = 1
    while True:
        state = bus.step()
        if state:
            return [state, steps, bus.mdegc]
        steps += 1
        time.sleep_us(500)
def read():
    found = [done(None)[0]]
    time.sleep_ms(760)
    for uid in bus.uids:
        found.append(done(uid))
    return found
import json
print(json.dumps(["".join(["%02x" % b for b in uid]) for uid in bus.uids]))
"""
READ = "print(read())"


def there(*temperatures, **more):
    """Return all thermometers in turn with a temperature, or a fault."""
    each = [
        {"uid": uid, "mdegc": value} if isinstance(value, int) else {"uid": uid, "mdegc": 20_000, "fault": value}
        for uid, value in zip(UIDS, temperatures, strict=False)
    ]
    return [{"part": "thermometers", "thermometers": each, **more}]


STEPS = {
    "nobody": {"script": MAKE + "print(done(None)[0])"},
    "found": {"script": MAKE + READ, "controls": there(20_062, -10_125, 124_938)},
    "slow": {
        "script": "bus.search()\nprint(len(bus.uids))\nprint(read())",
        "controls": there(0, 1000, -55_000, slow=11_000),
    },
    "noise": {"script": READ, "controls": there(20_000, "noise", 21_000)},
    "silent": {"script": READ, "controls": there(20_000, 20_500, "silent")},
    "power": {"script": READ, "controls": there("power", 20_500, 21_000)},
    "gone": {"script": READ, "controls": there("silent", "silent", "silent")},
    "short": {
        "script": READ + "\nbus.search()\nprint(len(bus.uids))\nbus.uids = [bytes(8)]\nprint(read())",
        "controls": there(short=True),
    },
    "back": {"script": "bus.search()\n" + READ, "controls": there(20_000, 20_500, 21_000)},
    "allocation": {
        "script": "uid = bus.uids[1]\nn = 0\nstate = 0\ngc.collect()\nbefore = gc.mem_alloc()\nbus.begin(uid)\nwhile not state:\n state = bus.step()\n"
        "n = gc.mem_alloc() - before\nprint([state, n, bus.mdegc])",
        "controls": there(20_000, 20_500, 21_000),
    },
    # the longest that a call takes, with interrupts as they are
    "time": {
        "script": "longest = 0\nbus.begin(bus.uids[0])\nstate = 0\nwhile not state:\n a = time.ticks_us()\n state = bus.step()\n"
        " longest = max(longest, time.ticks_diff(time.ticks_us(), a))\n time.sleep_ms(2)\nprint([state, longest])",
        "controls": there(20_000, 20_500, 21_000),
    },
}


@pytest.fixture(scope="module")
def out():
    return {name: step["out"] for name, step in zip(STEPS, run_steps(list(STEPS.values())), strict=True)}


def temperatures(found):
    return [mdegc if state == 1 else None for state, _, mdegc in found[1:]]


def test_all_are_read_to_a_sixteenth_of_a_degree_in_some_steps(out):
    assert sorted(out["found"][0]) == sorted(UIDS)
    expected = dict(zip(UIDS, (20_062, -10_125, 124_937), strict=True))  # sixteenths, rounded down
    assert temperatures(out["found"][1]) == [expected[uid] for uid in out["found"][0]]
    assert out["found"][1][0] == 1
    for _, steps, _ in out["found"][1][1:]:
        assert 30 <= steps <= 60  # 152 bits, four a step
    # 11 µs after it is let go, as with 2.4 nF to the Pico's threshold of 2 V.
    assert out["slow"][0] == 3
    assert None not in temperatures(out["slow"][1])
    assert out["nobody"] == [[], 2]


@pytest.mark.parametrize("fault", ["noise", "silent", "power"])
def test_one_that_fails_leaves_the_others(out, fault):
    order = out["found"][0]
    broken = {"noise": 1, "silent": 2, "power": 0}[fault]
    expected = {
        uid: None if k == broken else value
        for k, (uid, value) in enumerate(zip(UIDS, (20_000, 20_500, 21_000), strict=True))
    }
    assert temperatures(out[fault][0]) == [expected[uid] for uid in order]


def test_a_wire_without_thermometers_or_held_low_fails_at_once_until_it_is_mended(out):
    assert out["gone"][0][0] == 2
    assert temperatures(out["gone"][0]) == 3 * [None]
    assert temperatures(out["short"][0]) == 3 * [None]
    assert out["short"][1] == 0
    assert temperatures(out["short"][2]) == [None], "zeros have a checksum that is right"
    assert set(temperatures(out["back"][0])) == {20_000, 20_500, 21_000}


def test_reading_allocates_nothing_and_takes_no_time(out):
    state, allocated, _ = out["allocation"][0]
    assert (state, allocated) == (1, 0)
    state, longest = out["time"][0]
    assert state == 1
    assert longest <= 400  # µs, of a loop that may take 28 ms; the checksum of the last step is the longest
