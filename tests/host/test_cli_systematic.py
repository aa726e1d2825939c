"""``truearm identify`` on data with a systematic error: what it prints and stores, and that its advice helps."""

import html
import json
import re
from dataclasses import replace

import fault_worlds as worlds
import numpy as np
import pytest
from command_line import Run, told
from puma_bench import CHAIN, SIGMA
from result_schema import check_schema
from tests.host.findings_bench import listed, stated

from truearm.files.observation_table import write_table
from truearm.files.rig_file import write_rig
from truearm.report.result_findings import hardly_matters, systematic_findings


@pytest.fixture(scope="module")
def slip(tmp_path_factory):
    """Return the files of a session in which a chuck slips, its name and the row."""
    folder = tmp_path_factory.mktemp("slip")
    table, (chuck, at) = worlds.slipped(worlds.plan(), np.random.default_rng(1))
    write_table(folder / "poses.csv", table, CHAIN.joint_units)
    write_rig(folder / "rig.toml", worlds.RIG)
    return folder, chuck, at


def test_a_slip_is_named_and_the_option_that_is_named_removes_it(run: Run, slip) -> None:
    folder, chuck, at = slip
    arguments = ["identify", folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml", "--json"]
    first = json.loads(run(*arguments).out)
    check_schema(first)
    (found,) = first["systematic"]
    assert found["what"] == f"chuck.{chuck}"
    assert abs(found["rows"][0] - (at + 1)) <= 15
    assert found["from"] == f"poses.csv row {found['rows'][0] + 1}", "the header is row 1 of the file"
    assert abs(found["size"] - 0.3e-3) < 4.0 * found["sigma"]
    assert found["chance"] < 1e-3
    outcome = run(*arguments, "--allow", found["apply"]["allow"])
    assert (outcome.code, outcome.err) == (0, "")
    second = json.loads(outcome.out)
    check_schema(second)
    assert second["systematic"] == []
    assert second["without_systematic"] is None
    # First order and the refit agree to the curvature, some parts in a thousand.
    assert second["chi2_reduced"] == pytest.approx(first["without_systematic"]["chi2_reduced"], rel=0.01)
    moved = [p for p in second["parameters"] if p["name"].startswith(f"chuck.{chuck}")]
    assert [p["name"].rpartition("@")[2] for p in moved] == [str(found["rows"][0])] * 3


def test_a_person_reads_what_is_off_and_what_to_do(run: Run, slip, tmp_path) -> None:
    folder, chuck, _ = slip
    page = tmp_path / "page.html"
    files = [folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml", "--report", page]
    outcome = run("identify", *files, "--json")
    findings = stated(json.loads(outcome.out))
    assert findings["systematic-offset"].values["what"] == f"chuck.{chuck}"
    assert findings["systematic-apply"].values["allow"][0].startswith("chuck.")
    # The largest is the one to expect: the slip displaces base and tool, and lengths from the slipped chuck agree with that.
    # The covariance knows nothing of the slip.
    assert "tool-error" not in findings
    expected = findings["tool-error-systematic"].values
    assert expected["moves"]["mm"] > expected["error"]["mm"] > 0.0
    text = html.unescape(page.read_text())
    assert "of the tool, predicted" not in text
    assert findings["tool-error-systematic"].text() in text
    assert findings["systematic-offset"].text() in text


def test_rows_that_are_left_out_neither_fit_nor_judge(run: Run, slip) -> None:
    folder, *_ = slip
    arguments = ["identify", folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml", "--json"]
    result = json.loads(
        run(*arguments, "--hold-out", "0.2", "--leave-out", "poses.csv row 12:31", "--leave-out", "40").out
    )
    (rows,) = result["observations"]
    assert rows["fitted"] + rows["held_out"] == 360 - 21
    assert result["held_out"]["n"] == rows["held_out"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--allow", "chuck.c9"], "'chuck.c9' can be estimated here"),
        (["--allow", "chuck.c1@0"], "--allow 'chuck.c1@0'"),
        (["--allow", "chuck.c1@9:3"], "--allow 'chuck.c1@9:3': row 9 comes after row 3"),
        (["--allow", "chuck.c1@1:0"], "--allow 'chuck.c1@1:0'"),
        (["--allow", "chuck.c1@361"], "rows 1 to 360"),
        (["--leave-out", "x"], "--leave-out 'x'"),
        (["--leave-out", "5:2"], "--leave-out '5:2': row 5 comes after row 2"),
        (["--leave-out", "poses.csv row 1"], "poses.csv row 2"),
        (["--leave-out", "300:361"], "rows 300 to 361 cannot be left out:"),
        (["--leave-out", "1:360"], "nothing-left"),
    ],
)
def test_what_is_not_there_cannot_be_allowed_or_left_out(run: Run, slip, options, message) -> None:
    folder, *_ = slip
    told(run("identify", folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml", *options), message)


def test_a_validation_names_what_is_off_and_no_option_that_it_does_not_have(run: Run, slip, tmp_path) -> None:
    folder, chuck, _ = slip
    write_table(tmp_path / "clean.csv", worlds.clean(worlds.plan(), np.random.default_rng(2)), CHAIN.joint_units)
    files = ["--rig", folder / "rig.toml"]
    run("identify", tmp_path / "clean.csv", "--model", "puma560", *files, "--out", tmp_path / "result.json")
    given = ("validate", tmp_path / "result.json", folder / "poses.csv", *files)
    findings = listed(json.loads(run(*given, "--json").out))
    assert findings["systematic-offset"]["what"] == f"chuck.{chuck}"
    assert "systematic-here" in findings
    assert "allow" not in run(*given).out


def test_a_fit_that_did_not_converge_is_not_tested(run: Run, slip) -> None:
    folder, *_ = slip
    files = [folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml"]
    outcome = run("identify", *files, "--max-iterations", "1", "--json")
    assert outcome.code == 3
    assert json.loads(outcome.out)["systematic"] == []


def entry(rows, first_within, last_within):
    """A finding of result.json."""
    found = {"what": "target.reflector", "form": "offset", "rows": rows, "from": "a.csv row 1", "to": "a.csv row 232"}
    within = {"first_within": first_within, "last_within": last_within}
    size = {"unit": "m", "size": 8e-5, "sigma": 5e-6, "chi2_drop": 60.0, "freedom": 3, "rivals": []}
    return {**found, **within, **size, "apply": {"allow": "target.reflector@1:232"}}


def document(moves_mm, one):
    """The parts of result.json that say what is systematic: 0.4 mm are to expect."""
    would_be = {"chi2_reduced": 64.0, "tool_moves_mm": moves_mm, "held_out_ratio": 0.99}
    return {"systematic": [one], "without_systematic": would_be, "unexplained": {"mean_mm": 0.4}}


@pytest.mark.parametrize(("moves_mm", "little"), [(0.004, True), (0.2, False)])
def test_a_finding_that_hardly_moves_the_tool_says_so(moves_mm, little):
    of = document(moves_mm, entry([1, 232], [1, 1], [220, 244]))
    assert hardly_matters(of) is little
    error, apply = systematic_findings(of)
    assert error.values["rows"] == "rows 1 to 232±12 (in the files: a.csv row 1 to a.csv row 232)"
    assert apply.values["little"] is little


def test_other_explanations_are_said_in_words():
    names = [
        "a gradual change of bar.b46.zero",
        "rows 196 to 200",
        "base@181",
        "bar.b46.zero.drift",
        "chuck.c2@1:9",
        "chuck.c1",
    ]
    of = document(0.2, {**entry([1, 232], [1, 1], [220, 244]), "rivals": names})
    error, which = systematic_findings(of)
    assert error.text().endswith(
        "; or, nearly as well supported: a gradual change of bar.b46.zero, or bad rows 196 to 200, "
        "or a constant error of base from row 181 on (base@181), "
        "or a drift of bar.b46.zero linear in time in all rows (bar.b46.zero.drift), "
        "or a constant error of chuck.c2 in rows 1 to 9 (chuck.c2@1:9), or a constant error of chuck.c1 in all rows. "
        "Estimating the first: χ² falls by 60 with 3 degrees of freedom."
    )
    assert (which.code, which.values["chi2"], which.values["moves"]) == ("systematic-open", "64", {"mm": 0.2})
    assert "target.reflector@" not in which.text(), "no advice to apply one of them"


def test_other_forms_of_an_error_of_the_same_item_do_not_forbid_to_apply_it():
    names = ["a gradual change of target.reflector", "target.reflector.thermal_drift", "target.reflector@1:40"]
    of = document(0.2, {**entry([1, 232], [1, 1], [220, 244]), "rivals": names})
    error, apply = systematic_findings(of)
    assert error.text().endswith(
        "Other possible explanations: a gradual change of target.reflector, a drift of target.reflector linear in the "
        "temperature in all rows (target.reflector.thermal_drift), a constant error of target.reflector in rows 1 to 40 "
        "(target.reflector@1:40)."
    )
    assert apply.text("--{}".format).startswith("To apply it: --allow target.reflector@1:232.")


def test_of_several_errors_only_the_certain_ones_are_applied():
    one = {**entry([1, 232], [1, 1], [220, 244]), "rivals": ["chuck.c1"]}
    sure = {**entry([1, 232], [1, 1], [220, 244]), "what": "chuck.c2", "apply": {"allow": "chuck.c2@1:232"}}
    of = {**document(0.2, one), "systematic": [one, sure]}
    *_, which = systematic_findings(of)
    assert (which.code, which.values["allow"]) == ("systematic-open", ["chuck.c2@1:232"])
    assert which.text("--{}".format).endswith("Until then, apply only what is certain: --allow chuck.c2@1:232.")


def test_a_finding_whose_last_row_may_be_anywhere_is_not_located():
    error, _ = systematic_findings(document(0.2, entry([1, 232], [1, 1], [90, 744])))
    assert error.values["rows"] == "some of rows 1 to 744 (rows 1 to 232 fit best, but others fit nearly as well)"


def test_a_slip_in_a_table_that_is_sorted_by_a_joint_is_named_by_its_times(run: Run, tmp_path) -> None:
    """In the order of joint 2, no row is the one from which the chuck was off. Seed 940010."""
    table, (chuck, at) = worlds.slipped(worlds.plan(), np.random.default_rng(940010))
    table = replace(table, time=100.0 + 12.0 * np.arange(len(table)))
    write_table(tmp_path / "sorted.csv", table.select(np.argsort(table.q[:, 1])), CHAIN.joint_units)
    write_rig(tmp_path / "rig.toml", worlds.RIG)
    outcome = run("identify", tmp_path / "sorted.csv", "--model", "puma560", "--rig", tmp_path / "rig.toml", "--json")
    assert "sorted.csv:" in outcome.err
    (found,) = json.loads(outcome.out)["systematic"]
    assert found["what"] == f"chuck.{chuck}"
    assert abs(found["rows"][0] - (at + 1)) <= 15
    row = int(np.flatnonzero(np.argsort(table.q[:, 1]) == found["rows"][0] - 1)[0])
    assert found["from"] == f"sorted.csv row {row + 2}", "the row of the file"


def test_an_amount_that_the_rows_determine_in_part_leaves_the_error_of_the_tool_open(run: Run, tmp_path) -> None:
    """A chuck is 1 mm off in x, y and z. Along z, base and arm turn with it, so nothing is known of z. Seed 940040."""
    plan, off = worlds.plan(), np.zeros((360, 3))
    off[plan.chuck == "c1"] = 1e-3
    noise = SIGMA * np.random.default_rng(940040).normal(size=360)
    write_table(tmp_path / "poses.csv", worlds.table(plan, worlds.lengths(plan, off) + noise), CHAIN.joint_units)
    write_rig(tmp_path / "rig.toml", worlds.RIG)
    files = ["--rig", tmp_path / "rig.toml", "--joint-laws", "none", "--out", tmp_path / "r.json"]
    outcome = run("identify", tmp_path / "poses.csv", "--model", "puma560", *files)
    document = json.loads((tmp_path / "r.json").read_text())
    (found,) = document["systematic"]
    x, y, z = found["off_by"]
    assert found["what"] == "chuck.c1"
    assert [of["value"] for of in (x, y)] == pytest.approx([1e-3, 1e-3], abs=2e-4)
    assert z["sigma"] is None or z["sigma"] > 1e-3
    assert document["predicted_error"] is None
    assert re.search(r"chuck\.c1 is off by x \S+ mm \(σ \S+ mm\), y \S+ mm \(σ \S+ mm\), z not determined", outcome.out)
    assert "These rows hardly determine chuck.c1.z, and the position of the tool depends on it." in outcome.out
    assert "Tool error predicted" not in outcome.out
    assert "These sigmas predict" not in outcome.out
