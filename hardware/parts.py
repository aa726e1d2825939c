"""The kinds of part in the box: their symbols, their pins, their manufacturers' part numbers.

Pins are in drawing order, from top to bottom on their side. Types are KiCad's electrical types, which its electrical
rules check uses. hardware/datasheets.py has the same pins from the data sheets, written independently.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class PinShape:
    """One pin of a symbol: KiCad's electrical type, the side on which it is drawn and its row there."""

    number: str
    name: str
    type: str
    side: str  # "L" or "R"
    row: int


@dataclass(frozen=True)
class Kind:
    """A kind of part. ``width`` and rows are in grid units of 2.54 mm; ``glyph`` names a two-terminal drawing."""

    name: str
    pins: tuple[PinShape, ...]
    width: int = 6
    glyph: str = ""

    @property
    def rows(self) -> int:
        return max(pin.row for pin in self.pins) + 1


def _side(side: str, text: str) -> Iterator[PinShape]:
    """Yield the pins of one side from lines "number name type"; an empty line leaves a row free."""
    for row, line in enumerate(text.strip("\n").splitlines()):
        if line.strip():
            number, name, kind = line.split()
            yield PinShape(number, name, kind, side, row)


def chip(name: str, left: str, right: str, width: int = 6) -> Kind:
    """Return a rectangle with pins on two sides."""
    return Kind(name, (*_side("L", left), *_side("R", right)), width)


def two_terminals(name: str, first: str = "1", second: str = "2") -> Kind:
    """Return a part with two pins in a line: 1 left (or above), 2 right (or below)."""
    return Kind(name, (PinShape("1", first, "passive", "L", 0), PinShape("2", second, "passive", "R", 0)), 2, name)


def connector(ways: int) -> Kind:
    """Return a row of screw terminals."""
    return Kind(
        f"TERMINAL_{ways}", tuple(PinShape(str(i + 1), str(i + 1), "passive", "R", i) for i in range(ways)), width=2
    )


R, C, FUSE, BEAD = two_terminals("R"), two_terminals("C"), two_terminals("FUSE"), two_terminals("BEAD")
DIODE = two_terminals("DIODE", "K", "A")  # pin 1 is the cathode, as in KiCad's libraries
TVS = two_terminals("TVS", "K", "A")
TVS_BOTH = two_terminals("TVS_BOTH")
TERMINALS = {ways: connector(ways) for ways in (2, 3, 5, 6, 7)}

BAT54S = chip("BAT54S", "3 COM passive", "2 K passive\n\n1 A passive", 3)  # 1 to 3 and 3 to 2

LP5907 = chip("LP5907MFX-3.3", "1 IN power_in\n3 EN input\n2 GND power_in", "5 OUT power_out\n4 NC no_connect")
OPA2388 = chip(
    "OPA2388",
    "3 +A input\n2 -A input\n\n5 +B input\n6 -B input\n\n4 V- power_in",
    "1 OUTA output\n\n\n7 OUTB output\n\n\n8 V+ power_in",
)
TS5A23159 = chip(
    "TS5A23159",
    "9 NC1 passive\n2 NO1 passive\n7 NC2 passive\n4 NO2 passive\n1 IN1 input\n5 IN2 input\n3 GND power_in",
    "10 COM1 passive\n\n6 COM2 passive\n\n\n\n8 V+ power_in",
)
ADS131M04 = chip(
    "ADS131M04",
    """
3 AIN0P input
4 AIN0N input
6 AIN1P input
5 AIN1N input
7 AIN2P input
8 AIN2N input
10 AIN3P input
9 AIN3N input
1 AVDD power_in
2 AGND power_in
""",
    """
15 DOUT tri_state
12 CS input
14 SCLK input
16 DIN input
13 DRDY output
11 SYNC/RESET input
17 CLKIN input
18 CAP passive
20 DVDD power_in
19 DGND power_in
""",
    10,
)
LTC2863 = chip(
    "LTC2863-1",
    "1 VCC power_in\n2 RO output\n3 DI input\n4 GND power_in",
    "8 A input\n7 B input\n6 Z output\n5 Y output",
)
ISO1211 = chip(
    "ISO1211",
    "8 SENSE input\n7 IN input\n5 SUB passive\n6 FGND power_in",
    "1 VCC1 power_in\n2 EN input\n3 OUT tri_state\n4 GND1 power_in",
    8,
)
VO615A = chip("VO615A-3", "1 A passive\n2 K passive", "4 C passive\n3 E passive", 5)
NPN_SOT223 = chip("BCP56-16", "1 B input", "2 C passive\n3 E passive\n4 TAB passive", 3)
NPN_SOT23 = chip("BC847C", "1 B input", "3 C passive\n2 E passive", 3)
PNP_SOT223 = chip("BCP53-16", "1 B input", "3 E passive\n2 C passive\n4 TAB passive", 3)
PNP_SOT23 = chip("BC857C", "1 B input", "2 E passive\n3 C passive", 3)

