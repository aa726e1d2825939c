"""--model: built-in robots by name, TOML and URDF by path; everything else is a one-line error."""

from pathlib import Path

import pytest
from tests.refusals import refused

from truearm.errors import RobotError
from truearm.model.robot_file import load_robot, robot_file

PANDA = Path(__file__).parents[1] / "data" / "mukca" / "panda.urdf"


def test_built_in_robots_robot_files_and_a_urdf_are_read(tmp_path):
    robot = load_robot("puma560")
    assert robot_file("puma560") is None
    assert robot.chain.joint_units == ("rad",) * 6
    from importlib import resources

    text = resources.files("truearm.model").joinpath("robots", "puma560.toml").read_text("utf-8")
    (tmp_path / "mine.toml").write_text(text, "utf-8")
    assert load_robot(str(tmp_path / "mine.toml")).chain == load_robot("puma560").chain
    robot = load_robot(str(PANDA), tip="ball_link")
    assert (robot.chain.base_frame, robot.chain.end_frame) == ("panda_link0", "ball_link")
    assert robot.chain.joint_units == ("rad",) * 7
    held = [name for name, free in zip(robot.chain.parameter_names, robot.free, strict=True) if not free]
    assert held == [f"panda_joint{i}.gain" for i in range(1, 8)]  # all else is free
    assert load_robot(str(PANDA), tip="panda_leftfinger").chain.joint_units == (*("rad",) * 7, "m")


@pytest.mark.parametrize(
    ("robot", "tip", "message"),
    [
        ("puma561", None, r"'puma561' .*did you mean puma560\?"),
        ("UR5E", None, r"did you mean ur5e\?"),
        ("robot", None, r"'robot' .*puma560"),
        ("puma560", "ball", "URDF"),
        (str(PANDA), None, "panda.urdf: .*choose tip"),
        (str(PANDA), "ball", "panda.urdf: URDF"),
    ],
)
def test_wrong_robots_are_told(robot: str, tip: str | None, message: str) -> None:
    with pytest.raises(RobotError, match=message):
        load_robot(robot, tip=tip)


def test_wrong_files_are_told_with_their_name(tmp_path: Path) -> None:
    with refused("missing-file", place="none.urdf"):
        load_robot("none.urdf")
    (tmp_path / "a.toml").write_text("name = 3")
    (tmp_path / "a.urdf").write_text("<robot")
    for name in ("a.toml", "a.urdf"):
        with pytest.raises(RobotError, match=name):
            load_robot(str(tmp_path / name))
