"""The correlations of the identified parameters as a picture of what the data can hardly distinguish."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from truearm.report import svg
from truearm.report.figures import Figure
from truearm.report.page_text import number
from truearm.results import Estimate
from truearm.types import Floats

MOST = 60  # parameters in the picture
STRONGEST = 4  # correlations that its caption names


def correlation(estimate: Estimate) -> Figure | None:
    """Return the lower triangle of the robot's parameter correlations; None unless there are 2 to MOST."""
    seen = estimate.free & estimate.identifiable & (np.diag(estimate.covariance) > 0.0)
    seen[estimate.n_robot_parameters :] = False
    names = [name for name, is_seen in zip(estimate.parameter_names, seen, strict=True) if is_seen]
    if not 2 <= len(names) <= MOST:
        return None
    sigma = np.sqrt(np.diag(estimate.covariance)[seen])
    rho = estimate.covariance[np.ix_(seen, seen)] / np.outer(sigma, sigma)
    cell, left, top = 16.0, 118.0, 8.0
    size = cell * len(names)
    width = max(left + size, 640.0) + 8.0  # room for the key next to a small triangle
    parts = [
        _cell(rho[i, j], left + cell * j, top + cell * i, cell, names[i], names[j])
        for i, j in zip(*np.tril_indices(len(names), -1))
    ]
    for k, name in enumerate(names):
        at = cell * (k + 0.5)
        parts.append(svg.label(left - 6, top + at + 4, _short(name), "end small"))
        turned = f' transform="translate({svg.num(left + at + 4)} {svg.num(top + size + 6)}) rotate(-90)"'
        parts.append(svg.label(0, 0, _short(name), "end small", turned))
    parts.append(_colour_key(width - 212.0, top + 14.0))
    caption = "Of the parameters that were identified. Strongest: " + "; ".join(_strongest(rho, names)) + "."
    picture = svg.drawing(width, top + size + 112.0, parts, "Correlation. " + caption)
    return Figure("Correlation of the parameters", caption, picture, wide=True)


def _cell(rho: float, x: float, y: float, cell: float, a: str, b: str) -> str:
    css = "positive" if rho > 0.0 else "negative"
    extra = f' fill-opacity="{abs(rho):.2f}"'
    return svg.rect(x, y, cell - 1.0, cell - 1.0, css, f"{a}, {b}: {number(rho, 2, sign=True)}", extra)


def _short(name: str) -> str:
    return name if len(name) <= 16 else name[:15] + "…"


def _colour_key(x: float, y: float) -> str:
    parts = []
    for k in range(11):
        rho = k / 5.0 - 1.0
        parts.append(_cell(rho, x + 18.0 * k, y, 18.0, "key", "correlation"))
    marks = zip((0, 5, 10), (-1, 0, 1), strict=True)
    return "".join(parts) + "".join(svg.label(x + 18.0 * k + 9, y + 34, number(v, 0), "mid small") for k, v in marks)


def _strongest(rho: Floats, names: Sequence[str]) -> list[str]:
    i, j = np.tril_indices(len(names), -1)
    order = np.argsort(-np.abs(rho[i, j]))[:STRONGEST]
    return [f"{names[i[k]]} and {names[j[k]]} {number(rho[i[k], j[k]], 2, sign=True)}" for k in order]
