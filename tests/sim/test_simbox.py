"""The simulated box as a thing: power, flash, inputs and outputs; and the magnetostrictive head of the world."""

import cbor2
import numpy as np
import pytest

from truearm_sim import micropython
from truearm_sim.hardware import Edge
from truearm_sim.simbox import Fault, SimulatedBox
from truearm_sim.world import MAG_MIDDLE, MAG_STROKE, Setup, World, standard_plan
from truearm_wire import frame, messages

WORLD = World(4, standard_plan(9, 4), setup=Setup(mag_period_ns=983_040))
MS = 1_000_000


class Talk:
    """A box that runs in steps of a millisecond, and the frames that it sent."""

    def __init__(self, **arguments):
        self.box = SimulatedBox(WORLD, micropython.find(), **arguments)
        self.t_ns = 0

    def run(self, ms=1, *commands):
        rx, found = b"".join(frame.frame(messages.encode_payload(list(c))) for c in commands), []
        for _ in range(ms):
            self.t_ns += MS
            for tx in self.box.advance(self.t_ns, rx):
                for run in filter(None, tx.split(b"\0")):
                    payload = frame.unframe(run)
                    found.append(messages.decode_payload(payload) if payload else run)
            rx = b""
        return found


@pytest.fixture
def talk():
    made = []

    def make(**arguments):
        made.append(Talk(**arguments))
        return made[-1]

    yield make
    for each in made:
        each.box.close()


def beats(found):
    return [dict(zip(messages.names(18), f[1:], strict=True)) for f in found if f[0] == messages.HEARTBEAT]


def document(found, kind):
    return cbor2.loads(b"".join(f[5] for f in found if f[0] == kind))


def test_flash_outlives_the_power(talk):
    box = talk()
    box.run(2)
    config = document(box.run(1, (messages.GET_CONFIG, 1)), messages.REPLY)
    for k, page in enumerate(messages.pages(cbor2.dumps({**config, "osr": 256}))):
        box.run(1, (messages.PUT_CONFIG, 2 + k, *page))
    box.box.power_cycle(box.t_ns)
    found = box.run(2500)
    assert document([f for f in found if f[0] == messages.IDENT], messages.IDENT)["streams"][0]["osr"] == 256
    assert {beat["reset_cause"] for beat in beats(found)} == {1}


def test_at_the_prompt_the_box_is_silent_until_power_fails(talk):
    box = talk()
    box.run(2)
    assert box.run(2, (messages.TO_REPL, 1))[0][0] == messages.REPLY
    assert box.run(3000, (messages.IDENTIFY, 2)) == []
    box.box.power_cycle(box.t_ns)
    assert beats(box.run(2500))


def test_the_output_is_seen_and_goes_with_the_power(talk):
    box = talk()
    box.run(2)
    found = box.run(2, (messages.PULSE, 1, 1))
    assert box.box.output
    assert [f[2:] for f in found if f[0] == messages.EVENT] == [[2, box.box.device_us(box.t_ns - MS), 1]]
    box.box.power_cycle(box.t_ns)
    assert not box.box.output


def test_edges_reach_the_box_at_their_time_and_not_before_it_has_power(talk):
    edges = [Edge(1 + 10 * k * MS, k % 2, k % 3 == 0) for k in range(6)]
    box = talk(edges=edges, faults=[])
    found = box.run(100)
    events = [f for f in found if f[0] == messages.EVENT]
    assert [(f[2], f[4]) for f in events] == [(e.line, int(e.rising)) for e in edges[1:]], (
        "the first came before the boot"
    )
    assert [f[3] for f in events] == [box.box.device_us(e.t_ns) for e in edges[1:]]


def test_without_a_watchdog_it_stands_still_for_ever(talk):
    box = talk(faults=[Fault(0.1, "hang")])
    box.run(2)
    config = document(box.run(1, (messages.GET_CONFIG, 1)), messages.REPLY)
    for k, page in enumerate(messages.pages(cbor2.dumps({**config, "watchdog_ms": 0}))):
        box.run(1, (messages.PUT_CONFIG, 2 + k, *page))
    box.run(100, (messages.START, 50))
    assert box.run(6000) == []


def test_long_waits_come_in_batches_and_nothing_is_left_out(talk):
    box = talk()
    box.run(2)
    box.run(1, (messages.START, 1))
    box.t_ns += 450 * MS  # 458 samples of both in one step: five grants
    found = box.run(1)
    for stream, block in ((0, 13), (1, 52)):
        n0 = [f[3] for f in found if f[0] == messages.DATA and f[2] == stream]
        assert n0 == [block * k for k in range(len(n0))]
        assert len(n0) == 458 // block


# -- the head


def test_the_magnet_stays_within_its_stroke_and_rests_while_the_bar_is_off():
    t = np.arange(0.0, WORLD.duration, 0.01)
    position = WORLD.magnet_position(t)
    assert position.min() >= MAG_STROKE[0]
    assert position.max() <= MAG_STROKE[1]
    off = ~WORLD.controller.bar_is_on(t)
    assert np.all(position[off] == MAG_MIDDLE)
    assert np.ptp(position[~off]) > 0.05
