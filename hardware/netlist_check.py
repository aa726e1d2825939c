"""Check a netlist against the data sheets and the expectations, independently of how the netlist was made.

There are four rules. Each returns findings in words, and none if everything is correct:

- ``expected``: every pin of a chip and every terminal is connected as hardware/expectations.txt states, and every part
  with two terminals is connected with its value between the two nodes named there;
- ``decoupled``: every supply pin has the capacitance that its data sheet requires;
- ``isolated``: only isolators touch both the robot's side and the logic;
- ``pico``: the Pico's pins are those of firmware/board_pico.py.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hardware.datasheets import data_sheet
from hardware.netlist import Netlist, Pin, quantity

HERE = Path(__file__).resolve().parent
BOARD = HERE.parent / "firmware" / "board_pico.py"
ISOLATORS = ("ISO1211", "VO615A")
# pins of an isolator on the robot's side
FIELD_PINS = {"ISO1211": {"SENSE", "IN", "FGND", "SUB"}, "VO615A": {"C", "E"}}
# the part of a part number that gives the kind of a part with two terminals; cathode first if it has one
KINDS = (
    ("ER", "R"),
    ("RS02", "R"),
    ("GRM", "C"),
    ("MF-", "FUSE"),
    ("BLM", "BEAD"),
    ("SMAJ33CA", "TVS_BOTH"),
    ("SMAJ5.0A", "TVS"),
    ("SS", "DIODE"),
)
POLARISED = ("DIODE", "TVS")


@dataclass(frozen=True)
class Expectations:
    """``nodes``: name → pins by (reference, function) with counts; ``parts``: (kind, value, first and second node)."""

    nodes: Mapping[str, Counter[tuple[str, str]]]
    open: Counter[tuple[str, str]]
    parts: tuple[tuple[str, str, str, str], ...]


@cache
def read_expectations() -> Expectations:
    """Return the content of hardware/expectations.txt."""
    text = (HERE / "expectations.txt").read_text(encoding="utf-8")
    nodes: dict[str, Counter[tuple[str, str]]] = {}
    left_open: Counter[tuple[str, str]] = Counter()
    parts = []
    for line in text.replace("\\\n", " ").splitlines():
        word, _, rest = line.partition(" ")
        if word == "NODE":
            name, _, pins = rest.partition(":")
            nodes[name] = _pins(pins)
        elif word == "OPEN":
            left_open += _pins(rest)
        elif word == "PART":
            kind_and_value, _, ends = rest.partition(":")
            kind, value = kind_and_value.split(" ", 1)
            parts.append((kind, value, *ends.split()))
    return Expectations(nodes, left_open, tuple(parts))


def _pins(text: str) -> Counter[tuple[str, str]]:
    found: Counter[tuple[str, str]] = Counter()
    for word in text.split():
        pin, _, times = word.partition("*")
        ref, _, function = pin.partition(".")
        found[ref, function] += int(times or 1)
    return found


# ---- the netlist in the terms of the data sheets


@dataclass(frozen=True)
class Bridge:
    """A part with two terminals: kind, value in the format of the expectations, and the nets of its terminals."""

    ref: str
    kind: str
    value: str
    first: str
    second: str


def function(netlist: Netlist, pin: Pin) -> str:
    """Return the data sheet's name of a pin; the number itself for a row of terminals."""
    sheet = data_sheet(netlist.components[pin[0]].mpn)
    return sheet.pins.get(pin[1], f"no pin {pin[1]}") if sheet else pin[1]


def is_anchor(netlist: Netlist, ref: str) -> bool:
    """Return whether the part is a chip or a row of terminals, which the expectations identify by reference."""
    return _kind(netlist.components[ref].mpn) is None


@cache
def _kind(mpn: str) -> str | None:
    if data_sheet(mpn):
        return None
    return next((kind for begin, kind in KINDS if mpn.startswith(begin)), None)


def bridges(netlist: Netlist) -> Iterator[Bridge]:
    """Yield all parts with two terminals; an open terminal's net is empty."""
    for ref, part in netlist.components.items():
        kind = _kind(part.mpn)
        if kind:
            value = part.value
            if kind in ("R", "C", "BEAD", "FUSE"):
                value = f"{quantity(value):.6g}" + ("" if part.fitted else " empty")
            yield Bridge(ref, kind, value, netlist.pins.get((ref, "1"), ""), netlist.pins.get((ref, "2"), ""))


def _wanted_value(kind: str, value: str) -> str:
    if kind not in ("R", "C", "BEAD", "FUSE"):
        return value
    number, _, empty = value.partition(" ")
    return f"{quantity(number):.6g}" + (f" {empty}" if empty else "")


# ---- the rules


