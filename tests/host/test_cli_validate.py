"""``truearm validate``: verdicts on robots that are unchanged, that changed, and that are different robots."""

import json
import re
from dataclasses import replace
from pathlib import Path

import correct_bench
import device_bench
import numpy as np
import pytest
from puma_bench import CHAIN, DESIGN, PAIRS, RIG, SIGMA, TRUTH, lengths, table
from tests.host.findings_bench import listed

from truearm.findings import findings_of
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table_file import write_table
from truearm.report.validation_findings import validation_findings
from truearm.types import Device, Rig
from truearm.workflows.project_file import FILE, Project, format_project


def verdict_of(document):
    return next(code for code in listed(document) if code != "simulated")


MUKCA = Path(__file__).parents[1] / "data" / "mukca"
UNITS = ("rad",) * 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("validate")
    correct_bench.write(folder / "result.json", correct_bench.identified())
    write_rig(folder / "rig.toml", RIG)
    return folder


def measured(path, truth, n=180, seed=9):
    """Return noisy lengths of a robot, half of them under each of two shell names."""
    rng = np.random.default_rng(seed)
    q = correct_bench.good_poses(n)
    pairs = [PAIRS[i % 9] for i in range(n)]
    rows = table(q, lengths(truth, q, pairs) + SIGMA * rng.normal(size=n), pairs)
    write_table(path, replace(rows, shell=np.where(np.arange(n) < n // 2, "one", "two")), UNITS)
    return path


def judged(run, folder, path, result="result.json"):
    code, said, err = run("validate", folder / result, path, "--rig", folder / "rig.toml", "--json")
    assert code == 0, err
    return json.loads(said)


def test_a_robot_that_did_not_change_passes(folder, run):
    """Errors are the noise and what the covariance leaves, some 0.09 mm; without the calibration some 12 mm, 2 mm once base and tool are placed."""
    path = measured(folder / "same.csv", TRUTH)
    found = judged(run, folder, path)
    assert found["rows"] == 180
    assert found["placed"]
    assert found["rms_raw_mm"] > 5.0
    assert 1.0 < found["rms_before_mm"] < 5.0
    # 0.084 mm of noise, 180 rows: σ of its RMS is 5 %; the parameters' own error adds about as much
    assert 0.07 < found["rms_after_mm"] < 0.12
    assert verdict_of(found) == "validation-holds"
    regions = {region["region"]: region for region in found["regions"]}
    assert regions["shell=one"]["rows"] == regions["shell=two"]["rows"] == 90
    parts = [region for name, region in regions.items() if name.startswith("radius")]
    assert sum(region["rows"] for region in parts) == 180
    total = sum(region["rows"] * region["rms_after_mm"] ** 2 for region in parts) / 180
    assert total == pytest.approx(found["rms_after_mm"] ** 2)
    code, said, _ = run("validate", folder / "result.json", path, "--rig", folder / "rig.toml")
    assert code == 0
    assert found["verdict"] in " ".join(said.split())
    assert len(said.splitlines()) <= 15
    assert "shell=one" not in said
    assert "shell=one" in run("validate", folder / "result.json", path, "--rig", folder / "rig.toml", "--details").out
    assert listed(found)["before"]["raw"] == {"mm": found["rms_raw_mm"]}


def test_a_page_has_a_certificate_of_the_validation(folder, run, tmp_path, monkeypatch):
    """The same errors as on the screen; twice the RMS is compared with the tolerance."""
    path = measured(folder / "page.csv", TRUTH)
    found = judged(run, folder, path)
    twice = 2.0 * found["rms_after_mm"]
    page = tmp_path / "page.html"
    (tmp_path / FILE).write_text(format_project(Project("puma560", customer="<Acme>")))
    monkeypatch.chdir(tmp_path)
    details = ["--number", "TV-9", "--report", page]
    for tolerance, decision in ((0.9 * twice, "tolerance-exceeded"), (1.1 * twice, "certified")):
        given = ["validate", folder / "result.json", path, "--rig", folder / "rig.toml", *details]
        code, said, _ = run(*given, "--tolerance-mm", f"{tolerance:.4f}", "--force", "--json")
        assert code == 0
        verdict, decided, *others = findings_of(json.loads(said))
        assert verdict.text() == found["verdict"]
        assert (decided.code, decided.values["rows"]) == (decision, 180)
        assert decided.values["error"]["mm"] == pytest.approx(twice)
        assert {"excludes-directions", "excludes-conditions"} < {finding.code for finding in others}
        text = page.read_text("utf-8")
        assert f'<p class="decision">{decided.text()}</p>' in text
    rows = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", text)]
    (whole,) = (row for row in rows if row[0] == "all, RMS")
    assert whole[1:3] == [f"{found[f'rms_{name}_mm']:.4f}" for name in ("before", "after")]
    assert "&lt;Acme&gt;" in text
    assert "TV-9" in text
    assert "signature" in text
    code, _, err = run(*given[:-2])
    assert (code, "--report" in err) == (2, True)
    page.write_text("my own page")
    assert run(*given).code == 2
    assert page.read_text() == "my own page"


def test_a_validation_with_the_fitted_rows_is_no_pass(run, tmp_path):
    rows = measured(tmp_path / "rows.csv", TRUTH)
    write_rig(tmp_path / "rig.toml", RIG)
    rig = ["--rig", tmp_path / "rig.toml"]
    assert (
        run("identify", rows, "--model", "puma560", *rig, "--joint-laws", "none", "--out", tmp_path / "r.json").code
        == 0
    )
    page = tmp_path / "page.html"
    assert run("validate", tmp_path / "r.json", rows, *rig, "--report", page, "--tolerance-mm", "50").code == 0
    text = page.read_text("utf-8")
    assert '<p class="decision">NOT DECIDED: the identification used these' in text
    assert listed(judged(run, tmp_path, rows, "r.json"))["validation-own-rows"]["files"] == ["rows.csv"]


@pytest.mark.parametrize(("n", "few"), [(1, True), (9, True), (10, False)])
def test_a_few_rows_say_nothing_about_other_poses(folder, run, n, few):
    document = judged(run, folder, measured(folder / f"few{n}.csv", TRUTH, n))
    assert verdict_of(document) in ("validation-holds", "validation-uncertain")
    assert ("few-rows" in listed(document)) == few


def test_a_robot_without_errors_of_its_own_is_not_helped_by_where_it_was_bolted(tmp_path, run):
    """Base 5 mm and 3 mrad off, tool 2 mm: that is not an error that a calibration takes credit for."""
    bolted = {"link1.x": 5e-3, "link1.beta": 3e-3, "link7.x": 2e-3}
    names = CHAIN.parameter_names
    off = np.array([next((value for key, value in bolted.items() if key == name), 0.0) for name in names])
    assert np.count_nonzero(off) == len(bolted), names
    rows = measured(tmp_path / "rows.csv", DESIGN + off)
    correct_bench.write(tmp_path / "result.json", correct_bench.identified())
    write_rig(tmp_path / "rig.toml", RIG)
    found = judged(run, tmp_path, rows)
    assert found["rms_raw_mm"] > 2.0
    # 0.084 mm of noise, less what few parameters follow; where they only nearly take the pose up, some µm more.
    assert found["rms_before_mm"] < 0.12
    assert verdict_of(found) == "validation-no-help"
    given = ("--rig", tmp_path / "rig.toml", "--report", tmp_path / "page.html", "--tolerance-mm", "20", "--json")
    stated = listed(json.loads(run("validate", tmp_path / "result.json", rows, *given).out))
    assert "certified" not in stated
    assert "calibration-unusable" in stated


def test_few_rows_place_nothing_and_a_robot_that_changed_is_found_out(folder, run):
    # Six lengths fit the six numbers of a base whatever they are: the robot stays where the rig says.
    found = judged(run, folder, measured(folder / "few.csv", TRUTH, n=6))
    assert found["rows"] == 6
    assert not found["placed"]
    assert found["rms_before_mm"] == pytest.approx(found["rms_raw_mm"])
    # A joint's zero has moved by 2 mrad, as after a collision.
    changed = TRUTH + 2e-3 * np.array([name == "joint3.offset" for name in CHAIN.parameter_names])
    found = judged(run, folder, measured(folder / "changed.csv", changed))
    assert found["rms_after_mm"] > 3 * found["reference_mm"]
    assert verdict_of(found) == "validation-changed"


def test_orientations_are_judged_in_degrees(folder, tmp_path, run):
    """Poses of a tracker: 0.1 mm and 1e-3 rad of noise a coordinate, more of it in the second half's angles."""
    rng = np.random.default_rng(3)
    poses = device_bench.tracked("pose", 80, np.array([1.5, 0.2, 0.5, 0.1, 0.2, 0.3]), rng)
    sigma = np.where(np.arange(80) < 40, 1e-3, 1e-2)[:, None]
    noisy = replace(
        poses,
        xyz=poses.xyz + 1e-4 * rng.normal(size=(80, 3)),
        rotation=poses.rotation + sigma * rng.normal(size=(80, 3)),
        shell=np.where(np.arange(80) < 40, "one", "two"),
    )
    sensor = ((1e-8, 0.0, 0.0), (0.0, 1e-8, 0.0), (0.0, 0.0, 1e-8))
    rig = Rig(targets=device_bench.TARGETS, trackers={"t": Device("t", sensor, rotation_sigma=1e-3)})
    write_rig(tmp_path / "rig.toml", rig)

    def found(rows):
        write_table(tmp_path / "poses.csv", noisy.select(rows), UNITS)
        given = ("validate", folder / "result.json", tmp_path / "poses.csv", "--rig", tmp_path / "rig.toml")
        said = run(*given, "--details")
        assert said[0] == 0, said
        return json.loads(run(*given, "--json")[1]), said[1]

    document, text = found(slice(40))
    assert document["residual_units"] == ["mm", "deg"]
    assert (document["n_mm"], document["n_deg"]) == (40, 40)
    due = document["expected"]
    # three angles of 1e-3 rad; 40 rows of three, some of which place the tracker: σ of the RMS is 6 %, three of these
    assert due["by_noise_deg"] == pytest.approx(np.degrees(1e-3 * np.sqrt(3.0)), rel=0.06)
    assert document["rms_after_deg"] == pytest.approx(due["rms_deg"], rel=0.2)
    assert document["rms_before_deg"] > 5.0 * document["rms_after_deg"]
    assert set(listed(document)["validation-holds"]["expected"]) == {"mm", "deg"}
    header, errors = (re.findall(pattern, text, re.M) for pattern in (r"^error \[(\w+)\]", r"^all, RMS.* +40$"))
    assert header == ["mm", "deg"]
    assert len(errors) == 2
    assert errors[1].split()[2:4] == [f"{document[f'rms_{name}_deg']:.5f}" for name in ("before", "after")]
    document, text = found(slice(80))  # angles that are too noisy are not errors of position
    assert set(listed(document)["validation-changed"]["unexplained"]) == {"mm", "deg"}
    by_row = validation_findings({**document, "unexplained_mm": 0.0, "unexplained_deg": 0.0})
    verdict = next(one for one in by_row if one.code == "validation-changed")
    assert "helps, but the errors do not fit the declared noise, row by row, most of it in shell=two:" in verdict.text()
    assert not document["consistent"]
    # Half the rows have ten times the declared angle, three components of 1e-2 rad: √(3·(1e-4 − 1e-6)/2) rad, σ 8 % by 40 rows.
    assert document["unexplained_deg"] == pytest.approx(np.degrees(np.sqrt(1.5 * 0.99e-4)), rel=0.25)
    assert document["worst_region"] == "shell=two"
    regions = {region["region"]: region for region in document["regions"]}
    assert regions["shell=two"]["rms_after_deg"] > 5.0 * regions["shell=one"]["rms_after_deg"]
    assert regions["shell=two"]["rms_after_mm"] < 1.3 * regions["shell=one"]["rms_after_mm"]
    noisy = noisy.replace(rotation_sigma=np.where(np.arange(80) < 40, np.nan, 1e-2))
    document, _ = found(slice(80))  # rows that say how noisy their angles are: the others have the tracker's figure
    assert verdict_of(document) == "validation-holds"
    by_noise = np.degrees(np.sqrt(3.0 * (1e-3**2 + 1e-2**2) / 2.0))
    assert document["expected"]["by_noise_deg"] == pytest.approx(by_noise, rel=0.06)


def test_rows_that_it_was_fitted_to_prove_little(tmp_path, run):
    urdf, rows, rig = MUKCA / "panda.urdf", MUKCA / "panda_3.csv", MUKCA / "rig.toml"
    held = [a for place in ("frontcenter", "frontleft", "frontright") for a in ("--hold-out", f"place={place}")]
    given = (rows, "--model", urdf, "--tip", "ball_link", "--rig", rig, "--joint-laws", "none", *held)
    assert run("identify", *given, "--out", tmp_path / "r.json")[0] == 0
    page = ("--report", tmp_path / "v.html")
    document = json.loads(
        run("validate", tmp_path / "r.json", rows, "--model", urdf, "--rig", rig, *page, "--json").out
    )
    findings = listed(document)
    assert "independent measurement" not in (tmp_path / "v.html").read_text()
    # Sockets at unknown places determine neither base nor tool, so neither was fitted.
    assert {"validation-own-rows", "rig-unknowns", "before"} <= set(findings)
    assert "rig-missing" not in findings
    assert "rows-unseen" in [finding.code for finding in validation_findings({**document, "unseen": 5})]
    document = json.loads(run("validate", tmp_path / "r.json", rows, "--model", urdf, "--json").out)
    assert listed(document)["rig-missing"] == {"rig": "rig.toml"}
    for way in ("export", "correct"):
        targets = tmp_path / "targets.csv"
        targets.write_text("x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n400,0,300,180,0,0\n")
        more = ("--format", "urdf") if way == "export" else (targets,)
        out = ("--out", tmp_path / ("o.urdf" if way == "export" else "o.csv"))
        code, _, err = run(way, tmp_path / "r.json", *more, "--model", urdf, "--tip", "panda_link8", *out)
        assert code == 2
        assert "--model, with --base panda_link0 and --tip ball_link" in err
    home = "--home=0,-45,0,-135,0,90,45"
    given = ("correct", tmp_path / "r.json", targets, home, "--model", urdf, "--out", tmp_path / "c.csv", "--json")
    code, said, err = run(*given)
    assert code == 0, err
    assert listed(json.loads(said))["targets-frames"]["held"]
    code, _, err = run("report", tmp_path / "r.json", rows, "--model", urdf, "--rig", rig, "--out", tmp_path / "r.html")
    assert code == 0, err  # base and tip are those of the result
