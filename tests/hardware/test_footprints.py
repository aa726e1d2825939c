"""Footprints: one a part, in KiCad's own libraries, with the part's pins and its package's dimensions."""

from dataclasses import replace

import pytest

from hardware import footprints
from hardware.__main__ import fitting_footprints
from hardware.box import sheets
from hardware.footprints import FOOTPRINTS, footprint_of, gap_across, misfits, read_pads
from hardware.part_check import read_needs
from hardware.parts import CATALOGUE

PARTS = [(part, CATALOGUE[part.kind.name, part.value][1]) for sheet in sheets() for part in sheet.parts]
LOGIC = {"U9": {"1", "2", "3", "4"}, "U10": {"1", "2", "3", "4"}, "U11": {"1", "2"}}


def test_every_part_has_one_and_none_is_of_a_part_that_is_not_there():
    assert {footprint_of(number) for _, number in PARTS} == set(FOOTPRINTS.values())
    assert {package for _, package in FOOTPRINTS} == {need.package for need in read_needs().values()}


def test_every_footprint_fits(tools):
    assert fitting_footprints(tools) == []


@pytest.mark.parametrize(
    ("slot", "footprint", "words"),
    [
        (("R", "0805"), "Resistor_SMD:R_0805_2013Metric", "no footprint"),
        (("R", "0805"), "Resistor_SMD:R_1206_3216Metric", "the part 2.0 mm"),
        (("C", "1210"), "Capacitor_SMD:C_0805_2012Metric", "the part 3.2 mm"),
        (("R", "axial RS02B"), "Resistor_THT:R_Axial_DIN0309_L9.0mm_D3.2mm_P12.70mm_Horizontal", "between its holes"),
        (("CHIP", "SOT-223"), "Package_TO_SOT_SMD:SOT-223-3_TabPin2", "the pads ['1', '2', '2', '3']"),
        (("CHIP", "VSSOP-10"), "Package_SO:TSSOP-10_4.4x3mm_P0.65mm", "no footprint"),
        (("CHIP", "TSSOP-20"), "Package_SO:SOIC-20W_7.5x12.8mm_P1.27mm", "a pitch of 1.27 mm"),
        (("DIODE", "SMC"), "Diode_SMD:D_SMA", "the part 7.9 mm"),
        (("TERMINAL 5", "5.08 mm"), FOOTPRINTS["TERMINAL 6", "5.08 mm"], "the pads"),
    ],
)
def test_another_footprint_is_found(tools, monkeypatch, slot, footprint, words):
    monkeypatch.setitem(FOOTPRINTS, slot, footprint)
    assert any(words in text for text in fitting_footprints(tools))


def test_the_board_under_the_isolators_is_bare(tools):
    """docs/how-to/hardware.md gives 3.8 mm under U9 and U10, 6 mm under U11."""
    gaps = {}
    for part, number in PARTS:
        if part.ref in LOGIC:
            gaps[part.ref] = gap_across(read_pads(tools.footprints, footprint_of(number)), LOGIC[part.ref])
    assert gaps == pytest.approx({"U9": 3.8, "U10": 3.8, "U11": 6.02}, abs=0.01)


def test_the_pads_under_the_parts_ends():
    left = footprints.Pad("1", -1.0, 0.0, 1.2, 1.4)
    assert misfits("0805", [left, replace(left, number="2", x=1.0)]) == []
    assert misfits("0805", [left, replace(left, number="2", x=3.0)]) != []
    assert misfits("1206", [left, replace(left, number="2", x=0.5)]) != []


def test_an_unknown_part_number_is_refused():
    with pytest.raises(KeyError, match="ERJ-6ENF1032V"):
        footprint_of("ERJ-6ENF1032V")