_PICO_GROUNDS = ("8", "13", "18", "23", "28", "38")


def _pico() -> Kind:
    left = {
        1: 0,
        2: 1,
        4: 2,
        5: 3,
        6: 4,
        7: 5,
        9: 6,
        10: 7,
        11: 8,
        12: 9,
        14: 10,
        15: 11,
        16: 12,
        17: 13,
        19: 14,
        20: 15,
    }
    right = {21: 16, 22: 17, 24: 18, 25: 19, 26: 20, 27: 21, 29: 22, 31: 26, 32: 27, 34: 28}
    pins = [PinShape(str(pin), f"GP{gpio}", "bidirectional", "L", row) for row, (pin, gpio) in enumerate(left.items())]
    supplies = [("40", "VBUS", "power_out"), ("39", "VSYS", "power_in"), ("37", "3V3_EN", "input")]
    supplies += [("36", "3V3", "power_out"), ("35", "ADC_VREF", "power_in"), ("30", "RUN", "input")]
    pins += [PinShape(number, name, kind, "R", row) for row, (number, name, kind) in enumerate(supplies)]
    row = len(supplies)
    for pin, gpio in right.items():
        pins.append(PinShape(str(pin), f"GP{gpio}", "bidirectional", "R", row))
        row += 1
    pins.append(PinShape("3", "GND", "power_out", "R", row))
    pins += [PinShape(number, "GND", "passive", "R", row + 1 + k) for k, number in enumerate((*_PICO_GROUNDS, "33"))]
    return Kind("RASPBERRY_PI_PICO", tuple(pins), 12)


PICO = _pico()

