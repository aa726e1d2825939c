"""The simulated box in its nominal state, with shorts and with ±30 V at its terminals: every chip's pin within its
absolute maximum, and every part within its continuous power, current and voltage.

The bench limits currents: the sensors' supply at J2 to SUPPLY_A, a fault's source to FAULT_A. If a fuse carries more
than its holding current, the state is simulated again with the fuse tripped; before it trips, all other parts must
withstand the current continuously, so how long the fuse takes does not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from hardware import lvdt_check
from hardware.budget import LVDTS
from hardware.kicad import Tools
from hardware.netlist import Netlist
from hardware.part_numbers import Rating
from hardware.rows import Row
from hardware.spice import Circuit, limited_nodes, rating_of, run, within_limits

FAULT_V = 30.0
FAULT_A = 10.0  # of the source of a fault
SUPPLY_MOST_V = 3.63  # at the Pico's 3.3 V: RP2040's absolute maximum, the lowest of the chips'
SUPPLY_V, SUPPLY_A = 24.0, 2.0  # at J2
LOADS = (("J6", "1", 0.15), ("J3", "4", 0.1), ("J4", "4", 0.1))  # A of the head and of each transducer
NOMINAL_HOLD = 0.76  # of a fuse's holding current at 23 °C: what is left of it at 50 °C
STEP_S, END_S, STEADY_S = 1e-5, 50e-3, 40e-3  # the fault begins at STEP_S; averages are from STEADY_S to END_S
TVS_PULSE_W, TVS_PULSE_J = 400.0, 0.4  # 10/1000 µs

# terminals on which a fault is applied: row → ways, relative to the box's ground
FAULT_TERMINALS = {"J1": "12", "J2": "1", "J3": "124", "J4": "124", "J5": "12345", "J6": "13456"}
# and relative to another terminal of the row: those on the robot's side
FIELD_TERMINALS = {"J7": ("1", "2"), "J8": ("1", "2"), "J9": ("1", "2")}
SHORTS = (("J1", "1"), ("J1", "2"), ("J3", "4"), ("J4", "4"), ("J6", "1"))  # outputs to ground
LOOPS = {"J3": "R12", "J4": "R18"}


@dataclass(frozen=True)
class State:
    """What is connected to the box: SPICE elements; ``ac`` if its currents alternate for ever."""

    name: str
    bench: tuple[str, ...]
    fitted: frozenset[str] = frozenset()


def jobs(netlist: Netlist) -> Iterator[Callable[[Tools, Circuit], list[Row]]]:
    """Yield the check of every state, and that of the box without its supply."""
    for state in states(Circuit(netlist)):
        yield lambda tools, circuit, state=state: check(tools, circuit, state)
    yield switched_off


def states(circuit: Circuit) -> Iterator[State]:
    """Yield the nominal state, the shorts and the faults."""
    yield State("nominal", (*supplied(circuit), *nominal(circuit)))
    for ref, way in SHORTS:
        yield State(f"{ref}.{way} shorted to ground", (*supplied(circuit), f"Rshort {circuit.node(ref, way)} 0 0.01"))
    yield State("J5.1 shorted to J5.2", (*supplied(circuit), *nominal(circuit, shorted=True)))
    for volt in (FAULT_V, -FAULT_V):
        for ref, ways in FAULT_TERMINALS.items():
            for way in ways:
                supply = () if ref == "J2" else supplied(circuit)
                yield State(f"{volt:+.0f} V on {ref}.{way}", (*supply, *fault(circuit.node(ref, way), "0", volt)))
        for ref, (plus, minus) in FIELD_TERMINALS.items():
            ends = circuit.node(ref, plus), circuit.node(ref, minus)
            drive = (f"Vdrive {circuit.node('U1', 'GP8')} 0 3.2",) if ref == "J9" else ()
            yield State(f"{volt:+.0f} V across {ref}", (*fault(*ends, volt), f"Rfield {ends[1]} 0 1k", *drive))
        for ref, loop in LOOPS.items():
            ends = circuit.node(ref, "1"), circuit.node(ref, "2")
            bench = (*supplied(circuit), f"Rz {ends[1]} 0 0.01", *fault(ends[0], "0", volt))
            yield State(f"{volt:+.0f} V on {ref}.1, {loop} fitted, {ref}.2 at 0 V", bench, frozenset({loop}))


def switched_off(tools: Tools, circuit: Circuit) -> list[Row]:
    """Return the 3.3 V of a box without supply with a fault at each sensor terminal: it must not be supplied beyond its
    maximum.

    The chips that it supplies are taken to need no current, which is the worst case.
    """
    box = replace(circuit, on=False)
    rail = box.node("U1", "3V3")
    rows = []
    for ref, ways in FAULT_TERMINALS.items():
        for way in ways:
            bench = [f"Vfault {box.node(ref, way)} 0 {FAULT_V:g}"]
            got = run(tools, box, bench, ["op", f"let level = v({rail})", "print level"])
            what = f"box off, {FAULT_V:+.0f} V on {ref}.{way}: V at 3V3"
            rows.append(Row(what, f"{got['level']:.2f}", f"at most {SUPPLY_MOST_V}", got["level"] <= SUPPLY_MOST_V))
    return rows


def source(name: str, plus: str, minus: str, level: str, ampere: float, *, sinks: bool) -> tuple[str, str]:
    """Return a voltage source with a limit of its current, which falls within 0.1 V, and its output capacitor."""
    share = f"tanh((V({level})-V({plus},{minus}))*20)"
    current = f"B{name} {plus} {minus} I=-{ampere:g}*{share if sinks else f'0.5*(1+{share})'}"
    return current, f"C{name} {plus} {minus} 1u"


def supplied(circuit: Circuit) -> tuple[str, ...]:
    """Return 24 V at J2."""
    node = circuit.node("J2", "1")
    return (f"Vlevel24 level24 0 {SUPPLY_V:g}", *source("supply", node, "0", "level24", SUPPLY_A, sinks=False))


def fault(plus: str, minus: str, volt: float) -> tuple[str, ...]:
    """Return a source that steps to ``volt``."""
    level = f"Vlevel levelfault 0 PWL(0 0 {STEP_S:g} 0 {STEP_S * 1.1:g} {volt:g} 1 {volt:g})"
    return (level, *source("fault", plus, minus, "levelfault", FAULT_A, sinks=True))


def nominal(circuit: Circuit, *, shorted: bool = False) -> tuple[str, ...]:
    """Return a bench in which everything works, the LVDT with the lowest impedance; or its primary's wires shorted."""
    bench = list(lvdt_check.clocks(circuit, 3.3))
    bench += ["Rshort2 {} {} 0.01".format(*(circuit.node("J5", n) for n in "12"))] if shorted else []
    bench += [] if shorted else lvdt_check.sensor(circuit, LVDTS[1], 1.0, LVDTS[1].primary_ohm)
    for ref in ("J3", "J4"):
        bench += [f"V{ref} {circuit.node(ref, '1')} 0 10", f"V{ref}z {circuit.node(ref, '2')} 0 0"]
    bench += [f"Rload{ref} {circuit.node(ref, way)} 0 {SUPPLY_V / ampere:g}" for ref, way, ampere in LOADS]
    bench.append(f"Iprobes {circuit.node('J1', '1')} 0 12m")
    for ref in ("J7", "J8"):
        bench += [f"V{ref} {circuit.node(ref, '1')} 0 24", f"V{ref}z {circuit.node(ref, '2')} 0 0"]
    bench += [f"V{'J9'} {circuit.node('J9', '1')} 0 24", f"RJ9 {circuit.node('J9', '2')} 0 1200"]
    bench.append(f"Vdrive {circuit.node('U1', 'GP8')} 0 3.2")
    # the head's receiver gets 2 V at 1 kHz
    bench += [f"Vhead {circuit.node('J6', '5')} 0 PULSE(0 2 0 20n 20n 3u 1m)", f"Vheadz {circuit.node('J6', '6')} 0 0"]
    return tuple(bench)


