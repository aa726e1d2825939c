"""``truearm identify`` from the user's point of view: results and messages."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import ulb_bench
from command_line import Run, told
from identify_bench import MUKCA, exact_lengths, identified
from tests.host.findings_bench import stated
from tests.refusals import shown

from truearm.kinds.rig_file import write_rig
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import write_table
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
