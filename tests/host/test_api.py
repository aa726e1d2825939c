"""The public Python interface: every name has a doctest that runs, errors name the wrong argument, and types are exact."""

import copy
import doctest
import inspect
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import get_type_hints

import msgspec
import numpy as np
import pytest
from identify_bench import exact_lengths
from session_stream import RIG, session, write_session

import truearm
from truearm.correct.methods import Method
from truearm.errors import InputError, RobotError, TargetError
from truearm.estimate.solvers import SOLVERS, LawMode, Loss, Prior
from truearm.export.formats import FORMATS
from truearm.kinds.rig_file import write_rig
from truearm.plan.options import Criterion
from truearm.types import LinePlacement
from truearm_sim.world import standard_rig

NAMES = [name for name in truearm.__all__ if name != "__version__"]
# of numpydoc, what a function that has arguments, returns and raises must say
SECTIONS = ("Parameters\n----------", "Raises\n------", "Examples\n--------")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with the files that the examples read: two tables of one robot, its rig, a session, a result."""
    folder = tmp_path_factory.mktemp("api")
    robot = truearm.load_robot("puma560")
    table, rig = exact_lengths(135)
    noise = np.random.default_rng(3).normal(0.0, 8.4e-5, len(table))
    noisy = replace(table, value=table.value + noise)
    first, second = np.arange(len(table)) < 90, np.arange(len(table)) >= 90
    shell = np.where(np.arange(len(table)) < 70, "inner", "outer")
    noisy = replace(noisy, shell=shell)
    truearm.write_table(folder / "poses.csv", noisy.select(first), robot)
    truearm.write_table(folder / "friday.csv", noisy.select(second), robot)
    write_rig(folder / "rig.toml", rig)
    write_rig(folder / "session.toml", RIG)
    write_rig(folder / "bench.toml", standard_rig())
    write_session(folder / "session.mcap", session(np.random.default_rng(2), dwells=5)[0], RIG)
    result = truearm.identify(
        robot, truearm.read_table(folder / "poses.csv", robot), truearm.read_rig(folder / "rig.toml")
    )
    truearm.write_result(folder / "result.json", result)
    return folder


@pytest.fixture(scope="module")
def result(folder):
    return truearm.read_result(folder / "result.json")


@pytest.fixture(scope="module")
def robot():
    return truearm.load_robot("puma560")


@pytest.fixture(scope="module")
def rig(folder):
    return truearm.read_rig(folder / "rig.toml")


@pytest.fixture(scope="module")
def table(folder, robot):
    return truearm.read_table(folder / "poses.csv", robot)


@pytest.mark.parametrize("name", NAMES)
def test_examples_run(name, folder, monkeypatch):
    monkeypatch.chdir(folder)
    (test,) = doctest.DocTestFinder(recurse=False).find(getattr(truearm, name), name, globs={})
    assert test.examples, f"{name} has no example"
    said = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=said.append)
    assert not said, "".join(said)


@pytest.mark.parametrize("name", ["Robot", "Calibration", "SessionObservations"])
def test_examples_of_methods_run(name, folder, monkeypatch):
    monkeypatch.chdir(folder)
    tests = doctest.DocTestFinder(exclude_empty=True).find(getattr(truearm, name), name, globs={})
    assert len([test for test in tests if test.examples]) >= 2
    said = []
    for test in tests:
        doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=said.append)
    assert not said, "".join(said)


@pytest.mark.parametrize("name", [name for name in NAMES if inspect.isfunction(getattr(truearm, name))])
def test_functions_have_numpydoc(name):
    text = inspect.getdoc(getattr(truearm, name))
    for section in SECTIONS if inspect.signature(getattr(truearm, name)).parameters else SECTIONS[-1:]:
        assert section in text, section
    for parameter in inspect.signature(getattr(truearm, name)).parameters:
        assert parameter in text


def test_every_name_is_there_and_described():
    for name in truearm.__all__:
        assert getattr(truearm, name) is not None
        assert inspect.getdoc(getattr(truearm, name)), name
    assert dir(truearm) == sorted(truearm.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        truearm.nothing  # noqa: B018
    assert len(truearm.__all__) > 40
    stub = Path(truearm.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    assert stub.count("\nfrom truearm.") == len(truearm.__all__) - 1  # and __version__


@pytest.mark.parametrize("name", [name for name in NAMES if inspect.isfunction(getattr(truearm, name))])
def test_what_a_function_returns_and_raises_can_be_named(name):
    function = getattr(truearm, name)
    returned = get_type_hints(function)["return"]
    assert not returned.__module__.startswith("truearm") or returned in [getattr(truearm, one) for one in NAMES]
    raised = re.findall(r"^\w*Error\b", inspect.getdoc(function).partition("Raises\n------\n")[2], re.M)
    assert set(raised) <= set(NAMES)


def test_an_exported_robot_says_what_it_costs(result):
    exact = truearm.export_robot(result, "sheth-uicker")
    assert (exact.missing, exact.exact) == ((), True)
    assert exact.largest < 1e-9
    assert "The file holds everything that was identified" in str(exact)
    lossy = truearm.export_robot(result, "urdf")
    gains = {name for name, one in result.parameters.items() if name.endswith(".gain") and one.value != one.nominal}
    assert set(lossy.missing) == gains
    assert not lossy.exact
    assert f"{1e3 * lossy.rms:.3f} mm RMS ({1e3 * lossy.largest:.3f} mm at most)" in str(lossy)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"q": np.nan}, "finite number"),
        ({"value": -0.46}, "-0.46 m"),
        ({"chuck": ""}, "needs a chuck"),
        ({"kind": "bar"}, "observation kind"),
    ],
)
def test_a_table_that_could_not_be_read_again_is_not_written(change, complaint, tmp_path, robot, table):
    ((field, value),) = change.items()
    column = getattr(table, field).astype(object if isinstance(value, str) else float)
    column[2] = value
    wrong = replace(table, **{field: column.astype(str) if isinstance(value, str) else column})
    with pytest.raises(truearm.TableError, match="row 4.*" + re.escape(complaint)):
        truearm.write_table(tmp_path / "t.csv", wrong, robot)
    assert not (tmp_path / "t.csv").exists()


@pytest.mark.parametrize(
    ("described", "parameter", "names"),
    [
        (truearm.export_robot, "format", FORMATS),
        (truearm.correct_poses, "method", Method),
        (truearm.IdentifyOptions, "prior", Prior),
        (truearm.IdentifyOptions, "solver", SOLVERS),
        (truearm.IdentifyOptions, "loss", Loss),
        (truearm.IdentifyOptions, "joint_laws", LawMode),
        (truearm.BallBarOptions, "criterion", Criterion),
    ],
)
def test_a_docstring_lists_all_names_of_a_choice(described, parameter, names):
    text = inspect.getdoc(described)
    (section,) = re.findall(rf"^{parameter} : .*\n((?:    .*\n)+)", text, re.MULTILINE)
    assert set(names) <= set(re.findall(r'"([^"]+)"', section))
    assert "{" not in text


def test_importing_is_cheap():
    code = "import sys, truearm; print(sorted({'numpy', 'scipy', 'truearm.api'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"


def test_a_result_reads_back_as_it_was_identified(folder, robot, table, rig, result):
    found = truearm.identify(robot, table, rig)
    assert str(found) == str(result)
    np.testing.assert_array_equal(found.identified, result.identified)
    np.testing.assert_array_equal(found.covariance, result.covariance)
    lines = str(found).splitlines()
    assert lines[1].split() == ["parameter", "nominal", "value", "change", "sigma", "unit"]
    assert len(lines) == 2 + 36
    one = found.parameters["link2.x"]
    at = found.estimate.parameter_names.index("link2.x")
    assert (one.value, one.sigma) == (found.estimate.value[at], found.estimate.sigma[at])
    assert not found.parameters["joint2.offset"].seen


def test_identify_is_what_the_command_does(run, folder, robot, table, rig):
    arguments = ["identify", folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml"]
    code, _, err = run(*arguments, "--hold-out", "shell=outer", "--solver", "map", "--out", folder / "command.json")
    assert (code, err) == (0, "")
    options = truearm.IdentifyOptions(solver="map")
    found = truearm.identify(robot, table, rig, hold_out="shell=outer", options=options)
    command = truearm.read_result(folder / "command.json")
    np.testing.assert_array_equal(found.identified, command.identified)
    assert found.document["held_out"] == command.document["held_out"]


def test_rows_are_held_out_and_rigs_named(robot, table, rig):
    outer = table.shell == "outer"
    for hold_out in ("shell=outer", ["shell=outer"], outer):
        assert (truearm.identify(robot, table, rig, hold_out=hold_out).estimate.fitted == ~outer).all()
    assert truearm.identify(robot, table, rig, hold_out=0.2).estimate.fitted.sum() == 72
    named = replace(table, rig=np.full(len(table), "monday"))
    found = truearm.identify(robot, named, {"monday": rig})
    assert found.estimate.rank == 36


def test_the_poses_of_a_calibrated_robot_hold_its_joint_laws(robot):
    """An error curve that the geometry cannot hold: the poses are those with the laws."""
    rng = np.random.default_rng(2)
    q = rng.uniform(-2.0, 2.0, (400, 6))
    bent = q.copy()
    bent[:, 1] += np.radians(0.1) * np.sin(3.0 * q[:, 1])
    xyz = robot.forward(bent)[:, :3, 3] + 2e-5 * rng.normal(size=(400, 3))
    table = truearm.ObservationTable(q=q, kind=np.full(400, "position"), tracker=np.full(400, "t"), xyz=xyz)
    tracker = truearm.Device("t", np.diag([4e-10] * 3), xyz=(0.0, 0.0, 0.0), sigma=0.0, turn_sigma=0.0)
    options = truearm.IdentifyOptions(joint_laws="curve", free=("joint*.offset",))
    result = truearm.identify(robot, table, truearm.Rig(trackers={"t": tracker}), options=options)
    assert np.linalg.norm(robot.forward(q)[:, :3, 3] - table.xyz, axis=1).max() > 5e-4
    assert np.linalg.norm(result.forward(q)[:, :3, 3] - table.xyz, axis=1).max() < 1e-4


def test_samples_and_joints_of_a_session_share_the_time_of_its_table(folder):
    session = truearm.read_session(folder / "session.mcap")
    time, extension = session.samples("lvdt")
    joint_time, q = session.joints()
    assert time.shape == extension.shape
    assert q.shape == (len(joint_time), session.table.q.shape[1])
    for dwell, q_dwell, length in zip(session.table.time, session.table.q, session.table.value, strict=True):
        nearest = np.argmin(np.abs(joint_time - dwell))
        np.testing.assert_allclose(q[nearest], q_dwell, atol=1e-3)
        (bar,) = session.rig.bars.values()
        assert abs(bar.zero + bar.gain * extension[np.argmin(np.abs(time - dwell))] - length) < 1e-3
    with pytest.raises(InputError, match="'lvd'"):
        session.samples("lvd")


def test_a_rig_may_be_read_or_a_file_for_every_function(folder, robot, table, rig):
    path = folder / "session.toml"
    read = [
        truearm.read_session(folder / "session.mcap", rig=given) for given in (path, str(path), truearm.read_rig(path))
    ]
    assert all(session.rig == read[0].rig for session in read)
    np.testing.assert_array_equal(read[0].table.value, read[2].table.value)
    named = truearm.read_session(folder / "session.mcap", rig={"session": truearm.read_rig(path)})
    assert list(named.rig) == ["session"]
    found = [truearm.identify(robot, table, given) for given in (folder / "rig.toml", rig)]
    np.testing.assert_array_equal(found[0].identified, found[1].identified)
    judged = [truearm.validate(found[0], table, given).after["m"].rms for given in (folder / "rig.toml", rig)]
    assert judged[0] == judged[1]


def test_the_robot_of_a_result_is_the_calibrated_one(folder, robot, result):
    """However a result was made: its poses are not those of the robot that was loaded."""
    q = np.array([[0.3, -0.6, 0.5, 0.2, 0.8, 0.1]])
    for read in (result, truearm.read_result(folder / "result.json", robot)):
        np.testing.assert_array_equal(read.robot.forward(q), read.forward(q))
        assert np.abs(read.robot.forward(q) - robot.forward(q)).max() > 1e-5
    assert str(result.robot) == f"{robot}, calibrated"


def test_poses_that_cannot_be_corrected_have_a_status_if_the_others_are_wanted(result):
    q = np.array([[0.3, -0.6, 0.5, 0.2, 0.8, 0.1]])
    poses = np.concatenate([result.robot.forward(q), result.robot.forward(q) + 9.0 * np.eye(4, k=3) * [0, 0, 0, 1]])
    with pytest.raises(TargetError, match="pose 1: no joint values"):
        truearm.correct_poses(result, poses, home=q[0])
    corrected = truearm.correct_poses(result, poses, home=q[0], partial=True)
    assert corrected.status[0] == "corrected"
    assert corrected.status[1].startswith("no joint values")
    assert np.isfinite(corrected.commanded[0]).all()
    assert np.isnan(corrected.commanded[1]).all()
    assert np.isnan(corrected.q[1]).all()
    np.testing.assert_array_equal(
        corrected.commanded[0], truearm.correct_poses(result, poses[:1], home=q[0]).commanded[0]
    )


@pytest.fixture(scope="module")
def shown(folder, robot, rig, table, result):
    """Return an object of each public class that holds arrays."""
    identification = truearm.identify(robot, table, rig)
    pose = result.robot.forward([[0.3, -0.6, 0.5, 0.2, 0.8, 0.1]])
    bench = truearm.read_rig(folder / "bench.toml")
    return [
        *(robot, rig, table, result, identification, identification.estimate),
        truearm.validate(result, truearm.read_table(folder / "friday.csv", robot), rig),
        truearm.correct_poses(result, pose, home=[0.3, -0.6, 0.5, 0.2, 0.8, 0.1]),
        truearm.export_robot(result, "urdf"),
        truearm.error_map(result, cell=0.2),
        truearm.read_session(folder / "session.mcap"),
        truearm.plan_ball_bar(robot, bench, poses=8, options=truearm.BallBarOptions(candidates=60)),
    ]


def test_public_objects_are_displayed_in_one_line_and_a_small_table(shown, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    for thing in shown:
        assert "\n" not in repr(thing)
        assert len(repr(thing)) < 400, repr(thing)
        html = thing._repr_html_()
        assert html.count("<tr>") <= 10
        assert len(html) < 8_000
        assert len({len(column) for column in thing.to_pandas().values()}) <= 1
    results = [type(thing) for thing in shown]
    displayed = {cls for name in NAMES if hasattr(cls := getattr(truearm, name), "_repr_html_")}
    assert displayed == set(results)


def test_columns_become_a_data_frame(table, result, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    frame = table.to_pandas()
    assert list(frame)[:7] == [*(f"q{i}" for i in range(1, 7)), "kind"]
    assert "xyz_sigma" not in str(list(frame))  # columns without any value
    np.testing.assert_array_equal(frame["q3"], table.q[:, 2])
    parameters = result.to_pandas()
    assert parameters["sigma"][list(parameters["name"]).index("link2.x")] == result.parameters["link2.x"].sigma
    pose = result.robot.forward([[0.3, -0.6, 0.5, 0.2, 0.8, 0.1]])
    corrected = truearm.correct_poses(result, pose, home=[0.3, -0.6, 0.5, 0.2, 0.8, 0.1])
    six = [*("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"), *(f"q{i}_rad" for i in range(1, 7))]
    errors = ["before_m", "after_m", "before_rad", "after_rad"]
    assert list(corrected.to_pandas()) == [*six, *errors, "status"]
    simulated = replace(result, stored=msgspec.structs.replace(result.stored, simulated=True))
    named = truearm.correct_poses(simulated, pose, home=[0.3, -0.6, 0.5, 0.2, 0.8, 0.1], names=["A"]).to_pandas()
    assert list(named) == ["name", *six, *errors, "simulated", "status"]
    assert (named["name"][0], named["simulated"][0]) == ("A", "yes")
    for names in (np.array(["A"]), named["name"], (name for name in "A")):
        assert truearm.correct_poses(result, pose, home=[0.3, -0.6, 0.5, 0.2, 0.8, 0.1], names=names).name == ("A",)
    assert truearm.correct_poses(result, pose, home=[0.3, -0.6, 0.5, 0.2, 0.8, 0.1], names=None).name == ()


def test_without_pandas_the_message_says_so(table, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="pip install 'pandas'"):
        table.to_pandas()


# what a call is refused for, by the error and a part of its text; the next table has further arguments
WRONG = [
    (TypeError, "robot: must be Robot (see load_robot)", lambda a: truearm.read_table(a.folder / "poses.csv", "puma560")),
    (RobotError, "nobody", lambda a: truearm.load_robot("nobody")),
    (InputError, "missing.toml", lambda a: truearm.read_rig("missing.toml")),
    (TypeError, "table: must be ObservationTable (see read_table)", lambda a: truearm.identify(a.robot, "poses.csv", a.rig)),
    (FileNotFoundError, "no.toml: no such", lambda a: truearm.identify(a.robot, a.table, a.folder / "no.toml")),
    (InputError, "rig: ", lambda a: truearm.identify(a.robot, a.table)),
    (InputError, "names no rig", lambda a: truearm.identify(a.robot, a.table, {"a": a.rig})),
    (InputError, "6 joints", lambda a: truearm.identify(truearm.load_robot("panda"), a.table, a.rig)),
    (InputError, "hold_out shell=x", lambda a: truearm.identify(a.robot, a.table, a.rig, hold_out="shell=x")),
    (InputError, "hold_out: must be one bool per row", lambda a: truearm.identify(a.robot, a.table, a.rig, hold_out=np.zeros(3, bool))),
    (TypeError, "options: must be IdentifyOptions", lambda a: truearm.identify(a.robot, a.table, a.rig, options="map")),
    (InputError, "loss huber", lambda a: truearm.IdentifyOptions(solver="ls", loss="huber")),
    (InputError, "also_free nothing", lambda a: truearm.identify(a.robot, a.table, a.rig, options=options(also_free=("nothing",)))),
    (TypeError, "result: must be Calibration (see identify or read_result)", lambda a: truearm.validate("result.json", a.table, a.rig)),
    (InputError, "rig.toml", lambda a: truearm.read_result(a.folder / "rig.toml")),
    (InputError, "rig.toml", lambda a: truearm.read_session(a.folder / "rig.toml")),
    (InputError, "MCAP", lambda a: truearm.read_session(a.folder / "poses.csv")),
    (InputError, "neither poses nor minutes", lambda a: truearm.plan_ball_bar(a.robot, a.rig)),
    (InputError, "(n, 4, 4)", lambda a: truearm.correct_poses(a.result, [1.0, 2.0])),
    (InputError, "poses: number 1 ", lambda a: truearm.correct_poses(a.result, [np.eye(4), 2.0 * np.eye(4)])),
    (InputError, "poses: number 0 ", lambda a: truearm.correct_poses(a.result, np.diag([1.0, 1.0, -1.0, 1.0]))),
    (TargetError, "pose 0", lambda a: truearm.correct_poses(a.result, np.eye(4) + 9.0 * np.eye(4, k=3) * [0, 0, 0, 1])),
    (InputError, "names: must be 1 name", lambda a: truearm.correct_poses(a.result, np.eye(4), names=["A", "B"])),
    (TypeError, "names: must be Iterable[str] or None", lambda a: truearm.correct_poses(a.result, np.eye(4), names="A")),
    (TypeError, "names: must be Iterable[str] or None", lambda a: truearm.correct_poses(a.result, np.eye(4), names=[1])),
    (InputError, "robot: is that of a calibration; give the nominal one", lambda a: truearm.identify(a.result.robot, a.table, a.rig)),
    (InputError, "robot: is that of a calibration; give the nominal one", lambda a: truearm.read_result(a.folder / "result.json", a.result.robot)),
    (InputError, "tip has no effect", lambda a: truearm.read_result(a.folder / "result.json", a.robot, tip="tool0")),
    (InputError, "its parameters differ from those of robot panda", lambda a: truearm.read_result(a.folder / "result.json", truearm.load_robot("panda"))),
    (InputError, "method: 'magic'", lambda a: truearm.correct_poses(a.result, np.eye(4), method="magic")),
    (InputError, "joints 2,9: must be two joints", lambda a: truearm.error_map(a.result, (2, 9))),
]  # fmt: skip


@pytest.fixture(scope="module")
def given(folder, robot, table, rig, result):
    bench = truearm.read_rig(folder / "bench.toml")
    return SimpleNamespace(folder=folder, robot=robot, table=table, rig=rig, result=result, bench=bench)


@pytest.mark.parametrize(("error", "says", "call"), WRONG)
def test_a_wrong_argument_is_named_in_one_line(error, says, call, given):
    with pytest.raises(error) as caught:
        call(given)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "--" not in str(caught.value)


def options(**given):
    return truearm.IdentifyOptions(**given)


def planned(robot, rig, **given):
    fields = {name: given.pop(name) for name in tuple(given) if name not in ("poses", "minutes", "result", "options")}
    return truearm.plan_ball_bar(robot, rig, **given, options=truearm.BallBarOptions(**fields))


# what a call is refused for: the argument that the message begins with, and whether its type or its value is wrong
REFUSED = [
    *(("max_iterations", TypeError, lambda a, v=v: options(max_iterations=v)) for v in (2.5, "5", True, None)),
    *(("max_iterations", InputError, lambda a, v=v: options(max_iterations=v)) for v in (0, 10_001)),
    ("seed", InputError, lambda a: options(seed=-1)),
    *((name, InputError, lambda a, name=name: options(**{name: "magic"})) for name in ("solver", "loss", "prior")),
    ("hold_out", TypeError, lambda a: truearm.identify(a.robot, a.table, a.rig, hold_out=[0.2])),
    ("hold_out", TypeError, lambda a: truearm.identify(a.robot, a.table, a.rig, hold_out=np.zeros(90))),
    ("hold_out", InputError, lambda a: truearm.identify(a.robot, a.table, a.rig, hold_out=np.ones(90, bool))),
    *(("hold_out", InputError, lambda a, v=v: truearm.identify(a.robot, a.table, a.rig, hold_out=v)) for v in (5.0, -0.1, float("nan"))),
    *(("poses", InputError, lambda a, v=v: planned(a.robot, a.bench, poses=v)) for v in (0, -1)),
    *(("minutes", InputError, lambda a, v=v: planned(a.robot, a.bench, minutes=v)) for v in (float("nan"), float("inf"), 0.0)),
    ("lower", InputError, lambda a: truearm.Region([0.0, 0.0], [1.0, 1.0, 1.0])),
    ("lower", InputError, lambda a: truearm.Region([2.0, 0.0, 0.0], [1.0, 1.0, 1.0])),
    ("upper", InputError, lambda a: truearm.Region([0.0, 0.0, 0.0], [1.0, 1.0, float("nan")])),
    ("upper", TypeError, lambda a: truearm.Region([0.0, 0.0, 0.0], "abc")),
    *((name, InputError, lambda a, name=name, v=v: planned(a.robot, a.bench, poses=8, **{name: v}))
      for name, v in (("candidates", 0), ("candidates", 100_001), ("reserve", -1e-3), ("reserve", float("inf")), ("spread", float("nan")), ("dwell", 0.0), ("seed", -1), ("criterion", "Q"))),
    *(("over", InputError, lambda a, v=v: truearm.export_robot(a.result, "dh", over=v)) for v in (np.full((4, 6), np.nan), np.zeros((0, 6)), np.zeros((3, 5)))),
    ("format", InputError, lambda a: truearm.export_robot(a.result, "step")),
    *(("joints", TypeError, lambda a, v=v: truearm.error_map(a.result, v)) for v in ((1,), 3, ("a", "b"), (2.5, 3), (1, 2, 3), "23")),
    *(("joints", InputError, lambda a, v=v: truearm.error_map(a.result, v)) for v in ((0, 2), (2, 7), (2, 2))),
    *(("cell", InputError, lambda a, v=v: truearm.error_map(a.result, cell=v)) for v in (float("inf"), float("nan"), 0.0, -0.1)),
    *(("home", InputError, lambda a, v=v: truearm.correct_poses(a.result, np.eye(4), home=v)) for v in ([0.0] * 5, [float("nan")] * 6, [1e3] * 6, np.zeros((1, 6)))),
    ("poses", TypeError, lambda a: truearm.correct_poses(a.result, np.eye(4, dtype=complex))),
    ("poses", TypeError, lambda a: truearm.correct_poses(a.result, [np.eye(4), [[1.0]]])),
    ("poses", InputError, lambda a: truearm.correct_poses(a.result, np.zeros((0, 4, 4)))),
    ("base", InputError, lambda a: truearm.load_robot("puma560", base="link1")),
    ("line_points", InputError, lambda a: truearm.read_session(a.folder / "session.mcap", line_points=1)),
    ("xyz", TypeError, lambda a: truearm.Point("c", (1.0, 2.0))),
    ("xyz", InputError, lambda a: truearm.Point("c", (1.0, 2.0, float("nan")))),
    ("sigma", InputError, lambda a: truearm.Point("c", (0.0, 0.0, 0.0), sigma=-1e-5)),
    ("gain_sigma", InputError, lambda a: truearm.BallBar("b", 0.46, 1.0, 0.075, 1e-5, gain_sigma=float("inf"))),
    ("line_sigma", InputError, lambda a: truearm.Rig(line_sigma=(1e-5, -1e-5, 1e-5))),
    ("identify", TypeError, lambda a: truearm.identify(a.robot, a.table, a.rig, solver="map")),
    ("kind", InputError, lambda a: truearm.ObservationTable(q=[[1.0, 2.0]], kind=["a", "b"])),
    ("q", InputError, lambda a: truearm.ObservationTable(q=[1, 2], kind="a")),
    ("q", TypeError, lambda a: truearm.ObservationTable(q=[["a"]], kind=["seat"])),
    ("q", TypeError, lambda a: truearm.ObservationTable(q=[[1.0], [1.0, 2.0]], kind=["seat"])),
    ("xyz", TypeError, lambda a: truearm.ObservationTable(q=[[1.0]] * 2, kind="seat", xyz=[[1.0], [1.0, 2.0]])),
    *(("table", InputError, lambda a, field=field, v=v: truearm.identify(a.robot, replace(a.table, **{field: np.full(getattr(a.table, field).shape, v)}), a.rig))
      for field, v in (("kind", "bar"), ("q", np.nan), ("value", np.nan))),
    *(("apply", InputError, lambda a, v=v: truearm.identify(a.robot, a.table, a.rig, options=options(apply=(v,))))
      for v in ("chuck.c1@9999", "chuck.c1.thermal_drift")),
    ("bars", InputError, lambda a: planned(a.robot, a.bench, poses=8, bars=("b99",))),
    *(("q", error, lambda a, v=v: a.result.outside(v)) for v, error in ((None, TypeError), ("home", TypeError), ([0.0] * 6, InputError), ([[0.0] * 5], InputError))),
    *(("residual", TypeError, lambda a, v=v: truearm.Figures.of(v)) for v in (None, "1.0")),
    *(("residuals", TypeError, lambda a, v=v: truearm.Figures.by_unit(v)) for v in (None, [1.0])),
    ("value", InputError, lambda a: truearm.ObservationTable(q=[[1.0]], kind=["seat"], value=[1.0, 2.0])),
    ("length", TypeError, lambda a: truearm.ObservationTable(q=[[1.0]], kind="seat", length=0.4)),
    ("poses", InputError, lambda a: truearm.correct_poses(a.result, np.eye(4) + 1e300 * np.eye(4, k=3))),
    ("table", InputError, lambda a: truearm.identify(a.robot, replace(a.table, q=np.degrees(a.table.q)), a.rig)),
    ("table", InputError, lambda a: truearm.identify(a.robot, a.table.select(slice(0)), a.rig)),
    *(("table", InputError, lambda a, field=field, v=v: truearm.identify(a.robot, replace(a.table, **{field: np.full(getattr(a.table, field).shape, v)}), a.rig))
      for field, v in (("value", 370.0), ("value", -0.46), ("value", float("inf")), ("sigma", 84.0), ("sigma", 0.0), ("time", 1e12), ("temperature", 1e3), ("q_rate", 1e3))),
    *((field, InputError, lambda a, field=field, v=v: truearm.Rig(**{field: v}))
      for field, v in (("time_offset", 1e6), ("seat_sigma", 0.0), ("line_travel", 1e3), ("payload", 1e6), ("payload_centre", [0.0, 0.0, 1e3]), ("line_placement", "nope"), ("line_sigma", [1e-5, 1e-5, 0.0]), ("time_offset_sigma", -1.0))),
    *(("joint_cov", error, lambda a, v=v: truearm.Rig(joint_cov=v))
      for v, error in (([1.0, 2.0], TypeError), ("x", TypeError), (np.eye(6)[:5], InputError), (-np.eye(6), InputError), (np.triu(np.ones((6, 6))), InputError), ([[1.0, 0.0], [1.0]], InputError))),
    *((field, error, lambda a, field=field, v=v: truearm.Rig(**{field: v}))
      for field in ("backlash", "backlash_sigma") for v, error in (([[1e-4]], TypeError), (["a"], TypeError), ([float("nan")], InputError), ([1e6], InputError))),
    *((field, InputError, lambda a, field=field, v=v: truearm.BallBar(**{"name": "b", "zero": 0.46, "gain": 1.0, "travel": 0.075, "sigma": 1e-5, field: v}))
      for field, v in (("zero", 370.0), ("zero", -0.46), ("travel", 75.0e3), ("sigma", 0.0), ("gain", 0.0), ("temperature", 1e3), ("expansion", 11.5))),
    ("xyz", InputError, lambda a: truearm.Point("c", (1000.0, 0.0, 0.0))),
    ("sigma", InputError, lambda a: truearm.Point("c", (1.0, 0.0, 0.0), sigma=1e-13)),
    ("distance", InputError, lambda a: truearm.SocketDistance(("a", "b"), distance=50.0e3, sigma=1e-5)),
    *(("sensor_cov", InputError, lambda a, v=v: truearm.Device("t", v)) for v in ((), [[1e-8]], np.zeros((3, 3)), np.triu(np.ones((3, 3))))),
    *(("normal", InputError, lambda a, v=v: truearm.Plane("f", (0.4, 0.0, 0.0), v, 2e-5)) for v in ([0.0, 0.0, 0.0], [0.0, 0.0, float("nan")])),
    ("rig", InputError, lambda a: truearm.identify(a.robot, a.table, {})),
    ("home", InputError, lambda a: truearm.correct_poses(a.result, np.eye(4), home=[0.0, 0.0, 0.0, 0.0, 0.0, 7.0])),
    ("at", InputError, lambda a: truearm.error_map(a.result, at=[0.0, 0.0, 0.0, 0.0, 0.0, -7.0])),
    ("over", InputError, lambda a: truearm.export_robot(a.result, "dh", over=np.full((20, 6), 1e4))),
    ("result", InputError, lambda a: truearm.plan_ball_bar(truearm.load_robot("irb120"), a.bench, poses=8, result=a.result)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "error", "call"), REFUSED)
def test_a_message_begins_with_the_argument_that_is_wrong(name, error, call, given):
    with pytest.raises((TypeError, InputError)) as caught:
        call(given)
    assert isinstance(caught.value, error)
    assert re.match(rf"{name}\b", str(caught.value)), str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200


ODD = (
    *(None, "", "x", "missing.mcap", "missing.csv", "a\0b", "x" * 5000, b"x", 0, -1, 10**400, True, 1 + 2j, object()),
    *([], [1.0], [[1.0, 2.0], [3.0]], [""], [None], (), {}, {"a": 1}, float("nan"), float("inf"), np.float64(3.0)),
    *(np.zeros((2, 3, 4)), np.array([]), np.full((4, 4), np.nan)),
    *(Path("missing.json"), Path("empty.mcap"), Path("folder"), Path("noise.mcap"), Path("/dev/null/x")),
)


def refusals(call, argument, right):
    """Call with each odd value of an argument; return those refused. Any other exception is raised."""
    found = []
    for value in ODD:
        try:
            call(**{**right, argument: value})
        except (TypeError, truearm.TruearmError) as exc:
            found.append(exc)
    return found


def test_odd_values_of_every_argument_are_refused_with_a_text(folder, robot, table, rig, result, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "noise.mcap").write_bytes(bytes(range(256)) * 20)
    (tmp_path / "folder").mkdir()
    right = {"robot": robot, "table": table, "rig": rig, "result": result, "format": "urdf", "poses": np.eye(4)}
    paths = {"read_session": "session.mcap", "read_rig": "rig.toml", "read_result": "result.json"}
    calls = []
    for name in (name for name in NAMES if inspect.isfunction(getattr(truearm, name))):
        parameters = inspect.signature(getattr(truearm, name)).parameters
        needed = {one: right.get(one) for one, of in parameters.items() if of.default is of.empty}
        if "path" in needed:
            needed["path"] = tmp_path / "out" if name.startswith("write") else folder / paths.get(name, "poses.csv")
        if name == "load_robot":
            needed = {"robot": "puma560"}
        elif name in ("identify", "validate"):
            needed["rig"] = rig
            parameters = {one: of for one, of in parameters.items() if one not in ("hold_out", "keep_rig")}
        elif name == "plan_ball_bar":
            few = truearm.BallBarOptions(candidates=60)
            needed |= {"rig": truearm.read_rig(folder / "bench.toml"), "poses": None, "options": few}
        calls += [(getattr(truearm, name), needed, one) for one in parameters]
    records = (
        (truearm.Point, {"name": "c", "xyz": (0.0, 0.0, 0.0)}),
        (truearm.BallBar, {"name": "b", "zero": 0.4, "gain": 1.0, "travel": 0.1, "sigma": 1e-5}),
        (truearm.Device, {"name": "t", "sensor_cov": 1e-8 * np.eye(3)}),
        (truearm.Plane, {"name": "p", "xyz": (0.0, 0.0, 0.0), "normal": (0.0, 0.0, 1.0), "sigma": 1e-5}),
        (truearm.SocketDistance, {"sockets": ("a", "b"), "distance": 0.1, "sigma": 1e-5}),
        (truearm.ObservationTable, {"q": [[0.0] * 6], "kind": ["seat"]}),
        (truearm.Region, {"lower": [0.0, 0.0, 0.0], "upper": [1.0, 1.0, 1.0]}),
        *((one, {}) for one in (truearm.Rig, truearm.IdentifyOptions, truearm.BallBarOptions)),
    )
    calls += [(record, given, one) for record, given in records for one in inspect.signature(record).parameters]
    calls += [(table.select, {}, "rows"), (truearm.ObservationTable.joined, {}, "tables")]
    calls += [(result.carrying, {"mass": 0.0}, one) for one in ("mass", "centre")]
    for call, given, name in calls:
        found = refusals(call, name, given)
        texts = [str(exc) for exc in found]
        assert len(texts) > len(ODD) / 3, (call, name)
        assert name in ("rows", "named") or any(isinstance(exc, TypeError) for exc in found), (call, name)
        assert name == "named" or any(text.startswith(f"{name}: must be ") for text in texts), (call, name)
        assert not any("\n" in text for text in texts)


def test_wrong_rows_tables_and_rows_in_memory_are_named(table, robot, rig, tmp_path):
    for rows in ("x", [0.5], np.ones(3, bool), len(table), [[0, 1]]):
        with pytest.raises(InputError, match=r"^rows: must be"):
            table.select(rows)
    other = truearm.ObservationTable(q=[[0.0]], kind=["seat"])
    for tables, error in (([table, other], InputError), ([], InputError), ("x", TypeError), ([1], TypeError)):
        with pytest.raises(error, match=r"^tables: must be "):
            truearm.ObservationTable.joined(tables)
    assert len(table.select(slice(3, 7))) == len(table.select([3, 4, 5, 6])) == 4
    every = np.arange(len(table))
    assert table.select(every >= 0) is table
    np.testing.assert_array_equal(table.select(every[::-1]).q, table.q[::-1])
    q = table.q.copy()
    q[3, 2] = np.nan
    bare = table.replace(q=q, source=None)
    with pytest.raises(truearm.TableError, match=r"^table: table\[3\]: q\[2\]"):
        truearm.identify(robot, bare, rig)
    # Messages name arguments as Python has them; two dashes in a name stay.
    with pytest.raises(InputError, match=r"runs--monday\.csv"):
        truearm.read_table(tmp_path / "runs--monday.csv", truearm.load_robot("puma560"))


def test_arrays_numbers_and_masks_of_numpy_are_taken_or_refused(table, result):
    # As data frames and binary files have them; a NumPy solver takes no float128, and float16 would round a length.
    for dtype in (np.float16, np.float32, np.longdouble, ">f8"):
        assert replace(table, q=table.q.astype(dtype)).q.dtype == np.float64
    for dtype in (object, np.dtypes.StringDType() if hasattr(np.dtypes, "StringDType") else object):
        given = replace(table, chuck=table.chuck.astype(dtype))
        assert given.chuck.dtype.kind == "U"
        assert given.chuck.tolist() == table.chuck.tolist()
    with pytest.raises(TypeError, match="chuck: must be an array"):
        replace(table, chuck=np.where(table.chuck == "c0", table.chuck.astype(object), np.nan))
    hidden = np.ma.masked_array(table.value, mask=np.arange(len(table)) == 3)
    with pytest.raises(TypeError, match="NaN, or leave out their rows"):
        replace(table, value=hidden)
    np.testing.assert_array_equal(replace(table, value=np.ma.masked_array(table.value)).value, table.value)
    with pytest.raises(TypeError, match=r"home: .*masked values"):
        truearm.correct_poses(result, np.eye(4), home=np.ma.masked_array(np.zeros(6), mask=np.arange(6) == 3))
    chosen = truearm.IdentifyOptions(free=["*.offset"], max_iterations=np.int64(3))
    assert (list(chosen.free), chosen.max_iterations) == (["*.offset"], 3)
    assert truearm.BallBarOptions(dwell=np.float32(2.0), spread=0, candidates=np.int32(60)).dwell == 2.0
    rows = truearm.ObservationTable(q=[[1, 2]], kind=["seat"], place=["p"], socket=["s"])
    assert (rows.q.dtype, rows.q.shape, rows.kind.shape) == (np.dtype(float), (1, 2), (1,))


def test_lists_and_arrays_of_a_rig_become_tuples(robot, table, rig):
    cov, width = 1e-10 * np.eye(6), np.full(6, 1e-6)
    lists = replace(rig, joint_cov=cov.tolist(), backlash=width.tolist(), backlash_sigma=[1e-7] * 6)
    arrays = replace(rig, joint_cov=cov, backlash=width, backlash_sigma=np.full(6, 1e-7))
    assert lists == arrays
    assert {lists.joint_cov, arrays.joint_cov} == {tuple(map(tuple, cov.tolist()))}
    assert truearm.Rig(line_placement="two_point").line_placement is LinePlacement.TWO_POINT
    assert truearm.Device("t", cov[:3, :3]).sensor_cov[0] == (1e-10, 0.0, 0.0)
    assert truearm.Point("c", np.zeros(3)).xyz == (0.0, 0.0, 0.0)
    assert truearm.identify(robot, table, lists).estimate.status == "converged"


def test_what_holds_arrays_is_compared_by_identity(folder, robot, table, result):
    """NumPy would refuse to say whether two arrays are equal, as in ``table in tables``."""
    identified = truearm.identify(robot, table, truearm.read_rig(folder / "rig.toml"))
    session = truearm.SessionObservations(table, truearm.Rig())
    for one in (robot, table, result, session, identified, identified.estimate):
        assert one in (copy.copy(one), one)
        assert one in {one}
        assert one != copy.copy(one)
