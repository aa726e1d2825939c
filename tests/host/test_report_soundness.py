"""The report page remains valid with hostile names, extreme numbers and many rows."""

import math
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from report_bench import HOSTILE, Strict, both, drawings, make_page, render

from truearm.findings import Finding
from truearm.report.figures import figures_of
from truearm.report.residual_rows import rows_by_kind
from truearm.results import NullDirection


def test_names_from_files_stay_text():
    page = make_page(60)
    n, e = 60, page.estimate
    names = (HOSTILE, *e.parameter_names[1:])
    estimate = replace(
        e,
        parameter_names=names,
        message=HOSTILE,
        solver=HOSTILE,
        null_space=(NullDirection((HOSTILE,), (1.0,)),),
        free=np.ones(54, dtype=bool),
        identifiable=np.ones(54, dtype=bool),
        covariance=1e-8 * np.eye(54),
    )
    columns = {name: np.full(n, HOSTILE) for name in ("chuck", "shell", "source", "place")}
    columns["sphere"] = np.array([f"{HOSTILE}{i % 3}" for i in range(n)])
    page = replace(
        page,
        title=HOSTILE,
        subtitle=HOSTILE,
        estimate=estimate,
        table=replace(page.table, **columns),
        facts=((HOSTILE, HOSTILE),) * 2,
        command=HOSTILE,
        findings=(Finding("not-converged", {"message": HOSTILE}),),
    )
    text = render(page)
    parsed = Strict(text)
    assert not parsed.all("script")
    assert not [a for _, attrs in parsed.elements for a in attrs if a.startswith("on")]
    assert "".join(parsed.text).count("<script>alert(1)</script>") >= 10
    drawings(text)  # still XML
    text.encode("utf-8")


def test_nothing_is_loaded_from_anywhere():
    text = render(make_page())
    parsed = Strict(text)
    assert not [
        t for t, a in parsed.elements if {"src", "href", "xlink:href", "srcset"} & a.keys() or t in ("link", "script")
    ]
    for word in ("http:", "https:", "//", "url(", "@import"):
        assert word not in text
    policies = [meta["content"] for meta in parsed.all("meta") if meta.get("http-equiv") == "Content-Security-Policy"]
    assert policies == ["default-src 'none'; style-src 'unsafe-inline'"]


@pytest.mark.parametrize("n", [1600, 100_000])
def test_weight(n):
    assert len(render(make_page(n)).encode()) <= 1.5e6


@pytest.mark.parametrize(
    "residual",
    [np.zeros(20), np.full(20, 1e-17), np.r_[np.nan, np.inf, np.linspace(-1e-4, 1e-4, 18)], np.full(20, np.nan)],
    ids=["zero", "rounding", "gaps", "nothing"],
)
def test_odd_residuals_make_a_page(residual):
    page = make_page(20)
    estimate = replace(
        page.estimate, residual={"m": residual}, rms_after={"m": 0.0}, rms_history={"m": (1e-2, 0.0)}, rank_gap=math.nan
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = render(replace(page, estimate=estimate))
    Strict(text)
    assert "nan" not in re.sub(r"<style.*?</style>", "", text, flags=re.S).lower()


@pytest.mark.parametrize("fitted", [1, 0, 2])
def test_few_fitting_rows_make_a_page(fitted):
    """Of a kind, no row may be fitted; of all, at least one is."""
    page = both(make_page(2), make_page(2, "seat"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Strict(render(replace(page, estimate=replace(page.estimate, fitted=np.arange(4) < max(fitted, 1)))))
        rows, *_ = rows_by_kind(page.estimate, page.table, page.longitude)
        assert figures_of(rows._replace(fitted=np.arange(2) < fitted))
