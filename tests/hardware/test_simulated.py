"""KiCad's electrical rules check, its own netlist, and the simulations. Skipped without KiCad or ngspice."""

import pytest

from hardware import __main__ as commands
from hardware import kicad, outputs, spice_check
from hardware.box import sheets
from hardware.sheet import netlist


@pytest.fixture(scope="module")
def tools():
    try:
        return kicad.find()
    except kicad.NoTools as error:
        pytest.skip(str(error))


def test_the_rules_check_finds_nothing(tools):
    assert commands.erc(tools) == []


def test_the_rules_check_would_find_a_pin_that_nothing_drives(tools, monkeypatch):
    monkeypatch.setattr(outputs, "FLAGS", {})
    assert any("power_pin_not_driven" in text for text in commands.erc(tools))


def test_kicad_reads_the_same_netlist(tools):
    assert commands.same_netlist(tools, netlist(sheets())) == []


def test_the_data_sheets_pins_are_those_of_kicads_symbols(tools):
    assert commands.same_pins(tools) == []


def test_the_simulated_box_does_what_the_document_says(tools):
    rows = spice_check.check(tools, netlist(sheets()))
    assert [(row.what, row.measured, row.wanted) for row in rows if not row.passed] == []
    assert len(rows) > 70