def findings(netlist: Netlist, board: str | None = None) -> list[str]:
    """Return all findings. ``board`` is the text of firmware/board_pico.py."""
    board = BOARD.read_text(encoding="utf-8") if board is None else board
    return [*expected(netlist), *decoupled(netlist), *isolated(netlist), *pico(netlist, board)]


def expected(netlist: Netlist) -> list[str]:
    """Return differences from the expectations."""
    wanted = read_expectations()
    anchors: dict[str, Counter[tuple[str, str]]] = {}
    for pin, net in netlist.pins.items():
        if is_anchor(netlist, pin[0]):
            anchors.setdefault(net, Counter())[pin[0], function(netlist, pin)] += 1
    found = []
    where: dict[str, str] = {}  # node → net
    for node, pins in wanted.nodes.items():
        net = next((net for net, there in anchors.items() if there == pins), None)
        if net is None:
            found.append(f"no net joins {_words(pins)} ({node}) and nothing else")
        else:
            where[node] = net
    for net in set(anchors) - set(where.values()):
        found.append(f"net {net} joins {_words(anchors[net])}, which is not expected")
    found += _open_pins(netlist, wanted)
    there = list(bridges(netlist))
    parts = [(kind, _wanted_value(kind, value), a, b) for kind, value, a, b in wanted.parts]
    _resolve(parts, there, where, set(anchors))
    have = Counter(_key(b.kind, b.value, b.first, b.second) for b in there)
    want: Counter[tuple[str, str, str, str]] = Counter()
    for kind, value, a, b in parts:
        if a in where and b in where:
            want[_key(kind, value, where[a], where[b])] += 1
        else:
            found.append(f"{kind} {value} between {a} and {b} is missing")
    found += [f"{' '.join(key[:2])} between {key[2]} and {key[3]} is missing" for key in (want - have)]
    found += [f"{' '.join(key[:2])} between {key[2]} and {key[3]} is not expected" for key in (have - want)]
    return found


def _words(pins: Counter[tuple[str, str]]) -> str:
    return ", ".join(sorted(f"{ref}.{name}" for ref, name in pins.elements()))


def _open_pins(netlist: Netlist, wanted: Expectations) -> list[str]:
    left: Counter[tuple[str, str]] = Counter()
    for ref, part in netlist.components.items():
        sheet = data_sheet(part.mpn)
        for number, name in (sheet.pins if sheet else {}).items():
            if (ref, number) not in netlist.pins:
                left[ref, name] += 1
    return [f"{ref}.{name} is open" for ref, name in left - wanted.open]


def _key(kind: str, value: str, first: str, second: str) -> tuple[str, str, str, str]:
    first, second = (first, second) if kind in POLARISED else sorted((first, second))
    return kind, value, first, second


def _resolve(
    parts: list[tuple[str, str, str, str]], there: list[Bridge], where: dict[str, str], anchored: set[str]
) -> None:
    """Find the nets of nodes without a chip: by the only part of its kind and value from a known node to an unknown
    one.

    At a known node, unknown nodes may be distinguishable only by their other parts, so the parts on each candidate net
    are compared.
    """
    signatures: dict[str, Counter[tuple[str, str]]] = {}
    for bridge in there:
        for net in (bridge.first, bridge.second):
            signatures.setdefault(net, Counter())[bridge.kind, bridge.value] += 1
    expected_at: dict[str, Counter[tuple[str, str]]] = {}
    for kind, value, a, b in parts:
        for node in (a, b):
            expected_at.setdefault(node, Counter())[kind, value] += 1
    changed = True
    while changed:
        changed = False
        for kind, value, *ends in parts:
            for known, unknown in (ends, reversed(ends)):
                if known not in where or unknown in where:
                    continue
                nets = {
                    other
                    for b in there
                    if (b.kind, b.value) == (kind, value)
                    for net, other in ((b.first, b.second), (b.second, b.first))
                    if net == where[known] and other not in anchored and other not in where.values()
                }
                nets = {net for net in nets if net and signatures[net] == expected_at[unknown]}
                if len(nets) == 1:
                    where[unknown] = nets.pop()
                    changed = True


def decoupled(netlist: Netlist) -> list[str]:
    """Return supply pins without the capacitance of their data sheet. Each capacitor counts for one pin only."""
    found = []
    fitted = [b for b in bridges(netlist) if b.kind == "C" and netlist.components[b.ref].fitted]
    capacitors = Counter((frozenset((b.first, b.second)), float(b.value)) for b in fitted)
    for ref, part in netlist.components.items():
        sheet = data_sheet(part.mpn)
        for pin, ground, farad in sheet.decoupling if sheet else ():
            nets = [
                next((netlist.pins.get((ref, number)) for number, name in sheet.pins.items() if name == wanted), None)
                for wanted in (pin, ground)
            ]
            key = (frozenset(net or "" for net in nets), farad)
            capacitors[key] -= 1
            if capacitors[key] < 0:
                found.append(f"{ref}.{pin} has no capacitor of {farad * 1e9:g} nF of its own to {ground}")
    return found


