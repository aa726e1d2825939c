"""The kinematics of a Universal Robots controller: read from its primary interface and its files, stored, compared again."""

import json
import struct
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import test_robots_rtde
from controller_peer import Controller, built_rows, drawn_rows, info, message, state
from scipy.spatial.transform import Rotation
from session_stream import RIG
from test_record_command import box_on_a_socket

import truearm
from truearm.errors import LinkError, RobotError
from truearm.export import ur
from truearm.export.writing import RobotToWrite, predicted
from truearm.kinds.rig_file import write_rig
from truearm.model.chain import point_forward
from truearm.model.controller_kinematics import kinematics_of_conf, kinematics_of_info, kinematics_of_yaml
from truearm.model.robot import parse_robot
from truearm.model.robot_file import builtin_robot, builtin_text, load_robot
from truearm.record.robots import rtde
from truearm.session.session_file import open_session
from truearm.workflows.controller_model import controller_state, controller_text

UR5E = builtin_robot("ur5e")
SEED = 6  # of an arm with d of 340 m


@pytest.fixture
def controller(monkeypatch):
    """Return a function that starts a controller with data, which the real reader then finds on its port."""
    started = []

    def start(data, **how):
        started.append(Controller(data, **how))
        monkeypatch.setattr(rtde, "PRIMARY_PORT", started[-1].port)
        return "rtde://127.0.0.1"

    yield start
    for one in started:
        one.close()


def exact_forward(rows, q):
    """Return the plain product of the rows' transforms in extended precision."""
    ends = []
    for reading in q.astype(np.longdouble):
        end = np.eye(4, dtype=np.longdouble)
        for turn, (theta, a, d, alpha) in zip(reading, rows.T.astype(np.longdouble), strict=True):
            (ct, st), (ca, sa) = ((np.cos(v), np.sin(v)) for v in (turn + theta, alpha))
            end = end @ np.array(
                [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]],
                dtype=np.longdouble,
            )
        ends.append(end)
    return np.array(ends)


@pytest.mark.parametrize("model", ["ur5e", "ur10e"])
def test_a_controller_is_read_into_a_robot_file_that_predicts_what_it_computes(
    run, printed, tmp_path, controller, model
):
    drawing = builtin_robot(model)
    rows = built_rows(drawing.chain, SEED)
    assert np.abs(rows[2]).max() > 100.0
    address = controller(message() + state(bytes(60), kind=6) + state(info(rows)))
    out = tmp_path / "arm.toml"
    stdout = printed("robot", "read", address, "--model", model, "--out", out, "--json")
    robot = load_robot(str(out))
    q = np.random.default_rng(0).uniform(-2 * np.pi, 2 * np.pi, (200, 6))
    assert np.abs(robot.forward(q) - exact_forward(rows, q)).max() < 1e-12
    assert robot.checksums == (1, 2, 3, 4, 5, 0xFFFFFFFF)
    assert np.array_equal(robot.free, drawing.free)
    np.testing.assert_array_equal(robot.branch.lower, drawing.branch.lower)
    np.testing.assert_allclose(robot.parameter_sets["design"], drawing.chain.params_nominal, atol=1e-15)
    values = json.loads(stdout)["findings"][0]["values"]
    apart = np.linalg.norm((robot.forward(q) - drawing.forward(q))[:, :3, 3], axis=1)
    assert values["rms"]["mm"] == pytest.approx(1e3 * np.sqrt((apart**2).mean()), rel=0.1)
    turn = Rotation.from_matrix((robot.forward(q) @ drawing.forward(q).swapaxes(1, 2))[:, :3, :3]).magnitude()
    assert values["turn"]["deg"] == pytest.approx(np.degrees(turn.max()), rel=0.1)
    # read again into a file that has the controller's values already
    again = tmp_path / "again.toml"
    assert run("robot", "read", address, "--model", out, "--out", again)[0] == 0
    assert again.read_text() == out.read_text()


def test_a_wrist_that_is_turned_is_another_arm(run, tmp_path, controller):
    """Its end turns about itself, so that positions are those of the drawing."""
    rows = drawn_rows(UR5E.chain)
    rows[0, 5] += 0.3
    code, _, err = run(
        "robot", "read", controller(state(info(rows))), "--model", "ur5e", "--out", tmp_path / "arm.toml"
    )
    assert code == 2
    assert "differs from ur5e by up to 0 mm and 17 deg" in " ".join(err.split())


