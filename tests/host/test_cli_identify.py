"""``truearm identify`` from the user's point of view: results and messages."""

import json
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ulb_bench
from command_line import Outcome, Run, process, told
from identify_bench import MUKCA, ROOT, SIGMA, exact_lengths, identified
from result_schema import BY_UNIT, FIELDS, check_schema
from tests.host.findings_bench import stated
from tests.refusals import shown

from truearm.estimate.result_file import ParameterEstimate
from truearm.estimate.solvers import SOLVERS, Loss
from truearm.findings import option
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import write_table
from truearm.model.robot_file import builtin_names
from truearm.types import Rig


def test_a_person_reads_parameters_errors_and_what_is_not_seen(run: Run, good: list[object]) -> None:
    outcome = run(*good, "--free", "*", "--hold-out", "shell=outer", "--details")
    assert outcome.code == 0
    identified = shown["identified"]
    assert [identified[name] for name in ("rank", "n_free", "held_out", "unseen")] == [36, 54, 20, 18]
    for words in ("unidentifiable", "held out, mean"):
        assert words in outcome.out
    # Table II: link 2's x is -180.00 mm by design and -180.803 mm in truth.
    line = next(line for line in outcome.out.splitlines() if line.startswith("link2.x"))
    assert line.split()[1] == "-180.0000"
    assert line.split()[-1] == "mm"


def test_stopping_early_and_a_rank_that_is_not_full_are_results(run: Run, tmp_path: Path) -> None:
    table, rig = exact_lengths(60, chucks=1)
    write_table(tmp_path / "t.csv", table, ("rad",) * 6)
    write_rig(tmp_path / "rig.toml", rig)
    arguments = ["identify", tmp_path / "t.csv", "--model", "puma560", "--rig", tmp_path / "rig.toml"]
    outcome = run(*arguments, "--free", "*", "--max-iterations", 1)
    assert outcome.code == 3
    assert shown["identified"]["rank"] == 33  # the paper's Table I: one chuck, three spheres
    assert next(iter(shown)) == "not-converged"
    # The paper's Table I: a second chuck makes 35, a third sphere is there already.
    assert "chuck" in shown["measure-next"]["what"]
    assert shown["measure-next"]["n"] == 2
    assert "one more sphere" not in outcome.out
    document = json.loads(run(*arguments, "--max-iterations", 1, "--json").out)
    assert document["status"] == "max_iterations"
    assert document["predicted_error"] is None
    # The inputs are right and a fit that goes on shows it: nobody is sent to look for a mistake in them.
    assert (document["explanations"], document["alternatives_tried"]) == ([], 0)
    stopped = stated(document)["meaningless"].values
    assert stopped["limit"]
    assert not stopped["line"]
    assert not stated({**document, "status": "stalled"})["meaningless"].values["limit"]  # more would not help


def test_a_fit_that_creeps_is_told_what_holds_it(run: Run, tmp_path: Path) -> None:
    table = ulb_bench.lines(2, 12, ulb_bench.NOMINAL, np.random.default_rng(2))
    write_table(tmp_path / "t.csv", table, ("rad",) * 6)
    document = json.loads(run("identify", tmp_path / "t.csv", "--model", "ulb", "--max-iterations", 1, "--json").out)
    assert document["status"] == "max_iterations"
    assert stated(document)["meaningless"].values["line"]
    hardly = [{"names": ["joint2.d"], "weights": [1.0]}]
    assert stated({**document, "prior": "none", "hardly_seen": hardly})["meaningless"].values["weak"]


def test_a_wrong_label_is_the_first_thing_said(run: Run, tmp_path: Path, noisy: tuple[ObservationTable, Rig]) -> None:
    table, rig = noisy
    order = np.lexsort((table.sphere, table.chuck))
    table = table.select(order)
    sphere = table.sphere.copy()
    sphere[:20] = "s1"  # the first pairing's rows are of c0 and s0
    result, text = identified(run, tmp_path, replace(table, sphere=sphere), rig)
    assert (result["usable"], result["unusable_because"]) == (False, "wrong inputs")
    (found,) = result["explanations"]
    assert (found["code"], found["values"]["leave_out"]) == ("wrong-labels", ["1:20"])
    (rows,) = found["values"]["runs"]
    assert rows.startswith("t.csv row 2 to t.csv row 21: sphere s0")
    assert found["rms_mm"] < 0.1 * found["rms_given_mm"]
    assert list(stated(result))[:2] == ["wrong-inputs", "wrong-labels"]
    remedy = re.search(r"or give (--leave-out .*?) \(rows", " ".join(text.split()))
    assert remedy is not None
    result, _ = identified(run, tmp_path, replace(table, sphere=sphere), rig, *shlex.split(remedy[1]))
    assert (result["usable"], result["explanations"]) == (True, [])


