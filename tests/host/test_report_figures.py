"""The report's numbers, wording, joint laws, axes and pictures."""

import math
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from report_bench import HOSTILE, drawings, make_page, render
from scipy import integrate, stats

import truearm
from truearm.model.chain import forward
from truearm.report import svg
from truearm.report.figures import MAX_POINTS, Law, by_order, rows_by_kind
from truearm.report.page import escape, figures, number, size, tiles
from truearm.report.result_findings import joint_zeros, tool_error
from truearm.report.svg import Cells, map_picture

# numbers and words


def test_numbers_units_and_escapes():
    assert (size(math.nan, "m"), size(2e-3, "m")) == ("–", "2.00 mm")
    assert "mm" not in tiles([("fit", "expected error", {"mm": math.nan}, "")])
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
    assert escape(HOSTILE) == "&lt;script&gt;alert(1)&lt;/script&gt;&quot;&#x27;&amp;"
    assert escape("a\x00b\u202ec\ud800d\te") == "a\ufffdb\ufffdc\ufffdd e"  # NUL, right-to-left mark, lone surrogate
    assert len(escape("x" * 10_000)) == 200


# laws and axes


@pytest.mark.parametrize(
    ("law", "reference"),
    [
        (Law(1, 0.3, 1.7), stats.norm(0.3, 1.7)),
        (Law(3, 0.0, 1.7), stats.maxwell(scale=1.7)),
        (Law(2, 0.0, 1.7), stats.rayleigh(scale=1.7)),
        (Law(6, 0.0, 1.7), stats.chi(6, scale=1.7)),
    ],
)
def test_law_against_scipy(law, reference):
    x = np.linspace(-5.0, 9.0, 57)
    np.testing.assert_allclose(law.density(x), reference.pdf(x), atol=1e-15)
    assert integrate.quad(lambda v: float(law.density(np.array(v))), -20.0, 20.0)[0] == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize("values", [[0.07, 12.0], [0.0, 0.0], [1e-13, 10.0], [1.0, 1.0], [0.5]])
def test_log_axis_holds_the_data(values):
    axis = svg.log_axis("x [mm]", values)
    shown = axis.fraction(values)
    assert np.all((shown >= 0.0) & (shown <= 1.0))
    assert 2 <= len(axis.ticks) <= 8
    assert axis.low <= min(v for v in [*values, 1.0] if v > 0.0)


def test_ticks_of_random_ranges_are_round():
    """Axes, and the scale of a map, are divided at multiples of 1, 2 or 5 times a power of ten, and labelled so."""
    rng = np.random.default_rng(20)
    for low, span in zip(rng.normal(0.0, 3.0, 40), 10.0 ** rng.uniform(-3.0, 3.0, 40), strict=True):
        error = np.array([[low, low + span], [low, low]]) ** 2
        scale = map_picture(Cells(np.r_[0.0, 9.0], np.r_[0.0, 9.0], error, error, error < 0.0), "Error")
        ticks = [text.replace("\u2212", "-") for text in re.findall(r'class="">([\u2212\d.e+]+)<', scale)]
        assert_round(np.array(ticks, dtype=float))
        axis = svg.linear_axis("x [mm]", low, low + span)
        assert_round(np.array([float(text.replace("\u2212", "-")) for text in axis.tick_labels]))


def assert_round(ticks):
    step = np.diff(ticks)
    assert 2 <= ticks.size <= 9
    assert step == pytest.approx(step[0])
    mantissa = step[0] / 10.0 ** math.floor(math.log10(step[0]) + 1e-9)
    assert min(abs(mantissa - m) for m in (1.0, 2.0, 5.0)) < 1e-6
    assert ticks / step[0] == pytest.approx(np.round(ticks / step[0]), abs=1e-6)


def test_bars_and_points_count_the_rows():
    page = make_page(1601)
    histogram, longitude, *_ = drawings(render(page))
    counts = [int(tip.text.rpartition(": ")[2]) for tip in histogram.iterfind("rect/title")]
    assert sum(counts) == page.estimate.n_observations == 801
    groups = {g.get("class"): len(g) for g in longitude.iterfind("g")}
    assert groups == {"fit": 801, "val": 800}


@pytest.mark.parametrize("residual_mm", [[-0.2, 0.0, 0.1, 0.3], [0.1, 0.3, 0.5, 0.7], [-0.3, -0.1], [0.05]])
def test_histogram_counts_residuals_on_the_edges(residual_mm):
    page = make_page(len(residual_mm))
    residual = 1e-3 * np.array(residual_mm)
    estimate = replace(page.estimate, residual={"m": residual}, fitted=np.ones(residual.size, dtype=bool))
    histogram = drawings(render(replace(page, estimate=estimate)))[0]
    assert sum(int(tip.text.rpartition(": ")[2]) for tip in histogram.iterfind("rect/title")) == residual.size


def test_the_largest_of_many_residuals_are_drawn():
    page = make_page(60_000)
    residual = page.estimate.residual["m"].copy()
    residual[17] = 5e-3
    page = replace(page, estimate=replace(page.estimate, residual={"m": residual}))
    longitude = drawings(render(page))[1]
    points = [circle.get("cy") for circle in longitude.iterfind("g/circle")]
    assert MAX_POINTS < len(points) <= 2 * MAX_POINTS
    assert min(map(float, points)) < 60.0  # near the top, which is at 30 of 300; all others are about 142


