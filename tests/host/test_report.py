"""The content of the report page."""

import html
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from report_bench import Strict, both, cells_of, drawings, make_page, render, rms, titles, with_rotation
from scipy import stats

from truearm.file_kind import KINDS
from truearm.findings import Finding
from truearm.kinds import NAMES
from truearm.kinds.registry import kinds
from truearm.report.residual_rows import law_of, rows_by_kind
from truearm.results import Figures, HeldOut, NullDirection

# --- the page


def errors_in(text, unit):
    """Return head and rows of the table of errors in a unit."""
    return next(cells for cells in cells_of(text, "errors") if cells[0][0] == f"error [{unit}]")


def test_every_figure_is_there_with_units_and_words():
    text = render(make_page())
    assert titles(text) == [
        "Residuals after calibration",
        "Residual against longitude",
        "Before and after",
        "Residual in the order of measurement",
    ]
    parsed = Strict(text)
    assert len(parsed.all("figure")) == len(parsed.all("figcaption")) == len(parsed.all("svg")) == 4
    for drawing in drawings(text):
        assert drawing.get("role") == "img"
        assert len(drawing.get("aria-label")) > 40
        for axis in drawing.iterfind(".//text[@class='mid name']"):
            assert axis.text is None or re.search(r"\[(mm|deg|%)\]$|^(observations|row)$", axis.text)


def test_a_seat_is_a_norm_and_has_no_gaussian():
    text = render(make_page(400, "seat"))
    assert "Gaussian" not in text
    assert "Maxwell" in text
    assert "residual [mm]" in text
    assert "Residual against longitude" not in titles(text)


@pytest.mark.parametrize("kind", NAMES)
def test_every_kind_has_its_words_and_units(kind):
    text = render(make_page(240, kind))
    of = kinds()[kind]
    name, signed = of.name, of.components.count("m") == 1
    assert name in text
    assert all(html.escape(residual) in text for residual in of.residual.values())
    assert ("Gaussian" in text, "Maxwell" in text) == (signed, not signed)
    assert not re.search(r"</h2>(<div[^>]*></div>)?</section>", text)  # no section is empty
    head, row, *_ = errors_in(text, "mm")
    assert head == ["error [mm]", "before", "after", "rows"]
    assert row[0] == "fitted, RMS"
    for drawing in drawings(text):
        for axis in drawing.iterfind(".//text[@class='mid name']"):
            assert axis.text is None or re.search(r"\[(mm|deg|%)\]$|^(observations|row)$", axis.text)


def test_a_pose_has_a_position_and_a_rotation():
    rng = np.random.default_rng(7)
    angle = 2e-4 * stats.maxwell.rvs(size=2000, random_state=rng)
    page = make_page(2000, "pose")
    page = replace(page, estimate=with_rotation(page.estimate, angle))
    text = render(page)
    names = titles(text)
    assert "Residuals after calibration · tracked pose, position" in names
    assert "Residuals after calibration · tracked pose, rotation" in names
    assert "Before and after · tracked pose, rotation" in names
    assert "residual [deg]" in text
    position, rotation = rows_by_kind(page.estimate, page.table, page.longitude)
    assert (position.unit, rotation.unit) == ("mm", "deg")
    # 1000 fitting rows of three coordinates: σ is known to 1/sqrt(6000) = 1.3 %; 4 of these
    assert law_of(rotation).sigma == pytest.approx(math.degrees(2e-4), rel=0.052)
    head, row, *_ = errors_in(text, "deg")
    assert row[head.index("after")] == f"{math.degrees(rms(angle[page.estimate.fitted])):.5f}"


