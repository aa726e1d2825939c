"""The tested content of a documentation page: its blocks of commands and of Python, in order, with their output.

- ``sh``: every line is run, `truearm` in this process; a ``text`` block directly after it contains printed lines, in this order. `…` stands
  for anything.
- ``python``: run, all of a page in one module.
- a block of any language with ``title="NAME"``: written to that file first.
- ``<!-- test: skip, REASON -->`` before a block: it is not run, but its commands are parsed. ``<!-- test: soak -->``: only
  by ``make soak``.
- ``<!-- test: setup`` (or ``setup soak``) … ``-->``: lines that are run and not shown; ``copy PATH [NAME]`` copies a file
  of the repository, ``tree PATH`` a folder, ``rows PATH PATTERN NAME`` the rows of a table that hold a text, ``cut NAME BYTES`` leaves only the beginning of a file.
- ``<!-- test: page skip, REASON -->``: no block of the page is run.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if "decisions" not in p.parts)]
_PART = re.compile(
    r"^<!-- test: (?P<mark>.*?)-->$|^(?P<indent> *)```(?P<language>\w+)(?P<info>[^\n]*)\n(?P<body>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """A block; ``shown`` are the output lines on the page, ``file`` the name to write it to, ``skip`` why it is not run."""

    language: str
    body: str
    line: int
    shown: tuple[str, ...] = ()
    file: str | None = None
    soak: bool = False
    skip: str = ""


def blocks(text: str) -> list[Block]:
    """Return the blocks of a page, without those of a page that is skipped. Raises ValueError for an unknown mark."""
    found: list[Block] = []
    mark, end = "", 0
    for part in _PART.finditer(text):
        line = text.count("\n", 0, part.start()) + 1
        if part["mark"] is not None:
            mark = part["mark"].strip()
            if mark.startswith("page skip, "):
                return []
            if mark.startswith(("setup\n", "setup soak\n")):
                first, _, body = mark.partition("\n")
                found.append(Block("setup", body, line, soak=first == "setup soak"))
                mark = ""
            elif not (mark == "soak" or mark.startswith("skip, ")):
                raise ValueError(f"line {line}: {mark}")
            continue
        body = re.sub(rf"^{part['indent']}", "", part["body"], flags=re.MULTILINE)
        title = re.search(r'title="([^"]+)"', part["info"])
        if mark.startswith("skip"):
            found.append(Block(part["language"], body, line, skip=mark.removeprefix("skip, ")))
        elif title:
            found.append(Block("file", body, line, file=title[1]))
        elif part["language"] in ("sh", "python"):
            found.append(Block(part["language"], body, line, soak=mark == "soak"))
        elif part["language"] == "text" and found and not found[-1].skip and not text[end : part.start()].strip():
            found[-1] = replace(found[-1], shown=tuple(body.splitlines()))
        mark, end = "", part.end()
    return found


def page_skip(text: str) -> str:
    """Return why no block of a page is run, "" if they are."""
    found = re.search(r"^<!-- test: page skip, (.*?) *-->$", text, re.MULTILINE)
    return found[1] if found else ""


def unprinted(shown: tuple[str, ...], printed: str) -> str | None:
    """Return the first shown line that was not printed after those before it."""
    lines = iter(printed.splitlines())
    for wanted in shown:
        pattern = re.compile(".*".join(re.escape(piece) for piece in wanted.strip().split("…")))
        if wanted.strip() and not any(pattern.fullmatch(line.strip()) for line in lines):
            return wanted
    return None
