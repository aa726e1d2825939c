"""Voltages of a box that is switched on for the first time, with nothing connected but USB and 24 V.

docs/how-to/hardware.md prints the limits; the simulated box must lie within them.
"""

from __future__ import annotations

from dataclasses import dataclass

from hardware.kicad import Tools
from hardware.rows import Row
from hardware.spice import Circuit, run


@dataclass(frozen=True)
class Reading:
    """What a voltmeter against GND shows at a pin, and what it shows if a part is wrong. Limits in V."""

    ref: str
    pin: str  # a terminal's number, or a chip's pin by its name
    what: str
    low: float
    high: float
    otherwise: str


# AVDD 3.2 to 3.4 V, USB 4.75 to 5.25 V, supply 24 V; a meter of 10 MΩ takes a tenth of what is behind 1 MΩ
READINGS = (
    Reading("U2", "OUT", "AVDD", 3.20, 3.40, "L1, U2"),
    Reading("U1", "GP27", "a third of the 5 V", 1.55, 1.78, "R1, R2"),
    Reading("U4", "OUTB", "`MIDDLE`, half of AVDD", 1.58, 1.72, "R20, R21, U4"),
    Reading("J5", "3", "secondary, at `MIDDLE`", 1.40, 1.72, "R31, D17"),
    Reading("J5", "4", "centre, at `MIDDLE`", 1.58, 1.72, "R35, D21"),
    Reading("J5", "5", "secondary, at `MIDDLE`", 1.40, 1.72, "R33, D19"),
    Reading("J5", "1", "primary, without direct voltage", -0.05, 0.05, "C21, R27, D13"),
    Reading("J5", "2", "primary, without direct voltage", -0.05, 0.05, "C22, R30, D16"),
    Reading("U3", "AIN1P", "transducer 1, open", -0.02, 0.02, "R9, D7"),
    Reading("U3", "AIN2P", "transducer 2, open", -0.02, 0.02, "R15, D9"),
    Reading("U1", "GP3", "head unplugged: no stop", 3.20, 3.40, "U8"),
    Reading("J1", "1", "thermometers' supply", 4.50, 5.25, "Q3, Q4, D3"),
    Reading("J1", "2", "thermometers' data, idle", 3.20, 3.40, "R3, R51, D2"),
    Reading("J3", "4", "supply of transducer 1", 23.0, 24.0, "F5"),
    Reading("J4", "4", "supply of transducer 2", 23.0, 24.0, "F6"),
    Reading("J6", "1", "supply of the head", 23.0, 24.0, "D5, F3, F4"),
)


def check(tools: Tools, circuit: Circuit) -> list[Row]:
    """Return a row a reading, from the simulated box."""
    control = ["op"]
    for k, reading in enumerate(READINGS):
        control += [f"let reading{k} = v({circuit.node(reading.ref, reading.pin)})", f"print reading{k}"]
    got = run(tools, circuit, [f"Vsupply {circuit.node('J2', '1')} 0 24"], control)
    rows = []
    for k, reading in enumerate(READINGS):
        volt = got[f"reading{k}"]
        limits = f"{reading.low:.2f} to {reading.high:.2f}"
        # the simulated fuse and diode carry nothing: the supply's own voltage, with the digits of the simulation
        within = reading.low - 1e-3 <= volt <= reading.high + 1e-3
        rows.append(Row(f"switched on, {reading.ref}.{reading.pin}: V", f"{volt:.2f}", limits, within))
    return rows
