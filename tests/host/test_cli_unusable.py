"""Commands that correct a robot refuse a fit that is not usable, unless it is asked for."""

import json
from dataclasses import replace

import correct_bench
import numpy as np
import pytest
from puma_bench import RIG, SIGMA, shell_table
from tests.host.findings_bench import listed
from tests.refusals import ended, shown

from truearm.kinds.rig_file import write_rig
from truearm.kinds.table_file import write_table
from truearm.results import Unusable

COMMANDS = {
    "export": ["--format", "dh-hayati", "--out", "robot.toml"],
    "correct": ["targets.csv", "--home", "0,-45,90,0,45,0", "--own-frames", "--out", "corrected.csv"],
    "map": ["--cell-mm", "60", "--out", "map.csv"],
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "targets.csv").write_text("name,x_mm,y_mm,z_mm\na,500,200,300\n")
    return tmp_path


@pytest.mark.parametrize("command", COMMANDS)
def test_a_fit_that_is_not_usable_is_refused(command, folder, run):
    estimate = replace(correct_bench.identified(), status="max_iterations", unusable=Unusable.NOT_CONVERGED)
    bad = correct_bench.write(folder / "bad.json", estimate)
    before = {path.name for path in folder.iterdir()}
    code, said, err = run(command, bad, *COMMANDS[command])
    assert (code, said) == (2, "")
    ended(err, "unusable-result", place="bad.json", reason="not converged")
    assert err.rstrip().endswith("or give --allow-unusable")
    assert {path.name for path in folder.iterdir()} == before
    code, _, err = run(command, bad, *COMMANDS[command], "--allow-unusable")
    assert code == 0, err
    assert (folder / COMMANDS[command][-1]).exists()


def test_judging_a_fit_that_is_not_usable_says_so(folder, run):
    estimate = replace(correct_bench.identified(), status="max_iterations", unusable=Unusable.NOT_CONVERGED)
    bad = correct_bench.write(folder / "bad.json", estimate)
    rows = shell_table(60, 0.46, np.random.default_rng(3), SIGMA)
    write_table(folder / "friday.csv", rows.replace(time=np.arange(60.0)[::-1]), ("rad",) * 6)
    write_rig(folder / "rig.toml", RIG)
    code, said, err = run("validate", bad, "friday.csv", "--rig", "rig.toml", "--json")
    assert (code, err) == (0, "")
    findings = listed(json.loads(said))
    assert next(iter(findings)) == "validation-holds"
    assert findings["calibration-unusable"] == {"because": Unusable.NOT_CONVERGED}
    assert findings["rows-reordered"] == {"place": "friday.csv"}
    given = ("validate", bad, "friday.csv", "--rig", "rig.toml", "--report", folder / "page.html", "--force")
    assert run(*given).code == 0
    assert shown["rows-reordered"] == {"place": "friday.csv"}
    codes = [entry["code"] for entry in json.loads(run(*given, "--json").out)["findings"]]
    assert len(codes) == len(set(codes)), "the decision of the certificate is stated once"
