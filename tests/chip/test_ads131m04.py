"""The converter's driver on the emulated chip, against a model of the converter that shares no code with it.

What the driver hands out is checked against what the model was asked for, and against the instants at which it converted.
"""

import pytest

from .bench import run_steps
from .converter_bench import MAKE, SETTLING, Blocks

OSRS = (128, 256, 512, 1024, 2048, 4096, 8192, 16384)


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


def test_the_converter_is_configured_and_misuse_is_refused(plain):
    assert plain["identity"]["out"] == [[1, 0x24], [0x2110, 0x0F02, 0]]
    assert [text.split(",")[0].split(";")[0] for text in plain["refused"]["out"]] == [
        "gains are four of (1",
        "gains are four of (1",
        "an oversampling of 1000",
    ]


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


def test_the_driver_alone_keeps_up_with_16_kHz_and_taking_does_not_allocate(plain):
    index, lost, crc_errors, worst_us = plain["fastest"]["out"][0]
    assert (index, lost, crc_errors) == (149 * 13, 0, 0)
    assert worst_us < 13 * 61.44  # a block's time
    assert plain["heap"]["out"] == [40]  # with the heap locked, an allocation raises MemoryError
