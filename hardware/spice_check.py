"""Requirements for the simulated box: scales, corners, faults, LVDT, triggers, RS-422.

Returns rows (what, measured, wanted, passed).
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from hardware import budget
from hardware.kicad import Tools
from hardware.netlist import Netlist
from hardware.spice import Circuit, limited_nodes, run, within_limits

PERIOD = 1 / budget.EXCITATION_HZ
# Delay of the demodulators' clocks relative to the excitation's, in periods. The primary's is a quarter of a period
# behind the secondary's, since the current lags the voltage that it induces: a change of the primary's resistance
# rotates both, and cancels.
PHASE_S = 0.25
PHASE_P = 0.50
FAULT_V = 30.0


@dataclass(frozen=True)
class Row:
    """One check."""

    what: str
    measured: str
    wanted: str
    passed: bool


def check(tools: Tools, netlist: Netlist) -> list[Row]:
    """Run all checks, two simulations at a time."""
    circuit = Circuit(netlist)
    with ThreadPoolExecutor(2) as pool:
        jobs = [
            pool.submit(job, tools, circuit)
            for job in (lvdt, transducers, triggers_in, trigger_out, receiver, *faults(netlist))
        ]
        return [row for job in jobs for row in job.result()]


# ---- transducers


def transducers(tools: Tools, circuit: Circuit) -> list[Row]:
    wanted = budget.transducer(circuit.netlist)
    rows = []
    for k in (1, 2):
        p, n, ap, an = (
            circuit.node(*pin)
            for pin in ((f"J{2 + k}", "1"), (f"J{2 + k}", "2"), ("U3", f"AIN{k}P"), ("U3", f"AIN{k}N"))
        )
        bench = [f"Vin {p} {n} DC 10 AC 1", f"Vn {n} 0 0"]
        got = run(
            tools, circuit, bench,
            ["op", f"let scale = (v({ap})-v({an}))/10", "print scale", "ac dec 200 1 1meg",
             f"let h = v({ap})-v({an})", "let level = db(h)-db(h[0])", "meas ac corner when level=-3.0103 fall=1",
             "let lag = -cph(h)/(2*pi*frequency)", "meas ac delay find lag at=100"],
        )  # fmt: skip
        rows += [
            _near(f"transducer {k}: volts at the converter a volt", got["scale"], wanted.scale, 1e-3),
            _near(f"transducer {k}: -3 dB, Hz", got["corner"], wanted.corner_hz, 0.02),
            _near(f"transducer {k}: delay, us", got["delay"] * 1e6, wanted.delay_s * 1e6, 0.02),
        ]
    loop = Circuit(circuit.netlist, frozenset({"R12"}))
    p, n, ap, an = (loop.node(*pin) for pin in (("J3", "1"), ("J3", "2"), ("U3", "AIN1P"), ("U3", "AIN1N")))
    got = run(
        tools, loop, [f"Iin 0 {p} 20m", f"Vn {n} 0 0"], ["op", f"let scale = (v({ap})-v({an}))/20m", "print scale"]
    )
    return [
        *rows,
        _near("4-20 mA: volts at the converter an ampere", got["scale"], budget.loop_scale(circuit.netlist), 1e-3),
    ]


def _near(what: str, measured: float, wanted: float, tolerance: float) -> Row:
    ok = abs(measured / wanted - 1) <= tolerance
    return Row(what, f"{measured:.6g}", f"{wanted:.6g} ± {tolerance:.1%}", ok)


# ---- LVDT


def lvdt_ratio(
    tools: Tools, circuit: Circuit, cases: list[tuple[float, float, float]], phase: float = PHASE_S, lead_s: float = 0.0
) -> list[tuple[float, float]]:
    """Return demodulated (secondary, primary) [V] for cases of core position -1..1, excitation high level, primary's
    ohms.

    The LVDT: 20 mH primary, secondaries of 30 mH, couplings 0.5 ± 0.3 x, their wires 150 Ω each, secondaries in
    opposition.
    """
    found = []
    for x, high, ohm in cases:
        s1, s2, p1, p2 = (circuit.node("J5", n) for n in "3512")
        exc, ds, dp = (circuit.node("U1", f"GP{n}") for n in (10, 12, 14))
        half = PERIOD / 2

        def pulse(level: float, delay: float) -> str:
            return f"PULSE(0 {level:g} {delay:.9g} 20n 20n {half - 20e-9:.9g} {PERIOD:.9g})"  # noqa: B023

        bench = [
            f"Vexc exc0 0 {pulse(high, 0)}",
            f"Vmean {exc} exc0 PWL(0 {high / 2:g} 1n 0)",  # the capacitors start at the mean
            f"Vds {ds} 0 {pulse(3.3, phase * PERIOD)}",
            f"Vdp {dp} 0 {pulse(3.3, (phase + PHASE_P - PHASE_S) * PERIOD)}",
            f"Rp {p1} lp1 {ohm:g}",
            f"Lp lp1 {p2} 20m",
            f"Rs1 {s1} ls1 150",
            "Ls1 ls1 mid 30m",
            "Ls2 lx mid 30m",
            f"Rs2 lx {s2} 150",
            f"K1 Lp Ls1 {0.5 + 0.3 * x:g}",
            f"K2 Lp Ls2 {0.5 - 0.3 * x:g}",
        ]
        start = SETTLING * PERIOD
        end = (SETTLING + 4) * PERIOD
        a0, a3 = ([circuit.node("U3", f"AIN{k}{s}") for s in "PN"] for k in (0, 3))
        control = [
            f"tran {PERIOD / 120:.6g} {end:.9g} {start:.9g} {PERIOD / 120:.6g}",
            f"let s = v({a0[0]})-v({a0[1]})",
            f"let p = v({a3[0]})-v({a3[1]})",
            f"meas tran secondary avg s from={start:.9g} to={end:.9g}",
            f"meas tran primary avg p from={start:.9g} to={end:.9g}",
        ]
        got = run(tools, circuit, bench, control)
        found.append((got["secondary"], got["primary"]))
    return found


SETTLING = 20  # periods: 2.6 time constants of the coupling capacitors, which start almost charged
POSITIONS = (-1.0, -0.5, 0.0, 0.5, 1.0)


def lvdt(tools: Tools, circuit: Circuit) -> list[Row]:
    cases = [(x, 3.3, 40.0) for x in POSITIONS]
    cases += [(1.0, 3.3 * 0.8, 40.0), (1.0, 3.3 * 1.2, 40.0), (1.0, 3.3, 10.0), (1.0, 3.3, 60.0)]
    signals = lvdt_ratio(tools, circuit, cases)
    ratios = [s / p for s, p in signals]
    line = ratios[: len(POSITIONS)]
    slope = sum(x * r for x, r in zip(POSITIONS, line, strict=True)) / sum(x * x for x in POSITIONS)
    mean = sum(line) / len(line)
    off = max(abs(r - mean - slope * x) for x, r in zip(POSITIONS, line, strict=True)) / abs(slope)
    full = ratios[len(POSITIONS) - 1]
    low, high, cold, hot = ratios[len(POSITIONS) :]
    excitation = max(abs(low / full - 1), abs(high / full - 1))
    resistance = abs(hot / cold - 1)
    signal = abs(signals[-1][0] / signals[-2][0] - 1)
    s, p = signals[len(POSITIONS) - 1]
    return [
        _near("LVDT: secondary at full travel, V", s, budget.SECONDARY_V, 0.02),
        _near("LVDT: primary, V", p, budget.PRIMARY_V, 0.02),
        Row("LVDT: ratio, largest deviation from a line", f"{off:.4%}", "0.05 %", off <= 5e-4),
        Row(
            "LVDT: ratio, excitation ±20 %",
            f"{excitation:.4%}",
            f"{budget.RATIO_PER_EXCITATION:.3%}",
            excitation <= budget.RATIO_PER_EXCITATION,
        ),
        Row(
            f"LVDT: ratio, primary 10 → 60 Ω (its signal: {signal:.1%})",
            f"{resistance:.4%}",
            f"{budget.RATIO_PER_50_OHM:.3%}",
            resistance <= budget.RATIO_PER_50_OHM,
        ),
    ]


# ---- faults


FAULT_TERMINALS = {
    "J1": "12",
    "J2": "1",
    "J3": "124",
    "J4": "124",
    "J5": "12345",
    "J6": "13456",
}


def faults(netlist: Netlist) -> Iterator:
    for ref, ways in FAULT_TERMINALS.items():
        for way in ways:
            for volt in (FAULT_V, -FAULT_V):
                yield lambda tools, circuit, ref=ref, way=way, volt=volt: [fault(tools, circuit, ref, way, volt)]


def fault(tools: Tools, circuit: Circuit, ref: str, way: str, volt: float) -> Row:
    """Step a terminal to ±30 V relative to the box's ground, and check every chip's pins in the first 50 ms."""
    nodes = limited_nodes(circuit)
    supplies = {circuit.node("U3", "AVDD"): 3.3, circuit.node("U1", "3V3"): 3.3}
    bench = [f"Vfault {circuit.node(ref, way)} 0 PWL(0 0 10u 0 11u {volt:g} 1 {volt:g})"]
    control = ["tran 20u 50m 0 200u"]
    for k, node in enumerate(nodes):
        control += [f"meas tran max{k} max v({node})", f"meas tran min{k} min v({node})"]
    got = run(tools, circuit, bench, control)
    found = set()
    for name in ("max", "min"):
        values = {node: got[f"{name}{k}"] for k, node in enumerate(nodes)}
        found |= set(within_limits(circuit, values, supplies))
    what = f"{volt:+.0f} V on {ref}.{way}"
    return Row(what, "; ".join(sorted(found)) or "within absolute maximum", "within absolute maximum", not found)


# ---- triggers


def triggers_in(tools: Tools, circuit: Circuit) -> list[Row]:
    """Check the inputs at 0 to 30 V in either direction.

    The receiver is certainly on above a sense voltage of 8.55 V and certainly off below 6.5 V.
    """
    rows = []
    for ref, chip in (("J7", "U9"), ("J8", "U10")):
        for name in ("PNP", "NPN"):
            for volt in (-30, 0, 5, 11, 15, 30) if name == "PNP" else (0, 5, 11, 15, 30):
                supply = max(24, volt)
                plus, minus = (volt, 0) if name == "PNP" else (supply, supply - volt)
                bench = [f"Vp {circuit.node(ref, '1')} 0 {plus}", f"Vn {circuit.node(ref, '2')} 0 {minus}"]
                sense, ground = circuit.node(chip, "SENSE"), circuit.node(chip, "FGND")
                got = run(
                    tools,
                    circuit,
                    bench,
                    ["op", f"let sense = v({sense})-v({ground})", "let amps = -i(vp)", "print sense amps"],
                )
                on = got["sense"] > 8.55
                off = got["sense"] < 6.5
                good = (on if volt >= 11 else off) and abs(got["amps"]) < 5e-3 and abs(got["sense"]) < 60
                rows.append(
                    Row(
                        f"trigger in {ref}, {name}, {volt} V",
                        f"{'on' if on else 'off' if off else '?'}, {got['sense']:.2f} V, {got['amps'] * 1e3:.2f} mA",
                        "on" if volt >= 11 else "off",
                        good,
                    )
                )
    return rows


def trigger_out(tools: Tools, circuit: Circuit) -> list[Row]:
    rows = []
    plus, minus, drive = circuit.node("J9", "1"), circuit.node("J9", "2"), circuit.node("U1", "GP8")
    pulse = f"Vd {drive} 0 PULSE(0 3.2 1m 1u 1u 10m 50m)"
    for name, bench, node, on_above in (
        ("PNP", [f"V24 {plus} 0 24", f"Rl {minus} 0 3k"], minus, True),
        ("NPN", ["V24 v24 0 24", f"Rl v24 {plus} 3k", f"Vz {minus} 0 0"], plus, False),
    ):
        got = run(
            tools, circuit, [pulse, *bench],
            ["tran 2u 25m 0 5u", f"meas tran off find v({node}) at=0.9m", f"meas tran on find v({node}) at=10m",
             f"meas tran rise when v({node})=11 cross=1", f"meas tran fall when v({node})=11 cross=2"],
        )  # fmt: skip
        on, off = (got["on"], got["off"]) if on_above else (24 - got["on"], 24 - got["off"])
        delays = (got["rise"] - 1e-3) * 1e6, (got["fall"] - 11.002e-3) * 1e6
        rows.append(
            Row(
                f"trigger out, {name}, 3 kΩ: volts on and off",
                f"{on:.2f}, {off:.3f}",
                "above 15, below 1",
                on > 15 and off < 1,
            )
        )
        rows.append(
            Row(
                f"trigger out, {name}: delays on and off, us",
                f"{delays[0]:.0f}, {delays[1]:.0f}",
                "below 300",
                max(delays) < 300,
            )
        )
    for volt in (30, -30):
        got = run(
            tools, circuit, [f"Vd {drive} 0 3.2", f"Vs {plus} {minus} {volt}", f"Vz {minus} 0 0"],
            ["op", "let amps = abs(i(vs))", f"let ce = v({circuit.node('Q1', 'C')})-v({circuit.node('Q1', 'E')})",
             f"let opto = v({circuit.node('U11', 'C')})-v({circuit.node('U11', 'E')})", "print amps ce opto"],
        )  # fmt: skip
        watt = max(0.0, got["ce"]) * got["amps"]
        good = got["amps"] < 0.03 and watt < 0.8 and -7 < got["opto"] < 70
        rows.append(
            Row(
                f"trigger out, on, {volt:+d} V across it: mA, mW in Q1",
                f"{got['amps'] * 1e3:.2f}, {watt * 1e3:.0f}",
                "below 30, 800",
                good,
            )
        )
    return rows


# ---- RS-422


def receiver(tools: Tools, circuit: Circuit) -> list[Row]:
    a, b, out = circuit.node("J6", "5"), circuit.node("J6", "6"), circuit.node("U1", "GP3")
    rows = []
    for name, bench, wanted in (
        ("open", [], True),
        ("shorted", [f"Rx {a} {b} 0.1"], True),
        ("idle, 100 Ω", [f"Rx {a} {b} 100"], True),
        ("driven high", [f"Va {a} 0 2", f"Vb {b} 0 0"], True),
        ("driven low", [f"Va {a} 0 0", f"Vb {b} 0 2"], False),
    ):
        got = run(tools, circuit, bench, ["op", f"print v({out})", f"let level = v({out})", "print level"])
        rows.append(
            Row(
                f"RS-422 {name}: level at GP3, V",
                f"{got['level']:.2f}",
                "high" if wanted else "low",
                (got["level"] > 2) == wanted,
            )
        )
    # a stop pulse of 3 us from a driver of 100 Ω: its two edges at the receiver
    bench = ["Va s 0 PULSE(-2 2 5u 20n 20n 3u 1)", f"Ra s {a} 100", f"Rb {b} 0 1"]
    got = run(
        tools,
        circuit,
        bench,
        ["tran 5n 12u 0 5n", f"meas tran width trig v({out}) val=1.65 rise=1 targ v({out}) val=1.65 fall=1"],
    )
    rows.append(_near("RS-422: width of a pulse of 3 us through the termination, us", got["width"] * 1e6, 3.02, 0.03))
    return rows
