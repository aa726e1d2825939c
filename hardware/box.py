"""The box: every part, every pin, every net. This is the only description of the circuit.

docs/how-to/hardware.md explains its function and how to build it, docs/decisions/ the reasons. Positions are in grid
units of 2.54 mm.
"""

from __future__ import annotations

from hardware.parts import (
    ADS131M04,
    BAT54S,
    BEAD,
    DIODE,
    FUSE,
    ISO1211,
    LP5907,
    LTC2863,
    NPN_SOT23,
    NPN_SOT223,
    OPA2388,
    PICO,
    PNP_SOT23,
    PNP_SOT223,
    TERMINALS,
    TS5A23159,
    TVS,
    TVS_BOTH,
    VO615A,
    C,
    R,
)
from hardware.sheet import Sheet

# GPIO of the Pico → net. firmware/board_pico.py has the same pins; hardware/netlist_check.py checks that they match.
GPIO = {
    2: "HEAD_START",
    3: "HEAD_STOP",
    6: "TRIGGER_IN0",
    7: "TRIGGER_IN1",
    8: "TRIGGER_OUT",
    9: "THERMOMETER",
    10: "EXCITATION",
    12: "DEMODULATE_S",
    14: "DEMODULATE_P",
    16: "ADC_DOUT",
    17: "ADC_CS",
    18: "ADC_SCLK",
    19: "ADC_DIN",
    20: "ADC_DRDY",
    21: "ADC_RESET",
    22: "ADC_CLOCK",
    27: "RAIL_5V",
}


def terminals(ways: int) -> tuple:
    """Return kind and value of a row of screw terminals."""
    return TERMINALS[ways], f"MKDS 1,5/{ways}-5,08"


def sheets() -> list[Sheet]:
    """Return all sheets, in reading order."""
    return [pico(), power(), converter(), lvdt(), head(), triggers()]


def pico() -> Sheet:
    """Return the Pico, the divider for its 5 V, and the thermometers' wire."""
    s = Sheet("pico", "Raspberry Pi Pico, 5 V monitor, thermometers")
    nets: dict[str, str | None] = {pin.number: GPIO.get(int(pin.name[2:])) for pin in PICO.pins if pin.name[:2] == "GP"}
    nets |= {pin.number: "GND" for pin in PICO.pins if pin.name == "GND"}
    nets |= {"40": "VBUS", "39": None, "37": None, "36": "+3V3", "35": None, "30": None}
    s.add("U1", PICO, "Raspberry Pi Pico H", (40, 20), nets)
    s.add("R1", R, "20k", (80, 22), ("VBUS", "RAIL_5V"), down=True)
    s.add("R2", R, "10k", (80, 27), ("RAIL_5V", "GND"), down=True)
    s.add("C1", C, "100n", (85, 27), ("RAIL_5V", "GND"), down=True)
    s.via("RAIL_5V", (80, 26), (85, 26))
    s.note((78, 19), "5 V monitor: a third of VBUS")
    s.add("R56", R, "120R", (100, 27), ("+3V3", "GND"), down=True)
    s.note((100, 24), "takes what D1 and R3 let in at +30 V on J1.2")

    s.note((70, 54), "Thermometers: DS18B20, up to eight on one wire")
    s.add("D1", BAT54S, "BAT54S", (82, 57), {"1": "GND", "2": "+3V3", "3": "THERMOMETER"})
    s.add("R4", R, "220R", (90, 62), ("THERMOMETER", "DQ_CLAMPED"))
    s.via("THERMOMETER", (81, 62))
    s.add("R3", R, "4.7k", (95, 57), ("+3V3", "DQ_CLAMPED"), down=True)
    s.via("DQ_CLAMPED", (95, 62), (97, 62))
    s.add("D2", TVS, "SMAJ5.0A", (97, 65), ("DQ_CLAMPED", "GND"), down=True)
    s.add("R51", R, "499R 3W", (101, 62), ("DQ_CLAMPED", "DQ"))
    s.note((70, 72), "Their supply: 13 mA at most, however it is shorted; D3 blocks a higher voltage")
    s.add("R5", R, "47R", (70, 75), ("VBUS", "TV_SENSE"))
    s.add("Q4", PNP_SOT23, "BC857C", (78, 78), {"1": "TV_SENSE", "2": "VBUS", "3": "TV_BASE"})
    s.add(
        "Q3", PNP_SOT223, "BCP53-16", (88, 74), {"1": "TV_BASE", "3": "TV_SENSE", "2": "TV_LIMITED", "4": "TV_LIMITED"}
    )
    s.add("R52", R, "10k", (82, 84), ("TV_BASE", "GND"), down=True)
    s.add("D3", DIODE, "SS16", (96, 76), ("TV", "TV_LIMITED"), flip=True)
    s.add("D4", TVS_BOTH, "SMAJ33CA", (102, 79), ("TV", "GND"), down=True)
    s.add("C2", C, "100n", (109, 79), ("TV", "GND"), down=True)
    s.via("TV", (102, 76), (109, 76))
    s.add("J1", *terminals(3), (112, 66), {"1": "TV", "2": "DQ", "3": "GND"}, note="thermometers: supply, data, 0 V")
    return s


