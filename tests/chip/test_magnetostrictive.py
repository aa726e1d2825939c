"""The magnetostrictive driver on the emulated chip, compared with the model head's record of every shot."""

import random

import pytest

from .bench import run_steps

PERIOD_NS = 983040
MAKE = """
from drivers import magnetostrictive as d
from drivers.magnetostrictive import Magnetostrictive
m = Magnetostrictive(machine, rp2, chip, (2, 3))
one = bytearray(4); at = bytearray(8); stamp = bytearray(4)
def shots(n, ms):
    found = []
    time.sleep_ms(ms)
    while len(found) < n:
        if m.take(1, one, 0, at, stamp):
            found.append((struct.unpack("<i", one)[0], struct.unpack(">Q", at)[0], struct.unpack(">I", stamp)[0], m.fault()))
    return found
def show(found):
    print([list(shot) for shot in found])
"""


def flights_ps(seed, n, low_us=12, high_us=480):
    rng = random.Random(seed)
    return [rng.randrange(low_us * 10**6, high_us * 10**6) for _ in range(n)]


def counted(flight, start_ns=44):
    """Return the count for a head that answers after start_ns: the tick of the stop minus that of the start."""
    return (start_ns * 1000 + flight) // 8000 - start_ns // 8 if flight >= 0 else 0


def check(shots, truth, first=0):
    """Check that counts are flights in ticks, indices are contiguous, and stamps are those of the interrogation edges."""
    assert [ticks for ticks, *_ in shots] == [counted(flight) for _, _, flight, _ in truth]
    assert [index for _, index, *_ in shots] == list(range(first, first + len(shots)))
    late_us = [stamp - edge_ns / 1000 for (_, _, stamp, _), (_, edge_ns, _, _) in zip(shots, truth, strict=True)]
    assert min(late_us) > -1
    assert max(late_us) <= 0.3  # the microsecond begun when DMA reads the timer


@pytest.fixture(scope="module")
def runs():
    """One boot for all; each test looks at its own step."""
    noisy = flights_ps(1, 160)
    lost = [-1 if k % 7 == 3 else flight for k, flight in enumerate(flights_ps(2, 100))]
    steps = {
        "make": {"script": MAKE},
        "plain": {
            "script": "m.configure(10000, 500000)\nm.start(983040)\nfound = shots(150, 149)\nm.stop()\nshow(found)\nprint([m.lost(), m.missing])",
            "flightsPs": noisy,
            "controls": [{"part": "mag", "ringing": [[1500, 700], [3000, 500], [7000, 400]]}],
        },
        "lost": {
            "script": "m.start(983040)\nfound = shots(60, 60)\nm.stop()\nshow(found)\nprint([m.lost(), m.missing])",
            "flightsPs": lost,
        },
        "stuck": {
            "script": "m.start(983040)\nfound = shots(12, 12)\nm.stop()\nshow(found)",
            "flightsPs": flights_ps(3, 10),
            "controls": [{"part": "mag", "stuck": True}],
        },
        "startless": {
            "script": "m.start(983040)\nfound = shots(20, 20)\nm.stop()\nshow(found)",
            "flightsPs": flights_ps(3, 10),
            "controls": [
                {"part": "mag", "stuck": False, "ringing": [], "start": False},
                {"part": "mag", "start": True, "afterMs": 15},
            ],
        },
        "second": {  # start pulses of 4 µs, as of Balluff's heads, and stop pulses that are as long
            "script": "m.configure(10000, 500000, d.SECOND)\nm.start(983040)\nfound = shots(60, 60)\nm.stop()\nshow(found)",
            "flightsPs": flights_ps(7, 60, 12, 470),
            "controls": [{"part": "mag", "startPulse": {"afterNs": 300, "lengthNs": 4000}}],
        },
        "gate": {
            "script": "m.configure(10000, 500000, d.GATE)\nm.start(983040)\nfound = shots(60, 60)\nm.stop()\nshow(found)",
            "flightsPs": flights_ps(8, 60, 12, 470),
            "controls": [{"part": "mag", "startPulse": {"afterNs": 123, "lengthNs": 4000}, "gate": True}],
        },
        "first": {  # the counters of pulses once more
            "script": "m.configure(10000, 500000)\nm.start(983040)\nfound = shots(30, 30)\nm.stop()\nshow(found)",
            "flightsPs": flights_ps(9, 30, 12, 470),
            "controls": [{"part": "mag", "startPulse": {"afterNs": 44, "lengthNs": 1000}, "gate": False}],
        },
        "fast": {  # 4 kHz, as a short rod allows; a start pulse that outlasts the blanking
            "script": "m.configure(5000, 200000)\nm.start(250000)\nfound = shots(200, 40)\nm.stop()\nshow(found)",
            "flightsPs": flights_ps(4, 33, 13, 199),
            "controls": [{"part": "mag", "startPulse": {"afterNs": 44, "lengthNs": 5000}}],
        },
        "lapped": {  # nobody looks for 1300 shots of 100 µs; a ring has 256
            "script": "m.configure(5000, 80000)\nm.start(100000)\nfound = shots(3, 0)\ntime.sleep_ms(130)\n"
            "print([m.waiting(), m.lost()])\nfound += shots(5, 1)\nm.stop()\nshow(found)",
            "flightsPs": flights_ps(5, 7, 13, 60),
        },
        "allocation": {
            "script": "m.configure(10000, 500000)\nblock = bytearray(4 * 52)\n"
            "def takes(n):\n"
            " while n:\n"
            "  time.sleep_ms(40)\n"
            "  if m.take(52, block, 0, at, stamp):\n"
            "   n -= 1\n"
            "  m.waiting(); m.lost(); m.fault()\n"
            "m.start(983040)\ntakes(1)\ngc.collect()\nbefore = gc.mem_alloc()\ntakes(4)\nm.stop()\nm.start(600000)\ntakes(1)\nm.stop()\n"
            "print(gc.mem_alloc() - before)",
            "flightsPs": flights_ps(6, 9),
        },
        "misuse": {
            "script": "for call in (lambda: m.start(983041), lambda: m.start(505000), lambda: m.configure(4999, 9), lambda: m.configure(8000, 8000), lambda: d.pulse_rounds(500)):\n"
            " try:\n  call()\n  print(0)\n except ValueError as e:\n  print('\"%s\"' % e)"
        },
    }
    found = run_steps(list(steps.values()))
    return dict(zip(steps, found, strict=True))


