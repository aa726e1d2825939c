"""Every page that truearm writes, laid out by a browser: nothing wider than a phone, everything on A4; the report's pictures."""

import html
import re
from dataclasses import replace

import numpy as np
import pytest
from browser import A4_PT, MARGIN_PT, PICTURES, laid_out, needs_browser, needs_printer, printed, probed
from report_bench import CERTIFICATE, Strict, drawings, full_page, make_page, render, titles, view

from truearm.box.gauge import Place, Places, calibrate, gauge_page
from truearm.box.requests import GaugeOptions
from truearm.findings import Finding, entries
from truearm.report import correction_page
from truearm.report.svg import Cells, map_picture
from truearm.report.validation_findings import validation_findings
from truearm.session.dwells import mean_of
from truearm.session.frames import Channel, Ident
from truearm.workflows.report import validation_page

PHONE = 400
LONG = "truearm report 2026-11-26-monday.result.json sessions/2026-11-26-monday.mcap --serial 2019-7 --out " + "x" * 60


def unusable():
    """The report of a fit that did not converge, made by a long command."""
    findings = (Finding("not-converged", {"message": LONG}),) * 2
    return render(make_page(100, command=LONG, findings=findings))


def gauge():
    x = np.linspace(-0.03, 0.03, 9)
    places = Places("uid", "lvdt", "V", 1e-7)
    for reference, error in zip(x, 1e-7 * np.cos(np.arange(9)), strict=True):
        places.places.append(Place(reference, mean_of(10.0 * (reference + error) + 1e-6 * np.sin(np.arange(99))), 20.0))
    calibration = calibrate(places, Channel("lvdt", "V", 1e-7), None)
    ident = Ident("1.0", 1, {}, (), (), {})
    return gauge_page(
        calibration, GaugeOptions("lvdt", instrument=LONG), ident, {"channels": [], "magnetostrictive": {}}
    )


def validation():
    """The page of ``truearm validate`` with lengths and angles, in all four parts of the space."""
    figures = {
        f"{name}_{when}_{unit}": 0.1234
        for name in ("rms", "mean", "max")
        for when in ("before", "after")
        for unit in ("mm", "deg")
    }
    numbers = {**figures, "n_mm": 120, "n_deg": 120, "rms_expected_mm": 0.1, "rms_expected_deg": None}
    parts = [f"radius {sign} 644 mm, z {other} 17 mm" for sign in "≤>" for other in "≤>"]
    document = {
        **numbers,
        **{"simulated": True, "without_rig": "rig.toml", "unseen": 0},
        **{"residual_units": ["mm", "deg"], "expected": None, "placed": True, "rms_raw_mm": 1.0, "rms_raw_deg": 0.1},
        **{"chi2_reduced": 1.1, "chi2_limit": 1.2, "faults": [], "copies": []},
        **{"settled": 21, "kept": 1, "left_out": 2, "regions": [{**numbers, "region": part} for part in parts]},
    }
    document |= {"rows": 120, "better": {"mm": True, "deg": True}, "consistent": True, "identified_from": [LONG]}
    findings = [*validation_findings(document), Finding("rig-missing", {"rig": LONG})]
    return validation_page("puma560", CERTIFICATE, {**document, "findings": entries(findings)}, LONG)


def program(n=30):
    """The report of ``truearm correct`` with straight moves and refused ones."""
    limit = {"limit_joint": 5, "limit_deg": 12.3, "singular_value": 0.12}
    moves = {"place": "line 1234, Target_120 in Path_10", "from": "line 1233", "deviation_mm": 0.123, "drivable": False}
    errors = {"shift_mm": 1.7, "shift_mrad": None, "error_before_mm": 2.0, "expected_mm": 0.1, "expected_mrad": None}
    targets = [
        {
            **{
                when: {f"{axis}_mm": 1e3 * k / n + by for axis in "xyz"}
                for when, by in (("before", 0.0), ("after", 1.0))
            },
            **{"place": moves["place"], **errors, **limit},
        }
        for k in range(n)
    ]
    statement = "MoveL Offs(Target_120, a, b, c), v1000, fine, tool\\WObj:=wobj0;"
    codes = [Finding("simulated"), Finding("range-unknown"), Finding("not-converged", {"message": LONG})]
    return correction_page.render(
        {
            **{"file": "welding_left.mod", "out": LONG, "result": LONG, "error_point": LONG, "robot": LONG},
            **{"base_frame": "base", "end_frame": "flange", "expected_relative_to": ["base", "tool"]},
            **{"unexplained_mm": 0.1, "unexplained_mrad": 0.0, "findings": entries(codes)},
            "refused": [
                {"file": "a.mod", "line": 1240, "statement": statement, "reason": "undeclared", "values": {"name": "a"}}
            ],
            "targets": targets,
            "moves": [{**moves, **limit}] * 5,
        }
    )


def map_(width=900.0, height=300.0):
    u, v = np.arange(0.0, width, 25.0), np.arange(0.0, height, 25.0)
    error = np.hypot(*np.meshgrid(u, v)) / 1e3
    cells = Cells(u, v, error, np.full_like(error, 0.1), error > 0.8 * error.max())
    return map_picture(cells, "Error of ur5e without calibration", (100.0, 400.0, 50.0, 250.0))


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """By name, the file of each kind of page."""
    folder = tmp_path_factory.mktemp("pages")
    made = {
        "report.html": render(replace(full_page(), scene=view())),
        "unusable.html": unusable(),
        "gauge.html": gauge(),
        "validation.html": validation(),
        "program.html": program(),
        "map.svg": map_(),
        "tall.svg": map_(60.0, 900.0),
        "flat.svg": map_(900.0, 20.0),
    }
    for name, text in made.items():
        (folder / name).write_text(text, encoding="utf-8")
    return {name: folder / name for name in made}


