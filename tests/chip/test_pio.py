"""The programs of the drivers on an interpreter of our own, cycle by cycle, and the emulator's PIO against it.

Three parties that share no code: pio_reference.py (the datasheet's chapter 3, plainly), hil_sim/chip/pio.mjs (event-driven, with
fast-forward), and the formulas in the drivers' docstrings.
"""

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest

from truearm_sim import node

from .bench import run_steps
from .pio_reference import Block, Program

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "firmware"))

from drivers import magnetostrictive  # noqa: E402

BENCH = Path(__file__).with_name("pio_bench.mjs")
INTERROGATION, STOP = 2, 3


PULSES = (1000, 7)  # ns of a start pulse, the pacer's rounds for it
ASSEMBLED = f"""
from drivers import ads131m04_dma, ds18b20, magnetostrictive, triggers
for made in (
    magnetostrictive.pacer_program(rp2, {PULSES[1]}), magnetostrictive.counter_program(rp2), magnetostrictive.gate_program(rp2),
    ads131m04_dma.program(rp2), ads131m04_dma.counter_program(rp2), triggers.program(rp2), ds18b20.program(rp2),
):
    side = made[7]
    print([list(made[0]), made[3], made[4], 0 if side is None else 1 if isinstance(side, int) else len(side)])
"""


@pytest.fixture(scope="module")
def programs():
    """Return the drivers' programs as the chip's MicroPython assembles them: pacer, counter, gate, and those of the other block."""
    assert magnetostrictive.pulse_rounds(PULSES[0]) == PULSES[1]
    (step,) = run_steps([{"script": ASSEMBLED}])
    return [Program.assembled(*made) for made in step["out"]]


def test_both_blocks_have_room_for_the_programs(programs):
    pacer, counter, gate, *others = (len(program.words) for program in programs)
    assert pacer + max(counter, gate) <= 32
    assert sum(others) <= 32


def test_each_request_paces_one_dma_channel():
    """RP2040 datasheet, 2.5.3: channels should not share a DREQ. Every channel that a driver sets up, by its control word."""
    script = """
from board import CONVERTER_MACHINE, CONVERTER_PINS, HEAD_BLOCK, HEAD_PINS, TRIGGER_MACHINE, TRIGGER_PINS
from drivers.ads131m04_dma import Adc
from drivers.magnetostrictive import Magnetostrictive
from drivers.triggers import Triggers
sources = (Triggers(machine, rp2, chip, TRIGGER_PINS, TRIGGER_MACHINE), Adc(machine, rp2, chip, CONVERTER_PINS, CONVERTER_MACHINE), Magnetostrictive(machine, rp2, chip, HEAD_PINS, HEAD_BLOCK))
print([setup[3] >> 15 & 63 for source in sources for setup in source._setups])
"""
    (step,) = run_steps([{"script": script}])
    (requests,) = step["out"]
    paced = [request for request in requests if request != 63]  # 63 is none: as fast as it goes
    assert len(requests) == 9
    assert len(set(paced)) == len(paced) == 6


# -- the magnetostrictive programs against random flights


class Head:
    """Drives the stop pin with pulses at given times after the interrogation edge, in ticks."""

    def __init__(self, pulses):
        self.pulses = pulses  # (begin, end) in ticks after the edge
        self.edge = None

    def level(self, time):
        """Return the level just before `time`, in ticks."""
        return self.edge is not None and any(self.edge + begin < time <= self.edge + end for begin, end in self.pulses)


