"""The tables of docs/how-to/hardware.md that follow from the sources. Uses only the standard library."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from hardware import budget
from hardware.datasheets import data_sheet
from hardware.netlist import Netlist
from hardware.part_numbers import UNVERIFIED, decode
from hardware.parts import CATALOGUE
from hardware.power_up import READINGS
from hardware.sheet import Part, Sheet, netlist

REACHED = "2026-11; no distributor was reached"


def source_of(number: str) -> str:
    """Return the data sheet behind a part number, with the date; "unverified" is among its words if no copy was found."""
    rating = decode(number)
    return f"{rating.source if rating else UNVERIFIED}, {REACHED}"


def package_of(number: str) -> str:
    rating = decode(number)
    return rating.package if rating else UNVERIFIED


def blocks(made: list[Sheet]) -> dict[str, str]:
    """Return the text of every generated block of docs/how-to/hardware.md by name."""
    circuit = netlist(made)
    parts = [part for sheet in made for part in sheet.parts]
    return {
        "pins": pins(circuit),
        "terminals": terminals(parts),
        "parts": parts_table(parts),
        "drawings": "\n".join(f"![{sheet.title}](../images/hardware/{sheet.name}.svg)\n" for sheet in made),
        "inputs": inputs(circuit),
        "lvdt-range": lvdt_range(),
        "lvdt-budget": lvdt_budget(circuit),
        "transducer-budget": transducer_budget(circuit),
        "head-budget": head_budget(),
        "trigger-budget": trigger_budget(circuit),
        "power-up": power_up_table(circuit),
    }


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)])


def pins(circuit: Netlist) -> str:
    """Return every used pin of the Pico and its connection."""
    rows = []
    for number, net in sorted(circuit.pins_of("U1").items(), key=lambda item: int(item[0])):
        name = data_sheet("SC0917").pins[number]
        if name.startswith("GP"):
            others = [pin for pin, other in circuit.pins.items() if other == net and pin[0] != "U1"]
            chips = [f"{ref} {_function(circuit, ref, n)}" for ref, n in sorted(others) if ref[0] in "UJ"]
            rest = sorted({ref for ref, _ in others if ref[0] not in "UJ"})
            rows.append((name, number, net, ", ".join(chips) or f"through {', '.join(rest)}"))
    return table(("GPIO", "pin", "net", "to"), sorted(rows, key=lambda row: int(row[0][2:])))


def _function(circuit: Netlist, ref: str, number: str) -> str:
    sheet = data_sheet(circuit.components[ref].mpn)
    return sheet.pins[number] if sheet else number


def power_up_table(circuit: Netlist) -> str:
    """Return where to measure at the first power-up, what, and which parts to look at otherwise."""
    rows = []
    for reading in READINGS:
        sheet = data_sheet(circuit.components[reading.ref].mpn)
        number = next((n for n, name in sheet.pins.items() if name == reading.pin), "") if sheet else ""
        where = f"{reading.ref} pin {number} ({reading.pin})" if number else f"{reading.ref}.{reading.pin}"
        rows.append((where, reading.what, f"{reading.low:.2f} to {reading.high:.2f}", reading.otherwise))
    return table(("at", "what", "V", "otherwise look at"), rows)


def terminals(parts: list[Part]) -> str:
    """Return every row of terminals with the connection of each screw."""
    rows = []
    for part in sorted((p for p in parts if p.ref[0] == "J"), key=lambda p: int(p.ref[1:])):
        name, _, ways = part.note.partition(":")
        rows.append((part.ref, name, *[way.strip() for way in ways.split(",")]))
    most = max(len(row) for row in rows) - 2
    return table(("row", "for", *map(str, range(1, most + 1))), [(*row, *[""] * (most + 2 - len(row))) for row in rows])


def parts_table(parts: list[Part]) -> str:
    """Return the parts list, one row per part number."""
    rows: dict[tuple[str, str, bool], list[str]] = {}
    for part in parts:
        rows.setdefault((part.kind.name, part.value, part.fitted), []).append(part.ref)
    found = []
    for (kind, value, fitted), refs in sorted(
        rows.items(), key=lambda item: min((ref[0], int(ref[1:])) for ref in item[1])
    ):
        maker, number = CATALOGUE[kind, value]
        count = str(len(refs)) if fitted else "0"
        doubt = UNVERIFIED if UNVERIFIED in source_of(number) else ""
        where = " ".join(sorted(refs, key=lambda ref: int(ref[1:]))) + ("" if fitted else " (for 4-20 mA)")
        found.append((count, where, value, maker, number, package_of(number), doubt))
    return table(("quantity", "references", "value", "manufacturer", "part number", "package", ""), found)


def inputs(circuit: Netlist) -> str:
    """Return the scale of every input of the converter."""
    t, loop, d = budget.transducer(circuit), budget.loop_scale(circuit), budget.demodulator(circuit)
    low = budget.transducer(circuit, budget.ADC_OHM * (1 - budget.ADC_OHM_TOLERANCE)).scale / t.scale - 1
    return table(
        ("input", "signal", "at the converter", "gain to set", "corner", "delay"),
        [
            (
                "AIN0",
                "LVDT secondary, demodulated",
                f"{d.loading:.5f} of its mean",
                1,
                _hz(d.corner_hz),
                _us(d.delay_s),
            ),
            (
                "AIN1, AIN2",
                "±10 V, 0–10 V",
                f"{t.scale:.6f} V/V ({t.unloaded:.6f} unloaded)",
                2,
                _hz(t.corner_hz),
                _us(t.delay_s),
            ),
            ("AIN1, AIN2", "4–20 mA, R12, R18 fitted", f"{loop:.4f} V/A", 2, _hz(t.corner_hz), _us(t.delay_s)),
            (
                "AIN3",
                "LVDT primary current, demodulated",
                f"{d.loading:.5f} of its mean",
                1,
                _hz(d.corner_hz),
                _us(d.delay_s),
            ),
        ],
    ) + (
        f"\n\nThe scale includes the converter's input impedance of 330 kΩ. If this is {budget.ADC_OHM_TOLERANCE:.0%} lower, the scale of ±10 V "
        f"changes by {low:.3%}; `truearm box gauge` removes that. A transducer sees {t.ohm / 1e3:.1f} kΩ."
    )


def _hz(value: float) -> str:
    return f"{value / 1e3:.1f} kHz"


def _us(value: float) -> str:
    return f"{value * 1e6:.0f} µs"


def lvdt_range() -> str:
    """Return the LVDTs that the checks simulate: the range that the document states."""
    rows = [
        (
            f"{lvdt.primary_h * 1e3:g} mH, {lvdt.primary_ohm:g} Ω",
            f"{lvdt.primary_impedance:.0f} Ω",
            f"{lvdt.secondary_h * 1e3:g} mH, {lvdt.secondary_ohm:g} Ω",
            f"{lvdt.secondary_impedance:.0f} Ω",
            f"{lvdt.primary_v * 1e3:.0f} mV",
            f"{lvdt.secondary_v * 1e3:.0f} mV",
        )
        for lvdt in budget.LVDTS
    ]
    head = ("primary", "at 2543 Hz", "each secondary", "at 2543 Hz", "AIN3", "AIN0 at the travel's end")
    return table(head, rows)


# ---- error budgets. Sensor data without a data sheet are marked "assumed".

TRAVEL_M = 0.0375  # half the stroke of the LVDT
LVDT_PER_K = 100e-6  # assumed
STEEL_PER_K = 11.5e-6
BAR_M = 0.5  # assumed
RESISTOR_PER_K = 25e-6
COPPER_PER_K = 0.0039
SOUND_M_S = 0.0254 / 9.05e-6
TICK_S = 8e-9


def _rows(rows: Iterable[tuple[str, float, str]]) -> str:
    # To 1e-9 µm: what is left of a filter's null is rounding.
    return table(
        ("source", "µm", "how"),
        [(name, f"{float(f'{round(metre * 1e6, 9):.2g}'):g}", how) for name, metre, how in rows],
    )


def lvdt_budget(circuit: Netlist) -> str:
    worst = max(budget.LVDTS, key=lambda lvdt: 1 / lvdt.secondary_v**2 + 1 / lvdt.primary_v**2)
    noise = TRAVEL_M * math.hypot(budget.ADC_NOISE_V / worst.secondary_v, budget.ADC_NOISE_V / worst.primary_v)
    rows = [
        ("converter noise, one sample at OSR 4096", noise, f"{budget.ADC_NOISE_V * 1e6:.2f} µV in {worst.secondary_v:g} V and in {worst.primary_v:g} V, at the travel's end: the weakest LVDT of the range"),
        ("R28, per K", RESISTOR_PER_K * TRAVEL_M, "25 ppm/K at the travel's end"),
        ("LVDT's coefficient, per K", LVDT_PER_K * TRAVEL_M, "assumed 100 ppm/K; measure it"),
        ("steel bar, per K", STEEL_PER_K * BAR_M, f"11.5 ppm/K of {BAR_M:g} m"),
        ("LVDT's linearity ●", 0.0025 * 2 * TRAVEL_M, "0.25 % of the stroke, assumed"),
        ("primary's copper, per K", budget.RATIO_PER_50_OHM * TRAVEL_M * 40 * COPPER_PER_K / 50, f"40 Ω · 0.39 %/K; at most {budget.RATIO_PER_50_OHM:.2%} for 50 Ω (simulated over the range)"),
        ("box's linearity ●", budget.RATIO_LINEARITY * TRAVEL_M, f"at most {budget.RATIO_LINEARITY:.2%} of the travel (simulated over the range)"),
        ("excitation ±20 %", budget.RATIO_PER_EXCITATION * TRAVEL_M, f"at most {budget.RATIO_PER_EXCITATION:.2%} of the ratio (simulated over the range)"),
        ("ripple at OSR 4096", budget.ripple(4096, circuit) * TRAVEL_M, f"{2 * budget.EXCITATION_HZ:.2f} Hz is the fifth null of {budget.CONVERTER_HZ / 8192:.2f} Hz"),
        ("ripple at OSR 1024", budget.ripple(1024, circuit) * TRAVEL_M, "peak; no null there: use OSR 4096 for an LVDT"),
        ("filter's delay at 100 mm/s", 0.1 * budget.demodulator(circuit).delay_s, "constant, part of the delay τ; nothing in a dwell"),
    ]  # fmt: skip
    return _rows(rows)


def transducer_budget(circuit: Netlist) -> str:
    t = budget.transducer(circuit)
    per_volt = 0.015 / (20 * t.scale)
    wrong = abs(budget.transducer(circuit, budget.ADC_OHM * 0.8).scale / t.scale - 1)
    rows = [
        ("converter noise, one sample", budget.ADC_NOISE_V * per_volt, f"{budget.ADC_NOISE_V * 1e6:.2f} µV × {per_volt * 1e3:.1f} mm/V"),
        ("converter's input impedance ●", wrong * 0.0075, f"330 kΩ less {budget.ADC_OHM_TOLERANCE:.0%} (assumed), at the end of 15 mm"),
        ("divider's tolerance ●", 0.002 * 0.0075, "0.1 % each, worst case"),
        ("divider, per K", 2 * RESISTOR_PER_K * 0.0075, "25 ppm/K each, worst case"),
        ("filter's delay at 100 mm/s", 0.1 * t.delay_s, "constant"),
        ("the paper's device: its resolution", 0.6e-6, "15 mm range; the paper gives no linearity"),
    ]  # fmt: skip
    return _rows(rows)


def head_budget() -> str:
    tick = TICK_S * SOUND_M_S
    rows = [
        ("resolution of 8 ns, RMS", tick / math.sqrt(12), f"{tick * 1e6:.1f} µm per tick, uniform"),
        (
            "position of the start edge within a tick ●",
            tick / 2,
            "at most; constant for a head that answers after a constant time",
        ),
        ("1 ns of the receiver's jitter", 1e-9 * SOUND_M_S, "LTC2863-1: some ns"),
        ("Pico's crystal ●", 30e-6, "30 ppm of 1 m, constant"),
        ("velocity of sound, per K", 15e-6, "15 ppm/K of 1 m, assumed"),
        ("velocity of sound, head to head ●", 500e-6, "0.05 %: enter the gradient of the label"),
        ("stamp at 100 mm/s", 0.1e-6, "1 µs"),
    ]
    return _rows(rows)


def trigger_budget(circuit: Netlist) -> str:
    series, shunt = (circuit.components[ref].value.split()[0] for ref in ("R41", "C33"))
    late = f"time constant of {series} and {shunt}; constant, but different for each edge"
    return table(
        ("source", "µs", "how"),
        [
            ("edge stamp", 1, "hardware timer of 1 MHz"),
            ("trigger in", f"about {budget.trigger_in_s(circuit) * 1e6:.0f}", late),
            ("trigger out, on", budget.TRIGGER_ON_US, "simulated into 3 kΩ, coupler of 3 µs"),
            (
                "trigger out, off",
                budget.TRIGGER_OFF_US,
                "simulated into 3 kΩ; the robot's input filter comes on top",
            ),
        ],
    )