def power() -> Sheet:
    """Return the sensors' 24 V, the converter's clean 3.3 V, and the connection of the cable shields."""
    s = Sheet("power", "Sensor supply 24 V, analogue supply 3.3 V, screens")
    s.note((10, 12), "24 V for the sensors (head, transducers) from a supply of their own; its 0 V is the box's GND")
    s.add("J2", *terminals(3), (10, 18), {"1": "P24_IN", "2": "GND", "3": "CHASSIS"}, note="24 V in: +, 0 V, housing")
    s.add("F3", FUSE, "0.5A 60V", (20, 19), ("P24_IN", "P24_FUSED"))
    s.add("D5", DIODE, "SS36", (28, 19), ("+24V", "P24_FUSED"), flip=True)
    s.add("D6", TVS_BOTH, "SMAJ33CA", (36, 21), ("+24V", "GND"), down=True)
    s.add("C3", C, "10u 50V", (42, 21), ("+24V", "GND"), down=True)
    for k, (ref, net) in enumerate((("F4", "P24_HEAD"), ("F5", "P24_T1"), ("F6", "P24_T2"))):
        s.add(ref, FUSE, "0.2A 60V", (56, 18 + 5 * k), ("+24V", net))
    s.note((10, 38), "Analogue supply: nothing that reaches the converter or its front ends has more than this")
    s.add("L1", BEAD, "600R", (12, 43), ("VBUS", "LDO_IN"))
    s.add("U2", LP5907, "LP5907MFX-3.3", (30, 42), {"1": "LDO_IN", "3": "LDO_IN", "2": "GND", "5": "AVDD", "4": None})
    s.add("C4", C, "1u", (20, 45), ("LDO_IN", "GND"), down=True)
    s.via("LDO_IN", (20, 43))
    s.add("C5", C, "1u", (44, 45), ("AVDD", "GND"), down=True)
    s.note((10, 56), "Screens are on the housing; the housing is on GND for high frequencies only")
    s.add("R6", R, "1M", (14, 60), ("CHASSIS", "GND"), down=True)
    s.add("C6", C, "10n C0G 100V", (20, 60), ("CHASSIS", "GND"), down=True)
    return s


def converter() -> Sheet:
    """Return the converter and the inputs of the two transverse transducers."""
    s = Sheet("converter", "Converter ADS131M04, transverse transducers")
    nets: dict[str, str | None] = {"3": "A0P", "4": "A0N", "6": "A1P", "5": "A1N", "7": "A2P", "8": "A2N"}
    nets |= {"10": "A3P", "9": "A3N", "1": "AVDD", "2": "GND", "20": "+3V3", "19": "GND", "18": "ADC_CAP"}
    nets |= {"15": "ADC_DOUT", "12": "ADC_CS", "14": "ADC_SCLK", "16": "ADC_DIN", "13": "ADC_DRDY", "11": "ADC_RESET"}
    s.add("U3", ADS131M04, "ADS131M04", (100, 20), nets | {"17": "CLKIN"})
    s.add("R7", R, "33R", (118, 27), ("CLKIN", "ADC_CLOCK"), note="close to the Pico")
    s.add("C7", C, "220n", (120, 36), ("ADC_CAP", "GND"), down=True, note="close to pin 18")
    s.add("C8", C, "1u", (126, 36), ("+3V3", "GND"), down=True, note="close to pin 20")
    s.add("C9", C, "1u", (94, 36), ("AVDD", "GND"), down=True, note="close to pin 1")
    for k, y in ((1, 14), (2, 54)):
        transducer(s, k, y)
    return s


