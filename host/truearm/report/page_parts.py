"""The parts of every page: its frame, sections, tables and pictures.

A page is a single HTML file: style and pictures are included, and a Content-Security-Policy prevents the browser from
loading anything and from running any script but that of its 3-D view (report/scene_view.py). It opens from disk without a network, follows the reader's light or dark
setting, can be printed, and fits a phone.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Sequence
from importlib.resources import files

from truearm.finding_texts import Severity
from truearm.findings import Finding, option
from truearm.report.figures import Figure
from truearm.report.page_text import ABSENT, escape

POLICY = "default-src 'none'; style-src 'unsafe-inline'"
GENERATOR = '<meta name="generator" content="truearm">'  # identifies a page written by truearm


def html_page(
    program: str, title: str, subtitle: str, sections: Iterable[str], watermark: str = "", script: str = ""
) -> str:
    """Return a complete page as HTML text, to be written as UTF-8.

    ``program`` is shown above its title. ``watermark`` is a word across each page, on screen and on paper. ``script`` runs
    when all of the page has been read.
    """
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"{POLICY}; script-src 'sha256-{digest}'" if script else POLICY
    run = f"<script>{script}</script>\n" if script else ""
    across = f'<p class="watermark" aria-hidden="true">{escape(watermark)}</p>\n' if watermark else ""
    style = files("truearm.report").joinpath("page.css").read_text(encoding="utf-8")
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n{GENERATOR}\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n{across}"
        f'<header><p class="brand">{program}</p><h1>{escape(title)}</h1>'
        f'<p class="subtitle">{escape(subtitle, 400)}</p></header>\n'
        f"<main>\n{''.join(sections)}</main>\n{run}</body>\n</html>\n"
    )


def section(title: str, content: str) -> str:
    """Return a section of a page; ``title`` and ``content`` are HTML."""
    return f"<section><h2>{title}</h2>{content}</section>\n"


def sentences(texts: Iterable[str], css: str, limit: int = 600) -> str:
    """Return a list of sentences, each cut at ``limit``; "" if there are none."""
    items = "".join(f"<li>{escape(text, limit)}</li>" for text in texts)
    return f'<ul class="{css}">{items}</ul>' if items else ""


def finding_parts(findings: Sequence[Finding]) -> tuple[str, str, str]:
    """Return the verdict as a heading, what to look at and to do, and notes, as HTML; a watermark tells that data are simulated."""
    first, *others = [finding for finding in findings if finding.code != "simulated"]

    def listed(css: str, *severities: Severity) -> str:
        return sentences((finding.text(option) for finding in others if finding.severity in severities), css, 1200)

    doubts = listed("remarks doubts", Severity.REFUSAL, Severity.WARNING) + listed("remarks", Severity.ADVICE)
    heading = f'<h2 class="verdict">{escape(first.text(option), 1200)}</h2>'
    return heading, doubts, listed("remarks", Severity.RESULT, Severity.NOTE)


def tiles(entries: Iterable[tuple[str, str, Iterable[tuple[str, str]], str]]) -> str:
    """Return figures in large type: class, name, value and unit of each figure, and a note."""
    return f'<div class="tiles">{"".join(_tile(*entry) for entry in entries)}</div>'


def _tile(css: str, name: str, sizes: Iterable[tuple[str, str]], note: str) -> str:
    units = [(value, "" if value == ABSENT else unit) for value, unit in sizes]
    shown = "".join(f'<p class="figure">{value}<span> {unit}</span></p>' for value, unit in units)
    return f'<div class="tile {css}"><p class="name">{name}</p>{shown}<p class="small">{escape(note)}</p></div>'


def command_block(command: str) -> str:
    """Return the command that makes a page again; "" if there is none."""
    return f'<pre tabindex="0"><code>{escape(command, 2000)}</code></pre>' if command else ""


def head_of(titles: Sequence[str]) -> str:
    """Return the head of a table."""
    return "<thead><tr>" + "".join(f'<th scope="col">{title}</th>' for title in titles) + "</tr></thead>"


def row_of(cells: Sequence[str]) -> str:
    """Return a row of a table; the first cell names it."""
    first, *rest = cells
    return f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in rest)}</tr>'


def table_of(titles: Sequence[str], rows: Iterable[Sequence[str]], label: str, css: str = "plain") -> str:
    """Return a table that scrolls on a phone. Its cells are HTML; the first column names the row."""
    return table(titles, "".join(map(row_of, rows)), label, css)


def table(titles: Sequence[str], body: str, label: str, css: str = "plain") -> str:
    """Return a table that scrolls on a phone, with rows that are HTML."""
    return scrolled(f'<table class="{css}">{head_of(titles)}<tbody>{body}</tbody></table>', label)


def scrolled(content: str, label: str) -> str:
    """Return content that may be wider than a phone, in a separately scrolling part that the keyboard can reach."""
    return f'<div class="scroll" tabindex="0" role="region" aria-label="{label}">{content}</div>'


def picture(figure: Figure, kind: str = "") -> str:
    """Return a picture with title and caption; ``kind`` is added to its title if there are several."""
    title = escape(figure.title + (f" · {kind}" if kind else ""))
    drawing = scrolled(figure.drawing, title) if figure.wide else figure.drawing
    caption = f"<figcaption>{escape(figure.caption, 800)}</figcaption>"
    css = ' class="wide"' if figure.wide else ""
    return f"<figure{css}><h3>{title}</h3>{drawing}{caption}</figure>\n"


def pictures(shown: Iterable[str]) -> str:
    """Return several pictures side by side where there is space; "" if there are none."""
    content = "".join(shown)
    return f'<div class="pictures">{content}</div>' if content else ""


def fact_list(facts: Sequence[tuple[str, str]]) -> str:
    """Return labels and values as a definition list."""
    entries = (f"<div><dt>{escape(name)}</dt><dd>{escape(value, 400)}</dd></div>" for name, value in facts)
    return f'<dl class="facts">{"".join(entries)}</dl>'
