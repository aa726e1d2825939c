"""The files of ``truearm identify``: result, schema, report; and files that it does not overwrite."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Run, told
from identify_bench import MUKCA, ROOT, SIGMA, identified
from result_schema import BY_UNIT, FIELDS, check_schema
from tests.host.findings_bench import stated

from truearm.estimate.result_file import ParameterEstimate
from truearm.findings import option
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import write_table
from truearm.types import Rig


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