def transducer(s: Sheet, k: int, y: int) -> None:
    """Add the input of transverse transducer k: both wires through 10 kΩ over 499 Ω, so the converter survives ±30 V."""
    plus, minus, ap, an = f"T{k}P", f"T{k}N", f"A{k}P", f"A{k}N"
    first = 8 + 6 * (k - 1)  # references of resistors
    cap = 10 + 3 * (k - 1)
    s.note((8, y - 3), f"Transducer {k}: ±10 V or 0-10 V as drawn; for 4-20 mA fit R{first + 4}")
    nets = {"1": plus, "2": minus, "3": "GND", "4": f"P24_T{k}", "5": "CHASSIS"}
    s.add(f"J{2 + k}", *terminals(5), (10, y), nets, note=f"transducer {k}: signal +, signal -, 0 V, +24 V, screen")
    s.via(minus, (18, y + 2), (18, y + 18))
    s.add(f"D{5 + 2 * k}", TVS_BOTH, "SMAJ33CA", (24, y + 3), (plus, "GND"), down=True)
    s.via(plus, (24, y + 1), (30, y + 1))
    s.add(f"D{6 + 2 * k}", TVS_BOTH, "SMAJ33CA", (24, y + 20), (minus, "GND"), down=True)
    s.via(minus, (24, y + 18), (30, y + 18))
    loop = "499R 3W not fitted"
    s.add(f"R{first + 4}", R, loop, (30, y + 8), (plus, minus), down=True, note="fitted for 4-20 mA only")
    s.add(f"R{first}", R, "10k 0.1%", (36, y + 1), (plus, ap))
    s.add(f"R{first + 1}", R, "499R 0.1%", (44, y + 3), (ap, "GND"), down=True)
    s.via(ap, (44, y + 1), (50, y + 1), (56, y + 1))
    s.add(f"C{cap}", C, "1n C0G", (50, y + 3), (ap, "GND"), down=True)
    s.add(f"C{cap + 1}", C, "10n C0G", (56, y + 8), (ap, an), down=True)
    s.add(f"R{first + 2}", R, "10k 0.1%", (36, y + 18), (minus, an))
    s.add(f"R{first + 3}", R, "499R 0.1%", (44, y + 20), (an, "GND"), down=True)
    s.via(an, (44, y + 18), (50, y + 18), (56, y + 18))
    s.add(f"C{cap + 2}", C, "1n C0G", (50, y + 20), (an, "GND"), down=True)