# ---- what a state does to the parts


@dataclass(frozen=True)
class Probe:
    """An element of the deck whose stress is measured: quantity ``p`` (power), ``id`` or ``i`` (current), of a part."""

    ref: str
    element: str
    quantity: str


def probes(circuit: Circuit) -> list[Probe]:
    """Return the probes of all resistors, diodes, transistors and fuses."""
    elements: dict[str, list[str]] = {}
    for line in circuit.lines():
        name = line.split()[0]
        elements.setdefault(name[1:].rstrip("ab"), []).append(name)
    found = []
    for ref, part in circuit.netlist.components.items():
        rating = rating_of(part.mpn)
        for name in elements.get(ref, []):
            if rating.watts and name[0] in "RDQ":
                found.append(Probe(ref, name, "p"))
            if rating.amperes and name[0] in "RD":
                found.append(Probe(ref, name, "i" if name[0] == "R" else "id"))
    return found


def check(tools: Tools, circuit: Circuit, state: State) -> list[Row]:
    """Return two rows of a state: absolute maximum of the chips' pins, ratings of the other parts."""
    box = replace(circuit, fitted=state.fitted)
    got = simulate(tools, box, state)
    over = beyond_maximum(box, got)
    worst = stresses(box, got)
    tripped = frozenset(ref for ref, share in holding(box, got).items() if share > 1)
    if tripped:
        box = replace(box, tripped=tripped)
        got = simulate(tools, box, state)
        over |= beyond_maximum(box, got)
        for what, share in stresses(box, got).items():
            worst[what] = max(share, worst.get(what, 0.0))
    largest = sorted(worst.items(), key=lambda item: -item[1])[:3]
    words = ", ".join(f"{what} {share:.0%}" for what, share in largest)
    trips = f"; trips: {', '.join(sorted(tripped))}" if tripped else ""
    extra = []
    if state.name == "nominal":
        most = max(holding(box, got).values())
        row = Row(
            "nominal: largest fuse current / holding current",
            f"{most:.0%}",
            f"{NOMINAL_HOLD:.0%}",
            most <= NOMINAL_HOLD,
        )
        extra.append(row)
    return [
        *extra,
        Row(
            state.name,
            "; ".join(sorted(over)) or "within absolute maximum",
            "within absolute maximum",
            not over,
        ),
        Row(f"{state.name}: stress", words + trips, "at most 100% of the ratings", largest[0][1] <= 1),
    ]


