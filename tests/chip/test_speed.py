"""The firmware on the emulated chip at the highest documented rate. bench/chip.py measures it; this test checks it."""

import copy
import json

import numpy as np

from tests.host.test_box_config import default
from tests.wire_frames import command
from truearm.session.frames import RATIO_STEP, parse_ident
from truearm.session.samples import with_ratios
from truearm_sim.hardware import Edge
from truearm_wire.messages import (
    CONFIGURE,
    EVENT,
    IDENT,
    IDENTIFY,
    START,
    STOP,
    STREAM_ADC,
    SYNC_REPLY,
    SYNC_REQUEST,
    TEMPERATURE,
)

from .conftest import MS, Counting, ident
from .test_box import blocks, heartbeats, indices
from .test_thermometers import there

OUTPUT = 2  # the line of the trigger output in events
OSR = 1024  # 4069 Hz
PERIOD_NS = 240 * OSR
RINGS_US = 1e-3 * 669 * PERIOD_NS  # what the converter's ring holds, the shortest of all buffers


RATIO_STEPS = 1000  # that the core moves by, to and fro


class Lvdt(Counting):
    """An LVDT's secondary and primary, demodulated, where the excitation wanders by ±20 %; the second channel says which sample it is."""

    def counts(self, k0, k1, start_ns, period_ns):
        k = np.arange(k0, k1, dtype=np.int64)
        primary = 1_200_000 + 60 * (7919 * k % 8001 - 4000)
        counts = np.zeros((k.size, 4), np.int32)
        counts[:, 0] = np.rint(ratio(k) * primary)
        counts[:, 1] = 4 * k % 2**22
        counts[:, 2] = -counts[:, 1]
        counts[:, 3] = primary
        return counts


def ratio(k):
    return (np.abs(k % (2 * RATIO_STEPS) - RATIO_STEPS) - RATIO_STEPS / 2) / RATIO_STEPS  # ±0.5


def test_at_4_khz_nothing_is_lost_no_memory_is_asked_for_and_the_rings_cover_the_longest_loop(power_on, tmp_path):
    """Both sources, an LVDT's ratio, trigger edges, two thermometers, sync requests, and the longest command that is allowed while streaming."""
    config = copy.deepcopy(default())
    config["channels"][0]["over"] = "excitation"
    config["magnetostrictive"] |= {"period_ns": PERIOD_NS, "timeout_ns": 230_000}
    chip = power_on(config=config, signals=Lvdt())
    chip.hardware.control(there(20_000, -5_000)[0])
    described = parse_ident(ident(chip.boot())).streams[STREAM_ADC]
    chip.ask(CONFIGURE, 0, OSR)
    chip.ask(START, ms=10)
    found = chip.hear(900 * MS)
    chip.hardware.control({"pico": "profile", "every_ns": 2999})
    for k in range(50):
        edge = Edge(1000 * chip.now_us + 123_456, k % 2, k % 4 < 2)
        found += chip.hear(10 * MS, rx=command(SYNC_REQUEST, 100 + k) if k % 10 == 0 else b"", edges=[edge])
    chip.hardware.control({"pico": "profiled", "file": str(tmp_path / "profile.json")})
    found += chip.ask(IDENTIFY, ms=1100)
    found += chip.ask(STOP, ms=500)
    samples = np.concatenate([np.frombuffer(f[6].data, "<i4").reshape(-1, 4) for f in blocks(found, 0)])
    assert (np.diff(samples[:, 1]) == 4).all()
    assert len(samples) > 10_000
    # secondary and primary of a sample belong together: the host's ratio is the core's, to a count of either and a step of the ratio
    k = samples[:, 1] // 4
    measured = with_ratios(samples, described.channels)[:, 0] * RATIO_STEP
    np.testing.assert_allclose(measured, ratio(k), rtol=0.0, atol=2e-6)
    shots = np.diff(indices(found, 1))
    assert len(shots) > 10_000
    assert (shots == 1).all()
    assert all(f[7] == 0 for f in blocks(found, 0) + blocks(found, 1))
    assert {(f[3], f[4]) for f in found if f[0] == TEMPERATURE} == {(0, 20_000), (1, -5_000)}
    kinds = [f[0] for f in found]
    lines = [f[2] for f in found if f[0] == EVENT]
    assert sum(line < OUTPUT for line in lines) == 50
    assert lines.count(OUTPUT) > 2700 / 150 - 1  # 2.7 s of a new box's toggles, at most 150 ms apart
    assert kinds.count(SYNC_REPLY) == 5
    assert kinds.count(IDENT) > 1
    beats = heartbeats(found)
    assert beats[-1]["overruns"] == 0
    assert max(beat["loop_max_us"] for beat in beats) < RINGS_US / 4
    profile = json.loads((tmp_path / "profile.json").read_text())
    assert profile["samples"] > 150_000
    assert "mp_map_lookup" in profile["c"]  # it did look
    assert not {"gc_alloc", "gc_collect", "gc_realloc"} & set(profile["c"])