def lvdt() -> Sheet:
    """Return the excitation of an LVDT's primary; synchronous demodulation of secondary voltage and primary current."""
    s = Sheet("lvdt", "LVDT: excitation 2543 Hz, synchronous demodulation of secondary voltage and primary current")
    s.note((6, 10), "Half of AVDD")
    s.add("R20", R, "10k", (8, 14), ("AVDD", "HALF"), down=True)
    s.add("R21", R, "10k", (8, 19), ("HALF", "GND"), down=True)
    s.add("C16", C, "1u", (13, 19), ("HALF", "GND"), down=True)
    s.via("HALF", (8, 18), (13, 18))
    s.note(
        (30, 18),
        "Excitation: a pole at 1 kHz and a resonance at 2.5 kHz make the Pico's square wave a sine of 1 V peak",
    )
    s.add("R22", R, "6.8k", (8, 30), ("EXCITATION", "EXC_1"))
    s.add("R55", R, "10k", (6, 32), ("EXCITATION", "GND"), down=True, note="without a Pico")
    s.add("C17", C, "22n C0G", (13, 32), ("EXC_1", "GND"), down=True)
    s.via("EXC_1", (13, 30))
    s.add("R23", R, "20k", (15, 30), ("EXC_1", "EXC_2"))
    s.via("EXC_2", (20, 30))
    s.add("C18", C, "10n C0G", (20, 26), ("EXC_OUT", "EXC_2"), down=True)
    s.add("R24", R, "20k", (22, 30), ("EXC_2", "EXC_3"))
    s.add("C19", C, "1n C0G", (27, 32), ("EXC_3", "GND"), down=True)
    s.via("EXC_3", (27, 30))
    amplifier = {"3": "EXC_3", "2": "EXC_OUT", "1": "EXC_OUT", "5": "HALF", "6": "MIDDLE", "7": "MIDDLE"}
    s.add("U4", OPA2388, "OPA2388", (37, 29), amplifier | {"8": "AVDD", "4": "GND"})
    s.add("C20", C, "100n", (30, 37), ("AVDD", "GND"), down=True, note="close to U4")
    s.add("R25", R, "22R", (46, 30), ("EXC_OUT", "EXC_4"))
    s.add("D11", BAT54S, "BAT54S", (53, 22), {"1": "GND", "2": "AVDD", "3": "EXC_4"})
    s.via("EXC_4", (52, 30))
    s.add("R26", R, "220R", (58, 30), ("EXC_4", "EXC_5"))
    s.add("D12", TVS, "SMAJ5.0A", (64, 32), ("EXC_5", "GND"), down=True)
    s.via("EXC_5", (64, 30))
    s.add("R49", R, "10R pulse", (67, 30), ("EXC_5", "EXC_6"))
    s.add("C21", C, "10u 50V", (71, 30), ("EXC_6", "LVDT_P1"))
    s.add("R27", R, "1M", (77, 32), ("LVDT_P1", "GND"), down=True)
    s.via("LVDT_P1", (77, 30))
    s.add("D13", TVS_BOTH, "SMAJ33CA", (82, 32), ("LVDT_P1", "GND"), down=True)
    s.via("LVDT_P1", (82, 30))

    s.note((6, 42), "Primary current: 220 Ω between the return and half of AVDD")
    s.add("R28", R, "220R 0.1%", (46, 50), ("MIDDLE", "CURRENT"))
    s.add("D14", BAT54S, "BAT54S", (53, 42), {"1": "GND", "2": "AVDD", "3": "CURRENT"})
    s.via("CURRENT", (52, 50))
    s.add("R29", R, "220R", (58, 50), ("CURRENT", "RET_1"))
    s.add("D15", TVS, "SMAJ5.0A", (64, 52), ("RET_1", "GND"), down=True)
    s.via("RET_1", (64, 50))
    s.add("R50", R, "10R pulse", (67, 50), ("RET_1", "RET_2"))
    s.add("C22", C, "10u 50V", (71, 50), ("RET_2", "LVDT_P2"))
    s.add("R30", R, "1M", (77, 52), ("LVDT_P2", "GND"), down=True)
    s.via("LVDT_P2", (77, 50))
    s.add("D16", TVS_BOTH, "SMAJ33CA", (82, 52), ("LVDT_P2", "GND"), down=True)
    s.via("LVDT_P2", (82, 50))

    nets = {"1": "LVDT_P1", "2": "LVDT_P2", "3": "LVDT_S1", "4": "LVDT_SC", "5": "LVDT_S2", "6": "CHASSIS"}
    s.add("J5", *terminals(6), (92, 29), nets, note="LVDT: primary, primary, secondary, centre, secondary, screen")

    s.note((6, 60), "Secondary")
    for k, y in ((1, 64), (2, 80)):
        wire, inner = f"LVDT_S{k}", f"SEC_{k}"
        s.add(f"D{15 + 2 * k}", TVS_BOTH, "SMAJ33CA", (8, y + 2), (wire, "GND"), down=True)
        s.add(f"R{29 + 2 * k}", R, "1M", (15, y + 2), (wire, "MIDDLE"), down=True)
        s.via(wire, (8, y), (15, y))
        s.add(f"R{30 + 2 * k}", R, "10k 0.1%", (19, y), (wire, inner))
        s.add(f"C{21 + 2 * k}", C, "100p C0G", (25, y + 2), (inner, "GND"), down=True)
        s.via(inner, (25, y))
        s.add(f"D{16 + 2 * k}", BAT54S, "BAT54S", (33, y + 3), {"1": "GND", "2": "AVDD", "3": inner})
        s.via(inner, (32, y))
    s.add("R35", R, "10k", (13, 92), ("LVDT_SC", "MIDDLE"))
    s.add("D21", TVS_BOTH, "SMAJ33CA", (11, 94), ("LVDT_SC", "GND"), down=True)
    s.via("LVDT_SC", (11, 92))
    buffers = {"3": "SEC_1", "2": "BUF_1", "1": "BUF_1", "5": "SEC_2", "6": "BUF_2", "7": "BUF_2"}
    s.add("U5", OPA2388, "OPA2388", (48, 64), buffers | {"8": "AVDD", "4": "GND"})
    s.add("C24", C, "100n", (60, 76), ("AVDD", "GND"), down=True, note="close to U5")

    s.note((90, 46), "Reversing switches: a square wave turns the signal's sign, the filter takes its mean")
    for k, clock in enumerate(("DEMODULATE_S", "DEMODULATE_P")):
        s.add(f"R{53 + k}", R, "10k", (98, 66 + 24 * k), (clock, "GND"), down=True, note="without a Pico")
    for ref, y, hot, cold, clock, channel, first in (
        ("U6", 52, "BUF_1", "BUF_2", "DEMODULATE_S", 0, 36),
        ("U7", 76, "CURRENT", "MIDDLE", "DEMODULATE_P", 3, 38),
    ):
        p, n = f"DEM{channel}P", f"DEM{channel}N"
        nets = {"9": cold, "2": hot, "7": hot, "4": cold, "1": clock, "5": clock, "3": "GND", "8": "AVDD"}
        s.add(ref, TS5A23159, "TS5A23159", (104, y), nets | {"10": p, "6": n})
        s.add(f"R{first}", R, "1k 0.1%", (116, y + 1), (p, f"A{channel}P"))
        s.add(f"R{first + 1}", R, "1k 0.1%", (116, y + 9), (n, f"A{channel}N"))
        s.via(n, (113, y + 3), (113, y + 9))
        s.add(f"C{first - 10}", C, "22n C0G", (124, y + 4), (f"A{channel}P", f"A{channel}N"), down=True)
        s.via(f"A{channel}P", (124, y + 1))
        s.via(f"A{channel}N", (124, y + 9))
        s.add(f"C{first - 9}", C, "100n", (108, y + 12), ("AVDD", "GND"), down=True, note=f"close to {ref}")
    return s


