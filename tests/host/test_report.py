"""The report page: laws, axes, words, and the page as a parser and a browser see it."""

import html
import json
import math
import re
import shutil
import subprocess
import warnings
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy import integrate, stats

from truearm.report import svg
from truearm.report.correlation import correlation
from truearm.report.figures import MAX_POINTS, figures_of
from truearm.report.findings import chi2_words
from truearm.report.page import CalibrationPage, doubts, looks_like_page, render, verdict
from truearm.report.rows import Law, law_of, rows_by_kind, summaries
from truearm.report.tables import direction_words
from truearm.report.text import escape, figures, number
from truearm.report.words import KINDS
from truearm.types import (
    Addition,
    Estimate,
    HeldOut,
    NullDirection,
    Observability,
    ObservationTable,
    PredictedError,
    Relabelling,
)

SIGMA = 0.084e-3  # m, the paper's residual
HOSTILE = "<script>alert(1)</script>\"'&"
LINK = ("x", "y", "z", "alpha", "beta", "gamma")


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def held_out(residual):
    size = np.abs(residual)
    return HeldOut(rms(residual), float(size.mean()), float(size.max()), size.size) if size.size else None


def puma_names():
    """54 names in the order of Table II: seven links, six joints."""
    names = [f"link1.{k}" for k in LINK]
    for i in range(1, 7):
        names += [f"joint{i}.offset", f"joint{i}.gain", *(f"link{i + 1}.{k}" for k in LINK)]
    return tuple(names)


def unit(name):
    return {"gain": "1", "x": "m", "y": "m", "z": "m"}.get(name.rpartition(".")[2], "rad")