def isolated(netlist: Netlist) -> list[str]:
    """Return parts other than isolators that touch both sides, the robot's and the logic; isolators with joined sides."""
    field, logic = _sides(netlist)
    found = [f"net {net} is on both sides of the isolation" for net in sorted(field & logic)]
    of: dict[str, set[str]] = {}
    for (ref, _), net in netlist.pins.items():
        of.setdefault(ref, set()).add(net)
    for ref, nets in of.items():
        part = netlist.components[ref]
        if not part.mpn.startswith(ISOLATORS) and nets & field and nets & logic:
            found.append(f"{ref} joins {', '.join(sorted(nets & field))} to {', '.join(sorted(nets & logic))}")
    return found


def _sides(netlist: Netlist) -> tuple[set[str], set[str]]:
    """Return the nets that parts join to the field pins of isolators, and those joined to the logic's ground."""
    logic = {net for (ref, _), net in netlist.pins.items() if netlist.components[ref].mpn.startswith("SC0917")}
    field: set[str] = set()
    for (ref, number), net in netlist.pins.items():
        mpn = netlist.components[ref].mpn
        for name, pins in FIELD_PINS.items():
            if mpn.startswith(name):
                (field if function(netlist, (ref, number)) in pins else logic).add(net)
    joined: dict[str, set[str]] = {}
    for (ref, _), net in netlist.pins.items():
        if not netlist.components[ref].mpn.startswith(ISOLATORS):
            joined.setdefault(ref, set()).add(net)
    parts = list(joined.values())
    for side in (field, logic):
        grown = True
        while grown:
            grown = False
            for nets in parts:
                if nets & side and not nets <= side:
                    side |= nets
                    grown = True
    return field, logic


def pico(netlist: Netlist, board: str) -> list[str]:
    """Compare the Pico's pins with firmware/board_pico.py, by the function of the chip's pin at the other end."""
    found = []
    resistors = [bridge for bridge in bridges(netlist) if bridge.kind == "R"]
    for gpio, wanted in board_pins(board).items():
        number = next((n for n, name in data_sheet("SC0917").pins.items() if name == f"GP{gpio}"), "")
        net = netlist.pins.get(("U1", number))
        others = {
            function(netlist, pin)
            for pin, other in netlist.pins.items()
            if net is not None and other == net and pin[0] != "U1"
        }
        if wanted not in others | _behind(netlist, resistors, net):
            found.append(
                f"GP{gpio} of firmware/board_pico.py goes to {wanted}, here to {', '.join(sorted(others)) or 'nothing'}"
            )
    nodes = read_expectations().nodes
    for name, node in board_nodes(board):
        if ("U1", name) not in nodes[node]:
            found.append(f"{name} of firmware/board_pico.py is {node}, which is {_words(nodes[node])} here")
    return found


def _behind(netlist: Netlist, resistors: Iterable[Bridge], net: str | None) -> set[str]:
    """Return the functions behind one resistor."""
    found = set()
    for b in resistors:
        if net in (b.first, b.second):
            far = b.second if b.first == net else b.first
            found |= {function(netlist, pin) for pin, other in netlist.pins.items() if other == far}
    return found


def board_nodes(text: str) -> list[tuple[str, str]]:
    """Return pins of the board file that do not end at a chip's digital pin, and their nodes in the expectations."""
    constants = _constants(text)
    pins = (*constants["LVDT_PINS"], constants["THERMOMETER_PIN"])
    nodes = ("EXCITATION", "DEMODULATE_S", "DEMODULATE_P", "DQ_PIN")
    return [(f"GP{pin}", node) for pin, node in zip(pins, nodes, strict=True)]


@cache
def _constants(text: str) -> dict[str, Any]:
    constants = {}
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            try:
                constants[node.targets[0].id] = ast.literal_eval(node.value)
            except ValueError:
                continue
    return constants


def board_pins(text: str) -> dict[int, str]:
    """Return GPIO → function of the chip's pin that it must reach, from the board file's constants."""
    constants = _constants(text)
    converter = ("DOUT", "CS", "SCLK", "DIN", "DRDY", "SYNC/RESET", "CLKIN")
    found = dict(zip(constants["CONVERTER_PINS"], converter, strict=True))
    found |= dict(zip(constants["HEAD_PINS"], ("DI", "RO"), strict=True))
    first = constants["TRIGGER_PINS"]
    found |= {first: "OUT", first + 1: "OUT", first + 2: "A", 26 + constants["RAIL_5V_ADC"]: "VBUS"}
    return found
