"""A day of dwells in virtual time, each step in its own process: nothing is lost, and memory does not grow with the length."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.end_to_end.conftest import measured_by_bars

from truearm.estimate.identify import identify
from truearm.model.robot_file import builtin_robot
from truearm.plan.plan_file import read_plan
from truearm_sim.world import World

pytestmark = [pytest.mark.soak, pytest.mark.skipif(not hasattr(os, "wait4"), reason="needs the memory of a child")]
MOST_MB = 500
SEED = 1

RECORD = f"""
import sys
from pathlib import Path
from truearm.workflows.simulate import record_virtually
from truearm.plan.plan_file import read_plan
from truearm_sim import micropython
from truearm_sim.simbox import SimulatedBox
from truearm_sim.world import World

out = Path(sys.argv[1])
plan = read_plan(out / "plan.csv")
world = World({SEED}, plan)
box = SimulatedBox(world, micropython.find(), seed={SEED})
record_virtually(out, world, box, 4096, {SEED})
box.close()
"""

PLAN = f"""
import sys
from pathlib import Path
from truearm.workflows.simulate import write_setup
from truearm.model.robot import builtin_robot
from truearm.plan.forecast import Knowledge
from truearm_sim.shells import plan_shells
from truearm_sim.arm import PUMA_SPEED
from truearm_sim.world import World, standard_rig

known = Knowledge.design(builtin_robot("puma560"), standard_rig())
plan = plan_shells(known, "bar46", int(sys.argv[2]), {SEED}, PUMA_SPEED)
write_setup(Path(sys.argv[1]), World({SEED}, plan))
"""


# A child's peak begins with the memory of the process that starts it, pytest's with all its tests: so a small one does.
START = """
import os, sys
child = os.posix_spawn(sys.executable, [sys.executable, *sys.argv[1:]], os.environ)
_, status, usage = os.wait4(child, 0)
print(usage.ru_utime, usage.ru_maxrss / 1024, file=sys.stderr)
sys.exit(os.waitstatus_to_exitcode(status))
"""


def measured(name, *command, out=os.devnull):
    """Run a Python process; print wall time, CPU time and peak memory, which must stay below MOST_MB."""
    started = time.perf_counter()
    with Path(out).open("w") as file:
        whole = [sys.executable, "-c", START, *map(str, command)]
        done = subprocess.run(whole, stdout=file, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 0, done.stderr
    cpu_s, megabytes = map(float, done.stderr.splitlines()[-1].split())
    print(f"{name:10}{time.perf_counter() - started:8.1f} s wall{cpu_s:8.1f} s CPU{megabytes:8.0f} MB")
    assert megabytes <= MOST_MB


@pytest.mark.parametrize("each", [80, 800])
def test_nine_pairings(tmp_path, each):
    """Two seconds at each of so many poses with each of nine pairings, moves and changes between, 1 kHz × 4 channels."""
    poses = 9 * each
    print()
    measured("plan", "-c", PLAN, tmp_path, poses)
    measured("record", "-c", RECORD, tmp_path)
    measured("sync", "-m", "truearm", "inspect", tmp_path / "session.mcap", "--json", out=tmp_path / "inspect.json")
    options = ["identify", tmp_path / "session.mcap", "--model", "puma560", "--out", tmp_path / "result.json"]
    measured("identify", "-m", "truearm", *options, out=tmp_path / "said.txt")
    export = ("session", "export", tmp_path / "session.mcap", "--out", tmp_path / "x", "--format", "npz")
    measured("npz", "-m", "truearm", *export)
    found = json.loads((tmp_path / "inspect.json").read_text())
    lost = [
        name for name, n in found["losses"].items() if name.endswith(("lost", "overrun", "malformed", "missing")) and n
    ]
    assert not lost
    assert found["dwells"]["observations"] == poses
    (adc,) = found["streams"]
    print(f"{adc['samples']} samples, {found['duration_s']:.0f} s")
    assert adc["samples"] == pytest.approx(found["duration_s"] * 1e9 / adc["period_ns"], rel=1e-3)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["rank"] == 36
    # Sensor, clocks and pairing add nothing: the same fit on what the world's truth is at the joints as they are read.
    robot, world = builtin_robot("puma560"), World(SEED, read_plan(tmp_path / "plan.csv"))
    best = identify(robot.chain, world.rig, measured_by_bars(world), free=robot.free)
    print(f"reduced chi² {result['chi2_reduced']:.5f}, of the world's truth {best.chi2_reduced:.5f}")
    assert result["chi2_reduced"] == pytest.approx(best.chi2_reduced, abs=5e-4)
