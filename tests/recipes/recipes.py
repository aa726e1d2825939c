"""The recipes of docs/extending.md: their code blocks applied to a copy of the package."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "extending.md"
FILE = re.compile(r"^New file `([^`]+)`:\n\n```\w*\n(.*?)^```$", re.M | re.S)
LINE = re.compile(r"^New line in `([^`]+)`, after `([^`]+)`:\n\n```\w*\n(.*?)^```$", re.M | re.S)


class Copy:
    """A copy of the package in a folder, in which commands run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        shutil.copytree(ROOT / "host", folder / "host", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))

    def apply(self, recipe: str) -> list[str]:
        """Apply the code blocks below a heading of the page; the files that are new or changed."""
        text = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.M)
        (section,) = (part for part in text if part.startswith(f"{recipe}\n"))
        for path, content in FILE.findall(section):
            assert not (self.folder / path).exists()
            (self.folder / path).write_text(content, encoding="utf-8")
        for path, before, content in LINE.findall(section):
            source = (self.folder / path).read_text(encoding="utf-8")
            assert source.count(f"{before}\n") == 1
            (self.folder / path).write_text(source.replace(f"{before}\n", f"{before}\n{content}"), encoding="utf-8")
        return [path for path, *_ in (*FILE.findall(section), *LINE.findall(section))]

    def run(self, *command: str, code: int = 0) -> str:
        """What truearm prints; errors too where it is to end with another code than 0."""
        environment = {**os.environ, "PYTHONPATH": str(self.folder / "host"), "PYTHONWARNINGS": "error::RuntimeWarning"}
        done = subprocess.run(
            [sys.executable, "-m", "truearm", *command],
            cwd=self.folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == code, done.stderr
        return done.stdout if code == 0 else done.stderr