@needs_browser
@pytest.mark.parametrize("width", [1280, 1440, 1920])
def test_nothing_is_hidden_on_a_screen(pages, tmp_path, width):
    """No box scrolls or clips what it holds, and no label of a picture leaves it or covers another."""
    layouts = laid_out(tmp_path, pages, width)
    for name, layout in layouts.items():
        assert layout["hidden"] == [], name
        for drawing in layout["svgs"]:
            assert (drawing["cut"], drawing["over"]) == ([], []), name
    assert min(len(layouts[name]["svgs"]) for name in ("map.svg", "report.html", "program.html")) > 0


@needs_browser
def test_no_page_is_wider_than_a_phone(pages, tmp_path):
    assert {
        name: page["scroll"] for name, page in laid_out(tmp_path, pages, PHONE).items() if page["scroll"] > PHONE
    } == {}


@needs_printer
@pytest.mark.parametrize("name", ["report.html", "unusable.html", "gauge.html", "validation.html", "program.html"])
def test_everything_is_on_the_sheets_of_a4(pages, tmp_path, name):
    """All table heads and the whole command are printed within the margins, and no sheet but the last is half empty."""
    sheets = printed(tmp_path, pages[name])
    text = pages[name].read_text()
    words = {word.text for sheet in sheets for word in sheet}
    heads = [html.unescape(re.sub("<.*?>", "", head)) for head in re.findall(r"<th scope=\"col\">.*?</th>", text)]
    assert {word for head in heads for word in head.split()} <= words
    for word in (word for sheet in sheets for word in sheet):
        assert word.left >= MARGIN_PT - 1.0, word
        assert word.right <= A4_PT[0] - MARGIN_PT + 1.0, word
    for sheet in sheets[:-1]:
        assert max(word.bottom for word in sheet) > 0.6 * A4_PT[1]


# the report in a browser

# A browser's window is at least 500 px wide; a frame of any width is laid out as a window of that width. The page
# inside is the unchanged one; the script stands in the frame around it, since the page's own policy would stop it.
AROUND = """<!DOCTYPE html><meta name="color-scheme" content="light dark"><iframe id="page" width="WIDTH" height="900"
style="border:0" srcdoc="PAGE"></iframe><pre id="probe"></pre><script>PICTURES
onload = () => {
  const frame = document.getElementById('page'), w = frame.contentWindow, d = frame.contentDocument;
  const style = w.getComputedStyle(d.body), root = d.documentElement;
  document.getElementById('probe').textContent = JSON.stringify({inner: w.innerWidth, client: root.clientWidth,
    scroll: root.scrollWidth, paper: style.backgroundColor, ink: style.color,
    loaded: w.performance.getEntriesByType('resource').length, svgs: pictures(d)});
};
</script>"""


def look(page, folder, width, dark):
    """The page laid out by the browser: what the probe found."""
    around = (
        AROUND.replace("PICTURES", PICTURES).replace("WIDTH", str(width)).replace("PAGE", html.escape(render(page)))
    )
    return probed(folder, around, *(("--blink-settings=preferredColorScheme=0",) if dark else ()))


def luminance(colour):
    """Relative luminance of "rgb(r, g, b)" (WCAG 2)."""
    c = np.array([int(v) for v in re.findall(r"\d+", colour)[:3]]) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_everything_at_once_is_one_sound_page():
    text = render(full_page())
    parsed = Strict(text)
    words = " ".join(" ".join(parsed.text).split())
    assert len(drawings(text)) == len(parsed.all("figure"))
    for said in (full_page().findings[0].text(), "touched plane", "0.0640 mm"):
        assert said in words
    for title in parsed.all("table"):
        assert title["class"].split()[0] in ("plain", "numbers", "steps")
    heads = [html.unescape(t) for t in re.findall(r'<th scope="col">(.*?)</th>', text)]
    for head in heads:  # every column of numbers says its unit
        assert re.search(r"\[(mm|deg|σ|1)\]$", head) or head in UNITLESS, head
    assert "nan" not in re.sub(r"<style.*?</style>", "", text, flags=re.S).lower()


UNITLESS = {
    *("row", "rows"),  # names and counts
    *("before", "after"),  # the first column names the unit
    *("parameter", "nominal", "value", "change", "sigma", "unit"),  # a column names the unit
}


@needs_browser
@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, True)], ids=["light", "dark"])
def test_in_a_browser(tmp_path, width, dark):
    page = full_page()
    seen = look(page, tmp_path, width, dark)
    assert seen["inner"] == width
    assert seen["scroll"] <= seen["client"]  # the page itself never scrolls sideways
    assert seen["loaded"] == 0
    assert len(seen["svgs"]) == len(titles(render(replace(page, certificate=None))))
    assert len(seen["svgs"]) > 15
    for drawing in seen["svgs"]:
        assert drawing["width"] >= 280
        assert drawing["height"] >= 150
        assert drawing["texts"] >= 8
        assert drawing["cut"] == []  # no label leaves its picture
        assert drawing["over"] == []  # nor hides another
    paper, ink = luminance(seen["paper"]), luminance(seen["ink"])
    assert (paper < ink) == dark
    assert (max(paper, ink) + 0.05) / (min(paper, ink) + 0.05) >= 7.0  # WCAG 2 contrast, level AAA
