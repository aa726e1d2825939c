"""Requirements for the simulated box: scales, corners, thermometers, triggers, RS-422; those of LVDTs and of faults are in
hardware/lvdt_check.py and hardware/stress.py.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from hardware import budget, lvdt_check, power_up, stress
from hardware.kicad import Tools
from hardware.netlist import Component, Netlist
from hardware.rows import Row, near
from hardware.spice import Circuit, run


def check(tools: Tools, netlist: Netlist) -> list[Row]:
    """Run all checks, two simulations at a time."""
    circuit = Circuit(netlist)
    with ThreadPoolExecutor(2) as pool:
        jobs = [
            pool.submit(job, tools, circuit)
            for job in (
                *lvdt_check.jobs(),
                power_up.check,
                transducers,
                thermometers,
                without_pico,
                triggers_in,
                trigger_out,
                receiver,
                *stress.jobs(netlist),
            )
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
            near(f"transducer {k}: volts at the converter a volt", got["scale"], wanted.scale, 1e-3),
            near(f"transducer {k}: -3 dB, Hz", got["corner"], wanted.corner_hz, 0.02),
            near(f"transducer {k}: delay, us", got["delay"] * 1e6, wanted.delay_s * 1e6, 0.02),
        ]
    loop = Circuit(circuit.netlist, frozenset({"R12"}))
    p, n, ap, an = (loop.node(*pin) for pin in (("J3", "1"), ("J3", "2"), ("U3", "AIN1P"), ("U3", "AIN1N")))
    got = run(
        tools, loop, [f"Iin 0 {p} 20m", f"Vn {n} 0 0"], ["op", f"let scale = (v({ap})-v({an}))/20m", "print scale"]
    )
    return [
        *rows,
        near("4-20 mA: volts at the converter an ampere", got["scale"], budget.loop_scale(circuit.netlist), 1e-3),
    ]


# ---- thermometers; the box without its Pico

PULL_UPS = (4700, 2200)  # R3, and the value that the document gives for long cables


def thermometers(tools: Tools, circuit: Circuit) -> list[Row]:
    """Check the levels on the thermometers' wire in both directions, and their supply with eight of them."""
    dq, tv, pin = circuit.node("J1", "2"), circuit.node("J1", "1"), circuit.node("U1", "GP9")
    rows = []
    for ohm in PULL_UPS:
        parts = dict(circuit.netlist.components)
        parts["R3"] = Component("R3", f"{ohm}R", parts["R3"].mpn)
        box = Circuit(Netlist(parts, circuit.netlist.pins))
        # a DS18B20 sinks 4 mA at 0.4 V: 100 Ω; the Pico's pin 50 Ω
        for what, bench, node, limit in (
            ("a thermometer pulls the wire low: V at GP9", f"Rt {dq} 0 100", pin, 0.8),
            ("the Pico pulls it low: V at the thermometer", f"Rt {pin} 0 50", dq, 0.8),
        ):
            got = run(tools, box, [bench], ["op", f"let level = v({node})", "print level"])
            rows.append(Row(f"{what}, R3 {ohm} Ω", f"{got['level']:.2f}", f"below {limit}", got["level"] < limit))
    got = run(tools, circuit, [f"It {tv} 0 12m"], ["op", f"let level = v({tv})", "print level"])
    rows.append(
        Row("thermometers: V of the supply at 12 mA (eight)", f"{got['level']:.2f}", "above 3.0", got["level"] > 3.0)
    )
    return rows


def without_pico(tools: Tools, circuit: Circuit) -> list[Row]:
    """Check that no input of a chip that is supplied without the Pico floats: 10 µA into it must not raise it above a
    low level.
    """
    parts = {ref: part for ref, part in circuit.netlist.components.items() if ref != "U1"}
    pins = {pin: net for pin, net in circuit.netlist.pins.items() if pin[0] != "U1"}
    box = Circuit(Netlist(parts, pins))
    rows = []
    for ref, function in (("U6", "IN1"), ("U7", "IN1"), ("U4", "+A")):
        node = box.node(ref, function)
        got = run(tools, box, ["Vusb vbus 0 5", f"Ileak 0 {node} 10u"], ["op", f"let level = v({node})", "print level"])
        rows.append(
            Row(
                f"Pico out of its sockets, 10 µA into {ref}.{function}: V",
                f"{got['level']:.2f}",
                "below 0.8",
                abs(got["level"]) < 0.8,
            )
        )
    return rows


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
                f"{delays[0]:.1f}, {delays[1]:.1f}",
                f"{budget.TRIGGER_ON_US}, {budget.TRIGGER_OFF_US} ± 1",
                abs(delays[0] - budget.TRIGGER_ON_US) <= 1 and abs(delays[1] - budget.TRIGGER_OFF_US) <= 1,
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
    rows.append(near("RS-422: width of a pulse of 3 us through the termination, us", got["width"] * 1e6, 3.02, 0.03))
    return rows
