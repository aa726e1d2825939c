"""A browser for tests: how wide pages are laid out, and what they print on A4.

python -m tests.host.browser     fetches what this computer lacks into build/browser
"""

import html
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from truearm_sim import debian

FOLDER = Path(__file__).parents[2] / "build" / "browser"
PACKAGES = ("chromium-headless-shell", "chromium-common", "fonts-dejavu-core", "poppler-utils")
UNPACKED = FOLDER / "root" / "usr"
ENVIRON = {**os.environ}
NAMES = ["chromium", "chromium-browser", "google-chrome"]
if debian.is_fetched(FOLDER, PACKAGES):
    fonts = {"FONTCONFIG_PATH": str(FOLDER / "root" / "etc" / "fonts"), "XDG_DATA_HOME": str(UNPACKED / "share")}
    ENVIRON = debian.environment(FOLDER) | fonts
    NAMES = [str(UNPACKED / "lib" / "chromium" / "chromium-headless-shell")]
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
PDFTOTEXT = shutil.which("pdftotext", path=ENVIRON["PATH"])
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no browser: make browser-if-possible, or install chromium")
needs_printer = pytest.mark.skipif(
    None in (CHROMIUM, PDFTOTEXT),
    reason="no browser or no PDF reader: make browser-if-possible, or install chromium and poppler-utils",
)
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
READING_FILES = "--allow-file-access-from-files"  # a page around others can read how they are laid out
A4_PT = (595.0, 842.0)
MARGIN_PT = 14.0 / 25.4 * 72.0  # of page.css

# A browser's window is at least 500 px wide; a frame of any width is laid out as a window of that width.
_FRAMES = """<!DOCTYPE html>FRAMES<pre id="probe"></pre><script>PICTURES
onload = () => { document.getElementById('probe').textContent = JSON.stringify(
  [...document.querySelectorAll('iframe')].map(f => { const d = f.contentDocument, w = f.contentWindow;
    const clips = e => w.getComputedStyle(e).overflowX != 'visible' && e.scrollWidth > e.clientWidth + 1;
    return {scroll: d.documentElement.scrollWidth, svgs: pictures(d), hidden: [...d.querySelectorAll('body *')].filter(clips)
      .map(e => [e.tagName, e.className, e.scrollWidth, e.clientWidth, e.textContent.slice(0, 60)])}; })); };
</script>"""
# The pictures of a page: which labels leave their picture, and which cover each other.
PICTURES = """
const box = e => e.getBoundingClientRect();
const pictures = d => [...d.querySelectorAll('svg')].map(svg => {
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
});"""


def browse(folder: Path, *arguments: str) -> str:
    """Run the browser with a profile in ``folder``; return what it prints."""
    command = [CHROMIUM, *QUIET, f"--user-data-dir={folder / 'profile'}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, env=ENVIRON).stdout


def probed(folder: Path, around: str, *arguments: str):
    """Load a page that writes JSON into its element "probe"; return what it wrote."""
    path = folder / "around.html"
    path.write_text(around, encoding="utf-8")
    dom = browse(folder, READING_FILES, *arguments, "--window-size=1400,1000", "--dump-dom", path.as_uri())
    return json.loads(html.unescape(re.search(r'<pre id="probe">(.*?)</pre>', dom, re.S).group(1)))


def laid_out(folder: Path, pages: dict[str, Path], width: int) -> dict[str, dict]:
    """Return for each page in a window of ``width`` [px] its own width, the boxes that hide something, and its pictures."""
    frames = "".join(f'<iframe width="{width}" height="900" src="{path.as_uri()}"></iframe>' for path in pages.values())
    page = _FRAMES.replace("PICTURES", PICTURES).replace("FRAMES", frames)
    return dict(zip(pages, probed(folder, page), strict=True))


@dataclass(frozen=True)
class Word:
    """A printed word and its box on the sheet [pt]."""

    text: str
    left: float
    top: float
    right: float
    bottom: float


def printed(folder: Path, page: Path) -> list[list[Word]]:
    """Print a page to PDF; return the words of each sheet."""
    pdf = folder / "printed.pdf"
    browse(folder, "--no-pdf-header-footer", f"--print-to-pdf={pdf}", page.as_uri())
    command = [PDFTOTEXT, "-bbox", pdf, "-"]
    boxes = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True, env=ENVIRON)
    sheets = []
    for sheet in re.findall(r"<page (.*?)</page>", boxes.stdout, re.S):
        size = re.match(r'width="([\d.]+)" height="([\d.]+)"', sheet)
        assert (round(float(size[1])), round(float(size[2]))) == A4_PT
        box = r'<word xMin="([-\d.]+)" yMin="([-\d.]+)" xMax="([-\d.]+)" yMax="([-\d.]+)">(.*?)</word>'
        sheets.append([Word(html.unescape(w[4]), *map(float, w[:4])) for w in re.findall(box, sheet)])
    return sheets


def main() -> int:
    if CHROMIUM and PDFTOTEXT:
        return 0
    try:
        debian.fetch(FOLDER, PACKAGES, lambda text: print(f"browser: {text}", flush=True))
    except debian.DebianError as error:
        print(f"error: no browser: {error}", file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
