"""Joint readings recorded by another program give the same dwells and lengths as readings that the recorder received."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from tests.end_to_end.conftest import record_session
from tests.host.findings_bench import listed
from tests.host.ros_bags import joint_state, write_bag
from tests.refusals import ended

from truearm.cli.main import main
from truearm.errors import InputError
from truearm.model.robot_file import RobotChoice
from truearm.record.robots.sources import FileOptions, readings_of_file
from truearm.record.session_copies import copy_head
from truearm.record.session_writer import SessionWriter, read_anchor
from truearm.session.session_file import open_session
from truearm.workflows.recorded_session import observations_of_session, open_finished
from truearm.workflows.session_files import joint_names

NAMES = [f"joint{i}" for i in range(6)]
SCRAMBLED = [2, 1, 0, 5, 3, 4]


class Recorded:
    """A session with the robot's readings, the same session without them, and the readings as numbers."""

    def __init__(self, folder):
        self.path, self.bare = folder / "whole.mcap", folder / "bare.mcap"
        record_session(self.path, 9, osr=16384)
        session = open_session(self.path)
        utc, host = read_anchor(session.metadata["session"])
        with SessionWriter(self.bare, None) as writer:
            copy_head(session, writer)
            for message in session.messages():
                if message.topic != "/robot/joints":
                    writer.add(message.topic, message.t_host_ns, message.data)
            writer.close(session.metadata["session-end"])
        rows = [(m.t_host_ns, json.loads(m.data)) for m in session.messages({"/robot/joints"})]
        self.utc_ns = [t - host + utc for t, _ in rows]
        self.t = [row["t"] for _, row in rows]
        self.q = np.array([row["q"] for _, row in rows])
        self.begin_ns = min(message.t_host_ns for message in open_session(self.bare).messages())
        self.result = observations_of_session(open_finished(self.path))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return Recorded(tmp_path_factory.mktemp("recorded"))


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out.mcap"


def csv_of(path, t_name, t, q):
    titles = [t_name, *(f"q{i}_deg" for i in range(1, 7))]
    rows = [",".join(map(repr, [when, *row])) for when, row in zip(t, np.rad2deg(q).tolist(), strict=True)]
    path.write_text("\n".join([",".join(titles), *rows]) + "\n")
    return path


def check(recorded, out):
    """The same dwells with the same joints; lengths differ by the noise of a few samples at their ends.

    A dwell of 2 s has 254 Hz · 1.4 s samples; its edges follow the arrival's jitter by a bin of 50 ms on each side, so that at most
    a fifth of them are others: the means differ by less than twice their standard error.
    """
    found = observations_of_session(open_finished(out))
    assert len(found.table) == len(recorded.result.table) == 18
    # quantised readings (1.2e-5 rad), degrees to radians and back (2e-16)
    assert np.allclose(found.table.q, recorded.result.table.q, atol=2e-6)
    error = np.sqrt([dwell.value_var for dwell in recorded.result.dwells if not dwell.reason])
    assert np.all(np.abs(found.table.value - recorded.result.table.value) < 2 * error)
    assert list(found.table.bar) == list(recorded.result.table.bar)


def test_a_table_whose_time_is_utc(recorded, tmp_path, out, printed):
    before = hashlib.sha256(recorded.bare.read_bytes()).hexdigest()
    table = csv_of(tmp_path / "joints.csv", "t_ns", recorded.utc_ns, recorded.q)
    said = listed(json.loads(printed("session", "add-joints", recorded.bare, table, "--out", out, "--json")))
    assert (said["joints-added"]["n"], said["joints-added"]["utc"]) == (len(recorded.t), True)
    check(recorded, out)
    assert hashlib.sha256(recorded.bare.read_bytes()).hexdigest() == before
    old, new = open_session(recorded.bare), open_session(out)
    assert new.attachments == old.attachments
    assert new.metadata["box"] == old.metadata["box"]
    assert new.metadata["joints-added"] == {
        "source": "joints.csv",
        "session": "bare.mcap",
        "session_sha256": before,
        "time": "utc",
        "readings": str(len(recorded.t)),
    }
    for name in ("session", "session-end"):
        for key in ("utc_ns", "monotonic_ns"):
            assert new.metadata[name][key] == old.metadata[name][key]
    findings = listed(json.loads(printed("inspect", out, "--json")))
    assert (findings["session-made"]["joints"], findings["session-made"]["time"]) == ("joints.csv", "utc")
    assert "robot-clock" not in findings  # what would be said of arrivals
    others = [message for message in new.messages() if message.topic not in ("/robot/joints", "/robot/columns")]
    assert others == list(old.messages())
    assert all(json.loads(message.data)["arrival"] is False for message in new.messages({"/robot/joints"}))


def test_a_table_whose_time_began_with_the_controller(recorded, tmp_path, out):
    table = csv_of(tmp_path / "joints.csv", "t_s", recorded.t, recorded.q)
    zero_ns = recorded.result.survey.joints.clocks[0].to_host_ns(np.array([0.0]))[0]
    zero = repr(1e-9 * float(zero_ns - recorded.begin_ns))
    assert main(["session", "add-joints", str(recorded.bare), str(table), "--zero-s", zero, "--out", str(out)]) == 0
    check(recorded, out)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag(recorded, tmp_path, out, storage):
    names = [NAMES[i] for i in SCRAMBLED]
    states = ((t, joint_state(t, names, q[SCRAMBLED])) for t, q in zip(recorded.utc_ns, recorded.q, strict=True))
    bag = write_bag(tmp_path / "bag", storage, states)
    arguments = [str(recorded.bare), str(bag), "--joints", ",".join(NAMES), "--out", str(out)]
    assert main(["session", "add-joints", *arguments]) == 0
    check(recorded, out)