def simulate(tools: Tools, box: Circuit, state: State) -> dict[str, float]:
    """Return the extremes of the limited nodes and of all capacitors, and the probes' averages and peaks."""
    probed = probes(box)
    saves = " ".join(f"@{probe.element.lower()}[{probe.quantity}]" for probe in probed)
    control = [f"save all {saves}", f"tran 20u {END_S:g} 0 100u"]
    for k, node in enumerate(limited_nodes(box)):
        control += [f"meas tran max{k} max v({node})", f"meas tran min{k} min v({node})"]
    for k, probe in enumerate(probed):
        control += [
            f"let probe{k} = abs(@{probe.element.lower()}[{probe.quantity}])",
            f"meas tran mean{k} avg probe{k} from={STEADY_S:g} to={END_S:g}",
            f"meas tran peak{k} max probe{k}",
            f"meas tran sum{k} integ probe{k} from=0 to={STEADY_S:g}",
        ]
    for ref in voltages(box):
        control += [
            f"let across_{ref.lower()} = abs(v({box.node(ref, '1')})-v({box.node(ref, '2')}))".replace("v(0)", "0"),
            f"meas tran volt_{ref.lower()} max across_{ref.lower()}",
        ]
    return run(tools, box, state.bench, control)


def voltages(box: Circuit) -> list[str]:
    """Return the parts whose voltage is limited and simulated: capacitors and fuses."""
    return [ref for ref, part in box.netlist.components.items() if rating_of(part.mpn).kind in ("C", "FUSE")]


def beyond_maximum(box: Circuit, got: Mapping[str, float]) -> set[str]:
    """Return chips' pins beyond their absolute maximum."""
    nodes = limited_nodes(box)
    supplies = {box.node("U3", "AVDD"): 3.3, box.node("U1", "3V3"): 3.3}
    found = set()
    for name in ("max", "min"):
        found |= set(within_limits(box, {node: got[f"{name}{k}"] for k, node in enumerate(nodes)}, supplies))
    return found


def holding(box: Circuit, got: Mapping[str, float]) -> dict[str, float]:
    """Return the current of each fuse in units of its holding current."""
    found = {}
    for k, probe in enumerate(probes(box)):
        rating = rating_of(box.netlist.components[probe.ref].mpn)
        if rating.kind == "FUSE":
            found[probe.ref] = got[f"mean{k}"] / rating.value
    return found


def stresses(box: Circuit, got: Mapping[str, float]) -> dict[str, float]:
    """Return stresses in units of the ratings, by words that begin with the part."""
    found: dict[str, float] = {}
    for k, probe in enumerate(probes(box)):
        rating = rating_of(box.netlist.components[probe.ref].mpn)
        mean, peak, joule = got[f"mean{k}"], got[f"peak{k}"], got[f"sum{k}"]
        for what, share in _shares(rating, probe.quantity, mean, peak, joule):
            what = f"{probe.ref} {what}"
            found[what] = max(share, found.get(what, 0.0))
    for ref in voltages(box):
        found[f"{ref} voltage"] = got[f"volt_{ref.lower()}"] / rating_of(box.netlist.components[ref].mpn).volts
    return found


def _shares(rating: Rating, quantity: str, mean: float, peak: float, joule: float) -> Iterator[tuple[str, float]]:
    if quantity == "p":
        yield "power", mean / rating.watts
        if rating.kind.startswith("TVS"):
            yield "pulse power", peak / TVS_PULSE_W
            yield "pulse energy", joule / TVS_PULSE_J
    elif rating.kind == "FUSE":  # what it may interrupt
        yield "current", peak / rating.amperes
    else:
        yield "current", mean / rating.amperes