def head() -> Sheet:
    """Return the magnetostrictive head's interface: start pulse out, start/stop pulses in."""
    s = Sheet("head", "Magnetostrictive head, RS-422")
    nets = {"1": "+3V3", "2": "HEAD_STOP", "3": "HEAD_START", "4": "GND", "8": "HEAD_A", "7": "HEAD_B"}
    s.add("U8", LTC2863, "LTC2863-1", (40, 20), nets | {"6": "HEAD_Z", "5": "HEAD_Y"})
    s.add("C30", C, "100n", (30, 30), ("+3V3", "GND"), down=True, note="close to U8")
    s.add("C31", C, "10u 25V", (36, 30), ("+3V3", "GND"), down=True)
    s.note((52, 12), "Termination without direct current: a fault of 30 V between A and B does not burn it")
    s.add("R40", R, "120R", (56, 14), ("HEAD_A", "HEAD_TERM"), down=True)
    s.add("C32", C, "10n C0G 100V", (56, 18), ("HEAD_TERM", "HEAD_B"), down=True)
    nets = {"1": "P24_HEAD", "2": "GND", "3": "HEAD_Y", "4": "HEAD_Z", "5": "HEAD_A", "6": "HEAD_B", "7": "CHASSIS"}
    s.add("J6", *terminals(7), (76, 18), nets, note="head: +24 V, 0 V, INIT+, INIT-, START/STOP+, START/STOP-, screen")
    return s


