"""The public Python interface: every name has a doctest that runs, wrong arguments are named, types are real."""

import doctest
import inspect
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identify_bench import exact_lengths
from session_stream import RIG, session

import truearm
from truearm.errors import InputError, RobotError, TableError, TargetError
from truearm.files.rig_file import write_rig
from truearm.model.chain import forward
from truearm.record.links import HostClock
from truearm.record.session_writer import SessionWriter
from truearm_sim.world import standard_rig

ROOT = Path(__file__).parents[2]
NAMES = [name for name in truearm.__all__ if name != "__version__"]
# of numpydoc, what a function that has arguments, returns and raises must say
SECTIONS = ("Parameters\n----------", "Raises\n------", "Examples\n--------")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the examples read: two tables of one robot, its rig, a session, a result."""
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
    with SessionWriter(folder / "session.mcap", HostClock()) as writer:
        writer.attach("rig.toml", "application/toml", (folder / "session.toml").read_bytes())
        for message in session(np.random.default_rng(2), dwells=5)[0]:
            writer.add(message.topic, message.t_host_ns, message.data)
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


@pytest.mark.parametrize("name", [name for name in NAMES if inspect.isfunction(getattr(truearm, name))])
def test_functions_have_numpydoc(name):
    text = inspect.getdoc(getattr(truearm, name))
    for section in SECTIONS if inspect.signature(getattr(truearm, name)).parameters else SECTIONS[-1:]:
        assert section in text, section
    for parameter in inspect.signature(getattr(truearm, name)).parameters:
        assert parameter in text


def test_every_name_is_there_and_in_the_page():
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    for name in truearm.__all__:
        assert getattr(truearm, name) is not None
        assert f"`{name}`" in page, name
    assert dir(truearm) == sorted(truearm.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        truearm.nothing  # noqa: B018


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
    arguments = ["identify", folder / "poses.csv", "--robot", "puma560", "--rig", folder / "rig.toml"]
    code, _, err = run(*arguments, "--hold-out", "shell=outer", "--solver", "map", "--out", folder / "command.json")
    assert (code, err) == (0, "")
    options = truearm.IdentifyOptions(solver="map")
    found = truearm.identify(robot, table, rig, hold_out="shell=outer", options=options)
    command = truearm.read_result(folder / "command.json")
    np.testing.assert_array_equal(found.identified, command.identified)
    assert found.document["held_out"] == command.document["held_out"]


def test_rows_are_held_out_by_name_fraction_and_mask(robot, table, rig):
    outer = table.shell == "outer"
    for hold_out in ("shell=outer", ["shell=outer"], outer):
        assert (truearm.identify(robot, table, rig, hold_out=hold_out).estimate.fitted == ~outer).all()
    assert truearm.identify(robot, table, rig, hold_out=0.2).estimate.fitted.sum() == 72


def test_a_mapping_of_rigs_serves_the_column_rig(robot, table, rig):
    named = replace(table, rig=np.full(len(table), "monday"))
    found = truearm.identify(robot, named, {"monday": rig})
    assert found.estimate.rank == 36


def test_export_correct_and_map(folder, result):
    written = truearm.export_robot(result, "sheth-uicker", folder / "calibrated.toml")
    assert (folder / "calibrated.toml").read_text() == written.text
    assert truearm.load_robot(folder / "calibrated.toml").chain.joints
    q = np.array([0.3, -0.6, 0.5, 0.2, 0.8, 0.1])
    poses = forward(result.chain, result.nominal, q[None])
    corrected = truearm.correct_poses(result, poses, home=q)
    np.testing.assert_allclose(corrected.q_nominal, [q], atol=1e-9)
    np.testing.assert_allclose(forward(result.chain, result.identified, corrected.q), poses, atol=1e-9)
    assert truearm.error_map(result, at=[0.0] * 6, cell=0.2).error.ndim == 2


WRONG = {
    "robot as text": (lambda f, r, t, g, c: truearm.read_table(f / "poses.csv", "puma560"), TypeError, "robot must be"),
    "no robot": (lambda f, r, t, g, c: truearm.load_robot("nobody"), RobotError, "nobody"),
    "no file name": (lambda f, r, t, g, c: truearm.read_rig(3), TypeError, "path must be a file name"),
    "no file": (lambda f, r, t, g, c: truearm.read_rig("missing.toml"), InputError, "missing.toml"),
    "table as path": (lambda f, r, t, g, c: truearm.identify(r, "poses.csv", g), TypeError, "table must be"),
    "rig as path": (lambda f, r, t, g, c: truearm.identify(r, t, "rig.toml"), TypeError, "rig must be"),
    "rig without chucks": (lambda f, r, t, g, c: truearm.identify(r, t), TableError, "not in the rig"),
    "rig's name": (lambda f, r, t, g, c: truearm.identify(r, t, {"a": g}), InputError, "rig: has no rig ''"),
    "joints": (
        lambda f, r, t, g, c: truearm.identify(truearm.load_robot("panda"), t, g),
        InputError,
        "table: has 6 joints, robot",
    ),
    "hold-out": (lambda f, r, t, g, c: truearm.identify(r, t, g, hold_out="shell=x"), InputError, "hold_out shell=x"),
    "hold-out's type": (lambda f, r, t, g, c: truearm.identify(r, t, g, hold_out=None), TypeError, "hold_out must be"),
    "hold-out's mask": (
        lambda f, r, t, g, c: truearm.identify(r, t, g, hold_out=np.zeros(3, bool)),
        InputError,
        "hold_out: must be one bool a row",
    ),
    "options": (lambda f, r, t, g, c: truearm.identify(r, t, g, options="map"), TypeError, "options must be"),
    "solver": (
        lambda f, r, t, g, c: truearm.identify(r, t, g, options=truearm.IdentifyOptions(solver="newton")),
        InputError,
        "solver 'newton' is not known",
    ),
    "loss": (
        lambda f, r, t, g, c: truearm.identify(r, t, g, options=truearm.IdentifyOptions(solver="ls", loss="huber")),
        InputError,
        "loss huber",
    ),
    "pattern": (
        lambda f, r, t, g, c: truearm.identify(r, t, g, options=truearm.IdentifyOptions(also_free=("nothing",))),
        InputError,
        "also_free nothing",
    ),
    "result": (lambda f, r, t, g, c: truearm.validate("result.json", t, g), TypeError, "result must come from"),
    "result's file": (lambda f, r, t, g, c: truearm.read_result(f / "rig.toml"), InputError, "rig.toml"),
    "budget": (lambda f, r, t, g, c: truearm.plan_ball_bar(r, g), InputError, "poses, minutes: give one"),
    "poses": (lambda f, r, t, g, c: truearm.correct_poses(c, [1.0, 2.0]), InputError, "poses: must be"),
    "poses that are no poses": (
        lambda f, r, t, g, c: truearm.correct_poses(c, [np.eye(4), 2.0 * np.eye(4)]),
        InputError,
        "poses: number 1 is no rotation",
    ),
    "a mirrored pose": (
        lambda f, r, t, g, c: truearm.correct_poses(c, np.diag([1.0, 1.0, -1.0, 1.0])),
        InputError,
        "poses: number 0 is no rotation",
    ),
    "pattern as text": (
        lambda f, r, t, g, c: truearm.identify(r, t, g, options=truearm.IdentifyOptions(free="joint*.offset")),
        InputError,
        "free: must be a tuple of patterns",
    ),
    "no iteration": (
        lambda f, r, t, g, c: truearm.identify(r, t, g, options=truearm.IdentifyOptions(max_iterations=0)),
        InputError,
        "max_iterations: must be 1 or more, is 0",
    ),
    "table as session": (lambda f, r, t, g, c: truearm.read_session(f / "poses.csv"), InputError, "is no session"),
    "poses' type": (lambda f, r, t, g, c: truearm.correct_poses(c, "home"), TypeError, "poses must be"),
    "far pose": (
        lambda f, r, t, g, c: truearm.correct_poses(c, np.eye(4) + 9.0 * np.eye(4, k=3) * [0, 0, 0, 1]),
        TargetError,
        "pose 0",
    ),
    "method": (
        lambda f, r, t, g, c: truearm.correct_poses(c, np.eye(4), method="magic"),
        InputError,
        "method: 'magic'",
    ),
    "home": (lambda f, r, t, g, c: truearm.correct_poses(c, np.eye(4), home=[1.0]), InputError, "home: must be 6"),
    "format": (lambda f, r, t, g, c: truearm.export_robot(c, "step"), InputError, "step"),
    "over": (lambda f, r, t, g, c: truearm.export_robot(c, "dh", over=[[1.0]]), InputError, "over: must be"),
    "cell": (lambda f, r, t, g, c: truearm.error_map(c, cell=0.0), InputError, "cell: must be"),
    "joints of a map": (
        lambda f, r, t, g, c: truearm.error_map(c, (2, 9)),
        InputError,
        "joints 2,9: must be two joints",
    ),
    "session": (lambda f, r, t, g, c: truearm.read_session(f / "rig.toml"), InputError, "rig.toml"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_argument_is_named_in_one_line(case, folder, robot, table, rig, result):
    call, error, says = WRONG[case]
    with pytest.raises(error) as caught:
        call(folder, robot, table, rig, result)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "--" not in str(caught.value)


def test_a_files_name_is_no_option(tmp_path):
    """Messages name arguments as Python has them; two dashes in a name stay."""
    with pytest.raises(InputError, match=r"runs--monday\.csv"):
        truearm.read_table(tmp_path / "runs--monday.csv", truearm.load_robot("puma560"))
