"""The documentation site as a browser shows it from the disk."""

import re
import subprocess
import sys
from pathlib import Path

from tests.host.browser import browse, needs_browser

ROOT = Path(__file__).resolve().parents[2]


@needs_browser
def test_the_search_works_from_the_disk(tmp_path):
    """Without a server a browser starts no worker and reads no JSON, so that needs a script of ours."""
    site = tmp_path / "site"
    build = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(site)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=120)
    home = (site / "index.html").as_uri()
    found = browse(tmp_path, "--virtual-time-budget=8000", "--dump-dom", f"{home}?q=PNP")
    first = re.search(r'<a href="([^"?]+)[^>]*class="md-search-result__link"', found)
    assert first is not None, "no result"
    assert first[1] == (site / "how-to/wire-a-trigger.html").as_uri()
    loaded = re.findall(
        r'<(?:script|img|link)\b[^>]*"https?://[^"]*', (site / "index.html").read_text(encoding="utf-8")
    )
    assert loaded == []
