"""The recipes of docs/how-to/extending.md: their code blocks applied to a copy of the package."""

import difflib
import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "how-to" / "extending.md"
FILE = re.compile(r"^New file `([^`]+)`:\n\n```\w*\n(.*?)^```$", re.M | re.S)
COPY = re.compile(r"^Copy `([^`]+)` to `([^`]+)`, with `([^`]+)` in place of `([^`]+)`\.$", re.M)
LINE = re.compile(r"^New lines? in `([^`]+)`, after `([^`]+)`:\n\n```\w*\n(.*?)^```$", re.M | re.S)
TEXT = re.compile(r"^In `([^`]+)`, `([^`]+)` becomes `([^`]+)`\.$", re.M)
# Compiled files are copied too: with the sources' times they stay valid, and nothing is compiled again. A file that
# another process is writing has a number behind its name.
NOISE = shutil.ignore_patterns("*.pyc.*", "*.egg-info")
# Commands that need no separate process share one, which imports everything once.
ALL_IN_ONE = """
import contextlib, io, json, sys
from truearm.cli.main import main
said = []
for command in json.load(sys.stdin):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(command)
    said.append([code, out.getvalue(), err.getvalue()])
json.dump(said, sys.stdout)
"""


def new_files(text: str) -> list[tuple[str, str]]:
    """Return path and content of each file that a part of the page adds: written there, or a copy with one change."""
    copies = [
        (path, (ROOT / source).read_text(encoding="utf-8").replace(before, after))
        for source, path, after, before in COPY.findall(text)
    ]
    return FILE.findall(text) + copies


class Said(NamedTuple):
    """The exit code and output of a command."""

    code: int
    out: str
    err: str


def findings(text: str) -> dict[str, dict[str, object]]:
    """Return the values of the findings by code that a command printed with --json; those of its error."""
    document = json.loads(text)
    entries = [document["error"]] if "error" in document else document["findings"]
    return {entry["code"]: entry["values"] for entry in entries}


class Copy:
    """A copy of the package in a folder, in which commands run; ``parts``: its folders of the repository, all imported."""

    def __init__(self, folder: Path, parts: tuple[str, ...] = ("host",)) -> None:
        self.folder = folder
        self.parts = parts
        self.paths = [folder / part for part in parts]
        for part in parts:
            shutil.copytree(ROOT / part, folder / part, ignore=NOISE)

    def apply(self, recipe: str) -> None:
        """Apply the code blocks below a heading of the page."""
        text = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.M)
        (section,) = (part for part in text if part.startswith(f"{recipe}\n"))
        for path, content in new_files(section):
            assert not (self.folder / path).exists()
            (self.folder / path).write_text(content, encoding="utf-8")
        for path, before, content in LINE.findall(section):
            self.replace(path, f"{before}\n", f"{before}\n{content}")
        for path, before, after in TEXT.findall(section):
            self.replace(path, before, after)

    def changes(self) -> dict[str, str]:
        """Return files that differ from the repository's: "new file", or the numbers of added and removed lines."""
        found = {}
        for path in sorted(p for part in self.parts for p in (self.folder / part).rglob("*")):
            name = path.relative_to(self.folder).as_posix()
            if path.is_dir() or path.suffix == ".pyc":
                continue
            if not (ROOT / name).exists():
                found[name] = "new file"
            elif path.read_bytes() != (ROOT / name).read_bytes():
                before, after = (
                    (base / name).read_text("utf-8", "replace").splitlines() for base in (ROOT, self.folder)
                )
                signs = Counter(line[0] for line in list(difflib.unified_diff(before, after, n=0))[2:])
                found[name] = f"+{signs['+']} -{signs['-']}"
        return found

    def run_each(self, *commands: tuple[str, ...]) -> list[Said]:
        """Return what several commands of truearm print, in one process."""
        done = self.python("-c", ALL_IN_ONE, text=json.dumps(commands))
        return [Said(*each) for each in json.loads(done.out)]

    def python(self, *arguments: str, text: str = "", code: int = 0) -> Said:
        """Return the output of a Python that imports the copy."""
        paths = os.pathsep.join(map(str, self.paths))
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": paths, "PYTHONWARNINGS": "error::RuntimeWarning"},
            input=text,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == code, done.stderr
        return Said(done.returncode, done.stdout, done.stderr)

    def replace(self, path: str, before: str, after: str) -> None:
        """Replace a text that occurs once in a file."""
        source = (self.folder / path).read_text(encoding="utf-8")
        assert source.count(before) == 1, f"{path} has {before!r} {source.count(before)} times"
        (self.folder / path).write_text(source.replace(before, after), encoding="utf-8")
