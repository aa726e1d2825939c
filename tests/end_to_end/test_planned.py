"""A planned session: the plan of `truearm plan ballbar` is driven, recorded and identified, and its forecast holds."""

import contextlib
import io
import json

import numpy as np
import pytest
from scipy import stats
from tests.end_to_end.conftest import record_session, recorded_with_plan

from truearm.cli.main import main
from truearm.kinds.rig_file import read_noise, write_rig
from truearm.plan.plan_file import read_plan
from truearm.workflows import simulate
from truearm_sim.arm import WORN
from truearm_sim.lab import Lab
from truearm_sim.robot import new_pairing
from truearm_sim.world import standard_rig


@pytest.fixture(
    scope="module", params=[(40, 150), pytest.param((150, 2000), marks=pytest.mark.soak)], ids=lambda p: f"{p[0]}-poses"
)
def planned(request, tmp_path_factory):
    """Poses planned on the design for the demo's rig, the forecast, and the session of the true robot that visits them."""
    poses, candidates = request.param
    out = tmp_path_factory.mktemp("planned")
    write_rig(out / "rig.toml", standard_rig())
    command = ["plan", "ballbar", "--model", "puma560", "--rig", str(out / "rig.toml"), "--out", str(out / "plan.csv")]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main([*command, "--poses", str(poses), "--candidates", str(candidates), "--json"]) == 0
    plan = read_plan(out / "plan.csv")
    recorded = record_session(out / "session.mcap", 0, osr=16384, rig=standard_rig(), plan=plan)
    return plan, json.loads(said.getvalue()), recorded


def test_the_bar_stays_on_and_within_its_travel_where_the_plan_says_so(planned):
    plan, _, recorded = planned
    world = recorded.world
    assert (plan.move == "via").sum() > 10
    # The operator takes the bar off where the plan says so and nowhere else ...
    assert world.controller.mounting.sum() == new_pairing(plan).sum()
    t = np.arange(0.0, world.duration, 0.1)
    row = world.controller.pose[world.controller.stop_index(t)]
    on = world.controller.bar_is_on(t)
    assert (on | world.controller.mounting[world.controller.stop_index(t)] | (plan.bar[row] == "")).all()
    # ... and on every way that it is on the true robot, 20 mm off its design, keeps it within its stroke.
    zero = np.array([standard_rig().bars[name].zero for name in plan.bar[row[on]]])
    assert np.abs(world.length(t[on]) - zero).max() < 0.5 * 0.075


ROBOT = ("--model", "puma560")
PLAN = ("plan", "characterize", *ROBOT, "--poses", 2, "--rounds", 2, "--long-dwell-s", 4)


@pytest.fixture
def virtual_time(monkeypatch):
    """``truearm simulate`` is recorded by the lab's clock in place of the wall's: what it would serve goes to session.mcap in its folder."""

    def start(world, box, box_port, robot_end, **_):
        recorded_with_plan(Lab(world, box, 1), start.folder / "session.mcap", osr=16384)

    monkeypatch.setattr(simulate, "serve", start)
    return start


def walk(folder, said, session):
    """From the rig to a result with and without the noise file; ``session(options)`` records a simulated session."""
    write_rig(folder / "rig.toml", standard_rig())
    said(*PLAN, "--rig", folder / "rig.toml", "--out", folder / "approaches.csv")
    noise = folder / "noise.toml"
    approaches = session("approaches", "--worn", "--plan", folder / "approaches.csv", "--rig", folder / "rig.toml")
    told = json.loads(said("characterize", approaches, *ROBOT, "--json", "--out", noise))
    found = read_noise(noise)
    half = 0.5 * np.array(WORN.backlash)
    sigma = np.sqrt(np.diag(found.joint_cov))
    # Of 32 visits backlash is known to some 0.1 mrad; a joint that moves the bar little, less well.
    assert np.abs(sigma - half).max() < 2e-4
    calibration = session("calibration", "--worn", "--poses", 40)
    with_noise, without = (
        json.loads(said("identify", calibration, *ROBOT, *more, "--json")) for more in (("--noise", noise), ())
    )
    assert without["chi2_reduced"] > without["chi2_band"][1]
    # Of a variance that was found from so many degrees of freedom, χ² has Snedecor's distribution.
    degrees = with_noise["chi2_freedom"], told["visits"] - told["poses"] - len(WORN.backlash)
    low, high = stats.f.ppf([0.005, 0.995], *degrees)
    assert low < with_noise["chi2_reduced"] < min(high, without["chi2_reduced"])


def test_a_worn_arm_from_a_plan_to_a_calibration_that_knows_its_noise(tmp_path, printed, virtual_time):
    def session(name, *options):
        virtual_time.folder = tmp_path / name
        printed("simulate", "--out", tmp_path / name, "--port", 0, "--robot-port", 0, *options)
        return tmp_path / name / "session.mcap"

    walk(tmp_path, printed, session)