def conf_of(rows, checksums="0x1, 0x2, 0x3, 0x4, 0x5, 0xffffffff"):
    deltas = rows - drawn_rows(UR5E.chain)
    lines = [f"delta_{name} = {row.tolist()}" for name, row in zip(("theta", "a", "d", "alpha"), deltas, strict=True)]
    return "\n".join(["[mounting]", *lines, f"joint_checksum = [ {checksums} ]", "calibration_status = 0", ""])


def test_a_calibration_conf_is_the_same_kinematics(run, tmp_path):
    rows = built_rows(UR5E.chain, SEED)
    (tmp_path / "calibration.conf").write_text(conf_of(rows))
    out = tmp_path / "robot.toml"
    assert run("robot", "read", tmp_path / "calibration.conf", "--model", "ur5e", "--out", out)[0] == 0
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (100, 6))
    robot = load_robot(str(out))
    assert np.abs(robot.forward(q) - exact_forward(rows, q)).max() < 1e-11  # digits lost in the differences
    assert robot.checksums == (1, 2, 3, 4, 5, 0xFFFFFFFF)


def test_a_file_of_ur_calibration_is_the_same_kinematics(run, tmp_path):
    """U_i = Rz(θ)·Tz(d)·Tx(a)·Rx(α) of the row before, with frames along the axes moved as the file has them."""
    rows = built_rows(UR5E.chain, SEED)
    frames = kinematics_of_info(info(rows)).links[:6]
    text = ["kinematics:"]
    for name, link in zip(("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"), frames, strict=True):
        x, y, z = (float(v) for v in link[:3, 3])
        roll, pitch, yaw = (
            float(np.arctan2(link[2, 1], link[2, 2])),
            float(-np.arcsin(link[2, 0])),
            float(np.arctan2(link[1, 0], link[0, 0])),
        )
        numbers = {"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw}
        text += [f"  {name}:", *(f"    {key}: {value!r}" for key, value in numbers.items())]
    (tmp_path / "calibration.yaml").write_text("\n".join([*text, "  hash: calib_1", ""]))
    kinematics = kinematics_of_yaml((tmp_path / "calibration.yaml").read_text())
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (100, 6))
    end = kinematics_of_info(info(rows)).links[6]
    assert np.abs(kinematics.forward(q) @ end - exact_forward(rows, q)).max() < 1e-9
    assert kinematics.checksums == ()


HOSTILE = {
    "huge package": struct.pack(">IB", 2**31, 16),
    "negative package": struct.pack(">iB", -1, 16),
    "tiny package": struct.pack(">IB", 4, 16),
    "sub-package beyond its package": struct.pack(">IBIB", 10, 16, 500, 5),
    "sub-package of no size": struct.pack(">IBIB", 10, 16, 0, 5),
    "short kinematics": state(bytes(100)),
    "not a number": state(info(np.full((4, 6), np.nan))),
    "no arm": state(info(np.full((4, 6), 1e6))),
    "closed": b"",
    "text": b"HTTP/1.1 400 Bad Request\r\n\r\n",
}


@pytest.mark.parametrize("data", HOSTILE.values(), ids=HOSTILE)
def test_what_is_no_controller_is_an_error_of_one_line_and_writes_nothing(run, tmp_path, controller, data):
    out = tmp_path / "robot.toml"
    code, _, err = run("robot", "read", controller(data), "--model", "ur5e", "--out", out)
    assert code in (1, 2)
    assert err.count("\n") == 1
    assert "rtde://127.0.0.1" in err
    assert not out.exists()


def test_a_controller_that_sends_no_kinematics_ends_after_a_time(controller, monkeypatch):
    monkeypatch.setattr(rtde, "ANSWER_S", 0.2)
    began = time.monotonic()
    with pytest.raises(LinkError, match="no kinematics"):
        rtde.kinematics_info(controller(state(bytes(60), kind=6), stays=True))
    assert time.monotonic() - began < 2.0


@pytest.mark.parametrize(
    "text", ["", "delta_theta = [1, 2]", conf_of(drawn_rows(UR5E.chain)).replace("0.0", "nan"), "kinematics:\n  a:\n"]
)
def test_files_that_are_no_calibration_are_refused(run, tmp_path, text):
    (tmp_path / "a.conf").write_text(text)
    code, _, err = run("robot", "read", tmp_path / "a.conf", "--model", "ur5e", "--out", tmp_path / "r.toml")
    assert code == 2
    assert "a.conf" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("checksums", "named"),
    [("0x1, 0x2, 0xZZ, 0x4, 0x5, 0x6", "0xZZ"), ("1, 2, 3, 4, 5, 6", "'1'"), ("0x1", "6 checksums"), ("", "''")],
)
def test_a_broken_checksum_is_an_error_that_names_it(checksums, named):
    drawing = drawn_rows(UR5E.chain)
    with pytest.raises(RobotError, match="joint_checksum.*" + named):
        kinematics_of_conf(conf_of(drawing, checksums), drawing)


