"""Report pages for tests: plausible calibrations, and a page as read by a parser."""

import html
import math
import re
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
from scipy import stats

from truearm.estimate.result_document import result_of
from truearm.estimate.result_file import Input, RobotFrames
from truearm.findings import Finding, entries
from truearm.kinds import NAMES
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.report import calibration_page
from truearm.report.figures import rows_by_kind
from truearm.report.page import MOST, Certificate, Points, Recording, Scene, facts_of, sensor_facts, shortened
from truearm.results import Estimate, Figures, HeldOut, NullDirection, PredictedError
from truearm.workflows.report import ALWAYS_EXCLUDED

SIGMA = 0.084e-3  # m, the paper's residual
HOSTILE = "<script>alert(1)</script>\"'&"
LINK = ("x", "y", "z", "alpha", "beta", "gamma")


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def held_out(residual):
    return HeldOut({"m": Figures.of(residual)}, residual.size) if residual.size else None


def puma_names():
    """Return 54 names in the order of Table II: seven links, six joints."""
    names = [f"link1.{k}" for k in LINK]
    for i in range(1, 7):
        names += [f"joint{i}.offset", f"joint{i}.gain", *(f"link{i + 1}.{k}" for k in LINK)]
    return tuple(names)


def unit(name):
    return {"gain": "1", "x": "m", "y": "m", "z": "m"}.get(name.rpartition(".")[2], "rad")


@dataclass(frozen=True)
class Page:
    """What a page is made from; ``longitude`` (n,) [rad] is that of the rows of ``table``."""

    estimate: Estimate
    table: ObservationTable
    longitude: np.ndarray
    title: str = "puma560"
    subtitle: str = "poses.csv"
    facts: tuple = ()
    command: str = ""
    predicted: PredictedError | None = None
    certificate: Certificate | None = None
    findings: tuple = ()
    scene: Scene | None = None

    @property
    def document(self):
        """The content of result.json."""
        robot = RobotFrames(self.title, "base", "tool", ("rad",) * 6)
        inputs = (Input("observations", self.subtitle, ""),)
        document = result_of(self.estimate, self.table, robot, self.predicted, inputs=inputs).document
        return {**document, "findings": entries(self.findings)}


def render(page):
    """Return the page as HTML text."""
    rows = rows_by_kind(page.estimate, page.table, page.longitude)
    return calibration_page.render(page.document, rows, (), page.facts, page.command, page.certificate, page.scene)


