"""A kind of observation whose residual is an angle: its errors are in degrees in all outputs."""

import json
import re

import incline_kind
import numpy as np
import pytest
from puma_bench import CHAIN, RIG, TRUTH, random_poses
from result_schema import check_schema
from tests.host.findings_bench import listed

from truearm.extend import add_kind
from truearm.kinds import columns, registry
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table_file import read_table
from truearm.model.chain import forward

SIGMA_DEG = 0.01


@pytest.fixture(autouse=True)
def _added(monkeypatch):
    """The kind, as another package adds it."""
    monkeypatch.setattr(columns, "ADDED", {})
    monkeypatch.setattr(registry, "ADDED", columns.ADDED)
    add_kind("incline", incline_kind.KIND)
    yield
    for function in (columns.declared, columns.identifiers, columns.quantities, registry.entries):
        function.cache_clear()


@pytest.fixture
def table(tmp_path):
    """160 inclinations of the true robot, in degrees, and a rig of which they use nothing."""
    rng = np.random.default_rng(4)
    q = random_poses(160, rng)
    angle = np.degrees(np.arccos(forward(CHAIN, TRUTH, q)[:, 2, 2])) + SIGMA_DEG * rng.normal(size=160)
    rows = [
        ",".join(["incline", *map(repr, joints.tolist()), place, repr(float(one)), str(SIGMA_DEG)])
        for joints, one, place in zip(q, angle, ["near", "far"] * 80, strict=True)
    ]
    titles = ["kind", *(f"q{i}_rad" for i in range(1, 7)), "place", "incline_deg", "sigma_deg"]
    (tmp_path / "t.csv").write_text("\n".join([",".join(titles), *rows, ""]))
    write_rig(tmp_path / "rig.toml", RIG)
    return tmp_path / "t.csv"


def test_a_table_has_its_sigma_in_degrees(table):
    rows = read_table(table, CHAIN.joint_units)
    np.testing.assert_allclose(rows.sigma, np.radians(SIGMA_DEG), rtol=1e-12)


def test_inclinations_are_identified_and_judged_in_degrees(table, run, printed):
    folder = table.parent
    given = ["identify", table, "--model", "puma560", "--rig", folder / "rig.toml", "--hold-out", "0.25"]
    text = printed(*given, "--out", folder / "r.json", "--report", folder / "r.html", "--details")
    result = json.loads((folder / "r.json").read_text())
    check_schema(result)
    assert result["residual_units"] == ["deg"]
    del result["findings"]  # where base and tool stand, whatever is measured
    assert not re.search(r'_mm"', json.dumps(result))
    # 120 rows and 19 combinations: noise alone would leave 0.0092 deg, with a σ of 7 %; four of these
    assert result["rms_after_deg"] == pytest.approx(SIGMA_DEG * np.sqrt(1.0 - result["rank"] / 120.0), rel=0.28)
    assert 0.6 < result["chi2_reduced"] < 1.5
    assert re.search(rf"^fitted, RMS +\d\.\d{{5}} +{result['rms_after_deg']:.5f} +120$", text, re.M)
    assert re.search(r"^error \[deg\] +before +after +rows$", text, re.M)
    assert "error [mm]" not in text
    errors = (folder / "r.html").read_text().partition("<h2>Parameters</h2>")[0]
    assert not re.search(r"\bmm\b", re.sub(r"<(style|script)\b.*?</\1>", "", errors, flags=re.S))
    assert '"residual after"' not in errors  # the 3-D view has the tool's error before, in mm, and no lengths after

    text = printed("validate", folder / "r.json", table, "--rig", folder / "rig.toml", "--details")
    assert re.search(r"^error \[deg\] +before +after +expected +rows$", text, re.M)
    judged = json.loads(run("validate", folder / "r.json", table, "--rig", folder / "rig.toml", "--json").out)
    assert "validation-own-rows" in listed(judged)  # which no verdict rests on
    assert "error [mm]" not in text
    assert "place=near" in text


def test_lengths_and_inclinations_are_never_pooled(table, run):
    """The same rows, and a ball seated in a socket at 40 of them: a table of errors a unit, each kind in its own."""
    folder = table.parent
    header, *rows = table.read_text().splitlines()
    seats = [",".join(["seat", *row.split(",")[1:7], "near", "", "", "0", "s0"]) for row in rows[:40]]
    table.write_text("\n".join([f"{header},socket,sphere", *(f"{row},," for row in rows), *seats, ""]))
    options = ("--prior", "weak", "--solver", "map", "--details")
    code, text, err = run("identify", table, "--model", "puma560", "--rig", folder / "rig.toml", *options)
    assert code == 3, err  # the seats are anywhere: no arm fits them
    lengths, angles = text.split("error [mm]")[1].split("error [deg]")
    assert "ball-in-socket" in lengths
    assert "inclination" not in lengths
    assert "inclination" in angles
    assert "ball-in-socket" not in angles
