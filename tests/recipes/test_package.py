"""A package outside the tree adds a kind, a term, a format, a source and a robot by entry points: the recipes' code, unchanged."""

import json
import math
import os
import re
import subprocess
import sys

import pytest

from tests.host.tcp_peer import Peer
from tests.recipes.recipes import ALL_IN_ONE, PAGE, Said, findings, new_files
from tests.recipes.test_kind import ZERO, write_inputs
from tests.recipes.test_source import OPEN, SENT
from tests.recipes.test_term import SPRUNG
from truearm.session.joint_format import parse_line

ROBOT = """
import truearm
robot = truearm.load_robot("sprung.toml")
print("joint2.spring" in robot.chain.parameter_names, truearm.load_robot("ur3lab").chain.name)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Make a folder of installed packages with truearm_lab, as pip would make it of the page's code."""
    site = tmp_path_factory.mktemp("site")
    package, record = site / "truearm_lab", site / "truearm_lab-1.0.dist-info"
    package.mkdir()
    record.mkdir()
    page = PAGE.read_text(encoding="utf-8")
    for path, content in new_files(page):
        (package / path.rpartition("/")[2]).write_text(content, encoding="utf-8")
    section = page.partition("## A package of your own")[2]
    (toml,) = re.findall(r"```toml\n(.*?)```", section, re.S)
    points = re.sub(r'project\.entry-points\."(.*)"', r"\1", toml).replace('"', "")
    (entries,) = re.findall(r"  ```python\n(.*?)```", section, re.S)
    (package / "__init__.py").write_text(re.sub(r"^  ", "", entries, flags=re.M), encoding="utf-8")
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: truearm-lab\nVersion: 1.0\n")
    (record / "entry_points.txt").write_text(points)
    return site


@pytest.fixture(scope="module")
def python(site, tmp_path_factory):
    """Return a function that runs Python with the package, in a folder with inputs."""
    folder = tmp_path_factory.mktemp("work")
    write_inputs(folder)
    (folder / "sprung.toml").write_text(SPRUNG)

    def run(*arguments, text=""):
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(site)},
            input=text,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    run.folder = folder
    return run


@pytest.fixture(scope="module")
def said(python):
    """Return what commands print."""
    inputs = ("poses.csv", "--model", "puma560", "--rig", "rig.toml")
    commands = [
        ("export", "--help"),
        ("record", "--help"),
        ("plan", "ballbar", "--help"),
        ("identify", *inputs, "--joint-laws", "none", "--out", "result.json"),
        ("export", "result.json", "--format", "screws", "--out", "screws.json", "--over", "poses.csv", "--json"),
    ]
    return [Said(*each) for each in json.loads(python("-c", ALL_IN_ONE, text=json.dumps(commands)))]


def test_help_names_what_was_added(said):
    export, record, plan = (" ".join(each.out.split()) for each in said[:3])
    assert "screws: axes of the joints at readings 0 (.json)." in export
    assert "semicolons://192.168.0.2:5000" in record
    assert "ur3lab" in plan


def test_the_kind_is_identified(python, said):
    assert said[3].code == 0, said[3].err
    document = json.loads((python.folder / "result.json").read_text())
    zeros = {p["name"]: p for p in document["parameters"] if p["name"].startswith("inclinometer.")}
    assert set(zeros) == {f"inclinometer.{name}.zero" for name in ZERO}
    for name, zero in ZERO.items():
        found = zeros[f"inclinometer.{name}.zero"]
        assert abs(found["value"] - zero) < 5.0 * max(found["sigma"], 1e-5)


def test_the_format_is_written(python, said):
    assert said[4].code == 0, said[4].err
    assert "exported" in findings(said[4].out)
    assert len(json.loads((python.folder / "screws.json").read_text())["joints"]) == 6


def test_term_and_robot_are_loaded(python):
    assert python("-c", ROBOT).split() == ["True", "ur3lab"]


def test_the_source_is_opened(python):
    lines = bytes.fromhex(python("-c", OPEN, f"semicolons://{Peer(SENT).address}")).split(b"\n")
    assert parse_line(lines[1]).q == pytest.approx([math.pi / 2, math.radians(-45.5)], rel=1e-15)