def make_page(n=1600, kind="ball_bar", seed=0, **changes):
    """Return a plausible calibration: 54 parameters, 36 free, half of the rows held out."""
    rng = np.random.default_rng(seed)
    names = puma_names()
    free = np.zeros(54, dtype=bool)
    free[rng.permutation(54)[:36]] = True
    root = rng.standard_normal((200, 36))
    covariance = np.zeros((54, 54))
    covariance[np.ix_(free, free)] = 1e-8 * np.linalg.inv(root.T @ root)
    nominal = np.round(rng.uniform(-1, 1, 54), 3)
    change = np.where(free, 1e-3 * rng.standard_normal(54), 0.0)
    signed = kinds()[kind].components.count("m") == 1
    residual = SIGMA * (rng.standard_normal(n) if signed else stats.maxwell.rvs(size=n, random_state=rng))
    before = 100.0 * residual
    fitted = np.arange(n) < (n + 1) // 2
    estimate = Estimate(
        status="converged",
        message="",
        solver="lm",
        iterations=4,
        parameter_names=names,
        units=tuple(map(unit, names)),
        nominal=nominal,
        value=nominal + change,
        sigma=np.where(free, np.sqrt(np.diag(covariance)), np.nan),
        free=free,
        identifiable=free.copy(),
        covariance=covariance,
        n_robot_parameters=54,
        n_observations=int(fitted.sum()),
        rank=36,
        rank_gap=math.inf,
        null_space=(),
        rms_before={"m": rms(before[fitted])},
        rms_after={"m": rms(residual[fitted])},
        rms_history={"m": (1e-2, 2e-4, 8.3e-5, 8.2e-5)},
        chi2_reduced=0.98,
        held_out=held_out(residual[~fitted]),
        held_out_before=held_out(before[~fitted]),
        residual={"m": residual},
        residual_before={"m": before},
        fitted=fitted,
        seconds=0.4,
    )
    index = np.arange(n)
    if kind == "ball_bar":
        chuck, sphere = np.array(["c1", "c2", "c3"])[index % 3], np.array(["s1", "s2", "s3"])[index // 3 % 3]
        names = {"chuck": chuck, "sphere": sphere}
    else:
        column = {"seat": "place", "line": "line", "position": "tracker", "pose": "tracker", "plane": "plane"}[kind]
        names = {column: np.array(["front", "left", "right"])[index % 3]}
    names |= {"bar": "b46", "shell": "b46-c1", "source": [f"session.mcap dwell {i}" for i in range(n)]}
    table = ObservationTable(q=np.zeros((n, 6)), kind=kind, value=0.46, **names)
    page = Page(
        estimate=estimate,
        table=table,
        longitude=rng.uniform(-np.pi, np.pi, n) if kind == "ball_bar" else np.full(n, np.nan),
        facts=(("dwells", str(n)), ("samples lost", "0")),
        command="truearm identify session.mcap",
    )
    return replace(page, **changes)


class Strict(HTMLParser):
    """Collects elements and text; raises an error if tags do not nest."""

    VOID = frozenset({"meta", "br"})

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.elements, self.text = [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "title"):
            self.text.append(data)

    def all(self, tag):
        return [attrs for name, attrs in self.elements if name == tag]


def with_rotation(estimate, angle):
    """Return the estimate with residuals (n,) in rad added; they are a tenth of their values before."""
    fitted = angle[estimate.fitted]
    return replace(
        estimate,
        residual={**estimate.residual, "rad": angle},
        residual_before={**estimate.residual_before, "rad": 10.0 * angle},
        rms_before={**estimate.rms_before, "rad": 10.0 * Figures.of(fitted).rms},
        rms_after={**estimate.rms_after, "rad": Figures.of(fitted).rms},
        rms_history={**estimate.rms_history, "rad": (2e-3, Figures.of(fitted).rms)},
    )


def drawings(text):
    """Return the SVG elements, each read by an XML parser."""
    return [ElementTree.fromstring(part) for part in re.findall(r"<svg.*?</svg>", text, re.S)]


def titles(text):
    return re.findall(r"<h3>(.*?)</h3>", text)


def both(a, b):
    """Return one page with the rows of both, and the parameters of the first."""

    def joined(x, y):
        return np.concatenate([x, y])

    table = ObservationTable.joined([a.table, b.table])
    changed = ("fitted", "suspect", "distance", "weight")
    rows = {k: joined(getattr(a.estimate, k), getattr(b.estimate, k)) for k in changed}
    for k in ("residual", "residual_before"):
        mine, others = getattr(a.estimate, k), getattr(b.estimate, k)
        gap = {id(of): np.full(len(page.table), np.nan) for of, page in ((mine, a), (others, b))}
        rows[k] = {
            si: joined(mine.get(si, gap[id(mine)]), others.get(si, gap[id(others)])) for si in {**mine, **others}
        }
    estimate, longitude = replace(a.estimate, **rows), joined(a.longitude, b.longitude)
    return replace(a, table=table, estimate=estimate, longitude=longitude)


def cells_of(text, label):
    """Return the header and the rows of each table with that label, as text."""
    tables = re.findall(rf'aria-label="{label}"><table.*?</table>', text, re.S)
    rows = (re.findall(r"<tr.*?</tr>", table, re.S) for table in tables)
    cell = r"<t[hd][^>]*>(.*?)</t[hd]>"
    return [[[html.unescape(text).strip() for text in re.findall(cell, row)] for row in table] for table in rows]


RECORDINGS = tuple(
    Recording(
        f"monday{i}.mcap",
        "2026-01-01 12:00 UTC",
        (
            ("begun", "2026-01-01 12:00 UTC"),
            ("box", "e6614103e7452b2f, firmware 0.4.0"),
            ("dwells", "400, of these rejected: 13 no plan match, 2 moved"),
            ("stops for mounting", "24"),
            ("passes along lines", "4"),
            ("samples", "1,234,567 received, 12 lost; 3 frames lost"),
            ("error of the box's clock, at most", "304 µs"),
            ("temperature of the box", "20.0 to 23.0 °C"),
            ("temperature of the bar", "20.0 to 21.0 °C"),
        ),
        (
            (
                "sensor lvdt",
                f"serial serial{i}, calibrated 2026-01-01, at 23.4 °C, residuals of 1.2 µm, against a reference",
            ),
        ),
        12,
        (("box", 20.0, 23.0), ("bar", 20.0, 21.0)),
    )
    for i in range(9)
)
CERTIFICATE = Certificate(
    "Certificate of calibration",
    (
        (
            "What",
            (("arm", "cell 3, " + "a long name " * 8), *((f"label {i}", "a value of some length") for i in range(11))),
        ),
        (
            "Error of the tool in the measured region",
            (
                ("before", "2.65 mm RMS"),
                ("after (k = 2)", "0.214 mm"),
                ("measured region", "400 rows, " + "x 474 to 626 mm, " * 4),
            ),
        ),
        (
            "Observations and independent validation",
            (("800 fitted, RMS", "1.90 mm before, 0.0855 mm after"), ("800 held out (bar=bar61)", "0.0855 mm RMS")),
        ),
        (
            "Reference",
            (
                *((f"ball-bar b{i}", "460.000 mm at 20 °C, ± 0.050 mm (k = 2)") for i in range(MOST)),
                *sensor_facts(RECORDINGS),
            ),
        ),
        ("Conditions", facts_of(RECORDINGS[:1])),
        (
            "Method",
            (
                ("solver", "lm, linear loss, prior where-needed, joint laws none"),
                ("parameters", "54 free, 36 independent combinations identified"),
            ),
        ),
        (
            "Files read",
            shortened(tuple((f"observations: monday{i}.mcap", f"SHA-256 {f'{i}' * 64}") for i in range(12))),
        ),
    ),
    (
        Finding("certified", {"error": {"mm": 0.214}, "tolerance": {"mm": 0.3}, "rows": None}),
        *ALWAYS_EXCLUDED,
        Finding("excludes-lengths", {"bars": ["b46", "b61", "b92"]}),
        *map(Finding, ("excludes-displacement", "excludes-other-poses", "excludes-directions")),
    ),
)


def view(n=30):
    """Return a 3-D view of two joints, with a value missing."""
    rng = np.random.default_rng(0)
    gap = 1e-3 * rng.standard_normal((n, 3))
    value = np.where(np.arange(n) == 3, np.nan, np.linalg.norm(gap, axis=1))
    points = Points(
        "measured poses",
        rng.uniform(0.2, 0.8, (n, 3)),
        rng.uniform(-1.0, 1.0, (n, 2)),
        ["a long name " * 6] * n,
        {"residual after": value, "error before": 10.0 * value},
        {"error before": 10.0 * gap, "residual after": np.where(np.isnan(value)[:, None], np.nan, gap)},
        [0] * n,
    )
    joints = np.array([[1, 0, 0, 0.3, 0, 0, 1], [0, 0.3, 0, 0.3, 0, 1, 0]])
    links = np.array([[0, 0, 0, 0, 0, 0, 0.3, 0.06], [1, 0, 0, 0.3, 0.3, 0, 0.3, 0.05]])
    return Scene(
        "two joints",
        "Error before: the nominal robot's. " * 4,
        joints,
        links,
        links[1:],
        {"chuck.c1": np.ones(3)},
        (points,),
    )


def full_page():
    """Return a page with all possible content: all kinds, two rigs, suspects, wrong labels, proposals."""
    page = make_page(300)
    for seed, kind in enumerate(NAMES):
        if kind != "ball_bar":
            page = both(page, make_page(60, kind, seed=seed))
    n, e = len(page.table), page.estimate
    index = np.arange(n)
    if "pose" in page.table.kind:
        e = with_rotation(e, np.where(page.table.kind == "pose", 1e-4 * (1 + index % 7), np.nan))
    estimate = replace(
        e,
        suspect=index % 50 == 3,
        distance=np.full(n, 6.5),
        weight=np.where(index % 100 == 3, 0.0, 1.0),
        chi2_band=(0.9, 1.1),
        null_space=(NullDirection(("link1.x", "link2.x"), (1.0, -1.0)),),
        hardly_seen=(NullDirection(("link2.z",), (1.0,)),),
    )
    return replace(
        page,
        estimate=estimate,
        table=replace(page.table, rig=np.where(index % 2 == 0, "monday", "tuesday")),
        findings=(
            Finding("wrong-inputs", {"after": {"mm": 43.0}, "large": False}),
            Finding(
                "wrong-constant",
                {
                    "lead": "This explains the observations",
                    "item": "bar.b46.zero",
                    "off": "0.430 mm ± 0.012",
                    "apply": "bar.b46.zero",
                    "with_change": {"mm": 0.084},
                    "as_given": {"mm": 43.0},
                },
            ),
            Finding(
                "tool-error",
                {
                    **{"rms": {"mm": 0.064}, "largest": {"mm": 0.112}, "n": 20, "relative": True, "row": "y.csv row 7"},
                    **dict.fromkeys(("parameters", "unnamed", "scatter", "faults", "names")),
                },
            ),
            Finding("no-law", {"tried": 0, "none": True}),
        ),
        predicted=PredictedError(6.4e-5, 1.12e-4, "y.csv row 7", 20, True),
        certificate=CERTIFICATE,
    )
