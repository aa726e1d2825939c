"""The report page with all its sections, read by a parser and a browser."""

import html
import re
from dataclasses import replace

import numpy as np
import pytest
from browser import PICTURES, needs_browser, probed
from report_bench import Strict, drawings, full_page, render, titles

# --- the page in a browser

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
