"""KiCad's electrical rules check, its own netlist, and the simulations. Skipped without KiCad or ngspice."""

import pytest

from hardware import __main__ as commands
from hardware import budget, lvdt_check, outputs, power_up, spice, spice_check, stress
from hardware.box import sheets
from hardware.netlist import Component, Netlist
from hardware.sheet import netlist
from hardware.spice import Circuit


def test_kicad_finds_no_fault_and_reads_the_same_netlist_and_pins(tools):
    assert commands.erc(tools) == []
    assert commands.same_netlist(tools, netlist(sheets())) == []
    assert commands.same_pins(tools) == []


def test_the_rules_check_would_find_a_pin_that_nothing_drives(tools, monkeypatch):
    monkeypatch.setattr(outputs, "FLAGS", {})
    assert any("power_pin_not_driven" in text for text in commands.erc(tools))


# Of 200 Ω, whose ratio changes most at the corners of the filter's tolerances; all in make soak.
WORST = [budget.LVDTS[0]]


@pytest.mark.parametrize(
    ("lvdts", "every"), [(WORST, 3), pytest.param(budget.LVDTS, 1, marks=pytest.mark.soak)], ids=["some", "all"]
)
def test_the_simulated_box_does_what_the_document_says(tools, monkeypatch, lvdts, every):
    """With every third of the shorts and faults, and with all."""
    states = stress.states
    monkeypatch.setattr(budget, "LVDTS", lvdts)
    monkeypatch.setattr(stress, "states", lambda circuit: [*states(circuit)][::every])
    rows = spice_check.check(tools, netlist(sheets()))
    assert [(row.what, row.measured, row.wanted) for row in rows if not row.passed] == []
    assert len(rows) > 120 // every + 11 * len(lvdts)


def changed(**values):
    """Return the box with other values, by reference."""
    made = netlist(sheets())
    parts = dict(made.components)
    for ref, value in values.items():
        parts[ref] = Component(ref, value, parts[ref].mpn)
    return Circuit(Netlist(parts, made.pins))


def failed(tools, circuit, name):
    state = next(state for state in stress.states(circuit) if state.name == name)
    return "; ".join(row.measured for row in stress.check(tools, circuit, state) if not row.passed)


@pytest.mark.parametrize(
    ("values", "state", "words"),
    [
        ({"R46": "4.7k"}, "+30 V across J9", "R46 power 12"),
        ({"R8": "4.7k"}, "-30 V on J3.1", "R8 power"),
        ({"R51": "220R"}, "-30 V on J1.2", "R51 power"),
        ({"R5": "10R"}, "-30 V on J1.1", "Q3 power"),
        ({"R35": "4.7k"}, "+30 V on J5.4", "R35 power"),
    ],
)
def test_a_part_that_burns_is_found(tools, values, state, words):
    assert words in failed(tools, changed(**values), state)


def test_a_fuse_that_may_not_interrupt_30_v_is_found(tools):
    made = netlist(sheets())
    weak = Component("F4", "0.2A 60V", "MF-MSMF020-2")  # 30 V
    circuit = Circuit(Netlist({**made.components, "F4": weak}, made.pins))
    assert failed(tools, circuit, "-30 V on J6.1").startswith("F4 voltage")


@pytest.mark.parametrize(
    ("lvdt", "words"),
    [
        (budget.Lvdt("beyond", 300e-3, 60, 60e-3, 300, 0.064, 0.24), "self-test"),
        (budget.Lvdt("beyond", 125e-3, 60, 400e-3, 2000, 0.064, 0.6), "10 → 60"),
    ],
)
def test_an_lvdt_beyond_the_range_is_found(tools, lvdt, words):
    rows = lvdt_check.check(tools, Circuit(netlist(sheets())), lvdt)
    assert any(words in row.what for row in rows if not row.passed)


def test_an_lvdt_with_the_parts_that_it_can_reach_is_as_with_the_whole_box(tools, monkeypatch):
    """Every printed digit is the same. The triggers and the sensors' supply are left out, the converter's is not."""
    circuit, lvdt = Circuit(netlist(sheets())), budget.LVDTS[0]
    kept = spice.reached(circuit.lines(), lvdt_check.sensor(circuit, lvdt, 1.0, 40.0))
    names = {element.split()[0] for element in kept}
    assert {"VU1", "VU2", "XU4A", "XU5A", "DU310"} < names
    assert names.isdisjoint({"XU9", "QQ1", "QQ3", "RF4"})
    part = lvdt_check.signals(tools, circuit, lvdt, 1.0, 40.0)
    monkeypatch.setattr(spice, "reached", lambda elements, bench: elements)
    assert part == lvdt_check.signals(tools, circuit, lvdt, 1.0, 40.0)


def test_a_filter_that_passes_the_harmonics_is_found(tools):
    """As it was, with an LVDT of 200 Ω, the worst for it."""
    circuit = changed(C17="10n", C18="4.7n", C19="2.2n")
    rows = lvdt_check.check(tools, circuit, budget.LVDTS[3])
    assert any("10 → 60" in row.what for row in rows if not row.passed)


def test_a_filter_with_capacitors_of_a_wider_tolerance_is_found(tools, monkeypatch):
    circuit, lvdt = Circuit(netlist(sheets())), budget.LVDTS[3]
    assert lvdt_check.corner(circuit, (0, 0, 0)).lines() == circuit.lines()
    monkeypatch.setattr(lvdt_check, "TOLERANCES", {"C": 0.1, "R": 0.01})
    failed = [row.what for row in lvdt_check.corners(tools, circuit, lvdt) if not row.passed]
    assert any("10 → 60" in what for what in failed)


@pytest.mark.parametrize(
    ("values", "failed"), [({"R2": "20k"}, ["U1.GP27"]), ({"R21": "22k"}, ["U4.OUTB", "J5.3", "J5.4", "J5.5"])]
)
def test_the_readings_of_the_first_power_up_show_a_wrong_part(tools, values, failed):
    rows = power_up.check(tools, changed(**values))
    assert [row.what for row in rows if not row.passed] == [f"switched on, {pin}: V" for pin in failed]


def test_a_supply_that_a_fault_raises_and_an_input_that_floats_are_found(tools):
    rows = stress.switched_off(tools, changed(R56="1k"))
    assert [row.what for row in rows if not row.passed] == ["box off, +30 V on J1.2: V at 3V3"]
    circuit = changed(R53="10M")
    assert [row.what for row in spice_check.without_pico(tools, circuit) if not row.passed] == [
        "Pico out of its sockets, 10 µA into U6.IN1: V"
    ]
