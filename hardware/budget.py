"""The numbers of the box: scales, corners, delays and errors, from the netlist's values and the sensors' data.

docs/how-to/hardware.md prints them; hardware/spice_check.py compares them with the simulated circuit. Uses only the
standard library.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from hardware.netlist import Netlist, quantity

SYSTEM_HZ = 125_000_000
EXCITATION_DIVIDER = 49152  # period of the excitation in clocks of the Pico
EXCITATION_HZ = SYSTEM_HZ / EXCITATION_DIVIDER
CONVERTER_HZ = SYSTEM_HZ / 15
ADC_OHM = 330e3  # ADS131M04, gains 1, 2 and 4, typical
ADC_OHM_TOLERANCE = 0.2  # assumed: the data sheet gives only a typical value
ADC_NOISE_V = 3.38e-6  # rms at gain 1, OSR 4096
ADC_REFERENCE_V = 1.2
# Limits of the ratio's errors, relative to full travel: hardware/lvdt_check.py holds all LVDTs of the range against them.
RATIO_LINEARITY = 0.0005
RATIO_PER_50_OHM = 0.0005  # 10 → 60 Ω in the primary
RATIO_PER_EXCITATION = 0.0001  # ±20 % of excitation
# Delays of the trigger output into 3 kΩ, simulated, in µs: hardware/spice_check.py holds the circuit against them.
TRIGGER_ON_US, TRIGGER_OFF_US = 1, 13


@dataclass(frozen=True)
class Lvdt:
    """An LVDT: inductances [H] and resistances [Ω] of the primary and of each secondary; simulated voltages at full
    travel.
    """

    name: str
    primary_h: float
    primary_ohm: float
    secondary_h: float
    secondary_ohm: float
    primary_v: float
    secondary_v: float

    @property
    def primary_impedance(self) -> float:
        """Ω at the excitation's frequency."""
        return math.hypot(self.primary_ohm, 2 * math.pi * EXCITATION_HZ * self.primary_h)

    @property
    def secondary_impedance(self) -> float:
        """Ω of one secondary at the excitation's frequency."""
        return math.hypot(self.secondary_ohm, 2 * math.pi * EXCITATION_HZ * self.secondary_h)


# The range that docs/how-to/hardware.md states: its ends and its middle. The first is the one of the error budget.
LVDTS = (
    Lvdt("of 300 Ω", 20e-3, 40, 30e-3, 150, 0.1618, 0.1732),
    Lvdt("of 100 Ω, small secondaries", 6.3e-3, 10, 10e-3, 50, 0.1494, 0.0515),
    Lvdt("of 100 Ω, large secondaries", 6.3e-3, 10, 60e-3, 300, 0.1494, 0.1266),
    Lvdt("of 200 Ω", 12e-3, 60, 30e-3, 150, 0.15, 0.124),
    Lvdt("of 1 kΩ, large secondaries", 62e-3, 60, 60e-3, 300, 0.1169, 0.3115),
    Lvdt("of 2 kΩ, small secondaries", 125e-3, 60, 10e-3, 50, 0.0641, 0.0983),
    Lvdt("of 2 kΩ, large secondaries", 125e-3, 60, 60e-3, 300, 0.064, 0.2411),
)


def value(netlist: Netlist, ref: str) -> float:
    return quantity(netlist.components[ref].value)


@dataclass(frozen=True)
class Input:
    """A transducer's input: volts at the converter per volt at the terminals, -3 dB frequency [Hz], delay [s], ohms."""

    scale: float
    corner_hz: float
    delay_s: float
    ohm: float
    unloaded: float


def transducer(netlist: Netlist, adc_ohm: float = ADC_OHM) -> Input:
    """Return the input of transducer 1 as fitted for voltages, between its two terminals."""
    series, shunt = value(netlist, "R8"), value(netlist, "R9")
    source = 2 * series * shunt / (series + shunt)
    unloaded = shunt / (series + shunt)
    loaded = adc_ohm * source / (adc_ohm + source)
    farad = value(netlist, "C11") + value(netlist, "C10") / 2
    return Input(
        unloaded * adc_ohm / (adc_ohm + source),
        1 / (2 * math.pi * loaded * farad),
        loaded * farad,
        2 * (series + shunt),
        unloaded,
    )


def loop_scale(netlist: Netlist) -> float:
    """Return volts at the converter per ampere of a 4-20 mA loop whose lower end, signal -, is at 0 V."""
    loop, ohm = value(netlist, "R12"), transducer(netlist)
    return loop * (ohm.ohm / 2) / (loop + ohm.ohm / 2) * ohm.scale


@dataclass(frozen=True)
class Demodulator:
    """The filter after the reversing switches: loading by the converter, corner [Hz], delay [s]."""

    loading: float
    corner_hz: float
    delay_s: float


def demodulator(netlist: Netlist) -> Demodulator:
    source = 2 * value(netlist, "R36")
    tau = value(netlist, "C26") * source * ADC_OHM / (source + ADC_OHM)
    return Demodulator(ADC_OHM / (ADC_OHM + source), 1 / (2 * math.pi * tau), tau)


def trigger_in_s(netlist: Netlist) -> float:
    """Return the time constant of trigger input 0, before its receiver."""
    return value(netlist, "R41") * value(netlist, "C33")


def filter_gain(hz: float, osr: int) -> float:
    """Return the gain of the converter's digital filter: sinc3, and above OSR 1024 the mean of several results."""
    first = min(osr, 1024)
    x = math.pi * hz * 2 * first / CONVERTER_HZ  # the modulator runs at half the clock frequency
    gain = abs(math.sin(x) / (first * math.sin(x / first))) ** 3 if x else 1.0
    n = osr // first
    if n > 1 and abs(math.sin(x)) > 1e-12:
        gain *= abs(math.sin(n * x) / (n * math.sin(x)))
    return gain


def ripple(osr: int, netlist: Netlist) -> float:
    """Return the ripple at twice the excitation that the converter passes, relative to the demodulated peak."""
    hz = 2 * EXCITATION_HZ
    return 2 / 3 / math.hypot(1, hz / demodulator(netlist).corner_hz) * filter_gain(hz, osr)
