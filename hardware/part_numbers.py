"""Part numbers decoded by their manufacturers' ordering codes, independently of hardware/parts.py.

A number that no code here describes and that no table lists is unknown: an error. The sources of the tables are data
sheets and published parts lists; "unverified" marks numbers and ratings that are from memory. No manufacturer's own
site could be reached.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

UNVERIFIED = "unverified"


@dataclass(frozen=True)
class Rating:
    """What a part number says. Units: Ω, F, V, A, W; 0 or "" where a kind has no such rating.

    ``value`` is the resistance, the capacitance, a fuse's holding current, a bead's impedance at 100 MHz, a TVS's
    stand-off voltage or a diode's reverse voltage. ``part`` names a part that has no value. ``watts`` is continuous on
    a board, ``amperes`` the continuous forward current, or the highest current that a fuse may interrupt; a
    tripped fuse holds its current at ``tripped_watts``.
    """

    kind: str
    package: str
    source: str
    value: float = 0.0
    part: str = ""
    tolerance: float = 0.0
    dielectric: str = ""
    volts: float = 0.0
    watts: float = 0.0
    amperes: float = 0.0
    trip: float = 0.0
    lowest_ohm: float = 0.0
    tripped_watts: float = 0.0


# significant digits of the series: a value outside them is not made
E24 = {10, 11, 12, 13, 15, 16, 18, 20, 22, 24, 27, 30, 33, 36, 39, 43, 47, 51, 56, 62, 68, 75, 82, 91}
E96 = {round(100 * 10 ** (k / 96)) for k in range(96)}


def _digits(code: str) -> float | None:
    """Return the ohms of a code: "1002" → 10000, "103" → 10000, "33R0" → 33. None if the value is not made."""
    if re.fullmatch(r"\d+R\d+", code):
        number = float(code.replace("R", "."))
        digits = code.replace("R", "")
    elif re.fullmatch(r"\d{3,4}", code):
        number = int(code[:-1]) * 10.0 ** int(code[-1])
        digits = code[:-1]
    else:
        return None
    digits = digits.lstrip("0").ljust(3, "0")[:3]
    made = int(digits) in E96 or (digits[2] == "0" and int(digits[:2]) in E24)
    return number if made else None


TOLERANCES = {"B": 0.001, "C": 0.0025, "D": 0.005, "F": 0.01, "G": 0.02, "J": 0.05, "K": 0.1, "M": 0.2}
# Panasonic's codes of size and type: package, W at 70 °C, limiting V
ERJ = {
    "2RK": ("0402", 0.1, 50),
    "3EK": ("0603", 0.1, 75),
    "6EN": ("0805", 0.125, 150),
    "8EN": ("1206", 0.25, 200),
    "P03": ("0603", 0.2, 150),
    "P06": ("0805", 0.5, 400),
    "P08": ("1206", 0.66, 500),
    "P14": ("1210", 0.5, 200),
}
ERA = {"2A": ("0402", 0.063, 50), "3A": ("0603", 0.1, 75), "6A": ("0805", 0.125, 100), "8A": ("1206", 0.25, 150)}


def _erj(number: str) -> Rating | None:
    match = re.fullmatch(r"ERJ-(\w{3})([DFJ])(\w{3,4})([VXU])", number)
    if not match or match[1] not in ERJ or len(match[3]) != (3 if match[2] == "J" else 4):
        return None
    ohm = _digits(match[3])
    package, watts, volts = ERJ[match[1]]
    source = "Panasonic, ERJ and ERJP data sheets: part number, power at 70 C"
    if ohm is None:
        return None
    return Rating("R", package, source, ohm, tolerance=TOLERANCES[match[2]], watts=watts, volts=volts)


def _era(number: str) -> Rating | None:
    match = re.fullmatch(r"ERA-(2A|3A|6A|8A)([EPRKH])([BCD])(\d{3,4})([VX])", number)
    ohm = _digits(match[4]) if match else None
    if match is None or ohm is None:
        return None
    if len(match[4]) == 4 and match[4][2] == "0" and int(match[4][:2]) in E24:  # E24 values have three digits
        return None
    package, watts, volts = ERA[match[1]]
    source = "Panasonic, ERA data sheet: part number; 0.125 W of 0805 is unverified"
    return Rating("R", package, source, ohm, tolerance=TOLERANCES[match[3]], watts=watts, volts=volts)


# wirewound, axial: package, W at 25 °C (characteristic U), highest ohms at 1 %
RS = {"RS01A": (1.0, 10.4e3), "RS02B": (3.0, 24.5e3), "RS005": (5.0, 95.2e3)}


def _rs(number: str) -> Rating | None:
    match = re.fullmatch(r"(RS\w{3})(\d[\dRK]{4})([DFJ])(E12|E70|E73)", number)
    if not match or match[1] not in RS or match[2].count("R") + match[2].count("K") != 1:
        return None
    ohm = float(re.sub("[RK]", ".", match[2])) * (1e3 if "K" in match[2] else 1)
    watts, most = RS[match[1]]
    source = "Vishay 30204: global part number, 3 W at 25 C; the value's stock is unverified"
    if not 0.1 <= ohm <= most:
        return None
    return Rating("R", f"axial {match[1]}", source, ohm, tolerance=TOLERANCES[match[3]], watts=watts, volts=1e3)


SIZES = {"15": "0402", "18": "0603", "21": "0805", "31": "1206", "32": "1210"}
# thicknesses that exist in a size
THICK = {"15": "5", "18": "8", "21": "69AB", "31": "9MC", "32": "9CDE"}
VOLTS = {"0J": 6.3, "1A": 10, "1C": 16, "1E": 25, "YA": 35, "1H": 50, "2A": 100, "2D": 200, "2E": 250}
DIELECTRICS = {"5C": "C0G", "R7": "X7R", "R6": "X5R", "C7": "X7S", "C8": "X6S"}
# highest capacitance [F] of GRM in size, dielectric at its voltage: what is beyond it is not made (unverified)
MOST = {("0805", "C0G"): 22e-9, ("1206", "C0G"): 100e-9, ("0805", "X7R"): 10e-6, ("1206", "X7R"): 10e-6}


def _grm(number: str) -> Rating | None:
    match = re.fullmatch(r"GRM(\d\d)(\w)(5C|R7|R6|C7|C8)(\w\w)(\d{3})([FGJKM])(\w\d\d)([LDKJ])", number)
    if not match or match[1] not in SIZES or match[2] not in THICK[match[1]] or match[4] not in VOLTS:
        return None
    farad = int(match[5][:2]) * 10.0 ** int(match[5][2]) * 1e-12
    package, dielectric = SIZES[match[1]], DIELECTRICS[match[3]]
    if farad > MOST.get((package, dielectric), 100e-6) * 1.001:
        return None
    return Rating(
        "C",
        package,
        "Murata, GRM part numbering" + ("; combination unverified" if number.startswith("GRM3195C2A103") else ""),
        farad,
        tolerance=TOLERANCES[match[6]],
        dielectric=dielectric,
        volts=VOLTS[match[4]],
    )


# Bourns: V, highest A, hold A, trip A, lowest Ω, W tripped, package
PTC = {
    "MF-MSMF010-2": (60, 40, 0.10, 0.30, 0.70, 0.8, "1812"),
    "MF-MSMF014-2": (60, 40, 0.14, 0.34, 0.40, 0.8, "1812"),
    "MF-MSMF020-2": (30, 80, 0.20, 0.40, 0.40, 0.8, "1812"),
    "MF-MSMF020/60-2": (60, 40, 0.20, 0.40, 0.40, 0.8, "1812"),
    "MF-MSMF030-2": (30, 10, 0.30, 0.60, 0.30, 0.8, "1812"),
    "MF-MSMF050-2": (15, 100, 0.50, 1.00, 0.15, 0.8, "1812"),
    "MF-SM030-2": (60, 40, 0.30, 0.60, 0.90, 1.7, "2920"),
    "MF-SM050-2": (60, 40, 0.50, 1.00, 0.35, 1.7, "2920"),
    "MF-SM075-2": (30, 80, 0.75, 1.50, 0.23, 1.7, "2920"),
    "MF-SM075/60-2": (60, 10, 0.75, 1.50, 0.23, 1.7, "2920"),
    "MF-SM100-2": (30, 80, 1.10, 2.20, 0.12, 1.7, "2920"),
}


def _ptc(number: str) -> Rating | None:
    if number not in PTC:
        return None
    volts, most, hold, trip, lowest, watts, package = PTC[number]
    source = "Bourns MF-MSMF and MF-SM data sheets, table of electrical characteristics"
    return Rating(
        "FUSE", package, source, hold, volts=volts, amperes=most, trip=trip, lowest_ohm=lowest, tripped_watts=watts
    )


STAND_OFF = {
    5,
    6,
    6.5,
    7,
    7.5,
    8,
    8.5,
    9,
    10,
    11,
    12,
    13,
    14,
    15,
    16,
    17,
    18,
    20,
    22,
    24,
    26,
    28,
    30,
    33,
    36,
    40,
    43,
    45,
}


def _smaj(number: str) -> Rating | None:
    match = re.fullmatch(r"SMAJ(\d+(?:\.\d)?)(A|CA)", number)
    if not match or float(match[1]) not in STAND_OFF or ("." in match[1]) != (float(match[1]) < 10):
        return None
    kind = "TVS" if match[2] == "A" else "TVS_BOTH"
    # 3.3 W is for a lead at 50 °C; 120 K/W to the air on the recommended pads, 50 to 125 °C
    source = "Littelfuse SMAJ data sheet: 400 W for 10/1000 us; continuous power from 120 K/W"
    return Rating(kind, "SMA", source, float(match[1]), watts=0.6, volts=float(match[1]))


SCHOTTKY = {"SS1": (1.0, "SMA"), "SS3": (3.0, "SMC")}


def _ss(number: str) -> Rating | None:
    match = re.fullmatch(r"(SS1|SS3)([2-689])", number)
    if not match:
        return None
    amperes, package = SCHOTTKY[match[1]]
    volts = 10.0 * int(match[2])
    source = f"onsemi {match[1]}x data sheet; {UNVERIFIED}"
    return Rating("DIODE", package, source, volts, part=number, volts=volts, amperes=amperes)


def _blm(number: str) -> Rating | None:
    match = re.fullmatch(r"BLM(15|18|21|31)(AG|PG|SP)(\d)(\d)(\d)SN1D", number)
    if not match:
        return None
    ohm = int(match[3] + match[4]) * 10.0 ** int(match[5])
    source = "Murata BLM21AG part numbering: 600 ohm at 100 MHz; 0.2 A (an older list) is taken"
    return Rating("BEAD", SIZES[match[1]], source, ohm, part=match[2], amperes=0.2)


def _phoenix(number: str) -> Rating | None:
    ways = {"1715721": 2, "1715734": 3, "1715747": 4, "1715750": 5, "1715763": 6, "1715776": 7, "1715789": 8}
    if number not in ways:
        return None
    part = f"MKDS 1,5/{ways[number]}-5,08"
    return Rating("TERMINAL", "5.08 mm", f"Phoenix Contact MKDS 1,5; {UNVERIFIED}", ways[number], part=part)


# chips and transistors: part, package, W (0: not checked), A; the numbers beside the fitted ones are what a slip would order
CHIPS: dict[str, tuple[str, str, float, float, str]] = {
    "SC0917": ("Raspberry Pi Pico H", "module", 0, 0, f"Raspberry Pi product list; {UNVERIFIED}"),
    "SC0918": ("Raspberry Pi Pico W", "module", 0, 0, f"Raspberry Pi product list; {UNVERIFIED}"),
    "SC0915": ("Raspberry Pi Pico", "module", 0, 0, f"Raspberry Pi product list; {UNVERIFIED}"),
    "LP5907MFX-3.3/NOPB": ("LP5907MFX-3.3", "SOT-23-5", 0, 0, "TI SNVS798; the number is in published parts lists"),
    "LP5907MFX-1.8/NOPB": ("LP5907MFX-1.8", "SOT-23-5", 0, 0, "TI SNVS798; the number is in published parts lists"),
    "LP5907MFX-3.0/NOPB": ("LP5907MFX-3.0", "SOT-23-5", 0, 0, "TI SNVS798; the number is in published parts lists"),
    "LP5907SNX-3.3/NOPB": ("LP5907SNX-3.3", "X2SON-4", 0, 0, "TI SNVS798; the number is in published parts lists"),
    "ADS131M04IPWR": ("ADS131M04", "TSSOP-20", 0, 0, "TI SBAS890; the number is in published parts lists"),
    "ADS131M04IRUKR": ("ADS131M04", "WQFN-20", 0, 0, "TI SBAS890; the number is in published parts lists"),
    "ADS131M02IPWR": ("ADS131M02", "TSSOP-20", 0, 0, f"TI ADS131M02; {UNVERIFIED}"),
    "OPA2388IDR": ("OPA2388", "SOIC-8", 0, 0, "TI SBOS777; the number is in published parts lists"),
    "OPA2388IDGKR": ("OPA2388", "VSSOP-8", 0, 0, "TI SBOS777; the number is in published parts lists"),
    "OPA388IDR": ("OPA388", "SOIC-8", 0, 0, "TI SBOS777; the number is in published parts lists"),
    "TS5A23159DGSR": ("TS5A23159", "VSSOP-10", 0, 0, "TI SCDS201; the number is in published parts lists"),
    "TS5A23159RSER": ("TS5A23159", "UQFN-10", 0, 0, "TI SCDS201; the number is in published parts lists"),
    "TS5A23157DGSR": ("TS5A23157", "VSSOP-10", 0, 0, f"TI TS5A23157; {UNVERIFIED}"),
    "LTC2863IS8-1#PBF": ("LTC2863-1", "SOIC-8", 0, 0, f"Analog Devices LTC2862-2865 order information; {UNVERIFIED}"),
    "LTC2863IS8-2#PBF": ("LTC2863-2", "SOIC-8", 0, 0, f"Analog Devices LTC2862-2865 order information; {UNVERIFIED}"),
    "LTC2862IS8-1#PBF": ("LTC2862-1", "SOIC-8", 0, 0, f"Analog Devices LTC2862-2865 order information; {UNVERIFIED}"),
    "ISO1211DR": ("ISO1211", "SOIC-8", 0, 0, "TI SLLSEY7; the number is in published parts lists"),
    "ISO1212DBQR": ("ISO1212", "SSOP-16", 0, 0, "TI SLLSEY7; the number is in published parts lists"),
    "VO615A-1": ("VO615A-1", "DIP-4", 0.1, 0, f"Vishay 81753, order information; {UNVERIFIED}"),
    "VO615A-3": ("VO615A-3", "DIP-4", 0.1, 0, f"Vishay 81753, order information; {UNVERIFIED}"),
    "VO615A-4": ("VO615A-4", "DIP-4", 0.1, 0, f"Vishay 81753, order information; {UNVERIFIED}"),
    # power with 1 cm² of copper at the collector
    "BCP56-16,115": ("BCP56-16", "SOT-223", 1.0, 1.0, f"Nexperia BCP56; power {UNVERIFIED}"),
    "BCP56-10,115": ("BCP56-10", "SOT-223", 1.0, 1.0, f"Nexperia BCP56; power {UNVERIFIED}"),
    "BCP53-16,115": ("BCP53-16", "SOT-223", 1.0, 1.0, f"Nexperia BCP53; power {UNVERIFIED}"),
    "BCP53-10,115": ("BCP53-10", "SOT-223", 1.0, 1.0, f"Nexperia BCP53; power {UNVERIFIED}"),
    "BC847C,215": ("BC847C", "SOT-23", 0.25, 0.1, "Nexperia BC847"),
    "BC847A,215": ("BC847A", "SOT-23", 0.25, 0.1, "Nexperia BC847"),
    "BC857C,215": ("BC857C", "SOT-23", 0.25, 0.1, "Nexperia BC857"),
    "BC857A,215": ("BC857A", "SOT-23", 0.25, 0.1, "Nexperia BC857"),
    "BAT54SLT1G": ("BAT54S", "SOT-23", 0.225, 0.2, "onsemi BAT54S"),
    "BAT54CLT1G": ("BAT54C", "SOT-23", 0.225, 0.2, "onsemi BAT54C"),
    "BAT54ALT1G": ("BAT54A", "SOT-23", 0.225, 0.2, "onsemi BAT54A"),
}


def _chip(number: str) -> Rating | None:
    if number not in CHIPS:
        return None
    part, package, watts, amperes, source = CHIPS[number]
    return Rating("CHIP", package, source, part=part, watts=watts, amperes=amperes)


DECODERS: tuple[Callable[[str], Rating | None], ...] = (
    _erj,
    _era,
    _rs,
    _grm,
    _ptc,
    _smaj,
    _ss,
    _blm,
    _phoenix,
    _chip,
)


@cache
def decode(number: str) -> Rating | None:
    """Return what a part number says; None if no ordering code and no table knows it."""
    return next((rating for decoder in DECODERS if (rating := decoder(number))), None)
