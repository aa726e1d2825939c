"""The report page: its content, and that it is sound with hostile names, extreme numbers and many rows."""

import html
import math
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from report_bench import HOSTILE, Strict, both, cells_of, drawings, make_page, render, rms, titles, with_rotation
from scipy import stats

from truearm.disk import KINDS
from truearm.findings import Finding
from truearm.kinds import NAMES
from truearm.kinds.registry import kinds
from truearm.report.figures import figures_of, law_of, rows_by_kind
from truearm.results import Figures, HeldOut, NullDirection

# --- the page


def errors_in(text, unit):
    """Return head and rows of the table of errors in a unit."""
    return next(cells for cells in cells_of(text, "errors") if cells[0][0] == f"error [{unit}]")


@pytest.mark.parametrize("kind", NAMES)
def test_every_kind_has_its_words_and_units(kind):
    text = render(make_page(240, kind))
    of = kinds()[kind]
    name, signed = of.name, of.components.count("m") == 1
    assert name in text
    assert all(html.escape(residual) in text for residual in of.residual.values())
    assert ("Gaussian" in text, "Maxwell" in text) == (signed, not signed)
    assert ("Residual against longitude" in titles(text)) == (kind == "ball_bar")
    assert len(Strict(text).all("figcaption")) == len(titles(text)) >= 3
    assert not re.search(r"</h2>(<div[^>]*></div>)?</section>", text)  # no section is empty
    head, row, *_ = errors_in(text, "mm")
    assert head == ["error [mm]", "before", "after", "rows"]
    assert row[0] == "fitted, RMS"
    for drawing in drawings(text):
        assert drawing.get("role") == "img"
        assert len(drawing.get("aria-label")) > 40
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
    assert "1 combination " in text
    assert f"<li>1.00 {name}</li>" in text


def test_names_from_files_stay_text():
    page = make_page(60)
    n, e = 60, page.estimate
    names = (HOSTILE, *e.parameter_names[1:])
    estimate = replace(
        e,
        parameter_names=names,
        message=HOSTILE,
        solver=HOSTILE,
        null_space=(NullDirection((HOSTILE,), (1.0,)),),
        free=np.ones(54, dtype=bool),
        identifiable=np.ones(54, dtype=bool),
        covariance=1e-8 * np.eye(54),
    )
    columns = {name: np.full(n, HOSTILE) for name in ("chuck", "shell", "source", "place")}
    columns["sphere"] = np.array([f"{HOSTILE}{i % 3}" for i in range(n)])
    page = replace(
        page,
        title=HOSTILE,
        subtitle=HOSTILE,
        estimate=estimate,
        table=replace(page.table, **columns),
        facts=((HOSTILE, HOSTILE),) * 2,
        command=HOSTILE,
        findings=(Finding("not-converged", {"message": HOSTILE}),),
    )
    text = render(page)
    parsed = Strict(text)
    assert not parsed.all("script")
    assert not [a for _, attrs in parsed.elements for a in attrs if a.startswith("on")]
    assert "".join(parsed.text).count("<script>alert(1)</script>") >= 10
    drawings(text)  # still XML
    text.encode("utf-8")


def test_nothing_is_loaded_from_anywhere():
    text = render(make_page())
    parsed = Strict(text)
    assert not [
        t for t, a in parsed.elements if {"src", "href", "xlink:href", "srcset"} & a.keys() or t in ("link", "script")
    ]
    for word in ("http:", "https:", "//", "url(", "@import"):
        assert word not in text
    policies = [meta["content"] for meta in parsed.all("meta") if meta.get("http-equiv") == "Content-Security-Policy"]
    assert policies == ["default-src 'none'; style-src 'unsafe-inline'"]


@pytest.mark.parametrize("n", [1600, 100_000])
def test_weight(n):
    assert len(render(make_page(n)).encode()) <= 1.5e6


@pytest.mark.parametrize(
    "residual",
    [np.zeros(20), np.full(20, 1e-17), np.r_[np.nan, np.inf, np.linspace(-1e-4, 1e-4, 18)], np.full(20, np.nan)],
    ids=["zero", "rounding", "gaps", "nothing"],
)
def test_odd_residuals_make_a_page(residual):
    page = make_page(20)
    estimate = replace(
        page.estimate, residual={"m": residual}, rms_after={"m": 0.0}, rms_history={"m": (1e-2, 0.0)}, rank_gap=math.nan
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = render(replace(page, estimate=estimate))
    Strict(text)
    assert "nan" not in re.sub(r"<style.*?</style>", "", text, flags=re.S).lower()


@pytest.mark.parametrize("fitted", [1, 0, 2])
def test_few_fitting_rows_make_a_page(fitted):
    """Of a kind, no row may be fitted; of all, at least one is."""
    page = both(make_page(2), make_page(2, "seat"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Strict(render(replace(page, estimate=replace(page.estimate, fitted=np.arange(4) < max(fitted, 1)))))
        rows, *_ = rows_by_kind(page.estimate, page.table, page.longitude)
        assert figures_of(rows._replace(fitted=np.arange(2) < fitted))
