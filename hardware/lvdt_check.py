"""The simulated box with LVDTs from all over the range that the document states (hardware/budget.py).

Each of them must meet the limits of the error budget and lie within the limits of the firmware's self-test.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path

from hardware import budget
from hardware.budget import Lvdt
from hardware.kicad import Tools
from hardware.netlist import Component, Netlist
from hardware.rows import Row, at_most, near
from hardware.spice import Circuit, run

PERIOD = 1 / budget.EXCITATION_HZ
# Delay of the demodulators' clocks relative to the excitation's, in periods. The primary's is a quarter of a period
# behind the secondary's, since the current lags the voltage that it induces: a change of the primary's resistance
# rotates both, and cancels. The common part is near the maximum for primaries of 300 Ω to 1 kΩ; at the ends of the range
# it keeps the effect of the harmonics small.
PHASE_S = 1 / 3
PHASE_P = 1 / 3 + 1 / 4
SETTLING = 20  # periods: 2.6 time constants of the coupling capacitors, which start almost charged
POSITIONS = (-1.0, -0.5, 0.0, 0.5, 1.0)
# Parts of the excitation's filter that vary together in a worst case (their effects have one sign), and the tolerances
# of capacitors and resistors. The groups vary independently: all corners are simulated. The effect of each part by itself
# was simulated too; that of C21 and C22 (±30 %), C23, C25, C26, C28 (±5 %), R20 and R28 (±1 %, ±0.1 %) is less than a fifth
# of the smallest of these on the primary, and less than 20 ppm on the ratio's change.
FILTER = (("C17", "R22"), ("C18", "R23", "R24"), ("C19",))
TOLERANCES = {"C": 0.05, "R": 0.01}
SELF_TEST = Path(__file__).resolve().parent.parent / "firmware" / "truearm_box" / "selftest.py"
MARGIN = 1.2  # between the excitation of an LVDT in the range and the self-test's limits


def jobs() -> Iterator[Callable[[Tools, Circuit], list[Row]]]:
    """Yield a check for each LVDT of the range, nominal and at every corner of the filter's tolerances."""
    for lvdt in budget.LVDTS:
        yield lambda tools, circuit, lvdt=lvdt: check(tools, circuit, lvdt)
        yield lambda tools, circuit, lvdt=lvdt: corners(tools, circuit, lvdt)


