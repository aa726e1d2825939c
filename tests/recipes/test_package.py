"""A package outside the tree adds a kind, a term, a format, a source and a robot by entry points: the recipes' code, unchanged."""

import json
import math
import re
import shutil

import pytest

from tests.host.tcp_peer import Peer
from tests.recipes.recipes import PAGE, Copy, findings, new_files
from tests.recipes.test_recipes import OPEN, SENT, SPRUNG, ZERO, write_inputs, write_more_of_the_kind
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
def work(site, tmp_path_factory):
    """Return a folder with inputs, in which Python finds the package."""
    work = Copy(tmp_path_factory.mktemp("work"), ())
    work.paths = [site]
    write_more_of_the_kind(work.folder, write_inputs(work.folder))
    (work.folder / "sprung.toml").write_text(SPRUNG)
    return work


@pytest.fixture(scope="module")
def said(work):
    """Return what commands print."""
    inputs = ("poses.csv", "--model", "puma560", "--rig", "rig.toml")
    return work.run_each(
        ("export", "--help"),
        ("record", "--help"),
        ("plan", "ballbar", "--help"),
        ("identify", *inputs, "--joint-laws", "none", "--out", "result.json"),
        ("export", "result.json", "--format", "screws", "--out", "screws.json", "--over", "poses.csv", "--json"),
    )


def test_help_names_what_was_added(said):
    export, record, plan = (" ".join(each.out.split()) for each in said[:3])
    assert "screws: axes of the joints at readings 0 (.json)." in export
    assert "semicolons://192.168.0.2:5000" in record
    assert "ur3lab" in plan


def test_the_kind_is_identified(work, said):
    assert said[3].code == 0, said[3].err
    document = json.loads((work.folder / "result.json").read_text())
    zeros = {p["name"]: p for p in document["parameters"] if p["name"].startswith("inclinometer.")}
    assert set(zeros) == {f"inclinometer.{name}.zero" for name in ZERO}
    for name, zero in ZERO.items():
        found = zeros[f"inclinometer.{name}.zero"]
        assert abs(found["value"] - zero) < 5.0 * max(found["sigma"], 1e-5)


def test_the_format_is_written(work, said):
    assert said[4].code == 0, said[4].err
    assert "exported" in findings(said[4].out)
    assert len(json.loads((work.folder / "screws.json").read_text())["joints"]) == 6


def test_term_and_robot_are_loaded(work):
    assert work.python("-c", ROBOT).out.split() == ["True", "ur3lab"]


def test_the_source_is_opened(work):
    lines = bytes.fromhex(work.python("-c", OPEN, f"semicolons://{Peer(SENT).address}").out).split(b"\n")
    assert parse_line(lines[1]).q == pytest.approx([math.pi / 2, math.radians(-45.5)], rel=1e-15)


