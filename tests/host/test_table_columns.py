"""Tables of joints from other programs, with their names, separators and decimal commas."""

import json

import numpy as np
import pytest
from tests.refusals import refused

from truearm.errors import InputError
from truearm.record.robots.sources import FileOptions
from truearm.record.robots.text_lines import parse_renames, readings, renamed, separator_of

UR = "t_s=timestamp,q{}_rad=actual_q_{},qd{}_rad_s=actual_qd_{}"
HEADER = ["timestamp", "robot_mode", *(f"actual_q_{i}" for i in range(6)), *(f"actual_qd_{i}" for i in range(6))]


def table(path, separator, comma, n=5):
    """As Universal Robots' own recorder writes it, in one country or another."""
    rng = np.random.default_rng(1)
    rows = np.column_stack([12.5 + 0.002 * np.arange(n), np.full(n, 7), rng.uniform(-3, 3, (n, 12))])
    lines = [[f"{cell:.9f}".replace(".", ",") if comma else f"{cell:.9f}" for cell in row] for row in rows]
    path.write_text("\n".join(separator.join(line) for line in [HEADER, *lines]) + "\n")
    return np.round(rows, 9)


@pytest.mark.parametrize(
    ("separator", "comma"), [(",", False), (";", False), (";", True), ("\t", True), (" ", False), ("   ", True)]
)
def test_a_table_of_another_program(tmp_path, separator, comma):
    rows = table(tmp_path / "r.csv", separator, comma)
    found = list(readings(tmp_path / "r.csv", FileOptions("", columns=parse_renames(UR))))
    assert [one.t for one in found] == pytest.approx(rows[:, 0].tolist(), abs=1e-12)
    lines = [json.loads(one.line) for one in found]
    assert np.array([line["q"] for line in lines]) == pytest.approx(rows[:, 2:8], abs=1e-12)
    assert np.array([line["qd"] for line in lines]) == pytest.approx(rows[:, 8:], abs=1e-12)


def test_columns_by_semicolons_and_joints_from_the_lowest_number(tmp_path):
    (tmp_path / "r.csv").write_text("t_s;q1_deg;q2_deg\n1,5;90;-45,5\n")
    (one,) = readings(tmp_path / "r.csv", FileOptions(""))
    assert json.loads(one.line)["q"] == pytest.approx(np.deg2rad([90.0, -45.5]))
    (tmp_path / "r.txt").write_text("# t_s  q1_deg  q2_deg\n  1.5     90   -45.5\n")
    (one,) = readings(tmp_path / "r.txt", FileOptions(""))
    assert json.loads(one.line)["q"] == pytest.approx(np.deg2rad([90.0, -45.5]))
    assert renamed(["q2", "t", "q1"], parse_renames("t_s=t,q{}_deg=q{}")) == ["q2_deg", "t_s", "q1_deg"]
    assert renamed(["q1", "t", "q0", "z"], parse_renames("t_s=t,q{}_deg=q{}")) == ["q2_deg", "t_s", "q1_deg", "x_3"]
    assert renamed(["stamp", "q1_deg", "z", "q2_deg"], parse_renames("t_s=stamp")) == ["t_s", "q1_deg", "x_2", "q2_deg"]
    assert renamed(["t", "q1_rad", "a1"], parse_renames("t_s=t,q{}_deg=a{}")) == ["t_s", "x_1", "q1_deg"]
    assert [separator_of(text) for text in ("a,b;c,d", "a;b", "a\tb\tc", "a", "a, b c d", "a  b")] == [
        *(",", ";", "\t", ",", ",", " ")
    ]


@pytest.mark.parametrize("text", ["", "t_s", "=x", "t_s=", "q{}_rad=q", "q1_rad=q{}", "q{}_rad=q{}{}", "t_s=t,,"])
def test_renames_that_are_none(text):
    with pytest.raises(InputError, match="write OURS=THEIRS"):
        parse_renames(text)


def test_a_column_that_is_not_there_is_named(tmp_path):
    table(tmp_path / "r.csv", ",", False)
    with refused("malformed-file", "'timestamp', 'robot_mode'", place="r.csv", reason="'stamp'"):
        list(readings(tmp_path / "r.csv", FileOptions("", columns=parse_renames("t_s=stamp,q{}_rad=actual_q_{}"))))
    with refused("wrong-value"):
        list(readings(tmp_path / "r.csv", FileOptions("", columns=parse_renames("t_s=timestamp,q{}=actual_q_{}"))))