def self_test_limits() -> tuple[float, float]:
    """Return the lowest and highest voltage of the primary that the firmware's self-test accepts."""
    for node in ast.parse(SELF_TEST.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "LIMITS":
            unit, low, high = ast.literal_eval(node.value)["excitation"]
            if unit != "uV":
                raise ValueError(f"the self-test's excitation is in {unit}, not uV")
            return low * 1e-6, high * 1e-6
    raise ValueError(f"{SELF_TEST} has no LIMITS")


def clocks(circuit: Circuit, level: float) -> list[str]:
    """Return the Pico's three clocks as SPICE elements; ``level`` is the high level of the excitation."""
    exc, ds, dp = (circuit.node("U1", f"GP{n}") for n in (10, 12, 14))
    half = PERIOD / 2

    def pulse(high: float, delay: float) -> str:
        return f"PULSE(0 {high:g} {delay:.9g} 20n 20n {half - 20e-9:.9g} {PERIOD:.9g})"

    return [
        f"Vexc exc0 0 {pulse(level, 0)}",
        f"Vmean {exc} exc0 PWL(0 {level / 2:g} 1n 0)",  # the capacitors start at the mean
        f"Vds {ds} 0 {pulse(3.3, PHASE_S * PERIOD)}",
        f"Vdp {dp} 0 {pulse(3.3, PHASE_P * PERIOD)}",
    ]


def sensor(circuit: Circuit, lvdt: Lvdt, x: float, ohm: float) -> list[str]:
    """Return an LVDT at J5 as SPICE elements. Couplings are 0.5 ± 0.3 x, the secondaries are in opposition."""
    s1, s2, p1, p2 = (circuit.node("J5", n) for n in "3512")
    return [
        f"Rp {p1} lp1 {ohm:g}",
        f"Lp lp1 {p2} {lvdt.primary_h:g}",
        f"Rs1 {s1} ls1 {lvdt.secondary_ohm:g}",
        f"Ls1 ls1 mid {lvdt.secondary_h:g}",
        f"Ls2 lx mid {lvdt.secondary_h:g}",
        f"Rs2 lx {s2} {lvdt.secondary_ohm:g}",
        f"K1 Lp Ls1 {0.5 + 0.3 * x:g}",
        f"K2 Lp Ls2 {0.5 - 0.3 * x:g}",
    ]


def signals(
    tools: Tools, circuit: Circuit, lvdt: Lvdt, x: float, ohm: float, level: float = 3.3
) -> tuple[float, float, float]:
    """Return demodulated (secondary, primary) [V] and the excitation's peak [V] at core position x, -1 to 1.

    ``ohm`` is the resistance of primary and cable, ``level`` the high level of GP10.
    """
    out = circuit.node("U4", "OUTA")
    bench = [*clocks(circuit, level), *sensor(circuit, lvdt, x, ohm)]
    start = SETTLING * PERIOD
    end = (SETTLING + 4) * PERIOD
    a0, a3 = ([circuit.node("U3", f"AIN{k}{s}") for s in "PN"] for k in (0, 3))
    control = [
        f"tran {PERIOD / 120:.6g} {end:.9g} {start:.9g} {PERIOD / 120:.6g}",
        f"let s = v({a0[0]})-v({a0[1]})",
        f"let p = v({a3[0]})-v({a3[1]})",
        f"meas tran secondary avg s from={start:.9g} to={end:.9g}",
        f"meas tran primary avg p from={start:.9g} to={end:.9g}",
        f"meas tran swing pp v({out}) from={start:.9g} to={end:.9g}",
    ]
    got = run(tools, circuit, bench, control, whole=False)
    return got["secondary"], got["primary"], got["swing"] / 2


def ratio(tools: Tools, circuit: Circuit, lvdt: Lvdt, x: float, ohm: float, level: float = 3.3) -> float:
    secondary, primary, _ = signals(tools, circuit, lvdt, x, ohm, level)
    return secondary / primary


def check(tools: Tools, circuit: Circuit, lvdt: Lvdt) -> list[Row]:
    """Return the rows of one LVDT: signals, linearity, effect of excitation and of the primary's resistance."""
    line = []
    for x in POSITIONS:
        s, p, peak = signals(tools, circuit, lvdt, x, lvdt.primary_ohm)
        line.append(s / p)
    slope = sum(x * r for x, r in zip(POSITIONS, line, strict=True)) / sum(x * x for x in POSITIONS)
    mean = sum(line) / len(line)
    off = max(abs(r - mean - slope * x) for x, r in zip(POSITIONS, line, strict=True)) / abs(slope)
    changed = [ratio(tools, circuit, lvdt, 1.0, lvdt.primary_ohm, 3.3 * k) / line[-1] - 1 for k in (0.8, 1.2)]
    known = {lvdt.primary_ohm: line[-1]}
    cold, hot = (known[ohm] if ohm in known else ratio(tools, circuit, lvdt, 1.0, ohm) for ohm in (10.0, 60.0))
    low, high = self_test_limits()
    name = f"LVDT {lvdt.name}"
    return [
        near(f"{name}: secondary at full travel, V", s, lvdt.secondary_v, 0.02),
        near(f"{name}: primary, V", p, lvdt.primary_v, 0.02),
        Row(
            f"{name}: primary against the self-test's limits, V",
            f"{p:.4f}",
            f"{low * MARGIN:g} to {high / MARGIN:g}",
            low * MARGIN <= p <= high / MARGIN,
        ),
        Row(f"{name}: secondary within the converter's range, V", f"{abs(s):.4f}", "below 1.0", abs(s) < 1.0),
        Row(f"{name}: peak of EXC_OUT, V", f"{peak:.3f}", "0.9 to 1.5", 0.9 <= peak <= 1.5),
        at_most(f"{name}: ratio, largest deviation from a line", off, budget.RATIO_LINEARITY),
        at_most(f"{name}: ratio, excitation ±20 %", max(map(abs, changed)), budget.RATIO_PER_EXCITATION),
        at_most(f"{name}: ratio, primary 10 → 60 Ω", abs(hot / cold - 1), budget.RATIO_PER_50_OHM),
    ]


def corner(circuit: Circuit, signs: Sequence[int]) -> Circuit:
    """Return the box with each group of the filter's parts at an end of its tolerance."""
    parts = dict(circuit.netlist.components)
    for sign, refs in zip(signs, FILTER, strict=True):
        for ref in refs:
            changed = budget.value(circuit.netlist, ref) * (1 + sign * TOLERANCES[ref[0]])
            parts[ref] = Component(ref, f"{changed * 1e9:.9g}n" if ref[0] == "C" else f"{changed:.9g}", parts[ref].mpn)
    return Circuit(Netlist(parts, circuit.netlist.pins))


def corners(tools: Tools, circuit: Circuit, lvdt: Lvdt) -> list[Row]:
    """Return the worst of all corners: effect of the primary's resistance, lowest and highest primary and excitation."""
    changes, primaries, peaks = [], [], []
    for signs in product((-1, 1), repeat=len(FILTER)):
        box = corner(circuit, signs)
        cold, hot = (signals(tools, box, lvdt, 1.0, ohm) for ohm in (10.0, 60.0))
        changes.append(abs(hot[0] / hot[1] / (cold[0] / cold[1]) - 1))
        primaries += [cold[1], hot[1]]
        peaks += [cold[2], hot[2]]
    low, high = self_test_limits()
    name = f"LVDT {lvdt.name}, filter at the corners of its tolerances"
    within = low * MARGIN <= min(primaries) and max(primaries) <= high / MARGIN
    return [
        at_most(f"{name}: ratio, primary 10 → 60 Ω", max(changes), budget.RATIO_PER_50_OHM),
        Row(
            f"{name}: primary, V",
            f"{min(primaries):.4f} to {max(primaries):.4f}",
            f"{low * MARGIN:g} to {high / MARGIN:g}",
            within,
        ),
        Row(
            f"{name}: peak of EXC_OUT, V",
            f"{min(peaks):.3f} to {max(peaks):.3f}",
            "0.9 to 1.5",
            min(peaks) >= 0.9 and max(peaks) <= 1.5,
        ),
    ]
