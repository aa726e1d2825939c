"""The documentation site as a browser shows it from the disk."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.host.browser import browse, needs_browser

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Return the site's folder, and how `make docs` ended."""
    site = tmp_path_factory.mktemp("docs") / "site"
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]  # --quiet counts no warning
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    return site, subprocess.run(build, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)


def test_every_link_within_the_site_leads_somewhere(built):
    site, done = built
    assert done.returncode == 0, done.stdout + done.stderr
    assert (site / "external-links.txt").stat().st_size > 0


@needs_browser
def test_the_search_works_from_the_disk(built, tmp_path):
    """Without a server a browser starts no worker and reads no JSON, so that needs a script of ours."""
    site, _ = built
    home = (site / "index.html").as_uri()
    found = browse(tmp_path, "--virtual-time-budget=8000", "--dump-dom", f"{home}?q=PNP")
    first = re.search(r'<a href="([^"?]+)[^>]*class="md-search-result__link"', found)
    assert first is not None, "no result"
    assert first[1] == (site / "how-to/wire-a-trigger.html").as_uri()
    loaded = re.findall(
        r'<(?:script|img|link)\b[^>]*"https?://[^"]*', (site / "index.html").read_text(encoding="utf-8")
    )
    assert loaded == []
