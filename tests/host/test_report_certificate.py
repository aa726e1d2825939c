"""``truearm report``: the fit repeated from its files, and the certificate on page one."""

import html
import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import needs_printer, printed
from identify_bench import exact_lengths
from report_bench import full_page, render
from result_schema import signed
from session_stream import RIG, session, write_session

import truearm
from truearm.cli.main import main
from truearm.estimate.prediction import nominal_error
from truearm.findings import findings_of
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table_file import write_table
from truearm.report.page import facts_of, sensor_facts, size
from truearm.session.session_file import open_session
from truearm.types import rms
from truearm.units import MM
from truearm.workflows.correction_findings import unexplained_error
from truearm.workflows.inputs import Sources, read_sources, sensors_of
from truearm.workflows.project_file import FILE, Project, format_project

SESSIONS = Path(__file__).parents[1] / "data" / "sessions"
OPTIONS = ["--hold-out", "0.2", "--seed", "3", "--solver", "map", "--freeze", "link2.y"]


def given(folder):
    return ["--model", "puma560", "--rig", folder / "rig.toml"]


@pytest.fixture(scope="module")
def identified(tmp_path_factory, noisy):
    """A folder with observations, rig, and a result with held-out rows and options of its own."""
    folder = tmp_path_factory.mktemp("identified")
    table, rig = noisy
    write_table(folder / "poses.csv", table, ("rad",) * 6)
    write_rig(folder / "rig.toml", rig)
    arguments = ["identify", folder / "poses.csv", *given(folder), *OPTIONS, "--out", folder / "r.json"]
    assert main([str(one) for one in arguments]) == 0
    return folder


@pytest.fixture
def made(tmp_path, identified):
    """A copy of these files, and the command that makes the result's page."""
    shutil.copytree(identified, tmp_path, dirs_exist_ok=True)
    return ["report", tmp_path / "r.json", tmp_path / "poses.csv", *given(tmp_path), "--out", tmp_path / "page.html"]


def words(page):
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", re.sub(r"<style.*?</style>", "", page, flags=re.S))).split())


def test_a_page_says_what_who_how_and_what_came_out(made, tmp_path, run, monkeypatch):
    details = {
        "customer": "Acme",
        "controller": "KRC5 8.7",
        "serial": "2019-7",
        "operator": "<b>A.</b>",
        "name": "cell 3",
    }
    (tmp_path / FILE).write_text(format_project(Project("puma560", **details)))
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*made, "--number", "TA-17")
    assert (code, err) == (0, "")
    decision, written = out.splitlines()
    assert written == f"Written: {tmp_path / 'page.html'}"
    page = (tmp_path / "page.html").read_text("utf-8")
    assert page.index("Certificate ") < page.index('class="tiles"')
    said, document = words(page), json.loads((tmp_path / "r.json").read_text())
    digest = next(one["sha256"] for one in document["inputs"] if one["role"] == "observations")
    for text in (
        "cell 3",
        "model puma560",
        "serial number 2019-7",
        "customer Acme",
        "controller KRC5 8.7",
        "certificate TA-17",
        "<b>A.</b>",
        digest,
        "Solved by map",
        f"{document['held_out']['n']} held out (0.2)",
        "k = 2",
        document["checksum"][:12],
        "temperature not recorded",
        "no tolerance was given",
        "place, date",
    ):
        assert text in said
    assert decision.partition(": ")[2] in said
    assert "<b>A." not in page
    assert f"{document['held_out']['rms_mm']:.3g} mm" in said


def test_the_files_of_a_result_are_found_in_the_project(made, tmp_path, run, monkeypatch):
    """By name and content: a file that was changed is none of them."""
    without = [*made[:2], "--out", made[-1]]
    (tmp_path / "data").mkdir()
    for name in ("poses.csv", "rig.toml"):
        (tmp_path / name).rename(tmp_path / "data" / name)
    code, _, err = run(*without)
    assert (code, "poses.csv, which" in err) == (2, True)
    (tmp_path / "truearm.toml").write_text('model = "puma560"')
    monkeypatch.chdir(tmp_path)
    assert run(*without).code == 0
    (tmp_path / "data" / "poses.csv").write_text("changed")
    assert run(*without, "--force").code == 2


def of_page(text, label):
    """Return the value of a label on a page."""
    return html.unescape(re.search(rf"<dt>{re.escape(label)}</dt><dd>(.*?)</dd>", text).group(1))


def test_a_tolerance_is_compared_with_twice_the_error_of_the_tool(made, tmp_path, run):
    """The larger one of the expected error, with what the noise does not explain, and that of held-out rows."""
    document = json.loads((tmp_path / "r.json").read_text())
    expected = 2.0 * math.hypot(document["predicted_error"]["rms_mm"], MM.of(unexplained_error(document)[0]))
    worst = max(expected, 2.0 * document["held_out"]["rms_mm"])
    said = {}
    for tolerance in (0.9 * worst, 1.1 * worst):
        assert run(*made, "--tolerance-mm", f"{tolerance:.4f}", "--force").code == 0
        page = (tmp_path / "page.html").read_text("utf-8")
        said[tolerance] = re.search(r'<p class="decision">(.*?)</p>', page).group(1)
        assert of_page(page, "after: expanded uncertainty (k = 2)") == size(expected / 1e3, "m")
    below, above = said.values()
    assert below.startswith(f"FAIL: {size(worst / 1e3, 'm')} ")
    assert above.startswith(f"PASS: {size(worst / 1e3, 'm')} ")


