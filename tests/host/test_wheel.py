"""The wheel in its own environment: what a new user types first, and what a type checker reports."""

import importlib.util
import re
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from identify_bench import exact_lengths
from session_stream import RIG, session, write_session

import truearm
from truearm.kinds.rig_file import write_rig

ROOT = Path(__file__).parents[2]

TEN_LINES = """\
import truearm
robot = truearm.load_robot("puma560")
table, rig = truearm.read_table("poses.csv", robot), truearm.read_rig("rig.toml")
result = truearm.identify(robot, table, rig, hold_out="shell=outer")
print(result)
print(truearm.validate(result, truearm.read_table("friday.csv", robot), rig))
pose = [[0, 0, 1, 0.5], [0, 1, 0, 0.1], [-1, 0, 0, 0.2], [0, 0, 0, 1]]
print(truearm.correct_poses(result, pose, home=[0.0, 0.0, 3.14, 0.0, -1.57, 0.0]).commanded)
truearm.export_robot(result, "urdf", "calibrated.urdf")
print(truearm.__file__)
"""
THREE_LINES = """\
import truearm
session = truearm.read_session("session.mcap")
print(len(session.table))
"""
# every public name, as a program would use it
TYPED = """\
from pathlib import Path

import numpy as np

import truearm
from truearm import (
    BallBar,
    BallBarOptions,
    BallBarPlan,
    Calibration,
    Correction,
    Device,
    ErrorMap,
    Estimate,
    ExportedRobot,
    Figures,
    Finding,
    HeldOut,
    Identification,
    IdentifyOptions,
    InputError,
    MissingFileError,
    ObservationTable,
    ParameterEstimate,
    PlanError,
    Plane,
    Point,
    ProblemError,
    Region,
    Rig,
    RigError,
    Robot,
    RobotError,
    SessionError,
    SessionObservations,
    SocketDistance,
    TableError,
    TargetError,
    TruearmError,
    Validation,
    ValidationRegion,
)

names: tuple[str, ...] = truearm.builtin_robots()
robot: Robot = truearm.load_robot(names[0])
session: SessionObservations = truearm.read_session(Path("session.mcap"), line_points=20)
table: ObservationTable = truearm.read_table("poses.csv", robot)
rig: Rig = truearm.read_rig("rig.toml")
bars = {"b": BallBar("b", zero=0.46, gain=1.0, travel=0.075, sigma=8.4e-5)}
own = Rig(chucks={"c": Point("c", (1.0, 0.0, 0.0))}, bars=bars, trackers={"t": Device("t", ((1e-8, 0.0, 0.0), (0.0, 1e-8, 0.0), (0.0, 0.0, 1e-8)))})
flat: Plane = Plane("f", (0.4, 0.0, 0.0), (0.0, 0.0, 1.0), 2e-5)
apart: SocketDistance = SocketDistance(("a", "b"), 0.05, 1e-5)
options = IdentifyOptions(solver="map", freeze=("joint1.*",))
found: Identification = truearm.identify(robot, table, rig, hold_out=["shell=outer"], options=options)
estimate: Estimate = found.estimate
sigma: float | None = found.parameters["link2.x"].sigma
verdict: Validation = truearm.validate(found, session.table, session.rig)
words: str = verdict.verdict
region: ValidationRegion = verdict.regions[0]
rms: float = region.after["m"].rms
truearm.write_result("result.json", found)
result: Calibration = truearm.read_result("result.json")
planned: BallBarPlan = truearm.plan_ball_bar(robot, rig, minutes=20.0, result=result, options=BallBarOptions(criterion="D"))
minutes: float = planned.route.minutes
told: Correction = truearm.correct_poses(result, np.eye(4), home=[0.0] * 6)
written: ExportedRobot = truearm.export_robot(result, "urdf", over=table.q)
cost: float = written.rms
cells: ErrorMap = truearm.error_map(result, (2, 3), cell=0.05)
area = Region([0.3, -0.2, 0.1], [0.6, 0.2, 0.4])
length: ParameterEstimate = found.parameters["link2.x"]
held_out: HeldOut | None = estimate.held_out
first: Finding = [*found.findings, *result.findings, *verdict.findings][0]
figures: Figures | None = held_out.figures["m"] if held_out else None
refused: list[type[InputError]] = [PlanError, RigError, RobotError, SessionError, TableError, TargetError]
truearm.write_table("copy.csv", table, robot)
try:
    truearm.load_robot(truearm.__version__)
except (InputError, ProblemError) as error:
    problem: TruearmError = error
"""