def test_every_shot_is_measured_and_stamped(runs):
    shots, (lost, missing) = runs["plain"]["out"]
    truth = runs["plain"]["shots"]
    check(shots, truth[:150])
    assert {period for *_, period in truth[2:]} == {PERIOD_NS}  # to the cycle
    assert (lost, missing, runs["plain"]["ignored"]) == (0, 0, 0)
    assert not any(flags for *_, flags in shots)


@pytest.mark.parametrize(("edge", "start_ns"), [("second", 4300), ("gate", 123), ("first", 44)])
def test_the_edges_that_a_head_means_are_timed(runs, edge, start_ns):
    """Second edges of pulses of 4 µs, begin and end of a gate, and first edges again: to the tick."""
    (shots,) = runs[edge]["out"]
    flights = [flight for _, _, flight, _ in runs[edge]["shots"][: len(shots)]]
    assert [ticks for ticks, *_ in shots] == [counted(flight, start_ns) for flight in flights]


def test_a_shot_without_a_start_is_none_and_the_next_is_whole(runs):
    (shots,) = runs["startless"]["out"]
    truth = runs["startless"]["shots"][:20]
    without = [ticks for ticks, *_ in shots].count(0)
    assert 5 < without < 15
    assert [ticks for ticks, *_ in shots] == [0] * without + [counted(flight) for _, _, flight, _ in truth[without:]]
    assert [flags for *_, flags in shots] == [4] * without + [0] * (20 - without)


def test_missing_stops_are_zero_counted_and_flagged(runs):
    shots, (lost, missing) = runs["lost"]["out"]
    check(shots, runs["lost"]["shots"][:60])
    absent = [k % 7 == 3 for k in range(60)]
    assert [flags for *_, flags in shots] == [4 if gone else 0 for gone in absent]
    assert (lost, missing) == (0, sum(absent))


def test_broken_lines_and_misuse(runs):
    (shots,) = runs["stuck"]["out"]
    assert [ticks for ticks, *_ in shots] == [0] * 12
    assert all(isinstance(text, str) for text in runs["misuse"]["out"])
    assert runs["misuse"]["out"][1] == "the period is a multiple of 8 ns, at least 510000, not 505000"
    assert runs["allocation"]["out"] == [0]


def test_four_thousand_a_second(runs):
    (shots,) = runs["fast"]["out"]
    check(shots, runs["fast"]["shots"][:200])
    assert {period for *_, period in runs["fast"]["shots"][2:]} == {250000}


def test_a_lapped_ring_is_counted_exactly(runs):
    (waiting, lost), shots = runs["lapped"]["out"]
    truth = runs["lapped"]["shots"]
    assert waiting == 0
    assert 1280 < lost < 1350
    check(shots[:3], truth[:3])
    check(shots[3:], truth[3 + lost : 8 + lost], 3 + lost)


def test_the_stamps_pass_the_timers_wrap():
    """2^32 µs come round after about half of 120 shots."""
    wrap_ns = 2**32 * 1000
    script = (
        "left_us = -machine.mem32[chip.TIMERAWL] & 0xffffffff\nprint(left_us)\ntime.sleep_us(left_us - 60000)\n"
        "m.start(983040)\nfound = shots(120, 118)\nm.stop()\nshow(found)"
    )
    _, step = run_steps([{"script": MAKE}, {"script": script, "flightsPs": flights_ps(7, 50)}], wrap_ns - 2 * 10**9)
    _, shots = step["out"]
    truth = step["shots"][:120]
    assert truth[0][1] < wrap_ns < truth[-1][1]
    unwrapped = [[t, i, s if s > 2**31 else s + 2**32, f] for t, i, s, f in shots]
    check(unwrapped, truth)
