"""The netlist as a SPICE circuit, and ngspice to run it.

The models follow the data sheets' limits and typical behaviour; none comes from a manufacturer. Digital chips are
modelled only as far as their analogue pins require. Every deck is made of the complete box, so what is simulated is what
is built; parts that nothing can reach are left out where that saves much time.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from hardware.datasheets import DataSheet, data_sheet
from hardware.kicad import Tools
from hardware.netlist import Netlist, quantity
from hardware.part_numbers import Rating, decode

ADC_OHM = 330e3  # ADS131M04 between the inputs of a channel, gains 1, 2 and 4
MODELS = """
.model DSCH D(IS=1e-7 N=1.05 RS=1.5 BV=60 CJO=10p)
.model DESD D(IS=1e-12 N=1.2 RS=2)
.model DIDEAL D(IS=1e-9 N=0.05 RS=0.05)
.model DTVS5 D(IS=1e-9 N=1.1 RS=0.04 BV=6.6 IBV=1m CJO=1n)
.model DTVS33 D(IS=1e-12 N=1.1 RS=0.3 BV=37.5 IBV=1m CJO=300p)
.model QSMALL NPN(IS=2e-14 BF=250 VAF=80 RB=20 CJE=8p CJC=4p TF=0.4n)
.model QPOWER NPN(IS=5e-14 BF=130 VAF=100 RB=5 CJE=60p CJC=15p TF=1n)
.model QPSMALL PNP(IS=2e-14 BF=250 VAF=80 RB=20 CJE=8p CJC=4p TF=0.4n)
.model QPPOWER PNP(IS=5e-14 BF=130 VAF=100 RB=5 CJE=60p CJC=15p TF=1n)
.model LED D(IS=1e-13 N=2 RS=3)
.model SWITCH SW(VT=1.65 VH=0.1 RON=1 ROFF=1e9)
.subckt OPAMP inp inn out vcc vee
* 10 MHz; the integrator is held within the rails, the output has 5 ohm inside the loop
G1 vee n1 inp inn 1e-3
R1 n1 vee 1e9
C1 n1 vee 15.9p
D1 n1 vcc DIDEAL
D2 vee n1 DIDEAL
E1 o vee n1 vee 1
Ro o out 5
D3 inp vcc DESD
D4 vee inp DESD
D5 out vcc DESD
D6 vee out DESD
.ends
.subckt OPTO a k c e
Vled a x 0
D1 x k LED
* current transfer ratio 1.5, 3 us, saturates at 0.1 V
B1 y 0 V=I(Vled)*1000
R1 y z 1k
C1 z 0 3n
B2 c e I=max(0,V(z))*1.5e-3*tanh(max(0,V(c,e))/0.1)
.ends
.subckt INPUT24 sense in fgnd
* 2.25 mA typical with 562 ohm between the pins; the rest of the pins' current is small
B1 in fgnd I=2.25m*tanh(max(0,V(in,fgnd))/0.3)
R1 sense fgnd 1e6
.ends
"""


TRANSISTORS = {"BCP56": "QPOWER", "BC847": "QSMALL", "BCP53": "QPPOWER", "BC857": "QPSMALL"}


@dataclass(frozen=True)
class Circuit:
    """A netlist for simulation. ``fitted``: positions that are empty on the board and filled here. ``tripped``: fuses
    that have tripped; the others have their lowest resistance. ``on``: the USB port supplies the box; if not, no chip
    drives or loads anything.
    """

    netlist: Netlist
    fitted: frozenset[str] = frozenset()
    tripped: frozenset[str] = frozenset()
    on: bool = True

    def node(self, ref: str, function: str) -> str:
        """Return the SPICE node of a pin, by the data sheet's name or a terminal's number."""
        sheet = data_sheet(self.netlist.components[ref].mpn)
        numbers = [n for n, name in sheet.pins.items() if name == function] if sheet else [function]
        for number in numbers:
            if (ref, number) in self.netlist.pins:
                return node_of(self.netlist.pins[ref, number])
        return f"open_{ref}_{re.sub('[^a-z0-9]', '_', function.lower())}"

    def lines(self) -> list[str]:
        """Return all parts as SPICE elements."""
        found: list[str] = []
        for ref, part in sorted(self.netlist.components.items()):
            if part.fitted or ref in self.fitted:
                sheet = data_sheet(part.mpn)
                found += self._chip(ref, part.mpn, sheet) if sheet else self._passive(ref, part.value, part.mpn)
        return found

    def _passive(self, ref: str, value: str, mpn: str) -> list[str]:
        a, b = self.node(ref, "1"), self.node(ref, "2")
        if mpn.startswith("GRM"):
            return [f"C{ref} {a} {b} {quantity(value):g}"]
        if mpn.startswith(("ER", "RS02", "BLM")):
            return [f"R{ref} {a} {b} {quantity(value) if mpn[0] != 'B' else 0.5:g}"]
        if mpn.startswith("MF-"):
            fuse = rating_of(mpn)
            return [
                f"R{ref} {a} {b} {fuse.volts**2 / fuse.tripped_watts if ref in self.tripped else fuse.lowest_ohm:g}"
            ]
        if mpn == "SMAJ33CA":
            return [f"D{ref}a {ref}m {a} DTVS33", f"D{ref}b {ref}m {b} DTVS33"]
        if mpn == "SMAJ5.0A":
            return [f"D{ref} {b} {a} DTVS5"]
        if mpn.startswith("SS"):
            return [f"D{ref} {b} {a} DSCH"]
        if mpn.startswith("17157"):  # terminals
            return []
        raise ValueError(f"{ref}: no model for {mpn}")

    def _chip(self, ref: str, mpn: str, sheet: DataSheet) -> list[str]:
        def at(*names: str) -> str:
            return " ".join(self.node(ref, name) for name in names)

        if mpn.startswith("ADS131M04"):
            pairs = [(f"AIN{k}P", f"AIN{k}N") for k in range(4)]
            found = [f"R{ref}{k} {at(*pair)} {ADC_OHM:g}" for k, pair in enumerate(pairs)]
            return found + [f"D{ref}{k}{s} {at(pair[s], 'AVDD')} DESD" for k, pair in enumerate(pairs) for s in (0, 1)]
        if mpn.startswith("OPA2388"):
            return [f"X{ref}{side} {at('+' + side, '-' + side, 'OUT' + side, 'V+', 'V-')} OPAMP" for side in "AB"]
        if mpn.startswith("TS5A23159"):
            found = []
            for k in "12":
                found.append(f"S{ref}o{k} {at('COM' + k, 'NO' + k)} {at('IN' + k)} 0 SWITCH")
                found.append(f"S{ref}c{k} {at('COM' + k, 'NC' + k)} {at('V+', 'IN' + k)} SWITCH")
            return found
        if mpn.startswith("LP5907"):  # sources current only
            if not self.on:
                return []
            return [f"V{ref} {ref}s 0 3.3", f"D{ref} {ref}s {at('OUT')} DIDEAL"]
        if mpn.startswith("BAT54S"):
            return [f"D{ref}a {at('A1', 'MID')} DSCH", f"D{ref}b {at('MID', 'K2')} DSCH"]
        if mpn.startswith("LTC2863"):
            levels = [f"R{ref}{pin} {at(pin)} 0 125k" for pin in "ABYZ"]
            if not self.on:
                return levels
            # high when open, shorted or idle: low only below -0.2 V
            return [*levels, f"B{ref} {at('RO')} 0 V=V({self.node(ref, 'A')},{self.node(ref, 'B')}) < -0.2 ? 0 : 3.3"]
        if mpn.startswith("ISO1211"):
            return [f"X{ref} {at('SENSE', 'IN', 'FGND')} INPUT24", f"R{ref}g {at('FGND')} 0 1e12"]
        if mpn.startswith("VO615A"):
            return [f"X{ref} {at('A', 'K', 'C', 'E')} OPTO", f"R{ref}g {at('E')} 0 1e12"]
        if mpn.startswith("BC"):
            return [f"Q{ref} {at('C', 'B', 'E')} {TRANSISTORS[mpn[:5]]}"]
        if mpn.startswith("SC0917"):  # protection of the pins; 3.3 V and 5 V
            found = [f"V{ref} {at('3V3')} 0 3.3", f"V{ref}b {at('VBUS')} 0 5"] if self.on else []
            used = [n for n in range(29) if not at(f"GP{n}").startswith("open_")]
            for n in used:
                found += [f"D{ref}h{n} {at(f'GP{n}', '3V3')} DESD", f"D{ref}l{n} 0 {at(f'GP{n}')} DESD"]
                found.append(f"R{ref}i{n} {at(f'GP{n}')} 0 1e7")
            return found
        raise ValueError(f"{ref}: no model for {mpn}")


def rating_of(mpn: str) -> Rating:
    """Return what a part number says. Raises ValueError if nothing knows it."""
    rating = decode(mpn)
    if rating is None:
        raise ValueError(f"{mpn} is in no ordering code or table of hardware/part_numbers.py")
    return rating


def node_of(net: str) -> str:
    """Return a net's SPICE node."""
    return "0" if net == "GND" else re.sub(r"[^a-z0-9_]", "p", net.lower())


