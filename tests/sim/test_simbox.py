"""The simulated box as a thing: power, flash, inputs and outputs; and the magnetostrictive head of the world."""

import cbor2
import numpy as np
import pytest

from truearm_sim import micropython, sensors
from truearm_sim.hardware import Edge, Signals
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


def test_flight_times_are_those_of_the_magnet():
    n, start, period = 4000, 5 * 10**9, 983_040
    flights = WORLD.flight_times(0, n, start, period)
    t = WORLD.clocks.device.true(1e-9 * (start + np.arange(n) * period))
    position = WORLD.magnet_position(t)
    delay = 1e-12 * flights - position * 9.05e-6 / 0.0254 - 1.2e-6
    assert abs(delay.mean()) < 5 * 1.8e-9 / np.sqrt(n)
    assert delay.std() == pytest.approx(1.8e-9, rel=5 / np.sqrt(2 * n))


def test_the_magnet_stays_within_its_stroke_and_rests_while_the_bar_is_off():
    t = np.arange(0.0, WORLD.duration, 0.01)
    position = WORLD.magnet_position(t)
    assert position.min() >= MAG_STROKE[0]
    assert position.max() <= MAG_STROKE[1]
    off = ~WORLD.controller.bar_is_on(t)
    assert np.all(position[off] == MAG_MIDDLE)
    assert np.ptp(position[~off]) > 0.05


def test_stops_are_lost_by_the_share_and_between_the_times_that_were_asked_for():
    world = World(4, standard_plan(9, 4), setup=Setup(mag_period_ns=983_040, lost_stops=0.1))
    n = 20_000
    lost = np.mean(world.flight_times(0, n, 0, 983_040) < 0)
    assert abs(lost - 0.1) < 5 * np.sqrt(0.09 / n)
    kept = world.flight_times(0, n, 0, 983_040)
    assert np.array_equal(kept[kept >= 0], WORLD.flight_times(0, n, 0, 983_040)[kept >= 0])
    t_s = (2.0, 2.01)
    signals = Signals(WORLD, WORLD.device_clock.from_true_ns(10**9), (t_s,))
    flights = signals.flight_times(0, 2000, 0, 983_040)
    t = WORLD.clocks.device.true(1e-9 * (signals.boot_device_ns + np.arange(2000) * 983_040))
    assert np.array_equal(flights < 0, (t >= t_s[0]) & (t < t_s[1]))
    assert (flights < 0).sum() in (10, 11)


def test_what_the_configuration_says_of_the_head_is_what_the_head_does():
    head = WORLD.box_config()["magnetostrictive"]
    assert head["period_ns"] == 983_040
    assert head["us_per_inch"][0] * 10.0 ** head["us_per_inch"][1] == pytest.approx(25400.0 / sensors.SOUND, rel=1e-15)
    assert head["delay_ns"] == sensors.MAG_DELAY_NS
    assert World(4, standard_plan(9, 4)).box_config()["magnetostrictive"]["period_ns"] == 0
    earliest, latest = (p / sensors.SOUND * 1e9 + head["delay_ns"] for p in MAG_STROKE)
    assert head["blanking_ns"] < earliest < latest < sensors.magnetostrictive(250_000)["timeout_ns"]
