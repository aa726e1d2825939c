"""A planned session: the plan of `truearm plan ballbar` is driven, recorded and identified, and its forecast holds."""

import contextlib
import io
import json

import numpy as np
import pytest
from tests.end_to_end.conftest import record_session

from truearm.cli.main import main
from truearm.kinds.rig_file import write_rig
from truearm.plan.plan_file import read_plan
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