def make_page(n=1600, kind="ball_bar", seed=0, **changes):
    """A plausible calibration: 54 parameters, 36 free, half of the rows held out."""
    rng = np.random.default_rng(seed)
    names = puma_names()
    free = np.zeros(54, dtype=bool)
    free[rng.permutation(54)[:36]] = True
    root = rng.standard_normal((200, 36))
    covariance = np.zeros((54, 54))
    covariance[np.ix_(free, free)] = 1e-8 * np.linalg.inv(root.T @ root)
    nominal = np.round(rng.uniform(-1, 1, 54), 3)
    change = np.where(free, 1e-3 * rng.standard_normal(54), 0.0)
    signed = kind in ("ball_bar", "plane")
    residual = SIGMA * (rng.standard_normal(n) if signed else stats.maxwell.rvs(size=n, random_state=rng))
    before = 100.0 * residual
    fitted = np.arange(n) < (n + 1) // 2
    estimate = Estimate(
        status="converged",
        message="",
        solver="lm",
        iterations=4,
        parameter_names=names,
        units=tuple(map(unit, names)),
        nominal=nominal,
        value=nominal + change,
        sigma=np.where(free, np.sqrt(np.diag(covariance)), np.nan),
        free=free,
        identifiable=free.copy(),
        covariance=covariance,
        n_robot_parameters=54,
        n_observations=int(fitted.sum()),
        rank=36,
        rank_gap=math.inf,
        null_space=(),
        rms_before=rms(before[fitted]),
        rms_after=rms(residual[fitted]),
        rms_history=(1e-2, 2e-4, 8.3e-5, 8.2e-5),
        chi2_reduced=0.98,
        held_out=held_out(residual[~fitted]),
        held_out_before=held_out(before[~fitted]),
        residual=residual,
        residual_before=before,
        fitted=fitted,
        seconds=0.4,
    )
    blank, index = np.full(n, ""), np.arange(n)
    pick = {
        "chuck": np.array(["c1", "c2", "c3"])[index % 3],
        "sphere": np.array(["s1", "s2", "s3"])[index // 3 % 3],
        "place": blank,
    }
    if kind != "ball_bar":
        named = np.array(["front", "left", "right"])[index % 3]
        column = {"seat": "place", "line": "line", "position": "tracker", "pose": "tracker", "plane": "plane"}[kind]
        pick = {"chuck": blank, "sphere": blank, "place": blank, column: named}
    table = ObservationTable(
        q=np.zeros((n, 6)),
        kind=np.full(n, kind),
        value=np.full(n, 0.46),
        sigma=np.full(n, np.nan),
        bar=np.full(n, "b46"),
        socket=blank,
        shell=np.full(n, "b46-c1"),
        source=np.array([f"session.mcap dwell {i}" for i in range(n)]),
        **pick,
    )
    page = CalibrationPage(
        title="Calibration of a PUMA 560",
        subtitle="46 cm shells",
        estimate=estimate,
        table=table,
        longitude=rng.uniform(-np.pi, np.pi, n) if kind == "ball_bar" else np.full(n, np.nan),
        facts=(("dwells", str(n)), ("samples lost", "0")),
        steps=(("simulate", 12.0), ("identify", 0.5)),
        command="truearm demo --seed 1",
    )
    return replace(page, **changes)


class Strict(HTMLParser):
    """Collects elements and text; raises where tags do not nest."""

    VOID = frozenset({"meta", "br"})

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.elements, self.text = [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "title"):
            self.text.append(data)

    def all(self, tag):
        return [attrs for name, attrs in self.elements if name == tag]


def drawings(text):
    """The SVG elements, each through an XML parser."""
    return [ElementTree.fromstring(part) for part in re.findall(r"<svg.*?</svg>", text, re.S)]


def titles(text):
    return re.findall(r"<h3>(.*?)</h3>", text)


# --- numbers and words


def test_numbers():
    assert [figures(v) for v in (10.2345, 0.08213, 1234.5, 0.0, 2.84e12, 3e-7, math.nan)] == [
        "10.2",
        "0.0821",
        "1234",
        "0",
        "2.84·10¹²",
        "3.00·10⁻⁷",
        "–",
    ]
    assert number(-0.25, 1) == "−0.2"  # a true minus; half to even
    assert number(-1e-9, 4, sign=True) == "0.0000"  # no sign before zero
    assert number(0.5, 2, sign=True) == "+0.50"


def test_escape_leaves_nothing_active():
    assert escape(HOSTILE) == "&lt;script&gt;alert(1)&lt;/script&gt;&quot;&#x27;&amp;"
    assert escape("a\x00b\u202ec\ud800d\te") == "a\ufffdb\ufffdc\ufffdd e"  # NUL, right-to-left mark, lone surrogate
    assert len(escape("x" * 10_000)) == 200


@pytest.mark.parametrize(
    ("names", "weights", "words"),
    [
        (("link6.alpha",), (1.0,), "link6.alpha: not seen at all"),
        (("link2.z", "link3.z"), (1.0, -1.0), "link2.z up, link3.z down by as much"),
        (("link4.z", "link2.x"), (1.0, 1.0), "link4.z up, link2.x up by as much"),
        (("a", "b", "c"), (0.4, 1.0, -0.2), "+1.00 b +0.40 a −0.20 c"),
        (("a", "b"), (1.0, 0.001), "a: not seen at all"),
    ],
)
def test_direction_words(names, weights, words):
    assert direction_words(NullDirection(names, weights)) == words


# --- laws and axes


@pytest.mark.parametrize(
    ("law", "reference"),
    [
        (Law(True, 0.3, 1.7), stats.norm(0.3, 1.7)),
        (Law(False, 0.0, 1.7), stats.maxwell(scale=1.7)),
    ],
)
def test_law_against_scipy(law, reference):
    x = np.linspace(-5.0, 9.0, 57)
    np.testing.assert_allclose(law.density(x), reference.pdf(x), atol=1e-15)
    share = np.linspace(0.01, 0.99, 33)
    np.testing.assert_allclose(law.quantile(share), reference.ppf(share), rtol=1e-12, atol=1e-12)
    assert integrate.quad(lambda v: float(law.density(np.array(v))), -20.0, 20.0)[0] == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize("kind", ["ball_bar", "seat"])
def test_law_finds_the_sigma_of_one_coordinate(kind):
    page = make_page(8000, kind, seed=3)
    (rows,) = rows_by_kind(page.estimate, page.table, page.longitude)
    # 4000 rows of 1 or 3 coordinates: σ is known to 1/sqrt(2·4000) = 1.1 % or better; 4 of these
    assert law_of(rows).sigma == pytest.approx(1e3 * SIGMA, rel=0.045)


@pytest.mark.parametrize(
    ("rough", "step"), [(1.0, 1.0), (1.01, 2.0), (0.3, 0.5), (0.05, 0.05), (7.0, 10.0), (2e-7, 2e-7)]
)
def test_round_step(rough, step):
    assert svg.round_step(rough) == pytest.approx(step, rel=1e-12)


@pytest.mark.parametrize(
    ("low", "high"), [(-0.27, 0.27), (0.0, 209.0), (0.0, 0.0), (3.0, 3.0), (-1e-13, 2e-13), (0, 1e9)]
)
def test_linear_axis_holds_the_data_with_few_short_labels(low, high):
    axis = svg.linear_axis("x [mm]", low, high)
    assert axis.low <= low
    assert axis.high >= high
    assert axis.ticks[0] == axis.low
    assert axis.ticks[-1] == pytest.approx(axis.high, rel=1e-12)
    assert 3 <= len(axis.ticks) <= 9
    assert len(set(axis.tick_labels)) == len(axis.ticks)
    assert max(map(len, axis.tick_labels)) <= 10
    np.testing.assert_array_equal(axis.fraction([axis.low, axis.high]), [0.0, 1.0])


@pytest.mark.parametrize("values", [[0.07, 12.0], [0.0, 0.0], [1e-13, 10.0], [1.0, 1.0], [0.5]])
def test_log_axis_holds_the_data(values):
    axis = svg.log_axis("x [mm]", values)
    shown = axis.fraction(values)
    assert np.all((shown >= 0.0) & (shown <= 1.0))
    assert 2 <= len(axis.ticks) <= 8
    assert axis.low <= min(v for v in [*values, 1.0] if v > 0.0)


def test_longitude_is_wrapped_and_in_degrees():
    page = make_page(4, longitude=np.array([0.0, 1.5 * np.pi, -1.5 * np.pi, np.nan]))
    (rows,) = rows_by_kind(page.estimate, page.table, page.longitude)
    np.testing.assert_allclose(rows.longitude, [0.0, -90.0, 90.0, np.nan], atol=1e-12)


# --- the page


def test_every_figure_is_there_with_units_and_words():
    text = render(make_page())
    assert titles(text) == [
        "Residuals after calibration",
        "Residual against longitude",
        "Before and after",
        "By pairing of chuck and sphere",
        "Normal probability",
        "Convergence",
        "Correlation of the parameters",
    ]
    parsed = Strict(text)
    assert len(parsed.all("figure")) == len(parsed.all("figcaption")) == len(parsed.all("svg")) == 7
    for drawing in drawings(text):
        assert drawing.get("role") == "img"
        assert len(drawing.get("aria-label")) > 40
        for axis in drawing.iterfind(".//text[@class='mid name']"):
            assert axis.text is None or re.search(r"\[(mm|deg|%)\]$|^(observations|iteration)$", axis.text)


def test_bars_and_points_count_the_rows():
    page = make_page(1601)
    histogram, longitude, *_ = drawings(render(page))
    counts = [int(tip.text.rpartition(": ")[2]) for tip in histogram.iterfind("rect/title")]
    assert sum(counts) == page.estimate.n_observations == 801
    groups = {g.get("class"): len(g) for g in longitude.iterfind("g")}
    assert groups == {"fit": 801, "val": 800}


def test_histogram_heights_follow_the_gaussian():
    page = make_page(20_000, seed=5)
    (rows,) = rows_by_kind(page.estimate, page.table, page.longitude)
    drawing = ElementTree.fromstring(figures_of(rows)[0].drawing)
    heights = np.array([float(r.get("height")) for r in drawing.iterfind("rect")])
    curve = drawing.find("polyline").get("points").split()
    top = min(float(point.split(",")[1]) for point in curve)
    # 10⁴ rows in bins of about 0.25 σ: 1000 in the highest, ±32; a scale wrong by the bin width would be far off
    assert heights.max() == pytest.approx(300.0 - 46.0 - top, rel=0.12)


@pytest.mark.parametrize("residual_mm", [[-0.2, 0.0, 0.1, 0.3], [0.1, 0.3, 0.5, 0.7], [-0.3, -0.1], [0.05]])
def test_histogram_counts_residuals_on_the_edges(residual_mm):
    page = make_page(len(residual_mm))
    residual = 1e-3 * np.array(residual_mm)
    estimate = replace(page.estimate, residual=residual, fitted=np.ones(residual.size, dtype=bool))
    histogram = drawings(render(replace(page, estimate=estimate)))[0]
    assert sum(int(tip.text.rpartition(": ")[2]) for tip in histogram.iterfind("rect/title")) == residual.size


def test_correlation_of_two():
    page = make_page(20)
    free = np.arange(54) < 2
    covariance = np.zeros((54, 54))
    covariance[:2, :2] = [[4e-8, -1e-8], [-1e-8, 1e-8]]
    figure = correlation(replace(page.estimate, free=free, identifiable=free, covariance=covariance))
    (cell,) = [r for r in ElementTree.fromstring(figure.drawing).iterfind("rect") if "link1" in r.find("title").text]
    assert cell.find("title").text == "link1.y, link1.x: −0.50"
    assert (cell.get("class"), cell.get("fill-opacity")) == ("negative", "0.50")
    assert "link1.y and link1.x −0.50" in figure.caption


def test_a_seat_is_a_norm_and_has_no_gaussian():
    text = render(make_page(400, "seat"))
    assert "Gaussian" not in text
    assert "Maxwell" in text
    assert "norm of the residual [mm]" in text
    assert "Residual against longitude" not in titles(text)
    assert "By place" in titles(text)


def both(a, b):
    """One page of the rows of two, with the parameters of the first."""

    def joined(x, y):
        return np.concatenate([x, y])

    columns = a.table.__dataclass_fields__
    table = ObservationTable(**{k: joined(getattr(a.table, k), getattr(b.table, k)) for k in columns})
    changed = ("residual", "residual_before", "fitted", "suspect", "distance", "weight")
    rows = {k: joined(getattr(a.estimate, k), getattr(b.estimate, k)) for k in changed}
    angles = [np.full(len(page.table), np.nan) if page.angle is None else page.angle for page in (a, b)]
    estimate, longitude = replace(a.estimate, **rows), joined(a.longitude, b.longitude)
    return replace(a, table=table, estimate=estimate, longitude=longitude, angle=joined(*angles))


def test_kinds_have_pictures_of_their_own():
    page = both(make_page(100), make_page(60, "seat"))
    names = titles(render(page))
    assert "Residuals after calibration · ball-bar" in names
    assert "Residuals after calibration · ball-in-socket" in names
    assert "The ball-bar and ball-in-socket error" in verdict(page)
    assert "The ball-bar, line and ball-in-socket error" in verdict(both(page, make_page(20, "line")))


def cells_of(text, label):
    """The header and the rows of the table with that label, as text."""
    table = re.search(rf'aria-label="{label}"><table.*?</table>', text, re.S).group()
    rows = re.findall(r"<tr.*?</tr>", table, re.S)
    return [[html.unescape(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)] for row in rows]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_its_words_and_units(kind):
    text = render(make_page(240, kind))
    name, residual, group, signed = KINDS[kind]
    assert f"Residual of a {name} observation: {html.escape(residual)}." in text
    assert verdict(make_page(240, kind)).startswith(f"The {name} error is ")
    assert ("Gaussian" in text, "Maxwell" in text) == (signed, not signed)
    assert f"By {group}" in titles(text)
    head, row = cells_of(text, "residuals")
    assert row[0] == name
    for title in head[1:]:
        assert re.search(r"\[mm\]$|^(fitted|held-out) rows$", title)
    for drawing in drawings(text):
        for axis in drawing.iterfind(".//text[@class='mid name']"):
            assert axis.text is None or re.search(r"\[(mm|deg|%)\]$|^(observations|iteration)$", axis.text)


def test_a_pose_has_a_position_and_a_rotation():
    rng = np.random.default_rng(7)
    angle = 2e-4 * stats.maxwell.rvs(size=2000, random_state=rng)
    page = make_page(2000, "pose", angle=angle)
    text = render(page)
    names = titles(text)
    assert "Residuals after calibration · tracked pose, position" in names
    assert "Residuals after calibration · tracked pose, rotation" in names
    assert "Before and after · tracked pose, rotation" not in names  # nobody knows the rotation before
    assert "angle of the residual [deg]" in text
    position, rotation = rows_by_kind(page.estimate, page.table, page.longitude, page.angle)
    assert (position.unit, rotation.unit) == ("mm", "deg")
    # 1000 fitting rows of three coordinates: σ is known to 1/sqrt(6000) = 1.3 %; 4 of these
    assert law_of(rotation).sigma == pytest.approx(math.degrees(2e-4), rel=0.052)
    head, row = cells_of(text, "residuals")
    assert head[-1] == "RMS rotation after [deg]"
    assert row[-1] == figures(math.degrees(rms(angle[page.estimate.fitted])))


def test_residuals_of_each_rig_and_kind():
    page = both(make_page(90), make_page(60, "line", seed=1))
    rig = np.where(np.arange(150) % 2 == 0, "monday", "tuesday")
    page = replace(page, table=replace(page.table, rig=rig))
    e = page.estimate
    head, *rows = cells_of(render(page), "residuals")
    assert head[1] == "rig"
    assert [row[:2] for row in rows] == [[k, r] for r in ("monday", "tuesday") for k in ("ball-bar", "line")]
    mine = (rig == "tuesday") & (page.table.kind == "line")
    found = summaries(e, page.table)[3]
    assert (found.fitted, found.held_out) == (int((mine & e.fitted).sum()), int((mine & ~e.fitted).sum()))
    assert found.after == pytest.approx(rms(e.residual[mine & e.fitted]))
    assert found.before == pytest.approx(100 * found.after)
    assert found.validation == pytest.approx(rms(e.residual[mine & ~e.fitted]))
    assert rows[3][4] == figures(1e3 * found.after)
    assert "monday: c1 · s1" in render(page)  # groups of the pictures say of which rig they are


@pytest.mark.parametrize(
    ("chi2", "band", "words"),
    [
        (1.0, (0.9, 1.1), "lies between 0.900 and 1.10 (95 %). It does."),
        (1.5, (0.9, 1.1), "It lies above: the robot errs in ways that these parameters do not model"),
        (0.2, (0.9, 1.1), "It lies below: the declared σ are larger"),
        (1.0, (math.nan, math.nan), "χ² per degree of freedom is 1.00."),
        (math.nan, (0.9, 1.1), ""),
    ],
)
def test_chi2_against_its_band(chi2, band, words):
    e = replace(make_page(20).estimate, chi2_reduced=chi2, chi2_band=band)
    assert words in chi2_words(e)
    assert bool(words) == bool(chi2_words(e))


def test_suspects_are_named_the_farthest_first():
    n = 60
    suspect = np.isin(np.arange(n), (3, 11))
    page = make_page(n)
    distance = np.where(np.arange(n) == 11, 9.25, 5.5)
    weight = np.where(np.arange(n) == 11, 0.0, 0.31)
    source = np.array([f"/home/anyone/s.csv row {i}" for i in range(n)])
    estimate = replace(page.estimate, suspect=suspect, distance=distance, weight=weight)
    text = render(replace(page, estimate=estimate, table=replace(page.table, source=source)))
    head, *rows = cells_of(text, "rows that disagree")
    assert head == [
        *("row", "observation", "distance from the others [σ]", "residual [mm]", "weight in the fit [1]"),
    ]
    assert [row[0] for row in rows] == ["s.csv row 11", "s.csv row 3"]  # without the folder
    assert (rows[0][2], rows[0][4], rows[1][4]) == ("9.2", "0", "0.31")
    assert "2 rows disagree with all others" in text
    assert "1 left out of the fit" in text
    assert "anyone" not in text
    none = replace(page.estimate, suspect=np.zeros(n, dtype=bool))
    assert "No fitted row disagrees" in render(replace(page, estimate=none))


def test_wrong_labels_are_the_first_doubt():
    page = make_page(20)
    found = (Relabelling((4, 5, 9), ("c1", "s1"), ("c2", "s1"), 8e-3, 9e-5),)
    words = doubts(replace(page, estimate=replace(page.estimate, relabellings=found)))[0]
    assert words.startswith("Wrong label? 3 rows from session.mcap dwell 4 to session.mcap dwell 9 name chuck c1")
    assert "fit chuck c2, sphere s1: RMS 8.00 mm as labelled, 0.0900 mm put right" in words


def test_observability_and_the_set_that_can_be_told_apart():
    page = make_page(20)
    suggested = page.estimate.free.copy()
    suggested[np.flatnonzero(suggested)[:2]] = False
    estimate = replace(page.estimate, observability=Observability(2.5, 0.0125, 0.75, 0.009), suggested_free=suggested)
    text = render(replace(page, estimate=estimate))
    head, *rows = cells_of(text, "observability")
    assert head == ["index", "value", "unit", "what it says"]
    assert [row[:3] for row in rows] == [
        ["O1", "2.50", "σ"],
        ["O2", "0.0125", "1"],
        ["O3", "0.750", "σ"],
        ["O4", "0.00900", "σ"],
    ]
    assert "<summary>the 34 parameters that can be told apart</summary>" in text
    names = ", ".join(np.array(page.estimate.parameter_names)[suggested])
    assert f"<p>{names}</p>" in text
    everything = replace(estimate, suggested_free=page.estimate.free)
    assert "can be told apart</summary>" not in render(replace(page, estimate=everything))


def test_what_to_measure_next():
    page = make_page(20)
    additions = (
        Addition("pairing", ("c3", "s2"), 35, ("link2.x",)),
        Addition("place", (), 34, tuple(f"p{i}" for i in range(15))),
    )
    text = render(replace(page, estimate=replace(page.estimate, additions=additions)))
    assert "<li>Measure with chuck c3, sphere s2 too to tell 1 more parameter: link2.x.</li>" in text
    assert "Seat the ball at a new place to tell 15 more parameters: p0, p1" in text
    assert "p11 and 3 others." in text


@pytest.mark.parametrize(("relative", "words"), [(False, "in the base frame"), (True, "own place is not measured")])
def test_the_predicted_error_of_the_tool(relative, words):
    page = make_page(20, predicted=PredictedError(6.4e-5, 1.12e-4, "/x/y.csv row 7", 20, relative))
    text = render(page)
    assert re.findall(r'<p class="figure">(.*?)<span>', text)[-1] == "0.0640"
    assert "RMS of the tool, predicted" in text
    assert words in text
    assert "most at y.csv row 7, by 0.112 mm" in text


def test_solver_loss_and_prior_are_facts():
    page = make_page(20, prior="weak")
    text = render(replace(page, estimate=replace(page.estimate, solver="map", loss="huber")))
    assert "<dt>loss</dt><dd>huber: rows far from all others count less</dd>" in text
    assert "<dt>prior of the robot</dt><dd>weak: nominal to 1 mm, 5 mrad, 0.001 of a gain</dd>" in text


def test_a_page_is_known_by_its_head():
    assert looks_like_page(render(make_page(20)).encode()[:1024])
    assert looks_like_page(b"")
    assert not looks_like_page(b"<!DOCTYPE html><html><body>diary")


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
        numbers = [number(nominal, decimals), number(value, decimals), number(value - nominal, decimals, sign=True)]
        expected = [*numbers, number(sigma, decimals), border, ""]
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
    assert text.count("not seen alone") == 1
    assert "<strong>35 of 36</strong>" in text
    assert f"{name}: not seen at all" in text


def test_what_is_hardly_seen_is_said():
    page = make_page(50)
    weak = (NullDirection(("link2.z", "link3.z"), (1.0, -1.0)), NullDirection(("link6.z",), (1.0,)))
    text = render(replace(page, estimate=replace(page.estimate, hardly_seen=weak)))
    assert "2 combinations of parameters are hardly seen: by the observations alone less well than a drawing" in text
    assert "<li>link2.z up, link3.z down by as much</li><li>link6.z: by itself</li>" in text
    assert "hardly seen" not in render(page)


def test_parameters_of_the_rig_stand_apart():
    page = make_page(50)
    text = render(replace(page, estimate=replace(page.estimate, n_robot_parameters=48)))
    robot, rig = re.findall(r"<tbody>(.*?)</tbody>", text.split("<h2>Parameters</h2>")[1])[:2]
    assert (robot.count("<tr"), rig.count("<tr")) == (48, 6)
    assert "<summary>6 parameters of the rig</summary>" in text


def test_notes_steps_and_facts_are_shown():
    text = render(make_page(50, notes=("The robot is simulated.",)))
    assert '<ul class="remarks"><li>The robot is simulated.</li></ul>' in text
    assert "<dt>dwells</dt><dd>50</dd>" in text
    assert '<th scope="row">total</th><td>12.5 s</td>' in text
    assert "<code>truearm demo --seed 1</code>" in text


def test_tiles_and_verdict_are_of_this_estimate():
    page = make_page(validation=HeldOut(9.19e-5, 7.3e-5, 3.39e-4, 800))
    estimate = replace(page.estimate, rms_before=1.06463e-2, rms_after=8.018e-5)
    page = replace(page, estimate=estimate)
    tiles = re.findall(r'<p class="figure">(.*?)<span>', render(page))
    assert tiles == ["10.6", "0.0802", "0.0919"]
    assert verdict(page) == (
        "The ball-bar error is 133 times smaller: 10.6 mm RMS before, 0.0802 mm after, 0.0919 mm on observations not "
        "used to fit."
    )
    assert doubts(page) == []


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"status": "max_iterations", "message": "stopped at 3"}, "stopped early (max_iterations): stopped at 3"),
        ({"held_out": None}, "Nothing was held out"),
        ({"held_out": HeldOut(2e-3, 1e-3, 5e-3, 10)}, "times the fitted one"),
        ({"chi2_reduced": 9.0}, "3.0 times what the declared sigmas allow"),
    ],
)
def test_doubts(changes, word):
    page = make_page(100)
    found = doubts(replace(page, estimate=replace(page.estimate, **changes)))
    assert len(found) == 1
    assert word in found[0]


