"""The trigger driver on the emulated chip: every edge once, in order, with its stamp, for any burst."""

import random

import pytest

from .bench import run_steps

SETTLE_NS = 20_000_000  # edges come after the script's start
MAKE = """
from drivers.triggers import Triggers
t = Triggers(machine, rp2, chip, 6)
buf = bytearray(6)
def edges():
    found = []
    while t.edge(buf):
        found.append([buf[0], buf[1], struct.unpack(">I", buf[2:])[0]])
    return found
"""


def toggles(times_ns, line=0):
    """Return alternating edges of a line that begins low."""
    return [[line, 1 - k % 2, SETTLE_NS + t] for k, t in enumerate(times_ns)]


def random_edges(seed, n):
    """Return edges of both inputs, at least 2 µs apart on each and 100 ns on both."""
    rng = random.Random(seed)
    levels, t, found = [0, 0], 0, []
    while len(found) < n:
        line = rng.randrange(2)
        levels[line] ^= 1
        found.append([line, levels[line], SETTLE_NS + t])
        t += rng.choice([100, 101, 333, 2000, 10_007, 100_000])
    return found


STEPS = {
    "make": {"script": MAKE + "print(edges())"},
    "random": {"script": "time.sleep_ms(40)\nprint(edges())\nprint(t.dropped)", "edges": random_edges(1, 200)},
    # both lines at one moment, and back; a pulse of 10 µs; the lines end low
    "together": {
        "script": "time.sleep_ms(21)\nprint(edges())",
        "edges": [[line, level, SETTLE_NS + t] for t, level in ((0, 1), (50_000, 0)) for line in (0, 1)]
        + toggles([100_000, 110_000]),
    },
    "output": {"script": "t.output(1)\ntime.sleep_us(500)\nt.output(0)\nt.output(0)\nprint(edges())"},
    # 700 edges wait for a ring of 256; then a few on the other line
    "burst": {
        "script": "time.sleep_ms(25)\nprint(edges())\nprint(t.dropped)",
        "edges": toggles([1000 * k for k in range(700)]) + toggles([2_000_000, 2_100_000], line=1),
    },
    "after": {"script": "time.sleep_ms(21)\nprint(edges())\nprint(t.dropped)", "edges": toggles([0, 5000])},
    "allocation": {
        "script": "time.sleep_ms(25)\nn = before = 0\ngc.collect()\nbefore = gc.mem_alloc()\nwhile t.edge(buf):\n n += 1\nt.output(0)\n"
        "t.dropped\nprint([n, gc.mem_alloc() - before])",
        "edges": toggles([3000 * k for k in range(200)]),
    },
    "stopped": {
        "script": "t.stop()\ntime.sleep_ms(21)\nprint(edges())\n"
        "print([machine.mem32[base + chip.DMA_AL1_CTRL] & chip.DMA_BUSY for base in t._bases])",
        "edges": toggles([0, 5000]),
    },
}


@pytest.fixture(scope="module")
def runs():
    return dict(zip(STEPS, run_steps(list(STEPS.values())), strict=True))


def check(found, run, step):
    """The edges that the lines made, with stamps of the microsecond in which DMA read the timer, at most 0.3 µs after the edge."""
    made = sorted(
        ([line, level, run["sentNs"] + after] for line, level, after in STEPS[step]["edges"]),
        key=lambda edge: (edge[2], edge[0]),
    )
    assert [edge[:2] for edge in found] == [edge[:2] for edge in made]
    late_us = [stamp - ns / 1000 for (_, _, stamp), (_, _, ns) in zip(found, made, strict=True)]
    assert min(late_us) > -1
    assert max(late_us) <= 0.3


def test_every_edge_of_both_lines_is_stamped(runs):
    assert runs["make"]["out"] == [[]]
    found, dropped = runs["random"]["out"]
    check(found, runs["random"], "random")
    assert dropped == 0


def test_lines_that_change_together_and_a_pulse_of_10_us(runs):
    (found,) = runs["together"]["out"]
    check(found, runs["together"], "together")
    assert found[0][2] == found[1][2]
    assert 9 <= found[-1][2] - found[-2][2] <= 11


def test_the_boxs_own_output_is_line_2(runs):
    (found,) = runs["output"]["out"]
    assert [edge[:2] for edge in found] == [[2, 1], [2, 0]]
    late_us = [stamp - ns / 1000 for (_, _, stamp), (_, ns) in zip(found, runs["output"]["outputs"], strict=True)]
    assert -1 < min(late_us) <= max(late_us) <= 0.3


def test_what_a_burst_overwrites_is_counted_and_edges_after_it_are_as_before(runs):
    found, dropped = runs["burst"]["out"]
    assert len(found) + dropped == 702
    assert len(found) >= 120  # half the ring, but what is being written
    made = STEPS["burst"]["edges"][-len(found) :]
    sent = runs["burst"]["sentNs"]
    assert [edge[:2] for edge in found] == [edge[:2] for edge in made]
    assert all(-1 < stamp - (sent + ns) / 1000 <= 0.3 for (_, _, stamp), (_, _, ns) in zip(found, made, strict=True))
    found, dropped = runs["after"]["out"]
    check(found, runs["after"], "after")
    assert dropped == runs["burst"]["out"][1]


def test_nothing_is_allocated_and_a_watcher_that_was_stopped_writes_no_more(runs):
    assert runs["allocation"]["out"] == [[200, 0]]
    assert runs["stopped"]["out"] == [[], [0, 0]]
