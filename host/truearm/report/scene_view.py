"""The 3-D view of a page: the arm, its fixtures, points with error vectors. The pictures of the page stay for paper and for pages without a script.

The page holds the data as JSON and one script, ``view3d/bundle.js``, which only runs if its hash is that of the page's
Content-Security-Policy. ``view3d/view.js`` is its source. The view stays hidden without the script or without WebGL.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats
from truearm.units import MM

MOST_POINTS = 1000  # of a set: about 130 kB with vectors, joints and names
LONGEST_NAME = 80


@dataclass(frozen=True, eq=False)
class Points:
    """A set of n points to draw, each with the joints at which the arm reaches it.

    ``xyz`` (n, 3) [m] is in the base frame and ``q`` (n, j) [rad, m]. ``values`` (n,) [m] colour the points and ``vectors`` (n, 3)
    [m] start at them, by name; NaN where there is none. ``fixture`` (n,) is the index of the fixture that a bar connects
    the point to, -1 for none.
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
    ``links`` and ``tools`` (m, 8) are capsules there: the joint that each moves with (0: none), both ends and the radius [m].
    ``fixtures`` are names and positions [m].
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
