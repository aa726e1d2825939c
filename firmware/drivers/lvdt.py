"""Excitation of an LVDT and the clocks of its two demodulators: three square waves of 2543 Hz from three PWM slices.

hardware/box.py has the circuit. The excitation becomes a sine that drives the primary. Two switches reverse the
secondary's voltage and the primary's current, and the converter averages them. A period is 49152 system clocks, so that
twice the frequency falls on a null of the converter's filter: its clock is the system's divided by 15, a result at OSR
4096 takes 2 · 4096 of it, and five times that are two periods. The secondary's clock is a third of a period behind the
excitation, the primary's a quarter of a period behind the secondary's (docs/how-to/hardware.md).

One write starts the slices together, with different counter values; nothing else is needed after that.
"""

from .registers import poke

PERIOD = 49152  # system clocks
BEHIND = (
    0,
    PERIOD // 3,
    PERIOD // 3 + PERIOD // 4,
)  # delays of the excitation, the secondary's clock and the primary's clock


class Excitation:
    """Runs from its creation. Pins: excitation, secondary's clock, primary's clock; even ones, each of another slice.

    Raises ValueError if the pins are unsuitable.
    """

    def __init__(self, machine, chip, pins):
        slices = [pin >> 1 & 7 for pin in pins]
        if len(set(slices)) < len(pins) or any([pin & 1 for pin in pins]):
            raise ValueError("the pins must be even ones of three slices")
        together = 0
        for k in range(len(pins)):
            base = chip.PWM + chip.PWM_STRIDE * slices[k]
            poke(base + chip.PWM_DIV, 1 << 4)
            poke(base + chip.PWM_CSR, 0)
            poke(base + chip.PWM_TOP, PERIOD - 1)
            poke(base + chip.PWM_CC, PERIOD // 2)
            poke(base + chip.PWM_CTR, (PERIOD - BEHIND[k]) % PERIOD)
            machine.Pin(pins[k], machine.Pin.OUT, value=0)
            poke(chip.IO_BANK0 + 8 * pins[k] + 4, chip.FUNCTION_PWM)
            together |= 1 << slices[k]
        poke(chip.PWM_EN, machine.mem32[chip.PWM_EN] | together)
