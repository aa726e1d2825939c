"""``truearm identify`` as a user meets it: what it prints and writes, and what it says of bad input."""

import json
import math
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import device_bench
import numpy as np
import pytest
import ulb_bench

from truearm import cli
from truearm.commands.identify import Loss, Solver
from truearm.commands.show import advice
from truearm.estimate.identify import SOLVERS
from truearm.estimate.robust import LOSSES
from truearm.files.result import parse_result, read_result
from truearm.files.rig import write_rig
from truearm.files.robot import load_robot
from truearm.files.table import concatenate, read_table, write_table
from truearm.model.chain import point_forward
from truearm.model.robot import builtin_names
from truearm.types import BallBar, Device, ObservationTable, Point, Rig

ROOT = Path(__file__).parents[2]
MUKCA = ROOT / "tests" / "data" / "mukca"


class Outcome(NamedTuple):
    code: int
    out: str
    err: str


Run = Callable[..., Outcome]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """The real main() with arguments; what it returns and prints."""

    def call(*arguments: object) -> Outcome:
        code = cli.main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return call


HELD_OUT_KEYS = {"rms_mm", "mean_mm", "max_mm", "n", "n_settled", "n_left_out"}


def process(*arguments: object) -> Outcome:
    command = [sys.executable, "-m", "truearm", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    return Outcome(done.returncode, done.stdout, done.stderr)


def exact_lengths(n: int, chucks: int = 3, seed: int = 5) -> tuple[ObservationTable, Rig]:
    """Noise-free ball-bar rows of the PUMA with Table II's optimised parameters, all pairings in turn."""
    robot = load_robot("puma560")
    where = {
        "chuck": [(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (0.0, 0.3, 0.1)][:chucks],
        "sphere": [(0.0, 0.0, 0.1), (0.08, 0.0, 0.1), (0.0, 0.06, 0.05)],
    }
    points = {
        what: {f"{what[0]}{i}": Point(f"{what[0]}{i}", p) for i, p in enumerate(ps)} for what, ps in where.items()
    }
    rig = Rig(points["chuck"], points["sphere"], {"b": BallBar("b", 0.46, 1.0, 0.075, 8.4e-5)})
    q = np.random.default_rng(seed).uniform(-1.5, 1.5, (n, 6))
    chuck, sphere = np.arange(n) % chucks, np.arange(n) // chucks % 3
    ball = point_forward(robot.chain, robot.parameter_sets["optimised"], q, np.array(where["sphere"])[sphere])
    empty = np.full(n, "")
    table = ObservationTable(
        q=q,
        kind=np.full(n, "ball_bar"),
        value=np.linalg.norm(ball - np.array(where["chuck"])[chuck], axis=1),
        sigma=np.full(n, math.nan),
        bar=np.full(n, "b"),
        chuck=np.char.add("c", chuck.astype(str)),
        sphere=np.char.add("s", sphere.astype(str)),
        socket=empty,
        place=empty,
        shell=np.where(np.arange(n) < n - 20, "inner", "outer"),
        source=empty,
    )
    return table, rig


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a good table and a good rig."""
    folder = tmp_path_factory.mktemp("identify")
    table, rig = exact_lengths(90)
    write_table(folder / "poses.csv", table, ("rad",) * 6)
    write_rig(folder / "rig.toml", rig)
    return folder


@pytest.fixture
def good(files: Path) -> list[object]:
    return ["identify", files / "poses.csv", "--robot", "puma560", "--rig", files / "rig.toml"]


def test_noise_free_lengths_give_the_true_robot(run: Run, good: list[object]) -> None:
    outcome = run(*good, "--all-free", "--hold-out", "outer", "--json")
    assert (outcome.code, outcome.err) == (0, "")
    result = json.loads(outcome.out)
    assert (result["status"], result["rank"], result["n_free"]) == ("converged", 36, 54)
    assert len(result["null_space"]) == 18
    assert result["iterations"] <= 8
    assert result["rms_before_mm"] > 1.0
    # 1e-10 of the parameters over lengths of about 1 m.
    assert result["rms_after_mm"] < 1e-7
    assert result["held_out"]["n"] == 20
    assert result["held_out"]["max_mm"] < 1e-7
    assert result["held_out_before"]["mean_mm"] > 1.0


SCALARS: dict[str, type | tuple[type, ...]] = {
    "format": str,
    "format_version": int,
    "truearm_version": str,
    "status": str,
    "message": str,
    "solver": str,
    "loss": str,
    "prior": str,
    "iterations": int,
    "n_observations": int,
    "n_free": int,
    "rank": int,
    "rank_gap": (float, type(None)),
    "rms_before_mm": float,
    "rms_after_mm": float,
    "chi2_reduced": (float, type(None)),
    "chi2_freedom": float,
    "relabelling_search": str,
}
PARAMETER = {
    "name": str,
    "unit": str,
    "nominal": float,
    "value": float,
    "sigma": (float, type(None)),
    "free": bool,
    "seen": bool,
    "of": str,
}
LISTS = {
    *("inputs", "observations", "free", "null_space", "rms_history_mm", "held_out_by", "parameters"),
    *("suggested_free", "additions", "relabellings", "chi2_band", "suspect", "hardly_seen"),
}
OBJECTS = {"robot", "held_out", "held_out_before", "covariance", "observability", "predicted_error"}
KIND_RMS = {"rms_before_mm", "rms_after_mm", "rms_held_out_mm", "rms_rotation_deg"}


def check_schema(result: dict[str, Any]) -> None:
    """docs/result-format.md, as far as a machine can hold it."""
    assert set(result) == {*SCALARS, *LISTS, *OBJECTS}
    for key, kind in SCALARS.items():
        assert isinstance(result[key], kind), key
    for parameter in result["parameters"]:
        assert set(parameter) == set(PARAMETER)
        assert all(isinstance(parameter[key], kind) for key, kind in PARAMETER.items()), parameter
        assert parameter["unit"] in ("m", "rad", "1")
        assert (parameter["sigma"] is None) == (not parameter["seen"])
    free = [p["name"] for p in result["parameters"] if p["free"]]
    assert result["free"] == result["covariance"]["names"] == free
    assert np.array(result["covariance"]["matrix"], dtype=float).shape == (len(free), len(free))
    unseen = {name for direction in result["null_space"] for name in direction["names"]}
    assert unseen == {p["name"] for p in result["parameters"] if p["free"] and not p["seen"] and p["of"] == "robot"}
    for direction in result["null_space"]:
        assert max(map(abs, direction["weights"])) == pytest.approx(1.0)
    assert len(result["suggested_free"]) == result["rank"]
    assert set(result["suggested_free"]) <= set(free)
    assert set(result["observability"]) == {"o1", "o2", "o3", "o4"}
    assert len(result["chi2_band"]) == 2
    for entry in result["observations"]:
        assert set(entry) == {"rig", "kind", "fitted", "held_out", "chucks", "spheres", "places", *KIND_RMS}
    predicted = result["predicted_error"]
    assert predicted is None or set(predicted) == {"rms_mm", "max_mm", "at", "n", "relative"}
    for key in ("held_out", "held_out_before"):
        assert result[key] is None or set(result[key]) == HELD_OUT_KEYS


def test_the_result_file_is_the_json_output_and_keeps_to_its_schema(
    run: Run, good: list[object], tmp_path: Path
) -> None:
    out = tmp_path / "result.json"
    outcome = run(*good, "--all-free", "--hold-out", "0.2", "--json", "--out", out)
    assert out.read_text() == outcome.out
    result = json.loads(outcome.out, parse_constant=pytest.fail)
    check_schema(result)
    check_schema(json.loads(run(*good, "--json").out))
    assert [(i["role"], i["name"], len(i["sha256"])) for i in result["inputs"]] == [
        ("observations", "poses.csv", 64),
        ("rig", "rig.toml", 64),
    ]
    assert str(tmp_path) not in outcome.out


def test_the_result_is_read_back(run: Run, good: list[object], tmp_path: Path) -> None:
    run(*good, "--all-free", "--out", tmp_path / "r.json")
    stored = read_result(tmp_path / "r.json")
    document = json.loads((tmp_path / "r.json").read_text())
    assert stored.robot.name == "puma560"
    assert stored.parameter_names == load_robot("puma560").chain.parameter_names
    assert stored.value.tolist() == [p["value"] for p in document["parameters"]]
    assert int(np.isnan(stored.sigma).sum()) == sum(p["sigma"] is None for p in document["parameters"])
    assert stored.covariance.shape == (54, 54)
    assert stored.of_robot.all()


def test_every_field_is_documented() -> None:
    text = (ROOT / "docs" / "result-format.md").read_text()
    nested = {
        "chucks",
        "spheres",
        "places",
        "role",
        "sha256",
        "base_frame",
        "end_frame",
        "joint_units",
        "fitted",
        "weights",
        "matrix",
        "units",
        *("source", "distance", "weight", "was", "fits", "rows", "o1", "o4"),
        *KIND_RMS,
        *("max_mm", "at", "relative"),
    }
    for field in {*SCALARS, *PARAMETER, *LISTS, *nested, *OBJECTS}:
        assert f"`{field}`" in text, field


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("parameters"), "field 'parameters' is missing"),
        (lambda d: d.update(format="other"), "is no result"),
        (lambda d: d.update(format_version=99), "format version 99"),
        (lambda d: d["parameters"][0].update(value="1"), "not a number"),
        (lambda d: d["parameters"][0].update(free=1), "not true or false"),
        (lambda d: d["covariance"]["matrix"].pop(), "wrong type or shape"),
        (lambda d: d.update(robot=[]), "wrong type or shape"),
    ],
)
def test_damaged_results_are_told(
    run: Run, good: list[object], change: Callable[[dict[str, Any]], object], message: str
) -> None:
    document = json.loads(run(*good, "--json").out)
    change(document)
    with pytest.raises(cli.TruearmError, match=message):
        parse_result(json.dumps(document), "r.json")
    for text in ("", "[]", "{", '{"a": NaN}', "[" * 100_000, "1" * 5000):
        with pytest.raises(cli.TruearmError, match=r"r\.json: is"):
            parse_result(text, "r.json")


def test_a_person_reads_parameters_errors_and_what_is_not_seen(run: Run, good: list[object]) -> None:
    outcome = run(*good, "--all-free", "--hold-out", "outer")
    assert outcome.code == 0
    for words in (
        "puma560: 70 ball_bar to fit, 20 held out; converged",
        "rank 36 of 54 free",
        "not seen",
        "18 combinations of parameters cannot be seen",
        "held out, mean",
        "--out result.json",
    ):
        assert words in outcome.out
    # Table II: link 2's x is -180.00 mm by design and -180.803 mm in truth.
    line = next(line for line in outcome.out.splitlines() if line.startswith("link2.x"))
    assert line.split()[1] == "-180.0000"
    assert line.split()[-1] == "mm"


def test_stopping_early_and_a_rank_that_is_not_full_are_results(run: Run, tmp_path: Path) -> None:
    table, rig = exact_lengths(60, chucks=1)
    write_table(tmp_path / "t.csv", table, ("rad",) * 6)
    write_rig(tmp_path / "rig.toml", rig)
    arguments = ["identify", tmp_path / "t.csv", "--robot", "puma560", "--rig", tmp_path / "rig.toml"]
    outcome = run(*arguments, "--all-free", "--max-iterations", 1)
    assert outcome.code == 0
    assert "rank 33 of 54 free" in outcome.out  # the paper's Table I: one chuck, three spheres
    assert "The fit stopped early" in outcome.out
    # The paper's Table I: a second chuck makes 35, a third sphere is there already.
    assert "Next: measure with one more chuck, not in line with the others, to tell 2 more parameters" in outcome.out
    assert "one more sphere" not in outcome.out
    document = json.loads(run(*arguments, "--max-iterations", 1, "--json").out)
    assert document["status"] == "max_iterations"
    (stopped,) = (line for line in advice(document, None) if "stopped early" in line)
    assert "--max-iterations" in stopped
    assert "roll" not in stopped
    (stopped,) = (line for line in advice({**document, "status": "stalled"}, None) if "stopped early" in line)
    assert "--max-iterations" not in stopped  # more of them would not help


def test_a_fit_that_creeps_is_told_what_holds_it(run: Run, tmp_path: Path) -> None:
    table = ulb_bench.lines(2, 12, ulb_bench.NOMINAL, np.random.default_rng(2))
    write_table(tmp_path / "t.csv", table, ("rad",) * 6)
    document = json.loads(run("identify", tmp_path / "t.csv", "--robot", "ulb", "--max-iterations", 1, "--json").out)
    assert document["status"] == "max_iterations"
    (stopped,) = (line for line in advice(document, None) if "stopped early" in line)
    assert "A straight line hardly shows its device's roll: give it in the rig, with turn_sigma_deg." in stopped
    (stopped,) = (line for line in advice({**document, "hardly_seen": document["null_space"]}, None) if "early" in line)
    assert "--solver map" in stopped


SIGMA = 8.4e-5  # m, of the bar


@pytest.fixture(scope="module")
def noisy() -> tuple[ObservationTable, Rig]:
    table, rig = exact_lengths(180)
    return replace(table, value=table.value + np.random.default_rng(6).normal(0.0, SIGMA, 180)), rig


def identified(run: Run, folder: Path, table: ObservationTable, rig: Rig, *more: object) -> tuple[dict[str, Any], str]:
    """The result as JSON, and what a person reads."""
    write_table(folder / "t.csv", table, ("rad",) * 6)
    write_rig(folder / "rig.toml", rig)
    arguments = ["identify", folder / "t.csv", "--robot", "puma560", "--rig", folder / "rig.toml", *more]
    outcomes = run(*arguments, "--json"), run(*arguments)
    assert [outcome.code for outcome in outcomes] == [0, 0]
    return json.loads(outcomes[0].out), outcomes[1].out


@pytest.mark.parametrize(
    ("solver", "prior"),
    [("lm", "none"), ("map", "wide"), ("recursive", "none"), ("renders-1991", "none"), ("ls", "none")],
)
def test_every_solver_can_be_asked_for(
    run: Run, tmp_path: Path, noisy: tuple[ObservationTable, Rig], solver: str, prior: str
) -> None:
    result, text = identified(run, tmp_path, *noisy, "--solver", solver)
    assert (result["solver"], result["loss"], result["prior"]) == (solver, "linear", prior)
    check_schema(result)
    assert ("solver map gives a covariance that holds" in " ".join(text.split())) == (solver == "renders-1991")


@pytest.mark.parametrize("options", [("--loss", "huber"), ("--loss", "cauchy"), ("--solver", "recursive")])
def test_a_faulty_row_is_named(
    run: Run, tmp_path: Path, noisy: tuple[ObservationTable, Rig], options: tuple[str, str]
) -> None:
    table, rig = noisy
    value = table.value.copy()
    value[70] += 20 * SIGMA
    result, text = identified(run, tmp_path, replace(table, value=value), rig, *options)
    # Row 1 is the header.
    assert [entry["source"] for entry in result["suspect"]] == ["t.csv row 72"]
    assert result["suspect"][0]["weight"] < 0.5
    assert "t.csv row 72 (" in text
    assert ("1 left out of the fit" in text) == (options[1] == "recursive")
    assert identified(run, tmp_path, *noisy, *options)[0]["suspect"] == []


def test_a_wrong_label_is_the_first_thing_said(run: Run, tmp_path: Path, noisy: tuple[ObservationTable, Rig]) -> None:
    table, rig = noisy
    order = np.lexsort((table.sphere, table.chuck))
    table = table.select(order)
    sphere = table.sphere.copy()
    sphere[:20] = "s1"  # the first pairing's rows are of c0 and s0
    result, text = identified(run, tmp_path, replace(table, sphere=sphere), rig)
    assert result["relabellings"]
    assert all((r["was"], r["fits"]) == (["c0", "s1"], ["c0", "s0"]) for r in result["relabellings"])
    assert result["relabellings"][0]["rms_after_mm"] < 0.1 * result["relabellings"][0]["rms_before_mm"]
    named = {source for r in result["relabellings"] for source in r["rows"]}
    assert named == {f"t.csv row {i + 2}" for i in range(20)}
    first = "Wrong label? 20 rows from t.csv row 2 to t.csv row 21: named chuck c0, sphere s1, fit chuck c0, sphere s0."
    assert text.startswith(first)


def test_chi2_is_shown_with_its_band(run: Run, tmp_path: Path, noisy: tuple[ObservationTable, Rig]) -> None:
    result, text = identified(run, tmp_path, *noisy)
    low, high = result["chi2_band"]
    assert low < result["chi2_reduced"] < high
    assert f"χ² per degree of freedom {result['chi2_reduced']:.3g}, within the {low:.3g} to {high:.3g}" in text


def test_free_and_freeze_choose_parameters(run: Run, good: list[object]) -> None:
    result = json.loads(run(*good, "--free", "joint*", "--freeze", "*.gain", "--json").out)
    assert result["free"] == [f"joint{i}.offset" for i in range(1, 7)]
    held = [p for p in result["parameters"] if not p["free"]]
    assert all(p["value"] == p["nominal"] and p["sigma"] is None for p in held)


def test_parameters_are_freed_beside_the_robot_files_own(run: Run, good: list[object]) -> None:
    """The PUMA's file holds all offsets, which the angles of the links make up for: the rank stays, the counts do not."""
    plain = json.loads(run(*good, "--json").out)
    more = json.loads(run(*good, "--also-free", "joint[23].offset,link2.z", "--json").out)
    assert set(more["free"]) - set(plain["free"]) == {"joint2.offset", "joint3.offset", "link2.z"}
    assert (plain["n_free"], more["n_free"]) == (36, 39)
    assert more["rank"] == plain["rank"] == 36
    told(run(*good, "--also-free", "joint2.ofset"), "names are like joint2.offset")


def test_several_tables_are_one_and_save_table_writes_it(run: Run, good: list[object], tmp_path: Path) -> None:
    saved = tmp_path / "all.csv"
    first = good[1]
    second = tmp_path / "second.csv"
    second.write_bytes(Path(str(first)).read_bytes())
    both = json.loads(run(good[0], first, second, *good[2:], "--save-table", saved, "--json").out)
    assert both["n_observations"] == 180
    table = read_table(Path(str(first)))
    back = read_table(saved, ("rad",) * 6)
    np.testing.assert_array_equal(back.q, np.concatenate([table.q, table.q]))
    np.testing.assert_array_equal(back.value, np.concatenate([table.value, table.value]))


def test_rigs_with_names_are_of_the_rows_that_name_them(
    run: Run, tmp_path: Path, noisy: tuple[ObservationTable, Rig]
) -> None:
    """Other spheres were mounted on the second day, and nobody measured them."""
    table, rig = noisy
    day = np.where(np.arange(len(table)) % 2 == 0, "mon", "tue")
    table = replace(table, rig=day)
    unknown = {name: replace(point, sigma=None) for name, point in rig.spheres.items()}
    write_table(tmp_path / "t.csv", table, ("rad",) * 6)
    write_rig(tmp_path / "mon.toml", rig)
    write_rig(tmp_path / "tue.toml", replace(rig, spheres=unknown))
    mon, tue = (f"{name}={tmp_path / name}.toml" for name in ("mon", "tue"))
    arguments = ["identify", tmp_path / "t.csv", "--robot", "puma560", "--json"]
    outcome = run(*arguments, "--rig", mon, "--rig", tue)
    assert outcome.code == 0, outcome.err
    result = json.loads(outcome.out)
    assert "tue.sphere.s0.x" in result["free"]
    assert [entry["name"] for entry in result["inputs"]] == ["t.csv", "mon.toml", "tue.toml"]
    assert result["chi2_band"][0] < result["chi2_reduced"] < result["chi2_band"][1]
    bare = tmp_path / "mon.toml"
    told(run(*arguments, "--rig", mon), "belongs to rig 'tue'; given: mon")
    told(run(*arguments, "--rig", mon, "--rig", mon), "rig mon is given twice")
    told(run(*arguments, "--rig", mon, "--rig", bare), "several rigs need names")
    told(run(*arguments, "--rig", bare, "--rig", bare), "several rigs need names")
    told(run(*arguments, "--rig", mon, "--rig", tue, "--rig", f"wed={bare}"), "no row has that name")


def test_lines_are_fitted_and_held_out(run: Run, tmp_path: Path) -> None:
    """Renders' problem on tables: two of six lines judge, each settled on its own rows."""
    wrong = ulb_bench.NOMINAL.copy()
    wrong[ulb_bench.OFFSETS] += 0.01
    table = ulb_bench.lines(6, 12, wrong, np.random.default_rng(2))
    write_table(tmp_path / "t.csv", table, ("rad",) * 6)
    write_rig(tmp_path / "rig.toml", ulb_bench.rig(table))
    arguments = ["identify", tmp_path / "t.csv", "--robot", "ulb", "--rig", tmp_path / "rig.toml", "--solver", "map"]
    arguments += ["--free", "joint[2-6].offset", "--hold-out", "line=l0", "--hold-out", "line=l1"]
    result = json.loads(run(*arguments, "--prior", "none", "--json").out)
    assert result["status"] == "converged"
    assert (result["held_out"]["n"], result["held_out"]["n_settled"]) == (24, 12)
    assert result["held_out"]["rms_mm"] < 0.2 * result["held_out_before"]["rms_mm"]
    assert result["rank"] == 4  # the tool lies on the last axis, which its offset turns about
    assert result["additions"][0]["parameters"] == ["joint6.offset"]
    for p in result["parameters"]:
        if p["of"] == "robot" and p["sigma"] is not None:
            # 4 σ: one of four clean parameters lies beyond in one draw of 4,000
            assert abs(p["value"] - p["nominal"] - 0.01) < 4 * p["sigma"]
    text = run(*arguments).out
    assert "1 combination of parameters cannot be seen" in text
    assert "to tell 1 more parameter: joint6.offset" in text


def documented_figures() -> list[list[str]]:
    rows = [line.strip("| ").split(" | ") for line in (MUKCA / "README.md").read_text().splitlines() if line[:1] == "|"]
    return [row for row in rows if row[0] in ("panda_1", "panda_3", "kuka_14")]


@pytest.mark.parametrize("row", documented_figures(), ids=lambda row: f"{row[0]} {row[2]}")
def test_real_data_gives_the_documented_figures(run: Run, row: list[str]) -> None:
    table, urdf, places, before, after, with_gains = row
    arguments = ["identify", MUKCA / f"{table}.csv", "--robot", MUKCA / f"{urdf}.urdf", "--tip", "ball_link"]
    arguments += ["--rig", MUKCA / "rig.toml", "--json"]
    for place in places.split():
        arguments += ["--hold-out", f"place={place}"]
    result, gains_too = (json.loads(run(*arguments, *more).out) for more in ([], ["--all-free"]))
    assert result["status"] == "converged"
    # Three decimals are written down.
    assert result["held_out_before"]["mean_mm"] == pytest.approx(float(before), abs=6e-4)
    assert result["held_out"]["mean_mm"] == pytest.approx(float(after), abs=6e-4)
    assert gains_too["held_out"]["mean_mm"] == pytest.approx(float(with_gains), abs=6e-4)


def test_real_data_reaches_what_was_asked(run: Run) -> None:
    assert len(documented_figures()) == 4
    panda_3 = documented_figures()[0]
    assert float(panda_3[3]) == pytest.approx(2.65, abs=0.005)
    assert float(panda_3[4]) <= 0.22


HEADER = "kind,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,length_mm,bar,chuck,sphere"
ROW = "ball_bar,0,0,0,0,0,0,460,b,c0,s0"
BAD_TABLES = {
    "unknown column": (HEADER.replace("chuck", "chukc"), ROW, "did you mean chuck?"),
    "no unit": (HEADER.replace("length_mm", "length"), ROW, "name it length_m or length_mm"),
    "joint without unit": (HEADER.replace("q3_rad", "q3"), ROW, "name it q3_rad or q3_deg"),
    "NaN": (HEADER, ROW.replace("460", "nan"), "row 2 column length_mm: nan is not a finite number"),
    "joint count": (HEADER.replace("q6_rad,", ""), ROW.replace("0,", "", 1), "5 joint columns, the robot has 6"),
    "unknown chuck": (
        HEADER,
        ROW.replace("c0", "c9"),
        "row 2 column chuck: 'c9' is not in the rig (it has c0, c1, c2)",
    ),
    "no rows": (HEADER, "", "no rows"),
    "ragged": (HEADER, ROW + ",1", "has 12 cells, the header has 11"),
}


def told(outcome: Outcome, message: str) -> None:
    """Exit code 2, nothing on stdout, one line on stderr that holds the message."""
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err.startswith("truearm: ")
    assert outcome.err.count("\n") == 1
    assert outcome.err.endswith("\n")
    assert message in outcome.err
    assert "Traceback" not in outcome.err


@pytest.mark.parametrize(("header", "row", "message"), BAD_TABLES.values(), ids=BAD_TABLES.keys())
def test_bad_tables(run: Run, good: list[object], tmp_path: Path, header: str, row: str, message: str) -> None:
    (tmp_path / "t.csv").write_text(f"{header}\n{row}\n")
    told(run("identify", tmp_path / "t.csv", *good[2:]), message)


BAD_ARGUMENTS = {
    "no such option": (["--nonsense"], "--nonsense"),
    "no number": (["--max-iterations", "many"], "--max-iterations"),
    "below its range": (["--max-iterations", "0"], "--max-iterations"),
    "no such prior": (["--prior", "strong"], "strong"),
    "no such solver": (["--solver", "magic"], "renders-1991"),
    "no such loss": (["--loss", "l1"], "cauchy"),
    "a loss for a solver without": (["--solver", "recursive", "--loss", "huber"], "lm and map; recursive has no"),
    "a prior for a solver without": (["--solver", "ls", "--prior", "weak"], "which knows no prior"),
    "a wide prior for it": (["--solver", "ls", "--prior", "wide"], "which knows no prior"),
    "no such robot": (["--robot", "puma561"], "puma560, ulb"),
    "no such robot file": (["--robot", "none.urdf"], "none.urdf: no such file"),
    "tip of no URDF": (["--tip", "ball"], "--base and --tip"),
    "no such group": (["--hold-out", "shell=s99"], "there is inner, outer"),
    "every group": (["--hold-out", "inner", "--hold-out", "outer"], "nothing would be left"),
    "no such parameter": (["--free", "link9.*"], "--free link9.*: matches no parameter"),
    "no such folder": (["--out", "/none/result.json"], "does not exist"),
    "a folder": (["--out", "/"], "is a directory"),
    "line breaks in a name": (["--out", "a\nb\x1b[31m/r.json"], "a b\\x1b[31m"),
}


@pytest.mark.parametrize(("arguments", "message"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS.keys())
def test_bad_arguments(run: Run, good: list[object], arguments: list[str], message: str) -> None:
    told(run(*good, *arguments), message)


def test_a_rig_that_is_not_there(run: Run, good: list[object]) -> None:
    told(run(*good[:4], "--rig", "none.toml"), "none.toml: no such file")
    told(run(*good[:4], "--rig", "mon=none.toml"), "none.toml: no such file")
    told(run(*good[:4], "--rig", "a\nb\x1b[31m.toml"), "a b\\x1b[31m.toml")


def test_bad_input_as_the_shell_sees_it(good: list[object], tmp_path: Path) -> None:
    told(process("identify", tmp_path / "none.csv", *good[2:]), "none.csv: no such file")
    told(process("identify", tmp_path, *good[2:]), "is a directory")
    told(process("identify"), "Missing argument")
    told(process("sing"), "sing")
    (tmp_path / "t.csv").write_bytes(b"\x89MCAP0\r\n\0\0")
    told(process("identify", tmp_path / "t.csv", *good[2:]), "is not UTF-8")


def test_help_and_version_and_no_command_are_no_errors(run: Run) -> None:
    assert "Example: truearm demo" in run("--help").out
    assert "Example:" in run("identify", "--help").out
    assert run().code == 0
    assert run("--version").out.startswith("truearm ")


def test_help_names_what_there_is(run: Run) -> None:
    """The names are written out in the command, since --help must not import what knows them."""
    words = set(re.findall(r"[\w-]+", run("identify", "--help").out))
    assert {*builtin_names(), *SOLVERS, *LOSSES} <= words
    assert [s.value for s in Solver] == list(SOLVERS)
    assert [loss.value for loss in Loss] == list(LOSSES)


def test_help_imports_nothing_slow() -> None:
    code = "import sys, truearm.cli; truearm.cli.main(['--help']); print({'numpy', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.splitlines()[-1] == "set()"


def test_interruption_is_one_line_and_130(run: Run, good: list[object], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("truearm.estimate.identify.identify", interrupted)
    assert run(*good) == Outcome(130, "", "truearm: interrupted\n")


def test_a_reader_that_leaves_is_no_traceback(good: list[object]) -> None:
    command = [sys.executable, "-m", "truearm", *map(str, good), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        child.stdout.close()
        assert child.stderr.read() == b""
    assert child.returncode == 1


def test_outputs_over_inputs_and_inputs_twice_are_refused(run: Run, tmp_path: Path) -> None:
    table = tmp_path / "rows.csv"
    table.write_bytes((MUKCA / "panda_3.csv").read_bytes())
    before = table.read_bytes()
    good = ["identify", table, "--robot", MUKCA / "panda.urdf", "--tip", "ball_link", "--rig", MUKCA / "rig.toml"]
    mine = tmp_path / "mine.json"
    mine.write_text('{"my": "notes"}')
    for more, text in (
        (["--out", table], "is also read"),
        (["--save-table", table], "is also read"),
        (["--out", tmp_path / "x", "--save-table", tmp_path / "x"], "is also read"),
        (["--out", mine], "nothing that truearm wrote"),
        ([table], "is given twice"),
    ):
        outcome = run(*map(str, [*good, *more]))
        assert (outcome.code, text in outcome.err, len(outcome.err.splitlines())) == (2, True, 1), outcome
    assert table.read_bytes() == before
    assert mine.read_text() == '{"my": "notes"}'


def test_a_fit_without_spare_rows_says_so(run: Run, tmp_path: Path) -> None:
    lines = (MUKCA / "panda_3.csv").read_text().splitlines()
    few = tmp_path / "few.csv"
    few.write_text("\n".join(lines[:12]) + "\n")
    outcome = run("identify", str(few), "--robot", str(MUKCA / "panda.urdf"), "--tip", "ball_link")
    assert outcome.code == 0, outcome
    assert "says little" in outcome.out


def test_the_page_tells_what_the_result_tells(run: Run, tmp_path: Path, noisy: tuple[ObservationTable, Rig]) -> None:
    table, rig = noisy
    value = table.value.copy()
    value[70] += 20 * SIGMA
    options = ["--solver", "map", "--loss", "huber", "--hold-out", "outer", "--report", tmp_path / "r.html"]
    result, text = identified(run, tmp_path, replace(table, value=value), rig, *options)
    page = (tmp_path / "r.html").read_text()
    assert "<h1>Calibration of puma560</h1>" in page
    assert '<p class="subtitle">t.csv</p>' in page
    assert "t.csv row 72" in page
    assert "huber: rows far from all others count less" in page
    assert "wide: nominal to 10 mm" in page
    assert f"<code>truearm identify {tmp_path / 't.csv'} --robot puma560" in page
    predicted = result["predicted_error"]
    assert (predicted["n"], predicted["relative"]) == (180, False)
    assert 0.0 < predicted["rms_mm"] < predicted["max_mm"]
    assert f"By these sigmas the tool errs by {predicted['rms_mm']:.4f} mm RMS over 180 poses, at most" in text
    assert "Solved by map with a wide prior of the robot, huber loss." in text
    o1 = result["observability"]["o1"]
    assert f"Observability of {len(result['suggested_free'])} parameters: O1 {o1:.3g}" in text
    (entry,) = result["observations"]
    assert entry["rms_after_mm"] == pytest.approx(result["rms_after_mm"])
    assert entry["rms_held_out_mm"] == pytest.approx(result["held_out"]["rms_mm"])
    assert entry["rms_rotation_deg"] is None


def test_the_page_replaces_a_page_but_nothing_else(run: Run, good: list[object], tmp_path: Path) -> None:
    page, diary = tmp_path / "r.html", tmp_path / "diary.html"
    diary.write_text("<!DOCTYPE html><p>Dear diary</p>")
    for _ in range(2):
        assert run(*good, "--report", page).code == 0
    told(run(*good, "--report", diary), "nothing that truearm wrote")
    new = tmp_path / "new"
    told(run(*good, "--report", new, "--out", new), "is also read")
    told(run(*good, "--report", good[1]), "is also read")
    told(run(*good, "--report", tmp_path / "none" / "r.html"), "does not exist")
    assert diary.read_text() == "<!DOCTYPE html><p>Dear diary</p>"


def test_kinds_and_rigs_are_told_apart(run: Run, tmp_path: Path) -> None:
    """Poses by a tracker of unknown place, and bars on another day: a line each, and what a pose's rotation is left with."""
    bars, rig = exact_lengths(90)
    rng = np.random.default_rng(8)
    poses = device_bench.tracked("pose", 60, np.array([1.5, 0.2, 0.5, 0.1, 0.2, 0.3]), rng)
    sensor = ((1e-8, 0.0, 0.0), (0.0, 1e-8, 0.0), (0.0, 0.0, 1e-8))
    tracker = Device("t", sensor, rotation_sigma=2e-4)
    rotation = poses.rotation + 2e-4 * rng.normal(size=poses.rotation.shape)
    poses = replace(poses, rotation=rotation, rig=np.full(60, "tue"))
    table = concatenate([replace(bars, rig=np.full(90, "mon")), poses])
    write_table(tmp_path / "t.csv", table, ("rad",) * 6)
    write_rig(tmp_path / "mon.toml", rig)
    write_rig(tmp_path / "tue.toml", Rig(targets=device_bench.TARGETS, trackers={"t": tracker}))
    arguments = ["identify", tmp_path / "t.csv", "--robot", "puma560", "--report", tmp_path / "r.html"]
    arguments += ["--rig", f"mon={tmp_path / 'mon.toml'}", "--rig", f"tue={tmp_path / 'tue.toml'}"]
    result, text = json.loads(run(*arguments, "--json").out), run(*arguments).out
    assert [(e["rig"], e["kind"], e["fitted"]) for e in result["observations"]] == [
        ("mon", "ball_bar", 90),
        ("tue", "pose", 60),
    ]
    assert "puma560: 90 ball_bar, 60 pose to fit" in text
    assert re.search(r"^  mon: ball-bar +\d+\.\d{4} +\d+\.\d{4} +90$", text, re.M)
    assert re.search(r"^  tue: tracked pose +\d+\.\d{4} +\d+\.\d{4} +60$", text, re.M)
    # 2e-4 rad about three axes is 0.0198 deg; 180 of these angles, 6 % of which the fit takes up: 5.3 % each σ, four of them
    found = result["observations"][1]["rms_rotation_deg"]
    assert found == pytest.approx(math.degrees(2e-4 * math.sqrt(3)), rel=0.22)
    assert f"Rotation of the tue: tracked pose rows: {found:.3g} deg RMS after." in text
    page = (tmp_path / "r.html").read_text()
    assert "tracked pose, rotation" in page
    assert "RMS rotation after [deg]" in page