def test_residuals_of_each_rig_and_kind():
    page = both(make_page(90), make_page(60, "line", seed=1))
    rig = np.where(np.arange(150) % 2 == 0, "monday", "tuesday")
    page = replace(page, table=replace(page.table, rig=rig))
    e = page.estimate
    _, _, *rows = errors_in(render(page), "mm")
    names = [f"  {r}: {k}" for r in ("monday", "tuesday") for k in ("ball-bar", "line")]
    assert [row[0] for row in rows[:4]] == [name.strip() for name in names]
    mine = (rig == "tuesday") & (page.table.kind == "line") & e.fitted
    after = 1e3 * rms(e.residual["m"][mine])
    assert rows[3][1:] == [f"{100 * after:.4f}", f"{after:.4f}", str(int(mine.sum()))]


def test_the_verdict_is_the_headline_then_doubts_and_advice_then_notes():
    findings = (
        Finding("simulated"),
        Finding("wrong-inputs", {"after": {"mm": 43.0}, "large": False}),
        Finding("still-joint", {"joint": "joint2", "reading": "3 deg"}),
        Finding("no-law", {"tried": 0, "none": True}),
        Finding("correct-next"),
    )
    text = html.unescape(render(make_page(20, findings=findings)))
    assert f'<h2 class="verdict">{findings[1].text()}</h2>' in text
    assert f'<ul class="remarks doubts"><li>{findings[2].text()}</li></ul>' in text
    places = [text.index(finding.text()) for finding in (findings[1], findings[2], findings[4], findings[3])]
    assert places == sorted(places)


def test_heads_tiles_and_fits_of_few_degrees_of_freedom():
    page = make_page(20)
    few = replace(page, estimate=replace(page.estimate, chi2_freedom=4.0, rank=36, held_out=None))
    assert "RMS after</p>" not in render(few)
    assert KINDS["page"].fits(render(make_page(20)).encode()[:1024])
    assert not KINDS["page"].fits(b"<!DOCTYPE html><html><body>diary")
    page = make_page()
    held_out = HeldOut({"m": Figures(9.19e-5, 7.3e-5, 3.39e-4, 800)}, 800)
    estimate = replace(page.estimate, rms_before={"m": 1.06463e-2}, rms_after={"m": 8.018e-5}, held_out=held_out)
    page = replace(page, estimate=estimate)
    tiles = re.findall(r'<p class="figure">(.*?)<span>', render(page))
    assert tiles == ["10.6", "0.0802", "0.0919"]


def test_parameters_are_in_the_units_of_the_border():
    page = make_page(50)
    e = page.estimate
    text = render(page)
    cells = dict(re.findall(r'<th scope="row">([^<]+)</th>((?:<td.*?</td>)+)', text))
    i = next(k for k in range(54) if e.free[k] and e.units[k] == "rad")
    j = next(k for k in range(54) if e.free[k] and e.units[k] == "m")
    held = next(k for k in range(54) if not e.free[k])
    for k, factor, decimals, border in ((i, 180.0 / math.pi, 5, "deg"), (j, 1e3, 4, "mm")):
        nominal, value, sigma = (factor * v[k] for v in (e.nominal, e.value, e.sigma))
        numbers = [f"{nominal:.{decimals}f}", f"{value:.{decimals}f}", f"{value - nominal:+.{decimals}f}"]
        expected = [*numbers, f"{sigma:.2g}", border]
        assert re.findall(r"<td[^>]*>(.*?)</td>", cells[e.parameter_names[k]]) == expected
    assert "held fixed" in cells[e.parameter_names[held]]
    assert len(re.findall(r'<tr class="held', text)) == 18


def test_what_is_not_seen_is_marked_and_said():
    page = make_page(50)
    seen = page.estimate.identifiable.copy()
    lost = int(np.flatnonzero(page.estimate.free)[0])
    seen[lost] = False
    name = page.estimate.parameter_names[lost]
    estimate = replace(page.estimate, identifiable=seen, rank=35, null_space=(NullDirection((name,), (1.0,)),))
    text = render(replace(page, estimate=estimate))
    assert text.count("<td>unidentifiable</td>") == 1
    assert "1 combination of parameters is unidentifiable" in text
    assert f"<li>1.00 {name}</li>" in text