class TestWhatIsWrong:
    """Errors: one line, exit code 2, and no file."""

    @pytest.fixture
    def table(self, recorded, tmp_path):
        return csv_of(tmp_path / "joints.csv", "t_ns", recorded.utc_ns[:100], recorded.q[:100])

    @staticmethod
    def fails(capsys, out, *arguments):
        folder = set(out.parent.iterdir())
        assert main(["session", "add-joints", *map(str, arguments), "--out", str(out)]) == 2
        complaint = capsys.readouterr().err
        assert complaint.count("\n") == 1
        assert set(out.parent.iterdir()) == folder
        return complaint

    def test_readings_are_there_already(self, recorded, table, out, capsys):
        assert "give --replace" in self.fails(capsys, out, recorded.path, table)
        assert main(["session", "add-joints", str(recorded.path), str(table), "--replace", "--out", str(out)]) == 0
        assert len(list(open_session(out).messages({"/robot/joints"}))) == 100

    def test_a_time_that_is_no_utc(self, recorded, tmp_path, out, capsys):
        table = csv_of(tmp_path / "other.csv", "t_s", recorded.t, recorded.q)
        assert "--zero-s" in self.fails(capsys, out, recorded.bare, table)
        ended(self.fails(capsys, out, recorded.bare, table, "--zero-s", "1e8"), "invalid-input", "--zero-s")

    def test_a_row_in_the_middle(self, recorded, table, out, capsys):
        table.write_text(table.read_text() + "1,2,3\n")
        assert "joints.csv row 102: " in self.fails(capsys, out, recorded.bare, table)

    def test_a_bag_that_is_cut_off(self, recorded, tmp_path, out, capsys):
        states = ((t, joint_state(t, NAMES, q)) for t, q in zip(recorded.utc_ns, recorded.q, strict=True))
        bag = write_bag(tmp_path / "bag", "mcap", states)
        (path,) = bag.glob("*.mcap")
        path.write_bytes(path.read_bytes()[:-1000])
        ended(self.fails(capsys, out, recorded.bare, bag, "--joints", ",".join(NAMES)), "malformed-file", place=bag)

    def test_a_session_that_is_none(self, table, out, capsys):
        ended(self.fails(capsys, out, table, table), "not-a-session")

    def test_no_output_over_an_input(self, recorded, table, out, capsys):
        table.rename(out)
        ended(self.fails(capsys, out, recorded.bare, out), "given-twice")
        ended(self.fails(capsys, out, recorded.bare, recorded.bare), "file-exists")
        out.write_bytes(recorded.bare.read_bytes())
        ended(self.fails(capsys, out, recorded.bare, recorded.bare), "file-exists")


PANDA = str(Path(__file__).parents[1] / "data" / "mukca" / "panda.urdf")


def test_the_order_of_the_joints_from_a_robot(tmp_path):
    """The bag has the Panda's joints backward, and its fingers; the URDF has them in order."""
    arm = [f"panda_joint{i}" for i in range(1, 8)]
    names = ["finger", *reversed(arm)]
    bag = write_bag(tmp_path / "bag", "mcap", [(10**18, joint_state(10**18, names, range(8)))])
    joints = joint_names(None, RobotChoice(PANDA, None, "ball_link"))
    assert joints == arm
    (reading,) = readings_of_file(bag, FileOptions("/joint_states", joints))
    assert json.loads(reading.line)["q"] == [7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0]


@pytest.mark.parametrize(
    ("joints", "robot", "says"),
    [("a,b", PANDA, "give one"), ("a,,b", None, "different names"), ("a,b,a", None, "different names")],
)
def test_names_that_are_none(joints, robot, says):
    with pytest.raises(InputError, match=says):
        joint_names(joints, RobotChoice(robot, None, "ball_link"))


def test_a_table_has_its_order(tmp_path):
    with pytest.raises(InputError, match="table's columns"):
        next(readings_of_file(tmp_path / "joints.csv", FileOptions("/joint_states", ["a"])))


def test_what_is_whole_of_a_damaged_session(recorded, tmp_path, out, capsys):
    """Cut off in the middle: refused, then used as far as it goes, and the new file says so."""
    damaged = tmp_path / "damaged.mcap"
    data = recorded.bare.read_bytes()
    damaged.write_bytes(data[: len(data) // 2])
    table = csv_of(tmp_path / "joints.csv", "t_ns", recorded.utc_ns, recorded.q)
    arguments = ["session", "add-joints", str(damaged), str(table), "--out", str(out)]
    assert main(arguments) == 2
    assert "--allow-damaged" in capsys.readouterr().err
    assert main([*arguments, "--allow-damaged"]) == 0
    assert "damaged" in open_session(out).metadata["joints-added"]
    assert 4 <= len(observations_of_session(open_finished(out)).table) < 18