def terminals(element: str) -> set[str]:
    """Return the nodes of a SPICE element; of a formula (B), every word in it."""
    name, *words = element.split()
    if name[0] == "B":
        return set(re.findall(r"\w+", element))
    if name[0] == "X":
        return set(words[:-1])
    return set(words[: {"Q": 3, "S": 4}.get(name[0], 2)])


def reached(elements: Iterable[str], bench: Iterable[str]) -> list[str]:
    """Return the elements on which a bench can have an effect, or which can have one on them.

    A node that an ideal source holds against ground has the same voltage whatever is connected to it: nothing passes
    through it. So what is left out changes no voltage and no current of the rest.
    """
    left = {element: terminals(element) for element in elements}
    found = [element for element in left if element[0] == "V" and element.split()[2] == "0"]
    held = {"0"} | {element.split()[1] for element in found}
    new = set(re.findall(r"[a-z_]\w*", " ".join(bench), re.I))  # no numbers: formulas have some too
    while new:
        near = [element for element, nodes in left.items() if not new.isdisjoint(nodes - held)]
        new = set().union(*(left.pop(element) for element in near))
        found += [element for element in near if element not in found]
    return found


def run(
    tools: Tools, circuit: Circuit, bench: Iterable[str], control: Iterable[str], *, whole: bool = True
) -> dict[str, float]:
    """Simulate the box with a bench around it; return the results of ``meas`` and ``print`` lines, by name in lower
    case.

    ``whole=False`` leaves out what has no effect on the bench; what ``control`` measures must then be near it.

    Raises:
        RuntimeError: ngspice failed; the text is its message.
    """
    bench = [*bench, *(["Iavdd avdd 0 8m"] if circuit.on else [])]
    elements = circuit.lines() if whole else reached(circuit.lines(), bench)
    lines = ["the box", *MODELS.splitlines(), *elements, *bench]
    lines += [".options reltol=1e-4 abstol=1e-10 vntol=1e-7 rshunt=1e12 method=gear", ".control"]
    lines += [*control, "quit", ".endc", ".end", ""]
    with tempfile.TemporaryDirectory() as folder:
        deck = Path(folder) / "box.cir"
        deck.write_text("\n".join(lines))
        done = subprocess.run(
            [tools.ngspice, "-b", str(deck)],
            capture_output=True,
            text=True,
            env=tools.environ,
            cwd=folder,
            timeout=170,
        )
    found = {}
    for match in re.finditer(r"^([a-z][\w.]*)\s*=\s*([-+0-9.e]+)", done.stdout, re.M | re.I):
        found[match[1].lower()] = float(match[2])
    # after "Transient op" an operating point would be whatever state the transient had reached
    if not found or "singular" in done.stderr or "Transient op" in done.stderr or "aborted" in done.stderr:
        raise RuntimeError(f"ngspice: {(done.stdout + done.stderr)[-2000:]}")
    return found


def limited_nodes(circuit: Circuit) -> list[str]:
    """Return the nodes of pins with a known absolute maximum."""
    found = set()
    for ref, part in circuit.netlist.components.items():
        sheet = data_sheet(part.mpn)
        found |= {circuit.node(ref, pin) for pin in sheet.limits} if sheet else set()
    return sorted(node for node in found if node != "0" and not node.startswith("open_"))


def within_limits(circuit: Circuit, values: Mapping[str, float], supplies: Mapping[str, float]) -> list[str]:
    """Return pins whose voltages exceed their absolute maximum; values are by node."""
    found = []
    for ref, part in circuit.netlist.components.items():
        sheet = data_sheet(part.mpn)
        if sheet is None:
            continue
        ground = values.get(circuit.node(ref, sheet.ground), 0.0)
        for pin, (low, high) in sheet.limits.items():
            node = circuit.node(ref, pin)
            if node in values:
                top = high if isinstance(high, float) else supplies[circuit.node(ref, high[0])] + high[1]
                volt = values[node] - ground
                if not low <= volt <= top:
                    found.append(f"{ref}.{pin} is at {volt:.2f} V; {low:g} to {top:g} V are allowed")
    return found