def test_a_file_without_checksums_has_none():
    drawing = drawn_rows(UR5E.chain)
    text = conf_of(drawing).replace("joint_checksum", "# joint_checksum")
    assert kinematics_of_conf(text, drawing).checksums == ()


def test_the_controller_of_another_arm_is_refused(run, tmp_path, controller):
    address = controller(state(info(built_rows(builtin_robot("ur10e").chain))))
    code, _, err = run("robot", "read", address, "--model", "ur5e", "--out", tmp_path / "robot.toml")
    assert code == 2
    assert "--model" in err
    code, _, err = run("robot", "read", address, "--model", "iiwa14", "--out", tmp_path / "robot.toml")
    assert code == 2
    assert "six revolute" in err


def test_a_project_has_the_controllers_kinematics_or_says_that_it_does_not(run, printed, tmp_path, controller):
    address = controller(state(info(built_rows(UR5E.chain))))
    for name in ("cell", "b"):  # which need no first rig then
        (tmp_path / name).mkdir()
        write_rig(tmp_path / name / "rig.toml", RIG)
    out = printed("init", tmp_path / "cell", "--model", "ur5e", "--address", address, "--minutes", "0", "--json")
    assert json.loads(out)["findings"][0]["code"] == "controller-read"
    assert 'model = "robot.toml"' in (tmp_path / "cell" / "truearm.toml").read_text()
    assert load_robot(str(tmp_path / "cell" / "robot.toml")).checksums
    code, out, _ = run(
        "init", tmp_path / "b", "--model", "ur5e", "--address", controller(b""), "--minutes", "0", "--json"
    )
    assert code == 0
    assert json.loads(out)["findings"][0]["code"] == "controller-unread"
    assert 'model = "ur5e"' in (tmp_path / "b" / "truearm.toml").read_text()


def test_a_controller_is_asked_only_for_a_robot_file_with_its_checksums(run, tmp_path, controller):
    out = tmp_path / "robot.toml"
    address = controller(state(info(built_rows(UR5E.chain))))
    assert run("robot", "read", address, "--model", "ur5e", "--out", out)[0] == 0
    assert controller_state(address, str(out)) == ((1, 2, 3, 4, 5, 0xFFFFFFFF), ())
    assert controller_state("tcp://127.0.0.1:1", str(out)) == ((), ())
    assert controller_state(address, "ur5e") == ((), ())
    for data in (b"", HOSTILE["short kinematics"]):
        checksums, (unread,) = controller_state(controller(data), str(out))
        assert (checksums, unread.code) == ((), "controller-unread")
        assert unread.values["reason"].count(address) == 1


@pytest.mark.parametrize("changed", [False, True])
def test_a_session_has_the_controllers_checksums_and_warns_when_they_changed(
    run, tmp_path, controller, monkeypatch, changed
):
    rows = built_rows(UR5E.chain)
    (tmp_path / "cell").mkdir()
    write_rig(tmp_path / "cell" / "rig.toml", RIG)
    address = controller(state(info(rows)))
    assert run("init", tmp_path / "cell", "--model", "ur5e", "--address", address, "--minutes", "0")[0] == 0
    monkeypatch.chdir(tmp_path / "cell")
    now = (1, 2, 9, 4, 5, 6) if changed else (1, 2, 3, 4, 5, 0xFFFFFFFF)
    controller(state(info(rows, now)))

    def readings(peer):
        with suppress(OSError):  # the recording ends
            for k in range(1000):
                peer.sendall(test_robots_rtde.data(100.0 + 0.002 * k))
                time.sleep(0.002)

    peer = test_robots_rtde.Controller(test_robots_rtde.WHOLE, readings)
    with box_on_a_socket() as (_, device):
        options = ["--box", device, "--address", peer.url, "--duration-s", 1, "--out", "s.mcap", "--unchecked"]
        code, _, err = run("record", *options)
    assert code in (0, 4), err
    setup = open_session(tmp_path / "cell" / "s.mcap").metadata["setup"]
    assert setup["controller_checksums"] == " ".join(f"{checksum:08x}" for checksum in now)
    assert ("joints 3, 6" in " ".join(err.split())) == changed
    assert ("truearm robot read" in err) == changed


