"""Pages: a list of blocks in one frame, with a certificate as page one and a 3-D view.

A block is HTML, made here of plain text: a heading, sentences, facts, a table, a picture, what findings say. A page is
a single HTML file with style and pictures. A Content-Security-Policy prevents the browser from loading anything, and
from running any script but that of its 3-D view. It opens from disk without a network, follows the reader's light or
dark setting, can be printed, and fits a phone.

The 3-D view shows the arm, its fixtures, and points with error vectors. The page holds them as JSON and one script,
``view3d/bundle.js``, which only runs if its hash is that of the page's Content-Security-Policy. ``view3d/view.js`` is
its source. The view stays hidden without the script or without WebGL; the page's pictures stay for these and for paper.

The certificate says what was calibrated, against what, the errors, and what they do not include. It fits on a sheet of
A4: items that do not fit (many sensors, many files) are counted. ``workflows.report`` says what is in it.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.finding_texts import Severity
from truearm.findings import Finding, option
from truearm.report.tables import Table
from truearm.text import counted
from truearm.types import Floats
from truearm.units import DEGC, MM, SUFFIXES, shown, symbol

MOST_POINTS = 1000  # of a set: about 130 kB with vectors, joints and names
LONGEST_NAME = 80
POLICY = ("default-src 'none'", "style-src 'unsafe-inline'")
GENERATOR = '<meta name="generator" content="truearm">'  # identifies a page written by truearm
ABSENT = "–"
MINUS = "\u2212"
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MOST = 4  # sensors, parts of the rig and files listed on page one
Facts = tuple[tuple[str, str], ...]  # labels and values
UNRECORDED = ("temperature", "not recorded")
SIGNATURE = "".join(f"<p>{field}</p>" for field in ("place, date", "name", "signature"))


@dataclass(frozen=True, eq=False)
class Points:
    """A set of n points to draw, each with the joints at which the arm reaches it.

    ``xyz`` (n, 3) [m] is in the base frame and ``q`` (n, j) [rad, m]. ``values`` (n,) [m] colour the points and
    ``vectors`` (n, 3) [m] start at them, by name; NaN where there is none. ``fixture`` (n,) is the index of the fixture
    that a bar connects the point to, -1 for none.
    """

    name: str
    xyz: Floats
    q: Floats
    labels: Sequence[str]
    values: Mapping[str, Floats]
    vectors: Mapping[str, Floats]
    fixture: Sequence[int] = ()

    @property
    def placed(self) -> NDArray[np.bool_]:
        """Return which points (n,) can be drawn: those with a position and joints."""
        return np.asarray(np.isfinite(np.column_stack([self.xyz, self.q])).all(axis=1))


@dataclass(frozen=True, eq=False)
class Scene:
    """The data of a view, in the base frame.

    ``joints`` (j, 7): 1 for a revolute joint, a point on its axis [m] and the axis's direction, with all joints at 0.
    ``links`` and ``tools`` (m, 8) are capsules there: the joint that each moves with (0: none), both ends and the
    radius [m]. ``fixtures`` are names and positions [m].
    """

    title: str
    caption: str
    joints: Floats
    links: Floats
    tools: Floats
    fixtures: Mapping[str, Floats]
    points: Sequence[Points]

    @property
    def is_empty(self) -> bool:
        """Return whether there is no point to draw."""
        return not self.points[0].placed.any()


COLOURS = ("val", "fit")  # of page.css: of the first vectors, those before, and of the second, those after


def view_section(scene: Scene | None) -> str:
    """Return the section of a page, to be shown by ``script()``; "" without anything to show."""
    if scene is None or scene.is_empty:
        return ""
    # No text can end the element: "<" is escaped. Everything that is not ASCII is too.
    data = json.dumps(_data(scene), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    shown = '<section id="view3d" hidden><h2>In the workspace</h2></section>\n'
    return f'{shown}<script type="application/json" id="scene">{data}</script>\n'


def script(scene: Scene | None) -> str:
    """Return the script of a page; "" without anything to show."""
    if scene is None or scene.is_empty:
        return ""
    return files("truearm.report").joinpath("view3d/bundle.js").read_text(encoding="ascii")


def _data(scene: Scene) -> dict[str, Any]:
    arm = {
        "joints": [["r" if row[0] else "t", *_rounded(row[1:])] for row in scene.joints],
        "links": [[int(row[0]), *_rounded(row[1:])] for row in scene.links],
        "tools": [[int(row[0]), *_rounded(row[1:])] for row in scene.tools],
    }
    fixtures = [
        {"name": name[:LONGEST_NAME], "xyz": _rounded(xyz), "post": "chuck." in name}
        for name, xyz in scene.fixtures.items()
    ]
    clouds = [_cloud(points) for points in scene.points]
    return {"title": scene.title, "caption": scene.caption, "arm": arm, "fixtures": fixtures, "clouds": clouds}


def _cloud(points: Points) -> dict[str, Any]:
    placed = points.placed
    return {
        "name": points.name,
        "points": _rounded(points.xyz[placed]),
        "q": _rounded(points.q[placed]),
        "labels": [label[:LONGEST_NAME] for label in compress(points.labels, placed)],
        "values": [{"name": name, "mm": _rounded(MM.of(value[placed]))} for name, value in points.values.items()],
        "vectors": [
            {"name": name, "colour": colour, "mm": _rounded(MM.of(vector[placed]))}
            for colour, (name, vector) in zip(COLOURS, points.vectors.items(), strict=False)
        ],
        "fixture": list(compress(points.fixture, placed)),
    }


def _rounded(values: Floats) -> list[Any]:
    """Return values to five decimals: 10 µm, 0.01 µm of an error; None where a value or a component is missing."""
    if values.ndim > 1:
        return [_rounded(row) if np.isfinite(row).all() else None for row in values]
    return [round(value, 5) if np.isfinite(value) else None for value in values.tolist()]


class Figure(NamedTuple):
    """A picture with its title and caption, both plain text."""

    title: str
    caption: str
    drawing: str
    wide: bool = False


def html_page(
    program: str,
    title: str,
    subtitle: str,
    blocks: Iterable[str],
    findings: Sequence[Finding] = (),
    *,
    figures: str = "",
    certificate: str = "",
    scene: Scene | None = None,
) -> str:
    """Return a complete page as HTML text, to be written as UTF-8.

    ``program`` is shown above its title. The ``certificate`` is page one; the verdict of the findings follows, with
    ``figures`` in large type and what to look at, then the 3-D view, notes, and the other blocks. If the findings tell
    that data are simulated, a watermark does on each page.
    """
    run = script(scene)
    digest = base64.b64encode(hashlib.sha256(run.encode()).digest()).decode()
    policy = "; ".join([*POLICY, *[f"script-src 'sha256-{digest}'"] * bool(run)])
    simulated = any(finding.code == "simulated" for finding in findings)
    title = escape(title + " (simulated)" * simulated)
    verdict, doubts, notes = finding_parts(findings)
    top = f"<section>{verdict}{figures}{doubts}</section>\n" if verdict or figures else ""
    body = "".join((certificate, top, view_section(scene), section("Notes", notes), *blocks))
    across = '<p class="watermark" aria-hidden="true">simulated</p>\n' * simulated
    style = files("truearm.report").joinpath("page.css").read_text(encoding="utf-8")
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n{GENERATOR}\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{title}</title>\n<style>\n{style}</style>\n</head>\n<body>\n{across}"
        f'<header><p class="brand">{program}</p><h1>{title}</h1><p class="subtitle">{escape(subtitle, 400)}</p></header>\n'
        f"<main>\n{body}</main>\n{f'<script>{run}</script>' * bool(run)}</body>\n</html>\n"
    )


def section(title: str, *blocks: str) -> str:
    """Return blocks below a heading; "" if all are empty."""
    content = "".join(blocks)
    return f"<section><h2>{escape(title)}</h2>{content}</section>\n" if content else ""


def paragraph(text: str, limit: int = 1200) -> str:
    """Return a paragraph."""
    return f"<p>{escape(text, limit)}</p>"


def folded(summary: str, *blocks: str) -> str:
    """Return blocks that a reader unfolds."""
    return f"<details><summary>{escape(summary)}</summary>{''.join(blocks)}</details>"


def sentences(texts: Iterable[str], css: str, limit: int = 600) -> str:
    """Return a list of sentences, each cut at ``limit``; "" if there are none."""
    items = "".join(f"<li>{escape(text, limit)}</li>" for text in texts)
    return f'<ul class="{css}">{items}</ul>' if items else ""


def finding_parts(findings: Sequence[Finding]) -> tuple[str, str, str]:
    """Return findings as HTML: the verdict as a heading, lists of doubts and of advice, and a list of notes."""
    stated = [finding for finding in findings if finding.code != "simulated"]

    def listed(css: str, *severities: Severity) -> str:
        return sentences((finding.text(option) for finding in stated[1:] if finding.severity in severities), css, 1200)

    heading = "".join(f'<h2 class="verdict">{escape(first.text(option), 1200)}</h2>' for first in stated[:1])
    doubts = listed("remarks doubts", Severity.REFUSAL, Severity.WARNING) + listed("remarks", Severity.ADVICE)
    return heading, doubts, listed("remarks", Severity.RESULT, Severity.NOTE)


Tile = tuple[str, str, Mapping[str, float], str]  # class, name, a quantity such as {"mm": 0.1}, note


def tiles(entries: Iterable[Tile]) -> str:
    """Return quantities in large type."""
    return f'<div class="tiles">{"".join(_tile(*entry) for entry in entries)}</div>'


def _tile(css: str, name: str, quantity: Mapping[str, float], note: str) -> str:
    units = ((value, SUFFIXES[suffix].symbol if math.isfinite(value) else "") for suffix, value in quantity.items())
    texts = "".join(f'<p class="figure">{figures(value)}<span> {unit}</span></p>' for value, unit in units)
    return f'<div class="tile {css}"><p class="name">{name}</p>{texts}<p class="small">{escape(note)}</p></div>'


def making(command: str, facts: Sequence[tuple[str, str]] = ()) -> str:
    """Return how a page was made: the command that makes it again, and facts."""
    block = f'<pre tabindex="0"><code>{escape(command, 2000)}</code></pre>' * bool(command)
    return section("How it was made", block, fact_list(facts))


def table(content: Table, css: str = "plain") -> str:
    """Return a table that scrolls on a phone.

    Its first column names the row, and ``content.marks`` are classes of rows.
    """
    head = "".join(f'<th scope="col">{escape(title.strip())}</th>' for title in content.titles)
    rows = []
    for k, (first, *cells) in enumerate(content.rows):
        mark = f' class="{content.marks[k]}"' if content.marks and content.marks[k] else ""
        data = "".join(f"<td>{escape(str(cell), 600)}</td>" for cell in cells)
        rows.append(f'<tr{mark}><th scope="row">{escape(str(first))}</th>{data}</tr>')
    body = f'<table class="{css}"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
    hidden = content.total - len(rows)
    return scrolled(body, content.label) + f"<p>and {hidden} more; the JSON document has all</p>" * (hidden > 0)


def scrolled(content: str, label: str) -> str:
    """Return content that may be wider than a phone, in a separately scrolling part that the keyboard can reach."""
    return f'<div class="scroll" tabindex="0" role="region" aria-label="{label}">{content}</div>'


def picture(figure: Figure) -> str:
    """Return a picture with title and caption."""
    title = escape(figure.title)
    drawing = scrolled(figure.drawing, title) if figure.wide else figure.drawing
    css = ' class="wide"' * figure.wide
    return f"<figure{css}><h3>{title}</h3>{drawing}<figcaption>{escape(figure.caption, 800)}</figcaption></figure>\n"


def pictures(figures: Iterable[Figure]) -> str:
    """Return several pictures side by side where there is space; "" if there are none."""
    content = "".join(map(picture, figures))
    return f'<div class="pictures">{content}</div>' if content else ""


def fact_list(facts: Sequence[tuple[str, str]]) -> str:
    """Return labels and values as a definition list; "" if there are none."""
    entries = (f"<div><dt>{escape(name)}</dt><dd>{escape(value, 400)}</dd></div>" for name, value in facts)
    return f'<dl class="facts">{"".join(entries)}</dl>' if facts else ""


# numbers and external strings as text


def escape(text: str, limit: int = 200) -> str:
    """Return ``text`` for HTML: markup escaped, unprintable characters replaced, cut at ``limit``.

    The replaced characters are control characters, marks that reverse the writing direction, and lone surrogates (from
    file names), which UTF-8 cannot hold.
    """
    short = text if len(text) <= limit else text[: limit - 1] + "…"
    return html.escape("".join(c if c.isprintable() else " " if c.isspace() else "\ufffd" for c in short))


def number(value: float, decimals: int, sign: bool = False) -> str:
    """Return a fixed number of decimals with a true minus, none before zero; a dash if the number does not exist."""
    if not math.isfinite(value):
        return ABSENT
    value = round(value, decimals) + 0.0  # no minus before a zero
    return f"{value:{'+' if sign and value else ''}.{decimals}f}".replace("-", MINUS)


def figures(value: float, count: int = 3) -> str:
    """Return ``count`` significant figures, with a power of ten below 1e-4 and from 1e6: 10.2, 0.0821, 2.8·10¹²."""
    if not math.isfinite(value):
        return ABSENT
    if value == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not -4 <= exponent < 6:
        mantissa = number(value / 10.0**exponent, count - 1)
        return f"{mantissa}·10{str(exponent).translate(SUPERSCRIPT)}"
    return number(value, max(count - 1 - exponent, 0))


def size(value: float, si: str, unit: str | None = None) -> str:
    """Return an SI value with three significant figures in its display unit; ``unit`` replaces the symbol after it."""
    if not math.isfinite(value):
        return ABSENT
    return f"{figures(shown(value, si))} {symbol(si) if unit is None else unit}".rstrip()


class Recording(NamedTuple):
    """How a session was recorded: its file, when in UTC ("" if unknown), and facts about it and the box's sensors.

    ``temperatures``: name, lowest and highest reading [°C] of each thermometer.
    """

    name: str
    begun: str
    facts: Facts
    sensors: Facts
    samples_lost: int
    temperatures: tuple[tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class Certificate:
    """The content of page one: groups of facts, and findings: the decision, then what the error does not include."""

    heading: str
    groups: tuple[tuple[str, Facts], ...]
    findings: tuple[Finding, ...] = ()


def facts_of(recordings: Sequence[Recording]) -> Facts:
    """Return labels and values of how sessions were recorded; of several, labels start with the session's name."""
    are_many = len(recordings) > 1
    return tuple(
        (f"{recording.name}: {label}" if are_many else label, value)
        for recording in recordings
        for label, value in recording.facts
    )


