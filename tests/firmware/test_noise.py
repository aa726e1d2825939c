"""Any input while the box streams: samples and heartbeats go on, nothing restarts. On the chip: tests/chip/test_noise.py."""

import random

import pytest

from tests.firmware.conftest import PERIOD_NS
from tests.noise import PATTERNS
from tests.wire_frames import frames
from truearm_sim.box import RX_MAX
from truearm_wire.messages import DATA, HEARTBEAT


@pytest.mark.parametrize("size", [20_000, pytest.param(10_000_000, marks=pytest.mark.soak)])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_no_input_costs_samples_heartbeats_or_a_restart(chip, pattern, size):
    data = PATTERNS[pattern](random.Random(2), size)
    chip.start()
    at = index = beats = overruns = 0
    while at < len(data) or chip.index % 1300:
        n = min(RX_MAX, chip.answer.rx_room)
        chip.sample(13, rx=data[at : at + n])
        at += n
        assert (chip.answer.end, chip.answer.alive) == ("", True)
        for f in frames(chip.answer.tx):
            if f[0] == DATA:
                assert f[3] == index
                index += 13
            elif f[0] == HEARTBEAT:
                beats += 1
                overruns = f[7]
    assert (index, overruns) == (chip.index, 0)
    assert beats == (chip.now_us // 1_000_000) - (chip.t_start_us // 1_000_000)
    assert chip.now_us - chip.t_start_us == chip.index * PERIOD_NS // 1000
