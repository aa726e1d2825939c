"""A circuit, whatever its origin: parts with a value, and nets that join their pins. Only the standard library."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

Pin = tuple[str, str]  # (reference, pin number), as ("U3", "18")

PREFIX = {"p": 1e-12, "n": 1e-9, "u": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3, "M": 1e6}


@dataclass(frozen=True)
class Component:
    """A part as listed: its reference, value, manufacturer's part number, and whether it is fitted as delivered."""

    ref: str
    value: str
    mpn: str
    fitted: bool = True


@dataclass(frozen=True)
class Netlist:
    """``pins`` gives the net of every connected pin; a pin that is missing is open."""

    components: Mapping[str, Component]
    pins: Mapping[Pin, str]

    def nets(self) -> dict[str, frozenset[Pin]]:
        """Return the pins of every net."""
        found: dict[str, set[Pin]] = {}
        for pin, net in self.pins.items():
            found.setdefault(net, set()).add(pin)
        return {net: frozenset(pins) for net, pins in found.items()}

    def pins_of(self, ref: str) -> dict[str, str]:
        """Return pin number → net of one part."""
        return {number: net for (owner, number), net in self.pins.items() if owner == ref}

    def groups(self) -> frozenset[frozenset[Pin]]:
        """Return the joined pins, without net names: two netlists must agree in these."""
        return frozenset(self.nets().values())


def quantity(value: str) -> float:
    """Return the number at the beginning of a value, in SI units: "4.7k 1%" → 4700, "220n X7R" → 2.2e-7, "33R" → 33.

    Raises:
        ValueError: the value does not begin with a number.
    """
    match = re.match(r"([0-9.]+)([pnumkMR]?)", value)
    if not match:
        raise ValueError(f"value {value!r} does not begin with a number")
    return float(match[1]) * PREFIX[match[2].replace("R", "")]


# ---- the text form that is committed


def to_csv(netlist: Netlist) -> str:
    """Return one row per pin: net, reference, pin, value, part number, fitted; sorted, to allow comparison of texts."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["net", "ref", "pin", "value", "mpn", "fitted"])
    for (ref, number), net in sorted(netlist.pins.items(), key=lambda item: (item[1], _natural(item[0]))):
        part = netlist.components[ref]
        writer.writerow([net, ref, number, part.value, part.mpn, "yes" if part.fitted else "no"])
    return out.getvalue()


def from_csv(text: str) -> Netlist:
    """Return the netlist written by :func:`to_csv`."""
    components: dict[str, Component] = {}
    pins: dict[Pin, str] = {}
    for row in csv.DictReader(io.StringIO(text)):
        components[row["ref"]] = Component(row["ref"], row["value"], row["mpn"], row["fitted"] == "yes")
        pins[row["ref"], row["pin"]] = row["net"]
    return Netlist(components, pins)


def _natural(pin: Pin) -> tuple[str, int, int, str]:
    letters = pin[0].rstrip("0123456789")
    return letters, int(pin[0][len(letters) :] or 0), int(pin[1]) if pin[1].isdigit() else 0, pin[1]


# ---- KiCad's own netlist (kicad-cli sch export netlist)


def s_expression(text: str) -> list:
    """Return a nested list of the strings of an s-expression."""
    stack: list[list] = [[]]
    for match in re.finditer(r'"(?:[^"\\]|\\.)*"|[()]|[^\s()]+', text):
        token = match.group()
        if token == "(":
            stack.append([])
        elif token == ")":
            done = stack.pop()
            stack[-1].append(done)
        else:
            stack[-1].append(re.sub(r"\\(.)", r"\1", token[1:-1]) if token[0] == '"' else token)
    return stack[0][0]


def children(node: Iterable, name: str) -> Iterator[list]:
    """Yield the lists in ``node`` that begin with ``name``."""
    return (child for child in node if isinstance(child, list) and child and child[0] == name)


def text_of(node: Iterable, name: str) -> str:
    """Return the first word after ``name`` in the first such list; "" if there is none."""
    return next((child[1] for child in children(node, name) if len(child) > 1), "")


def from_kicad(text: str) -> Netlist:
    """Return the netlist that KiCad extracted from a schematic, without pins that KiCad calls unconnected."""
    root = s_expression(text)
    components = {}
    for part in children(next(children(root, "components")), "comp"):
        fields = {}
        for field in children(next(children(part, "fields"), []), "field"):
            fields[text_of(field, "name")] = field[2] if len(field) > 2 else ""
        ref = text_of(part, "ref")
        properties = {text_of(p, "name") for p in children(part, "property")}
        components[ref] = Component(ref, text_of(part, "value"), fields.get("MPN", ""), "dnp" not in properties)
    pins = {}
    for net in children(next(children(root, "nets")), "net"):
        name = text_of(net, "name")
        if not name.startswith("unconnected-"):
            for node in children(net, "node"):
                pins[text_of(node, "ref"), text_of(node, "pin")] = name.rsplit("/", 1)[-1]
    return Netlist(components, pins)
