"""The data sheets' information on pins, supplies and limits, for checks that are independent of the generator.

The pin tables come from KiCad 9's own symbol libraries where ``symbol`` names one (``make hardware-check`` compares
them again), and otherwise from the sources in ``source``. No manufacturer's site could be reached when this was
written. Compare with the data sheets before ordering the first board, starting with LTC2863, which has no symbol of its
own in KiCad's libraries.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache


@dataclass(frozen=True)
class DataSheet:
    """Pins by number; supply pins with the capacitance [F] that the data sheet requires and the ground to which it
    connects.

    ``limits``: pin → lowest and highest voltage relative to the part's ground; a string is a supply's pin to which the
    number after it is added. ``current``: current in A that an input's protection may carry beyond these limits (0:
    none).
    """

    pins: dict[str, str]
    source: str
    symbol: str = ""
    decoupling: tuple[tuple[str, str, float], ...] = ()
    ground: str = ""
    limits: dict[str, tuple[float, float | tuple[str, float]]] = field(default_factory=dict)
    current: float = 0.0


def pins(text: str) -> dict[str, str]:
    """ "1 AVDD, 2 AGND" → {"1": "AVDD", "2": "AGND"}."""
    return dict(item.split() for item in text.split(","))


_AIN = [f"AIN{channel}{side}" for channel in range(4) for side in "PN"]
_PICO = """
1 GP0, 2 GP1, 3 GND, 4 GP2, 5 GP3, 6 GP4, 7 GP5, 8 GND, 9 GP6, 10 GP7, 11 GP8, 12 GP9, 13 GND, 14 GP10, 15 GP11, 16 GP12,
17 GP13, 18 GND, 19 GP14, 20 GP15, 21 GP16, 22 GP17, 23 GND, 24 GP18, 25 GP19, 26 GP20, 27 GP21, 28 GND, 29 GP22, 30 RUN,
31 GP26, 32 GP27, 33 AGND, 34 GP28, 35 ADC_VREF, 36 3V3, 37 3V3_EN, 38 GND, 39 VSYS, 40 VBUS
"""

# start of the part number → data sheet
DATA_SHEETS = {
    "SC0917": DataSheet(
        pins(_PICO),
        "Raspberry Pi Pico datasheet, pinout; RP2040 datasheet 5.5.3: -0.5 V to IOVDD + 0.5 V at a pin",
        "MCU_Module:RaspberryPi_Pico",
        ground="GND",
        limits={f"GP{n}": (-0.5, ("3V3", 0.5)) for n in range(29)},
    ),
    "ADS131M04": DataSheet(
        pins(
            "1 AVDD, 2 AGND, 3 AIN0P, 4 AIN0N, 5 AIN1N, 6 AIN1P, 7 AIN2P, 8 AIN2N, 9 AIN3N, 10 AIN3P, 11 SYNC/RESET, 12 CS, "
            "13 DRDY, 14 SCLK, 15 DOUT, 16 DIN, 17 CLKIN, 18 CAP, 19 DGND, 20 DVDD"
        ),
        "SBAS890 / SBASA13 pin functions: CAP 220 nF to DGND, AVDD and DVDD 1 uF each; absolute maximum -1.6 V to AVDD + 0.3 V "
        "at an input (from memory, as is 10 mA)",
        "Analog_ADC:ADS131M04xPW",
        decoupling=(("AVDD", "AGND", 1e-6), ("DVDD", "DGND", 1e-6), ("CAP", "DGND", 220e-9)),
        ground="AGND",
        limits={"AVDD": (-0.3, 3.9), **dict.fromkeys(_AIN, (-1.6, ("AVDD", 0.3)))},
        current=0.01,
    ),
    "LP5907MFX-3.3": DataSheet(
        pins("1 IN, 2 GND, 3 EN, 4 NC, 5 OUT"),
        "SNVS798: 1 uF at IN and at OUT; IN -0.3 V to 6 V",
        "Regulator_Linear:LP5907MFX-3.3",
        decoupling=(("IN", "GND", 1e-6), ("OUT", "GND", 1e-6)),
        ground="GND",
        limits={"IN": (-0.3, 6.0), "EN": (-0.3, 6.0)},
    ),
    "OPA2388": DataSheet(
        pins("1 OUTA, 2 -A, 3 +A, 4 V-, 5 +B, 6 -B, 7 OUTB, 8 V+"),
        "SBOS777: 2.5 to 5.5 V, rail to rail in and out; inputs -0.5 V to V+ + 0.5 V or 10 mA (the usual dual pinout)",
        "Amplifier_Operational:OPA2376xxD",
        decoupling=(("V+", "V-", 100e-9),),
        ground="V-",
        limits=dict.fromkeys(("+A", "-A", "+B", "-B", "OUTA", "OUTB"), (-0.5, ("V+", 0.5))),
        current=0.01,
    ),
    "TS5A23159": DataSheet(
        pins("1 IN1, 2 NO1, 3 GND, 4 NO2, 5 IN2, 6 COM2, 7 NC2, 8 V+, 9 NC1, 10 COM1"),
        "SCDS201 (DGS package; the same as TS5A623157's, SCDS253); COM to NC while IN is low, to NO while it is high; 1 ohm",
        "Analog_Switch:TS5A23159DGS",
        decoupling=(("V+", "GND", 100e-9),),
        ground="GND",
        limits=dict.fromkeys(("NO1", "NC1", "COM1", "NO2", "NC2", "COM2"), (-0.5, ("V+", 0.5))),
        current=0.01,
    ),
    "LTC2863": DataSheet(
        pins("1 VCC, 2 RO, 3 DI, 4 GND, 5 Y, 6 Z, 7 B, 8 A"),
        "LTC2862-2865 data sheet, first page: 3 to 5.5 V, 20 Mbps, +-60 V at the line pins also without supply, +-15 kV, receiver "
        "high when open, shorted or idle (for longer than some us); S8 pinout from memory (as MAX3490's and LTC2851's)",
        "Interface_UART:MAX3490xSA",
        decoupling=(("VCC", "GND", 100e-9),),
        ground="GND",
        limits=dict.fromkeys("ABYZ", (-60.0, 60.0)),
    ),
    "ISO1211": DataSheet(
        pins("1 VCC1, 2 EN, 3 OUT, 4 GND1, 5 SUB, 6 FGND, 7 IN, 8 SENSE"),
        "SLLSEY7: RSENSE 562 ohm, RTHR 1 kohm (type 3), 10 nF; SUB stays open; SENSE and IN +-60 V",
        "Isolator:ISO1211",
        decoupling=(("VCC1", "GND1", 100e-9),),
        ground="FGND",
        limits={"SENSE": (-60.0, 60.0), "IN": (-60.0, 60.0)},
    ),
    "VO615A": DataSheet(
        pins("1 A, 2 K, 3 E, 4 C"),
        "Vishay 81753: collector-emitter 70 V, emitter-collector 7 V, LED 60 mA",
        "Isolator:VO615A-3",
        ground="E",
        limits={"C": (-7.0, 70.0)},
    ),
    "BCP56": DataSheet(
        pins("1 B, 2 C, 3 E, 4 C"),
        "Nexperia BCP56: 80 V, 1 A (SOT-223)",
        "Transistor_BJT:BCP56",
        ground="E",
        limits={"C": (-5.0, 80.0)},
    ),
    "BC847": DataSheet(
        pins("1 B, 2 E, 3 C"),
        "Nexperia BC847: 45 V (SOT-23)",
        "Transistor_BJT:BC847",
        ground="E",
        limits={"C": (-5.0, 45.0)},
    ),
    # the supply of the thermometers ends at +-30 V: limits of a PNP are those of its collector
    "BCP53": DataSheet(
        pins("1 B, 2 C, 3 E, 4 C"),
        "Nexperia BCP53: 80 V, 1 A (SOT-223)",
        "Transistor_BJT:BCP53",
        ground="E",
        limits={"C": (-80.0, 5.0)},
    ),
    "BC857": DataSheet(
        pins("1 B, 2 E, 3 C"),
        "Nexperia BC857: 45 V (SOT-23)",
        "Transistor_BJT:BC857",
        ground="E",
        limits={"C": (-45.0, 5.0)},
    ),
    "BAT54S": DataSheet(
        pins("1 A1, 2 K2, 3 MID"), "two diodes in series, 30 V, 200 mA: 1 to 3 and 3 to 2", "Diode:BAT54S"
    ),
}


@cache
def data_sheet(mpn: str) -> DataSheet | None:
    """Return the data sheet of a part number; None without a pin table: two terminals and rows of terminals."""
    return next((sheet for begin, sheet in DATA_SHEETS.items() if mpn.startswith(begin)), None)
