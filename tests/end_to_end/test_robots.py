"""``truearm simulate --protocol rtde`` and ``truearm record --address rtde://``: a simulated Universal Robots arm."""

import json

import numpy as np
from tests.end_to_end.conftest import truearm, truearm_process
from tests.end_to_end.test_real_time import Simulator

from truearm.session.joint_format import unpack
from truearm.session.session_file import open_session
from truearm_sim.world import Setup, World, standard_plan


def test_rtde_from_the_simulator_to_the_dwell(tmp_path):
    """Four seconds at 500 Hz: every reading is in the session, bit for bit the World's, measured and commanded apart."""
    simulator = Simulator(tmp_path, "--protocol", "rtde", "--poses", "9")
    try:
        assert any(word.startswith("rtde://127.0.0.1:") for word in simulator.record)
        done = truearm_process(*simulator.record, "--duration-s", 4, timeout_s=60)
    finally:
        simulator.stop()
    assert done.returncode == 0, done.stderr
    session = tmp_path / "session.mcap"
    rows = unpack(*(message.data for message in open_session(session).messages({"/robot/readings"})))
    assert len(rows) >= 3.5 * 500
    # The Port drops what a slow reader does not take; seq and t tell of it alike.
    seq, t = rows.seq, rows.t
    assert np.array_equal(seq, np.rint((t - t[0]) * 500.0))
    states = World(1, standard_plan(9, 1), setup=Setup(robot_rate=500.0)).robot_states(0, 20 * 10**9)
    first = int(np.searchsorted(states.t_robot, t[0] - 1e-6))
    for key, read in (("q", rows.q), ("q_cmd", rows.columns["q_cmd"]), ("qd", rows.columns["qd"])):
        assert np.array_equal(read, getattr(states, key)[first + seq]), key
    assert not list(open_session(session).messages({"/robot/console"}))
    report = truearm("inspect", session, "--json")
    robot = json.loads(report.stdout)["robot"]
    assert robot["readings"] == len(rows)
    assert robot["lost"] == seq[-1] + 1 - len(rows)
