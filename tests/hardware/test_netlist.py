"""The box's netlist compared with data sheets and board_pico.py, independently of its generator; and these checks with injected faults."""

import random
from dataclasses import replace

import pytest

from hardware.box import sheets
from hardware.datasheets import data_sheet
from hardware.netlist import Component, Netlist, from_csv
from hardware.netlist_check import BOARD, board_pins, bridges, decoupled, expected, findings, isolated, pico
from hardware.outputs import OUT
from hardware.sheet import netlist

MUTATIONS = 200
SYMMETRIC = {"R", "C", "FUSE", "BEAD", "TVS_BOTH"}  # turned round they are the same circuit


@pytest.fixture(scope="module")
def made():
    return netlist(sheets())


def with_pins(made, **changes):
    """Return the netlist with the nets of some pins changed: U3_18="GND"; None opens a pin."""
    pins = dict(made.pins)
    for pin, net in changes.items():
        ref, _, number = pin.partition("_")
        if net is None:
            del pins[ref, number]
        else:
            pins[ref, number] = net
    return Netlist(made.components, pins)


def without(made, ref):
    return Netlist(
        {name: part for name, part in made.components.items() if name != ref},
        {pin: net for pin, net in made.pins.items() if pin[0] != ref},
    )


def test_the_box_and_its_committed_netlist_have_no_finding(made):
    assert findings(made) == []
    assert findings(from_csv((OUT / "netlist.csv").read_text())) == []


def test_every_chip_has_a_data_sheet_and_every_pin_of_it_is_known(made):
    for ref, number in made.pins:
        sheet = data_sheet(made.components[ref].mpn)
        if ref[0] in "UQ":
            assert sheet is not None, ref
            assert number in sheet.pins, (ref, number)


def test_every_constant_of_the_board_file_for_a_pin_is_checked():
    pins = board_pins(BOARD.read_text())
    assert {pins[n] for n in range(16, 23)} == {"DOUT", "CS", "SCLK", "DIN", "DRDY", "SYNC/RESET", "CLKIN"}
    assert {2: "DI", 3: "RO", 6: "OUT", 7: "OUT", 8: "A", 27: "VBUS"}.items() <= pins.items()


def test_a_pin_of_the_board_file_that_moves_is_found(made):
    board = BOARD.read_text()
    moved = board.replace("HEAD_PINS = (2, 3)", "HEAD_PINS = (2, 4)")
    assert moved != board
    assert any("GP4" in text for text in pico(made, moved))
    elsewhere = board.replace("THERMOMETER_PIN = 9", "THERMOMETER_PIN = 11")
    assert any("GP11" in text for text in pico(made, elsewhere))


@pytest.mark.parametrize(
    ("rule", "change", "words"),
    [
        (decoupled, {"C7_1": "AVDD"}, "U3.CAP"),
        (decoupled, {"C8_1": "GND"}, "U3.DVDD"),
        (decoupled, {"C9_1": "+3V3"}, "U3.AVDD"),
        (isolated, {"J7_2": "GND"}, "both sides"),
        (isolated, {"J9_2": "CHASSIS"}, "both sides"),
        (expected, {"U3_3": "A0N", "U3_4": "A0P"}, "R 1000"),
        (expected, {"D3_1": "VBUS", "D3_2": "THERMOMETER_5V"}, "DIODE"),
        (expected, {"U9_5": "GND"}, "U9.SUB"),
        (expected, {"R12_2": "GND"}, "R 499"),
    ],
)
def test_a_single_fault_is_found_by_its_rule(made, rule, change, words):
    assert rule(made) == []
    assert any(words in text for text in rule(with_pins(made, **change)))


def test_a_wrong_value_an_unfitted_and_a_stray_part_are_found(made):
    parts = dict(made.components)
    parts["R9"] = Component("R9", "4.99k 0.1%", parts["R9"].mpn)
    assert any("499" in text for text in findings(Netlist(parts, made.pins)))
    parts = {**made.components, "C7": replace(made.components["C7"], fitted=False)}
    assert any("U3.CAP" in text for text in findings(Netlist(parts, made.pins)))
    parts = {**made.components, "R99": Component("R99", "1M", "ERJ-6ENF1004V")}
    across = Netlist(parts, {**made.pins, ("R99", "1"): "GND", ("R99", "2"): "TI0_N"})
    assert any("R99" in text for text in isolated(across))


def test_mutations_are_found(made):
    """Two pins' nets swapped, or a part left out: the checks fail. A swap that leaves the circuit as it is is none."""
    rng = random.Random(18)
    kinds = {bridge.ref: bridge.kind for bridge in bridges(made)}
    pins, parts = sorted(made.pins), sorted(made.components)
    missed, tried = [], 0
    while tried < MUTATIONS:
        if rng.random() < 0.5:
            a, b = rng.sample(pins, 2)
            if made.pins[a] == made.pins[b] or (a[0] == b[0] and kinds.get(a[0]) in SYMMETRIC):
                continue
            mutant = Netlist(made.components, {**made.pins, a: made.pins[b], b: made.pins[a]})
            what = (a, b)
        else:
            what = rng.choice(parts)
            mutant = without(made, what)
        tried += 1
        if not findings(mutant):
            missed.append(what)
    assert len(missed) <= 0.05 * MUTATIONS, missed