def shots(programs, period_ns, blanking_ns, timeout_ns, heads, edge=magnetostrictive.FIRST):
    """Run the three state machines for len(heads) shots; return the counts of each, their references, edges and pulse ends (ticks)."""
    block = Block()
    busy, y, first, n, top = magnetostrictive.timing(blanking_ns, timeout_ns, PULSES[1])
    rest = period_ns // 8 - busy
    pacer, counter, gate, *_ = programs
    counter = gate if edge == magnetostrictive.GATE else counter
    inverted = edge != magnetostrictive.FIRST
    for i in range(2):
        block.load(i, counter, 0, y=first, osr=n, osr_count=0, jmp_pin=STOP)
    block.load(2, pacer, len(counter.words), side_base=INTERROGATION, y=y, osr=rest, x=(1 << 32) - 1, isr=(1 << 32) - 1)
    for machine in block.machines[:3]:
        machine.enabled = True
    edges, ends, was = [], [], 0
    for _ in range(len(heads) * period_ns // 8 - 20):  # the last shot's next edge is not wanted
        head = heads[max(0, len(edges) - 1)]
        block.pads = (head.level(block.now) ^ inverted) << STOP  # what the edge at the begin of this cycle samples
        block.cycle()
        for machine in block.machines:
            machine.rx.clear()  # as DMA does
        now = block._next[0] >> INTERROGATION & 1  # on the pad from the end of this cycle
        if now and not was:
            edges.append(block.now)
            heads[len(edges) - 1].edge = block.now
        elif was and not now:
            ends.append(block.now)
        was = now
    counts = [[word for _, i, word in block.pushed if i == k] for k in range(3)]
    assert counts[2] == [(1 << 32) - 1 - k for k in range(len(heads))]  # the shots' numbers
    pairs = [[x - (1 << 32) if x >> 31 else x for x in pair] for pair in zip(counts[0], counts[1], strict=True)]
    return list(zip(pairs[::2], pairs[1::2], strict=True)), top, edges, ends


def ticks_of(counted, top):
    """Return the driver's `unload` of the counts of start and stop."""
    if any(x0 < 0 or x1 - x0 not in (0, 1) for x0, x1 in counted):
        return 0
    start, stop = counted
    return top + sum(start) - sum(stop)


START = (6.5, 130)  # a start pulse; its tick is 6


def test_edges_at_the_borders_of_blanking_and_time_out(programs):
    blanking, timeout = 625, 1000  # ticks
    ends = [blanking - 1, blanking - 0.5, blanking + 0.001, blanking + 1, timeout - 2, timeout + 1.5, timeout + 5]
    heads = [Head([START, (end, end + 60)]) for end in ends]
    counted, top, _, _ = shots(programs, 8 * timeout + 10000, 8 * blanking, 8 * timeout, heads)
    found = [ticks_of(pair, top) for pair in counted]
    # within the blanking; in its last tick; just behind it; ...; behind the time-out
    assert found == [0, 0, blanking - 6, blanking + 1 - 6, timeout - 2 - 6, 0, 0]


def test_an_edge_counts_and_not_a_level(programs):
    heads = [
        Head([START]),  # no stop
        Head([(5, 700), (800, 925)]),  # a start pulse longer than the blanking
        Head([(-1e9, 1e9)]),  # a broken line: the receiver's output is high
        Head(
            [START, (600, 640), (660, 670), (900, 1000)]
        ),  # ringing within the blanking, and after it: the first edge counts
        Head([START, (750, 751), (850, 950)]),  # 8 ns: one counter alone sees it
        Head([(750, 875)]),  # no start pulse
        Head([(620, 640), (750, 875)]),  # one that comes too late
        Head([START, (700.5, 800), (810, 900)]),
    ]
    counted, top, _, _ = shots(programs, 18400, 5000, 8000, heads)
    assert [ticks_of(pair, top) for pair in counted] == [0, 795, 0, 654, 0, 0, 0, 694]


def test_a_gate_that_does_not_begin_or_end_is_none(programs):
    heads = [
        Head([]),
        Head([(6.5, 2300)]),  # it does not end
        Head([(6.5, 800)]),
        Head([(700, 800)]),  # it begins behind the blanking
        Head([(-1e9, 1e9)]),
        Head([(20.5, 900)]),
    ]
    counted, top, _, _ = shots(programs, 18400, 5000, 8000, heads, edge=magnetostrictive.GATE)
    assert [ticks_of(pair, top) for pair in counted] == [0, 0, 794, 0, 0, 880]


# -- the emulator against the interpreter


def random_program(rng):
    """Instructions, more of those that loop, count, wait and look at pins than of others."""
    words = []
    for at in range(8):
        kind = rng.choice([0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 7])
        low = rng.randrange(256)
        if kind == 0:  # jumps back, mostly on a count or the pin
            low = rng.choice([0, 2, 2, 4, 6, 6, 1, 3, 5, 7]) << 5 | max(0, at - rng.randrange(4))
        elif kind == 1:
            low = rng.choice([0x00, 0x80]) | rng.choice([0x20 | rng.randrange(4), 0x40 | rng.choice([4, 5, 20, 21])])
        elif kind in (3, 5) and low >> 5 in (4, 5, 7):
            low &= 0x7F if kind == 3 else 0x5F  # no random jumps or instructions out of data
        elif kind == 4:
            low = rng.choice([0x00, 0x20, 0x80, 0xA0, 0x40, 0xC0])
        elif kind == 6:
            low = rng.choice([0x04, 0x05, 0x14, 0x44, 0x45, 0x24])
        delay = rng.choice([0, 0, 0, 1, 3])
        side = rng.choice([0, 0, 8, 12])
        words.append(kind << 13 | (side | delay) << 8 | low)
    words[-1] = rng.randrange(3) << 8 | rng.randrange(4)  # jump back
    return Program(
        words, rng.randrange(3), 7, 2, True, rng.random() < 0.5, rng.random() < 0.5, rng.random() < 0.3, rng.random() < 0.3,
        rng.choice([3, 8, 32]), rng.choice([3, 8, 32]), rng.randrange(3),
    )  # fmt: skip


CONFIG = {"in_base": 4, "out_base": 8, "out_count": 3, "set_base": 12, "set_count": 2, "side_base": 16, "jmp_pin": 5}


def scenario(rng, cycles):
    """Four random machines, levels that change on pins 4 to 7, and a processor that reads and writes FIFOs: (cycle, what, ...)."""
    machines = [
        {
            "program": random_program(rng),
            "x": rng.choice([0, 1, 3, 17, 200, 5000]),
            "y": rng.choice([0, 1, 3, 17, 200, 5000]),
            "divider": rng.choice([256, 256, 256, 512, 700]),
            "tx": [rng.randrange(1 << 32) for _ in range(4)],
        }
        for _ in range(4)
    ]
    edges = [(rng.randrange(2, cycles), "toggle", rng.randrange(4, 8)) for _ in range(rng.choice([0, 5, 60]))]
    reads = [(rng.randrange(2, cycles), "read", rng.randrange(4)) for _ in range(rng.choice([0, 40]))]
    writes = [
        (rng.randrange(2, cycles), "write", rng.randrange(4), rng.randrange(1 << 32))
        for _ in range(rng.choice([0, 40]))
    ]
    return machines, sorted([*edges, *reads, *writes], key=lambda event: event[0])


def reference_run(machines, events, cycles):
    block = Block()
    for i, one in enumerate(machines):
        found = block.load(i, one["program"], 8 * i, x=one["x"], y=one["y"], divider=one["divider"], **CONFIG)
        found.tx.extend(one["tx"][: found.tx_depth])
        found.enabled = True
    pins, reads, last, pending = [], [], (0, 0), list(events)
    for _ in range(cycles):
        block.cycle()
        while pending and pending[0][0] == block.now - 1:  # within the cycle: seen from the next on
            _, what, index, *word = pending.pop(0)
            if what == "toggle":
                block.pads ^= 1 << index
            elif what == "write" and len(block.machines[index].tx) < block.machines[index].tx_depth:
                block.machines[index].tx.append(word[0])
            elif what == "read" and block.machines[index].rx:
                reads.append(block.machines[index].rx.popleft())
        if tuple(block._next) != last:
            last = tuple(block._next)
            pins.append([block.now, last[0], last[1]])
    state = [[m.x, m.y, m.pc, m.isr, m.osr, m.isr_count, m.osr_count, list(m.rx), list(m.tx)] for m in block.machines]
    return {"pins": pins, "reads": reads, "state": state, "flags": block.flags}


def emulator_runs(scenarios, cycles, fast):
    """Run the same in the emulator, all in one process."""

    def described(one):
        return {**one, "program": vars(one["program"])}

    message = {
        "cycles": cycles,
        "fast": fast,
        "config": CONFIG,
        "scenarios": [
            {"machines": [described(m) for m in machines], "events": events} for machines, events in scenarios
        ],
    }
    command = [str(node.ready().path), str(BENCH)]
    done = subprocess.run(command, input=json.dumps(message), capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


def compare(seed, n, cycles):
    """Scenarios in the interpreter and in the emulator. Returns the ticks that fast-forward saved."""
    rng = random.Random(seed)
    scenarios = [scenario(rng, cycles) for _ in range(n)]
    fast, stepped = emulator_runs(scenarios, cycles, True), emulator_runs(scenarios, cycles, False)
    saved = 0
    for k, (machines, events) in enumerate(scenarios):
        expected = reference_run(machines, events, cycles)
        saved += stepped[k].pop("done") - fast[k].pop("done")
        assert stepped[k] == expected, (seed, k)
        assert fast[k] == expected, (seed, k)
    return saved


def test_the_emulators_pio_does_what_the_datasheet_says_stepped_and_fast_forwarded():
    saved = compare(4, 60, 2000)
    assert saved > 60 * 4 * 2000 / 10  # ticks: else nothing was proved of fast-forward


def test_fast_forward_is_stepping_over_long_times_too():
    rng = random.Random(5)
    scenarios = [scenario(rng, 500) for _ in range(40)]
    fast, stepped = emulator_runs(scenarios, 20000, True), emulator_runs(scenarios, 20000, False)
    for one in (*fast, *stepped):
        one.pop("done")
    assert fast == stepped


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(100, 130))
def test_many_programs(seed):
    compare(seed, 100, 2000)