def test_the_order_of_measurement_has_its_sessions_and_mounts():
    """Two files, each with two mounts; the second file's residuals are 0.5 mm higher, and its mean shows it."""
    page = make_page(400)
    table = replace(
        page.table,
        chuck=np.repeat(["c1", "c2", "c1", "c2"], 100),
        sphere=np.full(400, "s1"),
        source=np.array([f"{'monday' if i < 200 else 'friday'}.csv row {i % 200 + 2}" for i in range(400)]),
    )
    off = np.where(np.arange(400) < 200, 0.0, 0.5e-3)
    estimate = replace(
        page.estimate, residual={"m": page.estimate.residual["m"] + off}, fitted=np.ones(400, dtype=bool)
    )
    (rows,) = rows_by_kind(estimate, table, page.longitude)
    figure = by_order(rows)
    assert "2 sessions, 4 stretches " in figure.caption
    drawing = ElementTree.fromstring(figure.drawing)
    marks = {css: [] for css in ("mount line", "session line")}
    for line in drawing.iterfind("polyline"):
        if line.get("class") in marks:
            marks[line.get("class")].append(float(line.get("points").split(",")[0]))
    assert len(marks["mount line"]) == 3
    assert len(marks["session line"]) == 1
    assert marks["session line"][0] == marks["mount line"][1]
    mean = drawing.findall("polyline")[-1].get("points").split()
    heights = np.array([float(point.split(",")[1]) for point in mean])
    first, second = np.split(heights, 2)
    assert second.max() < first.min(), "y of a drawing counts down"


# the error to expect: the largest of what poses show, what the covariance predicts, and what named errors move

SHOWN = {"mean_mm": 0.09, "low_mm": 0.07, "high_mm": 0.11, "n_mm": 36, "by": "held out"}


def error_of(tool=None, without_bad=None, shown=SHOWN):
    """The error of the tool to expect [mm]."""
    document = {
        "status": "converged",
        "usable": True,
        "unexplained": shown,
        "predicted_error": None if tool is None else {"rms_mm": tool[0], "n": tool[1]},
        "faults": [],
        "without_bad_rows": None if without_bad is None else {"tool_moves_mm": without_bad},
    }
    (finding,) = tool_error(document)
    return finding


@pytest.mark.parametrize(
    ("tool", "code"),
    [(None, "tool-error-shown"), ((0.2, 50), "tool-error-by-sigmas"), ((0.05, 50), "tool-error-shown")],
)
def test_the_largest_is_the_one_to_expect(tool, code):
    finding = error_of(tool)
    assert finding.code == code
    assert (finding.values["error"], finding.values["n"], finding.values["by"]) == ({"mm": 0.09}, 36, "held out")
    assert "0.090 mm (95 %: 0.0700 to 0.1100)" in finding.text()


def test_words_of_held_out_poses_and_bad_rows():
    assert error_of(shown={**SHOWN, "by": "cross-validation"}).values["by"] == "left out in turn"
    finding = error_of(tool=(0.2, 50), without_bad=0.05)
    assert (finding.code, finding.values["moves"]) == ("tool-error-bad-rows", {"mm": 0.05})


def seen_by_a_tracker(turned=(0.0,) * 6, mirrored=1.0):
    """An IRB 120 as described, whose controller counts joints from other zeros, or whose tracker has left-handed axes."""
    robot, rng = truearm.load_robot("irb120"), np.random.default_rng(5)
    q = rng.uniform(-1.05, 1.05, (120, 6))
    xyz = forward(robot.chain, robot.chain.params_nominal, q)[:, :3, 3] + 2e-5 * rng.normal(size=(120, 3))
    covariance = ((4e-10, 0.0, 0.0), (0.0, 4e-10, 0.0), (0.0, 0.0, 4e-10))
    rig = truearm.Rig(trackers={"t": truearm.Device("t", covariance)})
    rows = truearm.ObservationTable(
        q=q + turned, kind=["position"] * 120, xyz=xyz * [1.0, 1.0, mirrored], tracker=["t"] * 120
    )
    return truearm.identify(robot, rows, rig, options=truearm.IdentifyOptions(joint_laws="none")).document


def test_other_zeros_and_left_handed_axes_are_named():
    # The first and the last joint's zeros are those of base and tool, which may be anywhere.
    assert joint_zeros(seen_by_a_tracker()) == []
    assert joint_zeros(seen_by_a_tracker((1.5, 0.0, 2.0 * np.pi, 0.0, 0.0, 1.5))) == []
    (said,) = joint_zeros(seen_by_a_tracker((0.0, np.pi / 2.0, 0.0, 0.0, 0.0, 0.0)))
    assert (said.code, said.values["joints"]) == ("joint-zeros", ["joint2.offset by -90.0 deg"])
    # A robot with its lengths and zeros reversed is the mirrored one; no residual is left.
    document = seen_by_a_tracker(mirrored=-1.0)
    assert not document["usable"] or joint_zeros(document)