def output(*command: object, folder: Path) -> str:
    done = subprocess.run([*map(str, command)], cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Python of a new environment with the wheel alone; the packages that it needs are those of the tests."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    output(*pip, "wheel", "--no-deps", "--no-index", "--no-build-isolation", "-w", folder, ROOT, folder=folder)
    (wheel,) = folder.glob("truearm-*.whl")
    output(sys.executable, "-m", "venv", "--without-pip", folder / "venv", folder=folder)
    python = folder / "venv" / "bin" / "python"
    output(*pip, "--python", python, "install", "--no-deps", "--no-index", wheel, folder=folder)
    (site,) = (folder / "venv" / "lib").glob("python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")  # its own .pth files stay unread
    return python


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    robot = truearm.load_robot("puma560")
    table, rig = exact_lengths(135)
    rows = np.arange(len(table))
    truearm.write_table(folder / "poses.csv", table.select((rows < 80) | (rows >= 120)), robot)
    truearm.write_table(folder / "friday.csv", table.select((rows >= 80) & (rows < 120)), robot)
    write_rig(folder / "rig.toml", rig)
    write_session(folder / "session.mcap", session(np.random.default_rng(2), dwells=5)[0], RIG)
    return folder


def test_lines_of_python_and_the_command_work(environment, folder):
    said = output(environment, "-I", "-c", TEN_LINES, folder=folder)
    assert "link2.x" in said
    assert "The calibration holds" in said
    assert Path(said.splitlines()[-1]).is_relative_to(environment.parents[1])
    assert "<robot" in (folder / "calibrated.urdf").read_text()
    assert output(environment, "-I", "-c", THREE_LINES, folder=folder) == "5\n"
    assert output(environment.parent / "truearm", "--version", folder=folder) == f"truearm {truearm.__version__}\n"


def test_types_are_real(environment, folder):
    assert all(f"truearm.{name}" in TYPED or f"    {name}," in TYPED for name in truearm.__all__)
    (folder / "typed.py").write_text(TYPED)
    mypy = [sys.executable, "-m", "mypy", "--strict", "--python-executable", environment]
    cache = ["--cache-dir", ROOT / "build" / "mypy-wheel"]
    assert "Success" in output(*mypy, *cache, "typed.py", folder=folder)
    (folder / "wrong.py").write_text("import truearm\ntruearm.read_table('poses.csv', 'puma560')\n")
    done = subprocess.run(
        [*map(str, [*mypy, *cache, "wrong.py"])], cwd=folder, capture_output=True, text=True, check=False
    )
    assert 'incompatible type "str"; expected "Robot"' in done.stdout


def test_the_wheel_flashes_a_box_without_a_checkout(environment, folder):
    """It holds the image that make uf2 built; where there was none it says so."""
    image = ROOT / "build" / "uf2" / f"truearm-{truearm.__version__}.uf2"
    drive = folder / "drive"
    drive.mkdir()
    (drive / "INFO_UF2.TXT").write_text("UF2 Bootloader v3.0\nModel: Raspberry Pi RP2\nBoard-ID: RPI-RP2\n")
    done = subprocess.run(
        [environment, "-m", "truearm", "box", "flash", "--drive", drive, "--no-check"],
        cwd=folder, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    if image.is_file():
        assert done.returncode == 0, done.stderr
        assert (drive / image.name).read_bytes() == image.read_bytes()
    else:
        assert done.returncode == 2
        assert f"{image.name} is not part of this installation; give the image to flash" in done.stderr


def test_links_of_the_readme_are_absolute_where_the_repository_has_an_address(tmp_path, monkeypatch):
    monkeypatch.setenv("TRUEARM_URL", "https://example.org/truearm/")
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    metadata = {}
    module.LinksHook(str(ROOT), {}).update(metadata)
    text = metadata["readme"]["text"]
    assert "](https://example.org/truearm/raw/HEAD/docs/images/arm.png)" in text
    assert "](https://example.org/truearm/blob/HEAD/docs/how-to/rig.md)" in text
    assert not re.findall(r"\]\((?!https?://|#)[^)]*\)", text)
    assert metadata["urls"]["Source"] == "https://example.org/truearm"