def test_a_file_whose_rows_cannot_hold_the_controller_is_refused(run, tmp_path, controller):
    without = "\n".join(
        line for line in builtin_text("ur5e").splitlines() if not line.startswith("beta_deg = { design = 0.0 }")
    )
    (tmp_path / "mine.toml").write_text(
        without.replace("[tool]", "[tool]\nbeta_deg = { design = 0.0 }").replace(
            "[base]", "[base]\nbeta_deg = { design = 0.0 }"
        )
    )
    address = controller(state(info(built_rows(UR5E.chain))))
    code, _, err = run("robot", "read", address, "--model", tmp_path / "mine.toml", "--out", tmp_path / "r.toml")
    assert code == 2
    assert "cannot hold" in err


def test_report_and_validation_tell_controller_drawing_and_identified_robot_apart():
    """A true arm that is up to 0.3 mm off its controller's model, which is millimetres off the drawing."""
    text, _ = controller_text(builtin_text("ur5e"), UR5E, kinematics_of_info(info(built_rows(UR5E.chain, SEED))))
    robot, rng = parse_robot(text), np.random.default_rng(4)
    off = np.where([p.unit == "m" for p in robot.chain.parameters] & robot.free, 2e-4, 0.0)
    true = robot.chain.params_nominal + off * rng.normal(size=off.size)
    q = rng.uniform(robot.branch.lower, robot.branch.upper, (120, 6))
    xyz = point_forward(robot.chain, true, q, np.zeros(3)) + 2e-5 * rng.normal(size=(120, 3))
    table = truearm.ObservationTable(q=q, kind=np.full(120, "position"), tracker=np.full(120, "t"), xyz=xyz)
    tracker = truearm.Device("t", np.diag([4e-10] * 3), xyz=(0.0, 0.0, 0.0), sigma=0.0, turn_sigma=0.0)
    rig, options = truearm.Rig(trackers={"t": tracker}), truearm.IdentifyOptions(joint_laws="none")
    fitted, others = table.select(np.arange(120) < 90), table.select(np.arange(120) >= 90)
    result = truearm.identify(robot, fitted, rig, hold_out=0.3, options=options)
    judged = truearm.validate(result, others, rig)
    for document in (result.document, judged.document):
        error = next(finding["values"] for finding in document["findings"] if finding["code"] == "audit")
        assert error["drawing"]["mm"] > 2.0 * error["controller"]["mm"] > 6.0 * error["identified"]["mm"]
    drawn = truearm.identify(replace(UR5E, free=robot.free), fitted, rig, hold_out=0.3, options=options).document
    assert result.document["held_out_drawing"]["rms_mm"] == pytest.approx(drawn["held_out_before"]["rms_mm"], rel=1e-3)
    assert "audit" not in [finding["code"] for finding in drawn["findings"]]


def identified(robot):
    """Return the robot to write, with identified values 0.2 mm and 0.2 mrad off, its mountings included."""
    off = np.where(robot.free, 2e-4, 0.0) * np.random.default_rng(5).normal(size=robot.free.size)
    chain = robot.chain
    return RobotToWrite(chain, chain.params_nominal, chain.params_nominal + off, mountings=False, drawing=robot.drawing)


@pytest.mark.parametrize("of", ["drawing", "controller"])
def test_a_robot_is_given_back_as_the_files_of_its_maker(of):
    text, _ = controller_text(builtin_text("ur5e"), UR5E, kinematics_of_info(info(built_rows(UR5E.chain, SEED))))
    what = identified(UR5E if of == "drawing" else parse_robot(text))
    q = np.random.default_rng(6).uniform(-np.pi, np.pi, (200, 6))
    ends = predicted(what.robot, q)
    drawing = drawn_rows(UR5E.chain)
    for again in (kinematics_of_yaml(ur.ur_yaml(what)), kinematics_of_conf(ur.write_conf(what), drawing)):
        assert np.abs(again.forward(q) - ends).max() < 1e-9


def test_a_calibration_conf_is_of_an_arm_between_its_own_base_and_flange():
    for name in ("puma560", "irb120"):
        with pytest.raises(RobotError):
            ur.write_conf(identified(builtin_robot(name)))
