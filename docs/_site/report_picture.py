"""The picture of README.md: the top of the report of ``make demo``, photographed with Chromium."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "out" / "demo" / "report.html"
PICTURE = ROOT / "docs" / "images" / "report.png"
WIDTH, HEIGHT = 1180, 1490  # px: as far as the first row of figures
COLOURS = 128


def main() -> None:
    """Write the picture; without a report or a browser, print what is missing and keep the old one."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if not PAGE.exists() or browser is None:
        sys.exit(f"{PICTURE.name} stays as it is: it needs {'chromium' if PAGE.exists() else 'make demo'} first")
    with TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command += [f"--user-data-dir={folder}/profile", f"--window-size={WIDTH},{HEIGHT}", f"--screenshot={shot}"]
        subprocess.run([*command, PAGE.as_uri()], check=True, capture_output=True, timeout=120)
        with Image.open(shot) as image:
            image.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
