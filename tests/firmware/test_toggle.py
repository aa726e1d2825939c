"""The trigger output: random intervals within their limits, only while streaming, without allocation."""

import numpy as np
import pytest
from scipy.stats import kstest

from tests.wire_frames import command, frames
from truearm_wire import messages
from truearm_wire.messages import ERROR, EVENT, HEARTBEAT, REPLY

LIMITS = [300, 1300]
CYCLE_US = 2000


def configured(bench, limits=LIMITS):
    config = bench.document(messages.GET_CONFIG)
    config["trigger_ms"] = list(limits)
    config["watchdog_ms"] = 0
    return bench.put(config)


def edges(bench, n):
    """(line, time, edge) of the next n, by granting the box the times that it asks for."""
    found = []
    while len(found) < n:
        found += [f[2:5] for f in bench.give(us=bench.answer.wake_us) if f[0] == EVENT]
    return found


def test_edges_alternate_at_random_intervals_within_the_limits(bench):
    configured(bench)
    bench.start()
    start_us = bench.now_us
    found = edges(bench, 300)
    assert {line for line, _, _ in found} == {2}
    assert [edge for _, _, edge in found] == [1, 0] * 150
    times = np.array([start_us, *(t for _, t, _ in found)])
    waits = np.diff(times)
    assert waits.min() >= 300_000
    assert waits.max() < 1_300_000
    # Kolmogorov and Smirnov: p < 0.001 would come once in a thousand seeds, and the seed, the boot id, is fixed.
    assert kstest((waits - 300_000) / 1e6, "uniform").pvalue > 0.001
    assert kstest((times[1:] % CYCLE_US) / CYCLE_US, "uniform").pvalue > 0.001  # where in a controller's cycle
    assert abs(np.corrcoef(waits[1:], waits[:-1])[0, 1]) < 4.0 / np.sqrt(299)


def test_it_toggles_while_streaming_alone_and_ends_at_zero(bench):
    configured(bench)
    assert bench.answer.wake_us > 10**8
    assert not [f for f in bench.give(us=5_000_000) if f[0] == EVENT]
    bench.start()
    assert edges(bench, 1)[0][2] == 1
    assert bench.answer.output
    found = bench.give(rx=command(51, 7))
    assert [f[0] for f in found if f[0] in (REPLY, ERROR)] == [REPLY]
    found += bench.give(us=1000)
    assert [f[4] for f in found if f[0] == EVENT] == [0]
    assert not bench.answer.output
    assert bench.answer.wake_us > 10**8
    assert not [f for f in bench.give(us=5_000_000) if f[0] == EVENT]
    bench.give(rx=command(50, 8))
    assert [edge for _, _, edge in edges(bench, 2)] == [1, 0]


def test_a_new_box_toggles_every_50_to_150_ms(bench):
    assert bench.document(messages.GET_CONFIG)["trigger_ms"] == [50, 150]
    bench.start()
    waits = np.diff([t for _, t, _ in edges(bench, 40)])
    assert waits.min() >= 50_000
    assert waits.max() < 150_000


def test_what_a_host_of_1_1_leaves_out_is_off(bench):
    config = bench.document(messages.GET_CONFIG)
    del config["trigger_ms"]
    assert messages.REPLY in {f[0] for f in bench.put(config)}
    bench.start()
    assert bench.answer.wake_us > 10**8
    assert not [f for f in bench.give(us=5_000_000) if f[0] == EVENT]


@pytest.mark.parametrize("limits", [[10, 12], [10, 16000]])
def test_no_limits_make_an_integer_that_is_allocated(chip, limits):
    """Every loop is a step of the toggle; the longest intervals are drawn with the largest numbers."""
    configured(chip, limits)
    chip.start()
    free, events, tx = [], 0, b""
    for _ in range(1200):
        chip.sample(13)
        tx += chip.answer.tx
    for f in frames(tx):
        events += f[0] == EVENT
        if f[0] == HEARTBEAT:
            free.append(f[11])
    assert events > (1000 if limits[1] == 12 else 0)
    assert len(free) >= 12
    assert set(free[1:]) == {free[1]}, "heap_free moved while streaming"
