"""The committed hardware files are what the sources generate, and their numbers follow from the sources."""

import html
import math
import re

from hardware import budget, outputs
from hardware.box import sheets
from hardware.netlist import from_csv, quantity, to_csv
from hardware.sheet import netlist, wires

ROOT = outputs.ROOT


def test_committed_files_are_what_the_sources_make_and_no_others():
    assert [str(path.relative_to(ROOT)) for path in outputs.stale()] == [], "run: make hardware"
    made = set(outputs.committed())
    assert {path for folder in (outputs.OUT, outputs.DRAWINGS) for path in folder.iterdir()} <= made
    for path, text in outputs.committed().items():
        if path.parent == outputs.OUT:
            assert not re.search(r"20\d\d-\d\d-\d\d|/tmp/|/home/", text), path


def test_a_note_of_a_drawing_is_within_it():
    for sheet in outputs.DRAWINGS.glob("*.svg"):
        text = sheet.read_text(encoding="utf-8")
        x0, _, width, _ = map(float, re.search(r'viewBox="([^"]+)"', text)[1].split())
        for x, note in re.findall(r'<text class="n" x="(\d+)"[^>]*>([^<]*)<', text):
            assert float(x) + 6.0 * len(html.unescape(note)) <= x0 + width, (
                sheet.name
            )  # an 11 px sans-serif is narrower


def test_the_netlist_survives_its_text_form_and_the_parts_list_has_every_part():
    made = netlist(sheets())
    read = from_csv(to_csv(made))
    assert (read.pins, read.components) == (dict(made.pins), dict(made.components))
    rows = (outputs.OUT / "parts.csv").read_text().splitlines()[1:]
    listed = {ref for row in rows for ref in row.split(",")[1].split()}
    assert listed == set(netlist(sheets()).components)
    assert all("unpriced" in row for row in rows)
    made = netlist(sheets())
    assert quantity(made.components["C7"].value) == 220e-9
    assert quantity("4.7k 1%") == 4700
    assert quantity("33R") == 33


def test_no_two_wires_of_different_nets_meet():
    for sheet in sheets():
        drawn = wires(sheet)
        net_at = {point: net for net, points in drawn.clusters for point in points}
        for a, b in drawn.segments:
            assert net_at[a] == net_at[b]
            between = [
                point
                for point, net in net_at.items()
                if net != net_at[a]
                and min(a[0], b[0]) <= point[0] <= max(a[0], b[0])
                and min(a[1], b[1]) <= point[1] <= max(a[1], b[1])
            ]
            assert between == [], (sheet.name, a, b)


def test_twice_the_excitation_is_a_null_of_the_filter():
    """125 MHz / 49152 twice, against 125 MHz / 15 / 2 / 4096: five to one, exactly."""
    assert 2 * 15 * 2 * 4096 * 1.0 == 5 * 49152 * 1.0
    assert budget.filter_gain(2 * budget.EXCITATION_HZ, 4096) < 1e-12
    # a null moves by the slope only: 100 Hz beside it the gain is that of a mean of four of sinc3
    assert 1e-6 < budget.filter_gain(2 * budget.EXCITATION_HZ + 100, 4096) < 1e-2
    assert budget.filter_gain(0, 4096) == 1
    # sinc3's -3 dB is at 0.262 of its data rate
    rate = budget.CONVERTER_HZ / 2 / 1024
    assert abs(20 * math.log10(budget.filter_gain(0.262 * rate, 1024)) + 3.01) < 0.02


def test_the_transducers_scale_has_the_converters_impedance_in_it():
    made = netlist(sheets())
    t = budget.transducer(made)
    # by hand: 10 k over 499 from both ends, 330 k across
    loop = 330e3 / (330e3 + 2 * 10e3 * 499 / 10499)
    assert abs(t.scale - 499 / 10499 * loop) < 1e-12
    assert abs(t.scale / t.unloaded - 1) > 1e-3
    assert 10 * t.scale < 0.6  # full scale at gain 2
    assert 30 * 499 / 10499 < 1.6  # absolute maximum