def test_parameters_are_freed_beside_the_robot_files_own(run: Run, good: list[object], good_text: str) -> None:
    """The PUMA's file holds all offsets, which the angles of the links make up for: the rank stays, the counts do not."""
    plain = json.loads(good_text)
    more = json.loads(run(*good, "--also-free", "joint[23].offset,link2.z", "--json").out)
    assert set(more["free"]) - set(plain["free"]) == {"joint2.offset", "joint3.offset", "link2.z"}
    assert (plain["n_free"], more["n_free"]) == (36, 39)
    assert more["rank"] == plain["rank"] == 36
    told(run(*good, "--also-free", "joint2.ofset"), "like joint2.offset")


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
    arguments = ["identify", tmp_path / "t.csv", "--model", "puma560", "--json"]
    outcome = run(*arguments, "--rig", mon, "--rig", tue)
    assert outcome.code == 0, outcome.err
    result = json.loads(outcome.out)
    assert "tue.sphere.s0.x" in result["free"]
    assert [entry["name"] for entry in result["inputs"]] == ["t.csv", "mon.toml", "tue.toml"]
    assert result["chi2_band"][0] < result["chi2_reduced"] < result["chi2_band"][1]
    bare, plain = tmp_path / "mon.toml", arguments[:-1]
    told(run(*plain, "--rig", mon), "'tue'")
    told(run(*plain, "--rig", mon, "--rig", mon), "given-twice", what="mon")
    told(run(*plain, "--rig", mon, "--rig", bare), "invalid-input", place="--rig")
    told(run(*plain, "--rig", bare, "--rig", bare), "invalid-input", place="--rig")
    told(run(*plain, "--rig", mon, "--rig", tue, "--rig", f"wed={bare}"), "no row")


def documented_figures() -> list[list[str]]:
    rows = [line.strip("| ").split(" | ") for line in (MUKCA / "README.md").read_text().splitlines() if line[:1] == "|"]
    return [row for row in rows if row[0] in ("panda_1", "panda_3", "kuka_14")]


@pytest.mark.parametrize(
    "row",
    [pytest.param(row, marks=[pytest.mark.soak] * (row[2] != "left_back raised_left")) for row in documented_figures()],
    ids=lambda row: f"{row[0]} {row[2]}",
)
def test_real_data_gives_the_documented_figures(run: Run, row: list[str]) -> None:
    table, urdf, places, before, after, with_gains, with_laws = row
    arguments = ["identify", MUKCA / f"{table}.csv", "--model", MUKCA / f"{urdf}.urdf", "--tip", "ball_link"]
    arguments += ["--rig", MUKCA / "rig.toml", "--json"]
    for place in places.split():
        arguments += ["--hold-out", f"place={place}"]
    geometry = ["--joint-laws", "none"]
    options = (geometry, [*geometry, "--free", "*"], [])
    result, gains_too, by_default = (json.loads(run(*arguments, *more).out) for more in options)
    assert result["status"] == "converged"
    # Three decimals are written down.
    assert result["held_out_before"]["mean_mm"] == pytest.approx(float(before), abs=6e-4)
    assert result["held_out"]["mean_mm"] == pytest.approx(float(after), abs=6e-4)
    assert gains_too["held_out"]["mean_mm"] == pytest.approx(float(with_gains), abs=6e-4)
    assert by_default["held_out"]["mean_mm"] == pytest.approx(float(with_laws), abs=1e-3)


def test_a_fit_without_spare_rows_says_so(run: Run, tmp_path: Path) -> None:
    lines = (MUKCA / "panda_3.csv").read_text().splitlines()
    few = tmp_path / "few.csv"
    few.write_text("\n".join(lines[:12]) + "\n")
    outcome = run("identify", str(few), "--model", str(MUKCA / "panda.urdf"), "--tip", "ball_link", "--json")
    assert outcome.code == 0, outcome
    findings = stated(json.loads(outcome.out))
    assert findings["little-freedom"].values["rig"]
    assert "noise-share" not in findings


def test_an_error_of_the_tool_that_is_not_determined_is_no_number(good_text: str) -> None:
    document = json.loads(good_text)
    assert "tool-error" in stated(document)
    assert "tool-error-unpredictable" in stated({**document, "predicted_error": None})


# bad input, and --help