MAIN = "import sys; from truearm.cli.main import main; sys.exit(main(sys.argv[1:]))"
POSES = ("identify", "poses.csv", "--model", "puma560", "--rig", "rig.toml")
SESSION = ("identify", "s.mcap", "--model", "puma560", "--rig", "device.toml")
PAIR = "return (*sensors, None, None)[:2] if len(sensors) <= 2 else (None, None)"
# what is changed in the kind's module, into what, the command that meets it, and what its only line names
MISTAKES = {
    "a sensor for two channels": (PAIR, "return sensors[0]", SESSION, ["dwell()", "inclinometer", "2", "DwellSensor"]),
    "too few sensors": (PAIR, "return sensors[:1]", SESSION, ["dwell()", "inclinometer", "2", "1"]),
    "channels without streams": (
        *('(("inclinometer",), ("inclinometer_b",))', '("inclinometer", "inclinometer_b")'),
        *(POSES, ["truearm.kinds", "channels"]),
    ),
    "derivatives of another shape": (
        "np.ones((1, len(axis), 1))",
        "np.ones((len(axis), 1))",
        POSES,
        ["evaluate", "(w, n, c)"],
    ),
    "residuals of another shape": (
        "(self.inclination - predicted",
        "((self.inclination - predicted)[1:]",
        POSES,
        ["evaluate", "280 rows"],
    ),
    "a name that is not defined": (
        "angle + gather",
        "angles + gather",
        POSES,
        ["inclinometer.py", "evaluate", "angles"],
    ),
    "no unit": ('{"rad": "measured', '{"m": "measured', POSES, ["truearm.kinds", "residual", "rad"]),
    "an unknown unit": ('("inclination",), "rad"', '("inclination",), "gon"', POSES, ["truearm.kinds", "gon"]),
    "an import that fails": ("import numpy", "import nothing_such, numpy", POSES, ["truearm.kinds", "nothing_such"]),
    "a module that ends Python": ("import numpy as np", "raise SystemExit(0)", POSES, ["truearm.kinds", "SystemExit"]),
    "two of one name": (
        *("inclinometer = truearm_lab.inclinometer:KIND", "inclinometer = lab:KIND\ninclinometer = lab:KIND2"),
        *(POSES, ["truearm.kinds", "inclinometer", "lab:KIND ", "'lab:KIND2'"]),
    ),
    "a file that is missing": (
        "angle + gather",
        'open("no_such.txt") + gather',
        POSES,
        ["inclinometer.py", "evaluate", "no_such.txt"],
    ),
    "a wrong call of truearm": (
        "angle + gather",
        "gather(3.0, self.constants, self.zero) + gather",
        POSES,
        ["inclinometer.py", "evaluate", "raised by truearm."],
    ),
    "no kind": ("KIND = Kind", "KINDS = Kind", POSES, ["truearm.kinds", "KIND"]),
    "another's name": ("inclinometer =", "position =", POSES, ["truearm.kinds", "position"]),
    "a format without a module": (
        *("truearm_lab:SCREWS", "lab:SCREWS"),
        ("export", "result.json", "--format", "screws", "--out", "w.json", "--over", "poses.csv"),
        ["truearm.formats", "screws", "lab"],
    ),
    "a source without a module": (
        *("truearm_lab:SEMICOLONS", "lab:SEMICOLONS"),
        ("record", "--box", "socket://127.0.0.1:1", "--address", "semicolons://127.0.0.1:1", "--out", "r.mcap"),
        ["truearm.sources", "semicolons", "lab"],
    ),
    "a robot without a package": (
        *("ur3lab = truearm_lab", "ur3lab = lab"),
        ("identify", "poses.csv", "--model", "ur3lab", "--rig", "rig.toml"),
        ["truearm.robots", "ur3lab", "lab"],
    ),
    "a robot without a file": (
        "truearm.robots]\nur3lab",
        "truearm.robots]\nur9",
        ("identify", "poses.csv", "--model", "ur9", "--rig", "rig.toml"),
        ["truearm.robots", "ur9"],
    ),
    "a format without its function": (
        *("def write(", "def writes("),
        *(
            ("export", "result.json", "--format", "screws", "--out", "w.json", "--over", "poses.csv"),
            ["screws", "write"],
        ),
    ),
    "a source without its function": (
        *("def connect(", "def connects("),
        ("record", "--box", "socket://127.0.0.1:1", "--address", "semicolons://127.0.0.1:1", "--out", "r.mcap"),
        ["semicolons", "connect"],
    ),
    "a term of another class": ("TERM = Spring", "TERM = Structure", POSES, ["truearm.joint_terms", "spring"]),
}


@pytest.mark.parametrize("group", ["kinds", "joint_terms", "formats", "sources", "robots"])
def test_what_cannot_be_loaded_stops_only_what_needs_it(group, work, said, tmp_path):
    info = tmp_path / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[truearm.{group}]\nbad = nothing_such:X\n")
    other = Copy(tmp_path / "copy", ())
    other.folder, other.paths = work.folder, [*work.paths, tmp_path]
    commands = (
        *(("record", "--help"), ("plan", "ballbar", "--help"), ("export", "--help"), ("box", "list")),
        ("session", "recover", "s.mcap", "--out", str(tmp_path / "recovered.mcap")),
        ("inspect", "s.mcap"),
        ("export", "result.json", "--format", "screws", "--out", str(tmp_path / "w.json"), "--over", "poses.csv"),
        ("identify", "poses.csv", "--model", "puma560", "--rig", "rig.toml", "--joint-laws", "none"),
    )
    needed = commands[-2:] if group in ("kinds", "joint_terms") else ()
    done = dict(zip(commands, other.run_each(*commands), strict=True))
    assert [command for command, each in done.items() if each.code == 2] == [*needed]
    lines = [[line for line in each.err.splitlines() if "nothing_such" in line] for each in done.values()]
    assert {len(line) for line in lines} <= {0, 1}
    assert all(line[0].startswith(f"warning: truearm.{group}: bad = ") for line in lines[:-2] if line)
    assert lines[-1]


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line(mistake, site, work, said, tmp_path):
    before, after, command, words = MISTAKES[mistake]
    wrong = Copy(tmp_path / "copy", ())
    shutil.copytree(site, tmp_path / "site")
    wrong.folder, wrong.paths = work.folder, [tmp_path / "site"]
    files = [file for glob in ("inclinometer.py", "*.*") for file in (tmp_path / "site").glob(f"*/{glob}")]
    path = next(file for file in files if before in file.read_text(encoding="utf-8"))
    path.write_text(path.read_text(encoding="utf-8").replace(before, after), encoding="utf-8")
    said = wrong.python("-c", MAIN, *command, code=2)
    assert said.err.count("\n") == 1
    assert [word for word in words if word not in said.err] == []
