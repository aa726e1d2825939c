"""The LVDT's excitation and its demodulators' clocks at the emulated chip's pins: frequency, duty cycle and phases."""

import cmath
import math

import pytest

from hardware import budget, lvdt_check

from .bench import run_steps

PERIOD_US = 1e6 / budget.EXCITATION_HZ
SCRIPT = """
from drivers.lvdt import Excitation
import array
Excitation(machine, chip, (10, 12, 14))
@micropython.viper
def look(times: ptr32, levels: ptr32, n: int):
    timer = ptr32(0x40054028)
    pins = ptr32(0xD0000004)
    k = 0
    while k < n:
        times[k] = timer[0]
        levels[k] = pins[0]
        k += 1
        rest = 20
        while rest > 0:
            rest -= 1
times, levels = array.array("I", bytes(4 * 3000)), array.array("I", bytes(4 * 3000))
look(times, levels, 3000)
print(list(times))
print([level >> 10 & 21 for level in levels])
print([machine.mem32[chip.PWM + chip.PWM_STRIDE * n + chip.PWM_TOP] for n in (5, 6, 7)])
"""


REFUSED = "\n".join(
    f"try:\n Excitation(machine, chip, {pins})\nexcept ValueError:\n print(1)"
    for pins in ((10, 12, 26), (10, 13, 14))  # of one slice; an odd one
)


@pytest.fixture(scope="module")
def steps():
    return run_steps([{"script": "import micropython\n" + SCRIPT}, {"script": REFUSED}])


@pytest.fixture
def run(steps):
    return steps[0]["out"]


def spectrum(run, bit):
    """Return the mean of a pin's level, and its first harmonic as a complex amplitude."""
    times, levels, _ = run
    span = int((times[-1] - times[0]) // PERIOD_US) * PERIOD_US
    inside = [(t - times[0], level >> bit & 1) for t, level in zip(times, levels, strict=True) if t - times[0] < span]
    mean = sum(level for _, level in inside) / len(inside)
    first = sum((level - mean) * cmath.exp(-2j * math.pi * t / PERIOD_US) for t, level in inside) / len(inside)
    return mean, first


def test_all_are_square_waves_with_the_phases_of_the_simulated_circuit(run):
    for bit in (0, 2, 4):
        mean, first = spectrum(run, bit)
        assert abs(mean - 0.5) < 0.02  # times are in whole µs of 393, samples some µs apart
        assert abs(abs(first) - 1 / math.pi) < 0.01
    assert run[2] == [49151] * 3
    excitation = cmath.phase(spectrum(run, 0)[1])
    for bit, behind in ((2, lvdt_check.PHASE_S), (4, lvdt_check.PHASE_P)):
        late = (excitation - cmath.phase(spectrum(run, bit)[1])) / (2 * math.pi) % 1
        assert abs(late - behind) < 0.01


def test_pins_that_share_a_slice_or_are_odd_are_refused(steps):
    assert steps[1]["out"] == [1, 1]