BAD_ARGUMENTS = {
    "no such option": (["--nonsense"], "--nonsense"),
    "not a number": (["--max-iterations", "many"], "--max-iterations"),
    "below its range": (["--max-iterations", "0"], "--max-iterations"),
    "no such prior": (["--prior", "strong"], "'--prior': 'strong'"),
    "no such solver": (["--solver", "magic"], "renders-1991"),
    "no such loss": (["--loss", "l1"], "cauchy"),
    "a loss for a solver without": (["--solver", "recursive", "--loss", "huber"], "--loss huber"),
    "a prior for a solver without": (["--solver", "ls", "--prior", "weak"], "which knows no prior"),
    "no such robot": (["--model", "puma561"], "did you mean puma560?"),
    "tip of no URDF": (["--tip", "ball"], "--base and --tip"),
    "no such folder": (["--out", "/none/result.json"], "missing-file"),
    "line breaks in a name": (["--out", "a\nb\x1b[31m/r.json"], "a b\\x1b[31m"),
}


@pytest.mark.parametrize(("arguments", "message"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS.keys())
def test_bad_arguments(run: Run, good: list[object], arguments: list[str], message: str) -> None:
    told(run(*good, *arguments), message)


def test_a_rig_that_is_not_there_and_bad_input_as_the_shell_sees_it(run, good, tmp_path):
    told(run(*good[:4], "--rig", "none.toml"), "none.toml: no such file")
    told(run(*good[:4], "--rig", "mon=none.toml"), "none.toml: no such file")
    told(run(*good[:4], "--rig", "a\nb\x1b[31m.toml"), "a b\\x1b[31m.toml")
    told(process("identify"), "Missing argument")
    (tmp_path / "t.csv").write_bytes(b"\x89MCAP0\r\n\0\0")
    told(process("identify", tmp_path / "t.csv", *good[2:]), "its name must end in .mcap")


def test_version_help_and_no_command(run):
    assert run().code == 0
    assert run("--version").out.startswith("truearm ")
    words = set(re.findall(r"[\w-]+", run("identify", "--help").out))
    assert {*builtin_names(), *SOLVERS, *Loss} <= words
    code = "import sys, truearm.cli.main as cli; cli.main(['--help']); print({'numpy', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.splitlines()[-1] == "set()"


def test_interruption_is_one_line_and_130(run: Run, good: list[object], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    def interrupted_while_importing(*_: object, **__: object) -> None:
        raise ImportError("initialization failed") from KeyboardInterrupt()

    def faulty(*_: object, **__: object) -> None:
        raise ImportError("no such module")

    for raises in (interrupted, interrupted_while_importing):
        monkeypatch.setattr("truearm.workflows.identify.identified", raises)
        assert run(*good) == Outcome(130, "", "truearm: interrupted\n")
    monkeypatch.setattr("truearm.workflows.identify.identified", faulty)
    with pytest.raises(ImportError, match="no such module"):
        run(*good)


def test_a_reader_that_leaves_is_no_traceback(good: list[object]) -> None:
    command = [sys.executable, "-m", "truearm", *map(str, good), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        child.stdout.close()
        assert child.stderr.read() == b""
    assert child.returncode == 1


# the files: result, schema, report; and files that it does not overwrite


def test_the_result_file_is_the_json_output_and_keeps_to_its_schema(
    run: Run, good: list[object], good_text: str, tmp_path: Path
) -> None:
    out = tmp_path / "result.json"
    outcome = run(*good, "--free", "*", "--hold-out", "0.2", "--json", "--out", out)
    assert out.read_text() == outcome.out
    result = json.loads(outcome.out, parse_constant=pytest.fail)
    check_schema(result)
    check_schema(json.loads(good_text))
    assert [(i["role"], i["name"], len(i["sha256"])) for i in result["inputs"]] == [
        ("observations", "poses.csv", 64),
        ("rig", "rig.toml", 64),
    ]
    assert str(tmp_path) not in outcome.out


def test_every_field_is_documented() -> None:
    text = (ROOT / "docs" / "reference" / "result-format.md").read_text()
    nested = (
        "places role sha256 base_frame end_frame joint_units fitted weights upper units source distance weight o1 o4 at"
    )
    figures = {f"{figure}_mm" for figure in (*BY_UNIT, "rms_held_out", "mean", "max", "n")}
    for field in {*FIELDS, *ParameterEstimate.__struct_fields__, *nested.split(), *figures}:
        assert f"`{field}`" in text, field


def test_outputs_over_inputs_and_inputs_twice_are_refused(run: Run, tmp_path: Path) -> None:
    table = tmp_path / "rows.csv"
    table.write_bytes((MUKCA / "panda_3.csv").read_bytes())
    before = table.read_bytes()
    good = ["identify", table, "--model", MUKCA / "panda.urdf", "--tip", "ball_link", "--rig", MUKCA / "rig.toml"]
    mine = tmp_path / "mine.json"
    mine.write_text('{"my": "notes"}')
    for more, text in (
        (["--out", table], "given-twice"),
        (["--table-out", table], "given-twice"),
        (["--out", tmp_path / "x", "--table-out", tmp_path / "x"], "given-twice"),
        (["--out", mine], "file-exists"),
        ([table], "given-twice"),
    ):
        outcome = run(*map(str, [*good, *more]))
        told(outcome, text)
    assert table.read_bytes() == before
    assert mine.read_text() == '{"my": "notes"}'


def test_the_table_is_written_if_its_rows_form_no_problem(
    run: Run, tmp_path: Path, noisy: tuple[ObservationTable, Rig]
) -> None:
    """Not if an option is refused."""
    rows, rig = noisy
    write_table(tmp_path / "short.csv", rows.select(np.array([0])), ("rad",) * 6)
    write_rig(tmp_path / "rig.toml", rig)
    given = ["identify", tmp_path / "short.csv", "--model", "puma560", "--rig", tmp_path / "rig.toml"]
    given += ["--table-out", tmp_path / "o.csv"]
    assert run(*given, "--free", "nothing").code == 2
    assert not (tmp_path / "o.csv").exists()
    assert run(*given).code == 2
    assert len((tmp_path / "o.csv").read_text().splitlines()) == 2


def test_the_page_tells_what_the_result_tells(run: Run, tmp_path: Path, noisy: tuple[ObservationTable, Rig]) -> None:
    table, rig = noisy
    value = table.value.copy()
    value[70] += 20 * SIGMA
    options = ["--solver", "map", "--loss", "huber", "--hold-out", "shell=outer", "--report", tmp_path / "r.html"]
    result, _ = identified(run, tmp_path, replace(table, value=value), rig, *options)
    page = (tmp_path / "r.html").read_text()
    assert "<h1>Calibration of puma560</h1>" in page
    assert '<p class="subtitle">t.csv</p>' in page
    assert "t.csv row 72" in page
    assert "huber loss" in page
    assert "wide prior (10 mm, 52 mrad" in page
    assert f"<code>truearm identify {tmp_path / 't.csv'} --model puma560" in page
    predicted = result["predicted_error"]
    assert (predicted["n"], predicted["relative"]) == (180, False)
    assert 0.0 < predicted["rms_mm"] < predicted["max_mm"]
    findings = stated(result)
    assert (findings["tool-error"].values["rms"], findings["tool-error"].values["n"]) == (
        {"mm": predicted["rms_mm"]},
        180,
    )
    assert (findings["solver"].values["solver"], findings["solver"].values["loss"]) == ("map", "huber")
    assert findings["solver"].values["n"] == len(result["suggested_free"])
    assert all(
        of.text(option).replace("'", "&#x27;").replace('"', "&quot;").replace("<", "&lt;") in page
        for of in findings.values()
    )
    (entry,) = result["observations"]
    assert entry["rms_after_mm"] == pytest.approx(result["rms_after_mm"])
    assert entry["rms_held_out_mm"] == pytest.approx(result["held_out"]["rms_mm"])
    assert result["residual_units"] == ["mm"]


def test_the_page_replaces_a_page_but_nothing_else(run, printed: Run, good: list[object], tmp_path: Path) -> None:
    page, diary = tmp_path / "r.html", tmp_path / "diary.html"
    diary.write_text("<!DOCTYPE html><p>Dear diary</p>")
    out = printed(*good, "--report", page)
    assert out.splitlines()[-1].endswith("r.html")
    told(run(*good, "--report", page), "file-exists", "--force")
    assert run(*good, "--report", page, "--force").code == 0
    told(run(*good, "--report", diary, "--force"), "file-exists")
    told(run(*good, "--report", diary), "file-exists")
    new = tmp_path / "new"
    told(run(*good, "--report", new, "--out", new), "given-twice")
    told(run(*good, "--report", good[1]), "given-twice")
    told(run(*good, "--report", tmp_path / "none" / "r.html"), "missing-file")
    assert diary.read_text() == "<!DOCTYPE html><p>Dear diary</p>"


@pytest.mark.parametrize(
    ("name", "counts", "key"),
    [
        ("line", {"lines": 2, "lines_used": "2", "dwells": None}, ("lines", "lines_used")),
        ("ball-bar", {"dwells": 3, "used": "3", "last": 6, "stops": 3, "lines": 0}, ("dwells", "used")),
    ],
)
def test_what_a_session_gave_is_counted_in_its_own_kind(
    run: Run, tmp_path: Path, name: str, counts: dict[str, Any], key: tuple[str, str]
) -> None:
    session = MUKCA.parent / "sessions" / f"{name}.mcap"
    out = tmp_path / "r.json"
    run("identify", session, "--model", "puma560", "--max-iterations", "1", "--out", out)
    values = stated(json.loads(out.read_text()))["session"].values
    assert {**values, **counts} == values
    (count,) = json.loads(out.read_text())["sessions"]
    assert count[key[0]] == count[key[1]] > 0
    assert count["lines_rejected"] == {}
    assert count["with_bar"] is (name == "ball-bar")
