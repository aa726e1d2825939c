"""A file of another kind than the command expects is named as what it is; a similar name is proposed for a missing one."""

from pathlib import Path

import pytest
from tests.refusals import ended

from truearm.disk import missing_file

DATA = Path(__file__).parents[1] / "data" / "mukca"
FILES = {
    "rig.toml": (DATA / "rig.toml").read_text(encoding="utf-8"),
    "arm.urdf": (DATA / "panda.urdf").read_text(encoding="utf-8"),
    "poses.csv": "kind,q1_rad,place,socket\n",
    "plan.csv": "pose,q1_rad\n",
    "result.json": '{"format": "truearm-result"}',
    "truearm.toml": 'model = "ur5e"\n',
    "report.html": '<!DOCTYPE html><meta name="generator" content="truearm">',
}


@pytest.mark.parametrize(
    ("typed", "file", "kind", "expected"),
    [
        ("report rig.toml poses.csv --out r.html", "rig.toml", "a rig", "result (result.json)"),
        ("identify rig.toml --model ur5e", "rig.toml", "a rig", "give it as --rig"),
        ("identify poses.csv --model rig.toml", "rig.toml", "a rig", "robot (.toml or .urdf)"),
        ("identify poses.csv --model ur5e --rig day=plan.csv", "plan.csv", "a plan", "rig (rig.toml)"),
        ("inspect arm.urdf", "arm.urdf", "a robot", "session (.mcap)"),
        ("simulate --plan report.html", "report.html", "a page", "plan (plan.csv)"),
        ("plan ballbar --model ur5e --minutes 9 --rig truearm.toml", "truearm.toml", "a project's file", "a rig"),
        ("correct result.json result.json --out o.csv", "result.json", "a result", "targets (.csv) or"),
    ],
)
def test_a_swapped_file_is_named(typed, file, kind, expected, run, tmp_path, monkeypatch):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "cell").mkdir()
    monkeypatch.chdir(tmp_path / "cell")
    monkeypatch.setattr("truearm.cli.main.defaults", lambda folder: {})
    words = [f"../{word}" if word in FILES else word.replace("day=", "day=../") for word in typed.split()]
    code, out, err = run(*words)
    assert (code, out) == (2, "")
    ended(err, "invalid-input", f"{kind}, where ", expected, place=file)


def test_a_similar_name_is_proposed(tmp_path):
    (tmp_path / "panda_3.csv").touch()
    (tmp_path / "rig.toml").touch()
    values = missing_file(tmp_path / "pnada_3.csv").values
    assert values == {"place": str(tmp_path / "pnada_3.csv"), "meant": str(tmp_path / "panda_3.csv")}
    assert missing_file(tmp_path / "else.csv").values["meant"] == ""


def test_a_missing_folder_is_named(tmp_path):
    assert missing_file(tmp_path / "gone" / "rig.toml").values["folder"] == str(tmp_path / "gone")


def test_a_link_to_nothing_is_not_its_own_proposal(tmp_path):
    (tmp_path / "rig.toml").symlink_to(tmp_path / "other")
    (tmp_path / "results").mkdir()
    assert missing_file(tmp_path / "result.json").values["meant"] == ""
    assert missing_file(tmp_path / "result").values["meant"] == str(tmp_path / "results")
    assert missing_file(tmp_path / "rig.toml").values["meant"] == ""