# (kind, value) → manufacturer, part number. A resistor or capacitor without tolerance or dielectric in its value is 1 % or X7R.
CATALOGUE: dict[tuple[str, str], tuple[str, str]] = {
    ("R", "10R pulse"): ("Panasonic", "ERJ-P08F10R0V"),
    ("R", "22R"): ("Panasonic", "ERJ-6ENF22R0V"),
    ("R", "33R"): ("Panasonic", "ERJ-6ENF33R0V"),
    ("R", "47R"): ("Panasonic", "ERJ-6ENF47R0V"),
    ("R", "220R 0.1%"): ("Panasonic", "ERA-6AEB221V"),
    ("R", "120R"): ("Panasonic", "ERJ-6ENF1200V"),
    ("R", "220R"): ("Panasonic", "ERJ-6ENF2200V"),
    ("R", "499R 0.1%"): ("Panasonic", "ERA-6AEB4990V"),
    ("R", "499R 3W"): ("Vishay Dale", "RS02B499R0FE12"),
    ("R", "510R"): ("Panasonic", "ERJ-6ENF5100V"),
    ("R", "562R"): ("Panasonic", "ERJ-6ENF5620V"),
    ("R", "1k 0.1%"): ("Panasonic", "ERA-6AEB102V"),
    ("R", "1k pulse"): ("Panasonic", "ERJ-P08F1001V"),
    ("R", "4.7k"): ("Panasonic", "ERJ-6ENF4701V"),
    ("R", "6.8k"): ("Panasonic", "ERJ-6ENF6801V"),
    ("R", "10k"): ("Panasonic", "ERJ-6ENF1002V"),
    ("R", "10k 0.1%"): ("Panasonic", "ERA-6AEB103V"),
    ("R", "20k"): ("Panasonic", "ERJ-6ENF2002V"),
    ("R", "1M"): ("Panasonic", "ERJ-6ENF1004V"),
    ("C", "100p C0G"): ("Murata", "GRM2165C1H101JA01D"),
    ("C", "1n C0G"): ("Murata", "GRM2165C1H102JA01D"),
    ("C", "10n C0G"): ("Murata", "GRM2195C1H103JA01D"),
    ("C", "10n C0G 100V"): ("Murata", "GRM3195C2A103JA01D"),
    ("C", "22n C0G"): ("Murata", "GRM21B5C1H223JA01L"),
    ("C", "100n"): ("Murata", "GRM21BR71H104KA01L"),
    ("C", "220n"): ("Murata", "GRM21BR71H224KA01L"),
    ("C", "1u"): ("Murata", "GRM21BR71E105KA99L"),
    ("C", "10u 25V"): ("Murata", "GRM31CR71E106KA12L"),
    ("C", "10u 50V"): ("Murata", "GRM32ER71H106KA12L"),
    ("FUSE", "0.2A 60V"): ("Bourns", "MF-MSMF020/60-2"),
    ("FUSE", "0.5A 60V"): ("Bourns", "MF-SM050-2"),
    ("BEAD", "600R"): ("Murata", "BLM21AG601SN1D"),
    ("DIODE", "SS36"): ("onsemi", "SS36"),
    ("DIODE", "SS16"): ("onsemi", "SS16"),
    ("TVS", "SMAJ5.0A"): ("Littelfuse", "SMAJ5.0A"),
    ("TVS_BOTH", "SMAJ33CA"): ("Littelfuse", "SMAJ33CA"),
    ("BAT54S", "BAT54S"): ("onsemi", "BAT54SLT1G"),
    ("LP5907MFX-3.3", "LP5907MFX-3.3"): ("Texas Instruments", "LP5907MFX-3.3/NOPB"),
    ("OPA2388", "OPA2388"): ("Texas Instruments", "OPA2388IDR"),
    ("TS5A23159", "TS5A23159"): ("Texas Instruments", "TS5A23159DGSR"),
    ("ADS131M04", "ADS131M04"): ("Texas Instruments", "ADS131M04IPWR"),
    ("LTC2863-1", "LTC2863-1"): ("Analog Devices", "LTC2863IS8-1#PBF"),
    ("ISO1211", "ISO1211"): ("Texas Instruments", "ISO1211DR"),
    ("VO615A-3", "VO615A-3"): ("Vishay", "VO615A-3"),
    ("BCP56-16", "BCP56-16"): ("Nexperia", "BCP56-16,115"),
    ("BC847C", "BC847C"): ("Nexperia", "BC847C,215"),
    ("BCP53-16", "BCP53-16"): ("Nexperia", "BCP53-16,115"),
    ("BC857C", "BC857C"): ("Nexperia", "BC857C,215"),
    ("RASPBERRY_PI_PICO", "Raspberry Pi Pico H"): ("Raspberry Pi", "SC0917"),
    **{
        (f"TERMINAL_{ways}", f"MKDS 1,5/{ways}-5,08"): ("Phoenix Contact", number)
        for ways, number in {2: "1715721", 3: "1715734", 5: "1715750", 6: "1715763", 7: "1715776"}.items()
    },
}
