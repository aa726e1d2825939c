"""Calibrated robots as robot files (TOML, docs/reference/robot-format.md): tables to read, and to identify from again.

Every convention has its table: ``dh`` and ``modified_dh`` rows between base and tool, ``sheth_uicker`` links of six
constants. The mountings are part of base and tool, or of the first and the last link; the comment at the top lists them
separately.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence

import numpy as np

from truearm.errors import RobotError
from truearm.export.dh import DhRows, dh_rows
from truearm.export.link_frames import LinkFrames
from truearm.export.writing import RobotToWrite
from truearm.model.chain_structure import Joint
from truearm.model.poses import six_of
from truearm.types import Floats
from truearm.units import UNITS

SIX = ("x_m", "y_m", "z_m", "alpha_rad", "beta_rad", "gamma_rad")
NO_LIMIT = UNITS["rad"].largest  # for a joint without limits


def sheth_uicker_table(source: RobotToWrite) -> str:
    """Return a robot file of links of six constants, joints about or along z, for any robot."""
    robot = source.robot
    links = [robot.first, *robot.links[1:-1], robot.last]
    lines = _head(robot, "sheth_uicker", source.comment)
    for i, link in enumerate(links):
        lines += ["", f"[link{i + 1}]", *_six(link)]
        if i < len(robot.joints):
            lines += _joint(i, robot, float(robot.offsets[i]))
    return "\n".join([*lines, ""])


def dh_table(source: RobotToWrite, hayati: bool = False) -> str:
    """Return a robot file of distal rows, with β if ``hayati`` and needed. Raises RobotError for prismatic joints."""
    rows = _rows(source, hayati)

    def constants(i: int) -> list[str]:
        has_beta = not math.isnan(rows.beta[i])
        d = "d_m = 0.0" if has_beta else _parameter("d_m", rows.d[i])
        beta = [_parameter("beta_rad", rows.beta[i])] * has_beta
        return [d, _parameter("a_m", rows.a[i]), _parameter("alpha_rad", rows.alpha[i]), *beta]

    return _rows_table(source, rows, "dh", constants)


def dh_hayati_table(source: RobotToWrite) -> str:
    """Return a robot file of distal rows, with β where it is needed."""
    return dh_table(source, hayati=True)


def modified_dh_table(source: RobotToWrite) -> str:
    """Return a robot file of Craig's rows: a and α of a row are those of the distal form one row earlier."""
    rows = _rows(source)

    def constants(i: int) -> list[str]:
        a, alpha = (rows.a[i - 1], rows.alpha[i - 1]) if i else (0.0, 0.0)
        return [_parameter("alpha_rad", alpha), _parameter("a_m", a), _parameter("d_m", rows.d[i])]

    return _rows_table(source, rows, "modified_dh", constants)


def _rows_table(source: RobotToWrite, rows: DhRows, convention: str, constants: Callable[[int], list[str]]) -> str:
    robot = source.robot
    lines = [*_head(robot, convention, source.comment), "", "[base]", *_six(robot.base @ rows.base)]
    for i in range(len(robot.joints)):
        lines += [*_joint(i, robot, float(rows.theta[i] + robot.offsets[i])), *constants(i)]
    return "\n".join([*lines, "", "[tool]", *_six(rows.tool @ robot.tool), ""])


def _rows(source: RobotToWrite, hayati: bool = False) -> DhRows:
    for joint in source.robot.joints:
        if joint.kind != "revolute":
            raise RobotError(
                f"joint {joint.name} is prismatic; this format holds revolute joints only, use sheth-uicker"
            )
    return dh_rows(source.robot, source.described, hayati)


def _head(robot: LinkFrames, convention: str, comment: str) -> list[str]:
    return [
        *(f"# {line}" for line in comment.splitlines()),
        *([""] if comment else []),
        f"name = {_text(robot.name)}",
        f'convention = "{convention}"',
        'source = "truearm export"',
        'nominal = "calibrated"',
        f"base_frame = {_text(robot.base_frame)}",
        f"end_frame = {_text(robot.end_frame)}",
    ]


def _text(text: str) -> str:
    """Return a TOML basic string; JSON's escapes are TOML's."""
    return json.dumps(text, ensure_ascii=False)


def _six(pose: Floats) -> list[str]:
    return [_parameter(key, value) for key, value in zip(SIX, six_of(pose), strict=True)]


def _joint(i: int, robot: LinkFrames, offset: float) -> list[str]:
    joint = robot.joints[i]
    unit = "m" if joint.kind == "prismatic" else "rad"
    lower, upper = _limits(joint)
    return [
        "",
        f"[joint{i + 1}]  # {one_line(joint.name)}",
        f'kind = "{joint.kind}"',
        f"lower_{unit} = {lower!r}",
        f"upper_{unit} = {upper!r}",
        _parameter(f"offset_{unit}", offset),
        f"gain = {{ calibrated = {float(robot.gains[i])!r}, held = true }}",
        *_further_terms(i, robot),
    ]


def _further_terms(i: int, robot: LinkFrames) -> list[str]:
    """Return the terms of a joint's law other than offset and gain, unless they are neutral."""
    return [
        _parameter(f"{term.name}_{term.unit_of(robot.joints[i].kind)}".removesuffix("_1"), robot.params[index])
        for term in robot.further_terms
        for index in term.parameters[term.joints == i]
        if robot.params[index] != term.neutral
    ]


def _limits(joint: Joint) -> Sequence[float]:
    return [float(np.clip(value, -NO_LIMIT, NO_LIMIT)) for value in (joint.lower, joint.upper)]


def _parameter(key: str, value: float) -> str:
    return f"{key} = {{ calibrated = {float(value) + 0.0!r} }}"


def one_line(text: str) -> str:
    """Return a name as it may appear in a comment."""
    return "".join(c for c in text if c.isprintable())[:100]
