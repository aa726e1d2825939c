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
# For the simulated LVDT at full travel; hardware/spice_check.py compares them with the simulation.
SECONDARY_V, PRIMARY_V = 0.151, 0.140
RATIO_PER_50_OHM = 0.0003  # maximum change of the ratio by 50 Ω in the primary
RATIO_PER_EXCITATION = 0.00005  # maximum change by 20 % of excitation


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


def demodulator(netlist: Netlist, adc_ohm: float = ADC_OHM) -> Demodulator:
    source = 2 * value(netlist, "R36")
    tau = value(netlist, "C26") * source * adc_ohm / (source + adc_ohm)
    return Demodulator(adc_ohm / (adc_ohm + source), 1 / (2 * math.pi * tau), tau)


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
