"""The converter's driver on the emulated chip when converter, line or loop fail: no wrong sample is output, and all faults are counted."""

from itertools import pairwise

import pytest

from .bench import run_steps
from .converter_bench import MAKE, SETTLING, Blocks

FAULT_OSR = 1024
CONVERTER = 2  # FLAG_CONVERTER


def fault(*messages: dict, ms: int = 100, gains: str = "(1, 1, 1, 1)") -> dict:
    controls = [{"afterMs": 40, "part": "adc", **message} for message in messages]
    return {"script": f"adc.gains({gains})\nsample({FAULT_OSR}, {ms})", "controls": controls}


@pytest.fixture(scope="module")
def faults():
    steps = {
        "make": {"script": MAKE},
        "wrap": {  # the 32-bit timer wraps while sampling
            "script": "while machine.mem32[chip.TIMERAWL] & 0xFFFFFFFF < 0xFFFFFFFF - 40000:\n time.sleep_ms(10)\nsample(1024, 80)"
        },
        "one frame": fault({"fault": "corrupt", "frames": 1}),
        "five frames": fault({"fault": "corrupt", "frames": 5}),
        "reset": fault({"fault": "reset"}, gains="(1, 2, 4, 8)"),
        "silence": fault({"fault": "silent", "ns": 70_000_000}, ms=220),
        "register": fault({"fault": "register", "address": 4, "value": 0x7777}),
        "standing loop": {
            "script": """
def pull_late():
    while used < 3 * 224:
        plain_pull()
    time.sleep_ms(400)
    for _ in range(60):
        plain_pull()
plain_pull = pull
pull = pull_late
sample(1024, 5)  # one call: it takes longer
pull = plain_pull
"""
        },
        "careless": {  # a caller that never asks for the samples before a gap
            "script": """
adc.start(1024)
found = []
while len(found) < 24:
    if adc.take(13, block, 0, index, stamp):
        found.append([int.from_bytes(index, "big"), adc.lost(), adc.fault()])
adc.stop()
print(found)
""",
            "controls": [{"afterMs": 40, "part": "adc", "fault": "corrupt", "frames": 1}],
        },
        "heap in a reset": {
            "script": """
before = adc.resets
adc.start(1024)
while not adc.take(13, block, 0, index, stamp):
    pass
lost = 0
end = time.ticks_add(time.ticks_ms(), 80)
micropython.heap_lock()
while time.ticks_diff(end, time.ticks_ms()) > 0:
    if adc.take(13, block, 0, index, stamp):
        lost += adc.lost()
micropython.heap_unlock()
adc.stop()
print([adc.resets - before, lost])
""",
            "controls": [{"afterMs": 40, "part": "adc", "fault": "reset"}],
        },
        "again": {"script": "sample(1024, 30)"},
        "absent": {  # nothing is connected to these pins
            "script": """
other = Adc(machine, rp2, chip, (8, 9, 10, 11, 12, 13, 14), 2)
print([int(other.registers.setup()), other.registers.read(0)])
other.start(4096)
longest = 0
end = time.ticks_add(time.ticks_ms(), 240)
while time.ticks_diff(end, time.ticks_ms()) > 0:
    t = time.ticks_us()
    assert not other.take(13, block, 0, index, stamp) and other.waiting() == 0
    longest = max(longest, time.ticks_diff(time.ticks_us(), t))
other.stop()
print([other.resets, longest])
"""
        },
    }
    start_ns = (2**32 - 5_000_000) * 1000  # the boot window lasts 2 s
    return dict(zip(steps, run_steps(list(steps.values()), start_ns), strict=True))


def test_the_timer_wraps(faults):
    blocks = Blocks(faults["wrap"])
    conversions = blocks.conversions(FAULT_OSR)
    assert list(conversions) == list(range(len(conversions)))
    stamps = [stamp for _, stamp, *_ in blocks.blocks]
    assert max(stamps) > 2**32 - 40000
    assert stamps[-1] < 2**31