def test_names_from_files_stay_text():
    page = make_page(60)
    n, e = 60, page.estimate
    names = (HOSTILE, *e.parameter_names[1:])
    estimate = replace(
        e,
        parameter_names=names,
        units=(HOSTILE, *e.units[1:]),
        status=HOSTILE,
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
        facts=((HOSTILE, HOSTILE),),
        steps=((HOSTILE, 1.0),),
        command=HOSTILE,
        notes=(HOSTILE,),
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


def test_the_largest_of_many_residuals_are_drawn():
    page = make_page(60_000)
    residual = page.estimate.residual.copy()
    residual[17] = 5e-3
    page = replace(page, estimate=replace(page.estimate, residual=residual))
    longitude = drawings(render(page))[1]
    marks = [path.get("d") for path in longitude.iterfind("path") if "dots" in path.get("class")]
    points = [point for d in marks for point in re.findall(r"M[\d.]+ ([\d.]+)h0", d)]
    assert len(points) <= 2 * MAX_POINTS
    assert min(map(float, points)) < 60.0  # near the top, which is at 30 of 300; all others are about 142


@pytest.mark.parametrize(
    "residual",
    [np.zeros(20), np.full(20, 1e-17), np.r_[np.nan, np.inf, np.linspace(-1e-4, 1e-4, 18)], np.full(20, np.nan)],
    ids=["zero", "rounding", "gaps", "nothing"],
)
def test_odd_residuals_make_a_page(residual):
    page = make_page(20)
    estimate = replace(page.estimate, residual=residual, rms_after=0.0, rms_history=(1e-2, 0.0), rank_gap=math.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = render(replace(page, estimate=estimate))
    Strict(text)
    assert "nan" not in re.sub(r"<style.*?</style>", "", text, flags=re.S).lower()


@pytest.mark.parametrize("fitted", [1, 0, 2])
def test_few_fitting_rows_make_a_page(fitted):
    page = make_page(2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Strict(render(replace(page, estimate=replace(page.estimate, fitted=np.arange(2) < fitted))))


def test_rows_must_match():
    page = make_page(20)
    for changes in ({"longitude": np.zeros(19)}, {"angle": np.zeros(19)}):
        with pytest.raises(ValueError, match="must be \\(20,\\)"):
            replace(page, **changes)


# --- the page in a browser

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
QUIET = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
# A browser's window is at least 500 px wide; a frame of any width is laid out as a window of that width. The page
# inside is the unchanged one; the script stands in the frame around it, since the page's own policy would stop it.
AROUND = """<!DOCTYPE html><meta name="color-scheme" content="light dark"><iframe id="page" width="WIDTH" height="900"
style="border:0" srcdoc="PAGE"></iframe><pre id="probe"></pre><script>
onload = () => {
  const frame = document.getElementById('page'), w = frame.contentWindow, d = frame.contentDocument;
  const box = e => e.getBoundingClientRect();
  const svgs = [...d.querySelectorAll('svg')].map(svg => {
    const s = box(svg), texts = [...svg.querySelectorAll('text')].filter(t => t.textContent);
    const cut = texts.filter(t => { const b = box(t);
      return b.left < s.left - 1 || b.right > s.right + 1 || b.top < s.top - 1 || b.bottom > s.bottom + 1; });
    const over = [];
    texts.forEach((t, i) => texts.slice(0, i).forEach(u => { const a = box(t), b = box(u);
      // boxes of text are higher than its ink: a third of the height may be shared
      if (Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1 &&
          Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > Math.min(a.height, b.height) / 3)
        over.push(t.textContent + ' | ' + u.textContent); }));
    return {width: s.width, height: s.height, texts: texts.length, cut: cut.map(t => t.textContent), over};
  });
  const style = w.getComputedStyle(d.body), root = d.documentElement;
  document.getElementById('probe').textContent = JSON.stringify({inner: w.innerWidth, client: root.clientWidth,
    scroll: root.scrollWidth, paper: style.backgroundColor, ink: style.color,
    loaded: w.performance.getEntriesByType('resource').length, svgs});
};
</script>"""


def look(page, folder, width, dark):
    """The page laid out by the browser: what the probe found."""
    path = folder / "around.html"
    whole = AROUND.replace("WIDTH", str(width)).replace("PAGE", html.escape(render(page)))
    path.write_text(whole, encoding="utf-8")
    theme = ("--blink-settings=preferredColorScheme=0",) if dark else ()
    profile = f"--user-data-dir={folder / 'profile'}"
    run = subprocess.run(
        [CHROMIUM, *QUIET, *theme, profile, "--window-size=1400,1000", "--dump-dom", path.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return json.loads(html.unescape(re.search(r'<pre id="probe">(.*?)</pre>', run.stdout, re.S).group(1)))


def luminance(colour):
    """Relative luminance of "rgb(r, g, b)" (WCAG 2)."""
    c = np.array([int(v) for v in re.findall(r"\d+", colour)[:3]]) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def full_page():
    """A page with everything that a page may have: all kinds, two rigs, suspects, wrong labels, proposals."""
    page = make_page(300)
    for seed, kind in enumerate(KINDS):
        if kind != "ball_bar":
            page = both(page, make_page(60, kind, seed=seed))
    n, e = len(page.table), page.estimate
    index = np.arange(n)
    estimate = replace(
        e,
        suspect=index % 50 == 3,
        distance=np.full(n, 6.5),
        weight=np.where(index % 100 == 3, 0.0, 1.0),
        chi2_band=(0.9, 1.1),
        observability=Observability(2.5, 1.25e-7, 0.75, 0.009),
        suggested_free=e.free & (np.arange(54) > 9),
        additions=(Addition("pairing", ("c3", "s2"), 35, LINK), Addition("line", (), 34, LINK)),
        relabellings=(Relabelling((4, 5, 9), ("c1", "s1"), ("c2", "s1"), 8e-3, 9e-5),),
        null_space=(NullDirection(("link1.x", "link2.x"), (1.0, -1.0)),),
        hardly_seen=(NullDirection(("link2.z",), (1.0,)),),
    )
    return replace(
        page,
        estimate=estimate,
        table=replace(page.table, rig=np.where(index % 2 == 0, "monday", "tuesday")),
        angle=np.where(page.table.kind == "pose", 1e-4 * (1 + index % 7), np.nan),
        predicted=PredictedError(6.4e-5, 1.12e-4, "y.csv row 7", 20, True),
        prior="weak",
    )


def test_everything_at_once_is_one_sound_page():
    text = render(full_page())
    parsed = Strict(text)
    words = " ".join(" ".join(parsed.text).split())
    assert len(drawings(text)) == len(parsed.all("figure"))
    for said in (
        "Wrong label?",
        "χ² per degree of freedom",
        "touched flat",
        "What to measure next",
        "errs by 0.0640 mm",
    ):
        assert said in words
    for title in parsed.all("table"):
        assert title["class"].split()[0] in ("plain", "numbers", "steps")
    heads = [html.unescape(t) for t in re.findall(r'<th scope="col">(.*?)</th>', text)]
    for head in heads:  # every column of numbers says its unit
        assert re.search(r"\[(mm|deg|σ|1)\]$", head) or head in UNITLESS, head
    assert "nan" not in re.sub(r"<style.*?</style>", "", text, flags=re.S).lower()


UNITLESS = {
    *("observations", "rig", "fitted rows", "held-out rows", "row", "observation"),  # names and counts
    *("index", "value", "unit", "what it says"),  # a column names the unit
    *("parameter", "nominal", "identified", "change", "σ", ""),
}


@pytest.mark.skipif(
    CHROMIUM is None, reason="no browser: install chromium (apt-get install chromium) to lay out the page"
)
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_in_a_browser(tmp_path, width, dark):
    page = full_page()
    seen = look(page, tmp_path, width, dark)
    assert seen["inner"] == width
    assert seen["scroll"] <= seen["client"]  # the page itself never scrolls sideways
    assert seen["loaded"] == 0
    assert len(seen["svgs"]) == len(titles(render(page))) - 1  # "What to measure next" has no picture
    assert len(seen["svgs"]) > 20
    for drawing in seen["svgs"]:
        assert drawing["width"] >= 280
        assert drawing["height"] >= 150
        assert drawing["texts"] >= 8
        assert drawing["cut"] == []  # no label leaves its picture
        assert drawing["over"] == []  # nor hides another
    paper, ink = luminance(seen["paper"]), luminance(seen["ink"])
    assert (paper < ink) == dark
    assert (max(paper, ink) + 0.05) / (min(paper, ink) + 0.05) >= 7.0  # WCAG 2 contrast, level AAA
