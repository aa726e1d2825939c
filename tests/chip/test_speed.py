"""The box's firmware on its chip at the highest rate that the documents promise. bench/chip.py measures; this holds it."""

import json

import numpy as np

from tests.wire_frames import command
from truearm_sim.hardware import Edge
from truearm_wire.messages import CONFIGURE, EVENT, IDENT, IDENTIFY, START, STOP, SYNC_REPLY, SYNC_REQUEST, TEMPERATURE

from .conftest import MS
from .test_box import blocks, heartbeats, indices
from .test_thermometers import there

OSR = 1024  # 4069 Hz
PERIOD_NS = 240 * OSR
RINGS_US = 1e-3 * 669 * PERIOD_NS  # what the converter's ring holds, the shortest of all buffers


def test_at_4_khz_nothing_is_lost_no_memory_is_asked_for_and_the_rings_cover_the_longest_loop(power_on, tmp_path):
    """Both sources, trigger edges, two thermometers, sync requests, and the longest command that is allowed while streaming."""
    chip = power_on()
    chip.hardware.control(there(20_000, -5_000)[0])
    chip.boot()
    chip.ask(CONFIGURE, 0, OSR)
    chip.ask(START, ms=10)
    found = chip.hear(1100 * MS)
    chip.hardware.control({"pico": "profile", "every_ns": 2999})
    for k in range(50):
        edge = Edge(1000 * chip.now_us + 123_456, k % 2, k % 4 < 2)
        found += chip.hear(10 * MS, rx=command(SYNC_REQUEST, 100 + k) if k % 10 == 0 else b"", edges=[edge])
    chip.hardware.control({"pico": "profiled", "file": str(tmp_path / "profile.json")})
    found += chip.ask(IDENTIFY, ms=1100)
    found += chip.ask(STOP, ms=500)
    for stream in (0, 1):
        steps = np.diff(indices(found, stream))
        assert len(steps) > (10_000, 2500)[stream]
        assert (steps == (4 if stream == 0 else 1)).all()
    assert all(f[7] == 0 for f in blocks(found, 0) + blocks(found, 1))
    assert {(f[3], f[4]) for f in found if f[0] == TEMPERATURE} == {(0, 20_000), (1, -5_000)}
    kinds = [f[0] for f in found]
    assert kinds.count(EVENT) == 50
    assert kinds.count(SYNC_REPLY) == 5
    assert kinds.count(IDENT) > 1
    beats = heartbeats(found)
    assert beats[-1]["overruns"] == 0
    assert max(beat["loop_max_us"] for beat in beats) < RINGS_US / 4
    profile = json.loads((tmp_path / "profile.json").read_text())
    assert profile["samples"] > 150_000
    assert "mp_map_lookup" in profile["c"]  # it did look
    assert not {"gc_alloc", "gc_collect", "gc_realloc"} & set(profile["c"])
