"""The converter's driver on the emulated chip, against a model of the converter that shares no code with it.

What the driver hands out is held against what the model was asked for, and against the instants at which it converted.
"""

import json
import struct
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from truearm_sim import micropython, node

from .bench import run_steps

ROOT = Path(__file__).parents[2]
CHECK = Path(__file__).with_name("check_ads131m04.py")
MODEL = ROOT / "hil_sim" / "chip" / "ads131m04.mjs"
TRANSCRIPTS = Path(__file__).with_name("ads131m04_model.mjs")
VECTORS = Path(__file__).with_name("ads131m04_vectors.json")
SETTLING = 6  # conversions after a SYNC pulse that the driver does not use
OSRS = (128, 256, 512, 1024, 2048, 4096, 8192, 16384)
FAULT_OSR = 1024
CONVERTER = 2  # FLAG_CONVERTER
MAKE = """
import binascii, micropython
from drivers.ads131m04_dma import Adc
adc = Adc(machine, rp2, chip, (16, 17, 18, 19, 20, 21, 22))
block = bytearray(208)
index = bytearray(8)
stamp = bytearray(4)
kept = bytearray(24000)
used = 0
def pull():
    global used
    n = 13
    if not adc.take(n, block, 0, index, stamp):
        n = adc.waiting() if adc.broken() else 0
        if n == 0 or not adc.take(n, block, 0, index, stamp):
            return
    struct.pack_into(">BBHQ", kept, used, n, adc.fault(), adc.lost(), int.from_bytes(index, "big"))
    kept[used + 12 : used + 16] = stamp
    kept[used + 16 : used + 16 + 16 * n] = block[: 16 * n]
    used += 16 + 16 * n
def sample(osr, ms):
    global used
    used = 0
    before = adc.crc_errors, adc.resets
    adc.start(osr)
    end = time.ticks_add(time.ticks_ms(), ms)
    while time.ticks_diff(end, time.ticks_ms()) > 0:
        pull()
    adc.stop()
    print('[%d, %d, "%s"]' % (adc.crc_errors - before[0], adc.resets - before[1], binascii.hexlify(kept[:used]).decode()))
    gc.collect()
gc.collect()
"""


def counts(index: int, t_ns: float, gains=(1, 1, 1, 1)) -> tuple[int, ...]:
    """The signals of driver_bench.mjs, amplified and saturated."""
    raw = [((index * 4 + c) * 2654435 + (round(t_ns) % 1000003) * 7) % 8388608 - 4194304 for c in range(4)]
    return tuple(max(-(2**23), min(2**23 - 1, value * gain)) for value, gain in zip(raw, gains, strict=True))


