"""A UR5e from its controller's kinematics to a corrected program and a kinematics file, without ROS."""

import json

import numpy as np
import pytest
from tests.host.controller_peer import Controller, built_rows, drawn_rows, info, state

import truearm
from truearm.cli.main import main
from truearm.export.link_frames import link_frames, predicted
from truearm.model.controller_kinematics import kinematics_of_conf, kinematics_of_yaml
from truearm.model.robot import builtin_robot
from truearm.record.robots import ur_primary

pytestmark = pytest.mark.soak

PROGRAM = """def drill():
  set_tcp(p[0, 0, 0.1, 0, 0, 0])
  movel(p[0.40, 0.05, 0.35, 3.1416, 0, 0], a=0.5, v=0.1)
end
"""


def test_from_the_controllers_kinematics_to_a_corrected_program(capsys, tmp_path, monkeypatch):
    def run(*arguments):
        code = main([str(word) for word in arguments])
        return code, capsys.readouterr().out

    drawing = builtin_robot("ur5e").chain
    controller = Controller(state(info(built_rows(drawing, 6))))
    monkeypatch.setattr(ur_primary, "PORT", controller.port)
    cell = tmp_path / "cell"
    assert run("init", cell, "--model", "ur5e", "--address", "rtde://127.0.0.1", "--minutes", "25")[0] == 0
    controller.close()
    monkeypatch.chdir(cell)
    assert run("simulate", "--fast", "--out", "rehearsal", "--truth-seed", "1")[0] == 0
    code, out = run("identify", "rehearsal/session.mcap", "--hold-out", "0.25", "--out", "result.json", "--json")
    assert code == 0
    error = next(f["values"] for f in json.loads(out)["findings"] if f["code"] == "audit")
    assert error["identified"]["mm"] < 0.2 * error["controller"]["mm"] < 0.2 * error["drawing"]["mm"]
    for form, name in (("ur", "arm.yaml"), ("calibration-conf", "arm.conf")):
        assert run("export", "result.json", "--format", form, "--out", name)[0] == 0
    result = truearm.read_result(cell / "result.json", cell / "robot.toml")
    arm = link_frames(result.chain, result.nominal, result.identified, with_mountings=False)
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (100, 6))
    files = (
        kinematics_of_yaml((cell / "arm.yaml").read_text()),
        kinematics_of_conf((cell / "arm.conf").read_text(), drawn_rows(drawing)),
    )
    for again in files:
        assert np.abs(again.forward(q) - predicted(arm, q)).max() < 1e-6
    (cell / "drill.script").write_text(PROGRAM)
    home = "0,-90,90,-90,-90,0"
    code, _ = run("correct", "result.json", "drill.script", "--own-frames", "--home", home, "--out", "new.script")
    assert code == 0
    assert (cell / "new.script").read_text() != PROGRAM