def triggers() -> Sheet:
    """Return two isolated inputs and one floating output for the robot's 24 V signals. Nothing joins the two sides."""
    s = Sheet("triggers", "Triggers, isolated from everything else")
    for k, y in ((0, 16), (1, 40)):
        plus, minus, sense, inner = f"TI{k}_P", f"TI{k}_N", f"TI{k}_SENSE", f"TI{k}_IN"
        s.note(
            (8, y - 4), f"Trigger in {k}: IEC 61131-2 type 3; PNP: signal on 1, 0 V on 2; NPN: 24 V on 1, signal on 2"
        )
        s.add(f"J{7 + k}", *terminals(2), (10, y), {"1": plus, "2": minus}, note=f"trigger in {k}: +, -")
        s.via(minus, (15, y + 2), (15, y + 12), (20, y + 12), (34, y + 12))
        s.add(f"D{22 + k}", TVS_BOTH, "SMAJ33CA", (20, y + 5), (plus, minus), down=True)
        s.via(plus, (20, y + 1))
        s.add(f"R{41 + 2 * k}", R, "1k pulse", (24, y + 1), (plus, sense))
        s.add(f"C{33 + 2 * k}", C, "10n C0G 100V", (34, y + 6), (sense, minus), down=True)
        s.via(sense, (34, y + 1), (40, y + 1))
        s.add(f"R{42 + 2 * k}", R, "562R", (40, y + 3), (sense, inner), down=True)
        nets = {
            "8": sense,
            "7": inner,
            "5": None,
            "6": minus,
            "1": "+3V3",
            "2": "+3V3",
            "3": f"TRIGGER_IN{k}",
            "4": "GND",
        }
        s.add(f"U{9 + k}", ISO1211, "ISO1211", (50, y), nets)
        s.via(inner, (44, y + 6), (44, y + 2))
        s.via(inner, (40, y + 6))
        s.via(minus, (47, y + 12), (47, y + 4))
        s.add(f"C{34 + 2 * k}", C, "100n", (66, y + 3), ("+3V3", "GND"), down=True, note=f"close to U{9 + k}")
    s.note((8, 62), "Trigger out: conducts from 1 to 2 while TRIGGER_OUT is high, 20 mA at most")
    s.add("R45", R, "510R", (40, 71), ("TRIGGER_OUT", "OPTO_A"))
    s.add("U11", VO615A, "VO615A-3", (50, 70), {"1": "OPTO_A", "2": "GND", "4": "TO_OPTO_C", "3": "TO_BASE"})
    s.add("R46", R, "10k", (62, 68), ("TO_SWITCHED", "TO_OPTO_C"), down=True)
    s.via("TO_OPTO_C", (59, 71), (62, 71))
    s.add(
        "Q1",
        NPN_SOT223,
        "BCP56-16",
        (70, 74),
        {"1": "TO_BASE", "2": "TO_SWITCHED", "3": "TO_SENSE", "4": "TO_SWITCHED"},
    )
    s.add("Q2", NPN_SOT23, "BC847C", (70, 84), {"1": "TO_SENSE", "3": "TO_BASE", "2": "TO_N"})
    s.add("R47", R, "10k", (62, 86), ("TO_BASE", "TO_N"), down=True)
    s.add("R48", R, "33R", (82, 84), ("TO_SENSE", "TO_N"), down=True)
    s.add("D24", DIODE, "SS16", (84, 68), ("TO_SWITCHED", "TO_P"))
    s.add("D25", TVS_BOTH, "SMAJ33CA", (94, 74), ("TO_P", "TO_N"), down=True)
    s.add("J9", *terminals(2), (100, 70), {"1": "TO_P", "2": "TO_N"}, note="trigger out: +, -")
    return s