def conditions(recordings: Sequence[Recording]) -> Facts:
    """Return how the rows were recorded; what several sessions have of their own is on a later page."""
    if not recordings:
        return (("recording", "tables, which do not say how they were recorded"), UNRECORDED)
    if len(recordings) == 1:
        return facts_of(recordings)
    readings: dict[str, list[float]] = {}
    for name, *degc in (reading for recording in recordings for reading in recording.temperatures):
        readings.setdefault(name, []).extend(degc)
    temperatures = [(f"temperature of the {name}", between(min(degc), max(degc))) for name, degc in readings.items()]
    return (
        ("sessions", f"{len(recordings)}, listed under The recording"),
        ("samples lost", f"{sum(recording.samples_lost for recording in recordings):,}"),
        *(temperatures or [UNRECORDED]),
    )


def sensor_facts(recordings: Sequence[Recording]) -> Facts:
    """Return the sensors of the boxes with their calibrations."""
    sensors = tuple(dict.fromkeys(sensor for recording in recordings for sensor in recording.sensors))
    return shortened(sensors)


def shortened(facts: Facts) -> Facts:
    """Return at most MOST facts, and how many are not listed."""
    return facts[:MOST] + (("more", counted(len(facts) - MOST, "entry", "entries")),) * (len(facts) > MOST)


def recorded(recordings: Sequence[Recording]) -> str:
    """Return the days on which sessions were recorded."""
    days = sorted({recording.begun[:10] for recording in recordings if recording.begun})
    return " to ".join(dict.fromkeys((days[0], days[-1]))) if days else "not known"


def certificate_section(certificate: Certificate) -> str:
    """Return page one as HTML."""
    body = "".join(f"<h3>{escape(title)}</h3>{fact_list(facts)}" for title, facts in certificate.groups if facts)
    texts = [finding.text(option) for finding in certificate.findings]
    decision = "".join(f'<p class="decision">{escape(text, 400)}</p>' for text in texts[:1])
    excluded = f"<h3>Not included</h3>{sentences(texts[1:], 'excluded')}" if texts else ""
    return (
        f'<section class="certificate"><h2>{certificate.heading}</h2>{decision}{body}{excluded}'
        f'<div class="signature">{SIGNATURE}</div></section>\n'
    )


def between(lowest: float, highest: float) -> str:
    """Return a range of temperatures."""
    return f"{DEGC.of(lowest):.1f} to {DEGC.text(highest, '.1f')}"
