"""A robot identified from box data at every level: the same shell gives the same parameters."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.end_to_end.conftest import truearm
from tests.end_to_end.levels import LEVELS, wait_until_ready

from truearm.files.rig_file import format_rig
from truearm.record.recorder import RecordOptions, record
from truearm.record.session_writer import SessionWriter
from truearm.workflows.record import plan_rows
from truearm_sim import sensors
from truearm_sim.lab import Lab
from truearm_sim.simbox import SimulatedBox
from truearm_sim.world import World, standard_plan, standard_rig

OSR = 16384


def one_shell():
    """Return a rig with one chuck, one sphere and one bar."""
    rig = standard_rig()
    first = {kind: dict([next(iter(getattr(rig, kind).items()))]) for kind in ("chucks", "spheres", "bars")}
    return replace(rig, **first)


def recorded(level, poses, path):
    """Return the session of a box of this level with a robot that visits this number of poses."""
    rig = one_shell()
    plan = standard_plan(poses, 3, rig)
    world = World(3, plan, rig)
    box = SimulatedBox(world, seed=3, power_on=LEVELS[level]())
    lab = Lab(world, box, 3)
    try:
        wait_until_ready(lab)
        summary = record(
            lab.box_link,
            SessionWriter(path, lab.clock, overwrite=True),
            lab.clock,
            robot=lab.robot_link,
            options=RecordOptions(plan=plan_rows(plan), rig_toml=format_rig(rig).encode(), osr=OSR),
        )
    finally:
        box.close()
    assert summary.reason == "robot closed"
    assert summary.counters.lost_frames == 0
    return path


@pytest.mark.parametrize(
    ("poses", "options"),
    [
        pytest.param(7, ["--free", "joint*.offset"], marks=pytest.mark.soak),
        pytest.param(45, [], marks=pytest.mark.soak),
    ],
    ids=["six-offsets", "all-that-a-shell-shows"],
)
def test_all_levels_lead_to_the_same_robot(poses, options, tmp_path):
    """Both measure the same lengths, repeatability included. What differs is the samples' noise, as a share of sigma

        3 µm / √(samples a dwell) / 84 µm

    which is 0.002; how that goes into the parameters is what their sigmas say, so a twentieth of a sigma is far out.
    """
    results = []
    for level in LEVELS:
        path = recorded(level, poses, tmp_path / f"{level}.mcap")
        done = truearm("identify", path, "--model", "puma560", "--json", *options)
        assert done.returncode == 0, done.stderr
        results.append(json.loads(done.stdout))
    first, *others = results
    assert first["n_observations"] == poses
    free = [p for p in first["parameters"] if p["sigma"]]
    assert len(free) >= 6
    for other in others:
        assert other["n_observations"] == poses
        assert other["rank"] == first["rank"]
        values = {p["name"]: p["value"] for p in other["parameters"]}
        apart = np.array([abs(p["value"] - values[p["name"]]) / p["sigma"] for p in free])
        share = sensors.SAMPLE_SIGMA / np.sqrt(1e9 / sensors.period_ns(OSR)) / 84e-6
        assert apart.max() < 0.05, f"{apart.max():.4f} sigma, samples' noise is {share:.4f}"
