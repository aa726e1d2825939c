"""The calibrated robot with its whole joint law as one C99 file or one Python file without dependencies.

Both files are templates of this folder, in which the tables stand between two marked lines.
"""

from __future__ import annotations

from importlib import resources
from itertools import groupby
from typing import Any

import numpy as np

from truearm.export.toml_tables import NO_LIMIT
from truearm.export.writing import LinkFrames, RobotToWrite
from truearm.types import Floats


def write_python(source: RobotToWrite) -> str:
    """Return the evaluator in Python."""
    lines = [f"{name} = {value!r}" for name, value in _tables(source).items()]
    return _filled("py", [f"# {line}" for line in source.comment.splitlines()], lines)


def write_c(source: RobotToWrite) -> str:
    """Return the evaluator in C99."""
    tables = _tables(source)
    curves, sags = tables.pop("CURVES"), tables.pop("SAG")
    lines = [f"#define JOINTS {tables.pop('JOINTS')}", f"#define CURVES {len(curves)}", f"#define SAGS {len(sags)}"]
    empty_curve, empty_sag = (0, 0.0, 1.0, False, (0.0,)), (0, 0, (0.0, 0.0, 0.0), 0.0)  # C has no empty tables
    *columns, values = zip(*curves or [empty_curve], strict=True)
    counts = tuple(map(len, values))
    starts = tuple(np.cumsum([0, *counts])[:-1].tolist())
    names = ("CURVE_JOINT", "CURVE_FIRST", "CURVE_SPACING", "CURVE_PERIODIC", "CURVE_START", "CURVE_COUNT")
    tables |= dict(zip(names, (*columns, starts, counts), strict=True))
    tables["COEFFICIENTS"] = tuple(coefficient for curve in values for coefficient in curve)
    sag_names = ("SAG_JOINT", "SAG_POINT", "SAG_GRAVITY", "SAG_COMPLIANCE")
    tables |= dict(zip(sag_names, zip(*sags or [empty_sag], strict=True), strict=True))
    for name, value in tables.items():
        shape = "".join(f"[{n}]" for n in np.shape(value))
        kind = "double" if np.asarray(value).dtype.kind == "f" else "int"
        lines.append(f"static const {kind} {name}{shape} = {_braces(value)};")
    comment = [f"/* {line.replace('*/', '* /')} */" for line in source.comment.splitlines()]
    return _filled("c", comment, lines)


def _filled(suffix: str, comment: list[str], lines: list[str]) -> str:
    """Return the template with its tables."""
    text = resources.files(__package__).joinpath(f"evaluator_template.{suffix}").read_text("utf-8")
    begin, end = ("# tables\n", "# end tables\n") if suffix == "py" else ("/* tables */\n", "/* end tables */\n")
    head, _, tail = text.partition(begin)
    return "\n".join([*comment, head]) + begin + "\n".join(lines) + "\n" + end + tail.partition(end)[2]


def _braces(value: Any) -> str:
    if isinstance(value, tuple):
        return "{" + ", ".join(map(_braces, value)) + "}"
    return repr(int(value)) if isinstance(value, bool) else repr(value)


def _tables(source: RobotToWrite) -> dict[str, Any]:
    """Return the tables by name: numbers and nested tuples of them."""
    robot, nominal, chain = source.robot, source.described, source.chain
    values = robot.params.tolist()
    lower, upper = np.clip(chain.limits, -NO_LIMIT, NO_LIMIT).tolist()
    laws = [(p.term, p.joint or 0, p.basis, values[i]) for i, p in enumerate(chain.parameters)]
    curves = []
    for joint, group in groupby((law for law in laws if law[0] == "curve"), key=lambda law: law[1]):
        knots = list(group)
        first, spacing, period = knots[0][2]
        curves.append((joint, float(first), float(spacing), period != 0.0, tuple(value for *_, value in knots)))
    sags = [
        (joint, int(basis[0]), tuple(map(float, basis[1:])), value)
        for term, joint, basis, value in laws
        if term == "sag" and value
    ]
    return {
        "JOINTS": len(robot.joints),
        "SLIDES": tuple(joint.kind == "prismatic" for joint in robot.joints),
        "LINKS": _links(robot),
        "OFFSETS": tuple(robot.offsets.tolist()),
        "GAINS": tuple(robot.gains.tolist()),
        "LOWER": tuple(lower),
        "UPPER": tuple(upper),
        "CURVES": tuple(curves),
        "NOMINAL_LINKS": _links(nominal),
        "NOMINAL_OFFSETS": tuple(nominal.offsets.tolist()),
        "NOMINAL_GAINS": tuple(nominal.gains.tolist()),
        "SAG": tuple(sags),
        "PAYLOAD_MASS": float(chain.payload.mass),
        "PAYLOAD_CENTRE": tuple(map(float, chain.payload.centre)),
    }


def _links(robot: LinkFrames) -> tuple[Any, ...]:
    """Return the rows [R | p] of the links with the mountings."""
    links: Floats = np.stack([robot.first, *robot.links[1:-1], robot.last])
    return tuple(tuple(map(tuple, link[:3].tolist())) for link in links)