@pytest.mark.parametrize(("name", "n"), [("one frame", 1), ("five frames", 5)])
def test_corrupted_frames_are_dropped_counted_and_flagged(faults, name, n):
    blocks = Blocks(faults[name])
    conversions = blocks.conversions(FAULT_OSR)
    assert (blocks.crc_errors, blocks.resets) == (n, 0)
    assert [missing for _, missing in blocks.gaps] == [n]
    (after, _), *_ = blocks.gaps
    assert [index for index, _, flags, *_ in blocks.blocks if flags == CONVERTER] == [after]
    blocks.assert_honest(FAULT_OSR, conversions)


def test_a_reset_is_counted_flagged_and_the_converter_set_up_anew(faults):
    blocks = Blocks(faults["reset"])
    conversions = blocks.conversions(FAULT_OSR, (1, 2, 4, 8))  # with its gains, before and after
    assert blocks.resets == 1
    assert len(blocks.gaps) == 1
    blocks.assert_honest(FAULT_OSR, conversions)
    ((after, missing),) = blocks.gaps
    assert missing * FAULT_OSR * 0.24e-3 < 30  # ms
    assert [index for index, _, flags, *_ in blocks.blocks if flags == CONVERTER] == [after]
    assert max(conversions) > after + 100


def test_a_converter_that_falls_silent_is_set_up_anew(faults):
    blocks = Blocks(faults["silence"])
    conversions = blocks.conversions(FAULT_OSR)
    assert blocks.resets >= 1
    ((after, missing),) = blocks.gaps
    assert 70 < missing * FAULT_OSR * 0.24e-3 < 70 + 50 + 30  # until the next attempt, ms
    assert all(flags == 0 for _, _, flags, *_ in blocks.blocks)  # it reported nothing; the gap is what there is to tell
    blocks.assert_honest(FAULT_OSR, conversions)
    assert max(conversions) > after + 100


def test_no_value_of_a_converter_with_other_registers_is_handed_out(faults):
    blocks = Blocks(faults["register"])
    blocks.assert_honest(FAULT_OSR, blocks.conversions(FAULT_OSR))
    assert blocks.resets == 1


def test_a_loop_that_stands_still_loses_a_known_number(faults):
    blocks = Blocks(faults["standing loop"])
    conversions = blocks.conversions(FAULT_OSR)
    assert len(blocks.blocks) > 3 + 26
    assert len(blocks.gaps) == 1
    assert blocks.gaps[0][1] > 900  # 1627 conversions passed, 681 fit
    assert (blocks.crc_errors, blocks.resets) == (0, 0)
    blocks.assert_honest(FAULT_OSR, conversions)
    number = {t: i for i, t in blocks.asked}
    assert {number[t] - index for index, t in conversions.items()} == {SETTLING}


def test_a_caller_that_never_takes_a_short_block_goes_on_too(faults):
    (found,) = faults["careless"]["out"]
    jumps = [b[0] - a[0] - 13 for a, b in pairwise(found)]
    assert sum(jump > 0 for jump in jumps) == 1
    assert 0 < max(jumps) <= 13
    assert sum(lost for _, lost, _ in found) == sum(jumps)


def test_sampling_goes_on_after_all_that(faults):
    blocks = Blocks(faults["again"])
    assert list(blocks.conversions(FAULT_OSR)) == list(range(13 * len(blocks.blocks)))
    assert blocks.gaps == []


def test_setting_the_converter_up_anew_does_not_allocate(faults):
    resets, lost = faults["heap in a reset"]["out"][0]
    assert resets == 1
    assert lost > 0


def test_without_a_converter_the_box_goes_on(faults):
    (configured, identity), (attempts, longest_us) = faults["absent"]["out"]
    assert (configured, identity) == (0, -1)
    assert 2 <= attempts <= 5  # one in 50 ms
    assert longest_us < 10_000