@pytest.mark.parametrize(
    ("tolerance", "code"), [(None, "certified"), ("50", "certified"), ("0.001", "tolerance-exceeded")]
)
def test_the_decision_and_what_it_leaves_out_are_findings(made, tmp_path, run, tolerance, code):
    limit = ["--tolerance-mm", tolerance] if tolerance else []
    outcome = run(*made, *limit, "--json")
    answer = json.loads(outcome.out)
    decision, *excluded = findings_of(answer)
    assert (decision.code, decision.values["tolerance"]) == (code, tolerance and {"mm": float(tolerance)})
    assert {finding.code for finding in excluded} == {
        "excludes-lengths",
        "excludes-conditions",
        "excludes-repeatability",
    }
    page = words((tmp_path / "page.html").read_text("utf-8"))
    assert all(finding.text() in page for finding in (decision, *excluded))
    assert decision.text() == answer["decision"]


def test_the_error_of_the_nominal_robot_is_that_of_the_arm_and_not_of_its_mounting(noisy):
    table, rig = noisy
    robot = truearm.load_robot("puma560")
    e = truearm.identify(robot, table, rig, options=truearm.IdentifyOptions(joint_laws="none")).estimate
    names = list(e.parameter_names[: e.n_robot_parameters])

    def distances(**changes):
        value = e.value.copy()
        value[: len(names)] = e.nominal[: len(names)]
        for name, change in changes.items():
            value[names.index(name.replace("_", "."))] += change
        return nominal_error(robot.chain, rig, table, replace(e, value=value))

    assert distances().max() < 1e-12
    assert distances(link1_x=5e-3, link1_gamma=2e-3, link7_x=3e-3).max() < 2e-5  # second order
    assert 1e-3 < rms(distances(link3_x=5e-3)) < 5e-3  # placing the robot removes a part of the 5 mm


@pytest.mark.parametrize(("pair", "sigma"), [([12, -7], 1.2e-6), (None, None), ([1, 2, 3], None), ([1, 10**6], None)])
def test_a_sensor_says_how_well_its_calibration_fits_and_against_what(pair, sigma):
    calibration = {"unit": "m", "poly": [[1, 0]], "serial": "7", "date": "2026-01-02", "sigma": pair}
    calibration |= {"reference": "gauge blocks, certificate 4711", "reference_sigma": pair}
    document = {"streams": [{"channels": [{"name": "lvdt", "calibration": calibration}]}]}
    (sensor,) = sensors_of(document)
    ((label, value),) = sensor_facts([SimpleNamespace(sensors=(sensor, sensor))])
    assert label == "sensor lvdt"
    assert ("1.2 µm" in value) == (sigma is not None)
    assert "against gauge blocks, certificate 4711" in value
    assert ("± 2.4 µm (k = 2)" in value) == (sigma is not None)


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda d: d.pop("made_with"), "say how it was made"),
        (lambda d: d["made_with"].update(solver="lm", freeze=["link3.*"]), ": identify again"),
        (lambda d: d["made_with"].update(solver="magic"), "made_with"),
        (lambda d: d["made_with"].update(colour=1), "made_with"),
        (lambda d: d["made_with"].update(hold_out=3), "made_with"),
    ],
)
def test_a_result_that_was_changed_is_refused(made, tmp_path, run, spoil, complaint):
    document = json.loads((tmp_path / "r.json").read_text())
    spoil(document)
    (tmp_path / "r.json").write_text(signed(document))
    code, out, err = run(*made)
    assert (code, out) == (2, "")
    assert complaint in err
    assert not (tmp_path / "page.html").exists()


def test_files_that_were_changed_since_are_refused(made, tmp_path, run):
    text = (tmp_path / "rig.toml").read_text()
    (tmp_path / "rig.toml").write_text(text + "# a word more\n")
    code, _, err = run(*made)
    assert code == 2
    assert "was made from rig rig.toml, which" in err


def test_of_many_files_those_are_read_that_the_result_was_made_from(made, tmp_path, run):
    other, _ = exact_lengths(90)
    write_table(tmp_path / "other.csv", other, ("rad",) * 6)
    assert run(*made[:3], tmp_path / "other.csv", *made[3:]).code == 0


def test_a_recording_says_how_it_was_made(tmp_path):
    write_session(tmp_path / "s.mcap", session(np.random.default_rng(2), dwells=5)[0], RIG)
    (one,) = read_sources(Sources((tmp_path / "s.mcap",)), None).recordings
    assert one.name == "s.mcap"
    assert re.fullmatch(r"20\d\d-\d\d-\d\d \d\d:\d\d UTC", one.begun)
    facts = dict(one.facts)
    assert (re.sub(", .*:", ":", facts["dwells"]), one.samples_lost) == ("5: none", 0)
    assert any(value.endswith(" µs") for label, value in one.facts if "clock" in label)
    assert facts["temperature of the box"].startswith("24.0 to ")
    assert open_session(tmp_path / "s.mcap").path.name == one.name


def test_stops_between_lines_are_no_rejected_dwells():
    (one,) = read_sources(Sources((SESSIONS / "line.mcap",)), None).recordings
    facts = dict(facts_of([one]))
    assert facts["passes along lines"] == "2"
    assert "dwells" not in facts
    both = dict(facts_of([one, one._replace(name="bars", facts=(("dwells", "4"),))]))
    assert (both["bars: dwells"], both["line.mcap: passes along lines"]) == ("4", "2")


@needs_printer
def test_the_certificate_is_one_sheet_of_a4(tmp_path):
    (tmp_path / "page.html").write_text(render(full_page()), encoding="utf-8")
    first, *others = (" ".join(word.text for word in sheet) for sheet in printed(tmp_path, tmp_path / "page.html"))
    assert "Certificate of calibration" in first
    assert "signature" in first
    assert "3" * 64 in first  # the last of the files that it lists
    assert not any("0" * 64 in sheet for sheet in others)