class Blocks:
    """What a step's `sample` handed out: n, flags, samples lost before, index and stamp of each block, and its samples."""

    def __init__(self, step: dict):
        self.crc_errors, self.resets, text = step["out"][-1]
        self.asked = step["conversions"]
        self.blocks = []
        data = bytes.fromhex(text)
        while data:
            n, flags, lost, index, stamp = struct.unpack_from(">BBHQI", data)
            self.blocks.append((index, stamp, flags, lost, list(struct.iter_unpack("<4i", data[16 : 16 + 16 * n]))))
            data = data[16 + 16 * n :]

    @property
    def gaps(self) -> list[tuple[int, int]]:
        """(index after, samples missing)"""
        ends = [index + len(samples) for index, _, _, _, samples in self.blocks]
        return [
            (block[0], block[0] - end) for block, end in zip(self.blocks[1:], ends, strict=False) if block[0] != end
        ]

    def conversions(self, osr: int, gains=(1, 1, 1, 1)) -> dict[int, float]:
        """Instant of each sample by its index; every value is the model's, every stamp within a microsecond of the conversion."""
        by_value = {counts(i, t, gains): t for i, t in self.asked}
        found = {}
        for index, stamp, _, _, samples in self.blocks:
            for k, sample in enumerate(samples):
                assert sample in by_value, f"sample {index + k} is no conversion of the model"
                t_ns = by_value[sample]
                late_ns = (stamp - t_ns // 1000 + 2**31) % 2**32 - 2**31 + k * osr * 0.24
                late_ns = late_ns * 1000 - t_ns % 1000
                # the timer's microsecond begun when DMA reads it, at most 0.3 us after the conversion
                assert -1000 < late_ns <= 300
                found[index + k] = t_ns
        return found

    def assert_honest(self, osr: int, conversions: dict[int, float]) -> None:
        """Losses add up to the gaps, and an index tells the time to half a period."""
        assert sum(block[3] for block in self.blocks) == sum(n for _, n in self.gaps)
        start = conversions[0]
        for index, t_ns in conversions.items():
            assert abs(t_ns - start - index * osr * 240) <= osr * 120


@pytest.fixture(scope="module")
def plain():
    """One boot; each test looks at its own step."""
    steps = {
        "make": {"script": MAKE},
        "identity": {
            "script": "print([int(adc.registers.setup()), adc.registers.read(0) >> 8])\n"
            "print([adc.registers.read(address) for address in (2, 3, 4)])"
        },
        **{f"osr {osr}": {"script": f"sample({osr}, {max(20, osr * 60 // 4000)})"} for osr in OSRS},
        "gains": {"script": "adc.gains((1, 2, 16, 128))\nsample(4096, 40)\nadc.gains((1, 1, 1, 1))"},
        "refused": {
            "script": "for wrong in ((1, 2, 3, 4), (1, 1, 1)):\n"
            " try:\n  adc.gains(wrong)\n except ValueError as e:\n  print('\"%s\"' % e)\n"
            "try:\n adc.start(1000)\nexcept ValueError as e:\n print('\"%s\"' % e)"
        },
        "heap": {
            "script": """
adc.start(1024)
while not adc.take(13, block, 0, index, stamp):
    pass
done = 0
micropython.heap_lock()
while done < 40:
    if adc.take(13, block, 0, index, stamp):
        done += 1
        adc.lost()
        adc.fault()
        adc.waiting()
        adc.broken()
        adc.crc_errors
        adc.resets
micropython.heap_unlock()
adc.stop()
print(done)
"""
        },
        "fastest": {
            "script": """
adc.start(256)
done = worst = 0
while done < 150:
    t = time.ticks_us()
    if adc.take(13, block, 0, index, stamp):
        done += 1
        worst = max(worst, time.ticks_diff(time.ticks_us(), t))
adc.stop()
print([int.from_bytes(index, "big"), adc.lost(), adc.crc_errors, worst])
"""
        },
    }
    return dict(zip(steps, run_steps(list(steps.values())), strict=True))


def test_the_converter_is_identified_and_configured(plain):
    assert plain["identity"]["out"] == [[1, 0x24], [0x2110, 0x0F02, 0]]


@pytest.mark.parametrize("osr", OSRS)
def test_every_sample_at_every_rate(plain, osr):
    step = plain[f"osr {osr}"]
    blocks = Blocks(step)
    conversions = blocks.conversions(osr)
    assert list(conversions) == list(range(len(blocks.blocks) * 13))
    assert len(conversions) >= 39
    assert (blocks.crc_errors, blocks.resets, blocks.gaps) == (0, 0, [])
    assert all(flags == lost == 0 for _, _, flags, lost, _ in blocks.blocks)
    number = {t: i for i, t in blocks.asked}
    # sample 0 is the first that has settled (the model gives 1/6 and 5/6 of the signal before), and conversions follow one another
    assert [number[t] for t in conversions.values()] == list(range(SETTLING, SETTLING + len(conversions)))
    assert step["violations"] == []


def test_gains_and_saturation(plain):
    blocks = Blocks(plain["gains"])
    assert blocks.conversions(4096, (1, 2, 16, 128))
    assert any(abs(sample[3]) >= 2**23 - 1 for block in blocks.blocks for sample in block[4])


def test_misuse_is_refused_in_words(plain):
    assert [text.split(",")[0].split(";")[0] for text in plain["refused"]["out"]] == [
        "gains are four of (1",
        "gains are four of (1",
        "an oversampling of 1000",
    ]


def test_taking_does_not_allocate(plain):
    assert plain["heap"]["out"] == [40]  # with the heap locked, an allocation raises MemoryError


def test_the_driver_alone_keeps_up_with_16_kHz(plain):
    index, lost, crc_errors, worst_us = plain["fastest"]["out"][0]
    assert (index, lost, crc_errors) == (149 * 13, 0, 0)
    assert worst_us < 13 * 61.44  # a block's time


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
other = Adc(machine, rp2, chip, (8, 9, 10, 11, 12, 13, 14), 1)
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
""",
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


# -- CRC and frames on both interpreters, and of the model


def check(command: list[str]) -> str:
    done = subprocess.run([*command, str(CHECK), str(ROOT), str(VECTORS)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_crc_and_survey_on_cpython():
    assert check([sys.executable]).startswith("5 vectors, 0 failed")


def test_crc_and_survey_on_micropython():
    interpreter = micropython.find()
    assert interpreter is not None, "make micropython gets one"
    assert check([str(interpreter.path)]).startswith("5 vectors, 0 failed")


def test_the_model_answers_as_real_parts_did():
    done = subprocess.run([str(node.ready().path), str(TRANSCRIPTS)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr


def test_crc_of_the_model():
    script = f"import({json.dumps(MODEL.as_uri())}).then(({{crc16}}) => console.log(JSON.stringify({VECTORS.read_text()}.map((v) => crc16(Buffer.from(v.hex, 'hex'))))))"
    done = subprocess.run([str(node.ready().path), "-e", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [vector["crc"] for vector in json.loads(VECTORS.read_text())]
